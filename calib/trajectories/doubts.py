"""What a fit from ranges has to say against itself: residuals that trajectories, delays and curve do not explain.

The alternatives are those of a fit with known distances (`calib.estimation.misfit`): an offset of a pair, of a tag for
a while or as its power changes, and those of arithmetic. What trajectories, standing bodies and biases take of an
offset is taken off its slopes first, with the same arrow that the fit was solved by.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from calib.estimation.alternatives import Family, families
from calib.estimation.doubts import Doubts, of_a_decibel, reflected, short, weighed
from calib.estimation.misfit import (
    Judgement,
    Tested,
    findings,
    spans_of,
    widening_of_pairs,
)
from calib.estimation.places import of_places
from calib.estimation.problem import Problem
from calib.estimation.scores import Scores
from calib.estimation.solver import Solved
from calib.estimator.time_blocks import TimeBlocks, persistence
from calib.trajectories.arrow import Factored
from uwblink.arrays import Floats, Ints

if TYPE_CHECKING:
    from scipy.sparse import csr_array

REACHED: Final = 1e-3
"""Share of an alternative's information that must be left beside what was fitted for it to be tested."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Taken:
    """What trajectories take of a range's derivatives: derivatives by the band (n, L) and the arrow they are solved by.

    `rest` (n, r) are derivatives by standing bodies and biases when trajectories have taken what they can, `schur`
    (r, r) what is known of them; `held` are those of what is known beside ranges, by the band, and `held_design` by the
    parameters of the design when trajectories have taken what they can.
    """

    local: csr_array[Any]
    whole: Factored
    rest: Floats
    schur: Floats
    held: csr_array[Any]
    held_design: Floats
    informed: Floats

    def left(self, offsets: Floats) -> tuple[Floats, Floats]:
        """Return what is left of offsets (n, k), and how they pull at what is known beside ranges (l, k)."""
        weighed = offsets * self.informed[:, None]
        reach = self.whole.inverse_on(np.ascontiguousarray(self.local.T @ weighed))
        found = offsets - self.local @ reach
        pulls = self.held @ reach
        if self.rest.shape[1]:
            found = found - self.rest @ np.linalg.lstsq(self.schur, self.rest.T @ weighed, rcond=1e-13)[0]
        return np.asarray(found), np.asarray(pulls)


def doubted(problem: Problem, found: Solved, taken: Taken) -> Doubts:
    """Hold a solution against its residuals, and widen the delays' covariance by what does not fit.

    `problem` has the distances that were found.
    """
    number = found.scores.design.kept(problem.blocks.number)
    alternatives = list(families(problem, of_a_decibel(problem, found)))
    tested = [_test(family, found, taken, number, problem.blocks) for family in alternatives]
    by_pair = next(family for family in alternatives if family.kind == "pair")
    several = sum(len(one.names) for one in tested)
    judged = Judgement(
        findings=sorted(
            (one for each in tested for one in findings(each, several)), key=lambda finding: -abs(finding.deviation)
        ),
        widening_ns2=np.asarray(sum(widening_of_pairs(each) for each in tested if each.kind == "pair")),
        pairs=_test(by_pair, found, taken, number, problem.blocks, pulling=True),
    )
    places = of_places(problem, found.scores, judged.pairs, number)
    covariance, sentences = weighed(problem, found, judged, places)
    return Doubts(
        covariance_ns2=covariance,
        sentences=[*sentences, *reflected(problem, found), *short(found)],
        of_places_ns2=places.widening_ns2,
    )


def _offsets(family: Family, kept_rows: int) -> Floats:
    """Return a family's offsets as columns over kept rows (n, k)."""
    found = np.zeros((kept_rows, len(family.names)))
    rows = np.arange(kept_rows)
    weights = family.weight if isinstance(family.weight, tuple) else (family.weight,) * len(family.ends)
    for (place, sign), weight in zip(family.ends, weights, strict=True):
        found[rows, family.runs.rows(place)] += sign * weight
    return found


def _test(
    family: Family, found: Solved, taken: Taken, number: Ints, blocks: TimeBlocks, *, pulling: bool = False
) -> Tested:
    """Return a family's efficient slopes, beside trajectories and all that was fitted.

    With `pulling`, it is reckoned with that a delay whose offsets trajectories follow pulls at known places just as
    such an offset does: what delays can take up is then left out to the last, as offsets that last ask for.
    """
    scores, design = found.scores, found.scores.design
    offsets = design.given(_offsets(family, len(design)))
    left, pulls = taken.left(offsets)
    score, mine = scores.score, design.kept(left)
    information = (offsets * taken.informed[:, None]).T @ left
    link = _linked(scores, mine)
    if pulling:
        link[:, : taken.held_design.shape[1]] -= pulls.T @ taken.held_design
    reach = link @ found.inverse
    count = len(found.by_block)
    plain = np.column_stack([np.bincount(number, score * column, minlength=count) for column in mine.T])
    efficient = plain - found.by_block @ reach.T
    information = information - reach @ link.T
    # At the optimum all that was fitted has no slope left, what is known beside ranges included.
    known = 0.0 if pulling else found.by_block.sum(axis=0) @ reach.T
    whole = max(float(np.diag((offsets * taken.informed[:, None]).T @ offsets).max()), 1e-300)
    free = max(int(np.linalg.matrix_rank(information, tol=REACHED * whole, hermitian=True)), 1)
    lasting = persistence(efficient, blocks, free, spans_of(family, blocks))
    return Tested(
        kind=family.kind,
        names=family.names,
        total=score @ design.kept(offsets) - known,
        covariance=lasting.factor * (efficient.T @ efficient) + pulls.T @ pulls,
        by_time=efficient.sum(axis=0),
        information=information,
        whole=whole,
        effects=-found.delays @ reach[:, : found.delays.shape[1]].T,
        lasting=lasting,
        blocks=count,
    )


def _linked(scores: Scores, offsets: Floats) -> Floats:
    """Return what links offsets (n, k) of kept rows to the fitted parameters (k, D)."""
    runs = scores.design.runs()
    one = [(np.zeros_like(runs.block), 1.0)]
    return np.vstack([scores.linked(column, runs, one, 1) for column in offsets.T])
