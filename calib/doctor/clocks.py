"""Clock skew that is left in single-sided ranges, and carriers' readings beside what the stamps say."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.doctor.base import Finding, RecordingView, pair_ids
from calib.doctor.levels import medians
from calib.estimation.limits import told
from calib.estimation.plausibility import robust_slope
from calib.single_sided import corrected, left_skew
from calib.spread import robust_spread
from uwblink.arrays import Floats
from uwblink.protocols.table import single_sided
from uwblink.recording.relative_clocks import clock_skews
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import Exchanges, intervals, without_stamps

FEWEST: Final = 100
SPREAD_M: Final = 0.03
"""Skew must be expected to change ranges of a pair by more, for it to be seen in them."""

ONE_WAY_M: Final = 0.1
FEWEST_PAIRS: Final = 4
MORE_THAN_DELAYS_M: Final = 0.15
EXPLAINED: Final = 0.3
FEWEST_A_WAY: Final = 15
NEAR: Final = 0.5
BLIND: Final = "single-sided without carrier readings"
LEFT: Final = "skew in single-sided ranges"
WRONG_SIGN: Final = "carrier readings with the wrong sign"
SCATTER_PPM: Final = 1.5


def skew(view: RecordingView) -> Iterator[Finding]:
    """Errors that follow the carriers' readings: skew that was not taken out, or was with the wrong sign."""
    e = view.exchanges
    rows = np.isin(e.protocol, single_sided()) & np.isfinite(view.error_m) & ~without_stamps(e)
    if np.count_nonzero(rows) < FEWEST:
        return
    some, error = e[rows], view.error_m[rows]
    taken = np.array([corrected(name) for name in np.unique(some.protocol).tolist()])
    if taken.any() != taken.all():
        return
    known = np.isfinite(some.skew2_ppm) & (some.skew2_ppm != 0)
    if np.count_nonzero(known) < FEWEST:
        yield from _by_direction(some, error)
        return
    some, error = some[known], error[known]
    # A target's reply lasts longer by the clock of a faster initiator, and so does the range.
    expected = 0.5 * SPEED_OF_LIGHT * 1e-6 * some.skew2_ppm * intervals(some).dt32 * TICK_S
    ways = _both_ways(some, [expected, error])
    if len(ways) and np.max(np.abs(ways[:, 0])) > SPREAD_M:
        # Delays of a pair are the same both ways.
        slope = float(np.sum(ways[:, 0] * ways[:, 1]) / np.sum(ways[:, 0] ** 2))
        reach = float(np.max(np.abs(ways[:, 0])))
    else:
        found = _one_way(some, expected, error)
        if found is None:
            return
        slope, reach = found
    evidence = f"errors grow by {slope:.2f} m in a metre of c/2 times carrier's skew times reply, over {reach:.2f} m"
    for at, fault, remedy in SLOPES[bool(taken.all())]:
        if abs(slope - at) < NEAR:
            yield Finding(fault, evidence, remedy, 0.9)


def _one_way(some: Exchanges, expected: Floats, error: Floats) -> tuple[float, float] | None:
    """Return slope and reach where pairs range one way only: among pairs, as delays are smaller than skew, or within.

    None where skew is too small to be seen.
    """
    place = np.unique(pair_ids(some), return_inverse=True)[1]
    levels = [medians(values, place, int(place.max()) + 1) for values in (expected, error)]
    x, y = (level - level.mean() for level in levels)
    spread = float(np.std(x))
    if len(x) >= FEWEST_PAIRS and spread > MORE_THAN_DELAYS_M:
        slope = float(x @ y / (x @ x))
        if float(np.std(y - slope * x)) < EXPLAINED * max(spread, float(np.std(y))):
            return slope, float(np.ptp(x))
    x, y = _within(some, expected), _within(some, error)
    reach = float(np.ptp(np.percentile(x, (5, 95))))
    return None if reach < SPREAD_M else (robust_slope(x, y), reach)


def _by_direction(some: Exchanges, error: Floats) -> Iterator[Finding]:
    """Where carriers were not read: skew makes ranges of a pair longer one way, and as much shorter the other way."""
    ways = _both_ways(some, [error])
    spread = robust_spread(_within(some, error))
    if not len(ways):
        return
    worst = float(np.max(np.abs(ways[:, 0])))
    if worst > max(ONE_WAY_M, spread):
        yield Finding(
            LEFT,
            f"ranges of a pair differ by up to {100 * worst:.0f} cm by who initiates",
            "record the carrier integrator, or use double-sided ranging; until then take the mean of both ways",
            0.9,
        )


def _both_ways(some: Exchanges, columns: list[Floats]) -> Floats:
    """Return by how much medians of columns (n,) differ between the two ways of each pair (pairs, columns)."""
    pair, forth, found = pair_ids(some), some.initiator < some.target, []
    for p in np.unique(pair):
        ways = [(pair == p) & (forth == way) for way in (True, False)]
        if min(np.count_nonzero(way) for way in ways) >= FEWEST_A_WAY:
            found.append([float(np.median(c[ways[0]]) - np.median(c[ways[1]])) for c in columns])
    return np.array(found).reshape(len(found), len(columns))


def _within(some: Exchanges, values: Floats) -> Floats:
    """Return values (n,) less the median of their pair and way."""
    way = pair_ids(some) * 2 + (some.initiator < some.target)
    _, place = np.unique(way, return_inverse=True)
    return np.asarray(values - medians(values, place, int(place.max()) + 1)[place])


SLOPES: Final = {
    False: (
        (1.0, LEFT, 'correct them with the readings: protocol "ss-cfo"; or use double-sided ranging'),
        (-1.0, WRONG_SIGN, "the skew is in the ranges, and the readings have the other sign: change it on import"),
    ),
    True: (
        (-2.0, WRONG_SIGN, "the correction doubles the skew: change the readings' sign on import"),
        (1.0, LEFT, "the readings do not reach the correction: see to their unit"),
    ),
}


def unread(view: RecordingView) -> Iterator[Finding]:
    """Single-sided ranges whose carriers were not read: nothing says what skew left in them."""
    left = left_skew(view.exchanges)
    if left is None or np.isfinite(left.told_m):
        return
    yield Finding(
        BLIND,
        told(left),
        "range in both directions of every pair, so that half of the skew's sign is the other way; or record the "
        "carrier integrator, or use double-sided ranging",
        0.6,
    )


def carriers(view: RecordingView) -> Iterator[Finding]:
    """Carriers' readings that do not follow the clocks' ratios by the stamps."""
    if without_stamps(view.exchanges).all():
        return
    found = clock_skews(view.exchanges)
    scatter = {one.pair: one.residual_ppm for one in found if one.residual_ppm is not None and one.count >= FEWEST}
    wild = [pair for pair, residual in scatter.items() if residual > SCATTER_PPM]
    if not scatter or len(wild) < max(1, len(scatter) // 2):
        return
    worst = max(wild, key=lambda pair: scatter[pair])
    yield Finding(
        "carrier readings that say little",
        f"they scatter by {scatter[worst]:.1f} ppm about their median (pair {worst}), in {len(wild)} of {len(scatter)} "
        "pairs",
        "do not correct single-sided ranges with them; see to their unit and register",
        0.7,
    )
