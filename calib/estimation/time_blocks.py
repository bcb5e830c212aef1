"""Short blocks of the time that ranges cover: what sums over time are cut by, wherever a fit needs them.

Time counts only where there are ranges. Sessions are laid end to end, and gaps within a session are left out: nothing
of an error is measured in a gap, so a pause of hours must neither lengthen blocks nor count as time recorded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.data.ranges import Ranges
from calib.long_columns import let_go
from uwblink.arrays import Bools, Floats, Ints

MOST_BLOCKS: Final = 1000
SHORTEST_S: Final = 0.1
FEWEST_BLOCKS: Final = 30
"""Blocks are no shorter than a tenth of a second, unless a recording has few: sums over fewer blocks than there are
delays and splines, some twenty, do not vary in all directions, and their covariance is too small."""

GAP_S: Final = 10.0
USUAL_STEPS: Final = 20
"""Ranges further apart than ten seconds, and than twenty usual steps, have a gap in between.

The errors that recordings show last for seconds (docs/accuracy.md); slow schedules, and pairs in turn, are no gaps.
"""

PIECE: Final = 0.75
"""Length of pieces over that of an average session, so that sessions of unlike lengths have pieces too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeBlocks:
    """Blocks of time: `number` (n,) is the block of each range, `bounds` (sessions + 1,) are the blocks of sessions.

    `seconds` is how much time the ranges cover.
    """

    number: Ints
    bounds: Ints
    seconds: float

    @property
    def count(self) -> int:
        """Return the number of blocks."""
        return int(self.bounds[-1])

    def among(self, rows: Bools | Ints | slice) -> TimeBlocks:
        """Return the blocks of some of the ranges (n,), numbered without those that are empty."""
        used, number = np.unique(self.number[rows], return_inverse=True)
        bounds = np.unique(np.searchsorted(used, self.bounds))
        return TimeBlocks(number=number.astype(np.int32), bounds=bounds, seconds=self.seconds)

    def pieces(self, series: Floats, spans: int = 1) -> Floats:
        """Return sums by block (blocks, k) as columns of pieces of equal length, less their means.

        There are about as many pieces as `spans`, and none of two sessions. A single piece is the series as it is.
        """
        sizes = np.diff(self.bounds)
        spans = min(spans, self.count)
        if len(sizes) == 1 and spans == 1:
            return series
        length = self.count // spans
        if len(sizes) > 1:
            length = max(int(PIECE * self.count / max(spans, len(sizes))), 1)
        starts = [
            first + length * k
            for first, size in zip(self.bounds[:-1].tolist(), sizes.tolist(), strict=True)
            for k in range(size // length)
        ]
        cut = np.array([series[first : first + length] for first in starts])
        return np.hstack(list(cut - cut.mean(axis=1, keepdims=True)))


def in_order(ranges: Ranges) -> Ranges:
    """Return ranges in order of their sessions, and of time within each."""
    time, session = ranges.time_ns, ranges.session
    later, same = session[1:] > session[:-1], session[1:] == session[:-1]
    if np.all(later | (same & (time[1:] >= time[:-1]))):
        return ranges
    return ranges[np.lexsort((time, session))]


def time_blocks(time_ns: Ints, session: Ints) -> TimeBlocks:
    """Cut the time that ranges (n,) cover into short blocks, a thousand or so.

    Ranges are in order of their sessions, and of time within each. A block ends where a session or a gap does.
    """
    steps = np.diff(time_ns, prepend=time_ns[:1])
    changed = np.diff(session, prepend=session[:1]) != 0
    let_go(time_ns, session)
    cut = changed | (steps > max(GAP_S * 1e9, USUAL_STEPS * float(np.median(steps))))
    steps[cut] = 0
    elapsed = np.cumsum(steps)
    whole = int(elapsed[-1])
    length = max(whole // MOST_BLOCKS, min(int(SHORTEST_S * 1e9), whole // FEWEST_BLOCKS), 1)
    cut[1:] |= np.diff(elapsed // length) > 0
    number: Ints = np.asarray(np.cumsum(cut), dtype=np.int32)
    first = np.concatenate([[0], np.flatnonzero(changed)])
    bounds = np.append(number[first], number[-1] + 1).astype(np.int64)
    return TimeBlocks(number=number, bounds=bounds, seconds=float(elapsed[-1]) * 1e-9)
