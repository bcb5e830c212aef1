"""Exchanges as the columns of ranges: ranges of stamps, weights of delays, powers, and true distances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Poses, Tag
from uwblink.recording.tracks import Tracks
from uwblink.twr import Exchanges, delay_weights, middle_ns, raw_range, without_stamps

NO_STAMPS: Final = "range"
"""What stands for the protocol of a range that came without stamps."""

ROWS_AT_ONCE: Final = 65_536
"""Exchanges whose stamps are worked on together, so that what leads to ranges stays small beside them."""

LOUDEST_DBM: Final = -30.0

FAINTEST_DBM: Final = -140.0
"""Powers beyond these bounds were not measured: a board that cannot tell a strong power prints 0."""


def measured_powers(fpp_dbm: Floats) -> Floats:
    """Return first-path powers (n,) in dBm, NaN where the number cannot be one."""
    with np.errstate(invalid="ignore"):
        return np.where((fpp_dbm < LOUDEST_DBM) & (fpp_dbm > FAINTEST_DBM), fpp_dbm, np.nan)


def columns_of(
    exchanges: Exchanges, given_m: Floats, poses: Poses | Tracks | None, tags: Sequence[Tag]
) -> dict[str, Any]:
    """Return exchanges as the columns of ranges, with true distances `given_m` (n,), from poses where they are NaN."""
    raw, initiator, target, middle = _of_stamps(exchanges)
    bare = without_stamps(exchanges)
    return {
        "time_ns": exchanges.time_ns,
        "initiator": exchanges.initiator,
        "target": exchanges.target,
        "protocol": np.where(bare, NO_STAMPS, exchanges.protocol) if bare.any() else exchanges.protocol,
        "raw_m": raw,
        "truth_m": _truth(exchanges, given_m, poses, tags, middle),
        "weight_initiator": initiator,
        "weight_target": target,
        "fpp1_dbm": measured_powers(exchanges.fpp1_dbm),
        "fpp2_dbm": measured_powers(exchanges.fpp2_dbm),
    }


def _of_stamps(exchanges: Exchanges) -> tuple[Floats, Floats, Floats, Ints]:
    """Return raw ranges, both weights of delays, and the middles of the first two messages in ns, each (n,)."""
    raw, initiator, target = (np.empty(len(exchanges)) for _ in range(3))
    middle = np.empty(len(exchanges), dtype=np.int64)
    for begin in range(0, len(exchanges), ROWS_AT_ONCE):
        rows = slice(begin, begin + ROWS_AT_ONCE)
        some = exchanges[rows]
        raw[rows], (initiator[rows], target[rows]) = raw_range(some), delay_weights(some)
        middle[rows] = middle_ns(some)
    return raw, initiator, target, middle


def _truth(
    exchanges: Exchanges, given_m: Floats, poses: Poses | Tracks | None, tags: Sequence[Tag], middle_ns: Ints
) -> Floats:
    known = np.isfinite(given_m)
    if known.all() or poses is None or not len(poses):
        return given_m
    # A range belongs to the middle of its first two messages.
    return np.where(known, given_m, distances_m(poses, tags, exchanges.initiator, exchanges.target, middle_ns))
