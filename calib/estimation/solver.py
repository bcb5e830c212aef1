"""Finds the parameters of a fit: a robust loss or the mixture, delays and curves together or one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.estimation.losses import MIXTURE
from calib.estimation.mixture_fit import refine
from calib.estimation.problem import Problem
from calib.estimation.robust import quadratic_model, robust_fit, scale_of
from calib.estimation.smoothing import reml_penalty
from uwblink.arrays import Floats

PILOT: Final = 6000
"""Rows of the sample on which a start is found; from there, a few Newton steps over all rows suffice."""

FIRST_SMOOTHNESS: Final = 1e-6
"""Of the pilot's curve, before the data are asked: a row's share of the penalty's trace."""


@dataclass(frozen=True, slots=True)
class Solved:
    """Parameters (m,) and their covariance (m, m), the scale of the loss in metres, and how it ended."""

    parameters: Floats
    covariance: Floats
    scale: float
    steps: int
    success: bool


def solve(problem: Problem, loss: str, scale_m: float | None, *, sequential: bool) -> Solved:
    """Return the optimum.

    A sample gives a start: delays alone first, which a curve cannot lead astray, then both. Over all rows the scale of
    the loss, unless given, comes from the residuals of that start, the smoothness of the curves from the data.
    """
    robust = "cauchy" if loss == MIXTURE else loss
    if sequential:
        return _one_after_the_other(problem, robust, scale_m)
    start, steps = _pilot(problem, robust, scale_m)
    residual = problem.error + problem.design @ start
    width = scale_m or scale_of(residual)
    near = quadratic_model(problem.design, residual, robust, width)
    ridge, start = reml_penalty(near, start, problem.penalties())
    joint = robust_fit(problem.design, problem.error, robust, width, ridge, start, problem.blocks, near=True)
    steps += joint.steps
    if loss != MIXTURE:
        return Solved(joint.parameters, joint.covariance, joint.scale, steps, joint.success)
    likely = refine(
        problem.design,
        problem.error,
        joint.parameters,
        ridge / near.dispersion,
        problem.bins.number,
        problem.blocks,
    )
    return Solved(likely.parameters, likely.covariance, joint.scale, steps + likely.steps, likely.success)


def _pilot(problem: Problem, loss: str, scale_m: float | None) -> tuple[Floats, int]:
    """Return a start from a sample of rows, and the steps that it took."""
    count = len(problem.error)
    # Any fixed choice will do that no schedule of pairs keeps in step with.
    rows = np.sort(np.random.default_rng(0).permutation(count)[:PILOT])
    small = problem if len(rows) == count else problem.sample(rows)
    some = slice(None, None, 3)
    alone = robust_fit(small.design[some, : problem.rank], small.error[some], loss, scale_m)
    start = np.concatenate([alone.parameters, np.zeros(problem.design.shape[1] - problem.rank)])
    joint = robust_fit(small.design, small.error, loss, scale_m, _first_ridge(small), start)
    return joint.parameters, alone.steps + joint.steps


def _first_ridge(problem: Problem) -> Floats:
    """Return a weak penalty, enough to hold stretches without data."""
    count = len(problem.error)
    ridge = np.zeros((problem.design.shape[1],) * 2)
    for penalty in problem.penalties():
        ridge += FIRST_SMOOTHNESS * count / float(np.trace(penalty)) * penalty
    curves = np.arange(len(ridge)) >= problem.rank
    return ridge + np.diag(1e-9 * count * curves)


def _one_after_the_other(problem: Problem, loss: str, scale_m: float | None) -> Solved:
    """Delays first, then the curves on what they leave, as in ICRA 2023, section V, with our splines."""
    rank, columns = problem.rank, problem.design.shape[1]
    alone = robust_fit(problem.design[:, :rank], problem.error, loss, scale_m, blocks=problem.blocks)
    # The curves' splines are less their average; a column of ones lets the curve have a constant while it is fitted.
    design = np.hstack([np.ones((len(problem.error), 1)), problem.design[:, rank:]])
    penalties = [np.pad(p[rank:, rank:], ((1, 0), (1, 0))) for p in problem.penalties()]
    rough = np.pad(_first_ridge(problem)[rank:, rank:], ((1, 0), (1, 0)))
    first = robust_fit(design, alone.residuals, loss, scale_m, rough)
    near = quadratic_model(design, first.residuals, loss, first.scale)
    ridge, start = reml_penalty(near, first.parameters, penalties)
    curves = robust_fit(design, alone.residuals, loss, first.scale, ridge, start, problem.blocks, near=True)
    covariance = np.zeros((columns, columns))
    covariance[:rank, :rank] = alone.covariance
    covariance[rank:, rank:] = curves.covariance[1:, 1:]
    parameters = np.concatenate([alone.parameters, curves.parameters[1:]])
    steps = alone.steps + first.steps + curves.steps
    return Solved(parameters, covariance, alone.scale, steps, alone.success and curves.success)
