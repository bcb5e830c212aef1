"""First-path power: lifting, and curves over lifted power."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ALPHA_DBM: Final = -82.0
DEGREE: Final = 3
BIAS_SEGMENTS: Final = 8
SIGMA_SEGMENTS: Final = 4
SIGMA_BINS: Final = 30
SIGMA_SMOOTHNESS: Final = 0.1
SIGMA_FLOOR_M: Final = 0.002
"""A tick is 4.7 mm long; no range is better than half of one."""

POPULATED: Final = (0.005, 0.995)
"""Quantiles of lifted power between which a curve is fitted; beyond them it is held constant."""


def lift(power_dbm: Floats, alpha_dbm: float) -> Floats:
    """Return 10^((p - alpha)/10) (ICRA 2023, section V)."""
    return np.asarray(10 ** ((power_dbm - alpha_dbm) / 10))


def _mean_of_lifted(fpp1: Floats, fpp2: Floats, alpha: float) -> Floats:
    return (lift(fpp1, alpha) + lift(fpp2, alpha)) / 2


def _lift_of_mean(fpp1: Floats, fpp2: Floats, alpha: float) -> Floats:
    return lift((fpp1 + fpp2) / 2, alpha)


LIFTS: Final[dict[str, Callable[[Floats, Floats, float], Floats]]] = {
    "mean-of-lifted": _mean_of_lifted,
    "lift-of-mean": _lift_of_mean,
}


def lifted_power(fpp1_dbm: Floats, fpp2_dbm: Floats, how: str, alpha_dbm: float) -> Floats:
    """Lifted power of exchanges (n,); where one end's power is missing, the other's serves."""
    first = np.where(np.isfinite(fpp1_dbm), fpp1_dbm, fpp2_dbm)
    second = np.where(np.isfinite(fpp2_dbm), fpp2_dbm, fpp1_dbm)
    return LIFTS[how](first, second, alpha_dbm)


@dataclass(frozen=True, slots=True)
class Curve:
    """A B-spline over lifted power, held constant outside `range`, where nothing was measured."""

    knots: tuple[float, ...]
    coefficients: tuple[float, ...]
    degree: int
    range: tuple[float, float]

    def __call__(self, lifted: Floats) -> Floats:
        """Return the curve at lifted powers (n,), in metres."""
        from scipy.interpolate import BSpline

        spline = BSpline(np.array(self.knots), np.array(self.coefficients), self.degree)
        return np.asarray(spline(np.clip(lifted, *self.range)))

    def inside(self, lifted: Floats) -> NDArray[np.bool_]:
        """Return which lifted powers (n,) the curve was fitted at."""
        return (lifted >= self.range[0]) & (lifted <= self.range[1])


def populated(lifted: Floats) -> tuple[float, float]:
    """Return the range of lifted power in which there are data to fit a curve to."""
    low, high = np.quantile(lifted, POPULATED)
    return float(low), float(high)


def knots_for(lifted: Floats, segments: int) -> Floats:
    """Return clamped knots with `segments` intervals, halfway between equal counts and equal lengths.

    Equal counts alone leave the sparse high powers to one long segment, equal lengths the sparse ones without data.
    """
    low, high = populated(lifted)
    shares = np.linspace(0, 1, segments + 1)
    inner = (np.quantile(np.clip(lifted, low, high), shares) + np.linspace(low, high, segments + 1)) / 2
    inner[[0, -1]] = low, high
    return np.concatenate([[low] * DEGREE, inner, [high] * DEGREE])


def basis(lifted: Floats, knots: Floats) -> Floats:
    """Return the B-splines of `knots` at lifted powers, clamped to their span, shape (n, m)."""
    from scipy.interpolate import BSpline

    clamped = np.clip(lifted, knots[0], knots[-1])
    return np.asarray(BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)(clamped))


def roughness(count: int) -> Floats:
    """Return the penalty on second differences of `count` coefficients, shape (count, count)."""
    second = np.diff(np.eye(count), 2, axis=0)
    return np.asarray(second.T @ second)


def equal_bins(lifted: Floats, most: int = SIGMA_BINS) -> Ints:
    """Return the bin of each lifted power (n,): bins of equal count, at least 20 each, in order of power."""
    count = min(most, max(1, len(lifted) // 20))
    bins = np.empty(len(lifted), dtype=np.int64)
    bins[np.argsort(lifted)] = np.arange(len(lifted)) * count // len(lifted)
    return bins


def sigma_curve(lifted: Floats, bins: Ints, sigma_m: Floats) -> Curve:
    """Draw a curve through the standard deviations (bins,) of the bins of lifted power (n,).

    The spline's coefficients are held above a floor, and with them the whole curve.
    """
    from scipy.optimize import lsq_linear

    middles = (np.searchsorted(np.sort(bins), np.arange(len(sigma_m))) + np.bincount(bins) // 2).astype(np.int64)
    where = np.sort(lifted)[middles]
    knots = knots_for(lifted, SIGMA_SEGMENTS)
    design = basis(where, knots)
    smooth = SIGMA_SMOOTHNESS * np.diff(np.eye(design.shape[1]), 2, axis=0)
    stacked = np.vstack([design, smooth])
    aim = np.concatenate([sigma_m, np.zeros(len(smooth))])
    solution = lsq_linear(stacked, aim, bounds=(SIGMA_FLOOR_M, np.inf), tol=1e-12)
    return Curve(tuple(knots.tolist()), tuple(solution.x.tolist()), DEGREE, populated(lifted))
