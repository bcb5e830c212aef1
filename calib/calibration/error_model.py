"""The error model of corrected ranges, by pair and power: direct ranges, reflections, outliers.

An error is noise about `location_m`; with a probability of `tail_share` it also contains a detour, the sum of a least
one and an exponential one of one of two kinds; rarely it is an outlier. Noise and share are stated at some lifted
powers, and interpolated linearly as logarithm and log odds. Each pair has factors on noise, odds and detour; an unknown
pair has the common values.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from scipy.special import log_ndtr, ndtr

from calib.calibration.document import Metres, Number, OpenShare, PairName, Positive, Share, StdM, joint
from calib.calibration.lasting import LastingErrors
from calib.calibration.power_curves import Curve
from calib.errors import BadInputError
from calib.range_errors.densities import ROOT_2PI, LongDetours, densities
from uwblink.arrays import Floats, Ints


@dataclass(frozen=True, slots=True)
class PairErrors:
    """Factors of a pair of tags on the common noise, odds of a reflection, and mean exponential detour."""

    noise: Positive
    odds: Positive
    detour: Positive


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorShapes:
    """Parameters of each range (n,): noise, share of reflections, mean of their exponential detour, in metres."""

    noise_m: Floats
    tail_share: Floats
    detour_m: Floats


@dataclass(frozen=True, kw_only=True)
class ErrorModel:
    """Core, tail and outliers of the errors of corrected ranges, metres and shares of 1.

    `noise_m` and `tail_share` are those at `lifted` powers, for a pair that is not among `pairs` (named
    "smaller-larger"). `levels` are shares of errors and the model's levels that these were found below while fitting:
    what makes quantiles hold where the shape does not. `scale` does so for the total standard deviation. `detour_m` is
    the mean of both kinds of exponential detour; `long_share` of the reflections are `long_factor` times as long as the
    others. Without one there is one kind, as in calibrations of uwbcal up to 0.2.0. Of the noise `between_m` is what
    stays in the ranges of a pair for a recording, or a spell of it, and changes by the next; the uncertainty of delays
    and curve is in the noise, too.
    `lasting` says how long errors within the gate of a filter last; None where that is not known.
    """

    lifted: tuple[Number, ...]
    noise_m: tuple[Positive, ...]
    tail_share: tuple[OpenShare, ...]
    least_m: StdM
    detour_m: StdM
    outlier_share: Share
    outlier_m: StdM
    location_m: Metres = 0.0
    scale: Positive = 1.0
    levels: tuple[tuple[Share, Share], ...] = ()
    long_share: Share = 0.0
    long_factor: Positive = 1.0
    between_m: StdM = 0.0
    pairs: dict[PairName, PairErrors] = field(default_factory=dict)
    lasting: LastingErrors | None = None

    def between(self, between_m: float, correction_m: Floats | float = 0.0) -> ErrorModel:
        """Return the model for other recordings, in which pairs differ by `between_m`.

        `correction_m` (nodes,) are standard deviations of the correction at the powers `lifted`: with few ranges,
        delays and curve are uncertain, and corrected ranges share that error.
        """
        noise_m = tuple(np.hypot(np.hypot(self.noise_m, between_m), correction_m).tolist())
        return replace(self, noise_m=noise_m, between_m=between_m)

    @property
    def long(self) -> LongDetours:
        """Return the second kind of detour."""
        return LongDetours(share=self.long_share, factor=self.long_factor)

    def square_m2(self, detour_m: Any) -> Any:
        """Return the mean square of detours whose exponential part has such a mean."""
        return self.least_m**2 + 2 * self.least_m * detour_m + 2 * self.long.square * detour_m**2

    def shapes(self, lifted: Floats, initiator: Ints, target: Ints) -> ErrorShapes:
        """Return the shape of the errors of ranges (n,) at lifted powers between two tags, in either direction."""
        return self._shapes(lifted, self._factors[self._rows(initiator, target)])

    def _shapes(self, lifted: Floats, factors: Floats) -> ErrorShapes:
        """Return shapes at lifted powers (n,), from logarithms of factors (n, 3)."""
        nodes, share = np.array(self.lifted), np.array(self.tail_share)
        log_odds = np.interp(lifted, nodes, np.log(share / (1 - share))) + factors[:, 1]
        return ErrorShapes(
            noise_m=np.exp(np.interp(lifted, nodes, np.log(self.noise_m)) + factors[:, 0]),
            tail_share=np.asarray(1 / (1 + np.exp(-log_odds))),
            detour_m=self.detour_m * np.exp(factors[:, 2]),
        )

    def mean_m(self, shapes: ErrorShapes) -> Floats:
        """Return the mean of the errors (n,)."""
        inside = 1 - self.outlier_share
        return np.asarray(self.location_m + inside * shapes.tail_share * (self.least_m + shapes.detour_m))

    def total_m(self, shapes: ErrorShapes) -> Floats:
        """Return the standard deviation of the errors (n,) about their mean, reflections included."""
        inside, share = 1 - self.outlier_share, shapes.tail_share
        detour = self.square_m2(shapes.detour_m)
        square = inside * (shapes.noise_m**2 + share * detour) + self.outlier_share * self.outlier_m**2
        return np.asarray(self.scale * np.sqrt(square - (self.mean_m(shapes) - self.location_m) ** 2))

    def below(self, error_m: Floats, shapes: ErrorShapes) -> Floats:
        """Return the distribution function of errors (n,)."""
        error = error_m - self.location_m
        noise, share = shapes.noise_m, shapes.tail_share
        away = (error - self.least_m) / noise
        reflected = ndtr(away)
        for part, detour in self.long.kinds(shapes.detour_m):
            ratio = noise / detour
            reflected = reflected - part * np.exp(
                np.minimum(ratio * (0.5 * ratio - away) + log_ndtr(away - ratio), 0.0)
            )
        inside = (1 - share) * ndtr(error / noise) + share * reflected
        wild = ndtr(error / max(self.outlier_m, 1e-9))
        return np.asarray((1 - self.outlier_share) * inside + self.outlier_share * wild)

    def quantiles(self, probabilities: Sequence[float], lifted: Floats, initiator: Ints, target: Ints) -> Floats:
        """Return the quantiles (n, k) of errors at shares (k,), for ranges (n,); NaN without a power.

        They are computed at the model's powers for each pair, and interpolated linearly.
        """
        given = np.asarray(probabilities, dtype=np.float64)
        if given.ndim != 1 or not len(given) or not np.all((given > 0) & (given < 1)):
            raise BadInputError(f"found {probabilities!r:.60}, expected shares between 0 and 1", parameter="shares")
        place, count = self._rows(initiator, target), len(self.pairs) + 1
        nodes = np.tile(self.lifted, count)
        tables = self._table(self._own_levels(given), nodes, np.repeat(np.arange(count), len(self.lifted)))
        tables = tables.reshape(count, len(self.lifted), len(given))
        found = np.empty((len(lifted), len(given)))
        for pair in np.unique(place):
            rows = place == pair
            for k in range(len(given)):
                found[rows, k] = np.interp(lifted[rows], self.lifted, tables[pair, :, k])
        found[~np.isfinite(lifted)] = np.nan
        return found

    def tail_given(self, error_m: Floats, shapes: ErrorShapes) -> tuple[Floats, Floats]:
        """Return the probabilities (n,) that ranges with known errors were reflected, and that they are outliers."""
        error, inside = error_m - self.location_m, 1 - self.outlier_share
        found = densities(error, shapes.noise_m, self.least_m, shapes.detour_m, self.long)
        core = inside * (1 - shapes.tail_share) * found.direct
        tail = inside * shapes.tail_share * found.reflected
        wide = max(self.outlier_m, 1e-9)
        wild = self.outlier_share * np.exp(-0.5 * (error / wide) ** 2) / (wide * ROOT_2PI)
        total = core + tail + wild
        # Where all three vanish, only an outlier is possible.
        nothing = total <= 0
        total = np.where(nothing, 1.0, total)
        return np.asarray(tail / total), np.where(nothing, 1.0, wild / total)

    def _table(self, levels: Floats, lifted: Floats, pair: Ints) -> Floats:
        """Return quantiles (m, k) of the uncorrected model at lifted powers of numbered pairs (m,), by bisection."""
        flat = self._shapes(lifted, self._factors[pair])
        shapes = ErrorShapes(
            noise_m=flat.noise_m[:, None], tail_share=flat.tail_share[:, None], detour_m=flat.detour_m[:, None]
        )
        # Quantiles lie within 12 sigmas of noise or outliers and 25 means of the longest detour; 50 halvings of that
        # leave nothing of it.
        reach = 12.0 * (shapes.noise_m + self.outlier_m)
        low = np.broadcast_to(self.location_m - reach, (len(pair), len(levels))).copy()
        high = low + 2 * reach + self.least_m + 25.0 * self.long.longest * shapes.detour_m
        for _ in range(50):
            middle = (low + high) / 2
            above = self.below(middle, shapes) > levels
            high, low = np.where(above, middle, high), np.where(above, low, middle)
        return np.asarray((low + high) / 2)

    def _own_levels(self, probabilities: Floats) -> Floats:
        """Return the levels of the uncorrected model for shares of errors."""
        if not self.levels:
            return probabilities
        found, own = np.array(self.levels).T
        return np.asarray(np.interp(probabilities, [0.0, *found, 1.0], [0.0, *own, 1.0]))

    @cached_property
    def _factors(self) -> Floats:
        """Logarithms of each pair's factors (pairs + 1, 3); the last row is that of an unknown pair."""
        rows = [[pair.noise, pair.odds, pair.detour] for pair in self.pairs.values()]
        return np.log([*rows, [1.0, 1.0, 1.0]])

    @cached_property
    def _codes(self) -> tuple[Ints, Ints]:
        """Return pairs as sorted numbers, and the row of the factors of each."""
        ends = np.array([[int(end) for end in name.split("-")] for name in self.pairs], dtype=np.int64).reshape(-1, 2)
        codes = ends.min(axis=1, initial=2**31) << 32 | ends.max(axis=1, initial=0)
        order = np.argsort(codes)
        return codes[order], order

    def _rows(self, initiator: Ints, target: Ints) -> Ints:
        """Return the row of `_factors` of ranges (n,)."""
        codes, order = self._codes
        asked = np.minimum(initiator, target).astype(np.int64) << 32 | np.maximum(initiator, target).astype(np.int64)
        place = np.searchsorted(codes, asked)
        known = place < len(codes)
        known[known] = codes[place[known]] == asked[known]
        found = np.full(len(asked), len(codes), dtype=np.int64)
        found[known] = order[place[known]]
        return found


def _mistake(model: ErrorModel) -> str:
    sizes = len(model.lifted) == len(model.noise_m) == len(model.tail_share) > 1
    good = sizes and all(one < two for one, two in pairwise(model.lifted))
    return "" if good else "lifted: expected ascending powers, with as many noises and shares"


CheckedErrors = Annotated[ErrorModel, joint(_mistake)]


class ErrorsAtOnce:
    """Total standard deviation and share of reflections of single ranges, in plain Python; equal to `ErrorModel`.

    Between powers the total is computed from interpolated noise and odds.
    """

    def __init__(self, model: ErrorModel, bias_curve: Curve) -> None:
        """Prepare the tables; outside the range of the bias curve the total increases."""
        self._model, self._low, self._high = model, *bias_curve.range
        slopes = bias_curve.beyond(np.array([self._low - 1, self._high + 1]))
        self._below, self._above = slopes.tolist()
        share = np.array(model.tail_share)
        self._square_m2 = model.square_m2
        self._nodes = list(model.lifted)
        self._rows = list(zip(np.log(model.noise_m).tolist(), np.log(share / (1 - share)).tolist(), strict=True))
        self._pairs = {}
        for name, pair in model.pairs.items():
            one, two = (int(end) for end in name.split("-"))
            logs = (math.log(pair.noise), math.log(pair.odds), model.detour_m * pair.detour)
            self._pairs[one, two] = self._pairs[two, one] = logs

    def __call__(self, lifted: float, initiator: int, target: int) -> tuple[float, float]:
        """Return the total standard deviation in metres, and the share of reflections."""
        model = self._model
        noise, odds, detour = self._pairs.get((initiator, target), (0.0, 0.0, model.detour_m))
        one, two = self._at(lifted)
        noise, share = math.exp(noise + one), 1 / (1 + math.exp(-odds - two))
        inside = 1 - model.outlier_share
        square = noise * noise + share * self._square_m2(detour)
        mean = inside * share * (model.least_m + detour)
        total = model.scale**2 * (inside * square + model.outlier_share * model.outlier_m**2 - mean * mean)
        away = self._below * max(self._low - lifted, 0.0) + self._above * max(lifted - self._high, 0.0)
        return math.sqrt(total + away * away), share

    def _at(self, lifted: float) -> tuple[float, float]:
        """Return logarithm of noise and log odds at a lifted power, straight between the model's."""
        nodes = self._nodes
        k = bisect_right(nodes, lifted)
        if k in (0, len(nodes)):
            return self._rows[max(k - 1, 0)]
        part = (lifted - nodes[k - 1]) / (nodes[k] - nodes[k - 1])
        (a, b), (c, d) = self._rows[k - 1 : k + 1]
        return a + part * (c - a), b + part * (d - b)
