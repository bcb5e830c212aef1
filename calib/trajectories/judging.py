"""What the ranges say of delays and curve when trajectories are unknown too: intervals, and what stays open."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.calibration.model import Calibration
from calib.estimation.gauge import stating
from calib.estimation.intervals import intervals
from calib.estimation.mixture_start import SPREADS
from calib.estimation.problem import Problem
from calib.estimation.scores import Scores, inverse_of
from calib.estimation.smoothing import unsure
from calib.estimation.solver import Solved
from calib.information import Unknown, Verdict, judge
from calib.spread import TWO_SIDED_95
from calib.trajectories.arrow import Factored, normal_of
from calib.trajectories.climbing import Climbed
from calib.trajectories.coarseness import coarseness
from calib.trajectories.contradictions import contradictions
from calib.trajectories.doubts import Taken, doubted
from calib.trajectories.scene import Scene
from calib.trajectories.taken_curve import unsure_of_curve
from uwblink.arrays import Floats

PRIOR_NS: Final = 2.0
"""Delays of boards of one kind differ by less: what a direction is known by where nothing else says anything."""

GUESS_NS: Final = 0.2
LOOSEST: Final = 0.5
"""A direction of delays counts as determined if it is known to half of so much (3 cm of range), by standard error.

Calibrated by simulation (docs/theory.md): intervals beyond were seen not to hold.
"""

GROWTH: Final = 3.0
"""Few ranges leave delays less known than that even where distances are given; then so many times as much will do."""

ALONE: Final = 3.0
"""By geometry alone a fit is linear no further: errors of up to 4.2 of its standard errors were seen, which are so many
times as large there as linear propagation has them (docs/theory.md)."""

LOOKED_AT: Final = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """A solution as a fit with known distances would have it, and the verdict on the delays of `problem.tags`.

    `absorbed` says for the least known direction of delays how many times its variance grew because distances are not
    known; `distance_std_m` (k,) are standard errors of some distances, `covariance_ns2` (tags, tags) is that of the
    delays, with what does not fit, and `doubts` are sentences of that.
    """

    solved: Solved
    verdict: Verdict | None
    absorbed: float
    distance_std_m: Floats
    covariance_ns2: Floats
    doubts: list[str]

    @property
    def free_tags(self) -> list[int]:
        """Return the tags whose delays are not determined."""
        return [] if self.verdict is None else [int(tag) for tag in self.verdict.named("delay")]

    def open_ends(self) -> list[str]:
        """Return as a sentence what is not determined; none where everything is."""
        free, verdict = self.free_tags, self.verdict
        if verdict is None or not free:
            return []
        tags = [int(unknown.of) for unknown in verdict.unknowns]
        if len(free) < len(tags):
            return [f"the ranges do not determine the delays of tags {', '.join(map(str, free))}{self._known_to(free)}"]
        count = len(tags)
        common = np.full((1, count), 1 / count)
        apart = np.eye(count)[1:] - np.eye(count)[0]
        spread, differences = (
            TWO_SIDED_95 * float(np.sqrt(np.max(np.diag(rows @ self.covariance_ns2 @ rows.T))))
            for rows in (common, apart)
        )
        return [
            f"the ranges determine no delay: what all have in common is known to ± {spread:.2f} ns (95 %), and "
            f"differences to ± {differences:.2f} ns"
        ]

    def _known_to(self, free: list[int]) -> str:
        verdict = self.verdict
        tags = [] if verdict is None else [int(unknown.of) for unknown in verdict.unknowns]
        std = [math.sqrt(self.covariance_ns2[tags.index(tag), tags.index(tag)]) for tag in free]
        return f": known to ± {TWO_SIDED_95 * max(std):.2f} ns (95 %) at worst"


def judged(climbed: Climbed, problem: Problem, reference: float | None, curve: Calibration | None = None) -> Judged:
    """Return intervals and verdict of a solution whose delays are stated at the lifted power `reference`.

    `problem` has the distances that were found; `curve` is the calibration whose curve was taken.
    """
    reduced = _reduced(climbed)
    solved, precision = _solved(climbed, problem, reduced, reference)
    spread = _spread(climbed, reduced.taken)
    doubts = doubted(problem, solved, reduced.taken)
    sentences = [*_of_motion(climbed, reduced), *doubts.sentences]
    if not problem.rank:
        return Judged(
            solved=solved,
            verdict=None,
            absorbed=1.0,
            distance_std_m=spread,
            covariance_ns2=np.zeros((0, 0)),
            doubts=sentences,
        )
    columns, delays, covariance = climbed.columns.design, solved.delays, doubts.covariance_ns2
    if curve is not None:
        covariance = covariance + unsure_of_curve(problem, curve, solved, climbed.informed)
    covariance = beyond_linear(covariance, climbed.scene)
    # What places add is no matter of what ranges determine: with motion capture it is as large.
    of_ranges = covariance - beyond_linear(doubts.of_places_ns2, climbed.scene)
    ridge = climbed.ridge[:columns, :columns]
    with_truth = delays @ np.linalg.pinv(_information(climbed.rows.design, climbed.informed) + ridge) @ delays.T
    plain = np.linalg.pinv(_information(reduced.design, climbed.informed) + precision[:columns, :columns])
    return Judged(
        solved=solved,
        verdict=verdict_on(of_ranges, with_truth, problem),
        absorbed=_absorbed(delays @ plain @ delays.T, with_truth),
        distance_std_m=spread,
        covariance_ns2=covariance,
        doubts=sentences,
    )


def _of_motion(climbed: Climbed, reduced: _Reduced) -> Iterator[str]:
    """Yield what contradicts the trajectories."""
    scene, columns, state = climbed.scene, climbed.columns, climbed.state
    left = coarseness(scene, columns, climbed.rows, state, climbed.loss, climbed.informed)
    yield from left.told(columns.places.step_s)
    yield from contradictions(climbed.known, scene.tapes, state, reduced.taken.whole, reduced.schur)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Reduced:
    """What is left of derivatives by delays and curve when trajectories, standing bodies and biases took what they can.

    `design` (n, m) are those of the ranges, `held` (k, m) those of what is known beside them, `schur` (b, b) what is
    known of the border.
    """

    taken: Taken
    schur: Floats
    design: Floats
    held: Floats


def _reduced(climbed: Climbed) -> _Reduced:
    _, local, border = climbed.rows.linear(climbed.state)
    known = climbed.known.linear(climbed.state)
    whole = Factored(normal_of(local, border, climbed.informed) + known.normal)
    columns, size = climbed.columns.design, climbed.columns.border
    schur = whole.schur + climbed.ridge
    turn = np.zeros((size, columns))
    turn[:columns] = np.eye(columns)
    if size > columns:
        turn[columns:] = -np.linalg.lstsq(schur[columns:, columns:], schur[columns:, :columns], rcond=1e-13)[0]
    left, held = border - local @ whole.reach, known.border - known.local @ whole.reach
    taken = Taken(
        local=local,
        whole=whole,
        rest=left[:, columns:],
        schur=schur[columns:, columns:],
        held=known.local,
        held_design=held @ turn,
        informed=climbed.informed,
    )
    return _Reduced(taken=taken, schur=schur, design=left @ turn, held=held @ turn)


def _solved(climbed: Climbed, problem: Problem, reduced: _Reduced, reference: float | None) -> tuple[Solved, Floats]:
    """Return the solution as a fit with known distances would have it, and the whole prior."""
    columns = climbed.columns.design
    ridge, found = climbed.ridge[:columns, :columns], climbed.state.border[:columns]
    slope, _ = climbed.loss.slopes(climbed.rows.residuals(climbed.state))
    prior = ridge + reduced.held.T @ reduced.held
    scores, inverse, precision = _slopes(climbed, problem, reduced.design, -slope, prior)
    stated = stating(problem, reference)
    delays = problem.directions @ stated[: problem.rank]
    of_blocks = intervals(scores, inverse, precision, delays, problem.rank, problem.blocks)
    shares = [_of_curve(ridge, curve) for _, curve in problem.curves()]
    # Residuals are smaller by what trajectories have taken of them (as HC3 has it; MacKinnon and White 1985).
    covariance = of_blocks.covariance / (1 - climbed.used) ** 2 + unsure(inverse[:columns, :columns], found, shares)
    solved = Solved(
        parameters=stated @ found,
        covariance=stated @ covariance @ stated.T,
        residuals=climbed.rows.residuals(climbed.state) / np.sqrt(1 - climbed.used),
        scale=float(np.sqrt(1 / np.median(climbed.informed))),
        steps=climbed.steps,
        success=climbed.settled,
        scores=scores,
        by_block=of_blocks.by_block,
        inverse=inverse,
        delays=delays,
        lasting=of_blocks.lasting,
        mixture=climbed.mixture,
    )
    return solved, precision


def _slopes(
    climbed: Climbed, problem: Problem, design: Floats, score: Floats, prior: Floats
) -> tuple[Scores, Floats, Floats]:
    """Return the slopes of all ranges, the inverse of what they and a prior (m, m) say, and the whole prior."""
    if climbed.mixture is None:
        kept = problem.design.kept
        scores = Scores(design=problem.design.like(design), score=kept(score), curvature=kept(climbed.informed))
        return scores, inverse_of(scores.information() + prior), prior
    known = climbed.mixture.scores
    scores = replace(known, design=known.design.like(design), score=known.design.kept(score))
    precision = climbed.mixture.precision.copy()
    precision[: len(prior), : len(prior)] = prior
    return scores, inverse_of(scores.information() + precision, len(problem.pairs.ends), len(SPREADS)), precision


def beyond_linear(covariance: Floats, scene: Scene) -> Floats:
    """Return a covariance of delays (tags, tags), wider where geometry alone tells them."""
    return covariance * ALONE**2 if scene.by_geometry_alone else covariance


def verdict_on(covariance: Floats, with_truth: Floats, problem: Problem) -> Verdict:
    """Return what delays of a covariance (tags, tags) are determined, beside that of a fit with known distances."""
    guess = np.maximum(GUESS_NS, GROWTH / LOOSEST * np.sqrt(np.maximum(np.diag(with_truth), 0.0)))
    information = np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) + np.eye(len(covariance)) / PRIOR_NS**2
    information = (information + information.T) / 2
    unknowns = [Unknown("delay", str(tag), scale) for tag, scale in zip(problem.tags, guess.tolist(), strict=True)]
    return judge(information, unknowns, loosest=LOOSEST)


def _information(design: Floats, informed: Floats) -> Floats:
    return np.asarray((design * informed[:, None]).T @ design)


def _absorbed(covariance: Floats, with_truth: Floats) -> float:
    """Return the largest ratio of two covariances over all directions."""
    values, vectors = np.linalg.eigh(with_truth)
    kept = values > 1e-9 * values[-1]
    root = vectors[:, kept] / np.sqrt(values[kept])
    return float(np.linalg.eigvalsh(root.T @ covariance @ root)[-1])


def _spread(climbed: Climbed, taken: Taken) -> Floats:
    """Return the standard errors of some distances, given delays and curve."""
    rows, count = taken.local, taken.local.shape[0]
    some = np.unique(np.linspace(0, count - 1, LOOKED_AT).astype(np.int64))
    few = np.asarray(rows[some].todense())
    variance = np.einsum("kl,lk->k", few, taken.whole.inverse_on(np.ascontiguousarray(few.T)))
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _of_curve(prior: Floats, columns: slice) -> Floats:
    found = np.zeros_like(prior)
    found[columns, columns] = prior[columns, columns]
    return found
