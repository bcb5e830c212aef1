"""Models of ranges that filters assume: what each measures, with which errors, and averages over several models."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.evaluation.filters import GaussianFilters
from calib.online import FIXED_DELAYS, DelayStates, RangeErrors, Reflections, WeighedInnovation, gated_update
from uwblink.arrays import Bools, Floats, Ints


@dataclass(frozen=True, slots=True)
class FilterRanges:
    """What a filter measures (n,), the standard deviation of each measurement's own error, and its error model, if any.

    Ranges of a pair share an error with a standard deviation of `shared_m`, which lasts for `lasting_s`: (n, k) by the
    distances in a measurement, with their signs. Reflections last for `renewal_s` (`calib.online.Reflections`).
    Distances between a pair of tags are off by a constant with a standard deviation of `offset_m`. Measurements of an
    exchange share an error of `common_m` (n,). Where delays are states, `delay_slopes` (n, tags) are the derivatives by
    them. What counts is the average over a model and as many `rivals` before it (`ModelAverage`); a model that is not
    `shown` is only a rival.
    """

    measured_m: Floats
    std_m: Floats
    common_m: Floats
    shared_m: Floats
    lasting_s: float = np.inf
    renewal_s: float = 0.0
    offset_m: float = 0.0
    errors: RangeErrors | None = None
    delays: DelayStates = FIXED_DELAYS
    delay_slopes: Floats | None = None
    rivals: int = 0
    shown: bool = True

    def at(self, rows: Ints) -> FilterRanges:
        """Return some measurements."""
        names = ("measured_m", "std_m", "common_m", "shared_m", "delay_slopes")
        some = {name: x[rows] for name in names if (x := getattr(self, name)) is not None}
        return replace(self, **some, errors=None if self.errors is None else self.errors.at(rows))


class Weighing:
    """Updates of filters (filters, ...) by measurements (n,): by a gate, or by the error model, with reflections that
    last.

    Filters with an error model have the same, that of a calibration.
    """

    def __init__(self, known: Sequence[FilterRanges], gate: float, shape: tuple[int, ...]) -> None:
        """Begin with nothing known of reflections of filters and pairs (filters, *shape)."""
        self.robust = [f for f, one in enumerate(known) if one.errors is not None]
        self.gate, first = gate, known[self.robust[0]] if self.robust else known[0]
        self.errors = first.errors
        self.reflections = Reflections(first.renewal_s, (len(self.robust), *shape))

    def update(self, row: int, pair: Ints, used: Bools, innovation_m: Floats, variance_m2: Floats) -> WeighedInnovation:
        """Return the updates by measurement `row` between pairs (k,), which some filters (filters, ...) have `used`."""
        update, robust = gated_update(innovation_m, variance_m2, self.gate), self.robust
        if self.errors is not None:
            given = innovation_m[robust], variance_m2[robust], self.errors.at(row), pair, used[robust]
            own = self.reflections.weigh(*given)
            for name in ("noise_m", "variance_m2", "believed", "tail", "log_density"):
                getattr(update, name)[robust] = getattr(own, name)
        return update

    def forget(self, lost: tuple[int, ...]) -> None:
        """Forget what a filter that begins anew knew of reflections."""
        if lost[0] in self.robust:
            self.reflections.lasting[self.robust.index(lost[0]), *lost[1:]] = 0.0


def side_by_side(filters: Sequence[FilterRanges]) -> Iterator[Floats]:
    """Yield what filters measure, the standard deviations of own errors and of those of an exchange (n, filters), and
    of errors that pairs share (n, filters, k), and derivatives by states of delays (n, filters, tags)."""
    for name in ("measured_m", "std_m", "common_m", "shared_m"):
        yield np.stack([getattr(one, name) for one in filters], axis=1)
    fixed = np.zeros((len(filters[0].measured_m), len(delay_states(filters).tags)))
    yield np.stack([fixed if one.delay_slopes is None else one.delay_slopes for one in filters], axis=1)


def delay_states(filters: Sequence[FilterRanges]) -> DelayStates:
    """Return the states of delays that some of the filters have, of no tag where none has any."""
    return next((one.delays for one in filters if one.delays.tags), FIXED_DELAYS)


LEAST_ODDS: Final = 1e-3
"""Least probability of a model over that of the likeliest, so that delays may begin to drift late in a flight."""


class ModelAverage:
    """Averages over filters and their rivals by probability: one for each filter that is `shown`.

    Probabilities follow from the densities of innovations, and are equal before (Bar-Shalom, Li and Kirubarajan 2001,
    section 11.6.2). Arrays of filters are (filters, ...), averages (shown, ...).
    """

    def __init__(self, known: Sequence[FilterRanges], shape: tuple[int, ...] = ()) -> None:
        """Begin with no innovation of filters (filters, *shape)."""
        self.shown = [f for f, one in enumerate(known) if one.shown]
        rivals = np.array([[0 <= f - k <= known[f].rivals for k in range(len(known))] for f in self.shown])
        self.least = np.where(rivals, np.log(LEAST_ODDS), -np.inf).reshape(*rivals.shape, *(1 for _ in shape))
        self.log_odds = np.broadcast_to(np.where(np.isinf(self.least), -np.inf, 0.0), (*rivals.shape, *shape))
        self.drifting = np.array([len(one.delays.tags) > 0 for one in known])
        self.offset = np.array([one.offset_m > 0 for one in known])
        self.learn(np.zeros((len(known), *shape)))

    def learn(self, log_density: Floats) -> None:
        """Learn from the densities of innovations (filters, ...)."""
        log_odds = self.log_odds + log_density
        self.log_odds = np.maximum(log_odds - log_odds.max(axis=1, keepdims=True), self.least)
        odds = np.exp(self.log_odds)
        self.weights = odds / odds.sum(axis=1, keepdims=True)

    def mean(self, values: Floats | Bools) -> Floats:
        """Return averages of values (filters, ...), or of one for each filter (filters,)."""
        return np.asarray(np.einsum("gf...,f...->g...", self.weights, values))

    def moments(self, state: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """Return means (shown, ..., n) and covariances (shown, ..., n, n) of states with covariances.

        States are (filters, ..., n), or (shown, filters, ..., n) where they differ by average.
        """
        state = state if state.ndim > covariance.ndim - 1 else state[None]
        mean = np.einsum(
            "gf...,gf...n->g...n", self.weights, np.broadcast_to(state, (len(self.shown), *state.shape[1:]))
        )
        away = state - mean[:, None]
        within = np.einsum("gf...,f...nm->g...nm", self.weights, covariance)
        return mean, within + np.einsum("gf...,gf...n,gf...m->g...nm", self.weights, away, away)

    def delays(self, running: GaussianFilters) -> tuple[Floats, Floats]:
        """Return means and covariances of the changes of delays, which are zero in filters with fixed delays."""
        which, own = running.changes, self.drifting.reshape(-1, *(1 for _ in running.state.shape[1:]))
        fixed = np.broadcast_to(running.delays.covariance_m2, running.covariance[..., which, which].shape)
        covariance = np.where(own[..., None], running.covariance[..., which, which], fixed)
        return self.moments(np.where(own, running.state[..., which], 0.0), covariance)
