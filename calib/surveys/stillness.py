"""When boards stood still: stretches found from the ranges alone, and boards that were moved within one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.data.ranges import Ranges
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints

BIN_S: Final = 1.0
WINDOW: Final = 5
"""Bins before and after an instant whose medians are compared."""

STEP_M: Final = 0.05
"""Smallest step of a pair's range that counts as a motion; people who walk past change less, or one pair only."""

SIGMAS: Final = 6.0
MOVED_M: Final = 0.03
"""Smallest change of a pair's range that tells of a board that was moved within an arrangement."""

SPLITS: Final = 20
FEWEST_A_SIDE: Final = 8

SHORTEST_S: Final = 15.0
"""Shorter stretches between two motions are part of the motion."""


@dataclass(frozen=True, slots=True)
class Binned:
    """Medians of the ranges of pairs (p) in bins of time (b): `median_m` (p, b), NaN where a pair was silent.

    Bins begin at `begin_ns` (b,); those in which nobody ranged are not there.
    """

    begin_ns: Ints
    bin_ns: int
    pairs: tuple[tuple[int, int], ...]
    median_m: Floats
    std_m: Floats


@dataclass(frozen=True, slots=True)
class Motion:
    """A board that was moved: when, and by how much its ranges changed, by the other board."""

    tag: int
    time_ns: int
    steps_m: dict[int, float]


def binned(ranges: Ranges, bin_s: float = BIN_S) -> Binned:
    """Return medians by pair and bin; `std_m` (p,) is the spread of a pair's medians from one bin to the next."""
    low, high = np.minimum(ranges.initiator, ranges.target), np.maximum(ranges.initiator, ranges.target)
    pairs, pair = np.unique(np.column_stack([low, high]), axis=0, return_inverse=True)
    start, bin_ns = int(ranges.time_ns.min()), int(bin_s * 1e9)
    at = (ranges.time_ns - start) // bin_ns
    count = int(at.max()) + 1
    median = np.full((len(pairs), count), np.nan)
    order = np.lexsort((ranges.raw_m, at, pair))
    key = (pair * count + at)[order]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    ends = np.append(starts[1:], len(key))
    sorted_m = ranges.raw_m[order]
    median.ravel()[key[starts]] = (sorted_m[(starts + ends - 1) // 2] + sorted_m[(starts + ends) // 2]) / 2
    median = median[:, used := np.flatnonzero(np.isfinite(median).any(axis=0))]
    noise = np.array([_noise(row) for row in median])
    return Binned(start + bin_ns * used, bin_ns, tuple((i, j) for i, j in pairs.tolist()), median, noise)


def _noise(row: Floats) -> float:
    """Return the spread of a pair's medians, from differences of neighbours, which steps do not widen."""
    known = row[np.isfinite(row)]
    return robust_spread(np.diff(known), 0.0) / np.sqrt(2) if len(known) > 2 else 0.0


def steps(found: Binned, window: int = WINDOW) -> Floats:
    """Return the step (p, b + 1) of each pair at each edge: median after less median before; NaN where too few."""
    padded = np.pad(found.median_m, ((0, 0), (window, window)), constant_values=np.nan)
    windows = np.sort(np.lib.stride_tricks.sliding_window_view(padded, window, axis=1), axis=2)
    count = np.isfinite(windows).sum(axis=2, keepdims=True)
    # Missing values are sorted to the end, so the middle ones of those that are there are known.
    middle = [np.take_along_axis(windows, np.maximum((count - 1 + k) // 2, 0), axis=2)[:, :, 0] for k in (0, 1)]
    median = (middle[0] + middle[1]) / 2
    return np.asarray(median[:, window:] - median[:, :-window])


def threshold(found: Binned, window: int = WINDOW) -> Floats:
    """Return the step (p,) from which a pair's range changed by more than noise."""
    return np.asarray(np.maximum(STEP_M, SIGMAS * found.std_m * np.sqrt(2 / window)))


def stretches_ns(ranges: Ranges) -> list[tuple[int, int]]:
    """Return the stretches of time, (start, end) each, in which no board was moved.

    A motion is where two pairs' ranges step together (or the only pair's does). Whatever lies within a window of one,
    or between two less than 15 s apart, belongs to none.
    """
    if not len(ranges):
        return []
    found = binned(ranges)
    size = np.abs(steps(found)) > threshold(found)[:, None]
    moving = size.sum(axis=0) >= min(2, len(found.pairs))
    # An edge that sees a step within its window is not the step itself: only a bin that stands free of all is still.
    still = ~(moving[:-1] | moving[1:])
    return [(a, b) for a, b in _runs(still, found) if b - a >= SHORTEST_S * 1e9]


def _runs(still: Bools, found: Binned) -> list[tuple[int, int]]:
    padded = np.concatenate([[False], still, [False]]).astype(np.int8)
    change = np.diff(padded)
    starts, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
    begin = found.begin_ns
    return [(int(begin[a]), int(begin[b - 1]) + found.bin_ns) for a, b in zip(starts, ends, strict=True)]


def moved(ranges: Ranges) -> Motion | None:
    """Return the board that was moved within a stretch that should be still, None where there is none.

    A motion is an instant after which two of a board's pairs range otherwise, by more than noise and by 3 cm: a single
    pair does so when somebody walks by. The board most of whose pairs change, and most, is named.
    """
    pairs, series = _series(ranges)
    tags = sorted({tag for pair in pairs for tag in pair})
    if len(pairs) < 2:
        return None
    start, end = int(ranges.time_ns.min()), int(ranges.time_ns.max())
    best: tuple[float, Motion] | None = None
    for at in np.linspace(start, end, SPLITS + 2)[1:-1]:
        change = [_change(*one, at) for one in series]
        for tag in tags:
            mine = {
                sum(p) - tag: step for p, (step, size) in zip(pairs, change, strict=True) if tag in p and size > SIGMAS
            }
            mass = sum(
                min(size, 50.0) for p, (_, size) in zip(pairs, change, strict=True) if tag in p and size > SIGMAS
            )
            if len(mine) >= min(2, len(tags) - 1) and (best is None or mass > best[0]):
                best = mass, Motion(tag, int(at), mine)
    return best[1] if best else None


def _series(ranges: Ranges) -> tuple[list[tuple[int, int]], list[tuple[Floats, Floats, float]]]:
    low, high = np.minimum(ranges.initiator, ranges.target), np.maximum(ranges.initiator, ranges.target)
    pairs, number = np.unique(np.column_stack([low, high]), axis=0, return_inverse=True)
    rows = [np.flatnonzero(number == k) for k in range(len(pairs))]
    noise = [max(_noise(ranges.raw_m[r]), 0.005) for r in rows]
    series = [(ranges.time_ns[r].astype(float), ranges.raw_m[r], n) for r, n in zip(rows, noise, strict=True)]
    return [(i, j) for i, j in pairs.tolist()], series


def _change(time: Floats, raw: Floats, noise: float, at: float) -> tuple[float, float]:
    """Return by how much a pair's median changes at an instant, and that over what noise makes of it; 0 if too few."""
    before, after = raw[time < at], raw[time >= at]
    if min(len(before), len(after)) < FEWEST_A_SIDE:
        return 0.0, 0.0
    step = float(np.median(after) - np.median(before))
    size = abs(step) / (1.25 * noise * np.sqrt(1 / len(before) + 1 / len(after)))
    return step, float(size) if abs(step) > MOVED_M else 0.0
