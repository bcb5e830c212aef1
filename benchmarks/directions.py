"""Flights with delays that depend on direction and temperature, by a generator that shares no code with fits.

Robots move on sums of sines and turn about all axes; each has one tag. The effect of an antenna is a sum of waves over
azimuth that vanishes towards the poles, and not a spherical harmonic. `benchmarks.dependences` evaluates fits of these
flights.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from calib.data.samples import stamped
from uwblink.recording.antenna_delays import AntennaDelay, meta_of_delays
from uwblink.recording.contents import Contents
from uwblink.recording.schema import Poses, Tag

Floats = NDArray[np.float64]

POSES_HZ = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """Parameters of a flight; lengths are in metres, times in seconds.

    `pattern_m` is the difference between the longest and the shortest range of a turning robot over directions; with
    `own`, each antenna has its own pattern. `turning` is the share of a full turn that attitudes cover, 0 for robots
    that do not turn. Errors of pairs: `wall_m` is the standard deviation of a constant offset, `wander_m` that of an
    error with a correlation time of three seconds, and `room_m` that of an error that depends on the position of the
    pair's first robot. Robots on a `loop` head along it, so that directions depend on positions. Tags warm up by
    `warmer_k` from `start_c` within some tens of seconds and report their temperature each second; each end lengthens
    ranges by `mm_per_k`, which differs between tags by the standard deviation `apart_mm_per_k`.
    """

    robots: int = 4
    seconds: float = 60.0
    per_second: float = 60.0
    pattern_m: float = 0.1
    own: bool = False
    turning: float = 1.0
    noise_m: float = 0.05
    reflected: float = 0.1
    wall_m: float = 0.0
    wander_m: float = 0.0
    room_m: float = 0.0
    anchors: int = 0
    loop: bool = False
    warmer_k: float = 0.0
    start_c: float = 20.0
    mm_per_k: float = 0.0
    apart_mm_per_k: float = 0.0


def waves(rng: np.random.Generator, recipe: Recipe) -> Floats:
    """Return amplitudes and phases of two waves over azimuth, (tags + 1, 2, 2); the first wave is the larger one."""
    tags = recipe.robots + recipe.anchors + 1
    found = np.stack([np.tile([1.0, 0.35], (tags, 1)), rng.uniform(0, 2 * np.pi, (tags, 2))], axis=-1)
    return found if recipe.own else np.repeat(found[:1], tags, axis=0)


def pattern_m(direction: Floats, wave: Floats, size_m: float) -> Floats:
    """Return the effect of an antenna on ranges (n,) in directions (n, 3), unit vectors in the frame of its body."""
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    level = np.sqrt(np.clip(1 - direction[:, 2] ** 2, 0, 1))
    around = sum(h * np.cos((k + 1) * azimuth - phase) for k, (h, phase) in enumerate(wave))
    return np.asarray(0.5 * size_m * around * level)


def flight(recipe: Recipe, seed: int, number: int = 0) -> tuple[Contents, dict[str, Any]]:
    """Return a flight in the form of a recording, and the planted values; flights of one seed have the same boards."""
    boards, rng = np.random.default_rng([seed, 5_150]), np.random.default_rng([seed, 5_150, number + 1])
    count, tags = int(recipe.seconds * recipe.per_second), recipe.robots + recipe.anchors
    delays_ns, wave = boards.uniform(-0.4, 0.3, tags + 1), waves(boards, recipe)
    pairs = np.array([p for p in combinations(range(1, tags + 1), 2) if p[0] <= recipe.robots])
    walls_m = recipe.wall_m * boards.normal(size=len(pairs))
    arms = np.column_stack([boards.uniform(-0.1, 0.1, (tags + 1, 2)), np.full(tags + 1, 0.05)])
    arms[recipe.robots + 1 :] = 0.0
    motion = _motion(rng, recipe)
    time_s = np.sort(rng.uniform(0.5, recipe.seconds - 0.5, count))
    which = rng.integers(0, len(pairs), count)
    ends = np.where((rng.random(count) < 0.5)[:, None], pairs[which][:, ::-1], pairs[which])
    places, turned = np.empty((2, count, 3)), np.empty((2, count, 3, 3))
    for side in (0, 1):
        for tag in range(1, tags + 1):
            rows = ends[:, side] == tag
            centre, turned[side, rows] = motion(tag, time_s[rows])
            places[side, rows] = centre + turned[side, rows] @ arms[tag]
    way = places[1] - places[0]
    distance = np.linalg.norm(way, axis=1)
    error = np.zeros(count)
    for side, sign in ((0, 1.0), (1, -1.0)):
        direction = np.einsum("nij,ni->nj", turned[side], sign * way / distance[:, None])
        for tag in range(1, tags + 1):
            rows = ends[:, side] == tag
            error[rows] += pattern_m(direction[rows], wave[tag], recipe.pattern_m)
    power = -81 - 20 * np.log10(distance / 4) + 3 * np.sin(0.9 * time_s[None] + ends.T) + rng.normal(0, 0.8, (2, count))
    warmth, of_boards = np.random.default_rng([seed, 5_151, number]), np.random.default_rng([seed, 5_151])
    slopes = recipe.mm_per_k + recipe.apart_mm_per_k * of_boards.normal(size=tags + 1)
    slow_s, far = warmth.uniform(15, 40, tags + 1), warmth.uniform(0.7, 1.3, tags + 1)
    second = np.arange(0.0, recipe.seconds + 1)

    def celsius(tag: Any, at_s: Any) -> Floats:
        return np.asarray(recipe.start_c + recipe.warmer_k * far[tag] * (1 - np.exp(-at_s / slow_s[tag])))

    error += 1e-3 * sum(slopes[ends[:, side]] * (celsius(ends[:, side], time_s) - 25) for side in (0, 1))
    error += 0.12 * np.exp(-np.mean(10 ** ((power + 82) / 10), axis=0) / 0.4) + walls_m[which]
    error += recipe.noise_m * rng.normal(size=count)
    error += np.where(rng.random(count) < recipe.reflected, rng.gamma(2.0, 0.17, count), 0.0)
    error += recipe.room_m * _room(boards, places[0], places[1], ends, which)
    error += recipe.wander_m * _wander(rng, recipe, time_s, which)
    error -= 0.5 * 0.299702547 * (delays_ns[ends[:, 0]] + delays_ns[ends[:, 1]])
    time_ns = 1_000_000_000 + np.rint(time_s * 1e9).astype(np.int64)
    pose_s = np.arange(0, recipe.seconds + 1, 1 / POSES_HZ)
    tracks = [motion(tag, pose_s) for tag in range(1, tags + 1)]
    names = [f"robot{tag}" if tag <= recipe.robots else f"anchor{tag}" for tag in range(1, tags + 1)]
    still = [slice(None) if tag <= recipe.robots else slice(0, 1) for tag in range(1, tags + 1)]
    pose_ns = 1_000_000_000 + np.rint(pose_s * 1e9).astype(np.int64)
    poses = Poses(
        np.concatenate([pose_ns[own] for own in still]),
        np.concatenate([np.full(len(pose_s[own]), name) for own, name in zip(still, names, strict=True)]),
        np.concatenate([place[own] for (place, _), own in zip(tracks, still, strict=True)]),
        np.concatenate(
            [Rotation.from_matrix(turn[own]).as_quat() for (_, turn), own in zip(tracks, still, strict=True)]
        ),
    )
    carried = [Tag(tag, name, tuple(arms[tag].tolist())) for tag, name in enumerate(names, 1)]
    known = {"delays_ns": {str(tag): float(delays_ns[tag]) for tag in range(1, tags + 1)}}
    read = np.tile(second, tags), np.repeat(np.arange(1, tags + 1), len(second))
    readings = {
        "time_ns": 1_000_000_000 + (read[0] * 1e9).astype(np.int64),
        "tag": read[1],
        "temperature_c": celsius(read[1], read[0]) + warmth.normal(0, 0.2, len(read[0])),
        "supply_v": np.full(len(read[0]), np.nan),
    }
    found = Contents(
        exchanges=stamped(time_ns, ends, distance + error, power),
        tags=carried,
        poses=poses,
        temperature=readings if recipe.warmer_k else {},
        meta={"planted": known, **meta_of_delays({None: AntennaDelay()})},
    )
    return found, {"waves": wave, "mm_per_k": slopes}


def _motion(rng: np.random.Generator, recipe: Recipe) -> Any:
    """Return a function of tag and times that returns positions (n, 3) and attitudes (n, 3, 3)."""
    tags = recipe.robots + recipe.anchors + 1
    angle = 2 * np.pi * (np.arange(tags) + rng.uniform(0, 0.5, tags)) / max(tags - 1, 1)
    reach = np.where(np.arange(tags) <= recipe.robots, 2.2, 5.0)
    centre = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), rng.uniform(0.8, 2.2, tags)])
    rates, phases = rng.uniform(0.2, 1.2, (tags, 3, 3)), rng.uniform(0, 2 * np.pi, (tags, 3, 3))
    spin, start = rng.uniform(0.3, 0.7, tags) * rng.choice([-1, 1], tags), rng.uniform(0, 2 * np.pi, tags)

    def at(tag: int, time_s: Floats) -> tuple[Floats, Floats]:
        waves_at = np.sin(rates[tag] * time_s[:, None, None] + phases[tag])
        if tag > recipe.robots:
            return np.tile(centre[tag], (len(time_s), 1)), np.tile(np.eye(3), (len(time_s), 1, 1))
        if recipe.loop:
            around = spin[tag] * time_s + start[tag]
            way = np.column_stack([np.cos(around), np.sin(around), 0.05 * waves_at[:, 0, 0]])
            return centre[tag] * [0, 0, 1] + 1.8 * way, _turn(around + np.pi / 2 + 0.15 * waves_at[:, 1, 0], 2)
        yaw = recipe.turning * (spin[tag] * time_s + 1.0 * waves_at[:, 0, 0]) + start[tag] * (recipe.turning > 0)
        tilt = recipe.turning * 0.35 * waves_at[:, 1:, 1]
        return centre[tag] + 0.45 * waves_at.sum(axis=2), _turn(yaw, 2) @ _turn(tilt[:, 0], 1) @ _turn(tilt[:, 1], 0)

    return at


def _turn(angle: Floats, axis: int) -> Floats:
    """Return rotations (n, 3, 3) about a coordinate axis."""
    found = np.tile(np.eye(3), (len(angle), 1, 1))
    one, other = [k for k in range(3) if k != axis]
    found[:, one, one] = found[:, other, other] = np.cos(angle)
    sign = -1.0 if axis == 1 else 1.0
    found[:, other, one], found[:, one, other] = sign * np.sin(angle), -sign * np.sin(angle)
    return found


def _room(boards: np.random.Generator, first: Floats, second: Floats, ends: Any, which: Any) -> Floats:
    """Return an error of unit variance that depends on the position of the lower tag of a pair, smooth over half a
    metre.
    """
    place, found = np.where((ends[:, 0] < ends[:, 1])[:, None], first, second), np.zeros(len(which))
    for pair in range(int(which.max()) + 1):
        turns, phases = boards.normal(0, 2.0, (4, 3)), boards.uniform(0, 2 * np.pi, 4)
        rows = which == pair
        found[rows] = np.cos(place[rows] @ turns.T + phases).sum(axis=1) / np.sqrt(2)
    return found


def _wander(rng: np.random.Generator, recipe: Recipe, time_s: Floats, which: Any) -> Floats:
    """Return an error of unit variance for each pair with a correlation time of three seconds."""
    grid = np.arange(0, recipe.seconds + 0.2, 0.1)
    found = np.zeros(len(time_s))
    for pair in np.unique(which):
        kicks = np.sqrt(1 - np.exp(-0.2 / 3)) * rng.normal(size=len(grid) - 1)
        path = lfilter([1.0], [1.0, -np.exp(-0.1 / 3)], np.append(0.0, kicks))
        rows = which == pair
        found[rows] = np.interp(time_s[rows], grid, path)
    return found


SOUND: Final = {
    "sound": Recipe(pattern_m=0.0),
    "20 s, three robots": Recipe(pattern_m=0.0, seconds=20.0, robots=3),
    "errors of 4 cm that last": Recipe(pattern_m=0.0, wander_m=0.04),
    "walls of 5 cm": Recipe(pattern_m=0.0, wall_m=0.05, wander_m=0.02),
    "errors of places, 3 cm": Recipe(pattern_m=0.0, room_m=0.03),
    "the same, one robot and six anchors": Recipe(pattern_m=0.0, robots=1, anchors=6, room_m=0.03, wander_m=0.02),
    "the same, on a loop": Recipe(pattern_m=0.0, robots=1, anchors=8, loop=True, room_m=0.04, wander_m=0.02),
}
PLANTED: Final = {
    f"{100 * size_m:.0f} cm, {'each its own' if own else 'shared'}": Recipe(pattern_m=size_m, own=own)
    for own in (False, True)
    for size_m in (0.05, 0.1, 0.2)
}
