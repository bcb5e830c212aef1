"""True distances between tags, from the poses of their bodies and their lever arms."""

from __future__ import annotations

from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.recording.schema import Poses, Tag

ROWS_AT_ONCE: Final = 16_384
"""Ranges worked on together, so that what leads to their distances stays in the cache."""


def distances_m(poses: Poses, tags: list[Tag], initiator: Ints, target: Ints, time_ns: Ints) -> Floats:
    """Distance between two tags' antennas at given times, shape (n,), in metres.

    Positions are interpolated linearly between poses, attitudes along the chord of their
    quaternions. NaN where a tag has no lever arm, its body no poses, or the time lies outside them;
    a body with a single pose does not move.
    """
    tracks, found = _tracks(poses, tags), np.empty(len(time_ns))
    for begin in range(0, len(time_ns), ROWS_AT_ONCE):
        rows = slice(begin, begin + ROWS_AT_ONCE)
        ends = (_antennas(tracks, tags, ids[rows], time_ns[rows]) for ids in (target, initiator))
        apart = next(ends) - next(ends)
        found[rows] = np.sqrt(np.einsum("ij,ij->i", apart, apart))
    return found


def antennas_m(poses: Poses, tags: list[Tag], ids: Ints, time_ns: Ints) -> Floats:
    """Return where the antennas of tags `ids` (n,) are at given times, shape (n, 3); NaN as for `distances_m`."""
    return _antennas(_tracks(poses, tags), tags, ids, time_ns)


def bodies_m(poses: Poses, body: str, time_ns: Ints) -> Floats:
    """Return where a body is at given times (n,), shape (n, 3); NaN outside its poses."""
    return _Track(poses, np.flatnonzero(poses.body == body)).point_m(time_ns, np.zeros(3))


def _antennas(tracks: dict[str, _Track], tags: list[Tag], ids: Ints, time_ns: Ints) -> Floats:
    found = np.full((len(time_ns), 3), np.nan)
    for tag in tags:
        rows = np.flatnonzero(ids == tag.tag)
        if len(rows) and tag.body in tracks:
            found[rows] = tracks[tag.body].point_m(time_ns[rows], np.array(tag.lever_arm_m))
    return found


def _tracks(poses: Poses, tags: list[Tag]) -> dict[str, _Track]:
    """Return the tracks of the bodies that carry tags and have poses."""
    rows = {body: np.flatnonzero(poses.body == body) for body in sorted({tag.body for tag in tags})}
    return {body: _Track(poses, found) for body, found in rows.items() if len(found)}


class _Track:
    """One body's poses, of some rows, in order of time."""

    def __init__(self, poses: Poses, rows: Ints) -> None:
        # Poses of one body are mostly in one piece of the table, and then need no copy.
        piece = slice(rows[0], rows[-1] + 1) if rows[-1] - rows[0] + 1 == len(rows) else rows
        self._time = poses.time_ns[piece].astype(np.float64)
        self._position = poses.position_m[piece]
        self._quaternion = poses.quaternion[piece]

    def point_m(self, time_ns: Ints, lever_arm_m: Floats) -> Floats:
        """Where a point of the body is, shape (n, 3)."""
        if len(self._time) == 1:
            quaternion = np.broadcast_to(self._quaternion[0], (len(time_ns), 4))
            return np.asarray(self._position[0] + _rotate(quaternion, lever_arm_m))
        time = time_ns.astype(np.float64)
        after = np.clip(np.searchsorted(self._time, time, side="right"), 1, len(self._time) - 1)
        before = after - 1
        span = self._time[after] - self._time[before]
        share = (time - self._time[before]) / np.where(span > 0, span, 1.0)
        share[(time < self._time[0]) | (time > self._time[-1])] = np.nan
        first, second = self._quaternion[before], self._quaternion[after]
        # q and -q are one attitude: of the later one the sign is taken that is nearer to the earlier one.
        norms = np.einsum("ij,ij->i", first, first), np.einsum("ij,ij->i", second, second)
        weight = share * np.sqrt(norms[0] / np.where(norms[1] == 0, np.nan, norms[1]))
        weight = np.copysign(weight, np.einsum("ij,ij->i", first, second))
        chord = (1 - share)[:, None] * first + weight[:, None] * second
        place = self._position[before] + share[:, None] * (self._position[after] - self._position[before])
        return np.asarray(place + _rotate(chord, lever_arm_m))


def _rotate(quaternion: Floats, vector: Floats) -> Floats:
    """Rotate one vector (3,) by quaternions x y z w (n, 4) of any length but zero.

    v + (2 w (q x v) + 2 q x (q x v)) / |q|^2, with the double product written out as q (q.v) - v |q|^2 for the axis q.
    """
    axis, w = quaternion[:, :3], quaternion[:, 3]
    length = np.einsum("ij,ij->i", axis, axis)
    whole = length + w * w
    whole = np.where(whole == 0, np.nan, whole)
    x, y, z = axis.T
    turned = np.column_stack(
        [y * vector[2] - z * vector[1], z * vector[0] - x * vector[2], x * vector[1] - y * vector[0]]
    )
    along = axis @ vector
    return np.asarray(
        (2 * w / whole)[:, None] * turned
        + (2 * along / whole)[:, None] * axis
        + (1 - 2 * length / whole)[:, None] * vector
    )
