"""The choice of arrangements and taped distances: each the best after those before it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from calib.errors import UnanswerableError
from calib.planning.candidates import Layout, layouts
from calib.planning.having import Having
from calib.surveys.network import DIMENSIONS
from uwblink.arrays import Floats

CANDIDATES: Final = 60
MOST_ARRANGEMENTS: Final = 12
WORTH_IT: Final = 0.06
"""Share by which one arrangement more must narrow the mean interval to be planned, where no number is given."""

GUESS_M: Final = 0.45
"""How far a delay is known without any data, for the choice alone: 1.5 ns."""


@dataclass(frozen=True, slots=True)
class Choice:
    """The arrangements that were chosen, taped distances in them, and those that might have been, with what they say.

    `informations` (boards, boards) go with `candidates`, in 1/m^2.
    """

    given: Having
    candidates: list[Layout]
    informations: list[Floats]
    chosen: list[Layout]

    @property
    def total(self) -> Floats:
        """Return what all chosen ones say of the delays (boards, boards), in 1/m^2."""
        return np.asarray(np.sum([self.given.information(layout) for layout in self.chosen], axis=0))

    def best_next(self) -> int:
        """Return which candidate says most after those that were chosen."""
        total = self.total
        return min(range(len(self.informations)), key=lambda k: mean_std(total + self.informations[k]))


def choose(given: Having, count: int | None) -> Choice:
    """Return `count` arrangements, or as many as are worth it; raises `UnanswerableError` where boards find no room."""
    candidates = _candidates(given)
    informations = [given.information(layout) for layout in candidates]
    chosen = [candidates[k] for k in _chosen(informations, count)]
    return Choice(given, candidates, informations, _taped(given, chosen))


def _candidates(given: Having) -> list[Layout]:
    found = layouts(len(given.tags), DIMENSIONS[given.on], given.size_m, CANDIDATES, given.seed)
    if not found:
        raise UnanswerableError(f"{len(given.tags)} boards find no room: they must stand 0.4 m from each other")
    if not given.anchors:
        return found
    # Anchors stay where they are; the corners of the room are as good a guess as any.
    rows = [given.tags.index(tag) for tag in given.anchors]
    fixed = found[0].place_m[rows]
    moved = []
    for layout in found:
        place = layout.place_m.copy()
        place[rows] = fixed
        moved.append(replace(layout, place_m=place))
    return moved


def _chosen(informations: list[Floats], count: int | None) -> list[int]:
    """Return which arrangements, one after the other: each the best after those before it."""
    total = np.zeros_like(informations[0])
    found: list[int] = []
    while len(found) < (count or MOST_ARRANGEMENTS):
        # The same once more would have the same errors, unless boards were taken away in between.
        left = [k for k in range(len(informations)) if k not in found] or list(range(len(informations)))
        best = min(left, key=lambda k: mean_std(total + informations[k]))
        before, after = mean_std(total), mean_std(total + informations[best])
        if count is None and len(found) >= 2 and after > (1 - WORTH_IT) * before:
            break
        found.append(best)
        total = total + informations[best]
    return found


def _taped(given: Having, chosen: list[Layout]) -> list[Layout]:
    """Return the arrangements with the distances to tape in them: each where it brings most."""
    found = list(chosen)
    for _ in range(given.taped):
        best = best_tape(given, found)
        if best is None:
            break
        k, pair = best
        found[k] = replace(found[k], taped=(*found[k].taped, pair))
    return found


def best_tape(given: Having, chosen: list[Layout]) -> tuple[int, tuple[int, int]] | None:
    """Return in which arrangement which pair of boards (by number) is best taped; None where all are."""
    each = [given.information(layout) for layout in chosen]
    total = np.sum(each, axis=0)
    options = [
        (mean_std(total - each[k] + given.information(replace(layout, taped=(*layout.taped, pair)))), k, pair)
        for k, layout in enumerate(chosen)
        for pair in combinations(range(len(given.tags)), 2)
        if pair not in layout.taped
    ]
    if not options:
        return None
    _, k, pair = min(options)
    return k, pair


def mean_std(information: Floats) -> float:
    """Return the root mean variance of the delays, metres, of which a little is known without any data.

    To a nanometre, so that mirror images are equally good on every machine and the first of them is taken.
    """
    guess = np.eye(len(information)) / GUESS_M**2
    return round(float(np.sqrt(np.trace(np.linalg.inv(information + guess)) / len(information))), 9)
