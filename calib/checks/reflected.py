"""Checks of reflections: which share of the ranges the error model takes for reflected, and how long they stay so."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.checks.recording_view import QuickFit, RecordingView, quick_fit
from calib.findings import BUDGET, Candidate, exceeds, more_often, stretches
from uwblink.arrays import Bools, Floats

LASTING: Final = "reflections that last"
MANY: Final = "reflections"
MANY_SHARE: Final = 0.15
"""Share of reflected ranges of a sound recording: among obstacles placed for it a MILUV flight has 12 %."""

LEAST_SHARE: Final = 0.02
"""Share of which no more is asked than whether it lasts."""

LAGS: Final = (1, 4)
"""Ranges of a pair between which reflections are compared: how likely they stay so says how long they last."""


def reflections(view: RecordingView) -> Iterator[Candidate]:
    """Pairs whose reflections last, and recordings or tags of whose ranges a large share is reflected."""
    fit = view.quick_fit or quick_fit([view], constants="tag", ranges_a_pair=1)
    if fit is None or len(fit.rows) < 150:
        return
    long = fit.reflected > 0.5
    share = float(np.mean(long))
    evidence = f"about {_in_words(fit, long)} on average"
    if view.quick_fit is None:
        yield from _of_tags(fit, long, evidence)
        return
    lasting = [one for pair in range(len(fit.ends)) for one in _of_pair(fit, pair, long) if one.p_value < BUDGET]
    if lasting:
        lasting.sort(key=lambda one: -one.gain)
        named = "; ".join(one.evidence for one in lasting[:4])
        more = f"; and {len(lasting) - 4} pairs more" if lasting[4:] else ""
        yield Candidate(LASTING, named + more, min(one.p_value for one in lasting))
    elif share > MANY_SHARE:
        parts = [float(np.mean(long[s])) for s in stretches(len(long))]
        std = float(np.std(parts, ddof=1) / np.sqrt(len(parts))) if parts else np.inf
        p_value = exceeds(share, std, len(parts) - 1, tolerance=MANY_SHARE)
        yield Candidate(MANY, evidence, p_value, {"more": "move antennas away from bodies and walls"})


def _in_words(fit: QuickFit, long: Bools, mine: Bools | slice = slice(None)) -> str:
    """Return which share of some ranges is long, and by how much, compared with the others among them."""
    return f"{100 * np.mean(long[mine]):.0f} % of the ranges, by {100 * _detour_m(fit, long, mine):.0f} cm"


def _detour_m(fit: QuickFit, long: Bools, mine: Bools | slice) -> float:
    rest, which = fit.residual[mine], long[mine]
    return float(np.mean(rest[which]) - np.median(rest[~which])) if which.any() and not which.all() else 0.0


def _of_pair(fit: QuickFit, pair: int, every: Bools) -> Iterator[Candidate]:
    """Yield a pair whose reflected ranges follow each other, with how much they lengthen its ranges as its gain."""
    mine = fit.pair == pair
    long, share = every[mine], float(np.mean(every[mine]))
    if len(long) < 60 or not LEAST_SHARE < share < 1:
        return
    life_s = _life_s(fit.reflected[mine], fit.time_s[mine])
    if life_s > 0.8:
        after = long[1:][long[:-1]]
        yield Candidate(
            LASTING,
            f"pair {fit.names[pair]}: {_in_words(fit, every, mine)}, for {life_s:.1f} s at a time",
            # Antennas turn slowly, so that a range is so much likelier reflected after a reflected one.
            more_often(int(after.sum()), len(after), share + 0.35 * (1 - share), tried=len(fit.ends)),
            gain=share * _detour_m(fit, every, mine),
        )


def _life_s(reflected: Floats, time_s: Floats) -> float:
    """Return how long a reflection lasts on average, from probabilities (n,) that ranges of a pair are reflected.

    The autocorrelation of a process of two states falls exponentially with time, at the sum of both rates; what noise
    hides it hides at all lags alike.
    """
    apart, steps = reflected - reflected.mean(), float(np.median(np.diff(time_s)))
    near, far = (float(np.mean(apart[lag:] * apart[:-lag])) for lag in LAGS)
    if near <= 0:
        return 0.0
    rate = np.log(near / max(far, 0.01 * near)) / (steps * (LAGS[1] - LAGS[0]))
    # What lasts longer than a quarter of the recording cannot be told from another level.
    return float(min(1 / max(rate * (1 - np.mean(reflected)), 1e-9), steps * len(time_s) / 4))


def _of_tags(fit: QuickFit, long: Bools, evidence: str) -> Iterator[Candidate]:
    """Where pairs have a few ranges each: the tags of whose ranges many more are reflected than of the others'."""
    p_value, tags = more_often(int(long.sum()), len(long), MANY_SHARE), np.unique(fit.ends).tolist()
    for tag in tags:
        mine = fit.of_tag(tag)
        others = float(np.mean(long[~mine])) if (~mine).any() else float(np.mean(long))
        p_tag = more_often(int(long[mine].sum()), int(mine.sum()), max(others, LEAST_SHARE), tried=len(tags))
        if p_tag < BUDGET:
            p_value = min(p_value, p_tag)
            evidence += f"; tag {tag}: {_in_words(fit, long, mine)}"
    remedy = "see what stands near these antennas; pairs have too few ranges to say more: record for longer"
    yield Candidate(MANY, evidence, p_value, {"more": remedy})
