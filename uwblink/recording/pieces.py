"""A recording in pieces of time, for those who go through it from beginning to end and need no more at once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats
from uwblink.recording.contents import Contents
from uwblink.recording.distances import distances_m
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses
from uwblink.twr import Exchanges, middle_ns

ROWS_AT_ONCE: Final = 50_000
"""Rows of a table that a piece has, about."""

READING_MB: Final = 300
"""Of a file that is read in pieces so much is kept in memory."""

TIMED: Final = ("exchanges", "poses", "imu", "height", "temperature", "corrected", "faults")
ENDS: Final = ("time_ns", "initiator", "target")
"""By which rows of `corrected` are those of `exchanges`."""

_SOONEST, _LATEST = -(2**62), 2**62


def pieces(recording: Recording, rows: int = ROWS_AT_ONCE) -> Iterator[Contents]:
    """Yield what has a time, piece by piece: what comes later is in a later piece, whichever table it is in.

    Bytes, impulse responses and total powers are left out, and so is `corrected` where it is not that of the exchanges,
    row by row.
    """
    fitting = _fits(recording)
    for start_ns, end_ns in _spans(recording, rows):
        yield Contents(
            exchanges=recording.exchanges_between(start_ns, end_ns),
            poses=recording.poses(start_ns, end_ns),
            imu=recording.imu(start_ns, end_ns),
            height=recording.heights(start_ns, end_ns),
            temperature=recording.temperatures(start_ns, end_ns),
            corrected=recording.corrected(start_ns, end_ns) if fitting else {},
            faults=recording.faults(start_ns, end_ns),
        )


def _spans(recording: Recording, rows: int) -> list[tuple[int, int]]:
    edges = {_SOONEST, _LATEST}
    for table in TIMED:
        edges |= set(recording.some_times(table, rows)[1:].tolist())
    return list(pairwise(sorted(edges)))


def _fits(recording: Recording) -> bool:
    """Return whether the table `corrected` is that of the exchanges, row by row."""
    count = recording.count("corrected")
    if not count or count != recording.count("exchanges"):
        return False
    blocks = zip(recording.column_blocks("exchanges", ENDS), recording.column_blocks("corrected", ENDS), strict=True)
    return all(_equal(one, other) for one, other in blocks)


def _equal(one: dict[str, NDArray[Any]], other: dict[str, NDArray[Any]]) -> bool:
    return all(np.array_equal(one[name], other[name]) for name in ENDS)


def distances_by_poses_m(recording: Recording, blocks: Iterable[Exchanges]) -> Iterator[Floats]:
    """Yield the distances (n,) at which the antennas of each block of exchanges were by the poses; NaN without poses.

    A distance is that in the middle of the first two messages, to which a range belongs.
    """
    windows, tags = recording.pose_windows(), recording.tags()
    for exchanges in blocks:
        parts = (
            distances_m(tracks, tags, some.initiator, some.target, middle_ns(some))
            for some, tracks in windows.tracks_beside(exchanges)
        )
        yield np.concatenate([np.empty(0), *parts])


def exchanges_with_poses(recording: Recording) -> Iterator[tuple[Exchanges, Poses]]:
    """Yield all exchanges in the order of their rows, some at a time, and the poses between which they are.

    Distances at the exchanges' times, and at the middles of their messages, are what they are with all poses.
    """
    windows = recording.pose_windows()
    for block in recording.exchange_blocks():
        yield from windows.beside(block)
