"""Trajectories of bodies, evaluated at many instants at once, and the readings of their inertial and height sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.interpolate import BSpline, CubicHermiteSpline, CubicSpline, PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from uwblink.arrays import Columns, Floats, in_time_order
from uwbsim.random_streams import stream
from uwbsim.scenario.bodies import Carried, Figure, Height, Imu, RandomFlight, Recorded, Static, Waypoints
from uwbsim.scenario.model import Scenario
from uwbsim.world.clocks import NS_PER_S

Draw = Callable[[str], np.random.Generator]
"""Returns the random stream of a body, or of a pair of tags, for a purpose."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A body's path at seconds (n,): positions (n, 3) in metres in the world frame (ENU), attitudes body to world.

    Attitudes are quaternions x y z w, (n, 4).
    """

    position_m: Callable[[Floats], Floats]
    quaternion: Callable[[Floats], Floats]

    def pose(self, time_s: Floats) -> tuple[Floats, Floats]:
        """Return positions (n, 3) and rotations body to world (n, 3, 3)."""
        return self.position_m(time_s), Rotation.from_quat(self.quaternion(time_s)).as_matrix()


def _quaternions(angles: Floats) -> Floats:
    """Return yaw, pitch, roll (n, 3) as quaternions x y z w: SciPy's `from_euler("ZYX")` in a fifth of its time."""
    (cz, cy, cx), (sz, sy, sx) = np.cos(angles / 2).T, np.sin(angles / 2).T
    # The product of yaw and pitch; then that with roll.
    x, y, z, w = -(sz * sy), cz * sy, cy * sz, cz * cy
    return np.stack([w * sx + cx * x, cx * y + z * sx, cx * z - y * sx, w * cx - x * sx], axis=1)


def sample(
    motion: RandomFlight | Waypoints | Figure | Static | Carried | Recorded, duration_s: float, draw: Draw
) -> Trajectory:
    """Return the trajectory of a body over [0, duration_s]; `draw` returns the streams of random trajectories.

    A longer duration continues the same flight.
    """
    makers: dict[type, Callable[[Any, float, Draw], Trajectory]] = {
        Static: _static,
        Carried: _carried,
        Waypoints: _waypoints,
        RandomFlight: _random_flight,
        Figure: _figure,
        Recorded: _recorded,
    }
    return makers[type(motion)](motion, duration_s, draw)


def _static(motion: Static, _duration_s: float, _draw: Draw) -> Trajectory:
    point = np.array(motion.position_m)
    yaw = np.array([np.radians(motion.yaw_deg), 0.0, 0.0])
    return Trajectory(
        lambda t: np.broadcast_to(point, (len(t), 3)).copy(),
        lambda t: _quaternions(np.broadcast_to(yaw, (len(t), 3))),
    )


def _carried(motion: Carried, _duration_s: float, _draw: Draw) -> Trajectory:
    # Each place twice, at arrival and departure: from standstill to standstill.
    places = np.repeat(np.array(motion.places_m), 2, axis=0)
    arrivals = np.arange(len(motion.places_m)) * (motion.stay_s + motion.carry_s)
    times = np.column_stack([arrivals, arrivals + motion.stay_s]).ravel()
    return Trajectory(_held(CubicHermiteSpline(times, places, np.zeros_like(places)), times), _level)


def _waypoints(motion: Waypoints, _duration_s: float, _draw: Draw) -> Trajectory:
    points = np.array(motion.points_m)
    if motion.times_s is None:
        return Trajectory(_straight(points, motion.speed_mps or 1.0, motion.acceleration_mps2), _level)
    times = np.array(motion.times_s)
    return Trajectory(_held(CubicSpline(times, points, bc_type="clamped"), times), _level)


def _held(path: Callable[[Floats], Any], times: Floats) -> Callable[[Floats], Floats]:
    """Return a path through points at some times, without motion before the first and after the last."""
    return lambda t: np.asarray(path(np.clip(t, times[0], times[-1])))


def _level(time_s: Floats) -> Floats:
    return _quaternions(np.zeros((len(time_s), 3)))


def _straight(points: Floats, speed: float, acceleration: float) -> Callable[[Floats], Floats]:
    """Return positions on straight legs between stops: trapezoids of speed, or triangles on short legs."""
    legs = np.linalg.norm(np.diff(points, axis=0), axis=1)
    top = np.minimum(speed, np.sqrt(legs * acceleration))
    ramp = top / acceleration
    took = ramp + legs / top
    begins = np.concatenate([[0.0], np.cumsum(took)])

    def position(time_s: Floats) -> Floats:
        time = np.clip(time_s, 0, begins[-1])
        leg = np.clip(np.searchsorted(begins, time, side="right") - 1, 0, len(legs) - 1)
        into, left = time - begins[leg], begins[leg + 1] - time
        along = np.where(
            into < ramp[leg],
            0.5 * acceleration * into**2,
            np.where(left < ramp[leg], legs[leg] - 0.5 * acceleration * left**2, top[leg] * (into - ramp[leg] / 2)),
        )
        share = along / legs[leg]
        return np.asarray(points[leg] + share[:, None] * (points[leg + 1] - points[leg]))

    return position


def _figure(motion: Figure, _duration_s: float, _draw: Draw) -> Trajectory:
    centre, radius = np.array(motion.centre_m), motion.radius_m

    def position(time_s: Floats) -> Floats:
        angle = 2 * np.pi * time_s / motion.period_s + np.radians(motion.phase_deg)
        sideways = np.sin(2 * angle) / 2 if motion.shape == "eight" else np.sin(angle)
        # The height of a helix has a period of five rounds, the height of other figures of one.
        slow = angle / 5 if motion.shape == "helix" else angle
        height = 0.5 * motion.climb_m * np.sin(slow)
        return np.asarray(centre + np.column_stack([radius * np.cos(angle), radius * sideways, height]))

    def turning(time_s: Floats) -> Floats:
        yaw = 2 * np.pi * motion.turns_per_period * time_s / motion.period_s
        return _quaternions(np.column_stack([yaw, np.zeros((len(time_s), 2))]))

    return Trajectory(position, turning)


def _recorded(motion: Recorded, _duration_s: float, _draw: Draw) -> Trajectory:
    """Return a monotone cubic through recorded positions, and spherical interpolation of recorded attitudes."""
    times = np.array(motion.times_s)
    path = PchipInterpolator(times, np.array(motion.positions_m))
    turns = Slerp(times, Rotation.from_quat(np.array(motion.quaternions)))
    return Trajectory(_held(path, times), _held(lambda t: turns(t).as_quat(), times))


def _random_flight(motion: RandomFlight, duration_s: float, draw: Draw) -> Trajectory:
    lo, hi = np.array(motion.box_min_m), np.array(motion.box_max_m)
    # Two random points of a box lie about 0.38 of its diagonal apart.
    leg_s = 0.38 * float(np.linalg.norm(hi - lo)) / motion.speed_mps
    # One control point per leg. A B-spline stays in the convex hull of its control points, hence in the box, and a
    # cubic one has continuous acceleration.
    count = int(np.ceil(duration_s / leg_s)) + 8
    knots = (np.arange(count + 4, dtype=np.float64) - 5) * leg_s
    path = BSpline(knots, draw("position").uniform(lo, hi, (count, 3)), 3)
    tilt_rad = 0.12  # standard deviation of roll and pitch of a quadcopter in calm flight
    turns = draw("yaw")
    yaw = turns.uniform(-np.pi, np.pi) + np.cumsum(turns.normal(0, 0.8, count))
    angles = BSpline(knots, np.column_stack([yaw, draw("tilt").normal(0, tilt_rad, (count, 2))]), 3)
    # The body stops one leg after the end, when the last exchange is over.
    last_s = duration_s + leg_s
    return Trajectory(
        lambda t: np.asarray(path(np.minimum(t, last_s))),
        lambda t: _quaternions(np.asarray(angles(np.minimum(t, last_s)))),
    )


def sensor_readings(
    scenario: Scenario, trajectories: Mapping[str, Trajectory], sensor: Literal["imu", "height"]
) -> Columns:
    """Return the columns of a sensor's table, in order of time; no columns where no body has the sensor."""
    parts = []
    for body in scenario.bodies:
        if (model := getattr(body, sensor)) is not None:
            count = int(np.ceil(scenario.run.duration_s * model.rate_hz)) + 1
            time_ns = np.rint(np.arange(count) * NS_PER_S / model.rate_hz).astype(np.int64)
            rng, path = stream(scenario.run.seed, sensor, body.name), trajectories[body.name]
            read = (_inertial if sensor == "imu" else _height)(model, rng, path, time_ns / NS_PER_S)
            parts.append({"time_ns": time_ns, "body": np.full(count, body.name)} | read)
    return in_time_order(parts)


def _inertial(imu: Imu, rng: np.random.Generator, path: Trajectory, time_s: Floats) -> Columns:
    gyro, force = true_motion(path, time_s)
    gyro = gyro + _errors(rng, imu, "gyro", len(time_s))
    force = force + _errors(rng, imu, "force", len(time_s)) + imu.vibration_mps2 * rng.normal(size=force.shape)
    return dict(zip(("wx", "wy", "wz", "ax", "ay", "az"), np.hstack([gyro, force]).T, strict=True))


def _height(sensor: Height, rng: np.random.Generator, path: Trajectory, time_s: Floats) -> Columns:
    height = path.position_m(time_s)[:, 2] + rng.normal(0.0, sensor.bias_m)
    return {"height_m": height + rng.normal(0.0, sensor.noise_m, len(time_s))}


def true_motion(path: Trajectory, time_s: Floats) -> tuple[Floats, Floats]:
    """Return angular velocity (n, 3) in rad/s and specific force (n, 3) in m/s^2, both in the axes of the body."""
    # The rounding error of positions is 1e-16, so the error of accelerations over 2 ms is 1e-9.
    step_s = 1e-3
    before, after = (Rotation.from_quat(path.quaternion(time_s + sign * step_s)) for sign in (-1, 1))
    gyro = (before.inv() * after).as_rotvec() / (2 * step_s)
    early, now, late = (path.position_m(time_s + sign * step_s) for sign in (-1, 0, 1))
    force = (late - 2 * now + early) / step_s**2 + (0.0, 0.0, 9.81)
    return np.asarray(gyro), np.asarray(Rotation.from_quat(path.quaternion(time_s)).inv().apply(force))


def _errors(rng: np.random.Generator, imu: Imu, which: str, count: int) -> Floats:
    """Return the sum of constant bias, random walk of the bias, and white noise, (n, 3), in SI units."""
    (bias, walk, noise), root = imu.errors(which), np.sqrt(imu.rate_hz)
    wander = np.cumsum(rng.normal(0.0, walk / root, (count, 3)), axis=0)
    return np.asarray(rng.normal(0.0, bias, 3) + wander + rng.normal(0.0, noise * root, (count, 3)))
