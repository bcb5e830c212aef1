"""Known facts about a flight besides its ranges, as samples in time: positions, heights, tapes, attitudes and forces.

Attitudes are given, or integrated from gyroscopes; accelerometers give mean specific forces.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation, Slerp

from calib.data.sources import sensor_rows
from calib.evaluation.filters import GRAVITY_M_S2
from calib.settings import refuse
from calib.spread import medians, robust_spread
from uwblink.arrays import Bools, ColumnTable, Floats, Ints
from uwblink.recording.schema import Arrangement, KnownDistance

POINT_S = 0.4
"""Time between control points of a path: the acceleration of a multirotor does not change faster.

A taped distance is one measurement. While it is valid it has one row per this interval, with a standard error
multiplied by the square root of the number of rows.
"""

SAMPLE_S = POINT_S / 4
"""Time between known positions, heights (medians over it) and positions of an initial guess, and over which specific
forces are averaged: vibrations cancel, and the acceleration of a spline hardly changes."""


TRUSTED = 3.0
"""Factor on the spread of a sensor's residuals, because its errors last for some windows."""


@dataclass(frozen=True, slots=True)
class Samples(ColumnTable):
    """Columns of one length (k,); `time_s`, instead of `time_ns`, are the seconds at which they are valid.

    NaN means always.
    """

    time_s: Floats

    def between(self, begin_s: float, end_s: float) -> Self:
        """Return the samples inside a span of time, and those that are always valid."""
        return self[np.isnan(self.time_s) | ((self.time_s >= begin_s) & (self.time_s <= end_s))]


@dataclass(frozen=True, slots=True)
class Places(Samples):
    """Known positions of moving bodies: number of the body (k,), metres (k, 3), standard errors (k,)."""

    body: Ints
    position_m: Floats
    std_m: Floats


@dataclass(frozen=True, slots=True)
class Heights(Samples):
    """Median heights of moving bodies: number of the body (k,), metres (k,), standard errors (k,)."""

    body: Ints
    height_m: Floats
    std_m: Floats

    def reweighted(self, residual_m: Floats) -> Heights:
        """Return the readings with standard errors from their residuals (k,)."""
        if not len(self):
            return self
        # The flatness of floors, and nearly half the height of a room.
        std_m = float(np.clip(TRUSTED * robust_spread(residual_m, 0.0), 0.02, 1.0))
        # Readings beyond two spreads have less weight (Huber 1964): objects may be below the sensor.
        weight = np.minimum(1.0, 2.0 * std_m / TRUSTED / np.maximum(np.abs(residual_m), 1e-9))
        return replace(self, std_m=std_m / np.sqrt(weight))


def heights_of(table: Mapping[str, NDArray[Any]], moving: Sequence[str], began_ns: int, last_s: float) -> Heights:
    """Return the readings of moving bodies in a recording's table, as medians over windows."""
    if not table:
        return Heights(np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))
    time_s, height_m = (table["time_ns"] - began_ns) * 1e-9, np.asarray(table["height_m"], dtype=np.float64)
    number = np.select([table["body"] == body for body in moving], range(len(moving)), -1)
    rows = np.flatnonzero((number >= 0) & np.isfinite(height_m) & (time_s >= 0) & (time_s <= last_s))
    window = np.column_stack([number, np.floor(time_s / SAMPLE_S)])[rows]
    group = np.unique(window, axis=0, return_inverse=True)[1].ravel()
    time, body, height = (medians(column[rows], group) for column in (time_s, number, height_m))
    # A decimetre in addition to the sensor's constant offset, before residuals are known.
    return Heights(time, body.astype(np.int64), height, np.full(len(time), 0.1))


@dataclass(frozen=True, slots=True)
class Tapes(Samples):
    """Distances by tape at instants (k,): tags, metres, standard errors, and the number of the statement.

    All instants of one statement together carry its information. `stated` are the statements that are used, `left_out`
    the reasons why the others are not.
    """

    first: Ints
    second: Ints
    distance_m: Floats
    std_m: Floats
    number: Ints
    stated: tuple[KnownDistance, ...] = ()
    left_out: tuple[str, ...] = ()


def tapes_of(
    stated: Iterable[KnownDistance],
    arrangements: Iterable[Arrangement],
    bodies: Mapping[int, str],
    still: Collection[str],
    began_ns: int,
    last_s: float,
) -> Tapes:
    """Return the times at which distances are valid: always between standing bodies, else during their arrangement.

    `bodies` gives the body of each tag, `still` names the bodies that stand. An arrangement is one of the recording's,
    or a span of seconds since the first range ("2..8"); a distance without one is valid in all arrangements. Raises
    `BadInputError` for an unknown tag or arrangement, and for a distance that is not a positive number.
    """
    spans = {one.name: ((one.start_ns - began_ns) * 1e-9, (one.end_ns - began_ns) * 1e-9) for one in arrangements}
    rows, used, left_out = list[tuple[float, ...]](), list[KnownDistance](), list[str]()
    for one in stated:
        _refuse_unusable(one, bodies)
        times = _instants(one, spans, last_s)
        if {bodies[one.first], bodies[one.second]} <= set(still):
            times = [np.nan]
        if not times:
            left_out.append(
                f"the distance of tags {one.first} and {one.second} is not used, because it is unknown when its "
                f"bodies stood still"
            )
            continue
        std_m = one.sigma_m * np.sqrt(len(times))
        rows += [(time, one.first, one.second, one.distance_m, std_m, len(used)) for time in times]
        used.append(one)
    time_s, first, second, distance_m, std, number = np.array(rows, dtype=np.float64).reshape(-1, 6).T
    whole = [ids.astype(np.int64) for ids in (first, second, number)]
    return Tapes(time_s, whole[0], whole[1], distance_m, std, whole[2], tuple(used), tuple(left_out))


def _refuse_unusable(one: KnownDistance, bodies: Mapping[int, str]) -> None:
    """Raise `BadInputError` for a distance that cannot be used."""
    ends, pair = (one.first, one.second), f"tags {one.first} and {one.second}"
    strangers = [tag for tag in ends if tag not in bodies]
    tags = ", ".join(map(str, sorted(bodies)))
    on_one = f"{pair} are on one body, so their lever arms determine the distance"
    refuse(
        [
            *(("distances", True, f"found tag {tag}, the tags that range are {tags}") for tag in strangers),
            ("distances", len({bodies.get(tag) for tag in ends}) == 1, on_one),
            *(
                (
                    "distances",
                    not (np.isfinite(value) and value > 0),
                    f"found {value!r} as the {what} of {pair}, expected metres above 0",
                )
                for value, what in ((one.distance_m, "distance"), (one.sigma_m, "standard error"))
            ),
        ]
    )


def _instants(one: KnownDistance, spans: Mapping[str, tuple[float, float]], last_s: float) -> list[float]:
    """Return the seconds at which a distance between moving bodies has rows."""
    seconds = re.match(r"^\s*(\d+(?:\.\d*)?)\s*\.\.\s*(\d+(?:\.\d*)?)\s*$", one.arrangement)
    known = ({one.arrangement: (float(seconds[1]), float(seconds[2]))} if seconds else {}) | dict(spans)
    unknown = (
        f"found the arrangement {one.arrangement!r:.40}, but the recording has {', '.join(spans) or 'none'}; or give "
        f"seconds, as in 2..8"
    )
    refuse([("distances", one.arrangement not in ("", *known), unknown)])
    found = list[float]()
    for name, (start, end) in known.items():
        begin_s, end_s = max(start, 0.0), min(end, last_s)
        if one.arrangement in ("", name) and begin_s <= end_s:
            count = max(int((end_s - begin_s) / POINT_S), 1)
            found += np.linspace(begin_s, end_s, 2 * count + 1)[1::2].tolist()
    return found


@dataclass(frozen=True, kw_only=True)
class Attitude:
    """Attitudes at `time_s` (k,) as quaternions x y z w (k, 4), body to world, and their errors.

    Errors are rotations about the world's axes: `std_rad` (3,) is their standard deviation, infinite where it is
    unknown, and `wander_rad` (3,) the standard deviation of their change in a second (a random walk). Attitudes are
    exact where both are zero. `heading_known` tells whether the first heading is known.
    """

    time_s: Floats
    quaternion: Floats
    std_rad: Floats
    wander_rad: Floats
    heading_known: bool = True

    def turned_by(self, heading_rad: float) -> Attitude:
        """Return a copy that is rotated about the world's vertical."""
        turned = Rotation.from_euler("z", heading_rad) * Rotation.from_quat(self.quaternion)
        return replace(self, quaternion=turned.as_quat())

    def at(self, time_s: Floats) -> Rotation:
        """Return the rotations at instants (n,), interpolated between quaternions, constant outside."""
        return self._slerp(np.clip(time_s, self.time_s[0], self.time_s[-1]))

    @cached_property
    def _slerp(self) -> Slerp:
        # A second instant extends a single attitude.
        instants, rows = np.unique(np.append(self.time_s, self.time_s[-1] + 1.0), return_index=True)
        return Slerp(instants, Rotation.from_quat(self.quaternion[np.minimum(rows, len(self.time_s) - 1)]))


@dataclass(frozen=True, slots=True)
class Inertial(Samples):
    """Windows of an accelerometer, `SAMPLE_S` long, about `time_s` (k,).

    `force_m_s2` (k, 3) is the mean specific force in the world's axes by the given attitudes, `turn` (k, 3, 3) the mean
    rotation, `std_m_s2` the standard error of a mean.
    """

    force_m_s2: Floats
    turn: Floats
    std_m_s2: float = 0.5  # before residuals are known

    def turned_by(self, heading_rad: float) -> Inertial:
        """Return a copy that is rotated about the world's vertical."""
        turn = Rotation.from_euler("z", heading_rad).as_matrix()
        return replace(self, force_m_s2=self.force_m_s2 @ turn.T, turn=turn @ self.turn)


@dataclass(frozen=True, slots=True)
class Readings(Samples):
    """One body's readings in order of time: seconds (n,), angular velocity (n, 3) in rad/s, specific force (n, 3)."""

    gyro: Floats
    force: Floats

    @classmethod
    def of(cls, table: Mapping[str, NDArray[Any]], body: str, began_ns: int) -> Readings | None:
        """Return the readings of a body from a recording's table; None if it has fewer than ten."""
        time_s, values = sensor_rows(table, body, ("wx", "wy", "wz", "ax", "ay", "az"), began_ns)
        good: Bools = np.asarray(np.isfinite(values).all(axis=1))
        found = cls(time_s, values[:, :3], values[:, 3:])[good]
        return found if len(found) >= 10 else None

    @property
    def per_window(self) -> int:
        """Return the usual number of readings in a window."""
        return max(round(SAMPLE_S / max(float(np.median(np.diff(self.time_s))), 1e-4)), 1)


def windows(readings: Readings, attitude: Attitude, last_s: float) -> Inertial:
    """Return the windows of an accelerometer between the first and the last range."""
    some = readings.between(max(0.0, float(attitude.time_s[0])), min(last_s, float(attitude.time_s[-1])))
    turn = attitude.at(some.time_s).as_matrix()
    force = np.einsum("nij,nj->ni", turn, some.force)
    slot, starts, count = np.unique(np.floor(some.time_s / SAMPLE_S), return_index=True, return_counts=True)
    mean_force = np.add.reduceat(force, starts) / count[:, None]
    mean_turn = np.add.reduceat(turn, starts) / count[:, None, None]
    # Larger mean accelerations are impacts, not flight.
    flown = np.linalg.norm(mean_force - (0, 0, GRAVITY_M_S2), axis=1) < 4.0
    # The mean of a window that lacks a third of its readings is not the value at its middle.
    kept = flown & (count >= 0.7 * readings.per_window)
    return Inertial((slot[kept] + 0.5) * SAMPLE_S, mean_force[kept], mean_turn[kept])


def integrated(readings: Readings, known: Attitude | None, until_s: float) -> Attitude:
    """Return attitudes integrated from the gyroscope and levelled by the accelerometer.

    Before `until_s` they are the `known` ones, from which the gyroscope's bias is estimated. Without known attitudes
    the first heading is 0 and unknown.
    """
    first, bias = 0, np.zeros(3)
    up = readings.between(-np.inf, readings.time_s[0] + 1.0).force.mean(axis=0)
    start = Rotation.align_vectors([[0, 0, 1]], [up])[0]
    if known is not None:
        bias = _gyro_bias(readings, known, until_s)
        first = int(np.clip(np.searchsorted(readings.time_s, until_s), 1, len(readings.time_s) - 1))
        start = known.at(readings.time_s[first])
    found = Attitude(
        time_s=readings.time_s[first:],
        quaternion=_carried_on(readings, first, start.as_matrix(), bias),
        # Judgements for MEMS gyroscopes; the heading is unknown.
        std_rad=np.radians([2.0, 2.0, np.inf]),
        wander_rad=np.radians([0.5, 0.5, 0.5]),
        heading_known=known is not None,
    )
    if known is None:
        return found
    before = known.time_s < found.time_s[0]
    return replace(
        found,
        time_s=np.concatenate([known.time_s[before], found.time_s]),
        quaternion=np.concatenate([known.quaternion[before], found.quaternion]),
    )


def _carried_on(readings: Readings, first: int, attitude: Floats, bias: Floats) -> Floats:
    """Return quaternions (n - first, 4) integrated from the `attitude` (3, 3) of reading `first`."""
    steps = np.minimum(np.diff(readings.time_s[first:], append=readings.time_s[-1]), 0.1)
    turns = Rotation.from_rotvec((readings.gyro[first:] - bias) * steps[:, None]).as_matrix()
    pulls = ndimage.uniform_filter1d(readings.force, readings.per_window, axis=0, mode="constant")[first:]
    sizes = np.linalg.norm(pulls, axis=1)
    pulls /= np.maximum(sizes, 1e-9)[:, None]
    # A tenth of the tilt against the specific force is corrected per second (Mahony, Hamel and Pflimlin 2008).
    shares = np.where((sizes > 0.8 * GRAVITY_M_S2) & (sizes < 1.2 * GRAVITY_M_S2), 0.1 * steps, 0.0)
    found, up = np.empty((len(steps), 3, 3)), np.array([0.0, 0.0, 1.0])
    for k, share in enumerate(shares.tolist()):
        found[k] = attitude
        # A rotation by pull x vertical, small enough to be linear: the last row of the matrix is the world's vertical.
        levelling = np.outer(up, pulls[k]) - np.outer(attitude @ pulls[k], attitude[2])
        attitude = (attitude + share * levelling) @ turns[k]
    return np.asarray(Rotation.from_matrix(found).as_quat())


def _gyro_bias(readings: Readings, known: Attitude, until_s: float) -> Floats:
    """Return the bias of the gyroscope (3,), rad/s: the median of its readings minus the known turn rates, which are
    means over half a second."""
    step_s = 0.5
    last = min(until_s, float(known.time_s[-1]), float(readings.time_s[-1]))
    edges = np.arange(max(float(known.time_s[0]), float(readings.time_s[0])), last, step_s)
    slot = np.searchsorted(edges, readings.time_s, side="right") - 1
    there = np.intersect1d(slot, np.arange(len(edges) - 1))
    if not len(there):
        return np.zeros(3)
    at = known.at(edges)
    rates = (at[:-1].inv() * at[1:]).as_rotvec() / step_s
    read = np.column_stack([ndimage.mean(axis, slot, there) for axis in readings.gyro.T])
    return np.asarray(np.median(read - rates[there], axis=0))
