"""How long what differs by pair lasts: autocovariances over time within pairs, and how many values are worth one.

Nothing is assumed of what is drawn when: a life is the time constant of the autocovariance of some quantity, whatever
makes it last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import least_squares

from uwblink.arrays import Floats, Ints
from uwbsim.random_streams import stream

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
