"""True distances between tags, from the poses of their bodies and their lever arms."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uwblink.schema import Poses, Tag

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def distances_m(poses: Poses, tags: list[Tag], initiator: Ints, target: Ints, time_ns: Ints) -> Floats:
    """Distance between two tags' antennas at given times, shape (n,), in metres.

    Positions are interpolated linearly between poses, attitudes along the chord of their
    quaternions. NaN where a tag has no lever arm, its body no poses, or the time lies outside them;
    a body with a single pose does not move.
    """
    tracks = {str(body): _Track(poses, body) for body in np.unique(poses.body)}
    apart = _antennas(tracks, tags, target, time_ns) - _antennas(tracks, tags, initiator, time_ns)
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", apart, apart)))


def antennas_m(poses: Poses, tags: list[Tag], ids: Ints, time_ns: Ints) -> Floats:
    """Return where the antennas of tags `ids` (n,) are at given times, shape (n, 3); NaN as for `distances_m`."""
    return _antennas({str(body): _Track(poses, body) for body in np.unique(poses.body)}, tags, ids, time_ns)


def bodies_m(poses: Poses, body: str, time_ns: Ints) -> Floats:
    """Return where a body is at given times (n,), shape (n, 3); NaN outside its poses."""
    return _Track(poses, body).point_m(time_ns, np.zeros(3))


def _antennas(tracks: dict[str, _Track], tags: list[Tag], ids: Ints, time_ns: Ints) -> Floats:
    found = np.full((len(time_ns), 3), np.nan)
    for tag in tags:
        rows = np.flatnonzero(ids == tag.tag)
        if len(rows) and tag.body in tracks:
            found[rows] = tracks[tag.body].point_m(time_ns[rows], np.array(tag.lever_arm_m))
    return found


class _Track:
    """One body's poses in order of time."""

    def __init__(self, poses: Poses, body: str) -> None:
        rows = poses.body == body
        self._time = poses.time_ns[rows].astype(np.float64)
        norm = np.linalg.norm(poses.quaternion[rows], axis=1, keepdims=True)
        quaternion = poses.quaternion[rows] / np.where(norm == 0, np.nan, norm)
        # q and -q are one attitude: neighbours take the nearer of the two signs.
        turn = np.einsum("ij,ij->i", quaternion[1:], quaternion[:-1])
        flips = np.concatenate([[1.0], np.cumprod(np.where(turn < 0, -1.0, 1.0))])
        self._values = np.column_stack([poses.position_m[rows], quaternion * flips[:, None]])

    def point_m(self, time_ns: Ints, lever_arm_m: Floats) -> Floats:
        """Where a point of the body is, shape (n, 3)."""
        if len(self._time) == 1:
            state = np.broadcast_to(self._values[0], (len(time_ns), 7))
        else:
            time = time_ns.astype(np.float64)
            known = self._values.T
            state = np.column_stack([np.interp(time, self._time, v, left=np.nan, right=np.nan) for v in known])
        return np.asarray(state[:, :3] + _rotate(state[:, 3:], lever_arm_m))


def _rotate(quaternion: Floats, vector: Floats) -> Floats:
    """Rotate one vector (3,) by unit quaternions x y z w (n, 4) that need not be exactly unit."""
    length = np.sqrt(np.einsum("ij,ij->i", quaternion, quaternion))
    axis, w = (quaternion[:, :3].T / length).T, quaternion[:, 3] / length
    twice = 2 * np.cross(axis, vector)
    return np.asarray(vector + w[:, None] * twice + np.cross(axis, twice))
