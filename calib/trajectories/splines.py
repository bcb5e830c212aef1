"""Curves over time with control points at equal distances: which of them, and how much of each, at any instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwblink.arrays import Floats, Ints


@dataclass(frozen=True, slots=True)
class Grid:
    """`count` control points, the first at `start_s`, the next every `step_s` seconds."""

    start_s: float
    step_s: float
    count: int

    @property
    def times_s(self) -> Floats:
        """Return when each control point has its greatest weight (count,)."""
        return np.asarray(self.start_s + self.step_s * np.arange(self.count), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Weights:
    """At n instants: the control points that count, (n, k), and how much each does, (n, k)."""

    point: Ints
    share: Floats


def grid_over(begin_s: float, end_s: float, step_s: float, margin: int) -> Grid:
    """Return control points from `margin` steps before the beginning to `margin` steps after the end."""
    pieces = max(int(np.ceil((end_s - begin_s) / step_s)), 1)
    return Grid(begin_s - margin * step_s, step_s, pieces + 1 + 2 * margin)


def cubic(grid: Grid, time_s: Floats) -> Weights:
    """Return the weights of the uniform cubic B-spline (n, 4): twice continuously differentiable."""
    first, x = _piece(grid, time_s, 1, 3)
    share = np.column_stack([(1 - x) ** 3, 3 * x**3 - 6 * x**2 + 4, -3 * x**3 + 3 * x**2 + 3 * x + 1, x**3]) / 6
    return Weights(first[:, None] - 1 + np.arange(4), share)


def cubic_speed(grid: Grid, time_s: Floats) -> Weights:
    """Return the weights (n, 4) with which control points add up to the first derivative of the cubic B-spline."""
    first, x = _piece(grid, time_s, 1, 3)
    share = np.column_stack([-((1 - x) ** 2), 3 * x**2 - 4 * x, -3 * x**2 + 2 * x + 1, x**2]) / (2 * grid.step_s)
    return Weights(first[:, None] - 1 + np.arange(4), share)


def halved(grid: Grid, finer: Grid, points: Floats) -> Floats:
    """Return the points (k, ...) of a grid of half the distance that make the same cubic B-spline as those (n, ...).

    The subdivision of Lane and Riesenfeld (1980): a new point is the mean of two, or one with an eighth of either side.
    """
    whole = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    place = np.rint(2 * (finer.times_s - grid.start_s) / grid.step_s).astype(np.int64)
    near = np.clip(place // 2 + 1, 1, len(whole) - 2)
    onto = (whole[near - 1] + 6 * whole[near] + whole[near + 1]) / 8
    between = (whole[near] + whole[near + 1]) / 2
    odd = (place % 2 == 1).reshape(-1, *([1] * (points.ndim - 1)))
    return np.asarray(np.where(odd, between, onto))


def straight(grid: Grid, time_s: Floats) -> Weights:
    """Return the weights (n, 2) of straight lines between control points."""
    first, x = _piece(grid, time_s, 0, 2)
    return Weights(first[:, None] + np.arange(2), np.column_stack([1 - x, x]))


def _piece(grid: Grid, time_s: Floats, low: int, high: int) -> tuple[Ints, Floats]:
    """Return the piece of each instant and how far into it the instant lies, 0 to 1; the ends' pieces go on."""
    place = (time_s - grid.start_s) / grid.step_s
    first = np.clip(np.floor(place).astype(np.int64), low, grid.count - high)
    return first, place - first
