"""What inertial and height sensors of bodies read: motion by finite differences, with bias, noise and vibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.sensors import Height, Imu
from uwbsim.scenario.tags import Body
from uwbsim.units import NS_PER_S
from uwbsim.world.trajectories import Trajectory

GRAVITY_M_S2: Final = 9.81
STEP_S: Final = 1e-3
"""Half of the time over which motion is differenced; positions are exact to 1e-16, accelerations so to 1e-9."""

Columns = dict[str, NDArray[Any]]


def inertial_readings(scenario: Scenario, trajectories: Mapping[str, Trajectory]) -> Columns:
    """Return the columns of the table `imu`, in order of time; none where no body has such a sensor."""
    parts = [_imu_of(scenario, body, trajectories[body.name], body.imu) for body in scenario.bodies if body.imu]
    return _in_order(parts)


def height_readings(scenario: Scenario, trajectories: Mapping[str, Trajectory]) -> Columns:
    """Return the columns of the table `height`, in order of time; none where no body has such a sensor."""
    parts = [
        _heights_of(scenario, body, trajectories[body.name], body.height) for body in scenario.bodies if body.height
    ]
    return _in_order(parts)


def _imu_of(scenario: Scenario, body: Body, path: Trajectory, imu: Imu) -> Columns:
    time_s, time_ns = _times(scenario, imu.rate_hz)
    rng = stream(scenario.run.seed, "imu", body.name)
    gyro, force = true_motion(path, time_s)
    gyro = gyro + _errors(rng, imu, "gyro", len(time_s))
    force = force + _errors(rng, imu, "force", len(time_s)) + imu.vibration_mps2 * rng.normal(size=force.shape)
    columns: Columns = {"time_ns": time_ns, "body": np.full(len(time_ns), body.name)}
    columns |= dict(zip(("wx", "wy", "wz"), gyro.T, strict=True))
    return columns | dict(zip(("ax", "ay", "az"), force.T, strict=True))


def true_motion(path: Trajectory, time_s: Floats) -> tuple[Floats, Floats]:
    """Return angular velocity (n, 3) in rad/s and specific force (n, 3) in m/s^2, both in the axes of the body."""
    from scipy.spatial.transform import Rotation

    before, after = (Rotation.from_quat(path.quaternion(time_s + sign * STEP_S)) for sign in (-1, 1))
    gyro = (before.inv() * after).as_rotvec() / (2 * STEP_S)
    early, now, late = (path.position_m(time_s + sign * STEP_S) for sign in (-1, 0, 1))
    pull = (late - 2 * now + early) / STEP_S**2 + (0.0, 0.0, GRAVITY_M_S2)
    return np.asarray(gyro), np.asarray(Rotation.from_quat(path.quaternion(time_s)).inv().apply(pull))


def _errors(rng: np.random.Generator, imu: Imu, which: str, count: int) -> Floats:
    """Return a bias that wanders, and white noise (n, 3), in SI units."""
    found = imu.errors(which)
    root = np.sqrt(imu.rate_hz)
    wander = np.cumsum(rng.normal(0.0, found.wander / root, (count, 3)), axis=0)
    return np.asarray(rng.normal(0.0, found.bias, 3) + wander + rng.normal(0.0, found.noise * root, (count, 3)))


def _heights_of(scenario: Scenario, body: Body, path: Trajectory, sensor: Height) -> Columns:
    time_s, time_ns = _times(scenario, sensor.rate_hz)
    rng = stream(scenario.run.seed, "height", body.name)
    height = (
        path.position_m(time_s)[:, 2] + rng.normal(0.0, sensor.bias_m) + rng.normal(0.0, sensor.noise_m, len(time_s))
    )
    return {"time_ns": time_ns, "body": np.full(len(time_ns), body.name), "height_m": height}


def _times(scenario: Scenario, rate_hz: float) -> tuple[Floats, NDArray[np.int64]]:
    count = int(np.ceil(scenario.run.duration_s * rate_hz)) + 1
    time_ns = np.rint(np.arange(count) * NS_PER_S / rate_hz).astype(np.int64)
    return time_ns / NS_PER_S, time_ns


def _in_order(parts: list[Columns]) -> Columns:
    if not parts:
        return {}
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(columns["time_ns"], kind="stable")
    return {name: column[order] for name, column in columns.items()}
