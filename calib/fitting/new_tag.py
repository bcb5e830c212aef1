"""The delay of a new tag, from ranges with calibrated tags."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from calib.calibration.model import Calibration
from calib.checks.limits import WITHOUT_CURVE
from calib.data.sources import Data, load_ranges
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.losses import MIXTURE
from calib.fitting.fitting import fit
from calib.fitting.result import FitResult
from calib.settings import FitSettings, check_tag
from uwblink.recording.antenna_delays import delays_differ, known_delays

MIN_RANGES = 50
"""With so many ranges one delay has a standard error of a seventh of the noise of a range, 0.03 ns."""


def add_tag(data: Data | Iterable[Data], calibration: Calibration, tag: int, loss: str = MIXTURE) -> FitResult:
    """Fit the delay of one more tag; everything else in the calibration stays as it was.

    `data` is what `load_ranges` takes. It is the fit of `calib.fit` to all exchanges of the tag with calibrated ones,
    whose delays and curve are known. Raises `BadInputError` where the tag is known already or not in the data, and what
    `calib.fit` raises.

    >>> import calib, dataclasses
    >>> known = calib.fit(calib.sample_flight()).calibration
    >>> two = dataclasses.replace(known, delays_ns={tag: known.delays_ns[tag] for tag in (1, 2)})
    >>> found = calib.add_tag(calib.sample_flight(seed=2), two, 3).calibration
    >>> abs(found.delays_ns[3] - known.delays_ns[3]) < 0.02
    True
    """
    check_tag(tag)
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
    known = list(calibration.delays_ns)
    first, second = (np.isin(ends, known) for ends in (ranges.initiator, ranges.target))
    some = ranges[(first & (ranges.target == tag)) | (second & (ranges.initiator == tag))]
    if len(some) < MIN_RANGES:
        raise UnanswerableError(
            f"{ranges.source}: {len(some)} exchanges of tag {tag} with calibrated tags are too few, "
            f"at least {MIN_RANGES} are needed"
        )
    applied = replace(calibration, delays_ns=calibration.delays_ns | {tag: 0.0}).apply(some)
    straight = replace(some, raw_m=some.raw_m + applied.corrected_m - applied.delay_corrected_m)
    settings = FitSettings(loss=loss, delays_from=calibration, delays_only=True, alpha_dbm=calibration.alpha_dbm)
    found = fit(straight, settings, lift=calibration.lift)
    added = {"tag": tag, "recording": ranges.source, "exchanges": len(some)}
    return replace(
        found,
        calibration=replace(
            calibration,
            delays_ns=calibration.delays_ns | {tag: found.calibration.delays_ns[tag]},
            delays_std_ns=calibration.delays_std_ns | {tag: found.calibration.delays_std_ns[tag]},
            antenna_delays={**calibration.antenna_delays, **known_delays(ranges.antenna_delays, [tag])},
            provenance=calibration.provenance | {"added": [*calibration.provenance.get("added", []), added]},
        ),
        ranges=some,
        # The curve is known, and was taken off before.
        warnings=[text for text in found.warnings if not text.startswith(WITHOUT_CURVE)],
    )
