"""The delay of a new tag, from ranges with tags that are calibrated already."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.power_curves import equal_bins
from calib.data.sources import Data, load_ranges
from calib.error_mixture import fit_error_mixture
from calib.errors import BadInputError, UnanswerableError
from calib.estimation.robust import robust_fit, sandwich
from calib.estimator.losses import LOSSES
from calib.settings import check_choice, check_tag
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
    start = np.array([float(np.median(-error / mine))])
    found = robust_fit(mine[:, None], error, loss, start=start)
    core = error + mine * found.parameters[0]
    bins = equal_bins(applied.lifted)
    delay = float(
        found.parameters[0] - fit_error_mixture(core, bins.number, len(bins.count)).location_m / np.mean(mine)
    )
    covariance = sandwich(mine[:, None], found.residuals, LOSSES[loss], found.scale)
    added = {"tag": tag, "recording": ranges.source, "exchanges": int(np.count_nonzero(useful))}
    return replace(
        calibration,
        delays_ns=calibration.delays_ns | {tag: delay},
        delays_std_ns=calibration.delays_std_ns | {tag: float(np.sqrt(covariance[0, 0]))},
        antenna_delays={**calibration.antenna_delays, **known_delays(ranges.antenna_delays, [tag])},
        provenance=calibration.provenance | {"added": [*calibration.provenance.get("added", []), added]},
    )
