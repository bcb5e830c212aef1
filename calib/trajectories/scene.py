"""What a fit of trajectories is given: ranges, who carries which tag, and all that is known of places and attitudes."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.data.ranges import Ranges
from calib.data.sources import Data, Source, antenna_delays_of, opened
from calib.errors import BadInputError, UnanswerableError
from calib.spread import robust_spread
from calib.trajectories.attitudes import Attitude, Inertial, Readings, integrated, windows
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.schema import Arrangement, KnownDistance, Poses, Tag
from uwblink.recording.target_reports import single_reports
from uwblink.ticks import TICK_S
from uwblink.twr import Exchanges, intervals

NOWHERE = -1


@dataclass(frozen=True, slots=True)
class Places:
    """Places of moving bodies that are known: seconds (k,), number of the body (k,), metres (k, 3), standard errors."""

    time_s: Floats
    body: Ints
    position_m: Floats
    std_m: Floats

    def __getitem__(self, rows: Bools) -> Places:
        """Return the chosen ones."""
        return Places(self.time_s[rows], self.body[rows], self.position_m[rows], self.std_m[rows])

    def __add__(self, other: Places) -> Places:
        """Return both."""
        names = ("time_s", "body", "position_m", "std_m")
        return Places(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


TAPE_EVERY_S = 0.4
"""A distance is one number for as long as it holds: it is said so often, each time with so much larger an error."""

SPAN = re.compile(r"^\s*(\d+(?:\.\d*)?)\s*\.\.\s*(\d+(?:\.\d*)?)\s*$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Tapes:
    """Distances as instants at which they hold (k,): tags, seconds (NaN: always), metres, standard errors.

    The instants of one distance have its `number` and say together what it says; `told` names each distance, and
    `left_out` says of each that cannot be used why.
    """

    first: Ints
    second: Ints
    time_s: Floats
    distance_m: Floats
    std_m: Floats
    number: Ints
    told: tuple[KnownDistance, ...] = ()
    left_out: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of instants."""
        return len(self.number)

    def within(self, begin_s: float, end_s: float) -> Tapes:
        """Return those inside a span of time, and those that always hold."""
        return self._of(np.isnan(self.time_s) | ((self.time_s >= begin_s) & (self.time_s <= end_s)))

    def _of(self, rows: Bools) -> Tapes:
        names = ("first", "second", "time_s", "distance_m", "std_m", "number")
        return Tapes(**{name: getattr(self, name)[rows] for name in names}, told=self.told, left_out=self.left_out)


def no_tapes() -> Tapes:
    """Return no distances."""
    return _joined([], (), ())


def tapes_of(
    stated: Iterable[KnownDistance],
    arrangements: Iterable[Arrangement],
    bodies: Mapping[int, str],
    still: Collection[str],
    began_ns: int,
    last_s: float,
) -> Tapes:
    """Return when distances hold: between bodies that stand always, else while their arrangement lasts.

    `bodies` says which body each tag is on, `still` which of them stand. An arrangement is one of the recording's, or
    a span of seconds since the first range ("2..8"); a distance of none holds in all. Raises `BadInputError` for a tag
    or an arrangement that is not there, and for a number that is no distance.
    """
    spans: dict[str, tuple[float, float]] = {
        one.name: ((one.start_ns - began_ns) * 1e-9, (one.end_ns - began_ns) * 1e-9) for one in arrangements
    }
    parts: list[list[Floats]] = []
    told, left_out = list[KnownDistance](), list[str]()
    for one in stated:
        _check(one, bodies)
        when = _instants(one, spans, last_s)
        if {bodies[one.first], bodies[one.second]} <= set(still):
            when = np.array([np.nan])
        if not len(when):
            left_out.append(
                f"the distance of tags {one.first} and {one.second} is not used: nothing says when its bodies stood "
                "still; mark that arrangement, or say its seconds"
            )
            continue
        count = len(when)
        columns = (one.first, one.second, one.distance_m, one.sigma_m * np.sqrt(count), len(told))
        parts.append([when, *(np.full(count, float(value)) for value in columns)])
        told.append(one)
    return _joined(parts, tuple(told), tuple(left_out))


def _joined(parts: list[list[Floats]], told: tuple[KnownDistance, ...], left_out: tuple[str, ...]) -> Tapes:
    columns = [np.concatenate([part[k] for part in parts]) if parts else np.zeros(0) for k in range(6)]
    when, first, second, distance, std, number = columns
    return Tapes(
        first=first.astype(np.int64),
        second=second.astype(np.int64),
        time_s=when,
        distance_m=distance,
        std_m=std,
        number=number.astype(np.int64),
        told=told,
        left_out=left_out,
    )


def _check(one: KnownDistance, bodies: Mapping[int, str]) -> None:
    for tag in (one.first, one.second):
        if tag not in bodies:
            there = ", ".join(map(str, sorted(bodies)))
            raise BadInputError(f"found tag {tag}, the tags that range are {there}", parameter="distances")
    if bodies[one.first] == bodies[one.second]:
        raise BadInputError(
            f"tags {one.first} and {one.second} are on one body, whose lever arms say how far apart they are",
            parameter="distances",
        )
    for value, what in ((one.distance_m, "distance"), (one.sigma_m, "standard error")):
        if not (np.isfinite(value) and value > 0):
            raise BadInputError(
                f"found {value!r} as the {what} of tags {one.first} and {one.second}, expected metres above 0",
                parameter="distances",
            )


def _instants(one: KnownDistance, spans: Mapping[str, tuple[float, float]], last_s: float) -> Floats:
    """Return the seconds at which a distance between moving bodies is said to hold."""
    found = [_between(begin, end, last_s) for begin, end in _spans(one.arrangement, spans)]
    return np.concatenate([np.zeros(0), *found])


def _spans(name: str, spans: Mapping[str, tuple[float, float]]) -> Iterator[tuple[float, float]]:
    if not name:
        yield from spans.values()
        return
    seconds = SPAN.match(name)
    if name not in spans and seconds is None:
        there = ", ".join(spans) or "none"
        raise BadInputError(
            f"found the arrangement {name!r:.40}, the recording has {there}; or give seconds, as in 2..8",
            parameter="distances",
        )
    yield spans[name] if seconds is None or name in spans else (float(seconds[1]), float(seconds[2]))


def _between(begin_s: float, end_s: float, last_s: float) -> Floats:
    begin, end = max(begin_s, 0.0), min(end_s, last_s)
    if not begin <= end:
        return np.zeros(0)
    count = max(int((end - begin) / TAPE_EVERY_S), 1)
    return np.asarray(begin + (np.arange(count) + 0.5) * (end - begin) / count)


HEIGHT_WINDOW_S = 0.1
HEIGHT_STD_M = 0.1
"""What a mean reading is off by beside a constant, before the data say it better."""

HEIGHT_TRUSTED = 3.0
"""How much less than its residuals say a sensor is trusted: what it is off by lasts for some windows."""

HEIGHT_BOUNDS_M = (0.02, 1.0)
TURNS_AWAY = 2.0
"""Beyond so many spreads a reading counts less (Huber 1964): a sensor that looks down sees what stands below it."""


@dataclass(frozen=True, slots=True)
class Heights:
    """Mean heights of moving bodies: seconds (k,), number of the body (k,), metres (k,), standard errors (k,)."""

    time_s: Floats
    body: Ints
    height_m: Floats
    std_m: Floats

    def __getitem__(self, rows: Bools) -> Heights:
        """Return the chosen ones."""
        return Heights(self.time_s[rows], self.body[rows], self.height_m[rows], self.std_m[rows])

    def within(self, begin_s: float, end_s: float) -> Heights:
        """Return those inside a span of time."""
        return self[(self.time_s >= begin_s) & (self.time_s <= end_s)]

    def weighed(self, residual: Floats) -> Heights:
        """Return them with standard errors by what they were off, `residual` (k,) over the present ones."""
        if not len(residual):
            return self
        off = residual * self.std_m
        spread = float(np.clip(HEIGHT_TRUSTED * robust_spread(off, 0.0), *HEIGHT_BOUNDS_M))
        share = np.minimum(1.0, TURNS_AWAY * spread / HEIGHT_TRUSTED / np.maximum(np.abs(off), 1e-9))
        return replace(self, std_m=spread / np.sqrt(share))


def no_heights() -> Heights:
    """Return no readings."""
    return Heights(np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))


def heights_of(table: Mapping[str, NDArray[Any]], moving: Sequence[str], began_ns: int, last_s: float) -> Heights:
    """Return the readings of moving bodies in a recording's table, as medians over windows."""
    if not table:
        return no_heights()
    parts = [_of_body(table, body, number, began_ns, last_s) for number, body in enumerate(moving)]
    names = ("time_s", "body", "height_m", "std_m")
    return Heights(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _of_body(table: Mapping[str, NDArray[Any]], body: str, number: int, began_ns: int, last_s: float) -> Heights:
    rows = np.flatnonzero((table["body"] == body) & np.isfinite(table["height_m"]))
    time = np.asarray((table["time_ns"][rows] - began_ns) * 1e-9, dtype=np.float64)
    inside = (time >= 0) & (time <= last_s)
    order = np.argsort(time[inside], kind="stable")
    time, height = time[inside][order], np.asarray(table["height_m"][rows][inside][order], dtype=np.float64)
    starts = np.flatnonzero(np.diff(np.floor(time / HEIGHT_WINDOW_S), prepend=-np.inf))
    groups = list(zip(np.split(time, starts[1:]), np.split(height, starts[1:]), strict=True)) if len(starts) else []
    middle = np.array([[float(np.mean(when)), float(np.median(some))] for when, some in groups]).reshape(-1, 2)
    count = len(middle)
    return Heights(middle[:, 0], np.full(count, number), middle[:, 1], np.full(count, HEIGHT_STD_M))


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Ranges (n,) at `time_s` (n,) between tags of bodies that move or stand still.

    `moving` names the bodies that move; `still` has those that do not, with their place or None where it is to be
    found. `arms` says of each tag its body and lever arm. `attitudes` are those of moving bodies; a body without any
    has its tags in its middle. `tapes` are distances that were measured otherwise, `heights` readings of sensors.
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
        """Return the bodies that stand still at places that are to be found."""
        return [body for body, place in self.still.items() if place is None]

    @property
    def by_geometry_alone(self) -> bool:
        """Whether nothing says how far anything is but how ranges between lever arms fit together in space."""
        given = sum(place is not None for place in self.still.values())
        told = len(self.places.time_s), len(self.heights.time_s), len(self.inertial), len(self.tapes.told)
        return given < 2 and not any(told)

    def between(self, begin_s: float, end_s: float) -> Scene:
        """Return what lies within a span of time."""
        known = (self.places.time_s >= begin_s) & (self.places.time_s <= end_s)
        rows = np.flatnonzero((self.time_s >= begin_s) & (self.time_s <= end_s))
        inertial = {body: sensed.within(begin_s, end_s) for body, sensed in self.inertial.items()}
        return replace(
            self.only(rows),
            places=self.places[known],
            inertial=inertial,
            heights=self.heights.within(begin_s, end_s),
            tapes=self.tapes.within(begin_s, end_s),
        )

    def at(self, places: Places) -> Scene:
        """Return the scene with these places, and nothing else that is known beside its attitudes."""
        return replace(self, places=places, inertial={}, heights=no_heights(), tapes=no_tapes())

    @property
    def without_heading(self) -> list[str]:
        """Return the bodies whose first heading is not known."""
        return [body for body, known in self.attitudes.items() if not np.isfinite(known.std_rad[2]) and not known.begun]

    def headed(self, heading: Mapping[str, float]) -> Scene:
        """Return the scene with the attitudes of some bodies turned about the vertical by their headings."""
        if not heading:
            return self
        attitudes = {body: known.headed(heading.get(body, 0.0)) for body, known in self.attitudes.items()}
        inertial = {body: some.headed(heading.get(body, 0.0)) for body, some in self.inertial.items()}
        return replace(self, attitudes=attitudes, inertial=inertial)

    def only(self, rows: Ints) -> Scene:
        """Return the scene with some of its ranges."""
        columns = {name: getattr(self, name)[rows] for name in ("ranges", "time_s")}
        return replace(self, **columns)


@dataclass(frozen=True, slots=True)
class Ends:
    """One end of each range (n,): what carries the antenna there.

    `mover` and `stander` number the moving body or the one whose place is sought, -1 for neither; `base_m` (n, 3) is
    the antenna of a body at a known place, or how far it is from the middle of a standing one; `arm_m` (n, 3) is how
    far it is from the middle of a moving body by its given attitude.
    """

    mover: Ints
    stander: Ints
    base_m: Floats
    arm_m: Floats


def ends_of(scene: Scene, ids: Ints, time_s: Floats) -> Ends:
    """Return the ends at tags `ids` (n,) at instants (n,)."""
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
"""A body whose poses reach no further stands."""

PLACE_STD_M = 0.02
PLACE_EVERY_S = 0.1
"""Known places count so often, each with so large an error: what they are wrong by lasts."""

TILT_STD = float(np.radians(1.0))
TILT_WANDER = float(np.radians(0.2))
HEADING_WANDER = float(np.radians(0.5))
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
        return np.asarray(Rotation.from_quat(known[0]).as_matrix()) if len(known) else np.eye(3)

    def now_and_then(self, until_s: float) -> Ints:
        """Return the rows of places that count, `PLACE_EVERY_S` apart, since the first range."""
        rows = np.flatnonzero(self.placed & (self.time_s >= 0) & (self.time_s < until_s))
        slot = np.floor(self.time_s[rows] / PLACE_EVERY_S)
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
