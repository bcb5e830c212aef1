"""Levenberg and Marquardt's method on the likelihood of ranges and of all that is known beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.trajectories.arrow import Factored, Normal, normal_of
from calib.trajectories.known_rows import KnownRows
from calib.trajectories.range_losses import RangeLoss
from calib.trajectories.range_rows import RangeRows
from calib.trajectories.unknowns import State
from uwblink.arrays import Floats

FIRST_DAMPING: Final = 1e-5
LEAST_DAMPING: Final = 1e-9
MOST_DAMPING: Final = 1e8
SETTLED: Final = 0.02
"""A step that makes the data likelier by less, in logarithms, ends the search."""

MAX_STEPS: Final = 60


@dataclass(frozen=True, slots=True)
class Optimum:
    """Where a search ended: the unknowns, residuals of the ranges (n,), what was minimised, and how it came there."""

    state: State
    residuals: Floats
    cost: float
    steps: int
    settled: bool


def minimise(
    ranges: RangeRows,
    known: KnownRows,
    start: State,
    loss: RangeLoss,
    ridge: Floats | None = None,
    *,
    most_steps: int = MAX_STEPS,
    settled: float = SETTLED,
    each_step: Callable[[], None] | None = None,
) -> Optimum:
    """Minimise the loss of the ranges and half the squares of what is known over its standard errors.

    `ridge` (b, b) is the curvature of a penalty on the border.
    """
    penalty = np.zeros((len(start.border),) * 2) if ridge is None else ridge
    state, damping, steps, gained = start, FIRST_DAMPING, 0, np.inf
    cost = _cost(ranges.residuals(state), known, state, loss, penalty)
    while steps < most_steps and gained > settled and damping < MOST_DAMPING:
        residual, local, border = ranges.linear(state)
        slope, curvature = loss.slopes(residual)
        held = known.linear(state)
        normal = normal_of(local, border, curvature) + held.normal + _of_border(penalty, known)
        pull_local = -(local.T @ slope + held.local.T @ held.residual)
        pull_border = -(border.T @ slope + held.border.T @ held.residual + penalty @ state.border)
        gained = 0.0
        while damping < MOST_DAMPING and steps < most_steps:
            trial = state.moved(*Factored(normal, damping).solve(pull_local, pull_border))
            tried = _cost(ranges.residuals(trial), known, trial, loss, penalty)
            steps += 1
            if each_step is not None:
                each_step()
            if tried <= cost + 1e-9 * abs(cost):
                gained = cost - tried
                state, cost, damping = trial, tried, max(damping / 10, LEAST_DAMPING)
                break
            damping *= 10
    return Optimum(state, ranges.residuals(state), cost, steps, gained <= settled)


def _cost(residual: Floats, known: KnownRows, state: State, loss: RangeLoss, penalty: Floats) -> float:
    rest = known.residuals(state)
    return loss.cost(residual) + 0.5 * float(rest @ rest) + 0.5 * float(state.border @ penalty @ state.border)


def _of_border(penalty: Floats, known: KnownRows) -> Normal:
    return Normal(known.normal.band * 0.0, np.zeros_like(known.normal.across), penalty)
