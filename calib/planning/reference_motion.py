"""A reference flight for a plan: bodies move on sums of sines in a room and range in turn, without errors."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from calib.data.samples import stamped
from calib.evaluation.filters import GRAVITY_M_S2
from calib.planning.settings import FlightPlanSettings
from uwblink.arrays import Floats, Ints
from uwblink.recording.contents import Contents
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Poses, Tag


def reference_motion(flown: FlightPlanSettings) -> Contents:
    """Return a flight without errors or delays; the same for the same seed."""
    rng = np.random.default_rng(flown.seed)
    bodies = {f"robot{k + 1}": _motion(flown, k, rng) for k in range(len(flown.robots))}
    tags = [
        *(
            Tag(tag, body, tuple(arm))
            for body, robot in zip(bodies, flown.robots, strict=True)
            for tag, arm in zip(robot, _arms(len(robot), flown.apart_m).tolist(), strict=True)
        ),
        *(Tag(tag, f"anchor{tag}", (0.0, 0.0, 0.0)) for tag in flown.anchors),
    ]
    poses = _poses(flown, bodies)
    time_ns = _ns(np.arange(int(flown.seconds * flown.rate_hz)) / flown.rate_hz)
    pair = _in_turn(flown, len(time_ns), rng)
    distance = distances_m(poses, tags, pair[:, 0], pair[:, 1], time_ns)
    # As in free space, -80 dBm at 2 m, with 3 dB of fading.
    power = -80.0 - 20 * np.log10(distance / 2) + rng.normal(0, 3.0, (2, len(time_ns)))
    imu = _readings(bodies, flown.seconds) if flown.inertial else {}
    return Contents(exchanges=stamped(time_ns, pair, distance, power), tags=tags, poses=poses, imu=imu)


def _ns(time_s: Floats) -> Ints:
    return np.rint(time_s * 1e9).astype(np.int64)


def _motion(flown: FlightPlanSettings, number: int, rng: np.random.Generator) -> BSpline:
    """Return position and yaw (4,) of a body over time: two sines per axis about its own centre, upright, turning left
    and right.

    The body stands still, starts, and has its full speed 3 s later: a judgement, a gentle start at 1 m/s.
    """
    size, angle = np.array(flown.size_m), 2 * np.pi * number / len(flown.robots) + 0.4
    # Centres lie on an ellipse of 0.3 of the room; each of the two sines is 0.12 of it.
    middle = size * (0.5 + 0.3 * np.array([np.cos(angle), np.sin(angle), 0.0]))
    reach = 0.12 * size
    slow = 2 * np.pi * float(np.linalg.norm(reach)) / flown.speed_m_s
    rate = 2 * np.pi / (slow * rng.uniform(0.65, 1.7, (3, 2)))
    phase = rng.uniform(0, 2 * np.pi, (3, 2))
    # A turn by up to 1.2 rad either way takes 11 to 19 s.
    turning = 2 * np.pi / rng.uniform(11.0, 19.0)
    heading = float(rng.uniform(-np.pi, np.pi))
    # Cubic splines through samples every 0.02 s are exact to micrometres and 1e-4 m/s^2.
    along = time = np.arange(-1.5, flown.seconds + 1.5, 0.02)
    if flown.still_s:
        # The pace rises from 0 to 1 by 3 u^2 - 2 u^3, whose integral this is.
        u = np.clip((time - flown.still_s) / 3.0, 0.0, 1.0)
        along = 3.0 * (u**3 - u**4 / 2) + np.maximum(time - flown.still_s - 3.0, 0.0)
    place = middle + reach * np.sin(rate * along[:, None, None] + phase).sum(axis=2)
    return make_interp_spline(time, np.column_stack([place, heading + 1.2 * np.sin(turning * along)]))


def _arms(count: int, apart_m: float) -> Floats:
    """Return lever arms of the tags of a body (count, 3): on a circle, 5 cm below the body."""
    angle = 2 * np.pi * np.arange(count) / count + np.pi / 4
    return np.column_stack([apart_m / 2 * np.cos(angle), apart_m / 2 * np.sin(angle), np.full(count, -0.05)])


def _corners(flown: FlightPlanSettings) -> Floats:
    """Return the positions of anchors (n, 3) around the room, at 5 % and 95 % of its height in turn."""
    number = np.arange(len(flown.anchors))
    angle = 2 * np.pi * number / max(len(number), 1) + np.pi / 4
    around = np.column_stack([np.cos(angle), np.sin(angle)])
    around = 0.5 + 0.5 * around / np.abs(around).max(axis=1, keepdims=True)
    return np.asarray(flown.size_m * np.column_stack([around, np.where(number % 2, 0.95, 0.05)]))


def _in_turn(flown: FlightPlanSettings, count: int, rng: np.random.Generator) -> Ints:
    """Return the tags (n, 2) of the ranges: all pairs on different bodies but two anchors, each round in another order."""
    body = {tag: k for k, robot in enumerate(flown.robots) for tag in robot}
    pairs = [
        *((a, b) for a, b in combinations(body, 2) if body[a] != body[b]),
        *((tag, anchor) for tag in body for anchor in flown.anchors),
    ]
    rounds = [rng.permutation(pairs) for _ in range(-(-count // len(pairs)))]
    return np.concatenate(rounds)[:count].astype(np.int64)


def _poses(flown: FlightPlanSettings, bodies: Mapping[str, BSpline]) -> Poses:
    """Return the poses of all bodies; anchors have one at the start and one at the end."""
    time = np.arange(-1.0, flown.seconds + 1.0, 0.05)
    rows = [
        *((name, time, motion(time)) for name, motion in bodies.items()),
        *(
            (f"anchor{tag}", time[[0, -1]], np.tile([*place, 0.0], (2, 1)))
            for tag, place in zip(flown.anchors, _corners(flown), strict=True)
        ),
    ]
    names, times, where = zip(*rows, strict=True)
    x, y, z, yaw = np.concatenate(where).T
    upright = np.column_stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)])
    body = np.repeat(names, [len(one) for one in times])
    return Poses.from_arrays(_ns(np.concatenate(times)), body, np.column_stack([x, y, z]), upright)


def _readings(bodies: Mapping[str, BSpline], seconds: float) -> dict[str, Any]:
    """Return the table of inertial readings, 50 a second, without errors."""
    time, rows = np.arange(0.0, seconds + 0.5, 0.02), []
    for name, motion in bodies.items():
        yaw, rate, (x, y, z, _) = motion(time)[:, 3], motion(time, 1)[:, 3], motion(time, 2).T
        c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
        turns, forces = (zero, zero, rate), (c * x + s * y, c * y - s * x, z + GRAVITY_M_S2)
        rows.append((_ns(time), np.full(len(time), name), *turns, *forces))
    names = ("time_ns", "body", "wx", "wy", "wz", "ax", "ay", "az")
    return {name: np.concatenate(parts) for name, parts in zip(names, zip(*rows, strict=True), strict=True)}
