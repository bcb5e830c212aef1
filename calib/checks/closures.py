"""Pairs that delays of tags cannot explain: around four tags, ranges added and subtracted in turn leave no delay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Final

import numpy as np

from calib.checks.levels import DOF, OF_MEDIAN, Levels, levels
from calib.checks.pairs import standing_still
from calib.checks.recording_view import RecordingView
from calib.findings import BUDGET, Candidate, exceeds, positive, stretches
from uwblink.arrays import Floats

OPEN: Final = "pairs that do not close"
ASTRAY: Final = "ranges that do not follow the distances"
LOUD_M: Final = 0.3
"""Mean absolute error of a pair, about its median, that reflections may explain: half of the ranges by 60 cm."""

NAMED: Final = 6
TOLERANCE_M: Final = 0.04
"""What lever arms by a ruler and phase centres of antennas do to a pair: 2 cm at either end."""

CURVE_M: Final = 0.2
"""How far the bias by power of a pair may lie from another's (published curves span so much); told from the pair's own
only where each pair's power varies."""

EXPLAINS: Final = 0.5
"""Share of the misfit that a pair must explain to be named."""

ALIKE: Final = 0.9
MOST: Final = 3


@dataclass(frozen=True, slots=True)
class OpenPair:
    """Pairs of which one is off by a constant, by how many metres, and the p-value of that."""

    pairs: tuple[int, ...]
    offset_m: float
    p_value: float


def closures(view: RecordingView) -> Iterator[Candidate]:
    """Pairs whose level the delays of their tags do not explain, with the worst closure around four tags."""
    known = levels(view)
    if known is None:
        return
    for one in open_pairs(known, TOLERANCE_M + (CURVE_M if standing_still(view) is not None else 0.0)):
        names, way = " or ".join(known.named(pair) for pair in one.pairs), "long" if one.offset_m > 0 else "short"
        yield Candidate(
            OPEN,
            f"ranges of pair {names} are {100 * abs(one.offset_m):.1f} cm too {way} for "
            f"the delays of their tags{_around(known, one.pairs[0])}",
            one.p_value,
        )


def astray(view: RecordingView) -> Iterator[Candidate]:
    """Pairs whose ranges and true distances have little to do with each other."""
    known = levels(view)
    if known is None:
        return
    told, least = [], 1.0
    for pair in range(len(known.level)):
        rest = np.minimum(np.abs(known.rest[known.pair == pair]), 10 * LOUD_M)
        means = np.array([float(np.mean(rest[s])) for s in stretches(len(rest))])
        p_value = positive(means - LOUD_M, tried=len(known.level))
        if p_value < BUDGET:
            told.append(f"{known.named(pair)} by {np.mean(means):.2f} m")
            least = min(least, p_value)
    if told:
        more = f" and {len(told) - NAMED} pairs more" if len(told) > NAMED else ""
        yield Candidate(
            ASTRAY,
            f"ranges of pairs {', '.join(told[:NAMED])}{more} differ on average, each pair's median aside",
            least,
        )


def open_pairs(known: Levels, tolerance_m: float = TOLERANCE_M) -> list[OpenPair]:
    """Return pairs that are off, the surest first, each beside those found before."""
    tags, place = np.unique(known.ends, return_inverse=True)
    place = place.reshape(known.ends.shape)
    count = len(known.level)
    design = np.zeros((count, len(tags)))
    design[np.arange(count), place[:, 0]] += 1
    design[np.arange(count), place[:, 1]] += 1
    if count <= np.linalg.matrix_rank(design):
        return []
    variance = known.variances(known.clipped) / np.bincount(known.pair)
    # Hardly a pair is known better than the least of many.
    variance = OF_MEDIAN * np.maximum(variance, 0.5 * np.median(variance))
    found, level, left = list[OpenPair](), known.level.copy(), design
    for _ in range(MOST):
        one = _worst(left, level, variance, tolerance_m)
        if one is None:
            break
        found.append(one)
        column = np.zeros((count, 1))
        column[one.pairs[0]] = 1
        left = np.hstack([left, column])
    return found


def _worst(design: Floats, level: Floats, variance: Floats, tolerance_m: float) -> OpenPair | None:
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
    std = float(1 / (root[top] * np.sqrt(free[top])))
    p_value = exceeds(offset, std, DOF, tolerance=tolerance_m, tried=len(level))
    if p_value == 1 or deviation[top] ** 2 < EXPLAINS * misfit:
        return None
    close = np.flatnonzero(np.abs(deviation) > ALIKE * abs(deviation[top]))
    order = [top, *(int(k) for k in close if k != top)]
    return OpenPair(tuple(order), offset, p_value)


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
