"""The data of a recording to which a twin is fitted, their statistics, and the schedule of its exchanges.

Durations of reflections and fading are time constants of autocovariances within pairs, without a model of their causes.
The schedule contains the times and pairs of exchanges, reply times, and lost exchanges.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from uwblink.arrays import Floats, Ints
from uwblink.protocols.table import PROTOCOLS, RangingProtocol
from uwblink.recording.contents import Contents
from uwblink.recording.distances import sights
from uwblink.recording.file import Recording
from uwblink.recording.schema import Fault, Poses, Tag
from uwblink.ticks import ANTENNA_DELAY_TICKS, TICK_S, UUS_TICKS
from uwblink.twr import Exchanges, intervals, without_stamps
from uwbsim.errors import ScenarioError, TooFewDataError
from uwbsim.random_streams import stream
from uwbsim.scenario.ranging import FINAL_BYTES, TURNAROUND_S, frame_s

if TYPE_CHECKING:
    from uwbsim.twins.range_errors import KnownDevices


def lasting(time_s: Floats, pair: Ints, value: Floats) -> tuple[float, float | None]:
    """Return variance and time constant in seconds of the persistent part of values (n,), about the means of pairs.

    An exponential is fitted to the autocovariance over all pairs. Subtracting means over a flight of finite length
    lowers the autocovariance at all lags; the fit includes this effect. If the data do not determine the time constant,
    it is None and the variance is 0.
    """
    centred = value - (np.bincount(pair, value) / np.maximum(np.bincount(pair), 1))[pair]
    variance, span_s = float(np.mean(centred**2)), float(time_s[-1] - time_s[0])
    lag_s, covariance, count = _autocovariance(time_s, pair, centred, span_s)
    if len(lag_s) < 3 or variance <= 0:
        return 0.0, None
    error = variance / np.sqrt(count)
    # A grid of time constants; each has its variance by weighted least squares.
    life = np.geomspace(lag_s[0] / 20, span_s / 2, 400)[:, None]
    # Variance of the mean over the span T of a process with the autocovariance exp(-lag / life): with r = life / T,
    # 2 r (1 - r (1 - exp(-1 / r))).
    ratio = life / span_s
    of_mean = 2 * ratio * (1 - ratio * (1 - np.exp(-1 / ratio)))
    shape, scaled = (np.exp(-lag_s / life) - of_mean) / error, covariance / error
    found = np.maximum(shape @ scaled / np.sum(shape**2, axis=1), 0.0)
    best = int(np.argmin(np.sum((found[:, None] * shape - scaled) ** 2, axis=1)))
    # Undetermined: no lag with four standard errors, a time constant below the lags, or a variance above the measured.
    unclear = np.max(scaled) < 4 or life[best] < lag_s[0] / 3 or found[best] > 1.5 * variance
    return (0.0, None) if unclear else (float(found[best]), float(life[best, 0]))


def _autocovariance(time_s: Floats, pair: Ints, centred: Floats, span_s: float) -> tuple[Floats, Floats, Floats]:
    """Return the autocovariance of values within pairs, in bins of the lag: lags in seconds, covariances, counts.

    Lags are at most a quarter of the span, because longer lags have few independent products.
    """
    order = np.lexsort((time_s, pair))
    time, values, group = time_s[order], centred[order], pair[order]
    longest = int(np.bincount(pair).max()) // 4
    lags, products = [np.zeros(0)], [np.zeros(0)]
    # Distances in numbers of values of a pair, in geometric steps from 1.
    for step in np.unique(np.geomspace(1, max(longest, 2), 40).astype(np.int64)).tolist():
        apart = time[step:] - time[:-step]
        near = (group[step:] == group[:-step]) & (apart >= 1e-3) & (apart <= span_s / 4)
        lags.append(apart[near])
        products.append((values[step:] * values[:-step])[near])
    lag, product = np.concatenate(lags), np.concatenate(products)
    if not len(lag):
        return lag, lag, lag
    edges = np.geomspace(lag.min() * 0.999, lag.max() * 1.001, 25)
    count = np.histogram(lag, edges)[0]
    some = count > 20
    lag_s, covariance = (np.histogram(lag, edges, weights=v)[0][some] / count[some] for v in (lag, product))
    return lag_s, covariance, count[some]


def effective_size(value: Floats, group: Ints) -> float:
    """Return the effective number of independent values among values (n,), in order of time within groups (n,).

    It is n / (1 + 2 sum of autocorrelations), about the mean of all values, so that differences between groups reduce
    it. The sum ends before the first pair of successive lags whose sum is not positive (Geyer, Statistical Science 7,
    1992).
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
    """Return at most `most` of `count` rows, a random choice in ascending order.

    Every k-th row could leave out pairs that range in turns.
    """
    chosen = range(count) if count <= most else stream(0, "some rows", count).choice(count, most, replace=False)
    return np.sort(chosen)


def bulk_spread(value: Floats) -> float:
    """Return half of the difference of the 84 % and 16 % quantiles, a standard deviation robust to outliers."""
    low, high = np.quantile(value, [0.16, 0.84])
    return float(high - low) / 2


def lag_one(value: Floats, group: Ints) -> tuple[float, float]:
    """Return the autocorrelation r of successive values (n,) within groups, about the mean of all, and its std. error.

    The standard error is that of the mean of (x_k x_{k+1} - r x_k^2) / variance, with the effective number of these
    terms. Both are NaN with fewer than eight pairs of successive values.
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


RecordingSource = str | os.PathLike[str] | Contents
"""A recording: its file (.uwb), or its contents in memory."""


def read_flight(source: RecordingSource) -> tuple[Contents, str]:
    """Return the contents of a recording, and its name for messages.

    Raises the errors of `Recording.open`, and `ScenarioError` for an object that is not the contents of a recording.
    """
    if not isinstance(source, str | os.PathLike):
        if not all(hasattr(source, name) for name in ("exchanges", "tags", "poses", "faults")):
            raise ScenarioError(f"recording: found {source!r:.60}, expected a file (.uwb) or its contents")
        return source, "recording"
    with Recording.open(Path(source)) as file:
        contents = Contents(exchanges=file.exchanges(), tags=file.tags(), poses=file.poses(), faults=file.faults())
        return contents, str(source)


@dataclass(frozen=True, slots=True, kw_only=True)
class TwinFlight:
    """Exchanges of one protocol between tags with known positions, as columns of length n in order of time.

    `time_s` counts from `origin_ns`; `ends` (2, n) are the indices in `tags` of initiator and target, `pair` (n,) is
    the index in `pairs`, for both directions; `towards` (2, n, 3) are unit vectors to the other end in the frames of
    the two bodies. `residual_m` is the calibrated range minus the distance; `ratio_ppm` the rate of the initiator's
    clock relative to the target's by dt64/dt53, NaN unless the target sends a third message. `where` is the file of the
    recording.
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
        """Return the chosen exchanges, in their order; `origin_ns` does not change."""
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
        """Return the rows of at most `most` exchanges, in blocks that are evenly spread over the flight.

        Exchanges within a block are consecutive, so that autocovariances at short lags do not change.
        """
        if len(self) <= most:
            return np.arange(len(self))
        block = 2000
        begins = np.linspace(0, len(self) - block, most // block).astype(np.int64)
        return np.unique(begins[:, None] + np.arange(block))

    @property
    def interval_s(self) -> float:
        """The median interval between exchanges of a pair, in seconds."""
        order = np.lexsort((self.time_s, self.pair))
        apart = np.diff(self.time_s[order])[np.diff(self.pair[order]) == 0]
        return float(np.median(apart)) if len(apart) else float("inf")

    @property
    def power_dbm(self) -> Floats:
        """First-path powers (2, n) in dBm, at the target and at the initiator."""
        return np.array([self.exchanges.fpp1_dbm, self.exchanges.fpp2_dbm])

    @classmethod
    def of(cls, flown: Contents, known: KnownDevices, where: str = "recording", *, fewest: int = 100) -> Self:
        """Return the data of a recording, with ranges calibrated by `known`.

        Raises `TooFewDataError` if poses, powers, tags or the delays of tags are missing, for long replies, and for
        fewer than `fewest` exchanges: with 100, the standard error of quantiles of residuals is a tenth of their
        spread.
        """

        def require(met: object, text: str) -> None:
            if not met:
                raise TooFewDataError(f"{where}: {text}")

        require(len(flown.exchanges), "holds no exchanges; record or import some first")
        names, counts = np.unique(flown.exchanges.protocol, return_counts=True)
        row = PROTOCOLS[str(names[np.argmax(counts)])]
        x = flown.exchanges[np.flatnonzero(flown.exchanges.protocol == row.name)]
        require(len(x) >= fewest, f"has {len(x)} exchanges, but a twin needs {fewest} or more; record longer")
        spans = intervals(x)
        legs = (spans.dt32, spans.dt53) if row.third_sender else (spans.dt32,)
        longest_ms = max(float(np.median(leg)) for leg in legs) * TICK_S * 1e3
        require(
            longest_ms < 6.7,
            f"has reply delays of {longest_ms:.1f} ms, but boards reply within 6.7 ms; twins of "
            f"broadcasts are not supported",
        )
        require(len(flown.poses), "holds no poses; add motion capture with `uwblink poses`")
        x = x[np.argsort(x.time_ns, kind="stable")]
        powers = np.array([x.fpp1_dbm, x.fpp2_dbm])
        good = np.all(np.isfinite(powers) & (powers < 0), axis=0)
        require(good.any(), "no exchange has both first-path powers, which a twin needs")
        ids = np.unique([x.initiator, x.target]).tolist()
        lacking = ", ".join(str(tag) for tag in ids if tag not in {tag.tag for tag in flown.tags})
        require(not lacking, f"has no body of tag {lacking}; add it with 'uwblink poses --tags'")
        known.require(ids)
        distance, towards = sights(flown.poses, list(flown.tags), x.initiator, x.target, x.time_ns)
        good &= np.isfinite(distance) & ~without_stamps(x) & (x.initiator != x.target)
        require(
            np.count_nonzero(good) >= fewest,
            f"{np.count_nonzero(good)} of {len(good)} exchanges have stamps, both powers and poses, but a twin needs "
            f"{fewest} or more; record longer, with motion capture all the time",
        )
        x, distance = x[good], distance[good]
        # Sorted by id, for `searchsorted`.
        tags = tuple(sorted((tag for tag in flown.tags if tag.tag in ids), key=lambda tag: tag.tag))
        ends = np.searchsorted([tag.tag for tag in tags], [x.initiator, x.target])
        pairs, pair = np.unique(np.sort(ends, axis=0), axis=1, return_inverse=True)
        return cls(
            where=where,
            tags=tags,
            row=row,
            exchanges=x,
            origin_ns=int(x.time_ns[0]),
            time_s=np.asarray((x.time_ns - x.time_ns[0]) * 1e-9, dtype=np.float64),
            ends=ends,
            pair=pair.ravel(),
            pairs=tuple((tags[a].tag, tags[b].tag) for a, b in pairs.T),
            distance_m=distance,
            towards=towards[good].swapaxes(0, 1),
            residual_m=known.corrected_m(x) - distance,
            ratio_ppm=_ratio_ppm(x, row),
        )


def attitude(poses: Poses, body: str, time_ns: Ints) -> Rotation:
    """Return the attitudes of a body at times (n,), interpolated between its poses and constant outside them."""
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
"""Smallest `life_s` of paths, fading and outages in a scenario."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduleFit:
    """The schedule of exchanges, including lost ones: start times (slots,), and initiators and targets (2, slots).

    `rate_hz` is the rate of all exchanges. `turns` (2, pairs) is the order of a round robin, None if exchanges had
    another order. `lost_share` is the share of lost exchanges; outages of a pair last `outage_life_s`. `delay_uus` is
    the delay of scheduled messages, `replies_us` are quantiles of the times of immediate replies; None if the protocol
    has no such message.
    """

    time_s: Floats
    ends: Ints
    lost_share: float
    outage_life_s: float
    turns: Ints | None
    rate_hz: float
    delay_uus: int | None
    replies_us: tuple[float, ...] | None


def fit_schedule(flight: TwinFlight, faults: list[Fault]) -> ScheduleFit:
    """Return the schedule of a flight, including failed exchanges (`faults`)."""
    place: dict[int | None, int] = {tag.tag: k for k, tag in enumerate(flight.tags)}
    known = [fault for fault in faults if fault.initiator in place and fault.target in place]
    times = np.array([fault.time_ns for fault in known], dtype=np.int64)
    failed = np.array([[place[fault.initiator], place[fault.target]] for fault in known], dtype=np.int64).reshape(-1, 2)
    within = (times >= flight.origin_ns) & (times <= flight.exchanges.time_ns[-1])
    time = np.concatenate([flight.time_s, (times[within] - flight.origin_ns) * 1e-9])
    ends = np.concatenate([flight.ends, failed[within].T], axis=1)
    order = np.argsort(time, kind="stable")
    time, ends, lost = time[order], ends[:, order], order >= len(flight)
    rate, turns = (len(time) - 1) / max(float(time[-1]), 1e-3), None
    round_robin = _round_robin(time, ends)
    if round_robin:
        beat, slot, turns = round_robin
        # Slots without an exchange and without a fault are lost, too.
        every = np.arange(slot[-1] + 1)
        rate, time, ends = 1 / beat, every * beat, turns[:, every % turns.shape[1]]
        lost = ~np.isin(every, slot[~lost])
    elif _logged_late(flight):
        # Logged times are late and in groups, but exchanges did not overlap in the air: move them apart by the duration
        # of an exchange.
        own = intervals(flight.exchanges)
        ticks = own.dt41 + (own.dt64 if len(flight.row.messages) > 2 else 0.0)
        lasts_s = min(float(np.quantile(ticks, 0.99)) * TICK_S + frame_s(FINAL_BYTES, 128) + TURNAROUND_S, 1 / rate)
        beat_s = lasts_s * np.arange(len(time))
        time = np.asarray(beat_s + np.maximum.accumulate(time - beat_s))
    pair = ends.min(axis=0) * len(flight.tags) + ends.max(axis=0)
    return ScheduleFit(
        time_s=time,
        ends=ends,
        lost_share=float(np.mean(lost)),
        outage_life_s=lasting(time, pair, lost.astype(np.float64))[1] or SHORTEST_LIFE_S,
        turns=turns,
        rate_hz=rate,
        delay_uus=_scheduled_uus(flight),
        replies_us=_replies_us(flight),
    )


def _logged_late(flight: TwinFlight) -> bool:
    """Return whether times are those of a log: they differ by 0.1 ms or more from the stamps of initiators."""
    order, wrap_s = np.lexsort((flight.time_s, flight.ends[0])), TICK_S * 2.0**flight.exchanges.bits
    apart_s = np.diff(flight.time_s[order]) - np.diff(flight.exchanges.tx1[order] * TICK_S)
    late_s = (apart_s - wrap_s * np.rint(apart_s / wrap_s))[np.diff(flight.ends[0, order]) == 0]
    return len(late_s) > 0 and bool(np.median(np.abs(late_s)) > 1e-4)


def _round_robin(time: Floats, ends: Ints) -> tuple[float, Ints, Ints] | None:
    """Return interval, slots (n,) and turns (2, pairs) of a round robin; None if it explains less than 90 %."""
    turns, pair = np.unique(ends, axis=1, return_inverse=True)
    count, apart = turns.shape[1], np.diff(time)
    usual = np.median(apart) if len(apart) else 0.0
    if not usual > 0:
        return None
    beat = float(time[-1] / max(np.sum(np.rint(apart / usual)), 1))
    slot = np.append(0, np.cumsum(np.rint(apart / beat))).astype(np.int64)
    seen = np.zeros((count, count), dtype=np.int64)
    np.add.at(seen, (slot % count, pair.ravel()), 1)
    order = seen.argmax(axis=1)
    kept = (order[slot % count] == pair.ravel()) & (np.abs(time / beat - slot) < 0.25)
    return (beat, slot, turns[:, order]) if np.mean(kept) >= 0.9 and len(set(order.tolist())) == count else None


def _scheduled_uus(flight: TwinFlight) -> int | None:
    """Return the delay of the first scheduled message, within the bounds of a scenario; None without one."""
    spans = intervals(flight.exchanges)
    for message, ticks in zip(flight.row.messages[1:], (spans.dt32, spans.dt53), strict=False):
        if message.timing == "scheduled":
            # The chip rounds a scheduled time down to its grid, and adds the antenna delay.
            return int(np.clip(round((np.median(ticks) - ANTENNA_DELAY_TICKS) / UUS_TICKS), 280, 6500))
    return None


def _replies_us(flight: TwinFlight) -> tuple[float, ...] | None:
    """Return quantiles of immediate reply times, within the bounds of a scenario; None for scheduled replies."""
    if flight.row.messages[1].timing != "at once":
        return None
    delays = intervals(flight.exchanges).dt32 * TICK_S * 1e6
    found = np.quantile(delays, np.linspace(0, 1, min(201, len(delays))))
    return tuple(np.clip(found, 180.0, 6000.0).round(4).tolist())
