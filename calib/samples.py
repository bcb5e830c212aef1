"""A small flight for examples and first steps, with known delays and curve; no simulator is needed for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.recording.schema import Poses, Tag
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import Exchanges

DELAYS_NS: Final = {1: -0.3, 2: 0.1, 3: -0.1}
PAIRS: Final = np.array([(1, 2), (2, 3), (3, 1)])
NOISE_M: Final = 0.03
REPLY_TICKS: Final = 20_000_000
POSES_HZ: Final = 100


@dataclass(frozen=True, slots=True)
class SampleFlight:
    """What `fit`, `evaluate`, `localize` and `examine` take instead of a recording."""

    exchanges: Exchanges
    poses: Poses
    tags: list[Tag]
    planted: dict[str, Any]


def sample_flight(count: int = 900, *, seed: int = 1) -> SampleFlight:
    """Return `count` exchanges of three tags that move about a room, 100 a second, as a recording would hold them.

    Antenna delays are -0.3, 0.1 and -0.1 ns; ranges are 4 cm longer at the highest powers than at the lowest; the noise
    is 3 cm. The same seed gives the same flight.

    >>> import calib
    >>> calib.load_ranges(calib.sample_flight())
    <Ranges of memory: 900 of tags 1, 2, 3>
    """
    rng = np.random.default_rng(seed)
    time_ns = 1_000_000_000 + np.arange(count) * 10_000_000
    pair = PAIRS[np.arange(count) % len(PAIRS)]
    initiator, target = pair.T
    away = np.linalg.norm(_place(initiator, time_ns) - _place(target, time_ns), axis=1)
    power = rng.uniform(-95, -80, (2, count))
    lifted = np.mean(10 ** ((power + 82) / 10), axis=0)
    delay = np.array([DELAYS_NS.get(tag, 0.0) for tag in range(4)])
    measured_m = away + 0.04 * np.tanh(2 * lifted) + NOISE_M * rng.normal(size=count)
    measured_m = measured_m - 0.5e-9 * SPEED_OF_LIGHT * (delay[initiator] + delay[target])
    return SampleFlight(_exchanges(time_ns, pair, measured_m, power), _poses(int(time_ns[-1])), _tags(), _planted())


def _exchanges(time_ns: Any, pair: Any, measured_m: Floats, power: Floats) -> Exchanges:
    """Stamps of double-sided exchanges whose clocks run alike, so that the formula gives the measured range."""
    there_and_back = np.rint(2 * measured_m / SPEED_OF_LIGHT / TICK_S).astype(np.int64)
    zero, nothing = np.zeros_like(time_ns), np.zeros(len(time_ns))
    return Exchanges(
        time_ns=time_ns,
        initiator=pair[:, 0],
        target=pair[:, 1],
        protocol=np.full(len(time_ns), "ds"),
        reporter=pair[:, 0],
        range_m=measured_m,
        tx1=zero,
        rx1=zero,
        tx2=zero + REPLY_TICKS,
        rx2=there_and_back + REPLY_TICKS,
        tx3=zero + 2 * REPLY_TICKS,
        rx3=there_and_back + 2 * REPLY_TICKS,
        fpp1_dbm=power[0],
        fpp2_dbm=power[1],
        skew1_ppm=nothing,
        skew2_ppm=nothing,
        truth_m=np.full(len(time_ns), np.nan),
    )


def _place(tag: Any, time_ns: Any) -> Floats:
    """Where a tag is: each on its own slow figure about its own corner."""
    phase = 2e-9 * time_ns + 2.0 * tag
    corner = 2.0 * np.stack([np.cos(2.1 * tag), np.sin(2.1 * tag), 0.3 * tag], axis=-1)
    moved: Floats = corner + np.stack([np.sin(phase), np.cos(1.3 * phase), 0.5 * np.sin(0.7 * phase)], axis=-1)
    return moved


def _poses(last_ns: int) -> Poses:
    time_ns = np.arange(0, last_ns + 1_000_000_000, 1_000_000_000 // POSES_HZ)
    bodies = sorted(DELAYS_NS)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(time_ns), 1))
    return Poses(
        np.tile(time_ns, len(bodies)),
        np.repeat([f"robot{tag}" for tag in bodies], len(time_ns)),
        np.concatenate([_place(np.full(len(time_ns), tag), time_ns) for tag in bodies]),
        np.tile(upright, (len(bodies), 1)),
    )


def _tags() -> list[Tag]:
    return [Tag(tag, f"robot{tag}", (0.0, 0.0, 0.0)) for tag in sorted(DELAYS_NS)]


def _planted() -> dict[str, Any]:
    return {"delays_ns": {str(tag): delay for tag, delay in DELAYS_NS.items()}}
