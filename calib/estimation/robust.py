"""Robust least squares for antenna delays and curves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.estimation.design import Design, as_design
from calib.estimator.losses import LOSSES, Weights
from calib.long_columns import computed, empty, let_go, put, spans
from calib.spread import robust_spread
from uwblink.arrays import Floats
from uwblink.ticks import SPEED_OF_LIGHT

SCALE_OF_SPREAD: Final = 0.5
"""The loss's scale over the robust spread of the residuals.

Half the spread keeps the optimum with the core when a tenth of the data has a positive tail, and
still leaves a Cauchy loss two thirds of least squares' efficiency on clean data.
"""

SCALE_FLOOR_NS: Final = 0.002
MAX_STEPS: Final = 400
SETTLING: Final = 4
"""Steps of reweighting during which an unknown scale follows the residuals; then it stands."""

NEWTON_M: Final = 0.01
"""Newton's steps begin when reweighting moves no range by more than this, and may not move one further."""

CHORD_M: Final = 1e-4
"""Below this movement Newton's steps keep their curvature."""

CONVEX: Final = 1e-13
"""Least share of a curvature's largest eigenvalue that its smallest must have for Newton's steps."""

STILL_M: Final = 1e-8
"""A step that moves no range by more than this ends the iteration (0.03 fs of flight)."""


@dataclass(frozen=True, slots=True)
class Solution:
    """The optimum of a robust fit: parameters (m,), residuals (n,): what is left of the errors."""

    parameters: Floats
    residuals: Floats
    scale: float
    steps: int
    success: bool


def robust_fit(
    matrix: Design | Floats,
    error: Floats,
    loss: str,
    scale: float | None = None,
    penalty: Floats | None = None,
    start: Floats | None = None,
    *,
    near: bool = False,
) -> Solution:
    """Minimise the robust loss of the residuals `error + matrix @ x` plus half of x' penalty x.

    `matrix` (n, m) and `error` (n,) share a unit, which is that of `scale` (estimated from the
    residuals where not given). `near` says that `start` is so near the optimum that Newton's steps may begin at
    once.
    """
    design = as_design(matrix)
    if not design.shape[1]:
        return Solution(np.zeros(0), error.copy(), scale or scale_of(error), 0, True)
    error = design.kept(error)
    ridge = np.zeros((design.shape[1],) * 2) if penalty is None else penalty
    x = start if start is not None else _absolute_start(design, error, ridge)
    residual = added(error, design.times(x))
    width = scale or scale_of(residual)
    steps, moved, curvature = 0, 0.5 * NEWTON_M if near else np.inf, None
    while moved > STILL_M and steps < MAX_STEPS:
        weight, slope = terms(loss, residual, width)
        downhill = -design.pull(product(weight, residual)) - ridge @ x
        # Reweighting descends from anywhere; Newton is faster, where it descends at all. Near the end the curvature no
        # longer changes, and the last one serves on.
        if (near or steps >= SETTLING) and moved < NEWTON_M and (curvature is None or moved > CHORD_M):
            curvature = _descending(design.normal(slope) + ridge)
        step, change = x, np.array([np.inf])
        if curvature is not None:
            step = np.asarray(np.linalg.solve(curvature, downhill))
            change = design.times(step)
        if farthest(change) > NEWTON_M:
            step = _solved(design.normal(weight) + ridge, downhill)
            change, curvature = design.times(step), None
        x, residual = np.asarray(x + step), added(residual, change)
        # What no range determines may go where rounding takes it.
        moved = farthest(change)
        steps += 1
        if scale is None and steps <= SETTLING:
            width = scale_of(residual)
    return Solution(x, design.given(residual), width, steps, moved <= STILL_M)


def _solved(square: Floats, pull: Floats) -> Floats:
    """Return the shortest solution, where some direction may be left open."""
    return np.asarray(np.linalg.lstsq(square, pull, rcond=1e-13)[0], np.float64)


def _descending(curvature: Floats) -> Floats | None:
    """Return a curvature, None where the loss is not convex, so that Newton's step might climb.

    A curve's constant, which only a weak penalty holds, leaves 1e-11 of the largest eigenvalue, rounding 1e-15.
    """
    values = np.linalg.eigvalsh(curvature)
    return None if values[0] <= CONVEX * values[-1] else curvature


def terms(loss: str, residual: Floats, width: float) -> tuple[Floats, Floats]:
    """Return the weights of a loss at residuals (n,), and the slopes of its score."""
    function, count = LOSSES[loss], len(residual)
    weight, slope = empty(count), empty(count)
    for rows in spans(count):
        for column, values in zip((weight, slope), function(residual[rows] / width), strict=True):
            put(column, rows, values)
        let_go(residual)
    return weight, slope


def product(one: Floats, other: Floats) -> Floats:
    """Return two columns (n,) multiplied."""
    return computed(len(one), lambda rows: one[rows] * other[rows])


def added(one: Floats, other: Floats) -> Floats:
    """Return the sum of two columns (n,)."""
    return computed(len(one), lambda rows: one[rows] + other[rows])


def farthest(change: Floats) -> float:
    """Return the largest of some values (k,), either way."""
    return max(float(np.max(change)), -float(np.min(change)))


def scale_of(residual: Floats) -> float:
    """Return the loss's scale from the median absolute deviation of residuals in metres."""
    return max(SCALE_OF_SPREAD * robust_spread(residual), SCALE_FLOOR_NS * 1e-9 * SPEED_OF_LIGHT)


def _absolute_start(design: Design, error: Floats, ridge: Floats) -> Floats:
    """A few rounds towards least absolute deviations: a start that outliers do not own."""
    weight, residual = np.ones(len(error)), error
    x = np.zeros(design.shape[1])
    for _ in range(5):
        downhill = -design.pull(weight * residual) - ridge @ x
        x = x + _solved(design.normal(weight) + ridge, downhill)
        residual = error + design.times(x)
        size = np.abs(residual)
        weight = 1 / np.maximum(size, 0.1 * np.median(size) + 1e-9)
        weight /= weight.max()
    return x


@dataclass(frozen=True, slots=True)
class QuadraticModel:
    """A robust loss near a point, as a quadratic: curvature (m, m), and pull (m,) towards the optimum.

    `dispersion` is the variance that an error counts for: the mean squared score over the mean slope of the score,
    which is sigma squared for least squares.
    """

    curvature: Floats
    pull: Floats
    dispersion: float


def quadratic_model(matrix: Design | Floats, residual: Floats, loss: str, width: float) -> QuadraticModel:
    """Return the quadratic that a loss looks like at `residual` (n,)."""
    design = as_design(matrix)
    residual = design.kept(residual)
    weight, slope = terms(loss, residual, width)
    score = product(weight, residual)
    return QuadraticModel(
        design.normal(slope), -design.pull(score), float(score @ score) / max(float(slope.sum()), 1e-9 * len(slope))
    )


def sandwich(
    matrix: Design | Floats, residual: Floats, function: Weights, width: float, ridge: Floats | None = None
) -> Floats:
    """Return the covariance of parameters at the optimum, where `residual` (n,) is what is left: H^-1 S H^-1.

    It holds under a heavy tail where the usual one does not, but takes every row for independent
    (`calib.estimation.intervals` does not). The penalty counts as what is known beforehand (Wahba 1983; Nychka 1988),
    so that bands of a penalised curve hold its bias too.
    """
    design = as_design(matrix)
    residual = design.kept(residual)
    ridge = np.zeros((design.shape[1],) * 2) if ridge is None else ridge
    weight, slope = function(residual / width)
    bread = np.linalg.pinv(design.normal(slope) + ridge, rcond=1e-12)
    score = weight * residual
    dispersion = float(score @ score) / max(float(slope.sum()), 1e-9 * len(slope))
    meat = design.normal(score**2) + dispersion * ridge
    return np.asarray(bread @ meat @ bread)
