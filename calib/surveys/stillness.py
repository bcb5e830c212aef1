"""When boards stood still: stretches found from the ranges alone, and boards that were moved within one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.data.ranges import Ranges
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints

WINDOW = 5
"""Bins of a second before and after an instant whose medians are compared."""

STEP_M = 0.05
"""Smallest step of a pair's range that counts as a motion: people who walk past change less, or one pair only."""

MOVED_M = 0.03
"""Smallest change of a pair's range that tells of a board that was moved within an arrangement."""

SIGMAS = 6.0
"""Standard deviations of noise from which a change is one: one in 5e8 by chance, and there are thousands."""

SHORTEST_S = 15.0
"""Shorter stretches between two motions are part of the motion."""


@dataclass(frozen=True, slots=True)
class Motion:
    """A board that was moved: when, and by how much its ranges changed, by the other board."""

    tag: int
    time_ns: int
    steps_m: dict[int, float]


def pair_numbers(ranges: Ranges) -> tuple[list[tuple[int, int]], Ints]:
    """Return the pairs of tags in ranges, the smaller first, and the number of the pair of each range (n,)."""
    ends = np.sort(np.column_stack([ranges.initiator, ranges.target]), axis=1)
    pairs, number = np.unique(ends, axis=0, return_inverse=True)
    return [(i, j) for i, j in pairs.tolist()], number.ravel()


def still_stretches(ranges: Ranges, bin_s: float = 1.0) -> list[tuple[int, int]]:
    """Return the stretches of time, (start, end) each in ns, in which no board was moved.

    A motion is where two pairs' ranges step together (or the only pair's does). Whatever lies within a window of one,
    or between two less than 15 s apart, belongs to none.
    """
    if not len(ranges):
        return []
    begin, bin_ns = int(ranges.time_ns.min()), int(bin_s * 1e9)
    number = pair_numbers(ranges)[1]
    bins, at = np.unique((ranges.time_ns - begin) // bin_ns, return_inverse=True)
    median = np.full((number.max() + 1, len(bins)), np.nan)
    key = number * len(bins) + at
    order = np.lexsort((ranges.raw_m, key))
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    ends = np.append(starts[1:], len(key))
    ordered = ranges.raw_m[order]
    median.ravel()[key[order][starts]] = (ordered[(starts + ends - 1) // 2] + ordered[(starts + ends) // 2]) / 2
    noise = np.array([_noise(row) for row in median])
    threshold = np.maximum(STEP_M, SIGMAS * noise * np.sqrt(2 / WINDOW))
    moving = (np.abs(_steps(median)) > threshold[:, None]).sum(axis=0) >= min(2, len(median))
    # An edge that sees a step within its window is not the step itself: only a bin that stands free of all is still.
    still = np.concatenate([[False], ~(moving[:-1] | moving[1:]), [False]]).astype(np.int8)
    first, last = np.flatnonzero(np.diff(still) == 1), np.flatnonzero(np.diff(still) == -1) - 1
    found = zip((begin + bin_ns * bins[first]).tolist(), (begin + bin_ns * (bins[last] + 1)).tolist(), strict=True)
    return [(a, b) for a, b in found if b - a >= SHORTEST_S * 1e9]


def _steps(median: Floats) -> Floats:
    """Return the step (p, b + 1) of each pair at each edge of bins: median after less median before, NaN at too few."""
    padded = np.pad(median, ((0, 0), (WINDOW, WINDOW)), constant_values=np.nan)
    windows = np.sort(np.lib.stride_tricks.sliding_window_view(padded, WINDOW, axis=1), axis=2)
    count = np.isfinite(windows).sum(axis=2, keepdims=True)
    # Missing values are sorted to the end, so the middle ones of those that are there are known.
    middle = [np.take_along_axis(windows, np.maximum((count - 1 + k) // 2, 0), axis=2)[:, :, 0] for k in (0, 1)]
    medians = (middle[0] + middle[1]) / 2
    return np.asarray(medians[:, WINDOW:] - medians[:, :-WINDOW])


def _noise(values: Floats) -> float:
    """Return the spread of values, from differences of neighbours, which steps do not widen."""
    known = values[np.isfinite(values)]
    return robust_spread(np.diff(known), 0.0) / np.sqrt(2) if len(known) > 2 else 0.0


def find_motion(ranges: Ranges, splits: int = 20, fewest: int = 8) -> Motion | None:
    """Return the board that was moved within a stretch that should be still, None where there is none.

    A motion is one of `splits` instants after which two of a board's pairs range otherwise, by more than noise and by
    3 cm: a single pair does so when somebody walks by. The board most of whose pairs change, and most, is named. Either
    side of an instant needs `fewest` ranges.
    """
    pairs, number = pair_numbers(ranges)
    tags = sorted({tag for pair in pairs for tag in pair})
    if len(pairs) < 2:
        return None
    series = [(ranges.time_ns[number == k], ranges.raw_m[number == k]) for k in range(len(pairs))]
    noise = [max(_noise(raw), 0.005) for _, raw in series]
    best: tuple[float, Motion | None] = 0.0, None
    for instant in np.linspace(ranges.time_ns.min(), ranges.time_ns.max(), splits + 2)[1:-1].tolist():
        changed: dict[tuple[int, int], tuple[float, float]] = {}
        for pair, (time, raw), own in zip(pairs, series, noise, strict=True):
            before, after = raw[time < instant], raw[time >= instant]
            if min(len(before), len(after)) < fewest:
                continue
            step = float(np.median(after) - np.median(before))
            size = abs(step) / (1.25 * own * np.sqrt(1 / len(before) + 1 / len(after)))
            if abs(step) > MOVED_M and size > SIGMAS:
                changed[pair] = step, min(float(size), 50.0)
        for tag in tags:
            mine = {sum(pair) - tag: found for pair, found in changed.items() if tag in pair}
            total = sum(size for _, size in mine.values())
            if len(mine) >= min(2, len(tags) - 1) and total > best[0]:
                best = total, Motion(tag, int(instant), {other: step for other, (step, _) in mine.items()})
    return best[1]
