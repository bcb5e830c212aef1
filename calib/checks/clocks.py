"""Clock skew that is left in single-sided ranges, and carriers' readings beside what the stamps say."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.checks.levels import DOF, OF_MEDIAN, medians
from calib.checks.limits import told
from calib.checks.plausibility import robust_slope
from calib.checks.recording_view import RecordingView, pair_ids
from calib.data.clocks import corrected, left_skew
from calib.findings import BUDGET, Candidate, exceeds
from calib.spread import robust_spread
from uwblink.arrays import Floats
from uwblink.protocols.table import single_sided
from uwblink.recording import clock_skews
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import Exchanges, intervals, without_stamps

FEWEST: Final = 100
SPREAD_M: Final = 0.03
"""Skew must be expected to change ranges of a pair by more, for it to be seen in them."""

ONE_WAY_M: Final = 0.05
"""By how much ranges of a sound pair may differ by who initiates: the powers of both ways are not quite alike."""

FEWEST_PAIRS: Final = 4
MORE_THAN_DELAYS_M: Final = 0.15
FEWEST_A_WAY: Final = 15
NEAR: Final = 0.5
"""A slope is that of a fault, of 1 or of 2, or none: halfway lies the edge."""

BLIND: Final = "single-sided without carrier readings"
LEFT: Final = "skew in single-sided ranges"
WRONG_SIGN: Final = "carrier readings with the wrong sign"
SCATTER_PPM: Final = 1.5
"""What single readings of a sound board may scatter: a reply of 1.5 ms then adds a third of a metre to a range."""

NORMAL: Final = 1e6
"""Degrees of freedom of what many ranges tell."""


def skew(view: RecordingView) -> Iterator[Candidate]:
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
    ways, variance = _both_ways(some, [expected, error])
    if len(ways) and np.max(np.abs(ways[:, 0])) > SPREAD_M:
        # Delays of a pair are the same both ways.
        slope, std = _line(ways[:, 0], ways[:, 1], variance[:, 1])
        reach, dof = float(np.max(np.abs(ways[:, 0]))), NORMAL
    else:
        found = _one_way(some, expected, error)
        if found is None:
            return
        slope, std, dof, reach = found
    p_value = exceeds(slope, std, dof, tolerance=NEAR)
    evidence = f"errors grow by {slope:.2f} m in a metre of c/2 times carrier's skew times reply, over {reach:.2f} m"
    for at, fault, remedy in SLOPES[bool(taken.all())]:
        if abs(slope - at) < NEAR:
            yield Candidate(fault, evidence, p_value, {"more": remedy})


def _line(x: Floats, y: Floats, variance: Floats) -> tuple[float, float]:
    """Return the slope of y (n,) over x (n,) through the origin, and its standard error, by what is left if larger."""
    square = float(np.sum(x**2 / variance))
    if square == 0:
        return 0.0, np.inf
    slope = float(np.sum(x * y / variance)) / square
    left = float(np.mean((y - slope * x) ** 2 / variance))
    return slope, float(np.sqrt(max(left, 1.0) / square))


def _one_way(some: Exchanges, expected: Floats, error: Floats) -> tuple[float, float, float, float] | None:
    """Return slope, its error and degrees of freedom, and reach, where pairs range one way only.

    Among pairs, as delays are smaller than skew, or within.

    None where skew is too small to be seen.
    """
    place = np.unique(pair_ids(some), return_inverse=True)[1]
    levels = [medians(values, place, int(place.max()) + 1) for values in (expected, error)]
    x, y = (level - level.mean() for level in levels)
    spread = float(np.std(x))
    if len(x) >= FEWEST_PAIRS and spread > MORE_THAN_DELAYS_M:
        slope = float(x @ y / (x @ x))
        dof = len(x) - 2
        std = float(np.sqrt(np.sum((y - slope * x) ** 2) / dof / (x @ x)))
        if exceeds(slope, std, dof, tolerance=NEAR) < BUDGET:
            return slope, std, dof, float(np.ptp(x))
    x, y = _within(some, expected), _within(some, error)
    reach = float(np.ptp(np.percentile(x, (5, 95))))
    if reach < SPREAD_M:
        return None
    slope = robust_slope(x, y)
    # Tukey's line rests on medians of thirds.
    std = float(np.sqrt(2 * OF_MEDIAN * 3 / len(x))) * robust_spread(y - slope * x) / max(_between_thirds(x), 1e-9)
    return slope, std, NORMAL, reach


def _between_thirds(x: Floats) -> float:
    low, high = np.percentile(x, (100 / 6, 500 / 6))
    return float(high - low)


def _by_direction(some: Exchanges, error: Floats) -> Iterator[Candidate]:
    """Where carriers were not read: skew makes ranges of a pair longer one way, and as much shorter the other way."""
    ways, variance = _both_ways(some, [error])
    if len(ways):
        std = np.sqrt(variance[:, 0])
        worst = int(np.argmax(np.abs(ways[:, 0]) / std))
        size = float(np.max(np.abs(ways[:, 0])))
        told = f"ranges of a pair differ by up to {100 * size:.0f} cm by who initiates"
        p_value = exceeds(float(ways[worst, 0]), float(std[worst]), DOF, tolerance=ONE_WAY_M, tried=len(ways))
        remedy = "record the carrier integrator, or use double-sided ranging; until then take the mean of both ways"
        yield Candidate(LEFT, told, p_value, {"more": remedy})


def _both_ways(some: Exchanges, columns: list[Floats]) -> tuple[Floats, Floats]:
    """Return by how much medians of columns (n,) differ between the two ways of each pair, and their variances.

    Both are (pairs, columns).
    """
    pair, forth = pair_ids(some), some.initiator < some.target
    found, variance = list[list[float]](), list[list[float]]()
    for p in np.unique(pair):
        ways = [(pair == p) & (forth == way) for way in (True, False)]
        if min(np.count_nonzero(way) for way in ways) >= FEWEST_A_WAY:
            found.append([float(np.median(c[ways[0]]) - np.median(c[ways[1]])) for c in columns])
            variance.append([sum(OF_MEDIAN * _square(c[way]) / len(c[way]) for way in ways) for c in columns])
    shape = len(found), len(columns)
    return np.array(found).reshape(shape), np.array(variance).reshape(shape)


def _square(values: Floats) -> float:
    return max(robust_spread(values), 1e-4) ** 2


def _within(some: Exchanges, values: Floats) -> Floats:
    """Return values (n,) less the median of their pair and way."""
    way = pair_ids(some) * 2 + (some.initiator < some.target)
    _, place = np.unique(way, return_inverse=True)
    return np.asarray(values - medians(values, place, int(place.max()) + 1)[place])


def swapped_roles(view: RecordingView) -> Iterator[Candidate]:
    """The target's clock against the initiator's: from the third leg, and as the carriers say."""
    e = view.exchanges
    double = (e.protocol == "ds") & (e.tx3 != 0) & np.isfinite(e.skew1_ppm)
    if np.count_nonzero(double) < 100:
        return
    spans = intervals(e[double])
    with np.errstate(all="ignore"):
        target_faster = (spans.dt53 / spans.dt64 - 1) * 1e6
    told = e.skew1_ppm[double]
    pairs = pair_ids(e[double])
    first = e.initiator[double] < e.target[double]
    groups = [
        (float(np.median(target_faster[rows])), float(np.median(told[rows])), OF_MEDIAN * _square(told[rows]) / count)
        for p in np.unique(pairs)
        for way in (True, False)
        if (count := np.count_nonzero(rows := (pairs == p) & (first == way))) > FEWEST_A_WAY
    ]
    if not groups:
        return
    stamps, readings, variance = np.array(groups).T
    # The readings' own offset of a tenth of a ppm, which is no noise, hides no slope of 1.
    slope, std = _line(stamps, readings, variance)
    if slope < -NEAR:
        yield Candidate(
            "swapped roles",
            "the carriers say that the targets' clocks are slower where the stamps say faster, and the other way round",
            exceeds(slope, std, NORMAL, tolerance=NEAR),
        )


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


def unread(view: RecordingView) -> Iterator[Candidate]:
    """Single-sided ranges whose carriers were not read: nothing says what skew left in them."""
    left = left_skew(view.exchanges)
    if left is None or np.isfinite(left.told_m):
        return
    yield Candidate(BLIND, told(left))


def carriers(view: RecordingView) -> Iterator[Candidate]:
    """Carriers' readings that do not follow the clocks' ratios by the stamps."""
    if without_stamps(view.exchanges).all():
        return
    found = clock_skews(view.exchanges)
    known = [(one.residual_ppm, one.count, one.pair) for one in found if one.residual_ppm and one.count >= FEWEST]
    if not known:
        return
    # That of most pairs: one board that scatters is not the unit of all.
    scatter, count, pair = sorted(known)[(len(known) - 1) // 2]
    # Of the logarithm of a median absolute deviation (efficiency 0.37).
    std = float(1 / np.sqrt(2 * 0.37 * count))
    p_value = exceeds(max(np.log(scatter / SCATTER_PPM), 0.0), std, NORMAL)
    told = (
        f"they scatter by {scatter:.1f} ppm about their median (pair {pair}), and as much or more in half of the pairs"
    )
    yield Candidate("carrier readings that say little", told, p_value)
