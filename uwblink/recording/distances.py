"""True distances between tags, from poses of bodies and lever arms, and the clock offset of poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from uwblink.arrays import Bools, Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.recording.schema import Poses, Tag
from uwblink.twr import Exchanges, names_in, raw_range


class PoseTrack:
    """The poses of a body in order of time: the columns of `POSE` (7, n) at times (n,) in ns."""

    def __init__(self, time_ns: Ints, columns: Sequence[Floats] | Floats) -> None:
        """Sort the columns, which may have any order of time."""
        order = np.argsort(time_ns, kind="stable")
        self.time_ns, self.columns = time_ns[order], np.array([column[order] for column in columns])
        quaternion = self.columns[3:]
        # q and -q are the same attitude: choose signs so that each quaternion is near the previous one.
        apart = np.sum(quaternion[:, 1:] * quaternion[:, :-1], axis=0) < 0
        quaternion[:, 1:] *= np.cumprod(np.where(apart, -1.0, 1.0))
        self.columns[:, ~quaternion.any(axis=0)] = np.nan
        self._time, self._columns = self.time_ns.astype(np.float64), self.columns
        if len(order) > 2 and not np.ptp(self.columns[:3], axis=1).max() <= 0.02:
            # Motion capture that loses a body leaves a gap. In half a second, robots change their course, so a gap is
            # not interpolated: insert NaN after its start.
            lost = np.flatnonzero((steps := np.diff(self._time)) > max(0.5e9, 10 * np.median(steps))) + 1
            # 1 us later, because float64 resolves times since 1970 to 0.3 us.
            self._time, self._columns = (
                np.insert(self._time, lost, self._time[lost - 1] + 1000),
                np.insert(self.columns, lost, np.nan, axis=1),
            )

    def point_m(self, time_ns: Ints, lever_arm_m: Floats) -> Floats:
        """Return the position (3, n) of a point of the body in metres at times (n,), NaN outside the poses.

        Positions are interpolated linearly, attitudes along the chord of their quaternions; a body with a single pose
        does not move. If the body moves, gaps of more than half a second and ten times the usual step are NaN, too.
        """
        place, attitude, known = self._at(time_ns)
        return np.where(known, place + attitude.apply(lever_arm_m).T, np.nan)

    def into_body(self, time_ns: Ints, vector: Floats) -> Floats:
        """Return vectors (n, 3) of the world frame in the frame of the body at times (n,), NaN outside its poses."""
        _, attitude, known = self._at(time_ns)
        return np.where(known[:, None], attitude.apply(vector, inverse=True), np.nan)

    def turn_rad(self) -> float:
        """Return the largest angle between the first known attitude and another, in radians; 0 without any."""
        known = self.columns[3:, np.isfinite(self.columns[3:]).all(axis=0)]
        if not known.shape[1]:
            return 0.0
        unit = known / np.linalg.norm(known, axis=0)
        return float(2 * np.arccos(np.clip(np.abs(unit[:, 0] @ unit).min(), 0, 1)))

    def _at(self, time_ns: Ints) -> tuple[Floats, Rotation, Bools]:
        """Return positions (3, n) and attitudes (n,) at times (n,), and a mask (n,) of those that are known."""
        time, outside = time_ns.astype(np.float64), None if len(self._time) == 1 else np.nan
        found = np.array([np.interp(time, self._time, column, outside, outside) for column in self._columns])
        known = np.isfinite(found).all(axis=0)
        return found[:3], Rotation.from_quat(np.where(known, found[3:], 1.0).T), known


Tracks = dict[str, PoseTrack]
"""Tracks by the name of the body."""


def tracks_of(poses: Poses) -> Tracks:
    """Return the tracks of all bodies with poses."""
    columns = np.vstack([poses.position_m.T, poses.quaternion.T])
    rows = {body: poses.body == body for body in names_in(poses.body)}
    return {body: PoseTrack(poses.time_ns[some], columns[:, some]) for body, some in rows.items()}


def poses_around(tracks: Tracks, start_ns: int, end_ns: int) -> Poses:
    """Return the poses from `start_ns` to `end_ns`, and the next two of each body on either side, in order of time.

    Interpolation within the span gives the same as with all poses. Bodies whose poses are all before or after the span
    are left out; a single pose of a body is always included.
    """
    parts = [Poses.from_arrays([], "", (0.0, 0.0, 0.0))]
    for body, track in tracks.items():
        time, columns = track.time_ns, track.columns.T
        low = max(int(np.searchsorted(time, start_ns, side="right")) - 1, 0)
        high = int(np.searchsorted(time, end_ns, side="left")) + 1
        if len(time) == 1 or (time[0] <= end_ns and time[-1] >= start_ns):
            some = slice(max(low - 1, 0), high + 1)
            parts.append(Poses(time[some], np.full(len(time[some]), body), columns[some, :3], columns[some, 3:]))
    return Poses.concatenate(parts).in_time_order()


def distances_m(poses: Poses | Tracks, tags: Sequence[Tag], initiator: Ints, target: Ints, time_ns: Ints) -> Floats:
    """Return the distances between the antennas of two tags at times (n,), shape (n,), in metres.

    Positions are interpolated linearly between poses, attitudes along the chord of their quaternions; a body with a
    single pose does not move. NaN for tags that are not in `tags`, for bodies without poses, and for times outside the
    poses.
    """
    here, there = (antennas_m(poses, tags, ids, time_ns) for ids in (target, initiator))
    x, y, z = (here - there).T
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def sights(
    poses: Poses | Tracks, tags: Sequence[Tag], initiator: Ints, target: Ints, time_ns: Ints
) -> tuple[Floats, Floats]:
    """Return distances (n,) as `distances_m` does, and unit vectors (n, 2, 3) from each antenna to the other.

    The vectors of the initiator come first; they are in the frames of the bodies, NaN if a distance or an attitude is
    unknown.
    """
    tracks = tracks_of(poses) if isinstance(poses, Poses) else poses
    here, there = (antennas_m(tracks, tags, ids, time_ns) for ids in (initiator, target))
    way = there - here
    x, y, z = way.T
    distance = np.sqrt(x * x + y * y + z * z)
    way = way / np.maximum(distance, 1e-9)[:, None]
    found = np.full((len(time_ns), 2, 3), np.nan)
    for tag in tags:
        for end, (ids, sign) in enumerate(((initiator, 1.0), (target, -1.0))):
            rows = np.flatnonzero(ids == tag.tag)
            if len(rows) and tag.body in tracks:
                found[rows, end] = tracks[tag.body].into_body(time_ns[rows], sign * way[rows])
    return np.asarray(distance), found


def antennas_m(poses: Poses | Tracks, tags: Sequence[Tag], ids: Ints, time_ns: Ints) -> Floats:
    """Return the positions (n, 3) of the antennas of tags `ids` (n,) at times (n,) in metres; NaN as `distances_m`."""
    tracks = tracks_of(poses) if isinstance(poses, Poses) else poses
    found = np.full((len(time_ns), 3), np.nan)
    for tag in tags:
        rows = np.flatnonzero(ids == tag.tag)
        if len(rows) and tag.body in tracks:
            found[rows] = tracks[tag.body].point_m(time_ns[rows], np.array(tag.lever_arm_m, dtype=np.float64)).T
    return found


def bodies_m(poses: Poses, body: str, time_ns: Ints) -> Floats:
    """Return the positions (n, 3) of a body at times (n,) in metres; NaN outside its poses."""
    return tracks_of(poses)[body].point_m(time_ns, np.zeros(3)).T


def find_offset(exchanges: Exchanges, poses: Poses, tags: list[Tag], within_s: float | None = None) -> int:
    """Return the offset in ns to add to the times of poses, from the clock of motion capture to that of the host.

    At the right offset, ranges of a pair differ from the true distances by a constant (antenna delays) and noise; at
    other offsets, motion adds to the differences. The offset with the smallest robust spread of the differences is
    found, among offsets at which the exchanges and the poses overlap by at least half of the shorter of both, and of at
    most `within_s` seconds. Raises `ImportTableError` if no offset has a clearly smaller spread than others.
    """
    # 4000 exchanges suffice, and limit the time of the search.
    some = exchanges[np.unique(np.linspace(0, len(exchanges) - 1, min(len(exchanges), 4000)).astype(np.int64))]
    ranges, pair, tracks = raw_range(some), some.initiator * 65_536 + some.target, tracks_of(poses)

    def loss(offset_ns: int, scale_m: float | None = None) -> float:
        """Return the mean Cauchy loss of ranges minus distances minus their median by pair; without a scale, the median
        absolute value.

        It is infinite if less than 40 % of the ranges have a distance.
        """
        error = ranges - distances_m(tracks, tags, some.initiator, some.target, some.time_ns - offset_ns)
        good = np.isfinite(error)
        if np.count_nonzero(good) < 0.4 * len(error):
            return np.inf
        rest = np.concatenate([v - np.median(v) for p in np.unique(pair) if len(v := error[good & (pair == p)])])
        return float(np.mean(np.log1p((rest / scale_m) ** 2)) if scale_m else np.median(np.abs(rest)))

    first, last = int(poses.time_ns.min()), int(poses.time_ns.max())
    begin, end = int(some.time_ns.min()), int(some.time_ns.max())
    overlap_ns = int(0.5 * min(end - begin, last - first))
    low, high = begin + overlap_ns - last, end - overlap_ns - first
    if within_s is not None:
        low, high = max(low, -int(within_s * 1e9)), min(high, int(within_s * 1e9))
    # Steps of 0.1 s, in which a motion of 1 m/s is 10 cm, or larger steps to limit the number to 5000.
    step = max(100_000_000, (high - low) // 5000)
    offsets = range(low, high + step, step)
    spreads = np.array([loss(o) for o in offsets])
    if not np.isfinite(spreads).any():
        raise ImportTableError(
            "no offset matches the poses to the exchanges; check that the file contains the bodies of the tags"
        )
    typical, best = float(np.median(spreads[np.isfinite(spreads)])), offsets[int(np.argmin(spreads))]
    # Then minimise the Cauchy loss, which is more efficient than the median: by finer grids, then by a parabola.
    scale_m = max(float(spreads.min()), 1e-6)  # above 0 for a single exchange and for exact ranges
    while step > 1_000_000:
        step //= 5
        best = min(range(best - 6 * step, best + 7 * step, step), key=lambda o: loss(o, scale_m))
    # Noise makes the loss rough on the scale of the last grid, so the parabola is fitted over 0.1 s to either side.
    beside = 20_000_000 * np.arange(-5, 6, dtype=np.int64)
    curve, slope, _ = np.polyfit(beside * 1e-9, [loss(best + int(o), scale_m) for o in beside], 2)
    best += round(float(np.clip(-slope / (2 * curve) if curve > 0 else 0.0, -0.1, 0.1)) * 1e9)
    found_m = loss(best)
    if found_m > 0.7 * typical:
        raise ImportTableError(
            f"the ranges do not determine the offset: their spread is {100 * found_m:.0f} cm at the best offset and "
            f"{100 * typical:.0f} cm at others; record bodies that move, or give `offset` in seconds"
        )
    return best
