"""Worlds whose errors depend on positions: pairs of boards on moving bodies, with a smooth field of errors.

They share no code with simulator and fit: there are no walls and paths, but waves over the positions of both ends.
"""

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.data.ranges import Ranges

LIGHT_M_PER_NS = 0.299702547


def swum(rng: np.random.Generator, bodies: int, time_s: Any) -> Any:
    """Return positions (bodies, n, 3) in metres on sums of three sines per axis about points on a ring."""
    angle = 2 * np.pi * (np.arange(bodies) + 0.3 * rng.random(bodies)) / bodies
    middle = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), rng.uniform(1, 2, bodies)])
    rate = 2 * np.pi / rng.uniform(4, 15, (bodies, 3, 3))
    phase = rng.uniform(0, 2 * np.pi, rate.shape)
    return middle[:, None] + 0.45 * np.sin(rate[:, None] * time_s[None, :, None, None] + phase[:, None]).sum(axis=3)


def field(rng: np.random.Generator, first: Any, second: Any, size_m: float, wave_m: float) -> Any:
    """Return errors (n,) with the standard deviation `size_m`, smooth over `wave_m` of the position (n, 3) of either
    end.
    """
    vectors = rng.normal(0, 2 * np.pi / wave_m / np.sqrt(3), (40, 6))
    angle = np.hstack([first, second]) @ vectors.T + rng.uniform(0, 2 * np.pi, 40)
    return size_m * np.sqrt(2 / 40) * np.cos(angle).sum(axis=1)


def ranges_with_field(  # noqa: PLR0913 - what a world may differ in
    seed: int,
    *,
    bodies: int = 4,
    seconds: float = 60.0,
    rate: float = 100.0,
    field_m: float = 0.0,
    wave_m: float = 2.0,
    between_m: float = 0.0,
    noise_m: float = 0.03,
    reflected: float = 0.08,
) -> tuple[Ranges, Any]:
    """Return ranges with true distances, and delays in ns by tag, from 1 on, two tags on each body.

    Errors that depend on positions have the standard deviation `field_m` for every pair of bodies, constant ones
    `between_m`.
    """
    rng = np.random.default_rng([seed, 4711])
    count = int(seconds * rate)
    time = np.sort(rng.uniform(0, seconds, count))
    tags = 2 * bodies
    delays = np.concatenate([[0.0], rng.uniform(-0.4, 0.3, tags)])
    pairs = np.array([(a, b) for a, b in combinations(range(1, tags + 1), 2) if (a - 1) // 2 != (b - 1) // 2])
    first, second = pairs[rng.integers(0, len(pairs), count)].T
    places = swum(rng, bodies, time)
    arm, turning = rng.normal(0, 0.15, (tags + 1, 3)), rng.uniform(0.3, 0.9, bodies)
    both = np.array([first, second])
    body = (both - 1) // 2
    turned = Rotation.from_rotvec((turning[body] * time).reshape(-1, 1) * [0, 0, 1]).apply(arm[both].reshape(-1, 3))
    ends = places[body, np.arange(count)] + turned.reshape(2, count, 3)
    truth = np.linalg.norm(ends[0] - ends[1], axis=1)
    powers = -80 - 20 * np.log10(truth / 3) + rng.normal(0, 2.5, (2, count))
    error = 0.05 * np.sin(1.5 * np.mean(10 ** ((powers + 82) / 10), axis=0)) + noise_m * rng.normal(size=count)
    error += np.where(rng.random(count) < reflected, rng.exponential(0.3, count), 0.0)
    for a, b in combinations(range(bodies), 2):
        rows = (body[0] == a) & (body[1] == b)
        error[rows] += between_m * rng.normal() + field(rng, ends[0][rows], ends[1][rows], field_m, wave_m)
    swap = rng.random(count) < 0.5
    made = Ranges.from_arrays(
        truth + error - 0.5 * LIGHT_M_PER_NS * (delays[first] + delays[second]),
        initiator=np.where(swap, second, first),
        target=np.where(swap, first, second),
        fpp1_dbm=powers[0],
        fpp2_dbm=powers[1],
        truth_m=truth,
        time_ns=np.rint(time * 1e9).astype(np.int64),
    )
    return replace(made, bodies=tuple((tag, f"robot{(tag - 1) // 2}") for tag in range(1, tags + 1))), delays[1:]
