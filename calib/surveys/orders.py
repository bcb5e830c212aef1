"""The order in which boards are said to stand on a line: whether places agree with it, and who was exchanged.

A line has no beginning, so an order and its reverse are the same. Boards nearer to each other than 10 cm may stand in
either order: nobody can say who is first of two that stand side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from uwblink.arrays import Floats

TOGETHER_M = 0.1
"""Boards nearer to each other stand side by side."""


def line_coordinates(points: Floats, tags: Sequence[int], order: Sequence[int]) -> Floats:
    """Return the coordinates (n,) of an order of boards along the longest axis of points (m, 3), those of `tags`."""
    listed = points[[tags.index(tag) for tag in order]]
    middle = listed - listed.mean(axis=0)
    return np.asarray(middle @ np.linalg.svd(middle, full_matrices=False)[2][0])


def is_in_order(coordinates: Floats) -> bool:
    """Return whether coordinates (n,), those of boards in the order that is said, rise or fall."""
    return any(float(np.max(np.maximum.accumulate(v) - v)) <= TOGETHER_M for v in (coordinates, coordinates[::-1]))


def in_said_order(points: Floats, tags: Sequence[int], order: Sequence[int]) -> list[Floats]:
    """Return points (n, 3) with those of boards whose order is said put so; the nearer of both ways first."""
    rows = [tags.index(tag) for tag in order]
    upward = points[rows][np.argsort(line_coordinates(points, tags, order))]
    found = []
    for places in (upward, upward[::-1]):
        changed = points.copy()
        changed[rows] = places
        found.append(changed)
    return sorted(found, key=lambda one: float(np.abs(one - points).sum()))


def exchanged_boards(said: Sequence[int], coordinates: Floats) -> set[tuple[int, int]]:
    """Return which two boards must change places for those `said`, at coordinates (n,), to be in order; or nothing.

    More than one pair where the ranges cannot tell: 1-2-3-4 with the inner two exchanged is the same with the outer two
    exchanged, from the other end.
    """
    fitting = {}
    for i, j in combinations(range(len(said)), 2):
        changed = coordinates.copy()
        changed[[i, j]] = coordinates[[j, i]]
        if is_in_order(changed):
            apart = (changed[:, None] - changed)[np.triu_indices(len(changed), 1)]
            off = float(min(np.maximum(apart, 0).sum(), np.maximum(-apart, 0).sum()))
            fitting[min(said[i], said[j]), max(said[i], said[j])] = off
    return {pair for pair, off in fitting.items() if off <= min(fitting.values()) + TOGETHER_M}
