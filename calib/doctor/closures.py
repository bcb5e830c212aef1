"""Pairs that delays of tags cannot explain: around four tags, ranges added and subtracted in turn leave no delay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Final

import numpy as np

from calib.doctor.base import Finding, RecordingView
from calib.doctor.levels import Levels, levels, variance_of_sum
from uwblink.arrays import Floats

OPEN: Final = "pairs that do not close"
SURELY: Final = 7.0
SMALLEST_M: Final = 0.04
EXPLAINS: Final = 0.5
"""Share of the misfit that a pair must explain to be named."""

ALIKE: Final = 0.9
MOST: Final = 3


@dataclass(frozen=True, slots=True)
class OpenPair:
    """Pairs of which one is off by a constant, by how many metres, and how many standard errors that is."""

    pairs: tuple[int, ...]
    offset_m: float
    deviation: float


def closures(view: RecordingView) -> Iterator[Finding]:
    """Pairs whose level the delays of their tags do not explain, with the worst closure around four tags."""
    known = levels(view)
    if known is None:
        return
    for one in open_pairs(known):
        names, way = " or ".join(known.named(pair) for pair in one.pairs), "long" if one.offset_m > 0 else "short"
        yield Finding(
            OPEN,
            f"ranges of pair {names} are {100 * abs(one.offset_m):.1f} cm too {way} for "
            f"the delays of their tags{_around(known, one.pairs[0])}",
            "look for a wall or a body between these two, and at their lever arms; record the pair anew, or fit with "
            "`constants` pair",
            0.8,
        )


def open_pairs(known: Levels) -> list[OpenPair]:
    """Return pairs that are off, the surest first, each beside those found before."""
    tags, place = np.unique(known.ends, return_inverse=True)
    place = place.reshape(known.ends.shape)
    count = len(known.level)
    design = np.zeros((count, len(tags)))
    design[np.arange(count), place[:, 0]] += 1
    design[np.arange(count), place[:, 1]] += 1
    if count <= np.linalg.matrix_rank(design):
        return []
    values = known.clipped
    variance = np.array([
        variance_of_sum(values[known.pair == p], known.time_s[known.pair == p]) / np.count_nonzero(known.pair == p)
        for p in range(count)
    ])  # fmt: skip
    # Medians scatter more than means, and hardly a pair is known better than the least of many.
    variance = 1.6 * np.maximum(variance, 0.5 * np.median(variance))
    found, level, left = list[OpenPair](), known.level.copy(), design
    for _ in range(MOST):
        one = _worst(left, level, variance)
        if one is None:
            break
        found.append(one)
        column = np.zeros((count, 1))
        column[one.pairs[0]] = 1
        left = np.hstack([left, column])
    return found


def _worst(design: Floats, level: Floats, variance: Floats) -> OpenPair | None:
    """Return the pair whose own offset explains most, with those that would explain as much."""
    root = 1 / np.sqrt(variance)
    base = np.linalg.svd(design * root[:, None], full_matrices=False)
    rank = int(np.count_nonzero(base[1] > 1e-9 * base[1][0]))
    span = base[0][:, :rank]
    residual = level * root - span @ (span.T @ (level * root))
    free = 1 - np.sum(span**2, axis=1)
    known = free > 1e-6
    if not known.any():
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        deviation = np.where(known, residual / np.sqrt(np.maximum(free, 1e-12)), 0.0)
    top = int(np.argmax(np.abs(deviation)))
    offset = float(residual[top] / free[top] / root[top])
    misfit = float(residual @ residual)
    if abs(deviation[top]) < SURELY or abs(offset) < SMALLEST_M or deviation[top] ** 2 < EXPLAINS * misfit:
        return None
    close = np.flatnonzero(np.abs(deviation) > ALIKE * abs(deviation[top]))
    order = [top, *(int(k) for k in close if k != top)]
    return OpenPair(tuple(order), offset, float(deviation[top]))


def _around(known: Levels, pair: int) -> str:
    """Say the largest closure around four tags that a pair is part of."""
    a, b = known.ends[pair].tolist()
    level = {tuple(ends): value for ends, value in zip(known.ends.tolist(), known.level.tolist(), strict=True)}
    worst: tuple[float, tuple[int, ...]] | None = None
    for others in combinations([t for t in np.unique(known.ends).tolist() if t not in (a, b)], 2):
        for c, d in permutations(others):
            ring = [tuple(sorted(ends)) for ends in ((a, b), (b, c), (c, d), (d, a))]
            if all(ends in level for ends in ring):
                value = sum(sign * level[ends] for sign, ends in zip((1, -1, 1, -1), ring, strict=True))
                if worst is None or abs(value) > abs(worst[0]):
                    worst = value, (a, b, c, d)
    if worst is None:
        return ""
    return f"; around tags {'-'.join(map(str, worst[1]))} they close to {100 * worst[0]:+.1f} cm instead of nothing"
