"""Correct ranges by a calibration, as columns and one at a time: delays, curve, expected errors.

A single range takes a few microseconds of plain Python, for the loop of a robot: curves are split into polynomials
between knots. Both ways give the same numbers.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from scipy.interpolate import PPoly

from calib.calibration.error_model import ErrorShapes
from calib.calibration.parts import CorrectedRange, CorrectedRanges, offset_of, offsets_m
from calib.calibration.power_curves import Curve, ends, lift
from calib.data.ranges import FAINTEST_DBM, LOUDEST_DBM, Ranges
from calib.errors import BadInputError
from uwblink.arrays import Floats

if TYPE_CHECKING:
    from calib.calibration.model import Calibration

NEPERS_PER_DB: Final = math.log(10) / 10


def corrected_ranges(calibration: Calibration, ranges: Ranges) -> CorrectedRanges:
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


def _without_delays(calibration: Calibration, ranges: Ranges) -> Floats:
    """Return ranges (n,) corrected for the delays of both tags and for constants of pairs, in metres."""
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


def _errors(calibration: Calibration, ranges: Ranges, lifted: Floats, error_m: Floats) -> dict[str, Any]:
    """Return the expected errors of ranges (n,), by the names of `CorrectedRanges`."""
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
        "outlier": looked_at & (outlier > 0.5),
    }


def _bias(calibration: Calibration, ranges: Ranges, lifted: Floats) -> Floats:
    """Return the bias of ranges (n,) in metres, at the power of the exchange or of each reception."""
    if calibration.power_at == "exchange":
        return _curve(calibration, ranges, lifted, "bias_curve")
    first, second = (
        _curve(calibration, ranges, lift(power, calibration.alpha_dbm), "bias_curve")
        for power in ends(ranges.fpp1_dbm, ranges.fpp2_dbm)
    )
    return (first + second) / 2


def _curve(
    calibration: Calibration, ranges: Ranges, lifted: Floats, name: Literal["bias_curve", "sigma_curve"]
) -> Floats:
    """Return a curve at lifted powers (n,): the mean of the curves of both tags' groups, where there are groups."""
    if not calibration.groups:
        return np.asarray(getattr(calibration, name)(lifted))
    member = {tag for group in calibration.groups.values() for tag in group.tags}
    without = [tag for tag in ranges.tags() if tag not in member]
    if without:
        raise BadInputError(f"{ranges.source}: tag {without[0]} is in none of the calibration's groups of tags")
    values = np.zeros(len(ranges))
    for group in calibration.groups.values():
        share = 0.5 * np.isin(ranges.initiator, group.tags) + 0.5 * np.isin(ranges.target, group.tags)
        rows = np.flatnonzero(share)
        values[rows] += share[rows] * getattr(group, name)(lifted[rows])
    return values


class PiecewiseCurve:
    """A curve as polynomials between its knots, for one power at a time.

    `left` are the lifted powers at which the polynomials begin; `pieces` their coefficients, the highest power first,
    of the distance from there.
    """

    def __init__(self, curve: Curve) -> None:
        """Split a curve into polynomials."""
        self.low, self.high = curve.range
        first, count = curve.degree, len(curve.coefficients)
        whole = PPoly.from_spline((np.array(curve.knots), np.array(curve.coefficients), curve.degree))
        edges = whole.x[first : count + 1]
        pieces = np.diff(edges) > 0  # no polynomial lies between two equal knots
        self.left: list[float] = edges[:-1][pieces].tolist()
        self.pieces: list[list[float]] = whole.c[:, first:count].T[pieces].tolist()

    def __call__(self, lifted: float) -> float:
        """Return the curve at a lifted power, in metres."""
        x = min(max(lifted, self.low), self.high)
        piece = max(bisect_right(self.left, x) - 1, 0)
        t, value = x - self.left[piece], 0.0
        for coefficient in self.pieces[piece]:
            value = value * t + coefficient
        return value


class RangeCorrector:
    """Corrects single ranges by a calibration; make one object and call it for every range."""

    def __init__(self, calibration: Calibration) -> None:
        """Prepare the curves of every tag, and those of the error model."""
        self._calibration, self._flat = calibration, not calibration.needs_power
        self._metres = {tag: d * 1e-9 * calibration.speed_of_light for tag, d in calibration.delays_ns.items()}
        self._plain = PiecewiseCurve(calibration.bias_curve), PiecewiseCurve(calibration.sigma_curve)
        self._curves = {} if calibration.groups else dict.fromkeys(calibration.delays_ns, self._plain)
        for group in calibration.groups.values():
            curves = PiecewiseCurve(group.bias_curve), PiecewiseCurve(group.sigma_curve)
            self._curves |= dict.fromkeys(group.tags, curves)
        if model := calibration.errors:
            low, high = model.lifted[0], model.lifted[-1]
            self._noise, self._odds = (
                PiecewiseCurve(Curve((low, *model.lifted, high), tuple(values.tolist()), 1, (low, high)))
                for values in model.logarithms
            )

    def __call__(
        self,
        range_m: float,
        fpp1_dbm: float,
        fpp2_dbm: float,
        initiator: int,
        target: int,
        weights: tuple[float, float],
    ) -> CorrectedRange[float]:
        """Return what `Calibration.correct` returns for one range; raises `KeyError` for a tag that is not known."""
        known = self._calibration
        corrected = range_m + weights[0] * self._metres[initiator] + weights[1] * self._metres[target]
        first, second = self._curves[initiator], self._curves[target]
        if known.pair_offsets:
            corrected -= offset_of(known.pair_offsets, initiator, target).offset_m
        lifted = self._lifted(fpp1_dbm, fpp2_dbm)
        if lifted != lifted:
            if not self._flat:
                return CorrectedRange(corrected, math.nan, True, math.nan, math.nan)
            lifted = self._plain[0].low
        powers = [lifted]
        if known.power_at == "reception":
            ends = [self._lifted(power, power) for power in (fpp1_dbm, fpp2_dbm)]
            powers = [power for power in ends if power == power] or powers
        bias = sum(first[0](power) + second[0](power) for power in powers) / (2 * len(powers))
        sigma = (first[1](lifted) + second[1](lifted)) / 2
        clamped = not (self._flat or self._plain[0].low <= lifted <= self._plain[0].high)
        errors = self._errors(lifted, initiator, target, clamped=clamped)
        return CorrectedRange(corrected - bias, sigma, clamped, *errors)

    def _errors(self, lifted: float, initiator: int, target: int, *, clamped: bool) -> tuple[float, float]:
        """Return the total standard deviation in metres, and the share of reflections; NaN without an error model."""
        model = self._calibration.errors
        if model is None:
            return math.nan, math.nan
        pair = (initiator, target) if initiator < target else (target, initiator)
        noise, odds, detour = model.factors.get(pair, (0.0, 0.0, 0.0))
        shape = ErrorShapes(
            noise_m=math.exp(noise + self._noise(lifted)),
            tail_share=1 / (1 + math.exp(-odds - self._odds(lifted))),
            detour_m=model.detour_m * math.exp(detour),
        )
        beyond = float(self._calibration.bias_curve.beyond(lifted)) if clamped else 0.0
        return math.hypot(model.total_m(shape), beyond), shape.tail_share

    def _lifted(self, first: float, second: float) -> float:
        """Return the lifted power; if one of both powers is missing, the other replaces it."""
        known = [power for power in (first, second) if FAINTEST_DBM < power < LOUDEST_DBM]
        if not known:
            return math.nan
        alpha, count = self._calibration.alpha_dbm, len(known)
        if self._calibration.lift == "lift-of-mean":
            return math.exp((sum(known) / count - alpha) * NEPERS_PER_DB)
        return sum(math.exp((power - alpha) * NEPERS_PER_DB) for power in known) / count
