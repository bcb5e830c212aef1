"""Lifted power, and curves over it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from scipy.interpolate import BSpline

from calib.calibration.document import Metres, Number, joint, number
from uwblink.arrays import Bools, Floats, Ints

ALPHA_DBM: Final = -82.0
"""The power whose lifted power is 1 (ICRA 2023, section IV)."""

DEGREE: Final = 3
"""Degree of fitted curves. Cubic splines have a continuous second derivative, which measures their roughness."""

SIGMA_SEGMENTS: Final = 4
"""Number of segments of the curve of the noise; a prior on its roughness keeps it smooth."""

SIGMA_FLOOR_M: Final = 0.002
"""Smallest standard deviation of ranges: about half of a tick of 4.7 mm."""


def lift(power_dbm: Floats, alpha_dbm: float) -> Floats:
    """Return 10^((p - alpha)/10) (ICRA 2023, section IV)."""
    # np.exp takes a third of the time of 10 ** x.
    return np.asarray(np.exp((power_dbm - alpha_dbm) * (np.log(10) / 10)))


LIFTS: Final[dict[str, Callable[[Floats, Floats, float], Floats]]] = {
    "mean-of-lifted": lambda fpp1, fpp2, alpha: (lift(fpp1, alpha) + lift(fpp2, alpha)) / 2,
    "lift-of-mean": lambda fpp1, fpp2, alpha: lift((fpp1 + fpp2) / 2, alpha),
}
"""Functions of the powers of both ends (n,) and of alpha, in dBm, that return the lifted power of exchanges (n,): as in
the code of the authors of ICRA 2023, and as in the formula of the paper."""


def lifted_power(fpp1_dbm: Floats, fpp2_dbm: Floats, how: str, alpha_dbm: float) -> Floats:
    """Return the lifted power of exchanges (n,); a missing power of one end is replaced by that of the other."""
    return LIFTS[how](*ends(fpp1_dbm, fpp2_dbm), alpha_dbm)


def ends(fpp1_dbm: Floats, fpp2_dbm: Floats) -> tuple[Floats, Floats]:
    """Return the powers of both ends (n,); a missing power of one end is replaced by that of the other."""
    return (
        np.where(np.isfinite(fpp1_dbm), fpp1_dbm, fpp2_dbm),
        np.where(np.isfinite(fpp2_dbm), fpp2_dbm, fpp1_dbm),
    )


@dataclass(frozen=True, slots=True)
class Curve:
    """A B-spline over lifted power, held constant outside `range`, where nothing was measured.

    A flat curve has the same value at all powers, and also for ranges without power.
    """

    knots: tuple[Number, ...]
    coefficients: tuple[Metres, ...]
    degree: Annotated[int, number(0, 5, "a degree, 0 to 5", int)]
    range: tuple[Number, Number]

    def __call__(self, lifted: Floats) -> Floats:
        """Return the curve at lifted powers (n,), in metres."""
        if self.flat:
            return np.full(np.shape(lifted), self.coefficients[0])
        knots, coefficients = np.array(self.knots), np.array(self.coefficients)
        # `BSpline` would check the knots again at each call, which takes ten times as long as one range needs.
        spline = BSpline.construct_fast(knots, coefficients, self.degree)
        return np.asarray(spline(np.clip(lifted, *self.range)))

    def splines(self, lifted: Floats) -> Floats:
        """Return the B-splines (n, m) at lifted powers (n,): the curve is their product with the coefficients."""
        inside, knots = np.clip(lifted, *self.range), np.array(self.knots)
        return np.asarray(BSpline.design_matrix(inside, knots, self.degree, extrapolate=True).toarray())

    @property
    def flat(self) -> bool:
        """Whether the curve does not depend on power."""
        return min(self.coefficients) == max(self.coefficients)

    def inside(self, lifted: Floats) -> Bools:
        """Return a mask (n,) of lifted powers within the fitted range; True for all, also NaN, if the curve is flat."""
        return np.asarray(self.flat | ((lifted >= self.range[0]) & (lifted <= self.range[1])))

    def beyond(self, lifted: Floats | float) -> Floats:
        """Return the size (n,) of the change that a linear extrapolation would give outside the range, in metres.

        The curve is held constant there, so this estimates its error. It is zero within the range.
        """
        low, high = self.range
        away = np.asarray(lifted - np.clip(lifted, low, high))
        if not away.any():
            return away
        step = 0.1 * (high - low)  # slopes at the ends are those over a tenth of the range
        ends = self(np.array([low, low + step, high - step, high]))
        return np.asarray(np.abs(np.where(away < 0, ends[1] - ends[0], ends[3] - ends[2]) / step * away))


def _is_spline(curve: Curve) -> bool:
    fits = len(curve.knots) == len(curve.coefficients) + curve.degree + 1 and list(curve.knots) == sorted(curve.knots)
    return fits and len(curve.coefficients) > curve.degree and curve.range[0] < curve.range[1]


BiasCurve = Annotated[Curve, joint(_is_spline, "knots, coefficients, degree and range do not agree")]
SigmaCurve = Annotated[
    BiasCurve,
    joint(
        lambda curve: min(curve.coefficients) >= 0 or bool(np.all(curve(np.linspace(*curve.range, 200)) >= 0)),
        "coefficients: expected a standard deviation of 0 m or more everywhere",
    ),
]


def flat_curve(value_m: float, span: tuple[float, float]) -> Curve:
    """Return a constant curve in metres, with the lifted powers `span` as its range; an empty span is widened."""
    low, high = span if span[1] > span[0] else (0.999 * span[0], 1.001 * span[1])
    return Curve((low,) * (DEGREE + 1) + (high,) * (DEGREE + 1), (value_m,) * (DEGREE + 1), DEGREE, (low, high))


def populated(ordered: Floats) -> tuple[float, float]:
    """Return the range in which a curve is fitted: the 0.5 % and 99.5 % quantiles of lifted powers, sorted (n,)."""
    low, high = np.quantile(ordered, [0.005, 0.995]).tolist()
    return low, high


def knots_for(ordered: Floats, segments: int, span: tuple[float, float]) -> Floats:
    """Return clamped knots of a cubic spline with a number of segments, for lifted powers, sorted (n,).

    They lie in `span`, halfway between segments of equal counts and of equal lengths.
    With equal counts, one long segment would cover the sparse high powers; with equal lengths, some segments would have
    no data.
    """
    low, high = span
    quantiles = np.clip(np.quantile(ordered, np.linspace(0, 1, segments + 1)), low, high)
    inner = (quantiles + np.linspace(low, high, segments + 1)) / 2
    inner[[0, -1]] = low, high
    return np.concatenate([[low] * DEGREE, inner, [high] * DEGREE])


def basis(lifted: Floats, knots: Floats) -> Floats:
    """Return the cubic B-splines of `knots` at lifted powers (n,), which are clamped to their span, shape (n, m)."""
    return np.asarray(BSpline.design_matrix(np.clip(lifted, knots[0], knots[-1]), knots, DEGREE).toarray())


def curvature(knots: Floats) -> Floats:
    """Return the integrals of products of the second derivatives of the cubic B-splines of `knots`, shape (m, m).

    This is the penalty matrix of O'Sullivan (1986). Second derivatives are linear between knots, so Gauss-Legendre
    quadrature with two points per segment is exact. Powers are measured in spans of the knots, so the matrix has no
    unit.
    """
    edges = np.unique(knots)
    middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    points = np.concatenate([middle - half / np.sqrt(3), middle + half / np.sqrt(3)])
    every = BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)
    second = every.derivative(2)(points)
    weight = np.concatenate([half, half]) * (edges[-1] - edges[0]) ** 3
    return np.asarray((second * weight[:, None]).T @ second)


def equal_bins(lifted: Floats) -> Ints:
    """Return the number of each lifted power's bin (n,), in order of power.

    Bins have equal counts; there are at most 30 of them, with at least 20 powers each.
    """
    count, number = len(lifted), np.empty(len(lifted), dtype=np.int64)
    number[np.argsort(lifted)] = np.arange(count) * min(30, max(1, count // 20)) // max(count, 1)
    return number
