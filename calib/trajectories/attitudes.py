"""Attitudes of bodies, given or integrated from gyroscopes, and mean specific forces of accelerometers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation, Slerp

from calib.evaluation.inertial_filter import GRAVITY_M_S2
from calib.trajectories.samples import SAMPLE_S, Samples
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
        turned = Rotation.from_euler("z", heading_rad) * Rotation.from_quat(self.quaternion)
        return replace(self, quaternion=turned.as_quat())

    def at(self, time_s: Floats) -> Rotation:
        """Return the rotations at instants (n,), interpolated between quaternions, constant outside."""
        return self._slerp(np.clip(time_s, self.time_s[0], self.time_s[-1]))

    @cached_property
    def _slerp(self) -> Slerp:
        # A second instant makes a single attitude last.
        instants, rows = np.unique(np.append(self.time_s, self.time_s[-1] + 1.0), return_index=True)
        return Slerp(instants, Rotation.from_quat(self.quaternion[np.minimum(rows, len(self.time_s) - 1)]))


STRONGEST_M_S2 = 4.0
"""Windows with larger mean accelerations are left out: they are impacts, not flight."""

FORCE_STD_M_S2 = 0.5
"""Standard error of a mean specific force before residuals are known."""

LEVELLING = 0.1
"""Share of the tilt against the specific force that is corrected per second (Mahony, Hamel and Pflimlin 2008)."""


@dataclass(frozen=True, slots=True)
class Inertial(Samples):
    """Windows of an accelerometer, `SAMPLE_S` long, about `time_s` (k,).

    `force_m_s2` (k, 3) is the mean specific force in the world's axes by the given attitudes, `turn` (k, 3, 3) the mean
    rotation, `std_m_s2` the standard error of a mean.
    """

    force_m_s2: Floats
    turn: Floats
    std_m_s2: float = FORCE_STD_M_S2

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
        if not table:
            return None
        values = np.column_stack([table[f"{kind}{axis}"] for kind in "wa" for axis in "xyz"]).astype(np.float64)
        good: Bools = np.asarray((table["body"] == body) & np.isfinite(values).all(axis=1))
        rows = np.flatnonzero(good)
        rows = rows[np.argsort(table["time_ns"][rows], kind="stable")]
        time_s = np.asarray((table["time_ns"][rows] - began_ns) * 1e-9, dtype=np.float64)
        return cls(time_s, values[rows, :3], values[rows, 3:]) if len(rows) >= 10 else None

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
    kept = count >= 0.7 * readings.per_window
    kept &= np.linalg.norm(mean_force - (0, 0, GRAVITY_M_S2), axis=1) < STRONGEST_M_S2
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
    shares = np.where((sizes > 0.8 * GRAVITY_M_S2) & (sizes < 1.2 * GRAVITY_M_S2), LEVELLING * steps, 0.0)
    found, up = np.empty((len(steps), 3, 3)), np.array([0.0, 0.0, 1.0])
    for k, share in enumerate(shares.tolist()):
        found[k] = attitude
        # A turn by pull x vertical, small enough to be linear: the last row of the matrix is the world's vertical.
        levelling = np.outer(up, pulls[k]) - np.outer(attitude @ pulls[k], attitude[2])
        attitude = (attitude + share * levelling) @ turns[k]
    return np.asarray(Rotation.from_matrix(found).as_quat())


def _gyro_bias(readings: Readings, known: Attitude, until_s: float, step_s: float = 0.5) -> Floats:
    """Return the bias of the gyroscope (3,), rad/s: the median of its readings less the known turn rates, which are
    means over `step_s`."""
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
