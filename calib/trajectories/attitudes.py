"""Attitudes of bodies, given or integrated from gyroscopes, and mean specific forces of accelerometers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from uwblink.arrays import Bools, Floats


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
        return replace(self, quaternion=(_about_vertical(heading_rad) * Rotation.from_quat(self.quaternion)).as_quat())

    @property
    def exact(self) -> bool:
        """Whether the attitudes have no errors."""
        return not (self.std_rad.any() or self.wander_rad.any())

    def at(self, time_s: Floats) -> Floats:
        """Return rotation matrices (n, 3, 3) at instants (n,), interpolated between quaternions, constant outside."""
        time = np.clip(time_s, self.time_s[0], self.time_s[-1])
        return np.asarray(self._turn(time).as_matrix())

    @cached_property
    def _turn(self) -> Slerp:
        # A second instant makes a single attitude last.
        instants, rows = np.unique(np.append(self.time_s, self.time_s[-1] + 1.0), return_index=True)
        return Slerp(instants, Rotation.from_quat(self.quaternion[np.minimum(rows, len(self.time_s) - 1)]))


def _about_vertical(heading_rad: float) -> Rotation:
    return Rotation.from_rotvec([0.0, 0.0, heading_rad])


GRAVITY_M_S2 = 9.81
WINDOW_S = 0.1
"""Specific forces are averaged over this time: vibrations cancel, and the acceleration of a spline hardly changes."""

STRONGEST_M_S2 = 4.0
"""Windows with larger mean accelerations are left out: they are impacts, not flight."""

FORCE_STD_M_S2 = 0.5
"""Standard error of a mean specific force before residuals are known."""

LEVELLING = 0.1
"""Share of the tilt against the specific force that is corrected per second (Mahony, Hamel and Pflimlin 2008)."""

TILT_STD = float(np.radians(2.0))
TILT_WANDER = float(np.radians(0.5))
HEADING_WANDER = float(np.radians(0.5))
"""Standard deviations of integrated attitudes (rad) and of their random walk (rad per root second)."""

BIAS_STEP_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Inertial:
    """Windows of an accelerometer from `begin_s` to `end_s` (k,).

    `force_m_s2` (k, 3) is the mean specific force in the world's axes by the given attitudes, `turn` (k, 3, 3) the mean
    rotation, `std_m_s2` the standard error of a mean.
    """

    begin_s: Floats
    end_s: Floats
    force_m_s2: Floats
    turn: Floats
    std_m_s2: float = FORCE_STD_M_S2

    def between(self, begin_s: float, end_s: float) -> Inertial:
        """Return the windows inside a span of time."""
        rows = (self.begin_s >= begin_s) & (self.end_s <= end_s)
        chosen = {name: getattr(self, name)[rows] for name in ("begin_s", "end_s", "force_m_s2", "turn")}
        return replace(self, **chosen)

    def turned_by(self, heading_rad: float) -> Inertial:
        """Return a copy that is rotated about the world's vertical."""
        turn = _about_vertical(heading_rad).as_matrix()
        return replace(self, force_m_s2=self.force_m_s2 @ turn.T, turn=turn @ self.turn)


@dataclass(frozen=True, slots=True)
class Readings:
    """One body's readings in order of time: seconds (n,), angular velocity (n, 3) in rad/s, specific force (n, 3)."""

    time_s: Floats
    gyro: Floats
    force: Floats

    @classmethod
    def of(cls, table: Mapping[str, NDArray[Any]], body: str, began_ns: int) -> Readings | None:
        """Return the readings of a body from a recording's table; None where it has too few."""
        if not table:
            return None
        rows = np.flatnonzero(table["body"] == body)
        columns = [np.column_stack([table[f"{kind}{axis}"][rows] for axis in "xyz"]) for kind in "wa"]
        good: Bools = np.asarray(np.isfinite(np.hstack(columns)).all(axis=1))
        rows, columns = rows[good], [column[good] for column in columns]
        if len(rows) < 10:
            return None
        order = np.argsort(table["time_ns"][rows], kind="stable")
        time = np.asarray((table["time_ns"][rows][order] - began_ns) * 1e-9, dtype=np.float64)
        return cls(time, columns[0][order].astype(np.float64), columns[1][order].astype(np.float64))


def windows(readings: Readings, attitude: Attitude, last_s: float) -> Inertial:
    """Return the windows of an accelerometer between the first and the last range."""
    time = readings.time_s
    inside = (time >= max(0.0, float(attitude.time_s[0]))) & (time < min(last_s, float(attitude.time_s[-1])))
    turn = attitude.at(time[inside])
    force = np.einsum("nij,nj->ni", turn, readings.force[inside])
    slot = np.floor(time[inside] / WINDOW_S).astype(np.int64)
    starts = np.flatnonzero(np.diff(slot, prepend=-1))
    count = np.diff(starts, append=len(slot))
    if not len(starts):
        return Inertial(begin_s=np.zeros(0), end_s=np.zeros(0), force_m_s2=np.zeros((0, 3)), turn=np.zeros((0, 3, 3)))
    mean_force = np.add.reduceat(force, starts) / count[:, None]
    mean_turn = np.add.reduceat(turn, starts) / count[:, None, None]
    kept = count >= 0.7 * np.median(count)
    kept &= np.linalg.norm(mean_force - (0, 0, GRAVITY_M_S2), axis=1) < STRONGEST_M_S2
    begin = slot[starts][kept] * WINDOW_S
    return Inertial(begin_s=begin, end_s=begin + WINDOW_S, force_m_s2=mean_force[kept], turn=mean_turn[kept])


def integrated(readings: Readings, known: Attitude | None, until_s: float) -> Attitude:
    """Return attitudes integrated from the gyroscope and levelled by the accelerometer.

    Before `until_s` they are the `known` ones, from which the gyroscope's bias is estimated. Without known attitudes
    the first heading is 0 and unknown.
    """
    early = known is not None and bool(np.any(known.time_s < until_s)) and until_s > 0
    bias, turn = np.zeros(3), _level(readings)
    first = 0
    if known is not None and early:
        bias = _gyro_bias(readings, known, until_s)
        first = int(np.clip(np.searchsorted(readings.time_s, until_s), 1, len(readings.time_s) - 1))
        turn = known.at(readings.time_s[first : first + 1])[0]
    time, found = readings.time_s[first:], _carried_on(readings, first, turn, bias)
    wander = np.array([TILT_WANDER, TILT_WANDER, HEADING_WANDER])
    if known is not None and early:
        before = known.time_s < time[0]
        time = np.concatenate([known.time_s[before], time])
        found = np.concatenate([known.quaternion[before], found])
    return Attitude(
        time_s=time,
        quaternion=found,
        std_rad=np.array([TILT_STD, TILT_STD, np.inf]),
        wander_rad=wander,
        heading_known=early,
    )


def _carried_on(readings: Readings, first: int, turn: Floats, bias: Floats) -> Floats:
    """Return quaternions (n - first, 4) integrated from the attitude `turn` of reading `first`."""
    steps = np.minimum(np.diff(readings.time_s[first:], append=readings.time_s[-1]), 0.1)
    turns = Rotation.from_rotvec((readings.gyro[first:] - bias) * steps[:, None]).as_matrix()
    pulls = _smoothed(readings)[first:]
    sizes = np.linalg.norm(pulls, axis=1)
    pulls /= np.maximum(sizes, 1e-9)[:, None]
    shares = np.where((sizes > 0.8 * GRAVITY_M_S2) & (sizes < 1.2 * GRAVITY_M_S2), LEVELLING * steps, 0.0)
    found, attitude, up = np.empty((len(steps), 3, 3)), turn, np.array([0.0, 0.0, 1.0])
    for k, share in enumerate(shares.tolist()):
        found[k] = attitude
        # A turn by pull x vertical, small enough to be linear: the last row of the matrix is the world's vertical.
        levelling = np.outer(up, pulls[k]) - np.outer(attitude @ pulls[k], attitude[2])
        attitude = (attitude + share * levelling) @ turns[k]
    return np.asarray(Rotation.from_matrix(found).as_quat())


def _smoothed(readings: Readings) -> Floats:
    """Return specific forces (n, 3), smoothed over one window."""
    count = max(int(WINDOW_S / max(float(np.median(np.diff(readings.time_s))), 1e-4)), 1)
    kernel = np.ones(count) / count
    return np.column_stack([np.convolve(column, kernel, mode="same") for column in readings.force.T])


def _level(readings: Readings) -> Floats:
    """Return the attitude whose vertical is the mean specific force of the first second."""
    early = readings.time_s < readings.time_s[0] + 1.0
    up = readings.force[early].mean(axis=0)
    up = up / np.linalg.norm(up)
    side = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    return np.array([np.cross(side, up), side, up])


def _gyro_bias(readings: Readings, known: Attitude, until_s: float) -> Floats:
    """Return the bias of the gyroscope (3,), rad/s: the median of its readings less the known turn rates."""
    last = min(until_s, float(known.time_s[-1]), float(readings.time_s[-1]))
    first = max(float(known.time_s[0]), float(readings.time_s[0]))
    edges = np.arange(first, last, BIAS_STEP_S)
    if len(edges) < 2:
        return np.zeros(3)
    at = Rotation.from_matrix(known.at(edges))
    turned = (at[:-1].inv() * at[1:]).as_rotvec() / BIAS_STEP_S
    slot = np.searchsorted(edges, readings.time_s, side="right") - 1
    there = [k for k in range(len(edges) - 1) if np.any(slot == k)]
    if not there:
        return np.zeros(3)
    return np.asarray(np.median([readings.gyro[slot == k].mean(axis=0) - turned[k] for k in there], axis=0))
