"""Rates of the clocks of all tags over time, from ratios of stamps and carrier readings of all pairs.

The model is linear and Gaussian: the rate of each clock is a random walk between knots; each ratio dt64/dt53 and each
carrier reading is the difference of two rates plus noise. The standard deviations of walks and noise maximise the
likelihood, by the EM algorithm (Shumway and Stoffer 1982; they use a Kalman smoother, here one system of equations is
solved).
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
    """Fitted clocks: rates at the start in ppm, and random walks in ppm per root of a second, (tags,) each.

    At first, clocks run faster by `warm_up_ppm` (tags,), which decays with the time constant `warm_up_s`, None if no
    warm-up was fitted. The mean of all rates at the start, without the warm-up, is zero by convention, because a
    recording does not determine true time. `noise_ppm` and `bias_ppm` (2,) are those of ratios and of carrier readings.
    `receive_noise_s` (n,) are the residuals of the ratios, converted to noise of a single receive stamp; NaN without a
    ratio.
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
    """Fit the clocks of a flight; with a warm-up if random walks would be large without it."""
    found = _ClockSearch(flight, None)
    span = float(flight.time_s[-1])
    # A clock that walks further than 0.15 ppm over a flight may be warming up.
    if np.max(found.walk) * np.sqrt(span) > 0.15:
        tries = [_ClockSearch(flight, decay) for decay in (10.0, 25.0, 60.0) if decay < 2 * span]
        best = min(tries, key=lambda one: float(np.sum(np.log(one.walk))), default=found)
        # The log likelihood of a walk contains -(knots - 1) log(walk). It must grow by 3 per clock (a judgement).
        gain = float(np.sum(np.log(found.walk / best.walk))) * (best.knots - 1)
        if gain > 3 * len(flight.tags) and best.warm_up_ratio() > 3:
            found = best
    return found.result()


class _ClockSearch:
    """The EM algorithm for clocks with a warm-up of the time constant `decay_s`, or without (None).

    The unknowns are the rates of all clocks at the knots, the warm-up of each, and the biases of both kinds of
    measurement: 0 are ratios, 1 carrier readings.
    """

    def __init__(self, flight: TwinFlight, decay_s: float | None) -> None:
        self.tags, span = len(flight.tags), max(float(flight.time_s[-1]), 1e-3)
        self.flight, self.decay_s = flight, decay_s
        # Knots are at least half a second apart; at most 300 rates are unknown.
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
        """Set `value` (m,), ratios and carrier readings in ppm, `kind` (m,), 0 or 1, and `design` (m, unknowns).

        A carrier reading at the target is positive if the target's clock is faster. Rates are linear between knots,
        plus the warm-up.
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
        """Compute the posterior of the unknowns (E step), then the standard deviations of noise and walks (M step)."""
        # Leave out measurements more than five standard deviations off.
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
                # Expected square of the noise: square of the residual plus the variance of the fitted value.
                self.noise[k] = np.sqrt((np.sum(self.left[rows] ** 2) + np.sum(gram * self.covariance)) / len(rows))
        self.walk = self._walks()

    def _prior(self) -> Floats:
        knots, tags = self.knots, self.tags
        difference = np.diff(np.eye(knots), axis=0)
        stiffness = difference.T @ difference / self.step_s
        # Prior standard deviation of the warm-up: 5 ppm (a judgement); without a warm-up it is fixed to zero.
        warm = np.full(tags, 1e12 if self.decay_s is None else 5.0**-2)
        # The weak prior of the biases makes one zero that no measurement determines.
        prior = block_diag(*[stiffness / walk**2 for walk in self.walk], np.diag(warm), 1e-6 * np.eye(2))
        # Fix the mean of the rates at the start to zero.
        start = np.arange(tags) * knots
        prior[np.ix_(start, start)] += 1e6
        return np.asarray(prior)

    def _walks(self) -> Floats:
        """Return the standard deviations of the walks (tags,), from the expected squares of their steps.

        Each clock has one more step with the mean square of all clocks, as a weak prior.
        """
        count = self.tags * self.knots
        rates = self.found[:count].reshape(self.tags, self.knots)
        own = self.covariance[:count, :count].reshape(self.tags, self.knots, self.tags, self.knots)
        own = np.einsum("tktl->tkl", own)
        spread, beside = np.diagonal(own, axis1=1, axis2=2), np.diagonal(own, 1, axis1=1, axis2=2)
        steps = np.diff(rates) ** 2 + spread[:, 1:] + spread[:, :-1] - 2 * beside
        variance = steps.sum(axis=1)
        return np.asarray(np.sqrt((variance + steps.mean()) / self.knots / self.step_s))

    def warm_up_ratio(self) -> float:
        """Return the largest warm-up minus the median of all, relative to the clock's walk within the time constant."""
        warm = self.found[self.tags * self.knots : -2]
        return float(np.max(np.abs(warm - np.median(warm)) / (self.walk * np.sqrt(self.decay_s or 1.0))))

    def result(self) -> ClockFit:
        """Return the fitted clocks."""
        count, residual_ppm = self.tags * self.knots, np.full(len(self.flight), np.nan)
        ratios = np.flatnonzero(self.kind == 0)
        # Residuals are smaller than the noise, because the rates follow the ratios: scale them to the noise.
        left, noise = self.left[ratios], self.noise[0]
        inside = left[np.abs(left) < 5 * noise]
        scaled = left * noise / np.sqrt(np.mean(inside**2)) if len(left) else left
        residual_ppm[np.isfinite(self.flight.ratio_ppm)] = scaled
        # A ratio has the noise of two receptions of the same tag, divided by dt53.
        span_s = intervals(self.flight.exchanges).dt53 * TICK_S
        return ClockFit(
            skew_ppm=self.found[: count : self.knots],
            skew_error_ppm=np.sqrt(np.diag(self.covariance)[: count : self.knots]),
            walk_ppm_per_sqrt_s=self.walk,
            warm_up_ppm=self.found[count:-2],
            warm_up_s=self.decay_s,
            noise_ppm=self.noise,
            bias_ppm=self.found[-2:],
            receive_noise_s=np.asarray(residual_ppm * 1e-6 * span_s / np.sqrt(2)),
        )
