"""Checks of reflections: which share of the ranges the error model takes for reflected, and how long they stay so."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.checks.recording_view import QuickFit, RecordingView, quick_fit
from calib.data.ranges import Ranges
from calib.errors import CalibError
from calib.estimator.known_distances import Recipe, fit_known_distances
from calib.findings import BUDGET, Candidate, exceeds, more_often, stretches
from uwblink.arrays import Bools, Floats

LASTING: Final = "reflections that last"
MANY: Final = "reflections"
MANY_SHARE: Final = 0.15
"""Share of reflected ranges of a sound recording: among obstacles placed for it a MILUV flight has 12 %."""

LEAST_SHARE: Final = 0.02
"""Share of which no more is asked than whether it lasts."""

STICKY: Final = 0.35
"""By how much likelier a range may be reflected after a reflected one in a sound recording: antennas turn slowly."""

LASTS_S: Final = 0.8
"""What lasts shorter averages out."""

LAGS: Final = (1, 4)
"""Ranges of a pair between which reflections are compared: how likely they stay so says how long they last."""

RANGES_OF_A_SEQUENCE: Final = 60
"""Ranges of a pair from which is told how reflections follow each other."""

RANGES_IN_ALL: Final = 150
RANGES_OF_A_TAG: Final = 15
"""Ranges of a recording and of a tag from which a share is told."""

TRIED_RANGES: Final = 12_000
"""Ranges of a trial of losses: more say nothing else."""

BETTER: Final = 0.6
"""A loss is recommended if its halves disagree by no more than this share of the other's."""


def reflections(view: RecordingView) -> Iterator[Candidate]:
    """Pairs whose reflections last, and recordings or tags of whose ranges a large share is reflected."""
    fit = view.quick_fit or quick_fit([view], constants="tag", ranges_a_pair=1)
    if fit is None or len(fit.rows) < RANGES_IN_ALL:
        return
    long = fit.reflected > 0.5
    share = float(np.mean(long))
    evidence = (
        f"about {100 * share:.0f} % of the ranges are reflected, by {100 * _detour_m(fit, long):.0f} cm on average"
    )
    if view.quick_fit is None:
        yield from _of_tags(fit, long, evidence)
        return
    lasting = [one for pair in range(len(fit.ends)) for one in _of_pair(fit, pair, long) if one.p_value < BUDGET]
    if lasting:
        lasting.sort(key=lambda one: -one.gain)
        named = "; ".join(one.evidence for one in lasting[:4])
        more = f"; and {len(lasting) - 4} pairs more" if lasting[4:] else ""
        p_value = min(one.p_value for one in lasting)
        yield Candidate(LASTING, named + more, p_value, {"advice": advice_on_loss(view)})
    elif share > MANY_SHARE:
        parts = [float(np.mean(long[s])) for s in stretches(len(long))]
        std = float(np.std(parts, ddof=1) / np.sqrt(len(parts))) if parts else np.inf
        p_value = exceeds(share, std, len(parts) - 1, tolerance=MANY_SHARE)
        remedy = f"move antennas away from bodies and walls{advice_on_loss(view) if p_value < BUDGET else ''}"
        yield Candidate(MANY, evidence, p_value, {"more": remedy})


def _detour_m(fit: QuickFit, long: Bools) -> float:
    """Return by how much long ranges are longer than the others on average."""
    return float(np.mean(fit.residual[long]) - np.median(fit.residual[~long])) if long.any() and not long.all() else 0.0


def _of_pair(fit: QuickFit, pair: int, every: Bools) -> Iterator[Candidate]:
    """Yield a pair whose reflected ranges follow each other, with how much they lengthen its ranges as its gain."""
    mine = fit.pair == pair
    long, share = every[mine], float(np.mean(every[mine]))
    if len(long) < RANGES_OF_A_SEQUENCE or not LEAST_SHARE < share < 1:
        return
    life_s, detour_m = _life_s(fit.reflected[mine], fit.time_s[mine]), _detour_m(fit, mine & every)
    if life_s > LASTS_S:
        after = long[1:][long[:-1]]
        yield Candidate(
            LASTING,
            f"pair {fit.names[pair]}: {100 * share:.0f} % of its ranges, by {100 * detour_m:.0f} cm, for "
            f"{life_s:.1f} s at a time",
            more_often(int(after.sum()), len(after), share + STICKY * (1 - share), tried=len(fit.ends)),
            gain=share * detour_m,
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
        p_value = min(p_value, p_tag)
        if mine.sum() >= RANGES_OF_A_TAG and p_tag < BUDGET:
            size = f"{100 * np.mean(long[mine]):.0f} % of its ranges, by {100 * _detour_m(fit, mine & long):.0f} cm"
            evidence += f"; tag {tag}: {size}"
    remedy = "see what stands near these antennas; pairs have too few ranges to say more: record for longer"
    yield Candidate(MANY, evidence, p_value, {"more": remedy})


def advice_on_loss(view: RecordingView) -> str:
    """Return the loss under which two halves of these ranges agree better on the delays, as the end of a sentence.

    Says nothing where the ranges cannot be fitted, or the losses do alike.
    """
    try:
        apart = {loss: _halves_disagree_ps(view, loss) for loss in ("mixture", "cauchy")}
    except CalibError:
        return ""
    best, other = sorted(apart, key=lambda loss: apart[loss])
    said = (
        f"tried: delays of odd and even stretches differ by {apart[best]:.0f} ps with {best}, {apart[other]:.0f} with "
        f"{other}"
    )
    if apart[best] > BETTER * apart[other]:
        return f" ({said}: no loss is better here)"
    return f"; fit with `loss` {best} ({said})"


def _halves_disagree_ps(view: RecordingView, loss: str) -> float:
    """Return by how much delays of alternating stretches of time differ, rms less what they share.

    Raises what `fit_known_distances` raises.
    """
    ranges = Ranges.from_exchanges(view.exchanges, view.truth_m)
    order = np.argsort(ranges.time_ns, kind="stable")[:: max(len(ranges) // TRIED_RANGES, 1)]
    odd = np.arange(len(order)) * 20 // max(len(order), 1) % 2 == 1
    halves = [
        fit_known_distances(ranges[order[rows]].usable(), Recipe(loss=loss, fixed_ns={}, groups={}))
        for rows in (odd, ~odd)
    ]
    found = [dict(zip(half.model.tags, half.delays.tolist(), strict=True)) for half in halves]
    return 1e3 * float(np.std([found[0][tag] - found[1][tag] for tag in found[0] if tag in found[1]]))
