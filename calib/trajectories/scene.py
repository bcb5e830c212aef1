"""The inputs of a fit of trajectories: ranges, lever arms, and what is known of positions and attitudes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.ranges import Ranges
from calib.data.sources import Data, antenna_delays_of, opened, planted_of
from calib.errors import UnanswerableError
from calib.settings import FlightSettings
from calib.trajectories.attitudes import Attitude, Inertial, Readings, integrated, windows
from calib.trajectories.samples import Heights, Places, Tapes, heights_of, no_heights, no_tapes, tapes_of
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.antenna_delays import AntennaDelay
from uwblink.recording.schema import Poses, Tag
from uwblink.recording.summary import single_reports
from uwblink.ticks import TICK_S
from uwblink.twr import Exchanges, intervals

NOWHERE = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Ranges (n,) at `time_s` (n,) between tags of bodies that move or stand.

    `moving` names the moving bodies. `still` gives the position of each standing body, None if it is estimated. `arms`
    gives the body and the lever arm of each tag. `attitudes` are those of moving bodies; without an attitude the tags
    of a body are at its centre. `tapes` are distances by tape, `heights` readings of height sensors.
    """

    source: str
    ranges: Ranges
    time_s: Floats
    moving: tuple[str, ...]
    still: Mapping[str, Floats | None]
    still_turned: Mapping[str, Floats] = field(default_factory=dict)
    arms: Mapping[int, tuple[str, Floats]]
    attitudes: Mapping[str, Attitude]
    places: Places
    inertial: Mapping[str, Inertial] = field(default_factory=dict)
    heights: Heights = field(default_factory=no_heights)
    tapes: Tapes = field(default_factory=no_tapes)

    @property
    def sought(self) -> list[str]:
        """Return the standing bodies whose positions are estimated."""
        return [body for body, place in self.still.items() if place is None]

    @property
    def by_geometry_alone(self) -> bool:
        """Whether only the geometry of lever arms determines the scale of distances."""
        given = sum(place is not None for place in self.still.values())
        return given < 2 and not (len(self.places) or len(self.heights) or self.inertial or len(self.tapes))

    def between(self, begin_s: float, end_s: float) -> Scene:
        """Return the part of the scene within a span of time."""
        rows = np.flatnonzero((self.time_s >= begin_s) & (self.time_s <= end_s))
        samples = {name: getattr(self, name).between(begin_s, end_s) for name in ("places", "heights", "tapes")}
        inertial = {body: windows.between(begin_s, end_s) for body, windows in self.inertial.items()}
        return replace(self.only(rows), inertial=inertial, **samples)

    def at(self, places: Places) -> Scene:
        """Return the scene with these known positions instead of all positions, forces, heights and tapes."""
        return replace(self, places=places, inertial={}, heights=no_heights(), tapes=no_tapes())

    @property
    def without_heading(self) -> list[str]:
        """Return the bodies whose first heading is unknown."""
        return [
            body
            for body, known in self.attitudes.items()
            if not np.isfinite(known.std_rad[2]) and not known.heading_known
        ]

    def turned_by(self, heading: Mapping[str, float]) -> Scene:
        """Return the scene with attitudes of some bodies rotated about the vertical."""
        if not heading:
            return self
        attitudes = {body: known.turned_by(heading.get(body, 0.0)) for body, known in self.attitudes.items()}
        inertial = {body: some.turned_by(heading.get(body, 0.0)) for body, some in self.inertial.items()}
        return replace(self, attitudes=attitudes, inertial=inertial)

    def only(self, rows: Ints) -> Scene:
        """Return the scene with some of its ranges."""
        columns = {name: getattr(self, name)[rows] for name in ("ranges", "time_s")}
        return replace(self, **columns)


@dataclass(frozen=True, slots=True)
class Ends:
    """One end of each range (n,).

    `mover` and `stander` are the numbers of the moving body or of the body whose position is estimated, -1 for neither.
    `base_m` (n, 3) is the antenna's position on a body with a known position, or its offset from the centre of a
    standing body. `arm_m` (n, 3) is its offset from the centre of a moving body, by the given attitude.
    """

    mover: Ints
    stander: Ints
    base_m: Floats
    arm_m: Floats


def ends_of(scene: Scene, ids: Ints, time_s: Floats) -> Ends:
    """Return the ends of tags `ids` (n,) at instants (n,)."""
    count = len(ids)
    mover, stander = np.full(count, NOWHERE), np.full(count, NOWHERE)
    base, arm = np.zeros((count, 3)), np.zeros((count, 3))
    sought = scene.sought
    for tag, (body, lever) in scene.arms.items():
        rows = np.flatnonzero(ids == tag)
        if not len(rows):
            continue
        if body in scene.still:
            place = scene.still[body]
            turned = scene.still_turned.get(body, np.eye(3)) @ lever
            base[rows] = turned if place is None else place + turned
            stander[rows] = sought.index(body) if place is None else NOWHERE
        else:
            mover[rows] = scene.moving.index(body)
            if body in scene.attitudes:
                arm[rows] = scene.attitudes[body].at(time_s[rows]) @ lever
    return Ends(mover, stander, base, arm)


STILL_M = 0.1
"""A body whose poses stay within this distance stands still."""

PLACE_STD_M = 0.02
PLACE_EVERY_S = 0.1
"""Known positions are thinned to this interval and have this standard error: errors of motion capture last."""

TILT_STD = float(np.radians(1.0))
TILT_WANDER = float(np.radians(0.2))
HEADING_WANDER = float(np.radians(0.5))
"""Standard deviation of the tilt of an attitude reference (rad), and random walks of tilt and heading (rad per root
second)."""


def scene_from(data: Data, settings: FlightSettings, *, need_power: bool = True) -> Scene:
    """Return the scene of a recording; raises `UnanswerableError` if it has no ranges or no body moves."""
    with opened(data) as (name, source):
        exchanges = single_reports(source.exchanges).exchanges
        poses, tags, planted = source.poses, list(source.tags), planted_of(source, name)
        delays = antenna_delays_of(source, name)
        # A source need not have any of these.
        imu, height = (dict(getattr(source, table, None) or {}) for table in ("imu", "height"))
        stated, arrangements = (tuple(getattr(source, one, ())) for one in ("known_distances", "arrangements"))
    if not tags:
        raise UnanswerableError(f"{name}: does not say which tag sits on which body; 'uwblink poses --tags' adds that")
    rows, ranges = _ranges_between(tags, exchanges, name, planted, delays, need_power=need_power)
    began = int(ranges.time_ns[0])
    # A range belongs to the middle of its first two messages.
    half = np.nan_to_num(intervals(exchanges[rows]).dt41 * (TICK_S / 2), nan=0.0)
    time = (ranges.time_ns - began) * 1e-9 + np.where(np.abs(half) < 1.0, half, 0.0)
    ranging = set(ranges.tags())
    arms = {tag.tag: (tag.body, np.array(tag.lever_arm_m)) for tag in tags if tag.tag in ranging}
    bodies = sorted({body for body, _ in arms.values()})
    tracks = {body: _BodyPoses(poses, body, began) for body in bodies}
    still = {body: track.middle for body, track in tracks.items() if track.stands}
    moving = tuple(body for body in bodies if body not in still)
    if not moving:
        raise UnanswerableError(f"{ranges.source}: no body moves; boards that stand still are what a survey is for")
    last = float(time[-1])
    until = last if settings.poses_until_s is None else min(settings.poses_until_s, last)
    sensed = {body: Readings.of(imu, body, began) for body in moving}
    attitudes = {body: _attitude(body, tracks[body], sensed[body], settings, until, ranges.source) for body in moving}
    turned = {body: attitude for body, attitude in attitudes.items() if attitude is not None}
    return Scene(
        source=ranges.source,
        ranges=replace(ranges, truth_m=np.full(len(time), np.nan)),
        time_s=np.asarray(time),
        moving=moving,
        still=still if settings.anchors == "given" else dict.fromkeys(still),
        still_turned={body: tracks[body].turned for body in still},
        arms=arms,
        attitudes=turned,
        inertial={body: windows(some, turned[body], last) for body, some in sensed.items() if some and body in turned},
        places=_places([tracks[body] for body in moving], until),
        heights=heights_of(height, moving, began, last) if settings.heights == "used" else no_heights(),
        tapes=tapes_of(
            (*stated, *settings.distances),
            arrangements,
            {tag: body for tag, (body, _) in arms.items()},
            still,
            began,
            last,
        ),
    )


def _ranges_between(
    tags: Sequence[Tag],
    exchanges: Exchanges,
    name: str,
    planted: object,
    delays: Mapping[int | None, AntennaDelay],
    *,
    need_power: bool,
) -> tuple[Ints, Ranges]:
    """Return the usable ranges between known tags in order of time, and their rows among the exchanges."""
    # The truth is not known. In its place stands the number of the row, which tells what rows are left.
    numbered = Ranges.from_exchanges(
        exchanges,
        np.arange(len(exchanges), dtype=np.float64),
        tags=tags,
        planted=planted if isinstance(planted, Mapping) else None,
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
    return rows[order], ranges[order]


class _BodyPoses:
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
        """Whether all poses have one position."""
        here = self.position_m[self.placed]
        return bool(len(here)) and bool(np.ptp(here, axis=0).max() <= STILL_M)

    @property
    def middle(self) -> Floats:
        """Return the position of a standing body (3,)."""
        return np.asarray(np.median(self.position_m[self.placed], axis=0))

    @property
    def turned(self) -> Floats:
        """Return the rotation of a standing body (3, 3)."""
        known = self.quaternion[self.known]
        return np.asarray(Rotation.from_quat(known[0]).as_matrix()) if len(known) else np.eye(3)

    def sampled_rows(self, until_s: float) -> Ints:
        """Return the rows of positions since the first range, `PLACE_EVERY_S` apart."""
        rows = np.flatnonzero(self.placed & (self.time_s >= 0) & (self.time_s < until_s))
        slot = np.floor(self.time_s[rows] / PLACE_EVERY_S)
        return rows[np.diff(slot, prepend=-np.inf) > 0]


def _places(tracks: list[_BodyPoses], until_s: float) -> Places:
    rows = [track.sampled_rows(until_s) for track in tracks]
    body = np.repeat(np.arange(len(tracks)), [len(some) for some in rows])
    return Places(
        np.concatenate([track.time_s[some] for track, some in zip(tracks, rows, strict=True)]),
        body,
        np.concatenate([track.position_m[some] for track, some in zip(tracks, rows, strict=True)]),
        np.full(len(body), PLACE_STD_M),
    )


def _attitude(
    body: str, track: _BodyPoses, sensed: Readings | None, settings: FlightSettings, until_s: float, source: str
) -> Attitude | None:
    """Return the attitudes of a moving body; None if there are none."""
    given = _of_poses(track, settings) if track.known.any() else None
    if settings.attitudes == "imu":
        if sensed is None:
            raise UnanswerableError(f"{source}: no inertial readings of body {body}; take `attitudes` from poses")
        return integrated(sensed, given, until_s if settings.poses_until_s is not None else 0.0)
    return given if settings.attitudes == "poses" else None


def _of_poses(track: _BodyPoses, settings: FlightSettings) -> Attitude:
    heading = float(np.radians(settings.heading_std_deg))
    exact = heading == 0
    return Attitude(
        time_s=track.time_s[track.known],
        quaternion=track.quaternion[track.known],
        std_rad=np.zeros(3) if exact else np.array([TILT_STD, TILT_STD, heading]),
        wander_rad=np.zeros(3) if exact else np.array([TILT_WANDER, TILT_WANDER, HEADING_WANDER]),
    )
