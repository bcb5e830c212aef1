"""One range at a time, as fast as plain Python goes: what a robot's loop needs of a calibration.

The curves are taken apart into polynomials, one between each two knots, whose coefficients come from the curve's own
values; so this equals `Calibration.apply`, without the arrays.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from calib.calibration.content import CalibrationContent
from calib.calibration.error_model import ErrorsAtOnce
from calib.calibration.pair_offsets import offset_of
from calib.calibration.parts import CorrectedRanges
from calib.calibration.power_curves import Curve
from calib.data.ranges import FAINTEST_DBM, LOUDEST_DBM
from calib.errors import BadInputError
from uwblink.arrays import Bools, Floats
from uwblink.display import as_text, excerpt

NEPERS_A_DB: Final = math.log(10) / 10


class CorrectedRange(NamedTuple):
    """A corrected range and its standard deviation, metres; `clamped` where its power is beyond the curves'.

    `sigma_m` is the noise of a direct range; `sigma_total_m` counts reflections in, of which `tail_share` of the ranges
    of this pair at this power are, both NaN where the calibration does not say. Without a power at either end the range
    has the delays' part only, and its standard deviations are NaN.
    """

    range_m: float
    sigma_m: float
    clamped: bool
    sigma_total_m: float
    tail_share: float


class CorrectedColumns(NamedTuple):
    """What `CorrectedRange` holds, for arrays of ranges (n,)."""

    range_m: Floats
    sigma_m: Floats
    clamped: Bools
    sigma_total_m: Floats
    tail_share: Floats

    @classmethod
    def of(cls, applied: CorrectedRanges) -> CorrectedColumns:
        """Return corrected ranges as columns; those without a power have the delays' part only."""
        powered = np.isfinite(applied.lifted)
        return cls(
            np.where(powered, applied.corrected_m, applied.delay_corrected_m),
            np.where(powered, applied.sigma_m, np.nan),
            applied.clamped,
            applied.sigma_total_m,
            applied.tail_share,
        )

    def __repr__(self) -> str:
        """Return a headline and the first rows, in lines of 79 characters."""
        return as_text(f"{len(self.range_m)} corrected ranges", excerpt(self._asdict()))


class PiecewiseCurve:
    """A curve as polynomials between its knots, for one power at a time."""

    def __init__(self, curve: Curve) -> None:
        """Take a curve apart."""
        knots = np.array(curve.knots)
        count = len(curve.coefficients)
        edges = np.unique(knots[curve.degree : count + 1])
        self.low, self.high = curve.range
        self._inner = edges[1:-1].tolist()
        self._left = edges[:-1].tolist()
        self._scale = (1 / np.diff(edges)).tolist()
        # Interpolated at Chebyshev's points, where a polynomial of low degree loses no digits.
        place = 0.5 - 0.5 * np.cos(np.pi * (np.arange(curve.degree + 1) + 0.5) / (curve.degree + 1))
        points = edges[:-1, None] + place * np.diff(edges)[:, None]
        values = _unclamped(curve)(points.ravel()).reshape(points.shape)
        solved = np.linalg.solve(np.vander(place), values.T).T
        self._pieces = [tuple(row) for row in solved.tolist()]

    def table(self) -> tuple[list[float], list[float], list[tuple[float, ...]]]:
        """Return where each polynomial begins, one over its length, and its coefficients, the highest power first.

        A polynomial takes how far a lifted power is from its beginning, in units of its length.
        """
        return self._left, self._scale, self._pieces

    def __call__(self, lifted: float) -> float:
        """Return the curve at a lifted power, in metres."""
        x = min(max(lifted, self.low), self.high)
        piece = bisect_right(self._inner, x)
        t = (x - self._left[piece]) * self._scale[piece]
        value = 0.0
        for coefficient in self._pieces[piece]:
            value = value * t + coefficient
        return value


def _unclamped(curve: Curve) -> Curve:
    """A curve whose range is all of its knots: pieces are taken where nothing is held constant."""
    return Curve(curve.knots, curve.coefficients, curve.degree, (-math.inf, math.inf))


class RangeCorrector:
    """Corrects single ranges by a calibration; make one, and call it as often as there are ranges."""

    def __init__(self, calibration: CalibrationContent) -> None:
        """Prepare the curves of every group of tags."""
        self._metres = {tag: d * 1e-9 * calibration.speed_of_light for tag, d in calibration.delays_ns.items()}
        self._offsets = calibration.pair_offsets
        self._flat = not calibration.needs_power
        self._alpha = calibration.alpha_dbm
        self._of_mean = calibration.lift == "lift-of-mean"
        self._at_receptions = calibration.power_at == "reception"
        self._plain = PiecewiseCurve(calibration.bias_curve), PiecewiseCurve(calibration.sigma_curve)
        groups = {
            name: (PiecewiseCurve(group.bias_curve), PiecewiseCurve(group.sigma_curve))
            for name, group in calibration.groups.items()
        }
        self._errors = calibration.errors and ErrorsAtOnce(calibration.errors, calibration.bias_curve)
        self._member = {tag: groups[name] for name, group in calibration.groups.items() for tag in group.tags}

    def __call__(
        self,
        range_m: float,
        fpp1_dbm: float,
        fpp2_dbm: float,
        initiator: int,
        target: int,
        weights: tuple[float, float],
    ) -> CorrectedRange:
        """Return what `Calibration.correct` returns for one range."""
        try:
            corrected = range_m + weights[0] * self._metres[initiator] + weights[1] * self._metres[target]
        except KeyError as error:
            raise self._unknown(error.args[0]) from None
        if self._offsets:
            corrected -= offset_of(self._offsets, initiator, target).offset_m
        lifted = self._lifted(fpp1_dbm, fpp2_dbm)
        if lifted != lifted:
            if not self._flat:
                return CorrectedRange(corrected, math.nan, True, math.nan, math.nan)
            lifted = self._plain[0].low
        bias, sigma = self._plain
        clamped = not (self._flat or bias.low <= lifted <= bias.high)
        errors = self._errors(lifted, initiator, target) if self._errors else (math.nan, math.nan)
        if not self._member:
            return CorrectedRange(
                corrected - self._bias(bias, lifted, fpp1_dbm, fpp2_dbm), sigma(lifted), clamped, *errors
            )
        try:
            first, second = self._member[initiator], self._member[target]
        except KeyError as error:
            raise BadInputError(f"tag {error.args[0]} is in none of the calibration's groups of tags") from None
        mean = 0.5 * sum(self._bias(curves[0], lifted, fpp1_dbm, fpp2_dbm) for curves in (first, second))
        both = 0.5 * first[1](lifted) + 0.5 * second[1](lifted)
        return CorrectedRange(corrected - mean, both, clamped, *errors)

    def _bias(self, curve: PiecewiseCurve, lifted: float, first: float, second: float) -> float:
        """Return the bias at the power of the exchange, or the mean of those at its two receptions'."""
        if not self._at_receptions:
            return curve(lifted)
        one, two = self._lifted(first, first), self._lifted(second, second)
        return (curve(one if one == one else two) + curve(two if two == two else one)) / 2

    def _lifted(self, first: float, second: float) -> float:
        """Return the lifted power; of two powers of which one was not measured, the other serves."""
        if not FAINTEST_DBM < first < LOUDEST_DBM:
            first = second
            if not FAINTEST_DBM < first < LOUDEST_DBM:
                return math.nan
        if not FAINTEST_DBM < second < LOUDEST_DBM:
            second = first
        if self._of_mean:
            return math.exp(((first + second) / 2 - self._alpha) * NEPERS_A_DB)
        exp: Callable[[float], float] = math.exp
        return (exp((first - self._alpha) * NEPERS_A_DB) + exp((second - self._alpha) * NEPERS_A_DB)) / 2

    def _unknown(self, tag: object) -> BadInputError:
        known = ", ".join(map(str, sorted(self._metres)))
        return BadInputError(f"no delay for tag {tag} in the calibration, which knows {known}")
