"""The inputs of a fit of trajectories: ranges, lever arms, known positions and attitudes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.ranges import Ranges
from calib.data.sources import Data, opened, ranges_of
from calib.errors import UnanswerableError
from calib.settings import FlightSettings
from calib.trajectories.samples import (
    SAMPLE_S,
    Attitude,
    Heights,
    Inertial,
    Places,
    Readings,
    Tapes,
    heights_of,
    integrated,
    tapes_of,
    windows,
)
from uwblink.arrays import Floats, Ints
from uwblink.recording.schema import Poses


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Ranges (n,) in order of time between tags of bodies that move or stand; time zero is `began_ns`.

    `moving` names the moving bodies. `still` gives the position of each standing body, None if it is estimated. `arms`
    gives the body and the lever arm of each tag: of moving bodies in the body's axes, of standing ones in the world's.
    `attitudes` are the attitudes of moving bodies; without one the tags of a body are at its centre. `tapes` are
    distances by tape, `heights` readings of height sensors.
    """

    source: str
    ranges: Ranges
    began_ns: int
    moving: tuple[str, ...]
    still: Mapping[str, Floats | None]
    arms: Mapping[int, tuple[str, Floats]]
    attitudes: Mapping[str, Attitude]
    places: Places
    inertial: Mapping[str, Inertial]
    heights: Heights
    tapes: Tapes

    @property
    def time_s(self) -> Floats:
        """The times (n,) of the ranges in seconds."""
        return _seconds(self.ranges.valid_ns, self.began_ns)

    @property
    def sought(self) -> list[str]:
        """Return the standing bodies whose positions are estimated."""
        return [body for body, place in self.still.items() if place is None]

    def between(self, begin_s: float, end_s: float) -> Scene:
        """Return the part of the scene within a span of time."""
        rows = np.flatnonzero((self.time_s >= begin_s) & (self.time_s <= end_s))
        samples = {name: getattr(self, name).between(begin_s, end_s) for name in ("places", "heights", "tapes")}
        inertial = {body: some.between(begin_s, end_s) for body, some in self.inertial.items()}
        return replace(self.only(rows), inertial=inertial, **samples)

    @property
    def without_heading(self) -> list[str]:
        """Return the bodies whose first heading is unknown."""
        return [body for body, known in self.attitudes.items() if not known.heading_known]

    def turned_by(self, heading: Mapping[str, float]) -> Scene:
        """Return the scene with attitudes of some bodies rotated about the vertical."""
        attitudes = {body: self.attitudes[body].turned_by(angle) for body, angle in heading.items()}
        inertial = {body: some.turned_by(heading[body]) for body, some in self.inertial.items() if body in heading}
        return replace(self, attitudes={**self.attitudes, **attitudes}, inertial={**self.inertial, **inertial})

    def only(self, rows: Ints) -> Scene:
        """Return the scene with some of its ranges."""
        return replace(self, ranges=self.ranges[rows])

    def thinned(self, count: int) -> Scene:
        """Return the scene with about `count` of its ranges, evenly spread."""
        return self.only(np.arange(0, len(self.ranges), max(len(self.ranges) // count, 1)))


POSE_STD_M = 0.02
"""Standard error of known positions, thinned to `SAMPLE_S`: errors of motion capture last. Half or twice of it
moves delays by 0.24 standard errors, which become 0.85 to 1.46 times as large (`python -m benchmarks.constants`)."""

TILT_STD_DEG, TILT_WANDER_DEG, HEADING_WANDER_DEG = 1.0, 0.2, 0.5
"""Standard deviation of the tilt of an attitude reference (degrees), and random walks of tilt and heading (degrees per
root second): judgements for an autopilot. Half or twice of the first moves delays by 0.25 standard errors
(`python -m benchmarks.constants`)."""


def scene_from(data: Data, settings: FlightSettings, *, need_power: bool = True) -> Scene:
    """Return the scene of a recording; raises `UnanswerableError` if it has no ranges or no body moves."""
    with opened(data) as (name, source):
        ranges = ranges_of(source, name, truth=False)[1]
        poses, tags = source.poses, list(source.tags)
        # A source may lack any of these.
        imu, height = (dict(getattr(source, table, None) or {}) for table in ("imu", "height"))
        stated, arrangements = (tuple(getattr(source, one, ())) for one in ("known_distances", "arrangements"))
    if not tags:
        raise UnanswerableError(f"{name}: contains no bodies of tags; add them with 'uwblink poses --tags'")
    ranges = ranges.usable(need_power=need_power, need_truth=False)
    carried = [tag.tag for tag in tags]
    ranges = ranges[np.isin(ranges.initiator, carried) & np.isin(ranges.target, carried)].in_time_order()
    if not len(ranges):
        raise UnanswerableError(f"{name}: no ranges between tags whose bodies are known")
    began = int(ranges.time_ns[0])
    ranging = set(ranges.tags())
    arms = {tag.tag: (tag.body, np.array(tag.lever_arm_m)) for tag in tags if tag.tag in ranging}
    bodies = sorted({body for body, _ in arms.values()})
    placed, turned = (
        {body: poses[(poses.body == body) & np.isfinite(values).all(axis=1)] for body in bodies}
        for values in (poses.position_m, poses.quaternion)
    )
    still = {
        body: np.median(track.position_m, axis=0)
        for body, track in placed.items()
        # A body whose poses stay within a decimetre stands still.
        if len(track) and np.ptp(track.position_m, axis=0).max() <= 0.1
    }
    moving = tuple(body for body in bodies if body not in still)
    if not moving:
        raise UnanswerableError(f"{ranges.source}: no body moves; use `calib survey` for boards that stand still")
    for tag, (body, arm) in arms.items():
        if body in still and len(turned[body]):
            arms[tag] = body, Rotation.from_quat(turned[body].quaternion[0]).apply(arm)
    last = float(_seconds(ranges.valid_ns, began)[-1])
    until = last if settings.poses_until_s is None else min(settings.poses_until_s, last)
    sensed = {body: Readings.of(imu, body, began) for body in moving}
    found = {body: _attitude(body, turned[body], began, sensed[body], settings, name) for body in moving}
    attitudes = {body: attitude for body, attitude in found.items() if attitude is not None}
    inertial = {
        body: windows(some, attitudes[body], last) for body, some in sensed.items() if some and body in attitudes
    }
    return Scene(
        source=ranges.source,
        ranges=ranges,
        began_ns=began,
        moving=moving,
        still=still if settings.anchors == "given" else dict.fromkeys(still),
        arms=arms,
        attitudes=attitudes,
        inertial={body: some for body, some in inertial.items() if len(some)},
        places=_places([placed[body] for body in moving], began, until),
        heights=heights_of(height if settings.heights == "used" else {}, moving, began, last),
        tapes=tapes_of(
            (*stated, *settings.distances),
            arrangements,
            {tag: body for tag, (body, _) in arms.items()},
            still,
            began,
            last,
        ),
    )


def _seconds(time_ns: Ints, began_ns: int) -> Floats:
    """Return times (n,) in seconds since the first range."""
    return np.asarray((time_ns - began_ns) * 1e-9, dtype=np.float64)


def _places(tracks: Sequence[Poses], began_ns: int, until_s: float) -> Places:
    """Return the positions of each body since the first range, `SAMPLE_S` apart."""
    parts = []
    for number, track in enumerate(tracks):
        time_s = _seconds(track.time_ns, began_ns)
        early = np.flatnonzero((time_s >= 0) & (time_s < until_s))
        rows = early[np.diff(np.floor(time_s[early] / SAMPLE_S), prepend=-np.inf) > 0]
        parts.append((time_s[rows], np.full(len(rows), number), track.position_m[rows], np.full(len(rows), POSE_STD_M)))
    return Places(*map(np.concatenate, zip(*parts, strict=True)))


def _attitude(
    body: str, track: Poses, began_ns: int, sensed: Readings | None, settings: FlightSettings, source: str
) -> Attitude | None:
    """Return the attitudes of a moving body; None if there are none."""
    std = np.radians([TILT_STD_DEG, TILT_STD_DEG, settings.heading_std_deg])
    wander = np.radians([TILT_WANDER_DEG, TILT_WANDER_DEG, HEADING_WANDER_DEG])
    if settings.heading_std_deg == 0:
        std, wander = np.zeros((2, 3))
    time_s = _seconds(track.time_ns, began_ns)
    given = Attitude(time_s=time_s, quaternion=track.quaternion, std_rad=std, wander_rad=wander)
    if settings.attitudes != "imu":
        return given if settings.attitudes == "poses" and len(track) else None
    if sensed is None:
        raise UnanswerableError(f"{source}: no inertial readings of body {body}; take `attitudes` from poses")
    until_s = settings.poses_until_s or 0.0
    early = until_s > 0 and bool(np.any(time_s < until_s))
    return integrated(sensed, given if early else None, until_s)
