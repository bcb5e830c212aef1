"""Models of ranges that filters assume: measurements with their errors, and averages over several models."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from calib.evaluation.filters import GaussianFilters
from calib.online import FIXED_DELAYS, DelayStates, RangeErrors, Reflections, WeighedInnovation, gated_update
from uwblink.arrays import ArrayRows, Bools, Floats, Ints


@dataclass(frozen=True, slots=True)
class FilterRanges(ArrayRows):
    """The measurements (n,) of a filter, the standard deviation of each one's independent error, and its error model,
    if any.

    Ranges of a pair share an error that lasts for `lasting_s`, with a standard deviation of `shared_m` (n, k): by the
    distances in a measurement, with their signs. Reflections last for `renewal_s` (`calib.online.Reflections`).
    Distances between a pair of tags are off by a constant with a standard deviation of `offset_m`. Measurements of an
    exchange share an error of `common_m` (n,). Where delays are states, `delay_slopes` (n, tags) are the derivatives by
    them. The result is the average over a model and the `rivals` models before it (`ModelAverage`); a model that is not
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
        return replace(self[rows], errors=None if self.errors is None else self.errors.at(rows))


def side_by_side(filters: Sequence[FilterRanges]) -> Iterator[Floats]:
    """Yield the measurements of filters, the standard deviations of independent errors and of common errors of an
    exchange (n, filters), of errors that pairs share (n, filters, k), and derivatives by states of delays (n, filters,
    tags)."""
    for name in ("measured_m", "std_m", "common_m", "shared_m"):
        yield np.stack([getattr(one, name) for one in filters], axis=1)
    fixed = np.zeros((len(filters[0].measured_m), len(delay_states(filters).tags)))
    yield np.stack([fixed if one.delay_slopes is None else one.delay_slopes for one in filters], axis=1)


def delay_states(filters: Sequence[FilterRanges]) -> DelayStates:
    """Return the states of delays of the filters that have some; states without tags if none has."""
    return next((one.delays for one in filters if one.delays.tags), FIXED_DELAYS)


class ModelAverage:
    """Averages over filters and their rivals by probability: one for each filter that is `shown`.

    Probabilities follow from the densities of innovations, and are equal at first (Bar-Shalom, Li and Kirubarajan 2001,
    section 11.6.2). Arrays of filters are (filters, ...), averages (shown, ...).
    """

    def __init__(self, known: Sequence[FilterRanges], shape: tuple[int, ...] = ()) -> None:
        """Begin without innovations of filters (filters, *shape)."""
        self.shown = [f for f, one in enumerate(known) if one.shown]
        rivals = np.array([[0 <= f - k <= known[f].rivals for k in range(len(known))] for f in self.shown])
        # No model is a thousand times less probable than another, so that delays may begin to drift late in a flight.
        self.least = np.where(rivals, -np.log(1000.0), -np.inf).reshape(*rivals.shape, *(1 for _ in shape))
        self.log_odds = np.broadcast_to(np.where(np.isinf(self.least), -np.inf, 0.0), (*rivals.shape, *shape))
        self.drifting = np.array([len(one.delays.tags) > 0 for one in known])
        self.offset = np.array([one.offset_m > 0 for one in known])
        self.learn(np.zeros((len(known), *shape)))

    def learn(self, log_density: Floats) -> None:
        """Update probabilities with the densities of innovations (filters, ...)."""
        log_odds = self.log_odds + log_density
        self.log_odds = np.maximum(log_odds - log_odds.max(axis=1, keepdims=True), self.least)
        odds = np.exp(self.log_odds)
        self.weights = odds / odds.sum(axis=1, keepdims=True)

    def mean(self, values: Floats | Bools) -> Floats:
        """Return averages of values (filters, ...), or of one for each filter (filters,)."""
        return np.asarray(np.einsum("gf...,f...->g...", self.weights, values))

    def moments(self, state: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """Return means (shown, ..., n) and covariances (shown, ..., n, n) of states with covariances.

        States are (filters, ..., n), or (shown, filters, ..., n) if they differ by average.
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


class FilterBank:
    """Filters with the same measurements (n,), their shared errors, and their averages.

    A measurement is a sum of distances between pairs of tags, numbered by `pair` (n, k), with signs (n, k); `uses` (n,
    filters) are the measurements that each filter uses. They update by a gate, or by an error model with reflections
    that last. To the states of the filters `running` (filters, ...) are appended: `errors` in units of their standard
    deviation, of each pair and then of an exchange; `constants` of pairs, if a filter has any; and delays. `slopes` are
    the derivatives by delays, `measured` is (n, filters, ...).
    """

    def __init__(
        self,
        known: Sequence[FilterRanges],
        running: GaussianFilters,
        gate: float,
        uses: Bools,
        pair: Ints,
        sign: Floats,
    ) -> None:
        """Begin without information on errors."""
        self.known, self.running, self.pair, self.sign = known, running, pair, sign
        shape, pairs = running.state.shape[1:-1], int(pair.max()) + 1
        measured, std, common, shared, slopes = side_by_side(known)
        around = (..., *(None for _ in shape))
        self.measured, self.variance, self.uses = (
            np.broadcast_to(one[around], (*one.shape, *shape)) for one in (measured, std**2, uses)
        )
        self.common, self.shared = common[around], shared[around]
        self.slopes = np.expand_dims(slopes, tuple(range(2, 2 + len(shape))))
        self.lasting_s, self.offset_m = (
            np.array([getattr(one, name) for one in known])[around] for name in ("lasting_s", "offset_m")
        )
        self.of_pair = np.arange(pairs + 1) < pairs
        self.errors = running.append(np.eye(pairs + 1))
        self.constants = running.append(np.eye(pairs if self.offset_m.any() else 0))
        running.append_delays(delay_states(known))
        # All filters with an error model have the calibration's.
        self.gate, self.average = gate, ModelAverage(known, shape)
        self.robust = [f for f, one in enumerate(known) if one.errors is not None]
        first = known[self.robust[0]] if self.robust else known[0]
        self.error_model = first.errors
        self.reflections = Reflections(first.renewal_s, (len(self.robust), *shape, pairs))
        self.judged = np.empty((4, len(uses), len(self.average.shown), *shape))

    def observe(self, row: int, slopes: Floats, expected: Floats) -> WeighedInnovation:
        """Update the filters that use measurement `row`; return the updates of all.

        `expected` (filters, ...) is the expected measurement without shared errors, with derivatives `slopes` (filters,
        ..., states), to which those by shared errors, constants and delays are added.
        """
        for which, pair in enumerate(self.pair[row].tolist()):
            slopes[..., self.errors.start + pair] += self.shared[row, :, which]
            if self.constants.start < self.constants.stop:
                slopes[..., self.constants.start + pair] += self.sign[row, which] * self.offset_m
        slopes[..., self.errors.stop - 1] = self.common[row]
        slopes[..., self.running.changes] = self.slopes[row]
        used, innovation = self.uses[row], self.measured[row] - expected
        weigh = partial(self._weigh, row)
        update = self.running.update(slopes * used[..., None], innovation, self.variance[row], weigh)
        self.average.learn(np.where(used, update.log_density, 0.0))
        values = update.nis, update.accepted, self.average.offset, self.average.drifting
        self.judged[:, row] = [self.average.mean(one) for one in values]
        return update

    def _weigh(self, row: int, innovation_m: Floats, variance_m2: Floats) -> WeighedInnovation:
        """Weigh innovations (filters, ...) by the gate, or by the error model."""
        update, robust = gated_update(innovation_m, variance_m2, self.gate), self.robust
        if self.error_model is not None:
            used, pair, errors = self.uses[row][robust], self.pair[row], self.error_model.at(row)
            own = self.reflections.weigh(innovation_m[robust], variance_m2[robust], errors, pair, used)
            for name in ("noise_m", "variance_m2", "accepted", "tail", "log_density"):
                getattr(update, name)[robust] = getattr(own, name)
        return update

    def pass_time(self, dt: float, *, same_exchange: bool) -> None:
        """Let errors of pairs and the memory of reflections decay, and delays drift, for `dt` seconds.

        Unless the next measurement is of the same exchange, it has another error of the exchange.
        """
        kept = np.where(self.of_pair, np.exp(-dt / self.lasting_s)[..., None], float(same_exchange))
        self.running.decay(self.errors, kept)
        self.running.wander(dt)
        self.reflections.decay(dt)

    def forget_reflections(self, lost: tuple[int, ...]) -> None:
        """Forget the reflections of a filter that restarts."""
        if lost[0] in self.robust:
            self.reflections.lasting[self.robust.index(lost[0]), *lost[1:]] = 0.0

    def outcome(self, *which: Any) -> dict[str, Any]:
        """Return fields of the `Track` of one average: for the measurements that it uses, and delays at the end."""
        f, (changes_m, covariance) = self.average.shown[which[0]], self.average.delays(self.running)
        nis, accepted, offsets, drifts = self.judged[:, self.uses[(slice(None), f, *which[1:])]][(..., *which)]
        states = self.known[f].delays
        return {
            "nis": nis,
            "accepted": accepted > 0.5,
            "offsets": offsets,
            "drifts": drifts,
            "delays": states.estimates(changes_m[which], covariance[which]) if states.tags else {},
        }
