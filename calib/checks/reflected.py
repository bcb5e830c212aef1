"""Reflections: how many ranges of a pair have a detour, and whether it lasts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.checks.advice import advice_on_loss
from calib.checks.levels import Levels, levels
from calib.checks.recording_view import RecordingView
from calib.findings import BUDGET, Candidate, exceeds, more_often, stretches
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints

LASTING: Final = "reflections that last"
MANY: Final = "reflections"
BEYOND: Final = 3.0
"""Spreads of the core beyond which a range counts as reflected."""

FEWEST: Final = 60
FEWEST_SPELLS: Final = 2
LEAST_SHARE: Final = 0.02
STICKY: Final = 0.35
"""By how much likelier a reflected range may be after a reflected one in a sound recording: antennas turn slowly."""

SHORTEST_S: Final = 0.8
"""What lasts shorter averages out."""

LAGS: Final = (1, 4)
"""Ranges of a pair between which reflections are compared: how likely they stay so says how long they last."""

LONGEST: Final = 4.0
"""Reflections that last longer than such a part of a recording cannot be told from another level."""

LEAST_STICKY: Final = 0.03
MANY_SHARE: Final = 0.15
"""Share of long ranges of a sound recording: among obstacles placed for it a MILUV flight has 12 %."""

GAP: Final = 1
"""Direct ranges that do not end a spell."""

NAMED: Final = 4
FEWEST_IN_ALL: Final = 150
FEWEST_OF_TAG: Final = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class Reflected:
    """A pair's reflected ranges: their share, mean detour, how much they stick, spells, and how long these last."""

    pair: int
    share: float
    detour_m: float
    sticky: float
    spells: int
    life_s: float
    p_value: float


def reflections(view: RecordingView) -> Iterator[Candidate]:
    """Pairs whose reflections last, and recordings of which a large share is reflected."""
    known = levels(view)
    if known is None:
        yield from _of_tags(view)
        return
    found = [one for pair in range(len(known.level)) if (one := reflected(known, pair))]
    lasting = [one for one in found if one.p_value < BUDGET and one.spells >= FEWEST_SPELLS and one.life_s > SHORTEST_S]
    if lasting:
        yield _of_lasting(view, known, lasting)
        return
    if found:
        yield from _many(view, known, found)


def _many(view: RecordingView, known: Levels, found: list[Reflected]) -> Iterator[Candidate]:
    counts = np.bincount(known.pair, minlength=len(known.level))
    share = float(np.sum([one.share * counts[one.pair] for one in found]) / counts.sum())
    long = np.zeros(len(known.rest))
    for one in found:
        rows = known.pair == one.pair
        centre, spread = _core(known.rest[rows])
        long[rows] = np.abs(known.rest[rows] - centre) > BEYOND * spread
    parts = [float(np.mean(long[s])) for s in stretches(len(long))]
    std = float(np.std(parts, ddof=1) / np.sqrt(len(parts))) if parts else np.inf
    p_value = exceeds(share, std, len(parts) - 1, tolerance=MANY_SHARE)
    if p_value < 1:
        detour = float(np.average([one.detour_m for one in found], weights=[one.share for one in found]))
        told = (
            f"about {100 * share:.0f} % of the ranges are longer than noise explains, by {100 * detour:.0f} cm on "
            "average"
        )
        yield Candidate(
            MANY, told, p_value, {"more": f"move antennas away from bodies and walls{advice_on_loss(view)}"}
        )


def _of_tags(view: RecordingView) -> Iterator[Candidate]:
    """Where pairs have a few ranges each: the tags of whose ranges many more are reflected than of the others'."""
    e, good = view.exchanges, np.isfinite(view.error_m)
    if np.count_nonzero(good) < FEWEST_IN_ALL:
        return
    ends, error = np.column_stack([e.initiator, e.target])[good], view.error_m[good]
    tags, place = np.unique(ends, return_inverse=True)
    place = place.reshape(ends.shape)
    rest = _less_tags(error, place, len(tags))
    centre, spread = _core(rest)
    long = rest > centre + BEYOND * spread
    share = float(np.mean(long))
    told, p_value = [], more_often(int(np.count_nonzero(long)), len(long), MANY_SHARE)
    for k, tag in enumerate(tags.tolist()):
        mine = (place == k).any(axis=1)
        others = float(np.mean(long[~mine])) if (~mine).any() else share
        count = int(np.count_nonzero(mine))
        p_tag = more_often(int(np.count_nonzero(long[mine])), count, max(others, LEAST_SHARE), tried=len(tags))
        p_value = min(p_value, p_tag)
        if count >= FEWEST_OF_TAG and p_tag < BUDGET:
            detour = float(np.mean(rest[mine & long])) - centre
            told.append(f"tag {tag}: {100 * np.mean(long[mine]):.0f} % of its ranges, by {100 * detour:.0f} cm")
    if long.any():
        detour = float(np.mean(rest[long])) - centre
        yield Candidate(
            MANY,
            f"about {100 * share:.0f} % of the ranges are longer than noise explains, by {100 * detour:.0f} cm on "
            "average" + "".join(f"; {one}" for one in told),
            p_value,
            {"more": "see what stands near these antennas; pairs have too few ranges to say more: record for longer"},
        )


def _less_tags(error: Floats, place: Ints, count: int) -> Floats:
    """Return errors (n,) less what each tag adds to all of its ranges, by least absolute deviations."""
    design = np.zeros((len(error), count))
    rows = np.arange(len(error))
    design[rows, place[:, 0]] += 0.5
    design[rows, place[:, 1]] += 0.5
    weight, rest = np.ones(len(error)), error
    for _ in range(30):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(design * root[:, None], error * root, rcond=1e-9)[0]
        rest = error - design @ found
        weight = 1 / np.maximum(np.abs(rest), 0.01)
    return np.asarray(rest)


def _of_lasting(view: RecordingView, known: Levels, lasting: list[Reflected]) -> Candidate:
    worst = sorted(lasting, key=lambda one: -one.share * one.detour_m)
    told = "; ".join(
        f"pair {known.named(one.pair)}: {100 * one.share:.0f} % of its ranges, by {100 * one.detour_m:.0f} cm, for "
        f"{one.life_s:.1f} s at a time"
        for one in worst[:NAMED]
    )
    more = f"; and {len(worst) - NAMED} pairs more" if len(worst) > NAMED else ""
    return Candidate(LASTING, told + more, min(one.p_value for one in lasting), {"advice": advice_on_loss(view)})


def reflected(known: Levels, pair: int) -> Reflected | None:
    """Return what of a pair's ranges is reflected; None where that is little, or nothing can be said."""
    rows = known.pair == pair
    rest, time_s = known.rest[rows], known.time_s[rows]
    if len(rest) < FEWEST:
        return None
    centre, spread = _core(rest)
    long = rest > centre + BEYOND * spread
    short = rest < centre - BEYOND * spread
    # What noise leaves beyond on the long side it leaves on the short one.
    share = float(np.mean(long)) - float(np.mean(short))
    if share < LEAST_SHARE or not long.any():
        return None
    sticky, far = (_sticky(long, lag) for lag in LAGS)
    return Reflected(
        pair=pair,
        share=share,
        detour_m=float(np.mean(rest[long])) - centre,
        sticky=sticky,
        spells=_spells(long),
        life_s=_life_s(sticky, far, time_s, float(np.mean(long))),
        p_value=_lasts(long, len(known.level)),
    )


def _sticky(long: Bools, lag: int) -> float:
    """Return by how much likelier a range is reflected some ranges after a reflected one, from 0 to 1."""
    after, plain = long[lag:][long[:-lag]], float(np.mean(long))
    return (float(np.mean(after)) - plain) / max(1 - plain, 1e-3) if len(after) else 0.0


def _lasts(long: Bools, tried: int) -> float:
    """Return the p-value of ranges that follow a reflected one and are reflected, too, one pair of many."""
    plain = float(np.mean(long))
    after = long[1:][long[:-1]]
    return more_often(int(np.count_nonzero(after)), len(after), plain + STICKY * (1 - plain), tried=tried)


def _life_s(sticky: float, far: float, time_s: Floats, share: float) -> float:
    """Return how long a reflection lasts on average, from how likely it stays: noise hides some, at all lags alike.

    Of a process of two states the likelihood falls exponentially with time, at the sum of both rates.
    """
    if sticky <= LEAST_STICKY:
        return 0.0
    near, later = (float(np.median(time_s[lag:] - time_s[:-lag])) for lag in LAGS)
    rate = np.log(sticky / max(far, LEAST_STICKY)) / max(later - near, 1e-9)
    # Host times may have gaps of hours between one spell of ranging and the next.
    longest = float(np.median(np.diff(time_s))) * len(time_s) / LONGEST
    return float(min(1 / max(rate * (1 - share), 1e-9), longest))


def _core(rest: Floats) -> tuple[float, float]:
    """Return centre and spread of the direct ranges: of the shorter ones, which no detour makes longer."""
    centre, spread = float(np.median(rest)), robust_spread(rest)
    for _ in range(6):
        inside = rest[rest < centre + 1.5 * spread]
        centre = float(np.median(rest[np.abs(rest - centre) < 1.5 * spread]))
        low = inside[inside < centre]
        spread = max(robust_spread(low, centre), 1e-4) if len(low) > 10 else spread
    return centre, spread


def _spells(long: Bools) -> int:
    """Count spells of two and more reflected ranges; one direct range between does not end one."""
    at = np.flatnonzero(long)
    starts = np.flatnonzero(np.diff(at, prepend=-10) > GAP + 1)
    return sum(len(group) > 1 for group in np.split(at, starts[1:]))
