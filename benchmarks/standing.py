"""Boards that stand still in arrangements: ranges by code that shares nothing with calibration and simulator.

A pair has a constant error in an arrangement, a range has noise, and some pairs have a reflection that lengthens their
ranges. Boards have delays, and optionally a bias over received power, which decreases with distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from calib import Ranges
from uwblink.arrays import Floats

C_M_PER_NS = 0.299702547
DIMENSIONS = {"line": 1, "plane": 2, "space": 3}


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Planted values: delays in ns by tag, positions (arrangements, tags, 3), and the ranges."""

    delays_ns: dict[int, float]
    places: list[Floats]
    ranges: Ranges
    meta: dict[str, Any] = field(default_factory=dict)


def places_of(rng: np.random.Generator, boards: int, dimensions: int, size_m: float, apart_m: float) -> Floats:
    """Return random positions (boards, 3), at least `apart_m` from each other."""
    while True:
        place = np.zeros((boards, 3))
        place[:, :dimensions] = rng.uniform(0, size_m, (boards, dimensions))
        gaps = [np.linalg.norm(place[i] - place[j]) for i, j in combinations(range(boards), 2)]
        if min(gaps) > apart_m:
            return place


def power_dbm(length_m: float) -> float:
    """Return the received power at a distance in free space."""
    return -77.0 - 20.0 * math.log10(max(length_m, 0.1))


def bias_m(power: float, size_m: float) -> float:
    """Return a bias that changes from negative to positive as power decreases, zero at -82 dBm."""
    return size_m * float(np.tanh((-82.0 - power) / 8.0))


def wave_m(power: Floats | float, size_m: float) -> Floats:
    """Return a bias that is not monotonic: one period of a sine over lifted power up to 1.7, zero at -82 dBm."""
    lifted = np.minimum(10 ** ((np.append(power, -82.0) + 82.0) / 10), 1.7)
    found = size_m * np.sin(2 * np.pi * lifted / 1.7)
    return np.asarray(found[:-1] - found[-1])


def standing_boards(  # noqa: PLR0913 - a world has many settings
    seed: int,
    shape: str = "line",
    *,
    boards: int = 4,
    arrangements: int = 8,
    pair_error_m: float = 0.02,
    noise_m: float = 0.03,
    each: int = 60,
    size_m: float = 5.0,
    apart_m: float = 0.4,
    reflected: float = 0.0,
    detour_m: tuple[float, float] = (0.15, 0.6),
    bias_size_m: float = 0.0,
    wave_size_m: float = 0.0,
    board_power_db: float = 0.0,
    stay_s: float = 60.0,
    pause_s: float = 10.0,
    places: Sequence[Floats] | None = None,
) -> Standing:
    """Return ranges of boards in random arrangements on a "line", in a "plane" or in "space".

    There are `each` ranges per pair and arrangement. `reflected` is the share of pairs whose ranges are longer by
    `detour_m` in an arrangement. `board_power_db` is the standard deviation of the powers of boards.
    """
    rng = np.random.default_rng([seed, boards, arrangements])
    delays = dict(zip(range(1, boards + 1), rng.normal(-0.05, 0.2, boards).tolist(), strict=True))
    where = (
        list(places)
        if places is not None
        else [places_of(rng, boards, DIMENSIONS[shape], size_m, apart_m) for _ in range(arrangements)]
    )
    own_db = board_power_db * np.random.default_rng([seed, 1]).normal(size=boards)
    columns: dict[str, list[Floats]] = {name: [] for name in ("t", "i", "j", "r", "p")}
    for k, place in enumerate(where):
        for i, j in combinations(range(boards), 2):
            length = float(np.linalg.norm(place[i] - place[j]))
            power = power_dbm(length) + rng.normal(0, 1.0) + float(own_db[i] + own_db[j])
            constant = pair_error_m * rng.normal() + bias_m(power, bias_size_m) + float(wave_m(power, wave_size_m)[0])
            constant += rng.uniform(*detour_m) if rng.uniform() < reflected else 0.0
            constant -= C_M_PER_NS / 2 * (delays[i + 1] + delays[j + 1])
            turned = rng.uniform(size=each) < 0.5
            columns["t"].append(k * (stay_s + pause_s) + rng.uniform(0, stay_s, each))
            columns["i"].append(np.where(turned, j + 1, i + 1))
            columns["j"].append(np.where(turned, i + 1, j + 1))
            columns["r"].append(length + constant + noise_m * rng.normal(size=each))
            columns["p"].append(power + 0.3 * rng.normal(size=each))
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    order = np.argsort(whole["t"])
    ranges = Ranges.from_arrays(
        whole["r"][order],
        initiator=whole["i"][order].astype(int),
        target=whole["j"][order].astype(int),
        fpp1_dbm=whole["p"][order] if bias_size_m or wave_size_m else np.nan,
        time_ns=(whole["t"][order] * 1e9).astype(np.int64),
        source="standing",
    )
    return Standing(delays_ns=delays, places=where, ranges=ranges)
