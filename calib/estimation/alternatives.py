"""What a fit is held against: offsets that some ranges would have beside what was fitted, by kind."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.estimation.problem import Problem
from calib.estimation.row_order import Runs
from calib.long_columns import computed, let_go
from uwblink.arrays import Floats, Ints

SEGMENTS: Final = 6
"""Spans of time of equal counts, at most, in which a tag may have an offset of its own."""

GAP_S: Final = 1.0
"""Two ranges of a pair further apart say nothing of a speed: bodies turn round within seconds."""

SMALLEST_LIFTED: Final = 1e-4
SHORTEST_M: Final = 0.1
"""Least lifted power (-122 dBm) and distance that a logarithm is taken of."""

SPAN_S: Final = 20.0
"""Spans are no shorter, so that errors that last are known within them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """Alternatives of one kind: offsets times `weight` (n,), or 1; `names` (k,) say whose they are.

    Of several weights each is that of one of the `ends`.

    Whose a range is goes by its run: each of `ends` has a place among the names of every run (runs,), and a sign. A
    range belongs to both of its tags; in a family of differences the offset is taken the other way at one.
    Where offsets belong to sessions, those of one tag or pair in all `sessions` stand side by side.
    """

    kind: str
    names: list[str]
    weight: Floats | float | tuple[Floats, ...]
    runs: Runs
    ends: tuple[tuple[Ints, float], ...]
    sessions: tuple[str, ...] = ("",)


def families(problem: Problem, louder_m: Floats, *, beside_curve: bool = True) -> Iterator[Family]:
    """Yield the alternatives: offsets of a pair, of a tag for a while, of either in one of several sessions, of a tag
    as its power changes, and those of arithmetic.

    Rows are in the order in which the problem's design keeps them; `louder_m` (n,), in the order of given ones, is what
    a decibel more would do to each range. Where no curve is fitted, errors of all tags may
    change with power alike, which is no tag's fault. Then one of the opposite sign with the other tag initiating, as a
    clock leaves it whose skew is not corrected, and what all ranges share (`_shared`). A fit whose curve comes after
    its delays is not `beside_curve`: the curve is in its errors, and follows distance as power does.
    """
    kept, bins = problem.design.kept, problem.bins
    tags, truth_m = problem.ranges.tags(), problem.ranges.truth_m
    runs = problem.design.runs()
    pair = problem.design.first_of(kept(problem.pairs.number))
    low, high = np.searchsorted(tags, problem.pairs.ends[pair]).T
    both = (low, 1.0), (high, 1.0)
    names = [f"tag {tag}" for tag in tags]
    named = [f"pair {low}-{high}" for low, high in problem.pairs.ends.tolist()]
    yield Family(kind="pair", names=named, weight=1.0, runs=runs, ends=((pair, 1.0),))
    count = segments(problem.blocks.seconds)
    edges = -(-np.arange(count + 1) * len(truth_m) // count)
    when = kept(np.repeat(np.arange(count, dtype=np.int32), np.diff(edges)))
    spans = problem.design.runs(when)
    own = when[spans.starts[:-1]]
    yield Family(
        kind="time",
        names=[name for name in names for _ in range(count)],
        weight=1.0,
        runs=spans,
        ends=tuple((place[spans.block] * count + own, 1.0) for place in (low, high)),
    )
    if len(problem.blocks.bounds) > 2:
        yield _between_sessions(problem, names, named, (low, high, pair))
    if problem.unknowns.curve:
        ranks, number = np.linspace(-1, 1, len(bins.count)), kept(bins.number)
        rank = computed(len(number), lambda rows: ranks[number[rows]])
        let_go(number)
        yield Family(kind="power", names=names, weight=rank, runs=runs, ends=both)
    size = _root_mean_square(louder_m)
    let_go(louder_m, bins.number)
    if size > 0:
        yield Family(kind="decibels", names=names, weight=_times(kept(louder_m), 1 / size), runs=runs, ends=both)
    first = kept(problem.ranges.initiator < problem.ranges.target)
    forth = computed(len(first), lambda rows: np.where(first[rows], 1.0, -1.0))
    yield Family(kind="skew", names=names, weight=forth, runs=runs, ends=((low, 1.0), (high, -1.0)))
    shared = _shared(problem, louder_m)
    shared = shared if beside_curve else {name: weight for name, weight in shared.items() if name == "late"}
    if shared:
        whose = [np.full_like(low, k) for k in range(len(shared))]
        yield Family(
            kind="shared",
            names=list(shared),
            weight=tuple(kept(weight) for weight in shared.values()),
            runs=runs,
            ends=tuple((place, 1.0) for place in whose),
        )


def _shared(problem: Problem, louder_m: Floats) -> dict[str, Floats]:
    """Return what errors of all ranges (n,) may go with: distance, the speed at which it changes, noise of powers.

    Where powers are read with noise, the error that goes with the power itself is left in part, and goes with what
    distance lets expect of the power beyond what was read (regression calibration: Carroll et al. 2006, chapter 4).
    The curve is then right for the powers that are read, and nothing is wrong; but without this explanation ranges
    seem to grow with the distance. All are tested together, and what explains most is found first.
    """
    truth_m = problem.ranges.truth_m
    reach = float(np.ptp(truth_m))
    found: dict[str, Floats] = {}
    if reach <= 0:
        return found
    middle = float(np.median(truth_m))
    found["scale"] = computed(len(truth_m), lambda rows: (truth_m[rows] - middle) / reach)
    rate = _speeds(problem)
    size = _root_mean_square(rate)
    if size > 0:
        found["late"] = _times(rate, 1 / size)
    if np.any(louder_m):
        decibels = 10 * np.log10(np.maximum(problem.lifted, SMALLEST_LIFTED))
        far = np.log(np.maximum(truth_m, SHORTEST_M))
        slope, level = np.polyfit(far, decibels, 1)
        missing = louder_m * (slope * far + level - decibels)
        found["readings"] = _times(missing, 1 / max(_root_mean_square(missing), 1e-12))
    let_go(truth_m)
    return found


def _speeds(problem: Problem) -> Floats:
    """Return by how many metres a second the true distance of each range (n,) changes, by its pair's neighbours."""
    ranges, pair = problem.ranges, problem.pairs.number
    order = np.argsort(pair, kind="stable")
    time_s, truth_m = ranges.time_ns[order] * 1e-9, ranges.truth_m[order]
    same = (np.diff(pair[order]) == 0) & (np.diff(ranges.session[order]) == 0)
    step = np.diff(time_s)
    usual = same & (step > 0) & (step < GAP_S)
    rate = np.where(usual, np.diff(truth_m) / np.where(usual, step, 1.0), 0.0)
    # The mean of both sides, or the one that there is.
    sides = np.add(np.append(usual, False), np.insert(usual, 0, False), dtype=np.float64)
    found = np.empty(len(order))
    found[order] = (np.append(rate, 0.0) + np.insert(rate, 0, 0.0)) / np.maximum(sides, 1.0)
    return found


def _root_mean_square(values: Floats) -> float:
    return float(np.sqrt(values @ values / max(len(values), 1)))


def _between_sessions(problem: Problem, tags: list[str], pairs: list[str], places: tuple[Ints, Ints, Ints]) -> Family:
    """Return the offsets of tags, and of pairs, in one session; those of tags alone where time is short for both.

    Between sessions antennas are taken off and screwed on, and things are moved. `places` (blocks,) are the lower tag,
    the higher one and the pair of the design's blocks.
    """
    numbers, session = np.unique(problem.ranges.session, return_inverse=True)
    count, when = len(numbers), problem.design.kept(session.astype(np.int32))
    runs = problem.design.runs(when)
    own = when[runs.starts[:-1]]
    low, high, pair = (place[runs.block] * count + own for place in places)
    ends = (low, 1.0), (high, 1.0), (pair + len(tags) * count, 1.0)
    # The covariance of so many slopes must be known from blocks of time.
    both = (len(tags) + len(pairs)) * count < problem.blocks.count / 2
    return Family(
        kind="session",
        names=[name for name in (tags + pairs if both else tags) for _ in range(count)],
        weight=1.0,
        runs=runs,
        ends=ends if both else ends[:2],
        sessions=_distinct([problem.ranges.sessions[k] for k in numbers.tolist()]),
    )


def _distinct(names: list[str]) -> tuple[str, ...]:
    """Return names of sessions, numbered where two have the same."""
    if len(set(names)) == len(names):
        return tuple(names)
    return tuple(f"{name} ({k} of {len(names)})" for k, name in enumerate(names, 1))


def _times(column: Floats, factor: float) -> Floats:
    found = computed(len(column), lambda rows: column[rows] * factor)
    let_go(column)
    return found


def segments(seconds: float) -> int:
    """Return in how many spans of a recording a tag may have an offset of its own."""
    return int(min(max(seconds / SPAN_S, 2), SEGMENTS))
