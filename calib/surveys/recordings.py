"""From recordings to arrangements (marked, named in a file, or found from the ranges) and to a mean of each pair.

While nothing moves, all that a pair's ranges say of delays and places is their mean. Means, their spread and what is
reflected among single ranges come of one fit with the error model of all ranges (`calib.estimator.range_model`). A mean
has the mean power of its ranges: what power varies by while nothing moves is an error of its measurement.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import PurePath

import numpy as np
from scipy import ndimage

from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.data.ranges import Ranges, concatenate
from calib.data.sources import Data, antenna_delays_of, each, opened
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.optimize import maximize
from calib.estimator.pairs import Pairs, pairs_of
from calib.estimator.range_model import RangeModel
from calib.estimator.range_rows import RESIDUAL, Part
from calib.estimator.unknowns import Prior, Priors, Unknown
from calib.spread import robust_spread
from calib.surveys.knowledge import Knowledge
from calib.surveys.result import Contradiction
from uwblink.arrays import Floats, Ints
from uwblink.recording.antenna_delays import AntennaDelays
from uwblink.recording.schema import Arrangement, KnownDistance
from uwblink.recording.summary import single_reports

LIFT = "mean-of-lifted"
"""How the powers of both ends become one, as in `calib.fit`."""

MIN_RANGES = 5
"""Ranges that a pair needs in an arrangement."""

PARTS = 10
"""Stretches of time whose means say how well the mean of all is known, also where errors last."""

MAX_RANGE_M = 1e4
"""Ranges beyond are no ranges, but stamps that went wrong."""

WINDOW_BINS = 5
"""Bins of a second before and after an instant whose medians are compared."""

STEP_M = 0.05
"""Smallest step of a pair's range that counts as a motion: people who walk past change less, or one pair only."""

MOVED_M = 0.03
"""Smallest change of a pair's range that tells of a board that was moved within an arrangement."""

SIGMAS = 6.0
"""Standard deviations of noise from which a change is one: one in 5e8 by chance, and there are thousands."""

MIN_STILL_S = 15.0
"""Shorter stretches between two motions are part of the motion."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairMeans:
    """One row a pair and arrangement (n,): `ends` (n, 2) are its tags, the smaller first, `weights` multiply delays.

    `range_m` is the mean of raw ranges, `std_m` how well it is known, `noise_m` the spread of single ranges, `lifted`
    the mean lifted power, NaN without.
    """

    arrangement: Ints
    ends: Ints
    weights: Floats
    range_m: Floats
    std_m: Floats
    noise_m: Floats
    count: Ints
    lifted: Floats

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.range_m)

    def tags(self) -> list[int]:
        """Return the ids of all tags, in order."""
        return sorted(set(self.ends.ravel().tolist()))


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyData:
    """Means of pairs, the arrangements whose numbers they carry, distances that recordings state, and what to say."""

    means: PairMeans
    arrangements: tuple[Arrangement, ...]
    distances: tuple[KnownDistance, ...]
    sources: tuple[str, ...]
    findings: tuple[Contradiction, ...]
    warnings: tuple[str, ...]
    antenna_delays: AntennaDelays


@dataclass(frozen=True, slots=True)
class Motion:
    """A board that was moved: when, and by how much its ranges changed, by the other board."""

    tag: int
    time_ns: int
    steps_m: dict[int, float]


def read_surveys(data: Data | Iterable[Data], knowledge: Knowledge) -> SurveyData:
    """Return the means of pairs of one or more recordings by arrangement.

    Raises `BadInputError` for two arrangements of one name, `UnanswerableError` where no boards stood still.
    """
    recordings = [_load(one) for one in each(data)]
    several = len(recordings) > 1
    if knowledge.spans_s and several:
        raise BadInputError("gives times of arrangements, which is for one recording only", parameter="known")
    arrangements: list[Arrangement] = []
    numbers: list[Ints] = []
    findings: list[Contradiction] = []
    for ranges, marked, _ in recordings:
        number = np.full(len(ranges), -1)
        for one in _arrangements(ranges, marked, knowledge, several=several):
            rows = (ranges.time_ns >= one.start_ns) & (ranges.time_ns < one.end_ns)
            number[rows] = len(arrangements)
            findings += _moved(one, ranges[rows])
            arrangements.append(one)
        numbers.append(number)
    names = [one.name for one in arrangements]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BadInputError(f"two arrangements are called {twice[0]!r:.40}; give each its own name", parameter="data")
    whole = concatenate([ranges for ranges, _, _ in recordings])
    means, few = pair_means(whole, np.concatenate(numbers))
    return SurveyData(
        means=means,
        arrangements=tuple(arrangements),
        distances=tuple(distance for _, _, stated in recordings for distance in stated),
        sources=tuple(ranges.source for ranges, _, _ in recordings),
        findings=tuple(findings),
        warnings=(f"{few} pairs of an arrangement have less than 5 ranges and are left out",) if few else (),
        antenna_delays=whole.antenna_delays,
    )


def _load(data: Data) -> tuple[Ranges, list[Arrangement], list[KnownDistance]]:
    if isinstance(data, Ranges):
        ranges, marked, stated = data, [], []
    else:
        with opened(data) as (name, source):
            exchanges = single_reports(source.exchanges).exchanges
            marked = list(getattr(source, "arrangements", ()))
            stated = list(getattr(source, "known_distances", ()))
            delays = antenna_delays_of(source, name)
        if not len(exchanges):
            raise UnanswerableError(f"{name}: holds no exchanges")
        unknown = np.full(len(exchanges), np.nan)
        ranges = Ranges.from_exchanges(exchanges, unknown, source=name, antenna_delays=delays)
    good = np.isfinite(ranges.raw_m) & (np.abs(ranges.raw_m) < MAX_RANGE_M)
    if not good.any():
        raise UnanswerableError(f"{ranges.source}: none of its {len(ranges)} exchanges has possible stamps")
    return ranges[good], marked, stated


def _arrangements(
    ranges: Ranges, marked: list[Arrangement], knowledge: Knowledge, *, several: bool
) -> list[Arrangement]:
    if knowledge.spans_s:
        start = int(ranges.time_ns.min())
        spans = knowledge.spans_s.items()
        return [Arrangement(name, start + round(a * 1e9), start + round(b * 1e9)) for name, (a, b) in spans]
    if marked:
        return marked
    found = still_stretches(ranges)
    if not found:
        raise UnanswerableError(
            f"{ranges.source}: boards never stand still for 15 s; record while they do, or mark when they did"
        )
    stem = PurePath(ranges.source).stem
    if len(found) == 1:
        return [Arrangement(stem, *found[0])]
    return [Arrangement(f"{stem}-{k}" if several else str(k), *span) for k, span in enumerate(found, start=1)]


def _moved(one: Arrangement, ranges: Ranges) -> list[Contradiction]:
    motion = find_motion(ranges)
    if motion is None:
        return []
    steps = ", ".join(f"{100 * step:+.0f} cm to {tag}" for tag, step in sorted(motion.steps_m.items()))
    after_s = (motion.time_ns - int(ranges.time_ns.min())) * 1e-9
    text = (
        f"{one.name}: board {motion.tag} was moved {after_s:.0f} s after its beginning (ranges changed by {steps}); "
        "record that arrangement again, or end it before"
    )
    return [Contradiction("moved", text)]


def _pairs(ranges: Ranges) -> Pairs:
    return pairs_of(ranges.initiator, ranges.target)


def still_stretches(ranges: Ranges, bin_s: float = 1.0) -> list[tuple[int, int]]:
    """Return the stretches of time, (start, end) each in ns, in which no board was moved.

    A motion is where two pairs' ranges step together (or the only pair's does). Whatever lies within a window of one,
    or between two less than 15 s apart, belongs to none.
    """
    if not len(ranges):
        return []
    begin, bin_ns = int(ranges.time_ns.min()), int(bin_s * 1e9)
    number = _pairs(ranges).number
    bins, at = np.unique((ranges.time_ns - begin) // bin_ns, return_inverse=True)
    median = np.full((number.max() + 1, len(bins)), np.nan)
    key = number * len(bins) + at
    there = np.unique(key)
    median.ravel()[there] = ndimage.median(ranges.raw_m, key, there)
    noise = np.array([_noise(row) for row in median])
    threshold = np.maximum(STEP_M, SIGMAS * noise * np.sqrt(2 / WINDOW_BINS))
    moving = (np.abs(_steps(median)) > threshold[:, None]).sum(axis=0) >= min(2, len(median))
    # An edge that sees a step within its window is not the step itself: only a bin that stands free of all is still.
    still = np.concatenate([[False], ~(moving[:-1] | moving[1:]), [False]]).astype(np.int8)
    first, last = np.flatnonzero(np.diff(still) == 1), np.flatnonzero(np.diff(still) == -1) - 1
    found = zip((begin + bin_ns * bins[first]).tolist(), (begin + bin_ns * (bins[last] + 1)).tolist(), strict=True)
    return [(a, b) for a, b in found if b - a >= MIN_STILL_S * 1e9]


def _steps(median: Floats) -> Floats:
    """Return the step (p, b + 1) of each pair at each edge of bins: median after less median before, NaN at too few."""
    padded = np.pad(median, ((0, 0), (WINDOW_BINS, WINDOW_BINS)), constant_values=np.nan)
    windows = np.ma.masked_invalid(np.lib.stride_tricks.sliding_window_view(padded, WINDOW_BINS, axis=1))
    medians = np.ma.median(windows, axis=2).filled(np.nan)  # type: ignore[no-untyped-call]  # NumPy states none
    return np.asarray(medians[:, WINDOW_BINS:] - medians[:, :-WINDOW_BINS])


def _noise(values: Floats) -> float:
    """Return the spread of values, from differences of neighbours, which steps do not widen."""
    known = values[np.isfinite(values)]
    return robust_spread(np.diff(known), 0.0) / np.sqrt(2) if len(known) > 2 else 0.0


def find_motion(ranges: Ranges, splits: int = 20, fewest: int = 8) -> Motion | None:
    """Return the board that was moved within a stretch that should be still, None where there is none.

    A motion is one of `splits` instants after which two of a board's pairs range otherwise, by more than noise and by
    3 cm: a single pair does so when somebody walks by. The board most of whose pairs change, and most, is named. Either
    side of an instant needs `fewest` ranges.
    """
    pairs, tags = _pairs(ranges), ranges.tags()
    if len(pairs.ends) < 2:
        return None
    here = [pairs.number == k for k in range(len(pairs.ends))]
    series = [(ranges.time_ns[rows], ranges.raw_m[rows]) for rows in here]
    noise = [max(_noise(raw), 0.005) for _, raw in series]
    best: tuple[float, Motion | None] = 0.0, None
    for instant in np.linspace(ranges.time_ns.min(), ranges.time_ns.max(), splits + 2)[1:-1].tolist():
        changed: dict[tuple[int, int], tuple[float, float]] = {}
        for (i, j), (time, raw), own in zip(pairs.ends.tolist(), series, noise, strict=True):
            before, after = raw[time < instant], raw[time >= instant]
            if min(len(before), len(after)) < fewest:
                continue
            step = float(np.median(after) - np.median(before))
            size = abs(step) / (1.25 * own * np.sqrt(1 / len(before) + 1 / len(after)))
            if abs(step) > MOVED_M and size > SIGMAS:
                changed[i, j] = step, min(float(size), 50.0)
        for tag in tags:
            mine = {sum(pair) - tag: found for pair, found in changed.items() if tag in pair}
            total = sum(size for _, size in mine.values())
            if len(mine) >= min(2, len(tags) - 1) and total > best[0]:
                best = total, Motion(tag, int(instant), {other: step for other, (step, _) in mine.items()})
    return best[1]


def pair_means(ranges: Ranges, arrangement: Ints) -> tuple[PairMeans, int]:
    """Return the means of ranges (n,) whose `arrangement` (n,) is a number, or -1 for none; and how many were too few.

    Pairs of fewer than five ranges in an arrangement are left out; the second value counts them. Raises
    `UnanswerableError` where none is left.
    """
    pairs = _pairs(ranges)
    key = np.where(arrangement >= 0, arrangement * len(pairs.ends) + pairs.number, -1)
    keys, counts = np.unique(key[key >= 0], return_counts=True)
    kept = keys[counts >= MIN_RANGES]
    if not len(kept):
        raise UnanswerableError(f"{ranges.source}: no two boards range five times while all stand still")
    rows = np.flatnonzero(np.isin(key, kept))
    rows = rows[np.argsort(ranges.time_ns[rows], kind="stable")]
    group = np.searchsorted(kept, key[rows])
    ends = pairs.ends[kept % len(pairs.ends)]
    own = ranges[rows]
    location, std, noise = _locations(own, group, ends)
    from_first = own.initiator == ends[group, 0]
    weights = np.column_stack([own.weight_initiator, own.weight_target])
    weights = np.where(from_first[:, None], weights, weights[:, ::-1])
    lifted = lifted_power(own.fpp1_dbm, own.fpp2_dbm, LIFT, ALPHA_DBM)
    powered = np.isfinite(lifted)
    count = np.bincount(group)
    with np.errstate(invalid="ignore"):
        power = np.bincount(group, np.where(powered, lifted, 0.0)) / np.bincount(group, powered)
    means = PairMeans(
        arrangement=kept // len(pairs.ends),
        ends=ends,
        weights=np.column_stack([np.bincount(group, weight) / count for weight in weights.T]),
        range_m=location,
        std_m=std,
        noise_m=noise,
        count=count,
        lifted=power,
    )
    return means, len(keys) - len(kept)


def _locations(ranges: Ranges, group: Ints, ends: Ints) -> tuple[Floats, Floats, Floats]:
    """Return the location of the direct ranges of each group (g,), how well it is known, and the noise of a range.

    Ranges are in order of time. Slopes of the likelihood are summed over parts of each group's ranges, too: errors that
    last show in these sums.
    """
    median = ndimage.median(ranges.raw_m, group, np.arange(len(ends)))
    model = RangeModel.of(ranges, lift=LIFT, alpha_dbm=ALPHA_DBM, fixed_ns={}, groups={}, curve=False, offsets=False)
    model = replace(model, noise=None, pairs=Pairs(group, ends))
    residual = ranges.raw_m - median[group]
    errors, unknowns, parts = model.error_model(residual)
    names = tuple(f"{i}-{j}" for i, j in ends.tolist())
    mean = Unknown(kind="mean", names=names, start=np.zeros(len(ends)), priors=(Prior.of_deviation(1.0),))
    part = Part(parameter=RESIDUAL, kind="mean", columns=group[:, None], values=np.full((len(group), 1), -1.0))
    layout, rows = model.build(residual, errors, (mean, *unknowns), (part, *parts), only=())
    found = maximize([rows], Priors(layout), layout.start())
    values = rows.values(found.x)
    slope = errors.slopes(values)[1][RESIDUAL]
    count = np.bincount(group)
    order = np.argsort(group, kind="stable")
    number = np.concatenate([np.arange(n) * PARTS // n for n in count.tolist()])
    sums = np.bincount(group[order] * PARTS + number, slope[order], len(ends) * PARTS).reshape(-1, PARTS)
    # What a range tells of its mean, as a share of what it would with noise alone, is the same for all.
    inverse = np.exp(-2 * values["noise"])
    told = np.bincount(group, inverse) * float(np.sum(slope**2) / np.sum(inverse))
    of_parts = np.where(count >= 4 * PARTS, np.var(sums, axis=1, ddof=1) * PARTS, 0.0)
    std = np.maximum(1 / np.sqrt(told), np.sqrt(of_parts) / told)
    noise = np.exp(np.bincount(group, values["noise"]) / count)
    return median + found.of("mean"), std, noise
