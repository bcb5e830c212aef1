"""Where points of bodies are between their poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.recording.schema import Poses, Tag

POSE: Final = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""What a pose is beside its time, in the order of a track's columns."""


class Track:
    """One body's poses in order of time: the columns of `POSE` (7, n) at times (n,) in ns."""

    def __init__(self, time_ns: Ints, columns: Sequence[Floats]) -> None:
        """Take columns in any order of time."""
        if np.any(time_ns[1:] < time_ns[:-1]):
            order = np.argsort(time_ns, kind="stable")
            time_ns, columns = time_ns[order], [column[order] for column in columns]
        self._time = time_ns.astype(np.float64)
        self._columns = columns

    def point_m(self, time_ns: Ints, lever_arm_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Return where a point of the body is at some times (n,): x, y and z, NaN outside its poses.

        Positions are interpolated linearly, attitudes along the chord of their quaternions; a body with a single pose
        does not move.
        """
        if len(self._time) == 1:
            x, y, z, *chord = (np.broadcast_to(column[0], len(time_ns)) for column in self._columns)
            turned = _rotated(chord, lever_arm_m)
            return x + turned[0], y + turned[1], z + turned[2]
        time = time_ns.astype(np.float64)
        after = np.clip(np.searchsorted(self._time, time, side="right"), 1, len(self._time) - 1)
        before = after - 1
        start = self._time[before]
        span = self._time[after] - start
        share = (time - start) / np.where(span > 0, span, 1.0)
        share[(time < self._time[0]) | (time > self._time[-1])] = np.nan
        first, second = ([column[rows] for column in self._columns] for rows in (before, after))
        turned = _rotated(_chord(first[3:], second[3:], share), lever_arm_m)
        x, y, z = (
            one + share * (other - one) + arm for one, other, arm in zip(first[:3], second[:3], turned, strict=True)
        )
        return x, y, z


Tracks = dict[str, Track]
"""The tracks of bodies that have poses."""


def tracks_of(poses: Poses, tags: Sequence[Tag]) -> Tracks:
    """Return the tracks of the bodies that carry tags and have poses."""
    found = {}
    for body in sorted({tag.body for tag in tags}):
        rows = np.flatnonzero(poses.body == body)
        if len(rows):
            # Poses of one body are mostly in one piece of the table, and then need no list of them.
            some = slice(rows[0], rows[-1] + 1) if rows[-1] - rows[0] + 1 == len(rows) else rows
            columns = (*poses.position_m.T, *poses.quaternion.T)
            found[body] = Track(poses.time_ns[some], [np.ascontiguousarray(column[some]) for column in columns])
    return found


def _chord(first: Sequence[Floats], second: Sequence[Floats], share: Floats) -> list[Floats]:
    """Return quaternions (4, n) at a share of the way from the first to the second ones."""
    norms = _product(first, first), _product(second, second)
    weight = share * np.sqrt(norms[0] / np.where(norms[1] == 0, np.nan, norms[1]))
    # q and -q are one attitude: of the later one the sign is taken that is nearer to the earlier one.
    weight = np.copysign(weight, _product(first, second))
    left = 1 - share
    return [left * one + weight * other for one, other in zip(first, second, strict=True)]


def _product(one: Sequence[Floats], other: Sequence[Floats]) -> Floats:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2] + one[3] * other[3]


def _rotated(quaternion: Sequence[Floats], vector: Floats) -> tuple[Floats, Floats, Floats]:
    """Rotate one vector (3,) by quaternions x y z w (4, n) of any length but zero.

    v + (2 w (q x v) + 2 q x (q x v)) / |q|^2, with the double product written out as q (q.v) - v |q|^2 for the axis q.
    """
    x, y, z, w = quaternion
    a, b, c = vector.tolist()
    length = x * x + y * y + z * z
    whole = length + w * w
    inverse = 1 / np.where(whole == 0, np.nan, whole)
    turn, along, own = 2 * w * inverse, 2 * (a * x + b * y + c * z) * inverse, 1 - 2 * length * inverse
    return (
        turn * (y * c - z * b) + along * x + own * a,
        turn * (z * a - x * c) + along * y + own * b,
        turn * (x * b - y * a) + along * z + own * c,
    )
