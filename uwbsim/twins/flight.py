"""The columns of a recording to which a twin is fitted and compared, their statistics, and the schedule.

Lives of reflections and fading are time constants of autocovariances within pairs, without a model of their causes.
The schedule is who ranged when, how soon boards replied, and which exchanges were lost.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from uwblink.arrays import Bools, Floats, Ints
from uwblink.protocols.table import PROTOCOLS, RangingProtocol
from uwblink.recording.contents import Contents
from uwblink.recording.distances import antennas_m
from uwblink.recording.file import Recording
from uwblink.recording.schema import Fault, Poses, Tag
from uwblink.ticks import ANTENNA_DELAY_TICKS, TICK_S, UUS_TICKS
from uwblink.twr import Exchanges, intervals, without_stamps
from uwbsim.errors import ScenarioError, UnanswerableError
from uwbsim.random_streams import stream
from uwbsim.simulation.run import Simulated

if TYPE_CHECKING:
    from uwbsim.twins.range_errors import KnownDevices


def lasting(time_s: Floats, pair: Ints, value: Floats, span_s: float) -> tuple[float, float | None]:
    """Return variance and time constant in seconds of the persistent part of values (n,), about the means of pairs.

    An exponential is fitted to the autocovariance over all pairs. Subtracting means over a flight of finite length
    (`span_s`) lowers the autocovariance at every lag, which the fit takes into account. The time constant is None, and
    the variance 0, where the lags do not determine them.
    """
    centred = value - (np.bincount(pair, value) / np.maximum(np.bincount(pair), 1))[pair]
    variance = float(np.mean(centred**2))
    lag_s, covariance, count = _autocovariance(time_s, pair, centred, span_s)
    if len(lag_s) < 3 or variance <= 0:
        return 0.0, None
    error = variance / np.sqrt(count)
    if np.max(covariance / error) < 4:  # standard errors
        return 0.0, None

    def misfit(at: Floats) -> Floats:
        life = np.exp(at[1])
        # The share of a variance that the mean over a span has, where the autocovariance is exponential.
        ratio = life / span_s
        taken = 2 * ratio * (1 - ratio * (1 - np.exp(-1 / ratio)))
        return np.asarray((np.exp(at[0]) * (np.exp(-lag_s / life) - taken) - covariance) / error)

    peak = max(covariance.max(), 1e-3 * variance)
    low, high = np.log([1e-4 * variance, lag_s[0] / 20]), np.log([4 * variance, span_s / 2])
    starts = [np.clip(np.log([peak, life]), low + 1e-6, high - 1e-6) for life in np.geomspace(lag_s[0], span_s / 8, 4)]
    tries = [least_squares(misfit, start, bounds=(low, high)) for start in starts]
    found, life = np.exp(min(tries, key=lambda one: float(one.cost)).x)
    if life < lag_s[0] / 3 or found > 1.5 * variance:
        return 0.0, None
    return float(found), float(life)


def _autocovariance(time_s: Floats, pair: Ints, centred: Floats, span_s: float) -> tuple[Floats, Floats, Ints]:
    """Return mean products of values of a pair that lie some time apart: lags in seconds, covariances, counts.

    Lags reach a quarter of the span: longer ones have few independent products.
    """
    lags, products = [], []
    for key in np.unique(pair):
        rows = np.flatnonzero(pair == key)
        if len(rows) < 8:
            continue
        time, values = time_s[rows], centred[rows]
        # Products lie 1, 2, ... values of the pair apart, denser where they are few; 4 million of them are enough.
        most = int(np.clip(4_000_000 // len(centred), 12, 80))
        steps = np.rint(np.geomspace(1, max(len(rows) // 4, 2), most)).astype(np.int64)
        for step in np.unique(steps).tolist():
            apart = time[step:] - time[:-step]
            if apart.min() > span_s / 4:
                break
            lags.append(apart)
            products.append(values[step:] * values[:-step])
    lag, product = (np.concatenate(parts) if parts else np.zeros(0) for parts in (lags, products))
    near = (lag >= 1e-3) & (lag <= span_s / 4)
    lag, product = lag[near], product[near]
    if not len(lag):
        return lag, product, np.zeros(0, dtype=np.int64)
    bins = 24
    which = np.digitize(lag, np.geomspace(lag.min() * 0.999, lag.max() * 1.001, bins + 1)) - 1
    count, total, where = (np.bincount(which, v, minlength=bins)[:bins] for v in (None, product, lag))
    some = count > 20
    return where[some] / count[some], total[some] / count[some], count[some]


def effective_size(value: Floats, group: Ints) -> float:
    """Return the effective number of independent values among n values, in order of time within groups.

    n / (1 + 2 sum of autocorrelations), about the mean of all so that groups which differ count as less; the sum ends
    before the first pair of lags whose sum is not positive (Geyer, Statistical Science 7, 1992).
    """
    count, centred = len(value), value - value.mean()
    variance = float(np.mean(centred**2))
    if count < 4 or variance <= 0:
        return float(count)
    order = np.argsort(group, kind="stable")
    sorted_value, sorted_group = centred[order], group[order]
    total, before, longest = 1.0, 0.0, int(np.bincount(np.unique(group, return_inverse=True)[1]).max())
    for step in range(1, min(longest, 3000)):
        same = sorted_group[step:] == sorted_group[:-step]
        if np.count_nonzero(same) < 2:
            break
        correlation = float(np.sum(sorted_value[step:][same] * sorted_value[:-step][same])) / (variance * count)
        if step % 2 == 0 and before + correlation <= 0:
            break
        total, before = total + 2 * correlation, correlation
    return float(np.clip(count / max(total, 1e-9), 2.0, count))


def some_rows(count: int, most: int) -> Ints:
    """Return `most` of `count` rows, chosen at random, in order: every k-th would leave out pairs that take turns."""
    if count <= most:
        return np.arange(count)
    return np.sort(stream(0, "some rows", count).choice(count, most, replace=False))


def bulk_spread(value: Floats) -> float:
    """Return half the distance of the quantiles at 16 and 84 %: a standard deviation robust to outliers."""
    low, high = np.quantile(value, [0.16, 0.84])
    return float(high - low) / 2


def lag_one(value: Floats, group: Ints) -> tuple[float, float]:
    """Return the autocorrelation r of values (n,) to the next of their group, about the mean of all, and its error.

    The standard error is that of the mean of x_k x_{k+1} - r x_k^2 over the variance, whose terms persist, too. NaN
    where fewer than eight values have a next one.
    """
    order = np.argsort(group, kind="stable")
    centred, sorted_group = (value - value.mean())[order], group[order]
    rows = np.flatnonzero(sorted_group[1:] == sorted_group[:-1])
    variance = float(np.mean(centred**2))
    if len(rows) < 8 or variance <= 0:
        return float("nan"), float("nan")
    product = centred[rows] * centred[rows + 1] / variance
    r = float(np.mean(product))
    term = product - r * centred[rows] ** 2 / variance
    return r, float(np.std(term) / np.sqrt(effective_size(term, sorted_group[rows])))


RecordingSource = str | os.PathLike[str] | Contents | Simulated
"""A recording: its file (.uwb), or its contents in memory."""


def read_flight(source: RecordingSource) -> tuple[Contents | Simulated, str]:
    """Return the contents of a recording and its name in messages; raises what `Recording.open` raises."""
    if not isinstance(source, str | os.PathLike):
        if not all(hasattr(source, name) for name in ("exchanges", "tags", "poses", "faults")):
            raise ScenarioError(f"recording: found {source!r:.60}, expected a file (.uwb) or its contents")
        return source, "recording"
    with Recording.open(Path(source)) as file:
        held = Contents(exchanges=file.exchanges(), tags=file.tags(), poses=file.poses(), faults=file.faults())
        return held, str(source)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """Exchanges of one protocol between tags whose places are known, as columns of length n in order of time.

    `time_s` counts from `origin_ns`; `ends` are places in `tags` of initiator and target, (2, n), `pair` the places of
    both in `pairs`, whichever began; `towards` are unit vectors to the other end in the frames of the two bodies,
    (2, n, 3). `residual_m` is calibrated range less distance; `ratio_ppm` by how much the initiator's clock is faster
    than the target's as dt64/dt53 says, NaN where the protocol has no third message. `where` is the recording's file.
    """

    where: str
    tags: tuple[Tag, ...]
    row: RangingProtocol
    exchanges: Exchanges
    origin_ns: int
    time_s: Floats
    ends: Ints
    pair: Ints
    pairs: tuple[tuple[int, int], ...]
    distance_m: Floats
    towards: Floats
    residual_m: Floats
    ratio_ppm: Floats

    def __len__(self) -> int:
        """Return the number of exchanges."""
        return len(self.time_s)

    def __getitem__(self, rows: Ints) -> Self:
        """Return the chosen exchanges, in their order; times go on counting from the same instant."""
        return replace(
            self,
            exchanges=self.exchanges[rows],
            time_s=self.time_s[rows],
            ends=self.ends[:, rows],
            pair=self.pair[rows],
            distance_m=self.distance_m[rows],
            towards=self.towards[:, rows],
            residual_m=self.residual_m[rows],
            ratio_ppm=self.ratio_ppm[rows],
        )

    def some(self, most: int) -> Ints:
        """Return rows of `most` exchanges, all where there are no more: blocks all over the flight.

        What comes soon after one another stays together, so that short lags stay.
        """
        if len(self) <= most:
            return np.arange(len(self))
        block = 2000
        begins = np.linspace(0, len(self) - block, most // block).astype(np.int64)
        return np.unique(begins[:, None] + np.arange(block))

    @property
    def interval_s(self) -> float:
        """Return the median interval between the exchanges of a pair, in seconds."""
        order = np.lexsort((self.time_s, self.pair))
        apart = np.diff(self.time_s[order])[np.diff(self.pair[order]) == 0]
        return float(np.median(apart)) if len(apart) else float("inf")

    @property
    def power_dbm(self) -> Floats:
        """First-path powers read at target and initiator, (2, n)."""
        return np.array([self.exchanges.fpp1_dbm, self.exchanges.fpp2_dbm])

    @classmethod
    def of(
        cls, flown: Contents | Simulated, known: KnownDevices, where: str = "recording", *, fewest: int = 100
    ) -> Self:
        """Return the columns of a recording; raises `ScenarioError` where no twin can be fitted.

        That is with less than `fewest` exchanges: of 100, the quantiles of residuals are wrong by a tenth of their
        spread.
        """
        names, counts = np.unique(flown.exchanges.protocol, return_counts=True)
        if not len(names):
            raise UnanswerableError(f"{where}: holds no exchanges; record or import some first")
        row = PROTOCOLS[str(names[np.argmax(counts)])]
        exchanges = flown.exchanges[np.flatnonzero(flown.exchanges.protocol == row.name)]
        if len(exchanges) < fewest:
            raise UnanswerableError(
                f"{where}: holds {len(exchanges)} exchanges, a twin needs {fewest} or more; record longer"
            )
        if not len(flown.poses):
            raise UnanswerableError(f"{where}: holds no poses; add motion capture with `uwblink poses`")
        if not np.any(_powered(exchanges)):
            raise UnanswerableError(f"{where}: no exchange has both first-path powers, and a twin is made from powers")
        ids = set(np.unique([exchanges.initiator, exchanges.target]).tolist())
        lacking = sorted(ids - {tag.tag for tag in flown.tags})
        if lacking:
            raise UnanswerableError(
                f"{where}: does not say on which body tag {', '.join(map(str, lacking))} sits; give tags with "
                "'uwblink poses --tags'"
            )
        tags = tuple(tag for tag in flown.tags if tag.tag in ids)
        known.require([tag.tag for tag in tags])
        exchanges = exchanges[np.argsort(exchanges.time_ns, kind="stable")]
        ends = np.array([exchanges.initiator, exchanges.target], dtype=np.int64)
        spots = np.array([antennas_m(flown.poses, list(tags), end, exchanges.time_ns) for end in ends])
        good = np.isfinite(spots).all(axis=(0, 2)) & _powered(exchanges) & ~without_stamps(exchanges)
        good &= ends[0] != ends[1]
        if np.count_nonzero(good) < fewest:
            raise UnanswerableError(
                f"{where}: {np.count_nonzero(good)} of {len(good)} exchanges have stamps, both powers and poses around "
                f"them, a twin needs {fewest} or more; record longer, and with motion capture all the time"
            )
        exchanges, spots, ends = exchanges[good], spots[:, good], ends[:, good]
        distance = np.linalg.norm(spots[1] - spots[0], axis=1)
        unit = (spots[1] - spots[0]) / np.maximum(distance, 1e-9)[:, None]
        names, pair = np.unique(np.sort(ends, axis=0), axis=1, return_inverse=True)
        places = np.array([tag.tag for tag in tags])
        order = np.argsort(places)
        ends = order[np.searchsorted(places[order], ends)]
        towards = [
            _into_body(flown.poses, tags, end, exchanges.time_ns, way)
            for end, way in zip(ends, (unit, -unit), strict=True)
        ]
        return cls(
            where=where,
            tags=tags,
            row=row,
            exchanges=exchanges,
            origin_ns=int(exchanges.time_ns[0]),
            time_s=np.asarray((exchanges.time_ns - exchanges.time_ns[0]) * 1e-9, dtype=np.float64),
            ends=ends,
            pair=pair.ravel(),
            pairs=tuple((int(a), int(b)) for a, b in names.T),
            distance_m=distance,
            towards=np.array(towards),
            residual_m=known.corrected_m(exchanges) - distance,
            ratio_ppm=_ratio_ppm(exchanges, row),
        )


def _powered(exchanges: Exchanges) -> Bools:
    powers = np.array([exchanges.fpp1_dbm, exchanges.fpp2_dbm])
    return np.asarray(np.all(np.isfinite(powers) & (powers < 0), axis=0))


def _into_body(poses: Poses, tags: Sequence[Tag], end: Ints, time_ns: Ints, way: Floats) -> Floats:
    """Return vectors (n, 3) of the world in the frames of the bodies that carry tags at places `end` (n,)."""
    turned = way.copy()
    for body in sorted({tag.body for tag in tags}):
        mine = [k for k, tag in enumerate(tags) if tag.body == body]
        rows = np.flatnonzero(np.isin(end, mine))
        if len(rows):
            turned[rows] = attitude(poses, body, time_ns[rows]).apply(way[rows], inverse=True)
    return turned


def attitude(poses: Poses, body: str, time_ns: Ints) -> Rotation:
    """Return the attitudes of a body at times (n,), held beyond its poses."""
    mine = np.flatnonzero(poses.body == body)
    times, first = np.unique(poses.time_ns[mine], return_index=True)
    turns = Rotation.from_quat(poses.quaternion[mine][first])
    if len(times) == 1:
        return turns[np.zeros(len(time_ns), dtype=np.int64)]
    at = np.clip(time_ns, times[0], times[-1]) - times[0]
    return Slerp((times - times[0]) * 1e-9, turns)(at * 1e-9)


def _ratio_ppm(exchanges: Exchanges, row: RangingProtocol) -> Floats:
    if len(row.messages) < 3 or row.third_sender != "target":
        return np.full(len(exchanges), np.nan)
    spans = intervals(exchanges)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((spans.dt64 / spans.dt53 - 1) * 1e6)


SHORTEST_LIFE_S: Final = 0.01
"""The shortest `life_s` of paths, fading and outages in a scenario."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduleFit:
    """When exchanges began, of whom, and which were lost: columns (slots,) in order of time, tags by their places.

    `rate_hz` counts all; `regular` says whether they went round robin, and `turns` in which order. `delay_uus` is the
    scheduled delay, `replies_us` quantiles of replies at once; None where the protocol has none.
    """

    time_s: Floats
    initiator: Ints
    target: Ints
    lost: Bools
    regular: bool
    turns: tuple[tuple[int, int], ...]
    rate_hz: float
    delay_uus: int | None
    replies_us: tuple[float, ...] | None

    @property
    def lost_share(self) -> float:
        """Return the share of exchanges that were lost."""
        return float(np.mean(self.lost))

    def outage_life_s(self) -> float:
        """Return the mean duration of a pair's outages, from the autocorrelation of its losses."""
        pair = np.minimum(self.initiator, self.target) * 1000 + np.maximum(self.initiator, self.target)
        again, _ = lag_one(self.lost.astype(np.float64), pair)
        if not again > 0.02:
            return SHORTEST_LIFE_S
        order = np.argsort(pair, kind="stable")
        same = pair[order][1:] == pair[order][:-1]
        apart = float(np.median(np.diff(self.time_s[order])[same]))
        return max(-apart / float(np.log(min(again, 0.98))), SHORTEST_LIFE_S)


def fit_schedule(flight: Flight, faults: list[Fault]) -> ScheduleFit:
    """Return the schedule of a flight, with the exchanges that failed meanwhile."""
    time, first, second, lost = _slots(flight, faults)
    turns, rate = _turns(first, second), (len(time) - 1) / max(float(time[-1]), 1e-3)
    beat = _beat(time, first, second, turns) if turns else None
    if beat:
        # Slots of a round robin that left nothing at all are lost, too.
        rate, slot = 1 / beat, np.rint(time / beat).astype(np.int64)
        every = np.arange(slot[-1] + 1)
        time, lost = every * beat, ~np.isin(every, slot[~lost])
        first, second = np.array(turns)[every % len(turns)].T
    else:
        turns = sorted(set(zip(first.tolist(), second.tolist(), strict=True)))
    return ScheduleFit(
        time_s=time,
        initiator=first,
        target=second,
        lost=lost,
        regular=beat is not None,
        turns=tuple(turns),
        rate_hz=rate,
        delay_uus=_scheduled_uus(flight),
        replies_us=_replies_us(flight),
    )


def _slots(flight: Flight, faults: list[Fault]) -> tuple[Floats, Ints, Ints, Bools]:
    place = {tag.tag: k for k, tag in enumerate(flight.tags)}
    end_ns = int(flight.exchanges.time_ns[-1])
    failed = [
        ((fault.time_ns - flight.origin_ns) * 1e-9, place[fault.initiator], place[fault.target])
        for fault in faults
        if flight.origin_ns <= fault.time_ns <= end_ns and fault.initiator in place and fault.target in place
    ]
    time = np.concatenate([flight.time_s, [row[0] for row in failed]])
    ends = np.concatenate([flight.ends, np.array([row[1:] for row in failed], dtype=np.int64).reshape(-1, 2).T], axis=1)
    lost = np.arange(len(time)) >= len(flight)
    order = np.argsort(time, kind="stable")
    return time[order], ends[0][order], ends[1][order], lost[order]


def _turns(first: Ints, second: Ints) -> list[tuple[int, int]]:
    """Return the order of a round robin, empty where exchanges have none."""
    names = list(zip(first.tolist(), second.tolist(), strict=True))
    followers: dict[tuple[int, int], Counter[tuple[int, int]]] = {}
    for one, other in pairwise(names):
        followers.setdefault(one, Counter())[other] += 1
    turns = [names[0]]
    while len(turns) < len(set(names)):
        after = followers.get(turns[-1], Counter()).most_common(1)
        if not after or after[0][0] in turns:
            return []
        turns.append(after[0][0])
    return turns


def _beat(time: Floats, first: Ints, second: Ints, turns: list[tuple[int, int]]) -> float | None:
    """Return the interval of a round robin in seconds; None unless nine of ten slots keep to it and to their turns."""
    regular_share, number = 0.9, {pair: k for k, pair in enumerate(turns)}
    turn = np.array([number[pair] for pair in zip(first.tolist(), second.tolist(), strict=True)])
    step, apart = np.diff(turn) % len(turns), np.diff(time)
    in_turn = step == 1 % len(turns)
    if not len(apart) or np.mean(in_turn) < regular_share / 2 or np.median(apart[in_turn]) <= 0:
        return None
    beat = float(np.sum(apart) / max(np.sum(np.rint(apart / np.median(apart[in_turn]))), 1))
    slots = np.rint(apart / beat)
    fits = (np.abs(apart / beat - slots) < 0.25) & (slots % len(turns) == step)
    return beat if np.mean(fits) >= regular_share else None


def _scheduled_uus(flight: Flight) -> int | None:
    spans = intervals(flight.exchanges)
    shortest, longest = 280, 6500  # what a scenario takes
    for k, message in enumerate(flight.row.messages[1:], start=1):
        if message.timing == "scheduled":
            ticks = float(np.median(spans.dt32 if k == 1 else spans.dt53))
            # A delay is cut to the grid of transmissions, after which the antenna's comes on top.
            nearest = round((ticks - ANTENNA_DELAY_TICKS) / UUS_TICKS)
            return int(np.clip(nearest, shortest, longest))
    return None


def _replies_us(flight: Flight) -> tuple[float, ...] | None:
    if flight.row.messages[1].timing != "at once":
        return None
    delays = intervals(flight.exchanges).dt32 * TICK_S * 1e6
    levels = np.linspace(0, 1, min(201, len(delays)))
    found = np.clip(np.quantile(delays, levels), 180.0, 6000.0)  # what a scenario takes
    return tuple(round(float(value), 4) for value in np.maximum.accumulate(found))
