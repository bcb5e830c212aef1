"""Clock skew that is left in single-sided ranges, and carriers' readings beside what the stamps say."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.checks.recording_view import RecordingView, quick_fit
from calib.data.clocks import PPM_TO_METRES, corrected, left_skew
from calib.findings import Candidate, exceeds
from calib.spread import medians, spreads
from uwblink.protocols.table import single_sided
from uwblink.recording import clock_skews, target_faster_ppm
from uwblink.ticks import TICK_S
from uwblink.twr import intervals, without_stamps

RANGES_OF_A_SLOPE: Final = 100

ONE_WAY_M: Final = 0.05
"""By how much ranges of a sound pair may differ by who initiates: the powers of both ways are not quite alike."""

NEAR: Final = 0.5
"""A slope is that of a fault, of 1 or of 2, or none: halfway lies the edge."""

LEFT: Final = "skew in single-sided ranges"
WRONG_SIGN: Final = "carrier readings with the wrong sign"

NORMAL: Final = 1e6
"""Degrees of freedom of what many ranges tell."""


def skew(view: RecordingView) -> Iterator[Candidate]:
    """Errors that follow the carriers' readings: skew that was not taken out, or was with the wrong sign."""
    e = view.exchanges
    single = np.isin(e.protocol, single_sided()) & np.isfinite(view.error_m) & ~without_stamps(e)
    taken = {corrected(name) for name in np.unique(e.protocol[single]).tolist()}
    if np.count_nonzero(single) < RANGES_OF_A_SLOPE or len(taken) > 1:
        return
    known = single & np.isfinite(e.skew2_ppm) & (e.skew2_ppm != 0)
    if np.count_nonzero(known) < RANGES_OF_A_SLOPE:
        yield from _by_direction(view.chosen(single))
        return
    # Delays are the same both ways, and do not follow skews, so that pairs that range one way tell of it as well.
    fit = quick_fit([view.chosen(known)], constants="tag")
    if fit is None:
        return
    some = e[known][fit.rows]
    # A target's reply lasts longer by the clock of a faster initiator, and so does the range.
    expected = PPM_TO_METRES * some.skew2_ppm * intervals(some).dt32 * TICK_S
    found = fit.offsets(expected[:, None])
    slope = float(found.size[0])
    reach = float(np.ptp(np.percentile(expected, (5, 95))))
    # Skew must be expected to change ranges by more, for it to be seen in them.
    if reach < 0.03:
        return
    p_value = exceeds(slope, float(found.std[0]), found.dof, tolerance=NEAR)
    evidence = f"errors grow by {slope:.2f} m in a metre of c/2 times carrier's skew times reply, over {reach:.2f} m"
    for at, fault, remedy in SLOPES[taken.pop()]:
        if abs(slope - at) < NEAR:
            yield Candidate(fault, evidence, p_value, {"more": remedy})


def _by_direction(single: RecordingView) -> Iterator[Candidate]:
    """Where carriers were not read: skew makes ranges of a pair longer one way, and as much shorter the other way."""
    fit = quick_fit([single])
    if fit is None:
        return
    e = single.exchanges[fit.rows]
    of_pairs = np.equal.outer(fit.pair, np.arange(len(fit.ends)))
    found = fit.offsets(of_pairs * np.where(e.initiator < e.target, 0.5, -0.5)[:, None])
    ways = found.size
    worst = int(np.argmax((np.abs(ways) - ONE_WAY_M) / found.std))
    evidence = (
        f"ranges of pair {fit.names[worst]} differ by {100 * abs(ways[worst]):.0f} cm by who initiates, the most of all"
    )
    p_value = exceeds(float(ways[worst]), float(found.std[worst]), found.dof, tolerance=ONE_WAY_M, tried=len(ways))
    remedy = "record the carrier integrator, or use double-sided ranging; until then take the mean of both ways"
    yield Candidate(LEFT, evidence, p_value, {"more": remedy})


def swapped_roles(view: RecordingView) -> Iterator[Candidate]:
    """The target's clock against the initiator's: from the third leg, and as the carriers say."""
    e = view.exchanges
    e = e[(e.protocol == "ds") & (e.tx3 != 0) & np.isfinite(e.skew1_ppm)]
    _, link, count = np.unique(e.initiator * 65_536 + e.target, return_inverse=True, return_counts=True)
    enough = count > 15
    if len(e) < RANGES_OF_A_SLOPE or not enough.any():
        return
    variance = (np.pi / 2 * np.maximum(spreads(e.skew1_ppm, link), 1e-4) ** 2 / count)[enough]
    stamps, readings = (medians(ppm, link)[enough] for ppm in (target_faster_ppm(e), e.skew1_ppm))
    square = max(float(np.sum(stamps**2 / variance)), 1e-300)
    slope = float(np.sum(stamps * readings / variance)) / square
    left = float(np.mean((readings - slope * stamps) ** 2 / variance))
    # The readings' own offset of a tenth of a ppm, which is no noise, hides no slope of 1.
    if slope < -NEAR:
        yield Candidate(
            "swapped roles",
            "the carriers say that the targets' clocks are slower where the stamps say faster, and the other way round",
            exceeds(slope, float(np.sqrt(max(left, 1.0) / square)), NORMAL, tolerance=NEAR),
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
    if left and not np.isfinite(left.told_m):
        yield Candidate("single-sided without carrier readings", str(left))


def carriers(view: RecordingView) -> Iterator[Candidate]:
    """Carriers' readings that do not follow the clocks' ratios by the stamps."""
    known = sorted(
        (one.residual_ppm, one.count, one.pair)
        for one in clock_skews(view.exchanges)
        if one.residual_ppm and one.count >= RANGES_OF_A_SLOPE
    )
    if known:
        # That of most pairs: one board that scatters is not the unit of all.
        scatter, count, pair = known[(len(known) - 1) // 2]
        # Of the logarithm of a median absolute deviation (efficiency 0.37).
        # Of a sound board: a reply of 1.5 ms then adds a third of a metre to a range.
        p_value = exceeds(max(np.log(scatter / 1.5), 0.0), float(1 / np.sqrt(2 * 0.37 * count)), NORMAL)
        yield Candidate(
            "carrier readings that say little",
            f"they scatter by {scatter:.1f} ppm about their median (pair {pair}), and as much or more in half of the "
            "pairs",
            p_value,
        )
