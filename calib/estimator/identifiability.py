"""Whether the pairs of tags determine the antenna delays, and which combinations of delays they leave free."""

from __future__ import annotations

from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints

UNDETERMINED: Final = 1e-8
"""Smallest share of the largest eigenvalue at which a direction counts as determined.

Clock ratios differ from 1 by parts per million, which lifts a free direction to 1e-12 at most.
"""


def square_of(tags: list[int], initiator: Ints, target: Ints, first: Floats, second: Floats) -> tuple[Floats, Ints]:
    """Return the square (tags, tags) of the derivatives of ranges (n,) by the delays of tags, and their pairs (k, 2).

    `first` and `second` are the weights of the delays of initiator and target.
    """
    count, (one, two) = len(tags), (np.searchsorted(tags, ids) for ids in (initiator, target))

    def summed(row: Ints, column: Ints, weight: Floats) -> Floats:
        return np.asarray(np.bincount(row * count + column, weight, count * count), np.float64).reshape(count, count)

    across = summed(one, two, first * second)
    pairs = np.array(tags)[np.argwhere(across + across.T)]
    return summed(one, one, first**2) + summed(two, two, second**2) + across + across.T, pairs


def free_directions(square: Floats, tags: list[int], pairs: Ints) -> tuple[Floats, list[list[int]]]:
    """Return the directions that ranges leave free, (tags, k) of length one, and the tags that they shift.

    `square` (tags, tags) is that of the derivatives of ranges by the delays, `pairs` (pairs, 2) are the ids that range.
    The free tags come in groups that shift together: tags that range only with tags of another group (anchors against
    robots, a single pair) can shift by +a and -a without a trace in any range.
    """
    values, vectors = np.linalg.eigh(square)
    loose = values < UNDETERMINED * values[-1]
    free = {tag for tag, row in zip(tags, vectors[:, loose], strict=True) if np.abs(row).max(initial=0.0) > 1e-3}
    return np.asarray(vectors[:, loose]), _connected(free, {(low, high) for low, high in pairs.tolist()})


def _connected(tags: set[int], pairs: set[tuple[int, int]]) -> list[list[int]]:
    """Return the connected components of a graph of pairs, among some tags."""
    left, groups = set(tags), []
    while left:
        group, waiting = set(), [min(left)]
        while waiting:
            tag = waiting.pop()
            group.add(tag)
            linked = {b for a, b in pairs if a == tag} | {a for a, b in pairs if b == tag}
            waiting += sorted((linked & left) - group)
        groups.append(sorted(group))
        left -= group
    return groups
