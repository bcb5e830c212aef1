"""The delay of a new tag, from ranges with tags that are calibrated already."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.power_curves import equal_bins
from calib.data.sources import Data, load_ranges
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.known_distances import LEAST_SCALE_M, SCALE_OF_SPREAD
from calib.estimator.losses import LOSSES
from calib.estimator.optimize import Optimum, maximize
from calib.estimator.range_rows import RESIDUAL, Part, RangeRows, Robust
from calib.estimator.unknowns import Layout, Priors, Unknown
from calib.range_errors.error_mixture import fit_error_mixture
from calib.settings import check_choice, check_tag
from calib.spread import robust_spread
from uwblink.arrays import Floats
from uwblink.recording.antenna_delays import delays_differ, known_delays
from uwblink.ticks import SPEED_OF_LIGHT

FEWEST = 50


def add_tag(data: Data | Iterable[Data], calibration: Calibration, tag: int, loss: str = "cauchy") -> Calibration:
    """Return the calibration with the delay of one more tag; everything known stays as it was.

    `data` is what `load_ranges` takes.
    Start is the closed form of ICRA 2023, section III, for one pair (the median of what is missing); result a robust
    fit over all exchanges with calibrated tags, at the centre of the core of their errors. Raises `BadInputError`
    where the tag is known already or not in the data, `UnanswerableError` where too few exchanges help.

    >>> import calib, dataclasses
    >>> known = calib.fit(calib.sample_flight()).calibration
    >>> two = dataclasses.replace(known, delays_ns={tag: known.delays_ns[tag] for tag in (1, 2)})
    >>> abs(calib.add_tag(calib.sample_flight(seed=2), two, 3).delays_ns[3] - known.delays_ns[3]) < 0.02
    True
    """
    check_tag(tag)
    check_choice("loss", loss, LOSSES)
    if calibration.pair_offsets:
        raise BadInputError("has constants of pairs, which say nothing of a tag; fit anew", parameter="calibration")
    ranges = load_ranges(data, need_power=calibration.needs_power)
    if tag in calibration.delays_ns:
        raise BadInputError(f"tag {tag} has a delay in the calibration already; fit anew to change it", parameter="tag")
    differ = delays_differ(calibration.antenna_delays, ranges.antenna_delays, calibration.delays_ns)
    if differ:
        raise BadInputError(differ, parameter="calibration")
    if tag not in ranges.tags():
        raise BadInputError(
            f"tag {tag} does not range in {ranges.source}; its tags are {', '.join(map(str, ranges.tags()))}",
            parameter="tag",
        )
    mine_first, mine_second = ranges.initiator == tag, ranges.target == tag
    other = np.where(mine_first, ranges.target, ranges.initiator)
    useful = (mine_first | mine_second) & np.isin(other, list(calibration.delays_ns))
    if np.count_nonzero(useful) < FEWEST:
        raise UnanswerableError(
            f"{ranges.source}: {np.count_nonzero(useful)} exchanges of tag {tag} with calibrated tags are too few, "
            f"at least {FEWEST} are needed"
        )
    some = ranges[useful]
    mine = np.where(some.initiator == tag, some.weight_initiator, some.weight_target) * SPEED_OF_LIGHT * 1e-9
    trial = replace(calibration, delays_ns=calibration.delays_ns | {tag: 0.0})
    applied = trial.apply(some)
    error = applied.corrected_m - some.truth_m
    found = _robust(mine, error, loss)
    bins = equal_bins(applied.lifted)
    centre = fit_error_mixture(error + mine * found.of("delay")[0], bins.number, len(bins.count)).location_m
    delay = float(found.of("delay")[0] - centre / np.mean(mine))
    added = {"tag": tag, "recording": ranges.source, "exchanges": int(np.count_nonzero(useful))}
    return replace(
        calibration,
        delays_ns=calibration.delays_ns | {tag: delay},
        delays_std_ns=calibration.delays_std_ns | {tag: float(np.sqrt(found.covariance[0, 0]))},
        antenna_delays={**calibration.antenna_delays, **known_delays(ranges.antenna_delays, [tag])},
        provenance=calibration.provenance | {"added": [*calibration.provenance.get("added", []), added]},
    )


def _robust(mine: Floats, error: Floats, loss: str) -> Optimum:
    """Return the delay that explains errors (n,) best, whose derivatives (n,) are `mine`, by a robust loss."""
    layout = Layout((Unknown(kind="delay", names=("",), start=np.array([float(np.median(-error / mine))])),))
    part = Part(parameter=RESIDUAL, kind="delay", columns=np.zeros((len(error), 1), np.int64), values=mine[:, None])
    rows = RangeRows.of(
        error, np.zeros(len(error), np.int64), [part], Robust(weights=LOSSES[loss].weights, scale_m=1.0), layout
    )
    x, scale = layout.start(), 1.0
    for _ in range(5):
        residual = rows.residuals(x)
        scale = max(SCALE_OF_SPREAD * robust_spread(residual), LEAST_SCALE_M)
        errors = Robust(weights=LOSSES[loss].weights, scale_m=scale).tempered(residual)
        found = maximize([replace(rows, errors=errors)], Priors(layout), x, evidence_steps=0, tolerance=1e-6)
        x = found.x
    return found
