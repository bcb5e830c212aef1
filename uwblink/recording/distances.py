"""True distances between tags, from the poses of their bodies and their lever arms; and the clock of those poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.recording.schema import POSE, Poses, Tag
from uwblink.twr import Exchanges, raw_range


class Track:
    """One body's poses in order of time: the columns of `POSE` (7, n) at times (n,) in ns."""

    def __init__(self, time_ns: Ints, columns: Sequence[Floats]) -> None:
        """Take columns in any order of time."""
        if np.any(time_ns[1:] < time_ns[:-1]):
            order = np.argsort(time_ns, kind="stable")
            time_ns, columns = time_ns[order], [column[order] for column in columns]
        self.time_ns, self.columns = time_ns, columns
        self._time = time_ns.astype(np.float64)

    def point_m(self, time_ns: Ints, lever_arm_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Return where a point of the body is at some times (n,): x, y and z, NaN outside its poses.

        Positions are interpolated linearly, attitudes along the chord of their quaternions; a body with a single pose
        does not move.
        """
        if len(self._time) == 1:
            x, y, z, *chord = (np.broadcast_to(column[0], len(time_ns)) for column in self.columns)
            turned = _rotated(chord, lever_arm_m)
            return x + turned[0], y + turned[1], z + turned[2]
        time = time_ns.astype(np.float64)
        after = np.clip(np.searchsorted(self._time, time, side="right"), 1, len(self._time) - 1)
        before = after - 1
        start = self._time[before]
        span = self._time[after] - start
        share = (time - start) / np.where(span > 0, span, 1.0)
        share[(time < self._time[0]) | (time > self._time[-1])] = np.nan
        first, second = ([column[rows] for column in self.columns] for rows in (before, after))
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


class PoseWindows:
    """The poses of a recording by body: tracks for distances, and the poses around a stretch of time."""

    def __init__(self, poses: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
        """Take columns by body: `time_ns` and those of `POSE`, (n,) each."""
        self.tracks: Tracks = {
            body: Track(found["time_ns"], [found[name] for name in POSE]) for body, found in poses.items()
        }

    def tracks_beside(self, exchanges: Exchanges) -> Iterator[tuple[Exchanges, Tracks]]:
        """Yield exchanges and the tracks for their distances; nothing where there are no exchanges."""
        if len(exchanges):
            yield exchanges, self.tracks

    def around(self, start_ns: int, end_ns: int) -> Poses:
        """Return the poses from `start_ns` to `end_ns`, and each body's next ones on either side, in order of time.

        In between positions are those of all poses. Of a body that has no poses at these times there are none, of one
        that does not move there is its only one.
        """
        times, bodies, columns = [np.empty(0, np.int64)], [np.empty(0, np.str_)], [np.empty((0, len(POSE)))]
        for body, track in self.tracks.items():
            time = track.time_ns
            low = max(int(np.searchsorted(time, start_ns, side="right")) - 1, 0)
            high = int(np.searchsorted(time, end_ns, side="left")) + 1
            if len(time) == 1 or (time[0] <= end_ns and time[-1] >= start_ns):
                times.append(time[low:high])
                bodies.append(np.full(len(times[-1]), body))
                columns.append(np.column_stack([column[low:high] for column in track.columns]))
        time_ns, found = np.concatenate(times), np.concatenate(columns)
        return Poses(time_ns, np.concatenate(bodies), found[:, :3], found[:, 3:]).in_time_order()


def distances_m(poses: Poses | Tracks, tags: Sequence[Tag], initiator: Ints, target: Ints, time_ns: Ints) -> Floats:
    """Distance between two tags' antennas at given times, shape (n,), in metres.

    Positions are interpolated linearly between poses, attitudes along the chord of their
    quaternions. NaN where a tag has no lever arm, its body no poses, or the time lies outside them;
    a body with a single pose does not move.
    """
    tracks = tracks_of(poses, tags) if isinstance(poses, Poses) else poses
    found = np.empty(len(time_ns))
    # 32768 at once, so that intermediate results stay in the processor's cache.
    for begin in range(0, len(time_ns), 32_768):
        rows = slice(begin, begin + 32_768)
        here, there = (_antennas(tracks, tags, ids[rows], time_ns[rows]) for ids in (target, initiator))
        x, y, z = here - there
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
            found[:, rows] = point
    return found


@dataclass(frozen=True, slots=True)
class Alignment:
    """An offset to add to the poses' times, and the robust spread of the ranges there and elsewhere, metres."""

    offset_ns: int
    spread_m: float
    typical_m: float


def find_offset(exchanges: Exchanges, poses: Poses, tags: list[Tag], within_s: float | None = None) -> Alignment:
    """Find the offset between the clock of motion capture and that of the host, from the ranges themselves.

    Within a pair a range differs from the true distance by a constant (antenna delays) and noise, if the poses are at
    the right time; at a wrong time it also differs by motion. The offset with the least robust spread wins, among all
    at which at least half the exchanges lie within the poses, or those of at most `within_s` seconds. Raises
    `ImportTableError` where none stands out.
    """
    # 4000 exchanges tell an offset; more only take longer.
    rows = np.unique(np.linspace(0, len(exchanges) - 1, min(len(exchanges), 4000)).astype(np.int64))
    some = exchanges[rows]
    ranges, pair = raw_range(some), some.initiator * 65_536 + some.target
    tracks = tracks_of(poses, tags)

    def centred(offset_ns: int) -> Floats:
        """Return ranges less distances, less each pair's median; nothing where less than 40 % have a distance."""
        error = ranges - distances_m(tracks, tags, some.initiator, some.target, some.time_ns - offset_ns)
        good = np.isfinite(error)
        if np.count_nonzero(good) < 0.4 * len(error):
            return np.empty(0)
        return np.concatenate([v - np.median(v) for p in np.unique(pair) if len(v := error[good & (pair == p)])])

    def spread(offset_ns: int) -> float:
        found = centred(offset_ns)
        return float(np.median(np.abs(found))) if len(found) else float("nan")

    def loss(offset_ns: int) -> float:
        found = centred(offset_ns)
        return float(np.mean(np.log1p((found / scale_m) ** 2))) if len(found) else float("nan")

    first, last = int(poses.time_ns.min()), int(poses.time_ns.max())
    begin, end = int(some.time_ns.min()), int(some.time_ns.max())
    overlap_ns = int(0.5 * min(end - begin, last - first))
    low, high = begin + overlap_ns - last, end - overlap_ns - first
    if within_s is not None:
        low, high = max(low, -int(within_s * 1e9)), min(high, int(within_s * 1e9))
    # A grid of 0.1 s, in which motion of up to 1 m/s still shows, or a coarser one of 5000 points.
    step = max(100_000_000, (high - low) // 5000)
    offsets = np.arange(low, high + step, step, dtype=np.int64)
    spreads = np.array([spread(int(o)) for o in offsets])
    if not np.isfinite(spreads).any():
        raise ImportTableError("no offset puts the poses over the exchanges; are the bodies of the tags in the file?")
    typical, best = float(np.nanmedian(spreads)), int(offsets[np.nanargmin(spreads)])
    # Then the least Cauchy loss, which uses more of the data than their median: finer grids, then a parabola.
    scale_m = max(float(np.nanmin(spreads)), 1e-6)  # one exchange, or exact ranges, have no spread
    for _ in range(3 + max(step // 100_000_000 - 1, 0).bit_length()):
        step //= 5
        near = best + step * np.arange(-6, 7, dtype=np.int64)
        best = int(near[np.nanargmin([loss(int(o)) for o in near])])
    # The last grid is finer than what noise lets through, so the parabola runs over 0.1 s to either side.
    near = best + 20_000_000 * np.arange(-5, 6, dtype=np.int64)
    curve, slope, _ = np.polyfit((near - best) * 1e-9, [loss(int(o)) for o in near], 2)
    best += round(float(np.clip(-slope / (2 * curve) if curve > 0 else 0.0, -0.1, 0.1)) * 1e9)
    found_m = spread(best)
    if found_m > 0.7 * typical:
        raise ImportTableError(
            f"the ranges do not tell the offset: their spread is {100 * found_m:.0f} cm at the best offset and "
            f"{100 * typical:.0f} cm at others; record bodies that move, or give `offset` in seconds"
        )
    return Alignment(best, found_m, typical)
