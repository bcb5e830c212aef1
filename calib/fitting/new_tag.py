"""The delay of a new tag, from ranges with calibrated tags."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from calib.calibration.model import Calibration
from calib.data.sources import Data, load_ranges
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.known_distances import Recipe, fit_known_distances
from calib.estimator.losses import MIXTURE, check_loss
from calib.settings import check_tag
from uwblink.recording.antenna_delays import delays_differ, known_delays

MIN_RANGES = 50
"""With so many ranges one delay has a standard error of a seventh of the noise of a range, 0.03 ns."""


def add_tag(data: Data | Iterable[Data], calibration: Calibration, tag: int, loss: str = MIXTURE) -> Calibration:
    """Return the calibration with the delay of one more tag; everything known stays as it was.

    `data` is what `load_ranges` takes. It is the fit of `calib.fit` to all exchanges of the tag with calibrated ones,
    whose delays and curve are known. Raises `BadInputError` where the tag is known already or not in the data,
    `UnanswerableError` where too few exchanges help.

    >>> import calib, dataclasses
    >>> known = calib.fit(calib.sample_flight()).calibration
    >>> two = dataclasses.replace(known, delays_ns={tag: known.delays_ns[tag] for tag in (1, 2)})
    >>> abs(calib.add_tag(calib.sample_flight(seed=2), two, 3).delays_ns[3] - known.delays_ns[3]) < 0.02
    True
    """
    check_tag(tag)
    check_loss(loss)
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
    if np.count_nonzero(useful) < MIN_RANGES:
        raise UnanswerableError(
            f"{ranges.source}: {np.count_nonzero(useful)} exchanges of tag {tag} with calibrated tags are too few, "
            f"at least {MIN_RANGES} are needed"
        )
    some = ranges[useful]
    known = {one: ns for one, ns in calibration.delays_ns.items() if one in some.tags()}
    applied = replace(calibration, delays_ns=calibration.delays_ns | {tag: 0.0}).apply(some)
    straight = replace(some, raw_m=some.raw_m + applied.corrected_m - applied.delay_corrected_m)
    recipe = Recipe(
        loss=loss,
        lift=calibration.lift,
        alpha_dbm=calibration.alpha_dbm,
        fixed_ns=known,
        groups={},
        curve=False,
        min_ranges=MIN_RANGES,
    )
    with threadpool_limits(limits=1, user_api="blas"):
        found = fit_known_distances(straight, recipe)
    k = found.model.tags.index(tag)
    added = {"tag": tag, "recording": ranges.source, "exchanges": int(np.count_nonzero(useful))}
    return replace(
        calibration,
        delays_ns=calibration.delays_ns | {tag: float(found.delays[k])},
        delays_std_ns=calibration.delays_std_ns | {tag: float(np.sqrt(found.covariances["delay"][k, k]))},
        antenna_delays={**calibration.antenna_delays, **known_delays(ranges.antenna_delays, [tag])},
        provenance=calibration.provenance | {"added": [*calibration.provenance.get("added", []), added]},
    )
