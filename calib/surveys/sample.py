"""A small set of arrangements for examples and first steps, with known delays; no simulator is needed for it."""

from __future__ import annotations

from itertools import combinations
from typing import Final

import numpy as np

from calib.data.ranges import Ranges
from calib.data.samples import ANCHOR_DELAYS_NS
from uwblink.ticks import SPEED_OF_LIGHT

ORDERS: Final = ((1, 2, 3, 4), (2, 1, 4, 3), (3, 1, 4, 2), (2, 4, 1, 3), (4, 3, 2, 1), (1, 3, 4, 2))
"""Tags from left to right; every two tags are neighbours somewhere, and each is somewhere in the middle."""


def sample_arrangements(count: int = 6, *, seed: int = 1) -> Ranges:
    """Return ranges of four boards on a string in `count` orders (at most 6), each held for 30 s, 20 ranges a second.

    Antenna delays are -0.3, 0.1, -0.1 and 0.2 ns; a pair has a constant error of 1 cm in an arrangement, a range noise
    of 3 cm. No true distance is in it. The same seed gives the same ranges.

    >>> import calib
    >>> calib.sample_arrangements(2)
    <Ranges of memory: 1200 of tags 1, 2, 3, 4>
    """
    rng, held = np.random.default_rng(seed), 600
    pairs = np.array(list(combinations(sorted(ORDERS[0]), 2)))
    delays = np.array([0.0, *(ANCHOR_DELAYS_NS[tag] for tag in ORDERS[0])])[pairs].sum(axis=1)
    pair = np.arange(held) % len(pairs)
    raw = []
    for order in ORDERS[:count]:
        place = np.zeros(5)
        place[list(order)] = np.cumsum(rng.uniform(0.5, 1.5, 4))
        error = 0.01 * rng.normal(size=len(pairs))
        mean = np.abs(np.diff(place[pairs])[:, 0]) - 0.5e-9 * SPEED_OF_LIGHT * delays + error
        raw.append(mean[pair] + 0.03 * rng.normal(size=held))
    # Ten seconds between two arrangements.
    time_s = [40.0 * k + np.arange(held) / 20.0 for k in range(len(raw))]
    tags = np.tile(pairs[pair], (len(raw), 1))
    return Ranges.from_arrays(
        np.concatenate(raw),
        initiator=tags[:, 0],
        target=tags[:, 1],
        fpp1_dbm=np.nan,
        time_ns=(np.concatenate(time_s) * 1e9).astype(np.int64),
    )
