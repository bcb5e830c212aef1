"""Rates of all tags' clocks over time, jointly from ratios of stamps and from carrier readings of all pairs.

A linear Gaussian model: each clock's rate is a random walk between knots, each ratio dt64/dt53 and each carrier reading
the difference of two rates with noise. Deviations of walks and noises are what makes the data most likely, by
expectation and maximization (Shumway and Stoffer 1982, there with a Kalman smoother, here in one system of equations).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from uwblink.arrays import Floats
from uwblink.ticks import TICK_S
from uwblink.twr import intervals
from uwbsim.twins.flight import TwinFlight


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockFit:
    """Fitted clocks: rates in ppm at the start and random walks in ppm per root of a second, (tags,) each.

    Clocks ran faster by `warm_up_ppm` (tags,) at first, which decayed with the time constant `warm_up_s`, None where
    none did. The mean of all rates at the start, without that, is zero by choice: nothing in a recording says what true
    time is. `noise_ppm` and `bias_ppm` (2,) are those of ratios and of carrier readings. `receive_noise_s` (n,) is what
    the rates leave of ratios, as noise of a single receive stamp, NaN where there is no ratio.
    """

    skew_ppm: Floats
    skew_error_ppm: Floats
    walk_ppm_per_sqrt_s: Floats
    warm_up_ppm: Floats
    warm_up_s: float | None
    noise_ppm: Floats
    bias_ppm: Floats
    receive_noise_s: Floats


def fit_clocks(flight: TwinFlight) -> ClockFit:
    """Fit the clocks of a flight; with warming up where walks would have to be long without."""
    found = _Search(flight, None)
    span = float(flight.time_s[-1])
    # A clock that walks further than 0.15 ppm over a flight may be warming up.
    if np.max(found.walk) * np.sqrt(span) > 0.15:
        tries = [_Search(flight, decay) for decay in (10.0, 25.0, 60.0) if decay < 2 * span]
        best = min(tries, key=lambda one: float(np.sum(np.log(one.walk))), default=found)
        # Each clock pays for its warming up with a walk that is shorter by more than one number explains.
        shorter = float(np.sum(np.log(found.walk / best.walk))) * (best.knots - 1)
        if shorter > 3 * len(flight.tags) and best.warmed_up() > 3:
            found = best
    return found.result()


class _Search:
    """Expectation and maximization, with clocks that warm up with the time constant `decay_s`, or do not.

    The unknowns are the rates of all clocks at the knots, how much each warms up, and the biases of both kinds of
    readings: 0 are ratios, 1 carriers.
    """

    def __init__(self, flight: TwinFlight, decay_s: float | None) -> None:
        self.tags, span = len(flight.tags), max(float(flight.time_s[-1]), 1e-3)
        self.flight, self.decay_s = flight, decay_s
        # Knots half a second apart at least, and 300 unknown rates in all at most.
        self.knots = int(np.clip(min(300 // self.tags, span / 0.5), 2, 400))
        self.step_s = span / (self.knots - 1)
        self._read()
        self.noise, self.walk = np.array([0.2, 0.2]), np.full(self.tags, 3e-3)
        self.left = np.zeros(len(self.value))
        for _ in range(40):
            before = np.append(self.noise, self.walk)
            self._update()
            if np.max(np.abs(np.log(np.append(self.noise, self.walk) / before))) < 3e-3:
                break

    def _read(self) -> None:
        """Line up ratios and carriers: differences of rates (m,) by `design` (m, unknowns), of kind 0 or 1.

        Carriers read by the target are positive where it is faster. Rates are linear between knots, and warm up.
        """
        count, x, (first, second) = self.tags * self.knots, self.flight.exchanges, self.flight.ends
        values = np.concatenate([self.flight.ratio_ppm, x.skew1_ppm, x.skew2_ppm])
        plus, minus = np.concatenate([first, second, first]), np.concatenate([second, first, second])
        time, kind = np.tile(self.flight.time_s, 3), np.repeat([0, 1, 1], len(self.flight))
        rows = np.flatnonzero(np.isfinite(values))
        self.value, self.kind, time = values[rows], kind[rows], time[rows]
        knot = np.clip((time / self.step_s).astype(np.int64), 0, self.knots - 2)
        into = time / self.step_s - knot
        warm = np.zeros(len(rows)) if self.decay_s is None else np.exp(-time / self.decay_s)
        columns, entries = [count + self.tags + self.kind], [np.ones(len(rows))]
        for tag, sign in ((plus[rows], 1), (minus[rows], -1)):
            columns += [tag * self.knots + knot, tag * self.knots + knot + 1, count + tag]
            entries += [sign * (1 - into), sign * into, sign * warm]
        place = (np.tile(np.arange(len(rows)), len(columns)), np.concatenate(columns))
        self.design = csr_array((np.concatenate(entries), place), shape=(len(rows), count + self.tags + 2))

    def _update(self) -> None:
        """Find the most likely unknowns and their covariance, then the noises and walks expected with them."""
        # Readings five standard deviations off are left out.
        kept = np.abs(self.left) < 5 * self.noise[self.kind]
        parts = [np.flatnonzero(kept & (self.kind == k)) for k in (0, 1)]
        grams = [(self.design[rows].T @ self.design[rows]).toarray() for rows in parts]
        sides = [self.design[rows].T @ self.value[rows] for rows in parts]
        normal = self._prior() + sum(gram / noise**2 for gram, noise in zip(grams, self.noise, strict=True))
        self.covariance = np.linalg.inv(normal)
        self.found = self.covariance @ sum(side / noise**2 for side, noise in zip(sides, self.noise, strict=True))
        self.left = self.value - self.design @ self.found
        for k, (rows, gram) in enumerate(zip(parts, grams, strict=True)):
            if len(rows):
                # Their scatter, and what the model leaves open.
                self.noise[k] = np.sqrt((np.sum(self.left[rows] ** 2) + np.sum(gram * self.covariance)) / len(rows))
        self.walk = self._walks()

    def _prior(self) -> Floats:
        knots, tags = self.knots, self.tags
        difference = np.diff(np.eye(knots), axis=0)
        stiffness = difference.T @ difference / self.step_s
        warm = np.full(tags, 1e12 if self.decay_s is None else 5.0**-2)  # clocks run some 5 ppm faster at first
        # A bias that no reading determines is zero.
        prior = block_diag(*[stiffness / walk**2 for walk in self.walk], np.diag(warm), 1e-6 * np.eye(2))
        # The mean of the rates at the start is zero, tightly.
        start = np.arange(tags) * knots
        prior[np.ix_(start, start)] += 1e6
        return np.asarray(prior)

    def _walks(self) -> Floats:
        """Return the deviations of the walks that expected steps have, each clock's with one of the average's."""
        count = self.tags * self.knots
        rates = self.found[:count].reshape(self.tags, self.knots)
        own = self.covariance[:count, :count].reshape(self.tags, self.knots, self.tags, self.knots)
        own = np.einsum("tktl->tkl", own)
        spread, beside = np.diagonal(own, axis1=1, axis2=2), np.diagonal(own, 1, axis1=1, axis2=2)
        steps = np.diff(rates) ** 2 + spread[:, 1:] + spread[:, :-1] - 2 * beside
        variance = steps.sum(axis=1)
        return np.asarray(np.sqrt((variance + steps.mean()) / self.knots / self.step_s))

    def warmed_up(self) -> float:
        """Return the largest warm-up of a clock, less the median of all, in units of what its walk does meanwhile."""
        warm = self.found[self.tags * self.knots : -2]
        return float(np.max(np.abs(warm - np.median(warm)) / (self.walk * np.sqrt(self.decay_s or 1.0))))

    def result(self) -> ClockFit:
        """Return what was found."""
        count, ratio = self.tags * self.knots, np.full(len(self.flight), np.nan)
        ratios = np.flatnonzero(self.kind == 0)
        # The rates follow the ratios a little; what is left is scaled to the noise that is most likely.
        left, noise = self.left[ratios], self.noise[0]
        inside = left[np.abs(left) < 5 * noise]
        ratio[np.isfinite(self.flight.ratio_ppm)] = left * noise / np.sqrt(np.mean(inside**2)) if len(left) else left
        # A ratio has the noise of two receptions of the same tag, over dt53.
        span_s = intervals(self.flight.exchanges).dt53 * TICK_S
        return ClockFit(
            skew_ppm=self.found[: count : self.knots],
            skew_error_ppm=np.sqrt(np.diag(self.covariance)[: count : self.knots]),
            walk_ppm_per_sqrt_s=self.walk,
            warm_up_ppm=self.found[count:-2],
            warm_up_s=self.decay_s,
            noise_ppm=self.noise,
            bias_ppm=self.found[-2:],
            receive_noise_s=np.asarray(ratio * 1e-6 * span_s / np.sqrt(2)),
        )
