"""Where a search for positions begins: multidimensional scaling of the ranges, and other places for it to begin.

Boards may be said to stand in an order on a line. A line has no beginning, so an order and its reverse are the same.
Boards nearer to each other than 10 cm may stand in either order: nobody can say who is first of two side by side.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise

import numpy as np
from scipy.linalg import orthogonal_procrustes
from scipy.sparse.csgraph import floyd_warshall

from calib.surveys.network import Boards, Network
from uwblink.arrays import Floats, Ints

TOGETHER_M = 0.1
"""Boards nearer to each other stand side by side: they touch, and their order means nothing."""

SHAKEN = 4
"""Random starts of an arrangement beside those that are mirrored or exchanged: half or twice as many change nothing
(`python -m benchmarks.constants`)."""


def is_in_order(coordinates: Floats) -> bool:
    """Return whether coordinates (n,), those of boards in the order that is said, rise or fall."""
    ways = coordinates, coordinates[::-1]
    return any(float(np.max(np.maximum.accumulate(v) - v)) <= TOGETHER_M for v in ways)


def exchanged_boards(said: Sequence[int], coordinates: Floats) -> set[tuple[int, int]]:
    """Return which two boards must change places for those `said`, at coordinates (n,), to be in order; or nothing.

    More than one pair where the ranges cannot tell: 1-2-3-4 with the inner two exchanged is the same with the outer two
    exchanged, from the other end.
    """
    fitting = set()
    for i, j in combinations(range(len(said)), 2):
        changed = coordinates.copy()
        changed[[i, j]] = coordinates[[j, i]]
        if is_in_order(changed):
            fitting.add((min(said[i], said[j]), max(said[i], said[j])))
    return fitting


def first_start(network: Network, delays: Floats | None = None) -> Floats:
    """Return unknowns from the ranges alone, with delays (tags,) in ns, or none: by classical scaling."""
    x = network.layout.start()
    if delays is not None:
        x[network.layout.where["delay"]] = delays
    place = np.zeros((len(network.points), 3))
    measured = network.linear(np.where(np.arange(len(x)) < place.size, 0.0, x))[0]  # with all points at the origin
    for k, boards in enumerate(network.arrangements):
        here = network.seats(k)
        apart = _distances(network, measured, here)
        centring = np.eye(len(here)) - 1 / len(here)
        values, vectors = np.linalg.eigh(-0.5 * centring @ apart**2 @ centring)
        top = np.argsort(values)[::-1][: boards.dimensions]
        found = np.zeros((len(here), 3))
        found[:, : len(top)] = vectors[:, top] * np.sqrt(np.maximum(values[top], 1e-6))
        known = [n for n, point in enumerate(here.tolist()) if point in network.known_places]
        if known:
            goal, mine = np.array([network.known_places[here[n]][0] for n in known]), found[known]
            turn = orthogonal_procrustes(mine - mine.mean(axis=0), goal - goal.mean(axis=0))[0]
            found = (found - mine.mean(axis=0)) @ turn + goal.mean(axis=0)
        place[here] = found
    return network.with_positions(x, place)


def other_starts(points: Floats, boards: Boards, seed: int) -> Iterator[Floats]:
    """Yield other places (n, 3) of boards: neighbours exchanged, in the order that is said, mirrored, or shaken."""
    if boards.order:
        rows = [boards.tags.index(tag) for tag in boards.order]
        upward = points[sorted(rows, key=lambda row: float(points[row, 0]))]
        for places in (upward, upward[::-1]):
            yield _replaced(points, rows, places)
    if boards.dimensions == 1:
        for a, b in pairwise(np.argsort(points[:, 0]).tolist()):
            yield _replaced(points, [a, b], points[[b, a]])
    middle = points - points.mean(axis=0)
    _, size, axes = np.linalg.svd(middle)
    if boards.dimensions > 1:
        # Through the plane in which boards nearly lie: what is on its one side might be on its other.
        normal = axes[boards.dimensions - 1]
        yield points - 2 * np.outer(middle @ normal, normal)
    rng, spread = np.random.default_rng(seed), max(float(size[0]) / np.sqrt(len(points)), 0.1)
    for _ in range(SHAKEN):
        yield points + 0.5 * spread * rng.normal(size=points.shape)


def _replaced(points: Floats, rows: list[int], places: Floats) -> Floats:
    found = points.copy()
    found[rows] = places
    return found


def _distances(network: Network, measured: Floats, here: Ints) -> Floats:
    """Return the distances (n, n) of the points of an arrangement; by way of others where they were not measured."""
    apart = np.full((len(here), len(here)), np.inf)
    np.fill_diagonal(apart, 0.0)
    rows = np.flatnonzero(np.isin(network.ends[: len(network.means.range_m), 0], here))
    ends = np.searchsorted(here, network.ends[rows])
    apart[ends[:, 0], ends[:, 1]] = apart[ends[:, 1], ends[:, 0]] = np.maximum(measured[rows], 0.01)
    apart = floyd_warshall(apart)
    longest = float(apart[np.isfinite(apart)].max(initial=1.0))
    return np.where(np.isfinite(apart), apart, longest)
