"""Where a search for positions begins: multidimensional scaling of the ranges, and other places for it to begin."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from calib.surveys.network import Network
from calib.surveys.orders import rearranged
from uwblink.arrays import Floats


def first_start(network: Network, delays_m: Floats | None = None) -> Floats:
    """Return unknowns from the ranges alone, with delays (tags,) in metres, or none: by classical scaling."""
    x = network.centre()
    if delays_m is not None:
        x[network.delay_columns] = delays_m
    place = np.zeros((len(network.points), 3))
    for k in range(len(network.places)):
        here, apart = _distances(network, x, k)
        found = scaled(apart, network.places[k].dimensions)
        place[here, : found.shape[1]] = found
        place[here] = _onto_known(network, place[here], here)
    return network.with_positions(x, place)


def start_in_order(network: Network, x: Floats) -> Floats | None:
    """Return unknowns with boards put in the order that is said wherever they stand in another; None where nowhere."""
    place, wrong = network.positions(x), network.out_of_order(x)
    for k in wrong:
        here = network.seats(k)
        place[here] = rearranged(place[here], network.places[k].ordered_rows)[0]
    return network.with_positions(x, place) if wrong else None


def scaled(apart: Floats, dimensions: int) -> Floats:
    """Return points (n, dimensions) whose distances are near `apart` (n, n): classical multidimensional scaling."""
    count = len(apart)
    centring = np.eye(count) - 1 / count
    values, vectors = np.linalg.eigh(-0.5 * centring @ apart**2 @ centring)
    top = np.argsort(values)[::-1][:dimensions]
    found = vectors[:, top] * np.sqrt(np.maximum(values[top], 1e-6))
    return np.asarray(found)


def other_starts(network: Network, x: Floats, arrangement: int, count: int, seed: int = 0) -> Iterator[Floats]:
    """Yield unknowns in which one arrangement begins elsewhere: neighbours exchanged, mirrored, or shaken."""
    rng = np.random.default_rng(seed + arrangement)
    place = network.positions(x)
    here = [k for k, (a, _) in enumerate(network.points) if a == arrangement]
    dimensions = network.places[arrangement].dimensions
    order = network.places[arrangement].ordered_rows
    if order:
        yield first_start(network, x[network.delay_columns])
    said = rearranged(place[here], order) if order else []
    for points in (*said, *_variants(place[here], dimensions, count, rng)):
        changed = place.copy()
        changed[here] = points
        yield network.with_positions(x, changed)


def _variants(points: Floats, dimensions: int, count: int, rng: np.random.Generator) -> Iterator[Floats]:
    order = np.argsort(points[:, 0])
    for a, b in pairwise(order.tolist()):
        if dimensions == 1:
            found = points.copy()
            found[[a, b]] = points[[b, a]]
            yield found
    middle = points - points.mean(axis=0)
    _, size, axes = np.linalg.svd(middle, full_matrices=False)
    if dimensions > 1:
        # Through the plane in which boards nearly lie: what is on its one side might be on its other.
        normal = axes[dimensions - 1] if len(axes) >= dimensions else np.eye(3)[dimensions - 1]
        yield points - 2 * np.outer(middle @ normal, normal)
    spread = max(float(size[0]) / np.sqrt(len(points)), 0.1)
    for _ in range(count):
        shaken = points.copy()
        shaken[:, :dimensions] += 0.5 * spread * rng.normal(size=(len(points), dimensions))
        yield shaken


def _distances(network: Network, x: Floats, arrangement: int) -> tuple[list[int], Floats]:
    """Return the points of an arrangement and their distances (n, n); by way of others where not measured."""
    here = [k for k, (a, _) in enumerate(network.points) if a == arrangement]
    number = {point: k for k, point in enumerate(here)}
    apart = np.full((len(here), len(here)), np.inf)
    np.fill_diagonal(apart, 0.0)
    measured = network.means.range_m - network.linear @ x
    for (i, j), length in zip(network.ends.tolist(), measured.tolist(), strict=True):
        if i in number and j in number:
            apart[number[i], number[j]] = apart[number[j], number[i]] = max(length, 0.01)
    for via in range(len(here)):
        apart = np.minimum(apart, apart[:, [via]] + apart[[via], :])
    longest = float(apart[np.isfinite(apart)].max(initial=1.0))
    return here, np.where(np.isfinite(apart), apart, longest)


def _onto_known(network: Network, points: Floats, here: list[int]) -> Floats:
    """Return points turned, mirrored and shifted onto the known positions among them."""
    number = {point: k for k, point in enumerate(here)}
    rows = [k for k, at in enumerate(network.known.at.tolist()) if at in number]
    if not rows:
        return points
    goal, mine = network.known.position_m[rows], points[[number[int(network.known.at[k])] for k in rows]]
    u, _, v = np.linalg.svd((mine - mine.mean(axis=0)).T @ (goal - goal.mean(axis=0)))
    return np.asarray((points - mine.mean(axis=0)) @ (u @ v) + goal.mean(axis=0))
