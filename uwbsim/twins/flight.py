"""A recording as the columns that a twin is fitted to and compared by, and statistics of such columns by pair.

Lives of reflections and fading are time constants of autocovariances within pairs: nothing is assumed of what is drawn
when, or of what makes a quantity last.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Protocol, Self

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from uwblink.arrays import Floats, Ints
from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.distances import antennas_m
from uwblink.recording.file import Recording
from uwblink.recording.schema import Fault, Poses, Tag
from uwblink.twr import Exchanges, intervals, without_stamps
from uwbsim.errors import ScenarioError, UnanswerableError
from uwbsim.random_streams import stream
from uwbsim.twins.calibration_file import KnownDevices
from uwbsim.units import NS

BINS: Final = 24
MOST_STEPS: Final = 80
MOST_PRODUCTS: Final = 4_000_000
SHORTEST_LAG_S: Final = 1e-3
LONGEST_SHARE: Final = 0.25
"""Of a flight's length, up to which lags count."""

LONGEST_SUM: Final = 3000
"""Lags that are added up at most."""

SIGNIFICANT: Final = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Autocovariance:
    """Mean products of values of a pair that lie some time apart: lags in seconds, covariances, counts, (bins,) each.

    `variance` is that of the values, `span_s` how long the flight was.
    """

    lag_s: Floats
    covariance: Floats
    count: Floats
    variance: float
    span_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Lasting:
    """What lasts: its variance and its life in seconds; None where the lags that there are do not tell."""

    variance: float
    life_s: float | None


def autocovariance(time_s: Floats, pair: Ints, value: Floats, span_s: float) -> Autocovariance:
    """Return the autocovariance of values (n,) about their pair's mean, over all pairs."""
    lags, products = [], []
    for key in np.unique(pair):
        rows = np.flatnonzero(pair == key)
        if len(rows) < 8:
            continue
        time, centred = time_s[rows], value[rows] - value[rows].mean()
        for step in _steps(len(rows), len(value)):
            apart = time[step:] - time[:-step]
            if apart.min() > LONGEST_SHARE * span_s:
                break
            lags.append(apart)
            products.append(centred[step:] * centred[:-step])
    centred_all = value - (np.bincount(pair, value) / np.maximum(np.bincount(pair), 1))[pair]
    variance = float(np.mean(centred_all**2))
    if not lags:
        nothing = np.zeros(0)
        return Autocovariance(lag_s=nothing, covariance=nothing, count=nothing, variance=variance, span_s=span_s)
    lag, product = np.concatenate(lags), np.concatenate(products)
    near = (lag >= SHORTEST_LAG_S) & (lag <= LONGEST_SHARE * span_s)
    lag, product = lag[near], product[near]
    if not len(lag):
        lag, product = np.full(1, SHORTEST_LAG_S), np.zeros(1)
    edges = np.geomspace(lag.min() * 0.999, lag.max() * 1.001, BINS + 1)
    which = np.digitize(lag, edges) - 1
    count = np.bincount(which, minlength=BINS)[:BINS]
    some = count > 20
    total, where = (np.bincount(which, v, minlength=BINS)[:BINS] for v in (product, lag))
    return Autocovariance(
        lag_s=where[some] / count[some],
        covariance=total[some] / count[some],
        count=count[some].astype(np.float64),
        variance=variance,
        span_s=span_s,
    )


def _steps(count: int, total: int) -> list[int]:
    """Return by how many values of a pair products lie apart, denser where they are few."""
    most = int(np.clip(MOST_PRODUCTS // max(total, 1), 12, MOST_STEPS))
    longest = max(int(count * LONGEST_SHARE), 2)
    return sorted(set(np.rint(np.geomspace(1, longest, most)).astype(np.int64).tolist()))


def lasting(found: Autocovariance) -> Lasting:
    """Fit variance and life of an exponential to an autocovariance.

    Means of pairs are those of a flight as long as it is, which takes a little off every lag; that is in the fit.
    """
    if len(found.lag_s) < 3 or found.variance <= 0:
        return Lasting(variance=0.0, life_s=None)
    error = found.variance / np.sqrt(found.count)
    if np.max(found.covariance / error) < SIGNIFICANT:
        return Lasting(variance=0.0, life_s=None)

    def model(at: Floats) -> Floats:
        life = np.exp(at[1])
        return np.asarray(np.exp(at[0]) * (np.exp(-found.lag_s / life) - _taken(life, found.span_s)))

    def misfit(at: Floats) -> Floats:
        return np.asarray((model(at) - found.covariance) / error)

    peak = max(found.covariance.max(), 1e-3 * found.variance)
    starts = [np.log([peak, life]) for life in np.geomspace(found.lag_s[0], found.span_s / 8, 4)]
    bounds = (
        np.log([1e-4 * found.variance, found.lag_s[0] / 20]),
        np.log([4 * found.variance, found.span_s / 2]),
    )
    tries = [
        least_squares(misfit, np.clip(start, bounds[0] + 1e-6, bounds[1] - 1e-6), bounds=bounds) for start in starts
    ]
    best = min(tries, key=lambda one: float(one.cost))
    variance, life = np.exp(best.x)
    if life < found.lag_s[0] / 3 or variance > 1.5 * found.variance:
        return Lasting(variance=0.0, life_s=None)
    return Lasting(variance=float(variance), life_s=float(life))


def _taken(life_s: float, span_s: float) -> float:
    """Return which share of a variance the mean over a span has that its exponential autocovariance lasts."""
    ratio = life_s / span_s
    return float(2 * ratio * (1 - ratio * (1 - np.exp(-1 / ratio))))


def effective_size(value: Floats, group: Ints) -> float:
    """Return how many independent values n values are worth, in order of time within groups.

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
    for step in range(1, min(longest, LONGEST_SUM)):
        same = sorted_group[step:] == sorted_group[:-step]
        if np.count_nonzero(same) < 2:
            break
        correlation = float(np.sum(sorted_value[step:][same] * sorted_value[:-step][same])) / (variance * count)
        if step % 2 == 0 and before + correlation <= 0:
            break
        total, before = total + 2 * correlation, correlation
    return float(np.clip(count / max(total, 1e-9), 2.0, count))


def some_rows(count: int, most: int) -> Ints:
    """Return `most` of so many rows, in their order and by chance: every k-th would leave pairs out that take turns."""
    if count <= most:
        return np.arange(count)
    return np.sort(stream(0, "some rows", count).choice(count, most, replace=False))


def bulk_spread(value: Floats) -> float:
    """Return half the distance of the quantiles at 16 and 84 %, a standard deviation that outliers do not move."""
    low, high = np.quantile(value, [0.16, 0.84])
    return float(high - low) / 2


def lag_one(value: Floats, group: Ints) -> float:
    """Return the autocorrelation of values (n,) to the next of their group, about the mean of all; NaN for none."""
    order = np.argsort(group, kind="stable")
    sorted_value, sorted_group = (value - value.mean())[order], group[order]
    same = sorted_group[1:] == sorted_group[:-1]
    variance = float(np.mean(sorted_value**2))
    if np.count_nonzero(same) < 8 or variance <= 0:
        return float("nan")
    return float(np.mean(sorted_value[1:][same] * sorted_value[:-1][same]) / variance)


BLOCK: Final = 2000
FEWEST: Final = 100
"""Exchanges below which nothing of a distribution can be told."""


class Flown(Protocol):
    """What a flight must have: a `Contents`, a `Simulated` flight, or what is read of a recording."""

    @property
    def exchanges(self) -> Exchanges: ...  # noqa: D102 - the columns of a recording
    @property
    def tags(self) -> list[Tag]: ...  # noqa: D102
    @property
    def poses(self) -> Poses: ...  # noqa: D102
    @property
    def faults(self) -> list[Fault]: ...  # noqa: D102


RecordingSource = str | os.PathLike[str] | Flown
"""A recording: its file (.uwb), or what one holds, in memory."""


@dataclass(frozen=True, slots=True)
class Flew:
    """What a twin needs of a recording."""

    exchanges: Exchanges
    tags: list[Tag]
    poses: Poses
    faults: list[Fault]


def read_flight(source: RecordingSource) -> tuple[Flown, str]:
    """Return what a recording holds and what messages call it; raises what `Recording.open` raises."""
    if not isinstance(source, str | os.PathLike):
        if not all(hasattr(source, name) for name in ("exchanges", "tags", "poses", "faults")):
            raise ScenarioError(f"recording: found {source!r:.60}, expected a file (.uwb) or what one holds")
        return source, "recording"
    with Recording.open(Path(source)) as recording:
        return Flew(recording.exchanges(), recording.tags(), recording.poses(), recording.faults()), str(source)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """Exchanges of one protocol between tags whose places are known, as columns of length n in order of time.

    `time_s` counts from `origin_ns`; `ends` are places in `tags` of initiator and target, (2, n), `pair` the places of
    both in `pairs`, whichever began; `towards` are unit vectors to the other end in the frames of the two bodies,
    (2, n, 3). `residual_m` is calibrated range less distance; `ratio_ppm` by how much the initiator's clock is faster
    than the target's as dt64/dt53 says, NaN where the protocol has no such.
    """

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
    left_out: int = 0

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
        begins = np.linspace(0, len(self) - BLOCK, most // BLOCK).astype(np.int64)
        return np.unique(begins[:, None] + np.arange(BLOCK))

    @property
    def power_dbm(self) -> Floats:
        """First-path powers read at target and initiator, (2, n)."""
        return np.array([self.exchanges.fpp1_dbm, self.exchanges.fpp2_dbm])

    @classmethod
    def of(cls, flown: Flown, known: KnownDevices, where: str = "recording", *, fewest: int = FEWEST) -> Self:
        """Take the columns; raises `ScenarioError` where a recording cannot have a twin."""
        exchanges, row = _of_one_protocol(flown.exchanges, where)
        _check(flown, exchanges, where, fewest)
        tags = _those_that_range(flown.tags, exchanges, where)
        known.require([tag.tag for tag in tags])
        order = np.argsort(exchanges.time_ns, kind="stable")
        exchanges = exchanges[order]
        spots = [antennas_m(flown.poses, list(tags), ids, exchanges.time_ns) for ids in _ids(exchanges)]
        good = np.isfinite(spots[0] + spots[1]).all(axis=1) & _powered(exchanges) & ~without_stamps(exchanges)
        good &= exchanges.initiator != exchanges.target
        if np.count_nonzero(good) < fewest:
            raise UnanswerableError(
                f"{where}: {np.count_nonzero(good)} of {len(good)} exchanges have stamps, both powers and poses around "
                f"them, a twin needs {fewest} or more; record longer, and with motion capture all the time"
            )
        exchanges, spots = exchanges[good], [spot[good] for spot in spots]
        apart = spots[1] - spots[0]
        distance = np.linalg.norm(apart, axis=1)
        unit = apart / np.maximum(distance, 1e-9)[:, None]
        place = {tag.tag: k for k, tag in enumerate(tags)}
        ends = np.array([[place[int(tag)] for tag in ids.tolist()] for ids in _ids(exchanges)])
        names, pair = np.unique(np.sort(np.array(_ids(exchanges)), axis=0), axis=1, return_inverse=True)
        origin = int(exchanges.time_ns[0])
        turned = [
            _into_body(flown.poses, tags, end, exchanges.time_ns, way)
            for end, way in zip(ends, (unit, -unit), strict=True)
        ]
        return cls(
            tags=tags,
            row=row,
            exchanges=exchanges,
            origin_ns=origin,
            time_s=np.asarray((exchanges.time_ns - origin) * NS, dtype=np.float64),
            ends=ends,
            pair=pair.ravel(),
            pairs=tuple((int(a), int(b)) for a, b in names.T),
            distance_m=distance,
            towards=np.array(turned),
            residual_m=known.corrected_m(exchanges) - distance,
            ratio_ppm=_ratio_ppm(exchanges, row),
            left_out=len(flown.exchanges) - len(exchanges),
        )


def _ids(exchanges: Exchanges) -> tuple[Ints, Ints]:
    return exchanges.initiator.astype(np.int64), exchanges.target.astype(np.int64)


def _of_one_protocol(exchanges: Exchanges, where: str) -> tuple[Exchanges, RangingProtocol]:
    names, counts = np.unique(exchanges.protocol, return_counts=True)
    if not len(names):
        raise UnanswerableError(f"{where}: holds no exchanges; record or import some first")
    name = str(names[np.argmax(counts)])
    return exchanges[np.flatnonzero(exchanges.protocol == name)], PROTOCOLS[name]


def _check(flown: Flown, exchanges: Exchanges, where: str, fewest: int) -> None:
    if len(exchanges) < fewest:
        raise UnanswerableError(
            f"{where}: holds {len(exchanges)} exchanges, a twin needs {fewest} or more; record longer"
        )
    if not len(flown.poses):
        raise UnanswerableError(f"{where}: holds no poses; add motion capture with `uwblink poses`")
    if not np.any(_powered(exchanges)):
        raise UnanswerableError(f"{where}: no exchange has both first-path powers, and a twin is made from powers")


def _powered(exchanges: Exchanges) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    powers = np.array([exchanges.fpp1_dbm, exchanges.fpp2_dbm])
    return np.asarray(np.all(np.isfinite(powers) & (powers < 0), axis=0))


def _those_that_range(tags: Sequence[Tag], exchanges: Exchanges, where: str) -> tuple[Tag, ...]:
    ids = set(np.unique([exchanges.initiator, exchanges.target]).tolist())
    known = {tag.tag for tag in tags}
    if ids - known:
        lacking = ", ".join(map(str, sorted(ids - known)))
        raise UnanswerableError(
            f"{where}: does not say on which body tag {lacking} sits; give tags with 'uwblink poses --tags'"
        )
    return tuple(tag for tag in tags if tag.tag in ids)


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
    return Slerp((times - times[0]) * NS, turns)(at * NS)


def _ratio_ppm(exchanges: Exchanges, row: RangingProtocol) -> Floats:
    if len(row.messages) < 3 or row.third_sender != "target":
        return np.full(len(exchanges), np.nan)
    spans = intervals(exchanges)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((spans.dt64 / spans.dt53 - 1) * 1e6)
