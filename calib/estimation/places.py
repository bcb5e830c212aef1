"""Errors that belong to places: what ranges between the same two bodies have in common, whichever of their tags range.

A wall, a partition or a thing nearby lengthens all ranges between two bodies together, for as long as they are where
they are. Part of it comes and goes as bodies move, and shows as residuals of different pairs of tags that go together.
Part of it stays for the whole flight, and delays take up what they can of that. What they cannot shows where there are
more pairs of bodies than bodies; where there are not, what stays is taken to be about as large as what comes and goes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import ndtr

from calib.estimation.misfit import Tested
from calib.estimation.problem import Problem
from calib.estimation.scores import Scores
from calib.long_columns import let_go, spans
from calib.spread import TWO_SIDED_95
from uwblink.arrays import Floats, Ints

TOGETHER_S: Final = 1.0
"""Bodies are in the same places for about so long."""

ASKED: Final = 2.3
SURELY: Final = 3.1
"""Deviations that no more than 1 % and 0.1 % of sound flights show: the first widens intervals, the second is said."""

MATTERS: Final = 1.0
"""It matters where it adds so many of its printed standard errors to some delay."""

ALIKE: Final = 0.8
"""What stays is as large as what comes and goes, to so many logarithms (a factor of 2.2): a judgement.

In rooms of the simulator it was 1.2 to 4 times as large, in smooth fields of errors a sixth to two thirds.
"""

WALLS_M: Final = 0.02
"""What stays, to a factor of e, where nothing comes and goes: a partition or two that are always in between."""

LEFT: Final = 0.03
"""Share of an offset's information that delays and trajectories must leave: of less, slopes say nothing of its size."""

LARGEST_M: Final = 0.1
"""An offset of more is a detour, which has its place among reflections."""

SIZES_M: Final = np.geomspace(3e-4, 2 * LARGEST_M, 60)
"""Standard deviations of offsets that are thought of."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OfPlaces:
    """What places do: covariance (tags, tags) that they add to that of the delays, and whether it is certain.

    `size_m` is the standard deviation of offsets of two bodies for the whole flight as it is taken into intervals.
    """

    widening_ns2: Floats
    size_m: float = 0.0
    certain: bool = False

    def told(self, before_ns2: Floats) -> list[str]:
        """Return it as a sentence, where it is certain and matters beside a covariance (tags, tags) without it."""
        # What all delays have in common hangs on the curve as well, and is less known by far.
        apart = np.eye(len(before_ns2)) - 1 / max(len(before_ns2), 1)
        own, more = (np.diag(apart @ one @ apart) for one in (before_ns2, self.widening_ns2))
        if not self.certain or not np.any(more > MATTERS**2 * np.maximum(own, 1e-30)):
            return []
        return [
            "errors belong to places or directions: ranges between the same two bodies are wrong together, as walls "
            "and things near them make it, or a wrong lever arm, or an antenna whose delay depends on the direction, "
            f"which may move differences of delays by {1e3 * np.sqrt(more.max()):.0f} ps; intervals are widened for "
            "it; check the lever arms, then record elsewhere too, or farther from walls: what all ranges are too long "
            "by in common no range shows"
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lasting:
    """What delays leave of offsets of two bodies that last: values (k,) of unit variance, were there no offset.

    `reach` (k,) is by how much the variance of each grows with that of offsets, in 1/m^2.
    """

    values: Floats
    reach: Floats

    def beyond(self, deviation: float) -> bool:
        """Return whether the values are larger than chance makes them, by the measure of a normal deviation."""
        return float(self.values @ self.values) > _of_chi_square(len(self.values), deviation)

    def log_likelihood(self, sizes_m: Floats) -> Floats:
        """Return how likely offsets of standard deviations (n,) make the values (restricted maximum likelihood)."""
        variance = 1 + self.reach[:, None] * sizes_m**2
        return np.asarray(-0.5 * np.sum(np.log(variance) + self.values[:, None] ** 2 / variance, axis=0))


def of_places(problem: Problem, scores: Scores, pairs: Tested | None, blocks: Ints) -> OfPlaces:
    """Return what errors that tags of a body share do to delays.

    `pairs` are the efficient slopes of offsets by pair; `blocks` (n,) number short blocks of time, in the order in
    which the design keeps rows. Nothing is found where no body is known to carry two tags.
    """
    group = pairs_of_bodies(problem)
    nothing = OfPlaces(widening_ns2=np.zeros((len(problem.tags),) * 2))
    if pairs is None or group is None:
        return nothing
    sums = np.eye(int(group.max()) + 1)[:, group]
    lasting = _lasting(pairs, sums, problem.blocks.count)
    variance, deviation = _moving(problem, scores, sums, blocks)
    moves = deviation > ASKED
    if not moves and not lasting.beyond(ASKED):
        return nothing
    likely = lasting.log_likelihood(SIZES_M)
    middle, spread = (np.sqrt(variance), ALIKE) if moves else (WALLS_M, 1.0)
    likely -= 0.5 * (np.log(SIZES_M / middle) / spread) ** 2
    size, effects = _as_one(likely), pairs.effects @ sums.T
    return OfPlaces(
        widening_ns2=size**2 * effects @ effects.T,
        size_m=size,
        certain=deviation > SURELY or lasting.beyond(SURELY),
    )


def _as_one(likely: Floats) -> float:
    """Return the standard deviation whose 95 % interval is that of all sizes together, by their log likelihoods."""
    weight = np.exp(likely - likely.max())
    within = 2 * ndtr(TWO_SIDED_95 * SIZES_M[:, None] / SIZES_M) - 1
    return float(np.interp(0.95, within @ (weight / weight.sum()), SIZES_M))


def pairs_of_bodies(problem: Problem) -> Ints | None:
    """Return the number of the two bodies of each pair (pairs,); None where no two pairs are of the same ones."""
    carried = dict(problem.ranges.bodies)
    if problem.unknowns.of_pairs or not carried:
        return None
    names: dict[frozenset[str], int] = {}
    ends = [frozenset(carried.get(tag, f"tag {tag}") for tag in both) for both in problem.pairs.ends.tolist()]
    group = np.array([names.setdefault(both, len(names)) for both in ends])
    return group if len(names) < len(ends) else None


def _lasting(pairs: Tested, sums: Floats, blocks: int) -> _Lasting:
    """Return what is left of offsets that all pairs of a group have; `sums` (groups, pairs) says whose pairs are."""
    total, information = sums @ pairs.total, sums @ pairs.information @ sums.T
    # An offset that lasts is in every block: it is no scatter between them.
    scatter = pairs.covariance - pairs.lasting.factor * np.outer(pairs.by_time, pairs.by_time) / blocks
    values, vectors = np.linalg.eigh(information)
    base = vectors[:, values > LEFT * pairs.whole]
    variances, turned = np.linalg.eigh(base.T @ sums @ scatter @ sums.T @ base)
    sure = variances > 1e-9 * variances.max(initial=0.0)
    root = base @ turned[:, sure] / np.sqrt(variances[sure])
    through = root.T @ information
    reach, turned = np.linalg.eigh(through @ through.T)
    reach = np.maximum(reach, 0.0)
    largest = np.sqrt(1 + reach * LARGEST_M**2)
    return _Lasting(values=np.clip(turned.T @ root.T @ total, -largest, largest), reach=reach)


def _of_chi_square(freedom: int, deviation: float) -> float:
    """Return the value of chi-square as unlikely as a normal deviation (Wilson and Hilferty 1931)."""
    part = 2 / (9 * max(freedom, 1))
    return float(freedom * (1 - part + deviation * np.sqrt(part)) ** 3)


def _moving(problem: Problem, scores: Scores, sums: Floats, blocks: Ints) -> tuple[float, float]:
    """Return the variance of errors that pairs of a group share while they last, and its deviation from none.

    Of the slopes that different pairs of a group have in the same second, products are summed: noise, and reflections
    that belong to a pair, leave nothing of them on average.
    """
    slope, known = _by_time(problem, scores, blocks)
    # Of a robust loss, a pair of which most ranges lie far out may know less than nothing.
    whole = known.sum(axis=0)
    some = whole > LEFT * whole.max()
    slope, known, sums = slope[:, some], known[:, some], sums[:, some]
    slope = slope - known * (slope.sum(axis=0) / whole[some])
    product, expected = (((of @ sums.T) ** 2 - of**2 @ sums.T) / 2 for of in (slope, known))
    spread, reach = float(np.sqrt(np.sum(product**2))), float(expected.sum())
    if not spread > 0 or not reach > 0:
        return 0.0, 0.0
    return float(product.sum()) / reach, float(product.sum()) / spread


def _by_time(problem: Problem, scores: Scores, blocks: Ints) -> tuple[Floats, Floats]:
    """Return slopes and information of offsets of pairs, summed over about a second each (seconds, pairs)."""
    time, size = problem.blocks, len(problem.pairs.ends)
    each = max(round(TOGETHER_S * time.count / max(time.seconds, 1e-9)), 1)
    count, pair = (time.count - 1) // each + 1, scores.design.kept(problem.pairs.number)
    found = np.zeros((2, count * size))
    for rows in spans(len(pair)):
        where = blocks[rows] // each * size + pair[rows]
        found[0] += np.bincount(where, scores.score[rows], minlength=count * size)
        found[1] += np.bincount(where, scores.known(rows), minlength=count * size)
        let_go(blocks, pair, scores.score)
    return found[0].reshape(count, size), found[1].reshape(count, size)
