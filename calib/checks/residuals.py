"""Checks of the residuals of a quick fit: ranges far off the distances, skew of clocks, and reflections."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.checks.recording_view import Offsets, QuickFit, RecordingView, quick_fit
from calib.data.clocks import PPM_TO_METRES, corrected
from calib.estimator.known_distances import ASTRAY_M, FEWEST_RANGES
from calib.findings import BUDGET, NAMED_DETOUR_M, Candidate, more_often, positive, stretches
from uwblink.arrays import Bools, Floats
from uwblink.protocols.table import single_sided
from uwblink.ticks import TICK_S
from uwblink.twr import intervals, without_stamps

ONE_WAY_M: Final = 0.05
"""By how much ranges of a sound pair may differ by who initiates: the powers of both ways are not quite alike, and
published curves slope by 2 cm a dB (rms over -98 to -78 dBm)."""

MANY_SHARE: Final = 0.15
"""Share of reflected ranges of a sound recording: among obstacles placed for it a MILUV flight has 12 %."""

LEAST_SHARE: Final = 0.02
"""With a smaller share of reflected ranges, it is not asked how long reflections last: it is a sixth of what a MILUV
flight has, and noise passes for it."""

LASTING_S, AGAIN = 0.8, 0.35
"""A reflection that lasts longer is named, if a range after a reflected one is likelier reflected than others by more
than this share of what is left. Antennas turn by less than their beams are wide within it, in sound recordings too: set
by seeds below those of `benchmarks.flights.FIRST_REPORTED`."""

LEFT, WRONG_SIGN = "skew in single-sided ranges", "carrier readings with the wrong sign"
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
"""What slopes of errors over the expected skew mean, by whether the protocol corrects the skew."""


def astray(view: RecordingView) -> Iterator[Candidate]:
    """Pairs whose ranges and true distances have little to do with each other."""
    fit, found = view.quick_fit, list[tuple[float, str]]()
    if fit is None:
        return
    for pair, name in enumerate(fit.model.pairs.names):
        rest = np.minimum(np.abs(fit.residual[fit.model.pairs.number == pair]), 10 * ASTRAY_M)
        means = np.array([float(np.mean(rest[s])) for s in stretches(len(rest))])
        # Logarithms have the mean's logarithm as their mean at most (Jensen), and vary less from stretch to stretch.
        found.append((positive(np.log(np.maximum(means, 1e-3) / ASTRAY_M)), f"{name} by {np.mean(rest):.2f} m"))
    found.sort()
    # What is wrong with an anchor or a tag is wrong with several pairs: of all p-values together (Simes 1986).
    p_value = min(len(found) * p_value / k for k, (p_value, _) in enumerate(found, 1))
    wrong = [name for own, name in found if own < BUDGET]
    more = f" and {len(wrong) - 6} pairs more" if wrong[6:] else ""
    evidence = f"ranges of pairs {', '.join(wrong[:6])}{more} differ on average, each pair's median aside"
    yield Candidate("ranges that do not follow the distances", evidence, p_value)


def skew(view: RecordingView) -> Iterator[Candidate]:
    """Errors that follow the carriers' readings: skew that was not corrected, or with the wrong sign."""
    e = view.exchanges
    single = np.isin(e.protocol, single_sided()) & np.isfinite(view.error_m) & ~without_stamps(e)
    taken = {corrected(name) for name in np.unique(e.protocol[single]).tolist()}
    if len(taken) != 1:
        return
    known = single & np.isfinite(e.skew2_ppm) & (e.skew2_ppm != 0)
    if np.count_nonzero(known) < FEWEST_RANGES:
        yield from _by_direction(view.chosen(single))
        return
    # Delays are the same both ways, and do not follow skews, so that pairs that range one way tell of it as well.
    fit = quick_fit([view.chosen(known)], constants="tag")
    if fit is None:
        return
    some = e[known][fit.rows]
    # A target's reply lasts longer by the clock of a faster initiator, and so does the range.
    expected = PPM_TO_METRES * some.skew2_ppm * intervals(some).dt32 * TICK_S
    reach = float(np.ptp(np.percentile(expected, (5, 95))))
    # Skew must be expected to change ranges by more, for it to be seen in them.
    if reach < 0.03:
        return
    slope, p_value = fit.offset(expected, tolerance=0.5)
    evidence = f"errors grow by {slope:.2f} m in a metre of c/2 times carrier's skew times reply, over {reach:.2f} m"
    for at, fault, remedy in SLOPES[taken.pop()]:
        # Halfway between the slopes of sound and of faulty ranges.
        if abs(slope - at) < 0.5:
            yield Candidate(fault, evidence, p_value, {"more": remedy})


def _by_direction(single: RecordingView) -> Iterator[Candidate]:
    """Where carriers were not read: skew makes ranges of a pair longer one way, and as much shorter the other way."""
    fit = quick_fit([single])
    if fit is None:
        return
    signs = np.where(single.exchanges.initiator < single.exchanges.target, 0.5, -0.5)[fit.rows]
    ways = np.where(np.equal.outer(fit.model.pairs.number, np.arange(len(fit.model.pairs.ends))), signs[:, None], 0.0)
    seen = Offsets.of(fit.test(ways), np.eye(len(fit.model.pairs.ends)))
    worst = int(np.argmax((np.abs(seen.size) - ONE_WAY_M) / seen.std))
    size, p_value = fit.offset(ways[:, worst], tolerance=ONE_WAY_M, tried=len(fit.model.pairs.ends))
    yield Candidate(
        LEFT,
        f"ranges of pair {fit.model.pairs.names[worst]} differ by {100 * abs(size):.0f} cm by who initiates, the "
        "most of all",
        p_value,
        {"more": "record the carrier integrator, or use double-sided ranging; until then take the mean of both ways"},
    )


def reflections(view: RecordingView) -> Iterator[Candidate]:
    """Pairs whose reflections last, and recordings or tags of whose ranges a large share is reflected."""
    fit = view.quick_fit or quick_fit([view], constants="tag", ranges_a_pair=1)
    if fit is None or len(fit.rows) < 150:
        return
    long = fit.reflected > 0.5
    evidence = f"about {_in_words(fit, long)} on average"
    if view.quick_fit is None:
        yield from _of_tags(fit, long, evidence)
        return
    lasting = [
        one for pair in range(len(fit.model.pairs.ends)) for one in _of_pair(fit, pair, long) if one.p_value < BUDGET
    ]
    if lasting:
        lasting.sort(key=lambda one: -one.gain)
        more = f"; and {len(lasting) - 4} pairs more" if lasting[4:] else ""
        named = "; ".join(one.evidence for one in lasting[:4]) + more
        yield Candidate("reflections that last", named, min(one.p_value for one in lasting))
    else:
        far = long & (fit.residual > NAMED_DETOUR_M)
        p_value = positive(np.array([np.mean(far[s]) - MANY_SHARE for s in stretches(len(long))]))
        yield Candidate("reflections", evidence, p_value, {"more": "move antennas away from bodies and walls"})


def _in_words(fit: QuickFit, long: Bools, mine: Bools | slice = slice(None)) -> str:
    """Return which share of some ranges is long, and by how much, compared with the others among them."""
    return f"{100 * np.mean(long[mine]):.0f} % of the ranges, by {100 * _detour_m(fit, long, mine):.0f} cm"


def _detour_m(fit: QuickFit, long: Bools, mine: Bools | slice) -> float:
    rest, which = fit.residual[mine], long[mine]
    return float(np.mean(rest[which]) - np.median(rest[~which])) if which.any() and not which.all() else 0.0


def _of_pair(fit: QuickFit, pair: int, every: Bools) -> Iterator[Candidate]:
    """Yield a pair whose reflected ranges follow each other, with how much they lengthen its ranges as its gain."""
    mine = fit.model.pairs.number == pair
    long, share = every[mine], float(np.mean(every[mine]))
    if len(long) < 60 or not LEAST_SHARE < share < 1:
        return
    life_s = _life_s(fit.reflected[mine], 1e-9 * float(np.median(np.diff(fit.model.ranges.time_ns[mine]))))
    if life_s > LASTING_S:
        after = long[1:][long[:-1]]
        yield Candidate(
            "reflections that last",
            f"pair {fit.model.pairs.names[pair]}: {_in_words(fit, every, mine)}, for {life_s:.1f} s at a time",
            more_often(int(after.sum()), len(after), share + AGAIN * (1 - share), tried=len(fit.model.pairs.ends)),
            gain=share * _detour_m(fit, every, mine),
        )


def _life_s(reflected: Floats, step_s: float) -> float:
    """Return how long a reflection lasts on average, from probabilities (n,) that ranges of a pair are reflected.

    The autocorrelation of a process of two states falls exponentially with time, at the sum of both rates; what noise
    hides it hides at all lags alike. Ranges are `step_s` apart.
    """
    apart = reflected - reflected.mean()
    near, far = (float(np.mean(apart[lag:] * apart[:-lag])) for lag in (1, 4))
    if near <= 0:
        return 0.0
    rate = np.log(near / max(far, 0.01 * near)) / (3 * step_s)
    # What lasts longer than a quarter of the recording cannot be told from another level.
    return float(min(1 / max(rate * (1 - reflected.mean()), 1e-9), step_s * len(reflected) / 4))


def _of_tags(fit: QuickFit, long: Bools, evidence: str) -> Iterator[Candidate]:
    """Where pairs have a few ranges each: the tags of whose ranges many more are reflected than of the others'."""
    p_value, tags = more_often(int(long.sum()), len(long), MANY_SHARE), np.unique(fit.model.pairs.ends).tolist()
    for tag in tags:
        mine = (fit.model.pairs.ends == tag).any(axis=1)[fit.model.pairs.number]
        others = float(np.mean(long[~mine])) if (~mine).any() else float(np.mean(long))
        p_tag = more_often(int(long[mine].sum()), int(mine.sum()), max(others, LEAST_SHARE), tried=len(tags))
        if p_tag < BUDGET:
            p_value = min(p_value, p_tag)
            evidence += f"; tag {tag}: {_in_words(fit, long, mine)}"
    remedy = "see what stands near these antennas; pairs have too few ranges to say more: record for longer"
    yield Candidate("reflections", evidence, p_value, {"more": remedy})
