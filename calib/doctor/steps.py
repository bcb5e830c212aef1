"""A tag whose delay changes: all of its pairs shift alike at one time, others do not, and it does not come back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.doctor.base import Finding, RecordingView
from calib.doctor.levels import Levels, levels, variance_of_sum
from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT

MOVED: Final = "delay changed mid-flight"
DRIFTED: Final = "delay drifts"
SHORTEST_S: Final = 10.0
CUTS: Final = 60
MARGIN: Final = 0.06
"""Part of a recording at either end in which no change is looked for."""

FEWEST_PAIRS: Final = 2
FEWEST: Final = 12
SURELY: Final = 7.0
"""Standard errors of a shift, at the best of many times and tags."""

SMALLEST_M: Final = 0.03
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
    """By how much a tag's ranges shift, at what time, and how many standard errors that is."""

    tag: int
    size_m: float
    time_s: float
    deviation: float
    drifts: bool


def moved_delay(view: RecordingView) -> Iterator[Finding]:
    """Tags whose ranges all shift at one time."""
    known = levels(view)
    if known is None or known.time_s[-1] < SHORTEST_S:
        return
    for shift in shifts(known):
        ps = f"{abs(shift.size_m) / SPEED_OF_LIGHT * 2e9:.2f} ns"
        if shift.drifts:
            yield Finding(
                DRIFTED,
                f"ranges of tag {shift.tag} drift by {100 * shift.size_m:+.1f} cm over the recording ({ps}), all its "
                "pairs alike, others do not",
                f"let tag {shift.tag} warm up, see to its supply; calibrate short parts apart",
                0.75,
            )
            continue
        yield Finding(
            MOVED,
            f"ranges of tag {shift.tag} shift by {100 * shift.size_m:+.1f} cm {shift.time_s:.0f} s after the start "
            f"({ps} in its delay), all its pairs alike, others do not",
            f"look for a loose antenna or another voltage on tag {shift.tag}; calibrate the two parts apart",
            0.85,
        )


def shifts(known: Levels) -> list[Shift]:
    """Return the tags that shift, the surest first, each after what was found before it is taken off."""
    values, found = known.clipped, list[Shift]()
    variance = np.array([
        variance_of_sum(values[known.pair == p], known.time_s[known.pair == p]) for p in range(len(known.level))
    ])  # fmt: skip
    for _ in range(MOST):
        some = [one for tag in np.unique(known.ends).tolist() if (one := _shift_of(known, values, variance, tag))]
        some = [one for one in some if one.tag not in {old.tag for old in found}]
        if not some:
            break
        best = max(some, key=lambda one: abs(one.deviation))
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
    def deviation(self) -> float:
        return self.mean * float(np.sqrt(np.sum(1 / self.variance)))


def _shift_of(known: Levels, values: Floats, variance: Floats, tag: int) -> Shift | None:
    mine = known.pairs_of(tag)
    others = np.setdiff1d(np.arange(len(known.level)), mine)
    if len(mine) < FEWEST_PAIRS:
        return None
    length = known.time_s[-1]
    best: tuple[float, float, _Cut] | None = None
    for time in np.linspace(MARGIN, 1 - MARGIN, CUTS) * length:
        cut = _cut(known, values, variance, mine, float(time))
        if cut is not None and len(cut.size) >= FEWEST_PAIRS and (best is None or abs(cut.deviation) > abs(best[0])):
            best = cut.deviation, float(time), cut
    if best is None or abs(best[0]) < SURELY:
        return None
    deviation, time, cut = best
    rest = _cut(known, values, variance, others, time) if len(others) else None
    if not _agree(cut) or (rest is not None and abs(rest.mean) > OTHERS * abs(cut.mean)):
        return None
    time = _sharpened(known, values, mine, time)
    size = _size(known, mine, time)
    rows = np.isin(known.pair, mine)
    drifts = _line(known.time_s[rows], values[rows]) > STEEPER * _step(known.time_s[rows], values[rows], time)
    if not SMALLEST_M < abs(size) < LARGEST_M or not (drifts or _stays(known, values, mine, time)):
        return None
    return Shift(tag=tag, size_m=size, time_s=time, deviation=deviation, drifts=drifts)


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


def _agree(cut: _Cut) -> bool:
    """Return whether all pairs shift alike: an antenna does that to all, a wall only to some."""
    wrong = np.abs(cut.size - cut.mean)
    std = np.sqrt(cut.variance)
    alike = (wrong < AGREE * abs(cut.mean)) | (wrong < np.minimum(APART * std, abs(cut.mean)))
    sure = np.abs(cut.size) > 2 * std
    return bool(alike.all() and np.count_nonzero(sure & (cut.size * cut.mean > 0)) >= FEWEST_PAIRS)


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
