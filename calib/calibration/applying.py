"""Corrects columns of ranges by a calibration: delays, then the curve, then what is known of the errors."""

from __future__ import annotations

import math
from typing import Any, Final, Literal

import numpy as np

from calib.calibration.content import CalibrationContent
from calib.calibration.pair_offsets import offsets_m
from calib.calibration.parts import CorrectedRanges
from calib.calibration.power_curves import ends, lift
from calib.data.ranges import Ranges
from calib.errors import BadInputError
from uwblink.arrays import Floats

OUTLIER: Final = 0.5
"""Probability above which a range of known error is marked as an outlier."""


def corrected_ranges(calibration: CalibrationContent, ranges: Ranges) -> CorrectedRanges:
    """Return what `Calibration.apply` returns, and raise what that raises."""
    delays = _without_delays(calibration, ranges)
    lifted = calibration.lifted(ranges)
    corrected = delays - _bias(calibration, ranges, lifted)
    return CorrectedRanges(
        raw_m=ranges.raw_m,
        delay_corrected_m=delays,
        corrected_m=corrected,
        sigma_m=_curve(calibration, ranges, lifted, "sigma_curve"),
        lifted=lifted,
        clamped=~calibration.bias_curve.inside(lifted),
        **_errors(calibration, ranges, lifted, corrected - ranges.truth_m),
    )


def _without_delays(calibration: CalibrationContent, ranges: Ranges) -> Floats:
    """Return ranges (n,) without the delays of both tags and without the constants of pairs, in metres."""
    missing = [t for t in ranges.tags() if t not in calibration.delays_ns]
    if missing:
        known = ", ".join(map(str, sorted(calibration.delays_ns)))
        raise BadInputError(
            f"{ranges.source}: no delay for tag {', '.join(map(str, missing))} in the calibration, "
            f"which knows {known}; fit one from a recording with all tags"
        )
    size = max(ranges.tags(), default=0) + 1
    delay_s = np.array([calibration.delays_ns.get(t, math.nan) for t in range(size)]) * 1e-9
    flight = ranges.weight_initiator * delay_s[ranges.initiator] + ranges.weight_target * delay_s[ranges.target]
    return ranges.raw_m + calibration.speed_of_light * flight - offsets_m(calibration.pair_offsets, ranges)


def _errors(calibration: CalibrationContent, ranges: Ranges, lifted: Floats, error_m: Floats) -> dict[str, Any]:
    """Return what is known of the errors of ranges (n,), by the names of `CorrectedRanges`."""
    model = calibration.errors
    if model is None:
        nothing = np.full(len(ranges), np.nan)
        names = ("sigma_total_m", "mean_error_m", "tail_share", "tail_probability")
        return dict.fromkeys(names, nothing) | {"outlier": np.zeros(len(ranges), dtype=bool)}
    shapes = model.shapes(lifted, ranges.initiator, ranges.target)
    looked_at = np.isfinite(error_m)
    tail, outlier = model.tail_given(np.where(looked_at, error_m, 0.0), shapes)
    return {
        "sigma_total_m": np.hypot(model.total_m(shapes), calibration.bias_curve.beyond(lifted)),
        "mean_error_m": model.mean_m(shapes),
        "tail_share": shapes.tail_share,
        "tail_probability": np.where(looked_at, tail, shapes.tail_share),
        "outlier": looked_at & (outlier > OUTLIER),
    }


def _bias(calibration: CalibrationContent, ranges: Ranges, lifted: Floats) -> Floats:
    """Return the bias of ranges (n,) in metres, at the power of the exchange or of each reception."""
    if calibration.power_at == "exchange":
        return _curve(calibration, ranges, lifted, "bias_curve")
    first, second = (
        _curve(calibration, ranges, lift(power, calibration.alpha_dbm), "bias_curve")
        for power in ends(ranges.fpp1_dbm, ranges.fpp2_dbm)
    )
    return (first + second) / 2


def _curve(
    calibration: CalibrationContent, ranges: Ranges, lifted: Floats, name: Literal["bias_curve", "sigma_curve"]
) -> Floats:
    """Return a curve at lifted powers (n,): the mean of the curves of both tags' groups, where there are groups."""
    if not calibration.groups:
        return np.asarray(getattr(calibration, name)(lifted))
    member = {tag for group in calibration.groups.values() for tag in group.tags}
    lonely = [tag for tag in ranges.tags() if tag not in member]
    if lonely:
        raise BadInputError(f"{ranges.source}: tag {lonely[0]} is in none of the calibration's groups of tags")
    values = np.zeros(len(ranges))
    for group in calibration.groups.values():
        share = 0.5 * np.isin(ranges.initiator, group.tags) + 0.5 * np.isin(ranges.target, group.tags)
        rows = np.flatnonzero(share)
        values[rows] += share[rows] * getattr(group, name)(lifted[rows])
    return values
