"""The offset between the clock of motion capture and that of the host, found from the ranges themselves.

Within a pair a range differs from the true distance by a constant (antenna delays) and noise, if the poses are at
the right time; at a wrong time it also differs by motion. The offset with the least robust spread wins.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from uwblink.errors import ImportTableError
from uwblink.geometry import distances_m
from uwblink.schema import Poses, Tag
from uwblink.twr import Exchanges, raw_range

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

STEP_S: Final = 0.1
FINE_S: Final = 0.002
MOST_EXCHANGES: Final = 1500
LEAST_OVERLAP: Final = 0.5
CLEARLY: Final = 0.7
"""The best spread must be below this share of the typical one, or motion does not tell the time."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """An offset to add to the poses' times, and the robust spread of the ranges there and elsewhere, metres."""

    offset_ns: int
    spread_m: float
    typical_m: float


def find_offset(exchanges: Exchanges, poses: Poses, tags: list[Tag]) -> Alignment:
    """Search every offset at which at least half the exchanges lie within the poses; raises `ImportTableError`."""
    rows = np.unique(np.linspace(0, len(exchanges) - 1, min(len(exchanges), MOST_EXCHANGES)).astype(np.int64))
    some = exchanges[rows]
    ranges = raw_range(some)
    first, last = int(poses.time_ns.min()), int(poses.time_ns.max())
    begin, end = int(some.time_ns.min()), int(some.time_ns.max())
    overlap_ns = int(LEAST_OVERLAP * min(end - begin, last - first))
    step = int(STEP_S * 1e9)
    offsets = np.arange(begin + overlap_ns - last, end - overlap_ns - first + step, step, dtype=np.int64)
    spreads = np.array([_spread(some, ranges, poses, tags, int(o)) for o in offsets])
    if not np.isfinite(spreads).any():
        raise ImportTableError("no offset puts the poses over the exchanges; are the bodies of the tags in the file?")
    typical = float(np.nanmedian(spreads))
    best = int(offsets[np.nanargmin(spreads)])
    for width in (step, step // 10, step // 50):
        near = np.arange(best - width, best + width + 1, max(width // 10, int(FINE_S * 1e9 / 10)), dtype=np.int64)
        values = np.array([_spread(some, ranges, poses, tags, int(o)) for o in near])
        best = int(near[np.nanargmin(values)])
    spread = _spread(some, ranges, poses, tags, best)
    if spread > CLEARLY * typical:
        raise ImportTableError(
            f"the ranges do not tell the offset: their spread is {100 * spread:.0f} cm at the best offset and "
            f"{100 * typical:.0f} cm at others; record bodies that move, or give --offset in seconds"
        )
    return Alignment(best, spread, typical)


def _spread(exchanges: Exchanges, ranges: Floats, poses: Poses, tags: list[Tag], offset_ns: int) -> float:
    """Median absolute difference of range and distance, after each pair's own median; NaN where too few overlap."""
    e = exchanges
    error = ranges - distances_m(poses, tags, e.initiator, e.target, e.time_ns - offset_ns)
    good = np.isfinite(error)
    if np.count_nonzero(good) < LEAST_OVERLAP * 0.8 * len(error):
        return float("nan")
    pair = e.initiator * 65_536 + e.target
    centred = [np.abs(v - np.median(v)) for p in np.unique(pair) if len(v := error[good & (pair == p)])]
    return float(np.median(np.concatenate(centred)))
