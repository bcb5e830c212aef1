"""What can be wrong with radios, antennas and surroundings."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.doctor.base import Finding, RecordingView, pair_ids, spread_m
from calib.estimation.confounding import explained_by_distance
from calib.estimation.error_mixture import fit_error_mixture
from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT, TICKS_PER_SECOND
from uwblink.twr import intervals

CONFOUNDED: Final = "power confounded with distance"


def skew(view: RecordingView) -> Iterator[Finding]:
    """Errors that follow the relative skew of a pair times its reply delay, as uncorrected single-sided ones do."""
    e = view.exchanges
    single = (e.protocol == "ss") & np.isfinite(view.error_m) & np.isfinite(e.skew1_ppm)
    if np.count_nonzero(single) < 100:
        return
    dt32_s = intervals(e[single]).dt32 / TICKS_PER_SECOND
    expected = -0.5 * SPEED_OF_LIGHT * e.skew1_ppm[single] * 1e-6 * dt32_s
    error = view.error_m[single]
    slope = float(np.polyfit(expected, error, 1)[0]) if np.std(expected) > 0.05 else 0.0
    if 0.5 < slope < 1.5:
        yield Finding(
            "skew in single-sided ranges",
            f"errors follow c/2 times skew times reply delay with slope {slope:.2f}, over {np.ptp(expected):.1f} m",
            "use double-sided ranging, or correct single-sided ranges with the measured skew",
            0.9,
        )


def moved_delay(view: RecordingView) -> Iterator[Finding]:
    """A tag all of whose pairs shift at one time: the largest change of medians between before and after."""
    e, error = view.exchanges, view.error_m
    good = np.isfinite(error)
    if np.count_nonzero(good) < 1000:
        return
    time = (e.time_ns - e.time_ns[good].min()) * 1e-9
    length = float(time[good].max())
    if length < 10:
        return
    pair = pair_ids(e)
    centred = error.copy()
    for p in np.unique(pair):
        centred[pair == p] -= np.nanmedian(error[pair == p])
    spread, moved = spread_m(view), []
    for tag in sorted({*e.initiator.tolist(), *e.target.tolist()}):
        mine = good & ((e.initiator == tag) | (e.target == tag))
        rest = good & ~mine
        best, at = 0.0, 0.0
        for cut in np.linspace(0.15, 0.85, 15) * length:
            step = _step(centred, mine, time, cut) - (_step(centred, rest, time, cut) if rest.any() else 0.0)
            if abs(step) > abs(best):
                best, at = step, float(cut)
        large = abs(best) > 0.12 and abs(best) > 12 * spread / np.sqrt(np.count_nonzero(mine) / 4)
        if large and _in_all_pairs(centred, mine, pair, time, at, best):
            moved.append((abs(best), tag, best, at))
    # Partners of the tag that moved shift with it, by less.
    for _, tag, best, at in sorted(moved)[-1:]:
        yield Finding(
            "delay changed mid-flight",
            f"ranges of tag {tag} shift by {100 * best:+.1f} cm about {at:.0f} s after the start, others do not",
            f"look for a loose antenna or another voltage on tag {tag}; calibrate the two parts apart",
            0.8,
        )


def _in_all_pairs(values: Floats, mine: Bools, pair: Ints, time: Floats, cut: float, step: float) -> bool:
    """Return whether every pair of a tag shifts alike: an antenna does that to all, a wall only to some."""
    steps = [_step(values, mine & (pair == p), time, cut) for p in np.unique(pair[mine])]
    return all(0.4 < one / step < 1.6 for one in steps if one)


def _step(values: Floats, rows: Bools, time: Floats, cut: float) -> float:
    before, after = values[rows & (time < cut)], values[rows & (time >= cut)]
    return float(np.median(after) - np.median(before)) if len(before) > 50 and len(after) > 50 else 0.0


def reflections(view: RecordingView) -> Iterator[Finding]:
    """A large share of ranges with a detour."""
    good = np.isfinite(view.error_m) & (np.abs(view.error_m) < 20)
    if np.count_nonzero(good) < 300:
        return
    error = view.error_m[good]
    for p in np.unique(pair_ids(view.exchanges)[good]):
        rows = pair_ids(view.exchanges)[good] == p
        error[rows] -= np.median(error[rows])
    mixture = fit_error_mixture(error, np.zeros(len(error), dtype=np.int64), 1)
    if mixture.tail_share > 0.3 and mixture.tail_mean_m > 3 * mixture.sigma_m[0]:
        yield Finding(
            "reflections",
            f"about {100 * mixture.tail_share:.0f} % of the ranges are longer than noise explains, by "
            f"{100 * mixture.tail_mean_m:.0f} cm on average",
            "move antennas away from bodies and walls, or fit with `loss` mixture",
            0.75,
        )


def confounded(view: RecordingView) -> Iterator[Finding]:
    """Power that is a function of distance and nothing else lets the curve learn distance."""
    e = view.exchanges
    lifted = lifted_power(e.fpp1_dbm, e.fpp2_dbm, "mean-of-lifted", ALPHA_DBM)
    share = explained_by_distance(lifted, view.truth_m)
    if share is not None:
        yield Finding(
            CONFOUNDED,
            f"distance explains {100 * share:.0f} % of the power's variance",
            "turn the antennas while recording; until then the curve may hold what belongs to distance",
            0.8,
        )
