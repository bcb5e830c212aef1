"""Finds the parameters of a fit: a robust loss or the mixture, delays and curves together or one after the other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.estimation.design import Design
from calib.estimation.gauge import stating
from calib.estimation.intervals import intervals
from calib.estimation.mixture_slopes import Errors
from calib.estimation.pair_mixture import PairMixture, climbed, described, foot_of
from calib.estimation.problem import CELLS, Problem
from calib.estimation.robust import Solution, quadratic_model, robust_fit, scale_of, terms
from calib.estimation.scores import Scores, inverse_of
from calib.estimation.smoothing import reml_penalty, unsure
from calib.estimator.losses import MIXTURE
from calib.estimator.time_blocks import Persistence, lasting_in_pairs
from calib.long_columns import computed
from uwblink.arrays import Floats

LASTING: Final = 1.5
"""Where reflections last so that sums of slopes vary by so many times more, pairs are told apart with less trust."""

PILOT: Final = 6000
"""Rows of the sample on which a start is found; from there, a few Newton steps over all rows suffice."""

ASTRAY_M: Final = 0.3
"""Beyond what any pair's reflections move its median."""

MEDIANS: Final = 100_000
"""Ranges by which medians of pairs are told, if there are so many."""

FIRST_SMOOTHNESS: Final = 1e-6
"""Of the pilot's curve, before the data are asked: a row's share of the penalty's trace."""


@dataclass(frozen=True, slots=True)
class Ended:
    """How a search ended: whether it settled, after how many steps, and on how many independent stretches of time."""

    success: bool
    steps: int
    stretches: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Solved:
    """Parameters (m,) and their covariance (m, m), stated by the gauge, and how it ended.

    `residuals` (n,) are fitted less true ranges, `scale` is that of the loss, in metres. `scores` are the slopes at the
    optimum by what determined the delays, `by_block` (blocks, D) their sums over short blocks of time, with the
    `inverse` (D, D) of information and penalty; `delays` (tags, k)
    turns the parameters behind them into stated delays. `lasting` is how long errors last, `mixture` what they are made
    of, where that was fitted. It is `astray` where it took all ranges of some pair for outliers, as far from a robust
    loss may not end: a likelihood climbs, and where few powers or distances leave the design nearly open it can climb
    to a top where one pair is left out as a whole.
    """

    parameters: Floats
    covariance: Floats
    residuals: Floats
    scale: float
    steps: int
    success: bool
    scores: Scores
    by_block: Floats
    inverse: Floats
    delays: Floats
    lasting: Persistence
    mixture: PairMixture | None = None
    astray: bool = False

    @property
    def ended(self) -> Ended:
        """Return how it ended."""
        return Ended(self.success, self.steps, self.lasting.stretches)


def solve(
    problem: Problem, loss: str, scale_m: float | None, *, sequential: bool, reference: float | None = None
) -> Solved:
    """Return the optimum.

    A sample gives a start: delays alone first, which a curve cannot lead astray, then both. Over all rows the scale of
    the loss, unless given, comes from the residuals of that start, the smoothness of the curves from the data. Delays
    are stated for curves that are zero at the lifted power `reference`.
    """
    # Without a curve, or without a delay, there is nothing to come after the other.
    if sequential and 0 < problem.rank < problem.design.shape[1]:
        return _one_after_the_other(problem, loss, scale_m, reference)
    robust = "cauchy" if loss == MIXTURE else loss
    start, steps = _pilot(problem, robust, scale_m)
    residual = problem.residuals(start)
    far = _farthest_pair(problem, residual)
    width = scale_m or scale_of(residual)
    near = quadratic_model(problem.design, residual, robust, width)
    ridge, start = reml_penalty(near, start, problem.penalties())
    mixture = None
    # Ranges without any error have no distribution to be likely under; the robust loss is exact there.
    if loss == MIXTURE and near.dispersion > 0:
        mixture = _likeliest(problem, start, ridge / near.dispersion)
        parameters, success, steps = mixture.of("design"), mixture.success, steps + mixture.steps
        scores, inverse, prior = mixture.scores, mixture.covariance, mixture.precision
        ridge = ridge / near.dispersion
    else:
        joint = robust_fit(problem.design, problem.error, robust, width, ridge, start, near=True)
        parameters, success, steps = joint.parameters, joint.success, steps + joint.steps
        scores, inverse, prior = _slopes(problem.design, joint, robust, ridge)
    stated = stating(problem, reference)
    delays = problem.directions @ stated[: problem.rank]
    known = intervals(scores, inverse, prior, delays, problem.rank, problem.blocks)
    columns = len(parameters)
    shares = [_of_curve(ridge, curve) for _, curve in problem.curves()]
    covariance = known.covariance + unsure(inverse[:columns, :columns], parameters, shares)
    residual = problem.residuals(parameters)
    return Solved(
        parameters=stated @ parameters,
        covariance=stated @ covariance @ stated.T,
        residuals=residual,
        scale=width,
        steps=steps,
        success=success,
        scores=scores,
        by_block=known.by_block,
        inverse=inverse,
        delays=delays,
        lasting=known.lasting,
        mixture=mixture,
        astray=mixture is not None and _farthest_pair(problem, residual) > ASTRAY_M + 3 * far,
    )


def _likeliest(problem: Problem, start: Floats, ridge: Floats) -> PairMixture:
    """Return the likeliest mixture, where reflections last with less trust in what tells pairs apart."""
    pairs = problem.pairs
    place = computed(len(pairs.number), lambda rows: pairs.number[rows] * CELLS + problem.cell_of(rows), np.int32)
    errors = Errors.of(problem.error, problem.design, place, len(pairs.ends))
    del place
    foot = foot_of(errors, start, ridge)
    top = climbed(foot)
    lasting = lasting_in_pairs(top.slope(errors, "share"), pairs.number, problem.blocks)
    if lasting > LASTING:
        again = climbed(foot, lasting)
        top = replace(again if again.success else top, steps=top.steps + again.steps)
    return described(errors, top)


def _farthest_pair(problem: Problem, residual: Floats) -> float:
    """Return the largest median residual of a pair, in metres either way, of some of its ranges if they are many."""
    kept = np.asarray(problem.design.order)[:: max(len(residual) // MEDIANS, 1)]
    pair = problem.pairs.number[kept]
    # A design keeps the ranges of a pair together.
    parts = np.split(residual[kept], np.flatnonzero(np.diff(pair)) + 1)
    return max(abs(float(np.median(part))) for part in parts)


def _of_curve(prior: Floats, columns: slice) -> Floats:
    """Return what of a prior precision (m, m) is that of a curve."""
    found = np.zeros_like(prior)
    found[columns, columns] = prior[columns, columns]
    return found


def _slopes(design: Design, found: Solution, loss: str, ridge: Floats) -> tuple[Scores, Floats, Floats]:
    """Return the slopes of a robust loss at its optimum, the inverse of its curvature, and its penalty's pull.

    The penalty counts as what is known beforehand (Wahba 1983; Nychka 1988), so that bands of a penalised curve hold
    its bias too.
    """
    residual = design.kept(found.residuals)
    weight, slope = terms(loss, residual, found.scale)
    score = computed(len(residual), lambda rows: -weight[rows] * residual[rows])
    scores = Scores(design=design, score=score, curvature=slope)
    dispersion = float(score @ score) / max(float(slope.sum()), 1e-9 * len(slope))
    return scores, inverse_of(scores.information() + ridge), dispersion * ridge


def _pilot(problem: Problem, loss: str, scale_m: float | None) -> tuple[Floats, int]:
    """Return a start from a sample of rows, and the steps that it took."""
    count = len(problem.error)
    # Any fixed choice will do that no schedule of pairs keeps in step with.
    rows = np.sort(np.random.default_rng(0).permutation(count)[:PILOT])
    # So few rows are quicker written out.
    design, error, some = problem.design.sample(rows).written_out(), problem.error[rows], slice(None, None, 3)
    alone = robust_fit(design[some, : problem.rank], error[some], loss, scale_m)
    start = np.concatenate([alone.parameters, np.zeros(design.shape[1] - problem.rank)])
    joint = robust_fit(design, error, loss, scale_m, _first_ridge(problem, len(rows)), start)
    return joint.parameters, alone.steps + joint.steps


def _first_ridge(problem: Problem, count: int) -> Floats:
    """Return a weak penalty for so many ranges, enough to hold stretches without data."""
    ridge = np.zeros((problem.design.shape[1],) * 2)
    for penalty in problem.penalties():
        ridge += FIRST_SMOOTHNESS * count / float(np.trace(penalty)) * penalty
    curves = np.arange(len(ridge)) >= problem.rank
    return ridge + np.diag(1e-9 * count * curves)


def _one_after_the_other(problem: Problem, loss: str, scale_m: float | None, reference: float | None) -> Solved:
    """Delays first, then the curves on what they leave, as in ICRA 2023, section III and IV, with our splines.

    The curves keep their constants and the delays are those of the first step, unless a `reference` is asked for.
    """
    rank, columns = problem.rank, problem.design.shape[1]
    only = problem.design.part(slice(0, rank))
    alone = robust_fit(only, problem.error, loss, scale_m)
    inside = (problem.lifted >= problem.span[0]) & (problem.lifted <= problem.span[1])
    of_curves = problem.design.part(slice(rank, columns))
    design, left = of_curves.sample(inside), alone.residuals[inside]
    first = robust_fit(design, left, loss, scale_m, _first_ridge(problem, len(inside))[rank:, rank:])
    near = quadratic_model(design, first.residuals, loss, first.scale)
    penalties = [penalty[rank:, rank:] for penalty in problem.penalties()]
    ridge, start = reml_penalty(near, first.parameters, penalties)
    curves = robust_fit(design, left, loss, first.scale, ridge, start, near=True)
    covariance = np.zeros((columns, columns))
    scores, inverse, prior = _slopes(only, alone, loss, np.zeros((rank, rank)))
    known = intervals(scores, inverse, prior, problem.directions, rank, problem.blocks)
    covariance[:rank, :rank] = known.covariance
    slopes = _slopes(design, curves, loss, ridge)
    nothing = np.zeros((0, columns - rank))
    covariance[rank:, rank:] = intervals(*slopes, nothing, 0, problem.blocks.among(inside)).covariance
    stated = stating(problem, reference)
    return Solved(
        parameters=stated @ np.concatenate([alone.parameters, curves.parameters]),
        covariance=stated @ covariance @ stated.T,
        residuals=alone.residuals + of_curves @ curves.parameters,
        scale=alone.scale,
        steps=alone.steps + first.steps + curves.steps,
        success=alone.success and curves.success,
        scores=scores,
        by_block=known.by_block,
        inverse=inverse,
        delays=problem.directions,
        lasting=known.lasting,
    )
