"""From recordings to arrangements (marked, named in a file, or found from the ranges) and to a mean of each pair.

While nothing moves, the mean of a pair's ranges has all their information on delays and places. It is the location of
direct ranges in the error model of all ranges (`calib.estimator.range_model`). A mean has the mean power of its ranges,
because power varies only by errors of its measurement while nothing moves.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import PurePath

import numpy as np
from scipy import ndimage, special

from calib.calibration.error_model import ErrorModel
from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.data.ranges import Ranges, concatenate
from calib.data.sources import Data, each, opened, ranges_of, refuse_repeated
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.grouped_errors import SCATTER
from calib.estimator.known_distances import errors_of
from calib.estimator.optimize import LONGER, maximize
from calib.estimator.range_model import RangeModel
from calib.estimator.range_rows import RESIDUAL, block_of
from calib.estimator.time_blocks import time_blocks
from calib.estimator.to_calibration import error_model
from calib.estimator.unknowns import Prior, Priors, Unknown
from calib.findings import Finding, warning
from calib.pairs import Pairs
from calib.settings import FitSettings, refuse
from calib.spread import STD_OF_MEDIAN, medians, robust_spread
from calib.surveys.knowledge import Knowledge
from uwblink.arrays import ColumnTable, Floats, Ints
from uwblink.recording.antenna_delays import AntennaDelays
from uwblink.recording.schema import Arrangement, KnownDistance
from uwblink.ticks import METRES_PER_TICK

LIFT = "mean-of-lifted"
"""How the powers of both ends are combined, as in `calib.fit`."""


PARTS = 10
"""Number of stretches of time whose sums determine the standard error of the mean, also with errors that last: it is
known to a quarter (the root of 1/18); in an arrangement of 30 s they are 3 s long."""

WINDOW_BINS = 5
"""Number of bins of a second before and after an instant whose medians are compared: moving a board takes less time."""


SIGMAS = 6.0
"""Limit of changes in standard deviations of noise: one in 5e8 exceeds it by chance, and there are
thousands of tests."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairMeans(ColumnTable):
    """One row a pair and arrangement (n,): `ends` (n, 2) are its tags, the smaller first, `weights` multiply delays.

    `range_m` is the mean of raw ranges, `std_m` its standard error, `noise_m` the spread of single ranges, `lifted` the
    mean lifted power, NaN without one.
    """

    arrangement: Ints
    ends: Ints
    weights: Floats
    range_m: Floats
    std_m: Floats
    noise_m: Floats
    count: Ints
    lifted: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyData:
    """Means of pairs, the errors of single ranges about them, the arrangements by their numbers, distances in
    recordings, contradictions and limits.
    """

    means: PairMeans
    errors: ErrorModel | None
    arrangements: tuple[Arrangement, ...]
    distances: tuple[KnownDistance, ...]
    sources: tuple[str, ...]
    findings: tuple[Finding, ...]
    limits: tuple[Finding, ...]
    antenna_delays: AntennaDelays


def read_surveys(data: Data | Iterable[Data], knowledge: Knowledge) -> SurveyData:
    """Return the means of pairs of one or more recordings by arrangement.

    Raises `BadInputError` for two arrangements with the same name, `UnanswerableError` if no boards stood still.
    """
    recordings = [_load(one) for one in each(data)]
    if knowledge.spans_s and len(recordings) > 1:
        raise BadInputError("has times of arrangements, which need exactly one recording", parameter="known")
    stems = [PurePath(ranges.source).stem for ranges, *_ in recordings]
    stems = [f"{own} {stems[: k + 1].count(own)}" if stems.count(own) > 1 else own for k, own in enumerate(stems)]
    arrangements, numbers, findings = dict[str, Arrangement](), list[Ints](), list[Finding]()
    for stem, (ranges, marked, _) in zip(stems, recordings, strict=True):
        numbers.append(np.full(len(ranges), -1))
        for one in _arrangements(ranges, marked, knowledge, stem, several=len(recordings) > 1):
            if one.name in arrangements:
                text = f"two arrangements have the name {one.name!r:.40}; give each its own name"
                raise BadInputError(text, parameter="data")
            rows = (ranges.time_ns >= one.start_ns) & (ranges.time_ns < one.end_ns)
            numbers[-1][rows] = len(arrangements)
            findings += find_motion(one.name, ranges[rows])
            arrangements[one.name] = one
    whole = concatenate([ranges for ranges, _, _ in recordings])
    refuse_repeated(whole.recordings)
    means, errors, few = pair_means(whole, np.concatenate(numbers))
    text = f"{few} pairs of an arrangement have less than 5 ranges and are left out"
    return SurveyData(
        means=means,
        errors=errors,
        arrangements=tuple(arrangements.values()),
        distances=tuple(distance for _, _, stated in recordings for distance in stated),
        sources=tuple(ranges.source for ranges, _, _ in recordings),
        findings=tuple(findings),
        limits=(warning("few ranges of a pair", text),) if few else (),
        antenna_delays=whole.antenna_delays,
    )


def _load(data: Data) -> tuple[Ranges, list[Arrangement], list[KnownDistance]]:
    """Return the possible ranges of a recording, without true distances, and its other contents."""
    if isinstance(data, Ranges):
        # Parts of one recording have the same fingerprint.
        return replace(data, recordings=()).usable(need_power=False, need_truth=False), [], []
    with opened(data) as (name, source):
        ranges = ranges_of(source, name, truth=False)[1].usable(need_power=False, need_truth=False)
        marked, stated = getattr(source, "arrangements", ()), getattr(source, "known_distances", ())
        return ranges, list(marked), list(stated)


def _arrangements(
    ranges: Ranges, marked: list[Arrangement], knowledge: Knowledge, stem: str, *, several: bool
) -> list[Arrangement]:
    if knowledge.spans_s:
        start = int(ranges.time_ns.min())
        spans = knowledge.spans_s.items()
        refuse(
            ("known", not np.isfinite(span).all(), f"{name}: found {span}, expected its start and end in seconds")
            for name, span in spans
        )
        return [Arrangement(name, start + round(a * 1e9), start + round(b * 1e9)) for name, (a, b) in spans]
    if marked:
        return marked
    found = still_stretches(ranges)
    if not found:
        raise UnanswerableError(
            f"{ranges.source}: boards never stand still for 15 s; record boards that stand still, or give the times "
            f"of arrangements"
        )
    if len(found) == 1:
        return [Arrangement(stem, *found[0])]
    return [Arrangement(f"{stem}-{k}" if several else str(k), *span) for k, span in enumerate(found, start=1)]


def _binned(ranges: Ranges, bin_ns: int) -> tuple[Ints, Ints, Floats, Floats]:
    """Return the pairs of tags (p, 2), the starts of bins of time (b,) in ns, medians (p, b) of their ranges in each
    (NaN without any), and the noise of these medians (p,), without the effect of steps."""
    pairs, begin = ranges.pairs, int(ranges.time_ns.min())
    bins, at = np.unique((ranges.time_ns - begin) // bin_ns, return_inverse=True)
    median = np.full((len(pairs.ends), len(bins)), np.nan)
    key = pairs.number * len(bins) + at
    there = np.unique(key)
    median.ravel()[there] = ndimage.median(ranges.raw_m, key, there)
    changes = [np.diff(row[np.isfinite(row)]) for row in median]
    noise = [robust_spread(one, 0.0) / np.sqrt(2) if len(one) > 1 else 0.0 for one in changes]
    return pairs.ends, begin + bin_ns * bins, median, np.array(noise)


def _steps(median: Floats, window: int) -> Floats:
    """Return the step (p, b + 1) of each pair at each edge of bins: the median of the bins after minus the
    bins before.
    """
    padded = np.pad(median, ((0, 0), (window, window)), constant_values=np.nan)
    windows = np.ma.masked_invalid(np.lib.stride_tricks.sliding_window_view(padded, window, axis=1))
    found = np.ma.median(windows, axis=2).filled(np.nan)  # type: ignore[no-untyped-call]  # NumPy states none
    return np.asarray(found[:, window:] - found[:, :-window])


def still_stretches(ranges: Ranges) -> list[tuple[int, int]]:
    """Return the stretches of time, (start, end) each in ns, in which no board was moved.

    A motion is a simultaneous step of the ranges of two pairs (or of the only pair). Times within a window of a motion,
    or between two motions less than 15 s apart, belong to no stretch.
    """
    second_ns = 1_000_000_000
    _, starts, median, noise = _binned(ranges, second_ns)
    # People who walk past change ranges by less than 5 cm, or only the ranges of one pair.
    threshold = np.maximum(0.05, SIGMAS * noise * np.sqrt(2 / WINDOW_BINS))
    moving = (np.abs(_steps(median, WINDOW_BINS)) > threshold[:, None]).sum(axis=0) >= min(2, len(median))
    # An edge with a step in its window is not the step itself: only bins outside all such windows are still.
    still = np.concatenate([[False], ~(moving[:-1] | moving[1:]), [False]]).astype(np.int8)
    first, last = np.flatnonzero(np.diff(still) == 1), np.flatnonzero(np.diff(still) == -1) - 1
    found = zip(starts[first].tolist(), (starts[last] + second_ns).tolist(), strict=True)
    # Shorter stretches between two motions are part of the motion.
    return [(a, b) for a, b in found if b - a >= 15e9]


def find_motion(name: str, ranges: Ranges) -> list[Finding]:
    """Return the board that was moved during an arrangement, if there is one.

    A motion is an instant after which the ranges of two of a board's pairs differ, by more than noise and by 3 cm; a
    person who walks by changes a single pair. The board with the most changed pairs, and the largest changes, is named.
    """
    if len(ranges.tags()) < 3:
        return []
    begin = int(ranges.time_ns.min())
    # An arrangement is divided into sixty bins, of which either side needs eight.
    ends, starts, median, noise = _binned(ranges, int(np.ptp(ranges.time_ns)) // 60 + 1)
    step = _steps(median, len(starts))[:, 1:-1]
    before = np.cumsum(np.isfinite(median), axis=1)[:, :-1]
    after = np.isfinite(median).sum(axis=1, keepdims=True) - before
    sides = np.minimum(before, after) >= 8
    with np.errstate(divide="ignore", invalid="ignore"):
        std = STD_OF_MEDIAN * np.maximum(noise, METRES_PER_TICK)[:, None] * np.sqrt(1 / before + 1 / after)
        size = np.where(sides, np.abs(step) / std, 0.0)
    changed = (size > SIGMAS) & (np.abs(step) > 0.03)
    member = (ends[:, :, None] == np.array(ranges.tags())).any(axis=1).T.astype(float)
    total = (member @ np.where(changed, np.minimum(size, 50.0), 0.0)) * (member @ changed >= 2)
    if not total.any():
        return []
    board, edge = np.unravel_index(int(np.argmax(total)), total.shape)
    tag = ranges.tags()[board]
    mine = changed[:, edge] & (member[board] > 0)
    by_m = float(np.abs(step[mine, edge]).max())
    # Medians of short spans determine the time better than medians of long ones.
    at, edge = edge, np.argmax(np.nan_to_num(np.abs(_steps(median, WINDOW_BINS)[mine, 1:-1])).sum(axis=0))
    text = (
        f"{name}: board {tag} was moved {(starts[edge + 1] - begin) * 1e-9:.0f} s after the start (ranges changed by "
        f"up to {100 * by_m:.0f} cm)"
    )
    # At least two pairs changed at one of all edges.
    second = float(np.sort(size[mine, at])[-2])
    p_value = min(1.0, 2 * size.size * float(special.ndtr(-second)))
    return [warning("board moved within an arrangement", text, p_value)]


def pair_means(ranges: Ranges, arrangement: Ints) -> tuple[PairMeans, ErrorModel | None, int]:
    """Return the means of ranges (n,) whose `arrangement` (n,) is a number, or -1 for none; the errors of ranges about
    them; and the number of pairs with too few ranges.

    Pairs of fewer than five ranges in an arrangement are left out; the last value counts them. Raises
    `UnanswerableError` where none is left.
    """
    pairs = ranges.pairs
    key = arrangement * len(pairs.ends) + pairs.number
    keys, counts = np.unique(key[arrangement >= 0], return_counts=True)
    # With five ranges the spread is known to a third (the root of 1/8).
    kept = keys[counts >= 5]
    if not len(kept):
        raise UnanswerableError(f"{ranges.source}: no pair of boards has five ranges while all stand still")
    rows = np.flatnonzero(np.isin(key, kept))
    rows = rows[np.lexsort((ranges.time_ns[rows], key[rows]))]
    own, group = ranges[rows], np.searchsorted(kept, key[rows])
    ends, count = pairs.ends[kept % len(pairs.ends)], np.bincount(group)
    range_m, std_m, noise_m, errors = _locations(own, Pairs(group, ends))
    forward = own.initiator == ends[group, 0]
    weights = [
        np.bincount(group, np.where(forward == lower, own.weight_initiator, own.weight_target)) / count
        for lower in (True, False)
    ]
    lifted = lifted_power(own.fpp1_dbm, own.fpp2_dbm, LIFT, ALPHA_DBM)
    with np.errstate(invalid="ignore"):
        power = np.bincount(group, np.nan_to_num(lifted)) / np.bincount(group, np.isfinite(lifted))
    means = PairMeans(
        arrangement=kept // len(pairs.ends),
        ends=ends,
        weights=np.column_stack(weights),
        range_m=range_m,
        std_m=std_m,
        noise_m=noise_m,
        count=count,
        lifted=power,
    )
    return means, errors, len(keys) - len(kept)


def _locations(ranges: Ranges, groups: Pairs) -> tuple[Floats, Floats, Floats, ErrorModel | None]:
    """Return the location of the direct ranges of each group (g,), its standard error, the noise of a range, and the
    errors of ranges of any group, None for errors without spread.

    Ranges are in order of group and time. Slopes of the likelihood are summed over parts of each group's ranges, too:
    errors that last show in these sums.
    """
    group, count = groups.number, np.bincount(groups.number)
    median = medians(ranges.raw_m, group)
    model = RangeModel.of(ranges, FitSettings(delays_only=True), offsets=())
    model = replace(model, noise=None, pairs=groups)
    residual = ranges.raw_m - median[group]
    errors, unknowns, parts = model.error_model(residual)
    names, prior = ("",) * len(median), Prior.of_deviation(1.0)
    mean, part = block_of(
        Unknown(kind="mean", names=names, start=np.zeros(len(median)), priors=(prior,)),
        group[:, None],
        np.full((len(group), 1), -1.0),
    )
    layout, rows = model.build(residual, errors, (mean, *unknowns), (part, *parts), only=())
    # The likelihood has several maxima: with a moved board, shorter steps ended at one that was lower by 140.
    searches = (maximize([rows], Priors(layout), layout.start(), longer=longer) for longer in (LONGER, 2 * LONGER))
    found = max(searches, key=lambda one: one.value)
    values = rows.values(found.x)
    slope = errors.slopes(values)[1][RESIDUAL]
    number = np.concatenate([np.arange(n) * PARTS // n for n in count.tolist()])
    sums = np.bincount(group * PARTS + number, slope, len(count) * PARTS).reshape(-1, PARTS)
    # The ratio of a range's information on its mean to the information with noise alone is the same for all.
    inverse = np.exp(-2 * values["noise"])
    information = np.bincount(group, inverse) * float(np.sum(slope**2) / np.sum(inverse))
    lasting = np.where(count >= 4 * PARTS, np.var(sums, axis=1, ddof=1) * PARTS, 0.0)
    std = np.sqrt(np.maximum(1 / information, lasting / information**2))
    stated = _errors_of_any_pair(model, rows.residuals(found.x)) if robust_spread(residual) > 1e-6 else None
    return median + found.of("mean"), std, np.exp(np.bincount(group, values["noise"]) / count), stated


def _errors_of_any_pair(model: RangeModel, residual: Floats) -> ErrorModel:
    """Return the error model of residuals (n,) in metres, with the same values for all pairs and powers.

    A pair in an arrangement has its own reflections, which do not predict those at other places.
    """
    order = np.lexsort((model.ranges.time_ns, model.ranges.session))
    ranges, own = model.ranges[order], residual[order]
    one = Pairs(np.zeros(len(own), dtype=np.int32), ranges.pairs.ends[:1])
    model = replace(model, ranges=ranges, lifted=model.lifted[order], powered=model.powered[order], pairs=one)
    found = errors_of(model, own)
    # All ranges are fitted as one pair, so its factors are a part of the common values.
    alike = {f"{name} of pair": np.zeros(1) for name in SCATTER}
    common = {f"{name} level": found.values[f"{name} level"] + found.values[f"{name} of pair"] for name in SCATTER}
    found = replace(found, values={**found.values, **common, **alike})
    stated = error_model(model, own, found, time_blocks(ranges.time_ns, ranges.session))
    return replace(stated, pairs={})
