"""Robust least squares for antenna delays and curves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.estimation.losses import LOSSES, Weights
from calib.ranges import Ranges
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

CHUNK: Final = 512
"""Rows of a matrix worked on at once, so that they stay in the cache."""

STILL_M: Final = 1e-8
"""A step that moves no range by more than this ends the iteration (0.03 fs of flight)."""


@dataclass(frozen=True, slots=True)
class Solution:
    """The optimum of a robust fit: parameters (m,), covariance (m, m), residuals (n,): what is left of the errors."""

    parameters: Floats
    covariance: Floats
    residuals: Floats
    scale: float
    steps: int
    success: bool


def design(ranges: Ranges, tags: list[int]) -> Floats:
    """Return the derivative of calibrated ranges by delays, in metres a nanosecond, (n, tags)."""
    matrix = np.zeros((len(ranges), len(tags)))
    rows = np.arange(len(ranges))
    place = np.array(tags)
    for ids, weight in (
        (ranges.initiator, ranges.weight_initiator),
        (ranges.target, ranges.weight_target),
    ):
        matrix[rows, np.searchsorted(place, ids)] += weight * SPEED_OF_LIGHT * 1e-9
    return matrix


def robust_fit(
    matrix: Floats,
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
    residuals where not given). The covariance is the sandwich H^-1 S H^-1, which holds under a heavy
    tail where the usual one does not, but takes every row for independent (`calib.estimation.intervals` does not).
    `near` says that `start` is so near the optimum that Newton's steps may begin at
    once.
    """
    if not matrix.shape[1]:
        return Solution(np.zeros(0), np.zeros((0, 0)), error.copy(), scale or scale_of(error), 0, True)
    ridge = np.zeros((matrix.shape[1],) * 2) if penalty is None else penalty
    x = start if start is not None else _absolute_start(matrix, error, ridge)
    function = LOSSES[loss]
    reach = _reach(matrix)
    residual = error + matrix @ x
    width = scale or scale_of(residual)
    steps, moved, curvature = 0, 0.5 * NEWTON_M if near else np.inf, None
    while moved > STILL_M and steps < MAX_STEPS:
        weight, slope = function(residual / width)
        downhill = -(matrix.T @ (weight * residual)) - ridge @ x
        # Reweighting descends from anywhere; Newton is faster, where it descends at all. Near the end the curvature no
        # longer changes, and the last one serves on.
        if (near or steps >= SETTLING) and moved < NEWTON_M and (curvature is None or moved > CHORD_M):
            curvature = _descending(_normal(matrix, slope, ridge))
        step = None if curvature is None else np.linalg.solve(curvature, downhill)
        if step is None or np.max(np.abs(reach * step)) > NEWTON_M:
            step, curvature = np.linalg.lstsq(_normal(matrix, weight, ridge), downhill, rcond=1e-13)[0], None
        x, before = np.asarray(x + step), residual
        residual = error + matrix @ x
        # What no range determines may go where rounding takes it.
        moved = float(np.max(np.abs(residual - before)))
        steps += 1
        if scale is None and steps <= SETTLING:
            width = scale_of(residual)
    return Solution(
        x,
        sandwich(matrix, residual, function, width, ridge),
        residual,
        width,
        steps,
        moved <= STILL_M,
    )


def _reach(matrix: Floats) -> Floats:
    """Return the largest entry of each column (m,), without a copy of the matrix."""
    return np.asarray(np.maximum(matrix.max(axis=0), -matrix.min(axis=0)))


def _descending(curvature: Floats) -> Floats | None:
    """Return a curvature, None where the loss is not convex, so that Newton's step might climb.

    A curve's constant, which only a weak penalty holds, leaves 1e-11 of the largest eigenvalue, rounding 1e-15.
    """
    values = np.linalg.eigvalsh(curvature)
    return None if values[0] <= CONVEX * values[-1] else curvature


def scale_of(residual: Floats) -> float:
    """Return the loss's scale from the median absolute deviation of residuals in metres."""
    return max(SCALE_OF_SPREAD * robust_spread(residual), SCALE_FLOOR_NS * 1e-9 * SPEED_OF_LIGHT)


def _absolute_start(matrix: Floats, error: Floats, ridge: Floats) -> Floats:
    """A few rounds towards least absolute deviations: a start that outliers do not own."""
    weight = np.ones(len(error))
    x = np.zeros(matrix.shape[1])
    for _ in range(5):
        downhill = -(matrix.T @ (weight * (error + matrix @ x))) - ridge @ x
        x = x + np.linalg.lstsq(_normal(matrix, weight, ridge), downhill, rcond=1e-13)[0]
        residual = np.abs(error + matrix @ x)
        weight = 1 / np.maximum(residual, 0.1 * np.median(residual) + 1e-9)
        weight /= weight.max()
    return x


def _normal(matrix: Floats, weight: Floats, ridge: Floats) -> Floats:
    normal = ridge.copy()
    for begin in range(0, len(matrix), CHUNK):
        part = matrix[begin : begin + CHUNK]
        normal += (part * weight[begin : begin + CHUNK, None]).T @ part
    return normal


@dataclass(frozen=True, slots=True)
class QuadraticModel:
    """A robust loss near a point, as a quadratic: curvature (m, m), and pull (m,) towards the optimum.

    `dispersion` is the variance that an error counts for: the mean squared score over the mean slope of the score,
    which is sigma squared for least squares.
    """

    curvature: Floats
    pull: Floats
    dispersion: float


def quadratic_model(matrix: Floats, residual: Floats, loss: str, width: float) -> QuadraticModel:
    """Return the quadratic that a loss looks like at `residual` (n,)."""
    weight, slope = LOSSES[loss](residual / width)
    score = weight * residual
    nothing = np.zeros((matrix.shape[1],) * 2)
    return QuadraticModel(
        _normal(matrix, slope, nothing),
        -(matrix.T @ score),
        float(score @ score) / max(float(slope.sum()), 1e-9 * len(slope)),
    )


def sandwich(matrix: Floats, residual: Floats, function: Weights, width: float, ridge: Floats) -> Floats:
    """Return the covariance of parameters at the optimum, where `residual` (n,) is what is left.

    The penalty counts as what is known beforehand (Wahba 1983; Nychka 1988), so that bands of a penalised curve hold
    its bias too.
    """
    weight, slope = function(residual / width)
    bread = np.linalg.pinv(_normal(matrix, slope, ridge), rcond=1e-12)
    score = weight * residual
    dispersion = float(score @ score) / max(float(slope.sum()), 1e-9 * len(slope))
    meat = _normal(matrix, score**2, np.zeros_like(ridge)) + dispersion * ridge
    return np.asarray(bread @ meat @ bread)
