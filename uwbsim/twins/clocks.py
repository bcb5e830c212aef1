"""Rates of all tags' clocks over time, jointly from ratios of stamps and from carrier readings of all pairs.

A linear Gaussian model: each clock's rate is a random walk between knots, each ratio dt64/dt53 and each carrier reading
the difference of two rates with noise. Deviations of walks and noises are what makes the data most likely, by
expectation and maximization (Shumway and Stoffer 1982, there with a Kalman smoother, here in one system of equations).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from scipy.sparse import csr_array, hstack, vstack

from uwblink.arrays import Floats, Ints
from uwblink.ticks import TICK_S
from uwblink.twr import intervals
from uwbsim.twins.flight import Flight, bulk_spread, some_rows

SAMPLED: Final = 10_000
"""Readings of which the noise is taken in each round, at most: known to 1 % then."""


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


def fit_clocks(flight: Flight) -> ClockFit:
    """Fit the clocks of a flight; with warming up where walks would have to be long without."""
    found = _Search(flight, None).run()
    span = float(flight.time_s[-1])
    # A clock that walks further than 0.15 ppm over a flight may be warming up.
    if np.max(found.walk) * np.sqrt(span) > 0.15:
        tries = [_Search(flight, decay).run() for decay in (10.0, 25.0, 60.0) if decay < 2 * span]
        best = min(tries, key=lambda one: float(np.sum(np.log(one.walk))), default=found)
        # Each clock pays for its warming up with a walk that is shorter by more than one number explains.
        shorter = float(np.sum(np.log(found.walk / best.walk))) * (best.knots - 1)
        if shorter > 3 * len(flight.tags) and best.warmed_up() > 3:
            found = best
    return found.result()


class _Search:
    """Rounds of expectation and maximization, with clocks that warm up by e in every `decay_s`, or do not."""

    def __init__(self, flight: Flight, decay_s: float | None) -> None:
        tags, span = len(flight.tags), max(float(flight.time_s[-1]), 1e-3)
        self.flight, self.decay_s, self.tags = flight, decay_s, tags
        # Knots half a second apart at least, and 300 unknown rates in all at most.
        self.knots = int(np.clip(min(300 // tags, span / 0.5), 2, 400))
        self.step_s = span / (self.knots - 1)
        self._read()
        self.noise, self.walk = _initial_noise(flight), np.full(tags, 3e-3)
        self.weight = np.ones(len(self.value))
        self.some = some_rows(len(self.weight), SAMPLED)
        difference = np.diff(np.eye(self.knots), axis=0)
        self.stiffness = difference.T @ difference

    def _read(self) -> None:
        """Line up ratios and carriers: differences of rates (m,) by `design` (m, unknowns), of kind 0 or 1.

        Carriers read by the target are positive where it is faster. Rates are linear between knots, and warm up.
        """
        flight, count = self.flight, self.tags * self.knots
        first, second = flight.ends
        x = flight.exchanges
        parts = ((flight.ratio_ppm, first, second), (x.skew1_ppm, second, first), (x.skew2_ppm, first, second))
        designs, values = [], []
        for value, plus, minus in parts:
            rows = np.flatnonzero(np.isfinite(value))
            time = flight.time_s[rows]
            knot = np.clip((time / self.step_s).astype(np.int64), 0, self.knots - 2)
            into = time / self.step_s - knot
            warm = np.zeros(len(rows)) if self.decay_s is None else np.exp(-time / self.decay_s)
            columns, entries = [], []
            for tag, sign in ((plus[rows], 1), (minus[rows], -1)):
                columns += [tag * self.knots + knot, tag * self.knots + knot + 1, count + tag]
                entries += [sign * (1 - into), sign * into, sign * warm]
            place = (np.tile(np.arange(len(rows)), len(columns)), np.concatenate(columns))
            designs.append(csr_array((np.concatenate(entries), place), shape=(len(rows), count + self.tags)))
            values.append(value[rows])
        self.value = np.concatenate(values)
        self.kind = np.minimum(np.repeat(np.arange(3), [len(part) for part in values]), 1)
        self.design = csr_array(hstack([vstack(designs), csr_array(np.eye(2)[self.kind])]))

    def run(self) -> Self:
        """Go on until nothing changes any more."""
        for _ in range(40):
            before = np.append(self.noise, self.walk)
            self._solve()
            # Readings five standard deviations off are left out.
            self.weight = (np.abs(self.left) < 5 * self.noise[self.kind]).astype(np.float64)
            self._set_noise(self.some)
            self.walk = self._walks()
            if np.max(np.abs(np.log(np.append(self.noise, self.walk) / before))) < 3e-3:
                break
        return self

    def _solve(self) -> None:
        """Find the most likely rates, warming up and biases, and their covariance."""
        knots, tags = self.knots, self.tags
        precision = self.weight / self.noise[self.kind] ** 2
        normal = (self.design.T @ self.design.multiply(precision[:, None])).toarray()
        towards = self.design.T @ (precision * self.value)
        for k, walk in enumerate(self.walk):
            block = slice(k * knots, (k + 1) * knots)
            normal[block, block] += self.stiffness / (walk**2 * self.step_s)
        # The mean of the rates at the start is zero, tightly; clocks are thought to run 5 ppm faster at first; and a
        # bias that no reading determines is zero.
        start = np.arange(tags) * knots
        normal[np.ix_(start, start)] += 1e6
        warm = np.arange(tags * knots, tags * (knots + 1))
        normal[warm, warm] += 1e12 if self.decay_s is None else 5.0**-2
        normal[range(-2, 0), range(-2, 0)] += 1e-6
        self.covariance = np.linalg.inv(normal)
        self.found = self.covariance @ towards
        self.left = self.value - self.design @ self.found

    def _set_noise(self, rows: Ints) -> None:
        """Set the noise of each kind to the most likely, of some rows: their scatter and what the model leaves open."""
        pieces = [rows[k : k + SAMPLED] for k in range(0, len(rows), SAMPLED)]
        parts = [self.design[piece] for piece in pieces]
        own = [np.asarray(part.multiply(part @ self.covariance).sum(axis=1)).ravel() for part in parts]
        scatter, weight, kind = self.left[rows] ** 2 + np.concatenate(own), self.weight[rows], self.kind[rows]
        total, count = (np.bincount(kind, v, minlength=2) for v in (weight * scatter, weight))
        self.noise = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), self.noise)

    def _walks(self) -> Floats:
        """Return the deviations of the walks that expected steps have, each clock's with one of the average's."""
        variance = np.zeros(self.tags)
        for k in range(self.tags):
            block = slice(k * self.knots, (k + 1) * self.knots)
            own = self.covariance[block, block]
            between = np.diag(own)[1:] + np.diag(own)[:-1] - 2 * np.diag(own, 1)
            variance[k] = np.sum(np.diff(self.found[block]) ** 2 + between)
        together = variance.mean() / (self.knots - 1)
        return np.asarray(np.sqrt((variance + together) / self.knots / self.step_s))

    def warmed_up(self) -> float:
        """Return how much more than its walk does meanwhile the clock that warms up most does, from all others."""
        warm = self.found[self.tags * self.knots : -2]
        return float(np.max(np.abs(warm - np.median(warm)) / (self.walk * np.sqrt(self.decay_s or 1.0))))

    def result(self) -> ClockFit:
        """Return what was found; the noise is taken of all readings."""
        found, count = self.found, self.tags * self.knots
        self._set_noise(np.arange(len(self.left)))
        variance = np.diag(self.covariance)[:count].reshape(self.tags, self.knots)
        ratio = np.full(len(self.flight), np.nan)
        rows = self.kind == 0
        if rows.any():
            # The rates follow the ratios a little; what is left is scaled to the noise that is most likely.
            scale = self.noise[0] / np.sqrt(np.mean(self.left[rows & (self.weight > 0)] ** 2))
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


def _initial_noise(flight: Flight) -> Floats:
    """Return rough noise of ratios and of carriers, from values that do not depend on rates."""
    x = flight.exchanges
    both, apart = x.skew1_ppm + x.skew2_ppm, flight.ratio_ppm - (x.skew2_ppm - x.skew1_ppm) / 2
    carrier = bulk_spread(both[np.isfinite(both)]) / np.sqrt(2) if np.isfinite(both).any() else 0.2
    ratio = 0.1
    if np.isfinite(apart).any():
        spread = bulk_spread(apart[np.isfinite(apart)])
        ratio = np.sqrt(max(spread**2 - carrier**2 / 2, (0.3 * spread) ** 2)) or ratio
    return np.array([ratio, max(carrier, 1e-6)])
