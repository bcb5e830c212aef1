"""A tag whose delay changes: all of its pairs shift alike at one time, others do not, and it does not come back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.checks.levels import DOF, Levels, levels
from calib.checks.recording_view import RecordingView
from calib.findings import Candidate, exceeds
from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT

MOVED: Final = "delay changed mid-flight"
DRIFTED: Final = "delay drifts"
SHORTEST_S: Final = 10.0
CUTS: Final = 60
MARGIN: Final = 0.06
"""Part of a recording at either end in which no change is looked for."""

FEWEST_PAIRS: Final = 2
FEWEST_OTHERS: Final = 3
"""Pairs of others that do not shift, which a tag with one pair needs, for that pair to be its own matter."""

FEWEST: Final = 12
TOLERANCE_M: Final = 0.02
"""What temperature does to a sound board: 2.15 mm a degree (DW1000 user manual), ten degrees."""

LARGEST_M: Final = 0.75
"""Of 5 ns: no antenna and no voltage does more."""

AGREE: Final = 0.5
APART: Final = 3.5
"""A pair agrees that shifts by this share of the whole or this many standard errors otherwise at most."""

OTHERS: Final = 0.4
STEEPER: Final = 1.15
"""A straight line explains a drift that explains so many times as much as a step."""

MOST: Final = 3


@dataclass(frozen=True, slots=True)
class Shift:
    """By how much a tag's ranges shift, at what time, and the p-value of that at the best of many times and tags."""

    tag: int
    size_m: float
    time_s: float
    p_value: float
    drifts: bool


def moved_delay(view: RecordingView) -> Iterator[Candidate]:
    """Tags whose ranges all shift at one time."""
    known = levels(view)
    if known is None or known.time_s[-1] < SHORTEST_S:
        return
    for shift in shifts(known):
        ps = f"{abs(shift.size_m) / SPEED_OF_LIGHT * 2e9:.2f} ns"
        if shift.drifts:
            yield Candidate(
                DRIFTED,
                f"ranges of tag {shift.tag} drift by {100 * shift.size_m:+.1f} cm over the recording ({ps}), all its "
                "pairs alike, others do not",
                shift.p_value,
                {"tag": shift.tag},
            )
            continue
        after_s = known.host_s[np.searchsorted(known.time_s, shift.time_s)]
        alike = "all its pairs alike" if len(known.pairs_of(shift.tag)) > 1 else "its only pair"
        yield Candidate(
            MOVED,
            f"ranges of tag {shift.tag} shift by {100 * shift.size_m:+.1f} cm {after_s:.0f} s after the start "
            f"({ps} in its delay), {alike}, others do not",
            shift.p_value,
            {"tag": shift.tag},
        )


def shifts(known: Levels) -> list[Shift]:
    """Return the tags that shift, the surest first, each after what was found before it is taken off."""
    values, found = known.clipped, list[Shift]()
    variance = known.variances(values)
    for _ in range(MOST):
        some = [one for tag in np.unique(known.ends).tolist() if (one := _shift_of(known, values, variance, tag))]
        some = [one for one in some if one.tag not in {old.tag for old in found}]
        if not some:
            break
        best = min(some, key=lambda one: (one.p_value, -abs(one.size_m)))
        found.append(best)
        rows = np.isin(known.pair, known.pairs_of(best.tag))
        values = values - np.where(rows & (known.time_s >= best.time_s), best.size_m, 0.0)
    return found


@dataclass(frozen=True, slots=True)
class _Cut:
    """Shifts of pairs (k,) at a time, and their variances."""

    size: Floats
    variance: Floats

    @property
    def mean(self) -> float:
        return float(np.sum(self.size / self.variance) / np.sum(1 / self.variance))

    @property
    def std(self) -> float:
        return float(1 / np.sqrt(np.sum(1 / self.variance)))


def _shift_of(known: Levels, values: Floats, variance: Floats, tag: int) -> Shift | None:
    mine = known.pairs_of(tag)
    others = np.setdiff1d(np.arange(len(known.level)), mine)
    needed = FEWEST_PAIRS if len(mine) > 1 or len(others) < FEWEST_OTHERS else 1
    cuts = np.linspace(MARGIN, 1 - MARGIN, CUTS) * known.time_s[-1]
    found = [(cut, float(time)) for time in cuts if (cut := _cut(known, values, variance, mine, float(time)))]
    found = [(cut, time) for cut, time in found if len(cut.size) >= needed]
    if not found:
        return None
    cut, time = max(found, key=lambda one: abs(one[0].mean) / one[0].std)
    # Every cut of every tag was tried.
    tried = CUTS * len(np.unique(known.ends))
    p_value = exceeds(cut.mean, cut.std, DOF * len(cut.size), tolerance=TOLERANCE_M, tried=tried)
    if p_value == 1:
        return None
    rest = _cut(known, values, variance, others, time) if len(others) else None
    if not _agree(cut, needed) or (rest is not None and abs(rest.mean) > OTHERS * abs(cut.mean)):
        return None
    time = _sharpened(known, values, mine, time)
    size = _size(known, mine, time)
    rows = np.isin(known.pair, mine)
    drifts = _line(known.time_s[rows], values[rows]) > STEEPER * _step(known.time_s[rows], values[rows], time)
    if abs(size) > LARGEST_M or not (drifts or _stays(known, values, mine, time)):
        return None
    return Shift(tag=tag, size_m=size, time_s=time, p_value=p_value, drifts=drifts)


def _cut(known: Levels, values: Floats, variance: Floats, pairs: Ints, time: float) -> _Cut | None:
    """Return the shifts of some pairs at a time, those with enough ranges on both sides."""
    late = known.time_s >= time
    count = len(known.level)
    total = [np.bincount(known.pair[side], values[side], minlength=count)[pairs] for side in (~late, late)]
    size = [np.bincount(known.pair[side], minlength=count)[pairs] for side in (~late, late)]
    enough = (size[0] >= FEWEST) & (size[1] >= FEWEST)
    if not enough.any():
        return None
    before, after = (t[enough] / n[enough] for t, n in zip(total, size, strict=True))
    return _Cut(after - before, variance[pairs][enough] * (1 / size[0][enough] + 1 / size[1][enough]))


def _agree(cut: _Cut, needed: int) -> bool:
    """Return whether all pairs shift alike: an antenna does that to all, a wall only to some."""
    wrong = np.abs(cut.size - cut.mean)
    std = np.sqrt(cut.variance)
    alike = (wrong < AGREE * abs(cut.mean)) | (wrong < np.minimum(APART * std, abs(cut.mean)))
    sure = np.abs(cut.size) > 2 * std
    return bool(alike.all() and np.count_nonzero(sure & (cut.size * cut.mean > 0)) >= needed)


def _sharpened(known: Levels, values: Floats, pairs: Ints, near: float) -> float:
    """Return the time at which a step explains most of a tag's ranges."""
    rows = np.isin(known.pair, pairs)
    time, value = known.time_s[rows], values[rows]
    sums = np.cumsum(value - value.mean())[:-1]
    count = np.arange(1, len(value))
    gain = sums**2 / (count * (len(value) - count))
    gain[np.abs(time[:-1] - near) > 0.1 * known.time_s[-1]] = -1.0
    return float(time[int(np.argmax(gain)) + 1])


def _size(known: Levels, pairs: Ints, time: float) -> float:
    """Return the shift by the medians of the pairs, which nothing was cut off of."""
    late, found, weight = known.time_s >= time, [], []
    for pair in pairs.tolist():
        rows = known.pair == pair
        before, after = known.rest[rows & ~late], known.rest[rows & late]
        if min(len(before), len(after)) >= FEWEST:
            found.append(float(np.median(after) - np.median(before)))
            weight.append(1 / (1 / len(before) + 1 / len(after)))
    return float(np.average(found, weights=weight)) if found else 0.0


def _stays(known: Levels, values: Floats, pairs: Ints, time: float) -> bool:
    """Return whether both parts keep their level: a body in the way goes again."""
    rows = np.isin(known.pair, pairs)
    when, value = known.time_s[rows], values[rows]
    halves = []
    for side in (when < time, when >= time):
        middle = np.median(when[side])
        halves += [float(np.mean(value[side & (when < middle)])), float(np.mean(value[side & (when >= middle)]))]
    first, second, third, fourth = halves
    step = (third + fourth - first - second) / 2
    return abs(second - first) < 0.6 * abs(step) and abs(fourth - third) < 0.6 * abs(step)


def _step(time: Floats, value: Floats, at: float) -> float:
    late = time >= at
    share = float(np.mean(late))
    return share * (1 - share) * float(np.mean(value[late]) - np.mean(value[~late])) ** 2 if 0 < share < 1 else 0.0


def _line(time: Floats, value: Floats) -> float:
    away = time - time.mean()
    return float((away @ value) ** 2 / max(away @ away, 1e-12)) / len(value)
