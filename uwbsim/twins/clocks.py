"""Rates of all tags' clocks over time, jointly from ratios of stamps and from carrier readings of all pairs.

A linear Gaussian model: each clock's rate is a random walk between knots, each ratio dt64/dt53 and each carrier reading
the difference of two rates with noise. Deviations of walks and noises are what makes the data most likely, by
expectation and maximization (Shumway and Stoffer 1982, there with a Kalman smoother, here in one system of equations).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import csr_array, vstack

from uwblink.arrays import Floats, Ints
from uwblink.ticks import TICK_S
from uwblink.twr import intervals
from uwbsim.twins.flight import Flight

UNKNOWNS: Final = 300
"""Rates that are solved for at most, tags times knots."""

SHORTEST_STEP_S: Final = 0.5
ROUNDS: Final = 40
SAMPLED: Final = 6000
"""Readings of which the noise is taken in each round, at least."""

PRIOR_STEPS: Final = 10.0
"""How many steps of an average clock each clock's walk is taken together with: a short flight has few of its own."""

OUTLIER: Final = 5.0
SETTLED: Final = 3e-3
"""Relative change of a deviation, below which it is taken as found."""

KINDS: Final = 2
"""Of readings, each with a bias of its own: ratios and carriers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockFit:
    """What clocks did: rates in ppm at the start by tag's place, their walks in ppm a root of a second, (tags,) each.

    The mean of all rates at the start is zero by choice, as nothing in a recording says what true time is.
    `carrier_std_ppm` and `carrier_bias_ppm` are of a reading, `ratio_bias_ppm` of a ratio; `ratio_left_ppm` (n,) is
    what the rates leave of ratios, with as much spread as their noise has, NaN where there is no ratio.
    """

    skew_ppm: Floats
    skew_error_ppm: Floats
    walk_ppm_per_sqrt_s: Floats
    carrier_std_ppm: float
    carrier_bias_ppm: float
    ratio_bias_ppm: float
    ratio_left_ppm: Floats

    def receive_noise_s(self, flight: Flight) -> Floats:
        """Return what noise of a single receive stamp ratios show, exchange by exchange with its sign, (n,).

        A ratio has the noise of two receptions of the same tag, over dt53.
        """
        return np.asarray(self.ratio_left_ppm * 1e-6 * intervals(flight.exchanges).dt53 * TICK_S / np.sqrt(2))


@dataclass(slots=True)
class _Readings:
    """Observations: differences of rates (m,) by the design (m, unknowns), of kind 0 (ratio) or 1 (carrier)."""

    design: csr_array
    value: Floats
    kind: Ints


def fit_clocks(flight: Flight) -> ClockFit:
    """Fit the clocks of a flight."""
    tags, span = len(flight.tags), max(float(flight.time_s[-1]), 1e-3)
    knots = int(np.clip(min(UNKNOWNS // tags, span / SHORTEST_STEP_S), 2, 400))
    step_s = span / (knots - 1)
    readings = _readings(flight, knots, step_s)
    noise, walk = _first_guess(flight), np.full(tags, 3e-3)
    weight = np.ones(len(readings.value))
    some = np.arange(0, len(weight), max(len(weight) // SAMPLED, 1))
    stiffness = _walk_precision(knots)
    for _ in range(ROUNDS):
        before = np.append(noise, walk)
        found, covariance = _solve(readings, weight, noise, stiffness, walk**2 * step_s)
        left = readings.value - readings.design @ found
        scatter = left[some] ** 2 + _own_variance(readings.design[some], covariance)
        weight = (np.abs(left) < OUTLIER * noise[readings.kind]).astype(np.float64)
        noise = np.array([_spread(scatter, weight[some], readings.kind[some] == k, noise[k]) for k in (0, 1)])
        walk = _walks(found, covariance, knots, step_s)
        if np.max(np.abs(np.log(np.append(noise, walk) / before))) < SETTLED:
            break
    scatter = left**2 + np.concatenate(
        [_own_variance(readings.design[k : k + SAMPLED], covariance) for k in range(0, len(left), SAMPLED)]
    )
    noise = np.array([_spread(scatter, weight, readings.kind == k, noise[k]) for k in (0, 1)])
    rates = found[:-KINDS].reshape(tags, knots)
    error = np.sqrt(np.diag(covariance)[:-KINDS].reshape(tags, knots)[:, 0])
    ratio = np.full(len(flight), np.nan)
    rows = readings.kind == 0
    # The rates follow the ratios a little; what is left is scaled to the noise that makes the data most likely.
    kept = left[rows]
    if rows.any():
        ratio[np.isfinite(flight.ratio_ppm)] = kept * noise[0] / _rms(kept[weight[rows] > 0])
    return ClockFit(
        skew_ppm=rates[:, 0],
        skew_error_ppm=error,
        walk_ppm_per_sqrt_s=walk,
        carrier_std_ppm=float(noise[1]),
        carrier_bias_ppm=float(found[-1]),
        ratio_bias_ppm=float(found[-2]),
        ratio_left_ppm=ratio,
    )


def _readings(flight: Flight, knots: int, step_s: float) -> _Readings:
    """Line up ratios and carriers; those of the target's receiver are positive where the target is faster."""
    first, second = flight.ends
    x = flight.exchanges
    parts = ((flight.ratio_ppm, first, second, 0), (x.skew1_ppm, second, first, 1), (x.skew2_ppm, first, second, 1))
    designs, values, kinds = [], [], []
    for value, plus, minus, kind in parts:
        rows = np.flatnonzero(np.isfinite(value))
        designs.append(_design(flight, rows, plus[rows], minus[rows], knots, step_s, kind))
        values.append(value[rows])
        kinds.append(np.full(len(rows), kind))
    return _Readings(csr_array(vstack(designs)), np.concatenate(values), np.concatenate(kinds))


def _design(flight: Flight, rows: Ints, plus: Ints, minus: Ints, knots: int, step_s: float, kind: int) -> csr_array:
    """Return rows of the difference of two rates, linear between knots, and in the last columns of the biases."""
    at = flight.time_s[rows] / step_s
    knot = np.clip(at.astype(np.int64), 0, knots - 2)
    into = at - knot
    columns = np.concatenate(
        [plus * knots + knot, plus * knots + knot + 1, minus * knots + knot, minus * knots + knot + 1]
    )
    values = np.concatenate([1 - into, into, into - 1, -into])
    place = np.tile(np.arange(len(rows)), 4)
    size = len(flight.tags) * knots
    place, columns = np.append(place, np.arange(len(rows))), np.append(columns, np.full(len(rows), size + kind))
    values = np.append(values, np.ones(len(rows)))
    return csr_array((values, (place, columns)), shape=(len(rows), size + KINDS))


def _first_guess(flight: Flight) -> Floats:
    """Return rough noise of ratios and of carriers, from values that do not depend on rates."""
    x = flight.exchanges
    both = x.skew1_ppm + x.skew2_ppm
    carrier = _robust(both) / np.sqrt(2) if np.isfinite(both).any() else 0.2
    apart = flight.ratio_ppm - (x.skew2_ppm - x.skew1_ppm) / 2
    ratio = np.sqrt(max(_robust(apart) ** 2 - carrier**2 / 2, (0.3 * _robust(apart)) ** 2))
    return np.array([ratio if np.isfinite(ratio) and ratio > 0 else 0.1, max(carrier, 1e-6)])


def _robust(values: Floats) -> float:
    finite = values[np.isfinite(values)]
    if not len(finite):
        return float("nan")
    return float(1.4826 * np.median(np.abs(finite - np.median(finite))))


def _solve(
    readings: _Readings, weight: Floats, noise: Floats, stiffness: Floats, step_variance: Floats
) -> tuple[Floats, Floats]:
    """Return the most likely rates, and the biases, and their covariance."""
    knots = len(stiffness)
    precision = weight / noise[readings.kind] ** 2
    design = readings.design
    normal = (design.T @ design.multiply(precision[:, None])).toarray()
    towards = design.T @ (precision * readings.value)
    for k, variance in enumerate(step_variance):
        block = slice(k * knots, (k + 1) * knots)
        normal[block, block] += stiffness / variance
    # The mean of the rates at the start is zero, tightly; and a bias that nothing tells is zero.
    start = np.arange(len(step_variance)) * knots
    normal[np.ix_(start, start)] += 1e6
    normal[range(-KINDS, 0), range(-KINDS, 0)] += 1e-6
    covariance = np.linalg.inv(normal)
    return covariance @ towards, covariance


def _walk_precision(knots: int) -> Floats:
    difference = np.diff(np.eye(knots), axis=0)
    return np.asarray(difference.T @ difference)


def _own_variance(design: csr_array, covariance: Floats) -> Floats:
    """Return the variances of what the model says of readings, (m,)."""
    return np.asarray(design.multiply(design @ covariance).sum(axis=1)).ravel()


def _spread(scatter: Floats, weight: Floats, rows: Floats, before: float) -> float:
    total = float(np.sum(weight[rows]))
    return float(np.sqrt(np.sum((weight * scatter)[rows]) / total)) if total else before


def _walks(found: Floats, covariance: Floats, knots: int, step_s: float) -> Floats:
    """Return the deviations of the walks that expected steps have, each clock's with a little of the average."""
    tags = (len(found) - KINDS) // knots
    variance = np.zeros(tags)
    for k in range(tags):
        block = slice(k * knots, (k + 1) * knots)
        own = covariance[block, block]
        between = np.diag(own)[1:] + np.diag(own)[:-1] - 2 * np.diag(own, 1)
        variance[k] = np.sum(np.diff(found[block]) ** 2 + between)
    together = variance.mean() / (knots - 1)
    return np.asarray(np.sqrt((variance + PRIOR_STEPS * together) / (knots - 1 + PRIOR_STEPS) / step_s))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
