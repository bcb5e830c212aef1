"""Arrangements that one might make, and what each would say of the delays: Fisher's information, places unknown."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from uwblink.arrays import Floats

NEAREST_M: Final = 0.4
"""Boards stand no nearer to each other; nearer, powers saturate and fields are not yet waves."""

MOST_TRIES: Final = 400
EQUAL: Final = 1e-9


@dataclass(frozen=True, slots=True)
class Layout:
    """Places (boards, 3) of an arrangement in metres, and the pairs of boards (by number) whose distance is taped."""

    place_m: Floats
    dimensions: int
    taped: tuple[tuple[int, int], ...] = ()


def layouts(boards: int, dimensions: int, size_m: tuple[float, float, float], count: int, seed: int) -> list[Layout]:
    """Return random arrangements: orders on a line at even steps, random places on a table or in a room.

    Fewer than `count` where a line has fewer orders.
    """
    rng = np.random.default_rng(seed)
    found: list[Layout] = []
    seen: set[tuple[int, ...]] = set()
    for _ in range(MOST_TRIES):
        if len(found) == count:
            break
        if dimensions == 1:
            order = tuple(rng.permutation(boards).tolist())
            if order in seen:
                continue
            seen |= {order, order[::-1]}
            found.append(on_line(order, size_m[0]))
        else:
            place = np.zeros((boards, 3))
            place[:, :dimensions] = np.round(rng.uniform(0, size_m[:dimensions], (boards, dimensions)), 1)
            if min(np.linalg.norm(place[i] - place[j]) for i, j in combinations(range(boards), 2)) >= NEAREST_M:
                found.append(Layout(place, dimensions))
    return found


def on_line(order: tuple[int, ...], length_m: float) -> Layout:
    """Return boards (by number) in an order, at even steps along a line."""
    place = np.zeros((len(order), 3))
    place[list(order), 0] = np.round(np.linspace(0, length_m, len(order)), 1)
    return Layout(place, 1)


def delay_information(
    layout: Layout, pair_error_m: float, tape_sigma_m: float, place_sigma_m: dict[int, float] | None = None
) -> Floats:
    """Return the information (boards, boards) on delays in metres that an arrangement gives, whatever its places.

    `place_sigma_m` are boards whose place is known, by number, and how well.
    """
    return beside(*rows_of(layout, pair_error_m, tape_sigma_m, place_sigma_m or {}))


def rows_of(
    layout: Layout, pair_error_m: float, tape_sigma_m: float, place_sigma_m: dict[int, float]
) -> tuple[Floats, Floats]:
    """Return the derivatives by delays in metres (n, boards) and by coordinates (n, k): pairs, tapes, known places."""
    place, dimensions = layout.place_m, layout.dimensions
    pairs = list(combinations(range(len(place)), 2))
    rows = [_length(place, dimensions, i, j) / pair_error_m for i, j in pairs]
    rows += [_length(place, dimensions, i, j) / tape_sigma_m for i, j in layout.taped]
    for board, sigma in place_sigma_m.items():
        for axis in range(dimensions):
            row = np.zeros(len(place) * dimensions)
            row[board * dimensions + axis] = 1 / sigma
            rows.append(row)
    delays = np.zeros((len(rows), len(place)))
    for k, (i, j) in enumerate(pairs):
        delays[k, [i, j]] = -0.5 / pair_error_m
    return delays, np.array(rows)


def _length(place: Floats, dimensions: int, i: int, j: int) -> Floats:
    """Return the derivative of a distance by all coordinates."""
    row = np.zeros((len(place), dimensions))
    apart = (place[i] - place[j])[:dimensions]
    row[i] = apart / np.linalg.norm(apart)
    row[j] = -row[i]
    return row.ravel()


def beside(wanted: Floats, others: Floats) -> Floats:
    """Return the information on the wanted unknowns (n, m) that the others (n, k) cannot take up."""
    if not len(others):
        return np.zeros((wanted.shape[1],) * 2)
    basis, size, _ = np.linalg.svd(others, full_matrices=False)
    basis = basis[:, size > EQUAL * size[0]]
    left = wanted - basis @ (basis.T @ wanted)
    return left.T @ left
