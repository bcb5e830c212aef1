"""True distances between tags, from the poses of their bodies and their lever arms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.recording.schema import Poses, Tag
from uwblink.recording.tracks import Tracks, tracks_of

ROWS_AT_ONCE: Final = 32_768
"""Ranges worked on together, so that what leads to their distances stays in the cache."""


def distances_m(poses: Poses | Tracks, tags: Sequence[Tag], initiator: Ints, target: Ints, time_ns: Ints) -> Floats:
    """Distance between two tags' antennas at given times, shape (n,), in metres.

    Positions are interpolated linearly between poses, attitudes along the chord of their
    quaternions. NaN where a tag has no lever arm, its body no poses, or the time lies outside them;
    a body with a single pose does not move.
    """
    tracks = tracks_of(poses, tags) if isinstance(poses, Poses) else poses
    found = np.empty(len(time_ns))
    for begin in range(0, len(time_ns), ROWS_AT_ONCE):
        rows = slice(begin, begin + ROWS_AT_ONCE)
        (x, y, z), other = (_antennas(tracks, tags, ids[rows], time_ns[rows]) for ids in (target, initiator))
        x -= other[0]
        y -= other[1]
        z -= other[2]
        found[rows] = np.sqrt(x * x + y * y + z * z)
    return found


def antennas_m(poses: Poses, tags: Sequence[Tag], ids: Ints, time_ns: Ints) -> Floats:
    """Return where the antennas of tags `ids` (n,) are at given times, shape (n, 3); NaN as for `distances_m`."""
    return np.ascontiguousarray(_antennas(tracks_of(poses, tags), tags, ids, time_ns).T)


def bodies_m(poses: Poses, body: str, time_ns: Ints) -> Floats:
    """Return where a body is at given times (n,), shape (n, 3); NaN outside its poses."""
    (track,) = tracks_of(poses, [Tag(0, body, (0.0, 0.0, 0.0))]).values()
    return np.column_stack(track.point_m(time_ns, np.zeros(3)))


def _antennas(tracks: Tracks, tags: Sequence[Tag], ids: Ints, time_ns: Ints) -> Floats:
    """Return where antennas are, (3, n)."""
    found = np.full((3, len(time_ns)), np.nan)
    for tag in tags:
        rows = np.flatnonzero(ids == tag.tag)
        if len(rows) and tag.body in tracks:
            point = tracks[tag.body].point_m(time_ns[rows], np.array(tag.lever_arm_m, dtype=np.float64))
            for axis in range(3):
                found[axis, rows] = point[axis]
    return found
