"""Other solutions: places for boards that agree with the ranges nearly as well, looked for in each arrangement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.surveys.adjustment import Adjusted, adjust, settle, unlikely_at
from calib.surveys.network import Known, Network
from calib.surveys.reflections import searched
from calib.surveys.starts import first_start, other_starts, start_in_order
from uwblink.arrays import Bools, Floats

SHAKEN: Final = 4
"""Starts of each arrangement beside those that exchange neighbours or mirror."""

APART_M: Final = 0.03
"""How far a board must be from where it was for a solution to be another one."""

MOST_MOVES: Final = 6
BETTER: Final = 1e-3
WORTH_A_LOOK: Final = 60.0
AMBIGUOUS: Final = 9.0
"""By how much a second solution may be worse and still be as good: three standard deviations."""


@dataclass(frozen=True, slots=True)
class SecondBest:
    """The best other solution: in which arrangement it differs, whose places, how much worse its -2 log likelihood."""

    arrangement: str
    tags: tuple[int, ...]
    worse: float

    @property
    def ambiguous(self) -> bool:
        """Whether the ranges can hardly tell it from the best one."""
        return self.worse < AMBIGUOUS


def best(network: Network, *, pair_std_m: float | None) -> tuple[Adjusted, SecondBest | None]:
    """Return the best solution that any start leads to, and the second-best."""
    found = adjust(network, first_start(network), pair_std_m=pair_std_m, careful=True)
    # Once more with the delays that came out: the first guess of places was made without any.
    again = adjust(network, first_start(network, found.x[network.delay_columns]), pair_std_m=pair_std_m)
    found = min(found, again, key=lambda one: one.unlikely)
    said = start_in_order(network, found.x)
    if said is not None:
        found = min(found, adjust(network, said, pair_std_m=pair_std_m), key=lambda one: one.unlikely)
    worse: list[tuple[float, Who]] = []
    for _ in range(MOST_MOVES):
        others = [other for k in range(len(network.places)) for other in _others(found, k)]
        here = settled(found.network, found, found.x)[0]
        worse = [(one.unlikely - here, one.who) for one in others if one.unlikely >= here - BETTER]
        better = [one for one in others if one.unlikely < here - BETTER]
        if not better:
            break
        start = min(better, key=lambda one: one.unlikely)
        moved = adjust(found.network.marked(start.marks), start.x, pair_std_m=pair_std_m)
        if moved.unlikely > found.unlikely - BETTER:
            break
        found = moved
    if not worse:
        return found, None
    gap, (name, tags) = min(worse)
    return found, SecondBest(name, tags, max(gap, 0.0))


Who = tuple[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class Other:
    """Another solution that differs in one arrangement: its unknowns, which means are reflected, who is elsewhere."""

    unlikely: float
    x: Floats
    marks: Bools
    who: Who


def settled(network: Network, found: Adjusted, x: Floats) -> tuple[float, Floats]:
    """Return -2 log likelihood with the spreads that were found, and the unknowns, from a start."""
    std = network.std_m(found.pair_std_m)
    x, value, _ = settle(network, x, std, found.curve_std_m)
    return unlikely_at(network, x, std, found.curve_std_m, value), x


def settled_marks(network: Network, found: Adjusted, x: Floats) -> tuple[float, Floats, Network]:
    """Return the same with what is likeliest reflected there."""
    for _ in range(2):
        value, x = settled(network, found, x)
        marks = searched(network, x, network.std_m(found.pair_std_m), found.curve_std_m)
        if np.array_equal(marks, network.reflected):
            break
        network = network.marked(marks)
        value, x = settled(network, found, x)
    return value, x, network


def _others(found: Adjusted, arrangement: int) -> list[Other]:
    """Return other solutions that differ in one arrangement."""
    network = found.network
    single = alone(found, arrangement)
    mine = network.means.arrangement == arrangement
    if not len(single.means):
        return []
    start = single.with_positions(single.centre(), network.positions(found.x)[_rows(network, arrangement)])
    here, _ = settled(single, found, start)
    rows: list[Other] = []
    seen: list[Floats] = [_signature(single, start)]
    for other in other_starts(single, start, 0, SHAKEN):
        value, x, marked = settled_marks(single.marked(np.zeros_like(single.reflected)), found, other)
        mark = _signature(single, x)
        if value > here + WORTH_A_LOOK or any(_same(mark, known) for known in seen):
            continue
        seen.append(mark)
        place = network.positions(found.x)
        place[_rows(network, arrangement)] = single.positions(x)
        marks = network.reflected.copy()
        marks[mine] = marked.reflected
        cost, whole, changed = settled_marks(network.marked(marks), found, network.with_positions(found.x, place))
        there = network.positions(whole)[_rows(network, arrangement)]
        mark = _signature(single, single.with_positions(x, there))
        if not _same(mark, seen[0]):
            who = tuple(np.array(single.places[0].tags)[_elsewhere(mark, seen[0])].tolist())
            rows.append(Other(cost, whole, changed.reflected, (single.places[0].name, who)))
    return rows


def _rows(network: Network, arrangement: int) -> list[int]:
    return [k for k, (a, _) in enumerate(network.points) if a == arrangement]


def found_positions(found: Adjusted, arrangement: int) -> Floats:
    """Return where the boards of an arrangement were found (boards, 3)."""
    return found.network.positions(found.x)[_rows(found.network, arrangement)]


def alone(found: Adjusted, arrangement: int) -> Network:
    """Return one arrangement as a network of its own, with delays and curve as they were found."""
    network, rows = found.network, found.network.means.arrangement == arrangement
    means = network.means[rows]
    curve = 0.0 if network.power is None else network.power.design[rows] @ found.x[network.curve_columns]
    k, here = network.known, _rows(network, arrangement)
    number = {point: n for n, point in enumerate(here)}
    ends = np.isin(k.ends[:, 0], here)
    at = np.isin(k.at, here)
    known = Known(
        ends=np.array([[number[i], number[j]] for i, j in k.ends[ends].tolist()], dtype=np.int64).reshape(-1, 2),
        distance_m=k.distance_m[ends],
        distance_std_m=k.distance_std_m[ends],
        distance_of=k.distance_of[ends],
        at=np.array([number[i] for i in k.at[at].tolist()], dtype=np.int64),
        position_m=k.position_m[at],
        position_std_m=k.position_std_m[at],
    )
    delays = dict(zip(network.tags, found.x[network.delay_columns].tolist(), strict=True))
    tags = tuple(means.tags())
    return Network(
        means=replace(means, arrangement=np.zeros_like(means.arrangement), range_m=means.range_m - curve),
        places=(network.places[arrangement],),
        tags=tags,
        known=known,
        fixed_m={tag: delays[tag] for tag in tags},
        power=None,
        reflected=network.reflected[rows],
    )


def _signature(network: Network, x: Floats) -> Floats:
    """Return what tells two solutions apart (points, k): distances to all others, and places where a frame is known."""
    place = network.positions(x)
    apart = np.linalg.norm(place[:, None] - place, axis=2)
    return np.asarray(np.hstack([apart, place]) if len(network.known.at) else apart)


def _same(one: Floats, other: Floats) -> bool:
    return float(np.abs(one - other).max()) < APART_M


def _elsewhere(one: Floats, other: Floats) -> Bools:
    """Return which points moved: those whose distances to others changed most, or whose place did."""
    change = np.abs(one - other).max(axis=1)
    return np.asarray(change > max(APART_M, 0.5 * float(change.max())))
