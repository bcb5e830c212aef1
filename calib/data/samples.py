"""A small synthetic flight for examples, with known delays and curve, without the simulator."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.recording.antenna_delays import AntennaDelay, meta_of_delays
from uwblink.recording.contents import Contents
from uwblink.recording.schema import Poses, Tag
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import Exchanges

DELAYS_NS: Final = {1: -0.3, 2: 0.1, 3: -0.1}
ANCHOR_DELAYS_NS: Final = DELAYS_NS | {4: 0.2, 5: 0.0}
"""Planted delays of the flights without and with anchors."""

REPLY_TICKS: Final = 20_000_000
"""Reply time: 0.3 ms, as on the boards."""


def sample_flight(count: int = 900, *, seed: int = 1, anchors: bool = False) -> Contents:
    """Return `count` exchanges of three tags that move about a room, 100 per second, with poses and tags.

    With `anchors`, only tag 1 moves; tags 2 to 5 are fixed and also range with each other. The antenna delays of tags 1
    to 5 are -0.3, 0.1, -0.1, 0.2 and 0 ns. Ranges are 4 cm longer at the highest powers than at the lowest; the noise
    is 3 cm. The same seed gives the same flight.

    >>> import calib
    >>> calib.load_ranges(calib.sample_flight())
    <Ranges of memory: 900 of tags 1, 2, 3>
    """
    rng = np.random.default_rng(seed)
    time_ns = 1_000_000_000 + np.arange(count) * 10_000_000
    among_anchors = [(1, 2), (1, 3), (1, 4), (1, 5), (2, 3), (3, 4), (4, 5), (5, 2)]
    pairs = among_anchors if anchors else [(1, 2), (2, 3), (3, 1)]
    pair, fixed = np.array(pairs)[np.arange(count) % len(pairs)], (2, 3, 4, 5) if anchors else ()
    initiator, target = pair.T
    away = np.linalg.norm(_place(initiator, time_ns, fixed) - _place(target, time_ns, fixed), axis=1)
    power = rng.uniform(-95, -80, (2, count))
    lifted = np.mean(10 ** ((power + 82) / 10), axis=0)
    delay = np.array([ANCHOR_DELAYS_NS.get(tag, 0.0) for tag in range(6)])
    measured_m = away + 0.04 * np.tanh(2 * lifted) + 0.03 * rng.normal(size=count)
    measured_m = measured_m - 0.5e-9 * SPEED_OF_LIGHT * (delay[initiator] + delay[target])
    tags = [Tag(int(tag), f"robot{tag}", (0.0, 0.0, 0.0)) for tag in np.unique(pair)]
    planted = {"delays_ns": {str(tag.tag): ANCHOR_DELAYS_NS[tag.tag] for tag in tags}}
    # State that the boards' default antenna delays were programmed.
    meta = {"planted": planted, **meta_of_delays({None: AntennaDelay()})}
    # Poses 100 times a second, until a second after the last range.
    pose_ns = np.arange(0, int(time_ns[-1]) + 1_000_000_000, 10_000_000)
    poses = Poses(
        np.tile(pose_ns, len(tags)),
        np.repeat([tag.body for tag in tags], len(pose_ns)),
        np.concatenate([_place(np.full(len(pose_ns), tag.tag), pose_ns, fixed) for tag in tags]),
        np.tile([0.0, 0.0, 0.0, 1.0], (len(tags) * len(pose_ns), 1)),
    )
    return Contents(exchanges=stamped(time_ns, pair, measured_m, power), tags=tags, poses=poses, meta=meta)


def stamped(time_ns: Any, pair: Any, measured_m: Floats, power: Floats) -> Exchanges:
    """Return double-sided exchanges whose stamps give the measured ranges (n,) in metres; clock rates are equal."""
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


def _place(tag: Any, time_ns: Any, fixed: tuple[int, ...] = ()) -> Floats:
    """Return positions (n, 3) of tags in metres: each moves about its own corner, or stays there if it is `fixed`."""
    phase = 2e-9 * time_ns + 2.0 * tag
    corner = 2.0 * np.stack([np.cos(2.1 * tag), np.sin(2.1 * tag), 0.3 * tag], axis=-1)
    away = np.stack([np.sin(phase), np.cos(1.3 * phase), 0.5 * np.sin(0.7 * phase)], axis=-1)
    return np.asarray(corner + np.where(np.isin(tag, fixed)[..., None], 0.0, away))
