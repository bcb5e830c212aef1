"""What a recording gives a fit of trajectories: who moves, who stands, and where and how turned bodies are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from calib.data.ranges import Ranges
from calib.data.sources import Data, Source, antenna_delays_of, opened
from calib.errors import UnanswerableError
from calib.trajectories.attitudes import Attitude, matrices
from calib.trajectories.heights import heights_of, no_heights
from calib.trajectories.inertial import Readings, integrated, windows
from calib.trajectories.scene import Places, Scene
from calib.trajectories.tapes import tapes_of
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.schema import Arrangement, KnownDistance, Poses, Tag
from uwblink.recording.target_reports import single_reports
from uwblink.ticks import TICK_S
from uwblink.twr import Exchanges, intervals

STILL_M: Final = 0.1
"""A body whose poses reach no further stands."""

PLACE_STD_M: Final = 0.02
EVERY_S: Final = 0.1
"""Known places count so often, each with so large an error: what they are wrong by lasts."""

TILT_STD: Final = float(np.radians(1.0))
TILT_WANDER: Final = float(np.radians(0.2))
HEADING_WANDER: Final = float(np.radians(0.5))
"""What tilts of an attitude reference are wrong by, and by how much its errors change in a second."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Usable:
    """What of a recording may be used; the fields are parameters of `fit_from_ranges`."""

    poses_until_s: float | None = None
    attitudes: str = "poses"
    heading_std_deg: float = 3.0
    anchors: str = "given"
    distances: tuple[KnownDistance, ...] = ()
    heights: str = "used"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Beside:
    """What a recording has beside ranges and poses."""

    imu: Mapping[str, Any]
    height: Mapping[str, Any]
    distances: tuple[KnownDistance, ...]
    arrangements: tuple[Arrangement, ...]

    @classmethod
    def of(cls, source: Source) -> _Beside:
        """Return it; a source need not have any."""
        imu, height = (dict(getattr(source, name, None) or {}) for name in ("imu", "height"))
        stated, marked = (tuple(getattr(source, name, ())) for name in ("known_distances", "arrangements"))
        return cls(imu=imu, height=height, distances=stated, arrangements=marked)


def scene_from(data: Data, usable: Usable, *, need_power: bool = True) -> Scene:
    """Return the scene of a recording; raises `UnanswerableError` where it holds no ranges or nothing moves."""
    with opened(data) as (name, source):
        exchanges = single_reports(source.exchanges).exchanges
        poses, tags = source.poses, list(source.tags)
        planted = _planted(source)
        beside, delays = _Beside.of(source), antenna_delays_of(source, name)
    if not tags:
        raise UnanswerableError(f"{name}: does not say which tag sits on which body; 'uwblink poses --tags' adds that")
    # In the place of distances, which nobody knows, the number of the row: it says which rows are left.
    numbered = Ranges.from_exchanges(
        exchanges,
        np.arange(len(exchanges), dtype=np.float64),
        tags=tags,
        planted=planted,
        source=name,
        antenna_delays=delays,
    ).usable(need_power=need_power)
    carried = {tag.tag for tag in tags}
    rows = numbered.truth_m.astype(np.int64)
    mine = np.isin(numbered.initiator, list(carried)) & np.isin(numbered.target, list(carried))
    mine &= numbered.initiator != numbered.target
    rows, ranges = rows[mine], numbered[mine]
    if not len(rows):
        raise UnanswerableError(f"{name}: no ranges between tags whose bodies are known")
    order = np.argsort(ranges.time_ns, kind="stable")
    rows, ranges = rows[order], ranges[order]
    return _scene(ranges, exchanges[rows], poses, tags, beside, usable)


def _planted(source: Source) -> Mapping[str, Any] | None:
    found = getattr(source, "planted", None)
    return found if isinstance(found, Mapping) else None


def _scene(
    ranges: Ranges, exchanges: Exchanges, poses: Poses, tags: Sequence[Tag], beside: _Beside, usable: Usable
) -> Scene:
    began = int(ranges.time_ns[0])
    # A range belongs to the middle of its first two messages.
    half = np.nan_to_num(intervals(exchanges).dt41 * (TICK_S / 2), nan=0.0)
    time = (ranges.time_ns - began) * 1e-9 + np.where(np.abs(half) < 1.0, half, 0.0)
    ranging = set(ranges.tags())
    arms = {tag.tag: (tag.body, np.array(tag.lever_arm_m)) for tag in tags if tag.tag in ranging}
    bodies = sorted({body for body, _ in arms.values()})
    tracks = {body: _Track(poses, body, began) for body in bodies}
    still = {body: track.middle for body, track in tracks.items() if track.stands}
    moving = tuple(body for body in bodies if body not in still)
    if not moving:
        raise UnanswerableError(f"{ranges.source}: no body moves; boards that stand still are what a survey is for")
    last = float(time[-1])
    until = last if usable.poses_until_s is None else min(usable.poses_until_s, last)
    sensed = {body: Readings.of(beside.imu, body, began) for body in moving}
    attitudes = {body: _attitude(body, tracks[body], sensed[body], usable, until, ranges.source) for body in moving}
    turned = {body: attitude for body, attitude in attitudes.items() if attitude is not None}
    return Scene(
        source=ranges.source,
        ranges=replace(ranges, truth_m=np.full(len(time), np.nan)),
        time_s=np.asarray(time),
        moving=moving,
        still=still if usable.anchors == "given" else dict.fromkeys(still),
        still_turned={body: tracks[body].turned for body in still},
        arms=arms,
        attitudes=turned,
        inertial={body: windows(some, turned[body], last) for body, some in sensed.items() if some and body in turned},
        places=_places([tracks[body] for body in moving], until),
        heights=heights_of(beside.height, moving, began, last) if usable.heights == "used" else no_heights(),
        tapes=tapes_of(
            (*beside.distances, *usable.distances),
            beside.arrangements,
            {tag: body for tag, (body, _) in arms.items()},
            still,
            began,
            last,
        ),
    )


class _Track:
    """The poses of one body, in seconds since the first range."""

    def __init__(self, poses: Poses, body: str, began_ns: int) -> None:
        rows = np.flatnonzero(poses.body == body)
        self.time_s: Floats = np.asarray((poses.time_ns[rows] - began_ns) * 1e-9, dtype=np.float64)
        self.position_m: Floats = poses.position_m[rows]
        self.quaternion: Floats = poses.quaternion[rows]
        self.placed: Bools = np.asarray(np.isfinite(self.position_m).all(axis=1))
        self.known: Bools = np.asarray(np.isfinite(self.quaternion).all(axis=1))

    @property
    def stands(self) -> bool:
        """Whether all poses are of one place."""
        here = self.position_m[self.placed]
        return bool(len(here)) and bool(np.ptp(here, axis=0).max() <= STILL_M)

    @property
    def middle(self) -> Floats:
        """Return where a standing body is."""
        return np.asarray(np.median(self.position_m[self.placed], axis=0))

    @property
    def turned(self) -> Floats:
        """Return how a standing body is turned."""
        known = self.quaternion[self.known]
        return np.asarray(matrices(known[:1])[0]) if len(known) else np.eye(3)

    def now_and_then(self, until_s: float) -> Ints:
        """Return the rows of places that count, `EVERY_S` apart, since the first range."""
        rows = np.flatnonzero(self.placed & (self.time_s >= 0) & (self.time_s < until_s))
        slot = np.floor(self.time_s[rows] / EVERY_S)
        return rows[np.diff(slot, prepend=-np.inf) > 0]


def _places(tracks: list[_Track], until_s: float) -> Places:
    rows = [track.now_and_then(until_s) for track in tracks]
    body = np.repeat(np.arange(len(tracks)), [len(some) for some in rows])
    return Places(
        np.concatenate([track.time_s[some] for track, some in zip(tracks, rows, strict=True)]),
        body,
        np.concatenate([track.position_m[some] for track, some in zip(tracks, rows, strict=True)]),
        np.full(len(body), PLACE_STD_M),
    )


def _attitude(
    body: str, track: _Track, sensed: Readings | None, usable: Usable, until_s: float, source: str
) -> Attitude | None:
    """Return the attitudes of a moving body; None where nothing says any."""
    given = _of_poses(track, usable) if track.known.any() else None
    if usable.attitudes == "imu":
        if sensed is None:
            raise UnanswerableError(f"{source}: no inertial readings of body {body}; take `attitudes` from poses")
        return integrated(sensed, given, until_s if usable.poses_until_s is not None else 0.0)
    return given if usable.attitudes == "poses" else None


def _of_poses(track: _Track, usable: Usable) -> Attitude:
    heading = float(np.radians(usable.heading_std_deg))
    exact = heading == 0
    return Attitude(
        time_s=track.time_s[track.known],
        quaternion=track.quaternion[track.known],
        std_rad=np.zeros(3) if exact else np.array([TILT_STD, TILT_STD, heading]),
        wander_rad=np.zeros(3) if exact else np.array([TILT_WANDER, TILT_WANDER, HEADING_WANDER]),
    )
