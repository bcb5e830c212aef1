"""Rates of all tags' clocks over time, jointly from ratios of stamps and from carrier readings of all pairs.

A linear Gaussian model: each clock's rate is a random walk between knots, each ratio dt64/dt53 and each carrier reading
the difference of two rates with noise. Deviations of walks and noises are what makes the data most likely, by
expectation and maximization (Shumway and Stoffer 1982, there with a Kalman smoother, here in one system of equations).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import csr_array, hstack, vstack

from uwblink.arrays import Floats, Ints
from uwblink.ticks import TICK_S
from uwblink.twr import intervals
from uwbsim.twins.flight import Flight, bulk_spread, some_rows

UNKNOWNS: Final = 300
"""Rates that are solved for at most, tags times knots."""

SHORTEST_STEP_S: Final = 0.5
ROUNDS: Final = 40
WARM_UPS_S: Final = (10.0, 25.0, 60.0)
WARM_UP_PPM: Final = 5.0
"""How much faster clocks are thought to run at first before anything is seen."""

LONG_WALK_PPM: Final = 0.15
"""Over a flight; who walks that far may be warming up."""

NEEDED: Final = 3.0
SAMPLED: Final = 10_000
"""Readings of which the noise is taken in each round, at most."""

PRIOR_STEPS: Final = 1.0
"""How many steps of an average clock each clock's walk is taken together with: a short flight has few of its own."""

OUTLIER: Final = 5.0
SETTLED: Final = 3e-3
"""Relative change of a deviation, below which it is taken as found."""

KINDS: Final = 2
"""Of readings, each with a bias of its own: ratios and carriers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockFit:
    """What clocks did: rates in ppm at the start by tag's place, their walks in ppm a root of a second, (tags,) each.

    Clocks ran faster by `warm_up_ppm` (tags,) at first, which went away by e in every `warm_up_s`, None where none did.
    The mean of all rates at the start, without that, is zero by choice: nothing in a recording says what true time is.
    `carrier_std_ppm` and `carrier_bias_ppm` are of a reading, `ratio_bias_ppm` of a ratio; `ratio_left_ppm` (n,) is
    what the rates leave of ratios, with as much spread as their noise has, NaN where there is no ratio.
    """

    skew_ppm: Floats
    skew_error_ppm: Floats
    walk_ppm_per_sqrt_s: Floats
    warm_up_ppm: Floats
    warm_up_s: float | None
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
    """Fit the clocks of a flight; with warming up where walks would have to be long without."""
    found = _Search(flight, None).run(ROUNDS)
    span = float(flight.time_s[-1])
    if np.max(found.walk) * np.sqrt(span) > LONG_WALK_PPM:
        tries = [_Search(flight, decay).run(ROUNDS) for decay in WARM_UPS_S if decay < 2 * span]
        best = min(tries, key=lambda one: float(np.sum(np.log(one.walk))), default=found)
        # Each clock pays for its warming up with a walk that is shorter by more than one number explains.
        shorter = float(np.sum(np.log(found.walk / best.walk))) * (best.knots - 1)
        if shorter > NEEDED * len(flight.tags) and best.warmed_up() > NEEDED:
            found = best
    return found.result()


class _Search:
    """Rounds of expectation and maximization, with clocks that warm up by e in every `decay_s`, or do not."""

    def __init__(self, flight: Flight, decay_s: float | None) -> None:
        tags, span = len(flight.tags), max(float(flight.time_s[-1]), 1e-3)
        self.flight, self.decay_s, self.tags = flight, decay_s, tags
        self.knots = int(np.clip(min(UNKNOWNS // tags, span / SHORTEST_STEP_S), 2, 400))
        self.step_s = span / (self.knots - 1)
        self.readings = _readings(flight, self.knots, self.step_s, decay_s)
        self.noise, self.walk = _first_guess(flight), np.full(tags, 3e-3)
        self.weight = np.ones(len(self.readings.value))
        self.some = some_rows(len(self.weight), SAMPLED)
        self.stiffness = _walk_precision(self.knots)

    def run(self, rounds: int) -> _Search:
        """Go on for so many rounds, or until nothing changes any more."""
        readings, some = self.readings, self.some
        for _ in range(rounds):
            before = np.append(self.noise, self.walk)
            self._solve()
            scatter = self.left[some] ** 2 + _own_variance(readings.design[some], self.covariance)
            self.weight = (np.abs(self.left) < OUTLIER * self.noise[readings.kind]).astype(np.float64)
            self._set_noise(scatter, self.weight[some], readings.kind[some])
            self.walk = _walks(self.found, self.covariance, self.tags, self.knots, self.step_s)
            if np.max(np.abs(np.log(np.append(self.noise, self.walk) / before))) < SETTLED:
                break
        return self

    def _solve(self) -> None:
        """Find the most likely rates, warming up and biases, and their covariance."""
        readings, knots, tags = self.readings, self.knots, self.tags
        precision = self.weight / self.noise[readings.kind] ** 2
        normal = (readings.design.T @ readings.design.multiply(precision[:, None])).toarray()
        towards = readings.design.T @ (precision * readings.value)
        for k, walk in enumerate(self.walk):
            block = slice(k * knots, (k + 1) * knots)
            normal[block, block] += self.stiffness / (walk**2 * self.step_s)
        # The mean of the rates at the start is zero, tightly; and a bias that nothing tells is zero.
        start = np.arange(tags) * knots
        normal[np.ix_(start, start)] += 1e6
        warm = np.arange(tags * knots, tags * (knots + 1))
        normal[warm, warm] += 1e12 if self.decay_s is None else WARM_UP_PPM**-2
        normal[range(-KINDS, 0), range(-KINDS, 0)] += 1e-6
        self.covariance = np.linalg.inv(normal)
        self.found = self.covariance @ towards
        self.left = readings.value - readings.design @ self.found

    def _set_noise(self, scatter: Floats, weight: Floats, kind: Ints) -> None:
        self.noise = np.array([_spread(scatter, weight, kind == k, self.noise[k]) for k in range(KINDS)])

    def warmed_up(self) -> float:
        """Return how much more than its walk does meanwhile the clock that warms up most does, from all others."""
        warm = self.found[self.tags * self.knots : -KINDS]
        return float(np.max(np.abs(warm - np.median(warm)) / (self.walk * np.sqrt(self.decay_s or 1.0))))

    def result(self) -> ClockFit:
        """Return what was found; the noise is taken of all readings."""
        readings, found, count = self.readings, self.found, self.tags * self.knots
        pieces = range(0, len(self.left), SAMPLED)
        own = [_own_variance(readings.design[k : k + SAMPLED], self.covariance) for k in pieces]
        self._set_noise(self.left**2 + np.concatenate(own), self.weight, readings.kind)
        variance = np.diag(self.covariance)[:count].reshape(self.tags, self.knots)
        ratio = np.full(len(self.flight), np.nan)
        rows = readings.kind == 0
        if rows.any():
            # The rates follow the ratios a little; what is left is scaled to the noise that is most likely.
            scale = self.noise[0] / _rms(self.left[rows & (self.weight > 0)])
            ratio[np.isfinite(self.flight.ratio_ppm)] = self.left[rows] * scale
        return ClockFit(
            skew_ppm=found[:count].reshape(self.tags, self.knots)[:, 0],
            skew_error_ppm=np.sqrt(variance[:, 0]),
            walk_ppm_per_sqrt_s=self.walk,
            warm_up_ppm=found[count : count + self.tags],
            warm_up_s=self.decay_s,
            carrier_std_ppm=float(self.noise[1]),
            carrier_bias_ppm=float(found[-1]),
            ratio_bias_ppm=float(found[-2]),
            ratio_left_ppm=ratio,
        )


def _readings(flight: Flight, knots: int, step_s: float, decay_s: float | None) -> _Readings:
    """Line up ratios and carriers; those of the target's receiver are positive where the target is faster."""
    first, second = flight.ends
    x = flight.exchanges
    parts = ((flight.ratio_ppm, first, second, 0), (x.skew1_ppm, second, first, 1), (x.skew2_ppm, first, second, 1))
    designs, values, kinds = [], [], []
    for value, plus, minus, kind in parts:
        rows = np.flatnonzero(np.isfinite(value))
        designs.append(_design(flight, rows, plus[rows], minus[rows], knots, step_s, decay_s))
        values.append(value[rows])
        kinds.append(np.full(len(rows), kind))
    which = np.concatenate(kinds)
    biases = csr_array(np.eye(KINDS)[which])
    return _Readings(csr_array(hstack([vstack(designs), biases])), np.concatenate(values), which)


def _design(
    flight: Flight, rows: Ints, plus: Ints, minus: Ints, knots: int, step_s: float, decay_s: float | None
) -> csr_array:
    """Return rows of the difference of two rates: linear between knots, and warming up."""
    at = flight.time_s[rows] / step_s
    knot = np.clip(at.astype(np.int64), 0, knots - 2)
    into, count = at - knot, len(flight.tags) * knots
    warm = np.zeros(len(rows)) if decay_s is None else np.exp(-flight.time_s[rows] / decay_s)
    columns, values = [], []
    for tag, sign in ((plus, 1), (minus, -1)):
        columns += [tag * knots + knot, tag * knots + knot + 1, count + tag]
        values += [sign * (1 - into), sign * into, sign * warm]
    place = np.tile(np.arange(len(rows)), len(columns))
    shape = (len(rows), count + len(flight.tags))
    return csr_array((np.concatenate(values), (place, np.concatenate(columns))), shape=shape)


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
    return bulk_spread(finite) if len(finite) else float("nan")


def _walk_precision(knots: int) -> Floats:
    difference = np.diff(np.eye(knots), axis=0)
    return np.asarray(difference.T @ difference)


def _own_variance(design: csr_array, covariance: Floats) -> Floats:
    """Return the variances of what the model says of readings, (m,)."""
    return np.asarray(design.multiply(design @ covariance).sum(axis=1)).ravel()


def _spread(scatter: Floats, weight: Floats, rows: Floats, before: float) -> float:
    total = float(np.sum(weight[rows]))
    return float(np.sqrt(np.sum((weight * scatter)[rows]) / total)) if total else before


def _walks(found: Floats, covariance: Floats, tags: int, knots: int, step_s: float) -> Floats:
    """Return the deviations of the walks that expected steps have, each clock's with a little of the average."""
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
