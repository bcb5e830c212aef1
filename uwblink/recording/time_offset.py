"""The offset between the clock of motion capture and that of the host, found from the ranges themselves.

Within a pair a range differs from the true distance by a constant (antenna delays) and noise, if the poses are at
the right time; at a wrong time it also differs by motion. The offset with the least robust spread wins.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.errors import ImportTableError
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Poses, Tag
from uwblink.recording.tracks import Tracks, tracks_of
from uwblink.twr import Exchanges, raw_range

STEP_S: Final = 0.1
PARABOLA_S: Final = 0.02
MOST_EXCHANGES: Final = 4000
MOST_OFFSETS: Final = 5000
LEAST_OVERLAP: Final = 0.5
CLEARLY: Final = 0.7
"""The best spread must be below this share of the typical one, or motion does not tell the time."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """An offset to add to the poses' times, and the robust spread of the ranges there and elsewhere, metres."""

    offset_ns: int
    spread_m: float
    typical_m: float


def find_offset(exchanges: Exchanges, poses: Poses, tags: list[Tag], within_s: float | None = None) -> Alignment:
    """Search every offset at which at least half the exchanges lie within the poses; raises `ImportTableError`.

    With `within_s` only offsets of that size are looked at. In very long recordings the first grid is coarser, so
    that it never has more than `MOST_OFFSETS` points.
    """
    rows = np.unique(np.linspace(0, len(exchanges) - 1, min(len(exchanges), MOST_EXCHANGES)).astype(np.int64))
    some = exchanges[rows]
    ranges = raw_range(some)
    first, last = int(poses.time_ns.min()), int(poses.time_ns.max())
    begin, end = int(some.time_ns.min()), int(some.time_ns.max())
    overlap_ns = int(LEAST_OVERLAP * min(end - begin, last - first))
    low, high = begin + overlap_ns - last, end - overlap_ns - first
    if within_s is not None:
        low, high = max(low, -int(within_s * 1e9)), min(high, int(within_s * 1e9))
    step = max(int(STEP_S * 1e9), (high - low) // MOST_OFFSETS)
    offsets = np.arange(low, high + step, step, dtype=np.int64)
    tracks = tracks_of(poses, tags)
    spreads = np.array([_spread(some, ranges, tracks, tags, int(o)) for o in offsets])
    if not np.isfinite(spreads).any():
        raise ImportTableError("no offset puts the poses over the exchanges; are the bodies of the tags in the file?")
    typical = float(np.nanmedian(spreads))
    best = int(offsets[np.nanargmin(spreads)])
    best = _refined(some, ranges, tracks, tags, best, float(np.nanmin(spreads)), step)
    spread = _spread(some, ranges, tracks, tags, best)
    if spread > CLEARLY * typical:
        raise ImportTableError(
            f"the ranges do not tell the offset: their spread is {100 * spread:.0f} cm at the best offset and "
            f"{100 * typical:.0f} cm at others; record bodies that move, or give `offset` in seconds"
        )
    return Alignment(best, spread, typical)


def _refined(
    exchanges: Exchanges, ranges: Floats, tracks: Tracks, tags: list[Tag], start: int, scale_m: float, step: int
) -> int:
    """Move to the least Cauchy loss, which uses more of the data than their median: grids, then a parabola."""
    best = start
    for _ in range(3 + max(step // int(STEP_S * 1e9) - 1, 0).bit_length()):
        step //= 5
        near = best + step * np.arange(-6, 7, dtype=np.int64)
        losses = np.array([_loss(exchanges, ranges, tracks, tags, int(o), scale_m) for o in near])
        best = int(near[np.nanargmin(losses)])
    # The last grid is finer than what noise lets through, so the parabola runs over a wider one.
    near = best + int(PARABOLA_S * 1e9) * np.arange(-5, 6, dtype=np.int64)
    losses = np.array([_loss(exchanges, ranges, tracks, tags, int(o), scale_m) for o in near])
    curve, slope, _ = np.polyfit((near - best) * 1e-9, losses, 2)
    move_s = -slope / (2 * curve) if curve > 0 else 0.0
    return best + round(float(np.clip(move_s, -5 * PARABOLA_S, 5 * PARABOLA_S)) * 1e9)


def _loss(
    exchanges: Exchanges, ranges: Floats, tracks: Tracks, tags: list[Tag], offset_ns: int, scale_m: float
) -> float:
    centred = _centred(exchanges, ranges, tracks, tags, offset_ns)
    # One exchange, or exact ranges, have no spread.
    scale_m = max(scale_m, 1e-6)
    return float(np.mean(np.log1p((centred / scale_m) ** 2))) if len(centred) else float("nan")


def _spread(exchanges: Exchanges, ranges: Floats, tracks: Tracks, tags: list[Tag], offset_ns: int) -> float:
    """Median absolute difference of range and distance, after each pair's own median; NaN where too few overlap."""
    centred = _centred(exchanges, ranges, tracks, tags, offset_ns)
    return float(np.median(np.abs(centred))) if len(centred) else float("nan")


def _centred(exchanges: Exchanges, ranges: Floats, tracks: Tracks, tags: list[Tag], offset_ns: int) -> Floats:
    """Differences of range and distance, less each pair's median; empty where too few exchanges overlap."""
    e = exchanges
    error = ranges - distances_m(tracks, tags, e.initiator, e.target, e.time_ns - offset_ns)
    good = np.isfinite(error)
    if np.count_nonzero(good) < LEAST_OVERLAP * 0.8 * len(error):
        return np.empty(0)
    pair = e.initiator * 65_536 + e.target
    return np.concatenate([v - np.median(v) for p in np.unique(pair) if len(v := error[good & (pair == p)])])
