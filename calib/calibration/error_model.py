"""The error model of corrected ranges, by pair and power: direct ranges, reflections, outliers.

An error is normal noise about `location_m`. With the probability `tail_share` the range is reflected, and the error
also contains a detour: a constant, `least_m`, plus an exponential part of one of two kinds. With the probability
`outlier_share` it is an outlier instead. Noise and share are given at some lifted powers; the logarithm of the noise
and the log odds of the share are interpolated linearly. Each pair has factors on noise, odds and detour; a pair that
was not fitted has the common values.

Errors of a pair are not independent in time: short reflections, fading and power readings change slowly, so successive
ranges share a part of their errors. A filter that assumes independent errors is overconfident (`LastingErrors`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize.elementwise import find_root
from scipy.special import gammainc, log_ndtr, ndtr

from calib.calibration.document import (
    Metres,
    Number,
    OpenShare,
    PairName,
    Positive,
    Share,
    StdM,
    joint,
    number,
    one_of,
    pair_name,
)
from calib.data.ranges import FEATURES, Ranges
from calib.errors import BadInputError
from calib.pairs import Pairs, pairs_of
from calib.range_errors.densities import ROOT_2PI, LongDetours, densities
from uwblink.arrays import Floats, Ints

GATE: Final = 10.83
"""99.9 % quantile of chi-square with one degree of freedom. Filters accept innovations whose square over their variance
is below it."""


FeatureName = Annotated[str, one_of(FEATURES)]
LogOdds = Annotated[float, number(-50.0, 50.0, "a logarithm of odds, -50 to 50")]


@dataclass(frozen=True, slots=True)
class LastingErrors:
    """Persistence of the errors of ranges within the gate of a filter, in units of sigma.

    The errors have a `mean`, an independent part with the variance `own_variance`, and a part with the variance
    `lasting_variance` that successive ranges of a pair share, with the correlation time `time_s`. A reflection of a
    pair lasts for `renewal_s` on average; 0 means that reflections of ranges are independent.
    """

    mean: Metres
    own_variance: Positive
    lasting_variance: Positive
    time_s: Positive
    renewal_s: StdM = 0.0


@dataclass(frozen=True, slots=True)
class PairErrors:
    """Factors of a pair of tags on the common noise, the odds of a reflection, and the mean exponential detour."""

    noise: Positive
    odds: Positive
    detour: Positive


@dataclass(frozen=True, slots=True)
class FeatureSlope:
    """Change of the log odds of a reflection per unit of a feature above `centre`, between two `bounds`."""

    log_odds: LogOdds
    centre: Number
    bounds: tuple[Number, Number]


CheckedFeature = Annotated[
    FeatureSlope,
    joint(lambda slope: slope.bounds[0] <= slope.bounds[1], "bounds: expected the lower bound first"),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorShapes:
    """Parameters of each range (n,), or of one: noise, share of reflections, and mean exponential detour, in metres."""

    noise_m: Any
    tail_share: Any
    detour_m: Any


@dataclass(frozen=True, kw_only=True)
class ErrorModel:
    """Error model of corrected ranges: noise, reflections (the tail) and outliers, in metres and shares of 1.

    `noise_m` and `tail_share` are values at `lifted` powers, for a pair that is not in `pairs` (keys such as "1-2", the
    smaller id first). `levels` are pairs of a share of the fitted errors and the model's probability of the same
    quantile; they correct quantiles if the model has another shape than the errors. `scale` corrects the total standard
    deviation. `detour_m` is the mean of both kinds of exponential detour; the share `long_share` of the reflections has
    detours that are `long_factor` times as long as the others on average. With `long_share` 0 there is one kind, as in
    calibrations of uwbcal up to 0.2.0. `between_m` is the part of the noise that is constant for a pair during a
    recording, or a part of it, and differs between recordings; the noise also includes the uncertainty of delays and
    curve. `features` are slopes of the log odds of a reflection. The log odds of a range with a known feature also
    include `known_log_odds`, because `tail_share` is the share of reflections among ranges without features. `lasting`
    is the persistence of errors within the gate of a filter; None if unknown.
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
    features: dict[FeatureName, CheckedFeature] = field(default_factory=dict)
    known_log_odds: LogOdds = 0.0

    def log_odds_of(self, features: NDArray[np.floating]) -> Floats:
        """Return the change of the log odds of a reflection (n,) by `FEATURES` (n, 2) of ranges, 0 if all are unknown.

        If one of two features is unknown, its centre is used.
        """
        found, known = np.zeros(len(features)), np.zeros(len(features), dtype=bool)
        for name, slope in self.features.items():
            values = features[:, FEATURES.index(name)].astype(np.float64)
            known |= np.isfinite(values)
            found += slope.log_odds * (np.clip(np.nan_to_num(values, nan=slope.centre), *slope.bounds) - slope.centre)
        return found + self.known_log_odds * known

    def between(self, between_m: float, correction_m: Floats | float = 0.0) -> ErrorModel:
        """Return the model for ranges of other recordings, with additional noise.

        `between_m` is the standard deviation of a pair's constant error between recordings. `correction_m` (nodes,) are
        the standard deviations of the correction at the powers `lifted`, by the uncertainty of delays and curve. Both
        are equal for all pairs, so the factors of pairs on noise shrink towards 1. The scale is that of the fitted
        errors: the added noise has its own size.
        """
        noise_m = np.hypot(np.hypot(self.noise_m, between_m), correction_m)
        own, added = np.median(self.noise_m), np.hypot(between_m, np.median(correction_m))
        pairs = {
            name: replace(one, noise=float(np.hypot(one.noise * own, added) / np.hypot(own, added)))
            for name, one in self.pairs.items()
        }
        typical = ErrorShapes(noise_m=own, tail_share=np.median(self.tail_share), detour_m=self.detour_m)
        fitted_m = float(self.total_m(typical))
        scale = self.scale * float(np.hypot(fitted_m, added) / np.hypot(fitted_m, self.scale * added))
        return replace(self, noise_m=tuple(noise_m.tolist()), between_m=between_m, pairs=pairs, scale=scale)

    def within_m(self, noise_m: Floats) -> Floats:
        """Return the part of the noise of ranges (n,), in metres, that varies within a recording.

        It is at least a tenth of the noise, because edited calibrations may state less noise than `between_m`.
        """
        return np.sqrt(np.maximum(np.square(noise_m) - self.between_m**2, (0.1 * noise_m) ** 2))

    @property
    def long(self) -> LongDetours:
        """Return the share of the long kind of detour, and the ratio of its mean to that of the other kind."""
        return LongDetours(share=self.long_share, factor=self.long_factor)

    def square_m2(self, detour_m: Any) -> Any:
        """Return the mean square of detours whose exponential part has the mean `detour_m`, in square metres."""
        return self.least_m**2 + 2 * self.least_m * detour_m + 2 * self.long.square * detour_m**2

    def square_below_m2(self, detour_m: Any, below_m: Any) -> Any:
        """Return the mean square of detours, with those longer than `below_m` counted as zero.

        Each kind of detour is `least_m` + x with an exponential x of mean m, so E[x^k; x < b] = k! m^k P(k + 1, b / m)
        with the regularised incomplete gamma function P.
        """
        powers = (1, 2, 3), (self.least_m**2, 2 * self.least_m, 2.0)
        return sum(
            part * factor * mean_m ** (k - 1) * gammainc(k, np.maximum(below_m - self.least_m, 0.0) / mean_m)
            for part, mean_m in self.long.kinds(detour_m)
            for k, factor in zip(*powers, strict=True)
        )

    def shapes(self, lifted: Floats, initiator: Ints, target: Ints, log_odds: Floats | float = 0.0) -> ErrorShapes:
        """Return the parameters of the errors of ranges (n,) at lifted powers between two tags, in either direction.

        `log_odds` (n,) is the change by features (`log_odds_of`).
        """
        pairs = pairs_of(initiator, target)
        return self._shapes(lifted, _with_odds(self._factors_of(pairs)[pairs.number], log_odds))

    def _shapes(self, lifted: Floats, factors: Floats) -> ErrorShapes:
        """Return the parameters at lifted powers (...), given logarithms of the factors of pairs (..., 3)."""
        log_noise, log_odds = self.logarithms
        odds = np.interp(lifted, self.lifted, log_odds) + factors[..., 1]
        return ErrorShapes(
            noise_m=np.exp(np.interp(lifted, self.lifted, log_noise) + factors[..., 0]),
            tail_share=np.asarray(1 / (1 + np.exp(-odds))),
            detour_m=self.detour_m * np.exp(factors[..., 2]),
        )

    @cached_property
    def logarithms(self) -> tuple[Floats, Floats]:
        """Logarithms of the noise in metres, and of the odds of a reflection, at the powers `lifted` (nodes,)."""
        share = np.array(self.tail_share)
        return np.log(self.noise_m), np.log(share / (1 - share))

    def _factors_of(self, pairs: Pairs) -> Floats:
        """Return logarithms of the factors of pairs (pairs, 3) on noise, odds and detour, 0 for pairs not fitted."""
        common = PairErrors(1.0, 1.0, 1.0)
        known = [self.pairs.get(pair_name(ends), common) for ends in pairs.ends.tolist()]
        return np.log([(one.noise, one.odds, one.detour) for one in known]).reshape(-1, 3)

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

    def quantiles(
        self,
        probabilities: Sequence[float],
        lifted: Floats,
        initiator: Ints,
        target: Ints,
        log_odds: Floats | float = 0.0,
    ) -> Floats:
        """Return the quantiles (n, k) of the errors of ranges (n,) at `probabilities` (k,); NaN without a power.

        They are computed for each pair on a grid of the powers `lifted` and of the `log_odds` by features, and
        interpolated linearly. Raises `BadInputError` for probabilities that are not between 0 and 1.
        """
        given = np.asarray(probabilities, dtype=np.float64)
        if given.ndim != 1 or not len(given) or not np.all((given > 0) & (given < 1)):
            raise BadInputError(f"found {probabilities!r:.60}, expected shares between 0 and 1", parameter="shares")
        pairs = pairs_of(initiator, target)
        odds = np.broadcast_to(log_odds, len(lifted))
        low, high = (odds.min(), odds.max()) if len(odds) else (0.0, 0.0)
        # If log odds span 8, odds change by a factor of 1.6 from one of the 17 nodes to the next.
        at_odds = np.linspace(low, high, 17) if high > low else np.array([low, low + 1.0])
        factors = _with_odds(self._factors_of(pairs)[:, None], at_odds)
        tables = self._table(self._own_levels(given), factors.reshape(-1, 3))
        at = np.column_stack([odds, np.clip(lifted, self.lifted[0], self.lifted[-1])])
        found = np.full((len(lifted), len(given)), np.nan)
        for pair, table in enumerate(tables.reshape(len(factors), len(at_odds), len(self.lifted), -1)):
            rows = np.flatnonzero((pairs.number == pair) & np.isfinite(lifted))
            found[rows] = RegularGridInterpolator((at_odds, self.lifted), table)(at[rows])
        return found

    def tail_given(self, error_m: Floats, shapes: ErrorShapes) -> tuple[Floats, Floats]:
        """Return the probabilities (n,) of a reflection and of an outlier, given the errors of ranges (n,)."""
        error, inside = error_m - self.location_m, 1 - self.outlier_share
        found = densities(error, shapes.noise_m, self.least_m, shapes.detour_m, self.long)
        core = inside * (1 - shapes.tail_share) * found.direct
        tail = inside * shapes.tail_share * found.reflected
        wide = max(self.outlier_m, 1e-9)
        wild = self.outlier_share * np.exp(-0.5 * (error / wide) ** 2) / (wide * ROOT_2PI)
        total = core + tail + wild
        # If all three densities underflow to zero, the range is an outlier.
        nothing = total <= 0
        total = np.where(nothing, 1.0, total)
        return np.asarray(tail / total), np.where(nothing, 1.0, wild / total)

    def _table(self, levels: Floats, factors: Floats) -> Floats:
        """Return quantiles (pairs, nodes, k) at `levels` (k,), without the correction by `self.levels`.

        `factors` (pairs, 3) are logarithms of factors; nodes are the powers `lifted`.
        """
        shapes = self._shapes(np.array(self.lifted), factors[:, None, :])
        noise, share, detour = (x[..., None] for x in (shapes.noise_m, shapes.tail_share, shapes.detour_m))

        def difference(error_m: Floats, noise: Floats, share: Floats, detour: Floats, level: Floats) -> Floats:
            return self.below(error_m, ErrorShapes(noise_m=noise, tail_share=share, detour_m=detour)) - level

        # Brackets of the root: probabilities beyond 12 sigma of noise or outliers, or 25 mean detours, are below 1e-10.
        reach = 12.0 * (noise + self.outlier_m)
        high = self.location_m + reach + self.least_m + 25.0 * self.long.longest * detour
        bounds = self.location_m - reach, high
        found = find_root(difference, bounds, args=(noise, share, np.broadcast_to(detour, noise.shape), levels))
        return np.asarray(found.x)

    def _own_levels(self, probabilities: Floats) -> Floats:
        """Return the model's probabilities of quantiles (k,), from the shares of errors below them (k,)."""
        if not self.levels:
            return probabilities
        found, own = np.array(self.levels).T
        return np.asarray(np.interp(probabilities, [0.0, *found, 1.0], [0.0, *own, 1.0]))


def _with_odds(factors: Floats, log_odds: Floats | float) -> Floats:
    """Return logarithms of factors (..., 3) after adding log odds (...)."""
    more = np.zeros((*np.broadcast_shapes(factors.shape[:-1], np.shape(log_odds)), 3))
    more[..., 1] = log_odds
    return np.asarray(factors + more)


def _nodes_fit(model: ErrorModel) -> bool:
    sizes = len(model.lifted) == len(model.noise_m) == len(model.tail_share) > 1
    return sizes and all(one < two for one, two in pairwise(model.lifted))


CheckedErrors = Annotated[
    ErrorModel, joint(_nodes_fit, "lifted: expected ascending powers, with a noise and a share for each")
]


def lasting_errors(ranges: Ranges, z: Floats, share: Floats, reflected: Floats) -> LastingErrors | None:
    """Fit the persistence of the errors of pairs, and of their reflections; None without enough data.

    `z` (n,) are errors divided by sigma, `share` (n,) the probabilities of a reflection before the error is known, and
    `reflected` (n,) those given the error. Let v be the variance of the probabilities and w the remaining variance of
    the true state (1 if reflected, else 0). Then the probabilities of two ranges with the same reflection have the
    covariance v^2 / (v + w) if the shares are right, and more otherwise; this is the lower bound of the fit.
    """
    inside = np.flatnonzero(z**2 < GATE)
    mean, total = float(np.mean(z[inside])), float(np.var(z[inside]))
    found = _persistence(ranges[inside], z[inside] - mean)
    if found is None:
        return None
    lasting = min(max(found[0], 1e-6), 0.99 * total)
    deviation = reflected - share - np.mean(reflected - share)
    known = float(np.mean(deviation**2))
    unknown = float(np.mean(reflected * (1 - reflected)))
    renewal = _persistence(ranges, deviation, known**2 / max(known + unknown, 1e-12))
    return LastingErrors(mean, total - lasting, lasting, found[1], renewal[1] if renewal else 0.0)


def _persistence(ranges: Ranges, values: Floats, least: float = 0.0) -> tuple[float, float] | None:
    """Fit the autocovariance a exp(-lag / time) of values (n,) within pairs and sessions; return a and the time (s).

    The products of values are averaged in bins of the logarithm of the lag; bins with fewer than 50 are left out. a is
    at least `least`. Returns None if no bin is left.
    """
    pairs = ranges.pairs
    pair = ranges.session * np.int64(len(pairs.ends)) + pairs.number
    order = np.lexsort((ranges.time_ns, pair))
    pair, time_s, away = pair[order], ranges.time_ns[order] * 1e-9, values[order]
    # A filter forgets its position within about a second, so the fit must be good at short lags. With lags up to a
    # minute it is worse there: the RMSE of positions in an office increased by 32 %, instead of 0 %.
    longest_s = 2.0
    edges = np.geomspace(0.01, longest_s, 17)
    count, product, lag = np.zeros((3, len(edges) + 1))
    for step in np.unique(np.rint(1.15 ** np.arange(60))).astype(np.int64):
        apart = time_s[step:] - time_s[:-step]
        same = (pair[step:] == pair[:-step]) & (apart < longest_s)
        if not same.any():
            break
        place = np.digitize(apart[same], edges)
        count += np.bincount(place, minlength=len(count))
        product += np.bincount(place, (away[step:] * away[:-step])[same], len(count))
        lag += np.bincount(place, apart[same], len(count))
    full = np.flatnonzero(count[:-1] >= 50)
    if not len(full):
        return None
    covariance, lag = product[full] / count[full], lag[full] / count[full]
    times = np.geomspace(0.02, longest_s, 60)
    shapes = np.exp(-lag / times[:, None])
    size = np.maximum(shapes @ covariance / np.sum(shapes**2, axis=1), least)
    best = int(np.argmin(np.sum((size[:, None] * shapes - covariance) ** 2, axis=1)))
    return float(size[best]), float(times[best])
