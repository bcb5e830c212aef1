"""The order in which boards are said to stand on a line: whether places agree with it, and who was exchanged.

A line has no beginning, so an order and its reverse are the same. Boards nearer to each other than 10 cm may stand in
either order: nobody can say who is first of two that stand side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Final

import numpy as np

from uwblink.arrays import Floats

TOGETHER_M: Final = 0.1


def along(points: Floats) -> Floats:
    """Return the coordinates (n,) of points (n, 3) along their longest axis."""
    middle = points - points.mean(axis=0)
    axis = np.linalg.svd(middle, full_matrices=False)[2][0]
    return np.asarray(middle @ axis)


def agrees(coordinates: Floats) -> bool:
    """Return whether coordinates (n,), those of boards in the order that is said, rise or fall."""
    return any(float(np.max(np.maximum.accumulate(v) - v)) <= TOGETHER_M for v in (coordinates, coordinates[::-1]))


def amiss(coordinates: Floats) -> float:
    """Return by how many metres, over all pairs, coordinates (n,) are not in order."""
    apart = (coordinates[:, None] - coordinates)[np.triu_indices(len(coordinates), 1)]
    return float(min(np.maximum(apart, 0).sum(), np.maximum(-apart, 0).sum()))


def rearranged(points: Floats, rows: Sequence[int]) -> list[Floats]:
    """Return points (n, 3) with those of `rows`, in the order that is said, put so; the nearer of both ways first."""
    found = []
    listed = points[list(rows)]
    upward = listed[np.argsort(along(listed))]
    for places in (upward, upward[::-1]):
        changed = points.copy()
        changed[list(rows)] = places
        found.append(changed)
    return sorted(found, key=lambda one: float(np.abs(one - points).sum()))


def exchanged(said: Sequence[int], coordinates: Floats) -> set[tuple[int, int]]:
    """Return which two boards must change places for those `said`, at coordinates (n,), to be in order; or nothing.

    More than one pair where the ranges cannot tell: 1-2-3-4 with the inner two exchanged is the same with the outer two
    exchanged, from the other end.
    """
    fitting = {}
    for i, j in combinations(range(len(said)), 2):
        changed = coordinates.copy()
        changed[[i, j]] = coordinates[[j, i]]
        if agrees(changed):
            fitting[min(said[i], said[j]), max(said[i], said[j])] = amiss(changed)
    return {pair for pair, off in fitting.items() if off <= min(fitting.values()) + TOGETHER_M}


def in_words(names: Sequence[str], pairs: set[tuple[int, int]], said: Sequence[int], coordinates: Floats) -> str:
    """Return what is wrong in the arrangements named: which of `pairs` are exchanged, or that the order is another.

    `said` is the order of the first of them, and `coordinates` (n,) are where these boards stand there.
    """
    way = np.argsort(coordinates)
    found = [said[k] for k in (way if _forward(coordinates) else way[::-1]).tolist()]
    orders = f"said was {_listed(said)}, the ranges of {names[0]} say {_listed(found)}"
    if not pairs:
        return f"{', '.join(names)}: boards stand in another order than said: {orders}; look at their labels"
    who = ", or ".join(f"{i} and {j}" for i, j in sorted(pairs))
    return f"{', '.join(names)}: boards {who} stand in each other's place: {orders}; look at the labels of these two"


def _forward(coordinates: Floats) -> bool:
    return bool(np.corrcoef(np.arange(len(coordinates)), coordinates)[0, 1] > 0)


def _listed(tags: Sequence[int]) -> str:
    return "-".join(map(str, tags))
