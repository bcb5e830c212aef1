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

from calib.surveys.network import Network
from uwblink.arrays import Floats, Ints

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


def first_start(network: Network, delays: Floats | None = None) -> Floats:
    """Return unknowns from the ranges alone, with delays (tags,) in ns, or none: by classical scaling."""
    x = network.layout.start()
    if delays is not None:
        x[network.layout.where["delay"]] = delays
    place = network.positions(x)
    measured = network.linear(x)[0]  # All points are at the origin as yet.
    for k, boards in enumerate(network.arrangements):
        here = network.seats(k)
        apart = _distances(network, measured, here)
        centring = np.eye(len(here)) - 1 / len(here)
        values, vectors = np.linalg.eigh(-0.5 * centring @ apart**2 @ centring)
        top = np.argsort(values)[::-1][: boards.dimensions]
        found = np.zeros((len(here), 3))
        found[:, : len(top)] = vectors[:, top] * np.sqrt(np.maximum(values[top], 1e-6))
        place[here] = _onto_known(network, found, here)
    return network.with_positions(x, place)


def start_in_order(network: Network, x: Floats, wrong: Sequence[int]) -> Floats:
    """Return unknowns with the boards of some arrangements put in the order that is said."""
    place = network.positions(x)
    for k in wrong:
        here, boards = network.seats(k), network.arrangements[k]
        place[here] = in_said_order(place[here], boards.tags, boards.order)[0]
    return network.with_positions(x, place)


def other_starts(network: Network, x: Floats, arrangement: int, shaken: int = 4, seed: int = 0) -> Iterator[Floats]:
    """Yield unknowns in which one arrangement begins elsewhere: neighbours exchanged, mirrored, or `shaken`."""
    rng = np.random.default_rng(seed + arrangement)
    place, here, boards = network.positions(x), network.seats(arrangement), network.arrangements[arrangement]
    points = place[here]
    variants = list(in_said_order(points, boards.tags, boards.order)) if boards.order else []
    if boards.dimensions == 1:
        for a, b in pairwise(np.argsort(points[:, 0]).tolist()):
            exchanged = points.copy()
            exchanged[[a, b]] = points[[b, a]]
            variants.append(exchanged)
    middle = points - points.mean(axis=0)
    _, size, axes = np.linalg.svd(middle, full_matrices=False)
    if boards.dimensions > 1:
        # Through the plane in which boards nearly lie: what is on its one side might be on its other.
        normal = axes[boards.dimensions - 1] if len(axes) >= boards.dimensions else np.eye(3)[boards.dimensions - 1]
        variants.append(points - 2 * np.outer(middle @ normal, normal))
    spread = max(float(size[0]) / np.sqrt(len(points)), 0.1)
    for _ in range(shaken):
        moved = points.copy()
        moved[:, : boards.dimensions] += 0.5 * spread * rng.normal(size=(len(points), boards.dimensions))
        variants.append(moved)
    if boards.order:
        variants.append(first_start(network, x[network.layout.where["delay"]])[: place.size].reshape(-1, 3)[here])
    for variant in variants:
        changed = place.copy()
        changed[here] = variant
        yield network.with_positions(x, changed)


def _distances(network: Network, measured: Floats, here: Ints) -> Floats:
    """Return the distances (n, n) of the points of an arrangement; by way of others where they were not measured."""
    apart = np.full((len(here), len(here)), np.inf)
    np.fill_diagonal(apart, 0.0)
    rows = np.flatnonzero(np.isin(network.ends[: len(network.means), 0], here))
    ends = np.searchsorted(here, network.ends[rows])
    apart[ends[:, 0], ends[:, 1]] = apart[ends[:, 1], ends[:, 0]] = np.maximum(measured[rows], 0.01)
    apart = floyd_warshall(apart)
    longest = float(apart[np.isfinite(apart)].max(initial=1.0))
    return np.where(np.isfinite(apart), apart, longest)


def _onto_known(network: Network, points: Floats, here: Ints) -> Floats:
    """Return points turned, mirrored and shifted onto the known positions among them."""
    rows = np.flatnonzero(np.isin(network.known.at, here))
    if not len(rows):
        return points
    goal, mine = network.known.position_m[rows], points[np.searchsorted(here, network.known.at[rows])]
    turn = orthogonal_procrustes(mine - mine.mean(axis=0), goal - goal.mean(axis=0))[0]
    return np.asarray((points - mine.mean(axis=0)) @ turn + goal.mean(axis=0))
