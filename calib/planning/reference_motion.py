"""A reference flight for a plan: bodies on sums of sines in a room, ranging in turn, without errors."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from calib.data.samples import SampleFlight, stamped
from calib.planning.settings import FlightPlanSettings
from uwblink.arrays import Floats, Ints
from uwblink.recording.schema import Poses, Tag

POSES_HZ = 20.0
IMU_HZ = 50.0
MIDDLES = 0.3
REACH = 0.12
"""Shares of the room: how far from its middle bodies fly about, and the size of each of the two sines an axis."""

PERIODS = (0.65, 1.7)
TURN_RAD = 1.2
TURNS_S = (11.0, 19.0)
HANGING_M = 0.05
POWER_AT_2_M_DBM = -80.0
FADING_DB = 3.0
GRAVITY_M_S2 = 9.81
EDGE = 0.05
SAMPLE_S = 0.02
"""Sampling interval of motion: cubic splines through the samples are exact to micrometres and 1e-4 m/s^2."""

STARTING_S = 3.0
"""Seconds from standstill to full speed."""


Motion = tuple[BSpline, BSpline]
"""Where a body is over time, and its yaw."""


def reference_motion(flown: FlightPlanSettings) -> SampleFlight:
    """Return a flight without errors or delays; the same for the same seed."""
    rng = np.random.default_rng(flown.seed)
    bodies = {f"robot{k + 1}": _motion(flown, k, rng) for k in range(len(flown.robots))}
    tags = [
        Tag(tag, body, tuple(arm))
        for body, robot in zip(bodies, flown.robots, strict=True)
        for tag, arm in zip(robot, _arms(len(robot), flown.apart_m).tolist(), strict=True)
    ]
    stands = dict(zip(flown.anchors, _corners(flown), strict=True))
    tags += [Tag(tag, f"anchor{tag}", (0.0, 0.0, 0.0)) for tag in stands]
    time = np.arange(int(flown.seconds * flown.rate_hz)) / flown.rate_hz
    pair = _in_turn(flown, len(time), rng)
    where = _antennas(bodies, tags, stands, time)
    number = {tag.tag: k for k, tag in enumerate(tags)}
    ends = np.vectorize(number.__getitem__)(pair)
    rows = np.arange(len(time))
    distance = np.linalg.norm(where[ends[:, 0], rows] - where[ends[:, 1], rows], axis=1)
    power = POWER_AT_2_M_DBM - 20 * np.log10(distance / 2) + rng.normal(0, FADING_DB, (2, len(time)))
    exchanges = stamped(np.rint(time * 1e9).astype(np.int64), pair, distance, power)
    imu = _readings(bodies, flown.seconds) if flown.inertial else {}
    return SampleFlight(exchanges, _poses(bodies, stands, flown.seconds), tags, {}, imu)


def _motion(flown: FlightPlanSettings, number: int, rng: np.random.Generator) -> Motion:
    """Return the motion of one body, upright and turning to and fro: two sines an axis about a middle of its own.

    Until it starts it stands; `STARTING_S` later it is as fast as it will be.
    """
    size, angle = np.array(flown.size_m), 2 * np.pi * number / len(flown.robots) + 0.4
    middle = size * (0.5 + MIDDLES * np.array([np.cos(angle), np.sin(angle), 0.0]))
    reach = REACH * size
    slow = 2 * np.pi * float(np.linalg.norm(reach)) / flown.speed_m_s
    rate = 2 * np.pi / (slow * rng.uniform(*PERIODS, (3, 2)))
    phase = rng.uniform(0, 2 * np.pi, (3, 2))
    turning = 2 * np.pi / rng.uniform(*TURNS_S)
    heading = float(rng.uniform(-np.pi, np.pi))
    time = np.arange(-1.5, flown.seconds + 1.5, SAMPLE_S)
    along = time
    if flown.still_s:
        # The pace rises from 0 to 1 by 3 u^2 - 2 u^3, whose integral this is.
        u = np.clip((time - flown.still_s) / STARTING_S, 0.0, 1.0)
        along = STARTING_S * (u**3 - u**4 / 2) + np.maximum(time - flown.still_s - STARTING_S, 0.0)
    place = middle + reach * np.sin(rate * along[:, None, None] + phase).sum(axis=2)
    yaw = heading + TURN_RAD * np.sin(turning * along)
    return make_interp_spline(time, place), make_interp_spline(time, yaw)


def _arms(count: int, apart_m: float) -> Floats:
    angle = 2 * np.pi * np.arange(count) / count + np.pi / 4
    return np.column_stack([apart_m / 2 * np.cos(angle), apart_m / 2 * np.sin(angle), np.full(count, -HANGING_M)])


def _corners(flown: FlightPlanSettings) -> list[Floats]:
    """Return places of anchors around the room, high and low in turn."""
    x, y, z = flown.size_m
    count = len(flown.anchors)
    angle = 2 * np.pi * np.arange(count) / max(count, 1) + np.pi / 4
    reach = 0.5 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    high = np.where(np.arange(count) % 2, 1 - EDGE, EDGE)
    return list(np.column_stack([x * (0.5 + reach * np.cos(angle)), y * (0.5 + reach * np.sin(angle)), z * high]))


def _in_turn(flown: FlightPlanSettings, count: int, rng: np.random.Generator) -> Ints:
    """Return who ranges with whom (n, 2): all pairs of bodies but two anchors, each round in another order."""
    body = {tag: k for k, robot in enumerate(flown.robots) for tag in robot}
    pairs = [(a, b) for a, b in combinations(body, 2) if body[a] != body[b]]
    pairs += [(tag, anchor) for tag in body for anchor in flown.anchors]
    rounds = [rng.permutation(pairs) for _ in range(-(-count // len(pairs)))]
    return np.concatenate(rounds)[:count].astype(np.int64)


def _antennas(bodies: Mapping[str, Motion], tags: list[Tag], stands: Mapping[int, Floats], time_s: Floats) -> Floats:
    """Return where each tag is at each instant (tags, n, 3)."""
    found = np.empty((len(tags), len(time_s), 3))
    for k, tag in enumerate(tags):
        if tag.tag in stands:
            found[k] = stands[tag.tag]
            continue
        (place, yaw), (x, y, z) = bodies[tag.body], tag.lever_arm_m
        c, s = np.cos(yaw(time_s)), np.sin(yaw(time_s))
        found[k] = place(time_s) + np.column_stack([c * x - s * y, s * x + c * y, np.full(len(c), z)])
    return found


def _poses(bodies: Mapping[str, Motion], stands: Mapping[int, Floats], seconds: float) -> Poses:
    time = np.arange(-1.0, seconds + 1.0, 1 / POSES_HZ)
    places = [place(time) for place, _ in bodies.values()] + [np.tile(place, (2, 1)) for place in stands.values()]
    yaws = [yaw(time) for _, yaw in bodies.values()] + [np.zeros(2) for _ in stands]
    times = [time for _ in bodies] + [time[[0, -1]] for _ in stands]
    names = [*bodies, *(f"anchor{tag}" for tag in stands)]
    yaw = np.concatenate(yaws)
    upright = np.column_stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)])
    each = [len(some) for some in times]
    return Poses.from_arrays(
        np.rint(np.concatenate(times) * 1e9).astype(np.int64), np.repeat(names, each), np.concatenate(places), upright
    )


def _readings(bodies: Mapping[str, Motion], seconds: float) -> dict[str, Any]:
    """Return the table of inertial readings, without errors."""
    time, rows = np.arange(0.0, seconds + 0.5, 1 / IMU_HZ), []
    for name, (place, yaw) in bodies.items():
        c, s = np.cos(yaw(time)), np.sin(yaw(time))
        x, y, z = place(time, 2).T
        turns, forces = (0 * c, 0 * c, yaw(time, 1)), (c * x + s * y, c * y - s * x, z + GRAVITY_M_S2)
        rows.append((np.rint(time * 1e9).astype(np.int64), np.full(len(time), name), *turns, *forces))
    names = ("time_ns", "body", "wx", "wy", "wz", "ax", "ay", "az")
    return {name: np.concatenate(parts) for name, parts in zip(names, zip(*rows, strict=True), strict=True)}
