"""A calibration from a fit: delays, curves, their uncertainty, and the error model of future ranges.

Reflections last, so the share of reflections of a pair in one recording predicts its share in another with less
certainty than for independent ranges. The loss of information is estimated from sums of slopes over blocks of time.
Parameters of pairs are shrunk to their common value accordingly, and the remaining uncertainty of a share enters the
predicted share.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import expit

from calib.calibration.error_model import ErrorModel, PairErrors
from calib.calibration.model import Calibration, PairOffset, TagGroup, Uncertainty, matrix_of
from calib.calibration.patterns import HARMONICS, Pattern, TemperatureSlope
from calib.calibration.power_curves import DEGREE, SIGMA_FLOOR_M, Curve, basis, flat_curve
from calib.estimator.covariates import COMMON, OF_PLACES, OWN, OWN_WARMTH, WARMTH
from calib.estimator.grouped_errors import ReflectionFeatures
from calib.estimator.known_distances import LARGEST_SPREAD_M, DescribedErrors, RangeFit, described_errors
from calib.estimator.range_model import (
    METRES_A_NS,
    OFFSET_OF_BODIES,
    OFFSET_OF_PAIR,
    OFFSETS,
    TYPICAL_OFFSET_M,
    RangeModel,
)
from calib.estimator.range_rows import RESIDUAL
from calib.estimator.time_blocks import TimeBlocks, lasting_in_pairs
from calib.range_errors.densities import LONG_FACTOR, LongDetours
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints
from uwblink.recording.antenna_delays import known_delays
from uwblink.ticks import SPEED_OF_LIGHT

NODES = 8
"""Number of powers at which noise and share are stated, twice the segments of the curve of noise; both are linear
between them."""

QUANTILE_SHARES = (0.005, 0.025, 0.05, 0.16, 0.5, 0.84, 0.95, 0.975, 0.995)
"""Shares of errors at which the model's quantiles are corrected."""

BEYOND_MEANS = 8.0
"""Errors longer than so many means of the longer detours are excluded from the total sigma. An exponential distribution
has 0.03 % of its values beyond; they are 1.4 % of its mean square."""

WIDEST_ODDS, WIDEST_DETOUR = 4.0, 1.0
"""Variances of a pair's log odds and log detour: two in three pairs between an eighth and eight times the common odds,
a third and three times the common detour. The uncertainty after a few lasting reflections is larger than the variation
in any room."""


SPELLS = 8
"""Number of spells of a recording that are compared: over the 28 pairs of eight tags their variance is known to a tenth
(the root of 2/(7 * 28)); over a single pair to half."""

BETWEEN_M = 0.05
"""Standard deviation of a pair's offset between recordings if only one is fitted.

4 cm by which pairs of MILUV differ between two days (3.2 to 4.3 cm), and 2.15 mm/K for each of both tags (DW1000 user
manual, section 8.3.1) whose temperatures differ by 10 K. Chosen without STAR-loc, on which it is tested.
"""


def calibration_of(found: RangeFit, delays_ns2: Floats) -> Calibration:
    """Return the calibration of a fit; `delays_ns2` (tags, tags) is the covariance of its delays."""
    model, search, settings = found.model, found.searches[0], found.model.settings
    names, fixed = model.unknowns[0].names, settings.fixed_ns
    of_pairs = settings.constants == "pair"
    free = {tag for sides in found.model.free for tags in sides for tag in tags}
    std = [
        math.inf if not of_pairs and int(name) in free else math.sqrt(max(value, 0.0))
        for name, value in zip(names, np.diag(delays_ns2), strict=True)
    ]
    fitted = [k for k, name in enumerate(names) if of_pairs or int(name) not in fixed]
    tags = [] if of_pairs else [int(names[k]) for k in fitted]
    offsets = {}
    if of_pairs:
        values = zip(model.pairs.ends.tolist(), found.delays.tolist(), std, strict=True)
        offsets = {(a, b): PairOffset(-METRES_A_NS * delay, METRES_A_NS * error) for (a, b), delay, error in values}
        fixed = dict.fromkeys(model.tags, 0.0)
    biases = bias_curves(found)
    errors = None
    spread = robust_spread(found.residuals)
    sigmas, sigma_m2 = _flat_sigma(model, spread, 0.5 / len(found.residuals))
    # Errors without spread have no distribution.
    if 1e-6 < spread < LARGEST_SPREAD_M:
        described = described_errors(found)
        errors = error_model(model, found.residuals, described, found.blocks)
        between_m = settings.between_m
        if between_m is None:
            between_m = between_recordings(found, described)
        errors = errors.between(between_m, _correction_std(found, delays_ns2, np.array(errors.lifted)))
        sigmas, sigma_m2 = sigma_curves(model, described.values, described.noise)
    return Calibration(
        delays_ns={tag: float(found.delays[k]) for k, tag in zip(fitted, tags, strict=not of_pairs)} | dict(fixed),
        delays_std_ns={tag: std[k] for k, tag in zip(fitted, tags, strict=not of_pairs)} | dict.fromkeys(fixed, 0.0),
        loss=search.loss,
        scale_ns=search.scale_m / METRES_A_NS,
        lift=settings.lift,
        alpha_dbm=settings.alpha_dbm,
        speed_of_light=SPEED_OF_LIGHT,
        bias_curve=_average(list(biases.values())),
        sigma_curve=_average(list(sigmas.values())),
        uncertainty=Uncertainty(
            tuple(tags),
            () if offsets else matrix_of(delays_ns2[np.ix_(fitted, fitted)]),
            matrix_of(_bias_covariance(found)),
            matrix_of(sigma_m2),
        ),
        pair_offsets=offsets,
        groups={name: TagGroup(tuple(own), biases[name], sigmas[name]) for name, own in settings.groups.items()},
        errors=errors,
        antenna_delays=known_delays(model.ranges.antenna_delays, model.ranges.tags()),
        undetermined_splits=tuple(model.free),
        patterns=patterns_of(found),
        temperatures=temperatures_of(found),
    )


def patterns_of(found: RangeFit) -> tuple[Pattern, ...]:
    """Return the patterns over direction of a fit: one for all tags, or one for each tag."""
    directions, values = found.model.covariates.get("pattern"), found.values
    if directions is None:
        return ()
    whose = [(tag,) for tag in directions.tags] if OWN in values else [directions.tags]
    factors, patterns = values[OWN if OWN in values else COMMON].reshape(-1, HARMONICS), []
    for k, (tags, own) in enumerate(zip(whose, factors, strict=True)):
        which = slice(k * HARMONICS, (k + 1) * HARMONICS)
        covariance = found.covariances["pattern"][which, which]
        rms = math.sqrt(float(np.sum(directions.square * (np.outer(own, own) + covariance))))
        centre = tuple(directions.centre.tolist())
        patterns.append(Pattern(tags, tuple(own.tolist()), centre, matrix_of(covariance), rms))
    return tuple(patterns)


def temperatures_of(found: RangeFit) -> tuple[TemperatureSlope, ...]:
    """Return the slopes over temperature of a fit: one for all tags, or one for each tag."""
    known, values = found.model.covariates.get("temperature"), found.values
    if known is None:
        return ()
    own = values.get(OWN_WARMTH, np.zeros(0))
    whose = [(tag,) for tag in known.tags] if len(own) else [known.tags]
    # A tag's slope is the sum of the common one and its own, which follow each other among the unknowns.
    sums = np.column_stack([np.ones(len(whose)), np.eye(len(own))]) if len(own) else np.ones((1, 1))
    slopes = sums @ np.append(values[WARMTH], own)
    covariance = found.covariances["temperature"][-sums.shape[1] :, -sums.shape[1] :]
    std = np.sqrt(np.diag(sums @ covariance @ sums.T))
    span = (float(known.span[0, 0]), float(known.span[1, 0]))
    rows = zip(whose, slopes.tolist(), std.tolist(), strict=True)
    return tuple(TemperatureSlope(tags, slope, error, float(known.centre[0]), span) for tags, slope, error in rows)


def bias_curves(found: RangeFit) -> dict[str, Curve]:
    """Return the curve of each group, zero at the reference power if delays absorb its constant."""
    model = found.model
    if model.curve is None:
        return dict.fromkeys(model.settings.groups or ("",), flat_curve(0.0, model.span))
    knots = tuple(model.curve.knots.tolist())
    return {
        kind.removeprefix("curve").strip(): Curve(knots, tuple(found.values[kind].tolist()), DEGREE, model.span)
        for kind in model.curve_kinds()
    }


def sigma_curves(
    model: RangeModel, values: Mapping[str, Floats], covariance: Floats
) -> tuple[dict[str, Curve], Floats]:
    """Return the noise of direct ranges over power for each group, and the covariance of their average (m, m).

    `covariance` is the covariance of level and curves of the logarithm of noise. The curves are splines through the
    noise.
    """
    level = float(values["noise level"][0])
    if model.noise is None:
        return _flat_sigma(model, math.exp(level), float(covariance[0, 0]))
    knots, names = model.noise.knots, list(model.settings.groups) or [""]
    splines = basis(np.linspace(knots[0], knots[-1], 8 * model.noise.size), knots)
    through = np.linalg.pinv(splines)
    sigma = [np.exp(level + splines @ values[f"noise curve {name}".strip()]) for name in names]
    by_level, by_curve = through @ sum(sigma), [through @ (own[:, None] * splines) for own in sigma]
    slope = np.column_stack([by_level, *by_curve]) / len(names)
    place, span = tuple(knots.tolist()), (float(knots[0]), float(knots[-1]))
    kept = [tuple(np.maximum(through @ own, SIGMA_FLOOR_M).tolist()) for own in sigma]
    curves = {name: Curve(place, own, DEGREE, span) for name, own in zip(names, kept, strict=True)}
    return curves, np.asarray(slope @ covariance @ slope.T)


def _flat_sigma(model: RangeModel, sigma_m: float, variance: float) -> tuple[dict[str, Curve], Floats]:
    """Return flat curves of noise whose logarithm has a variance, and their covariance."""
    value = max(sigma_m, SIGMA_FLOOR_M)
    curves = dict.fromkeys(model.settings.groups or ("",), flat_curve(value, model.span))
    return curves, np.full((DEGREE + 1,) * 2, value**2 * variance)


def _correction_std(found: RangeFit, delays_ns2: Floats, lifted: Floats) -> Floats:
    """Return the standard deviation of the correction at lifted powers (nodes,), in metres: the root mean square over
    the fitted pairs.

    The correction of a pair has half of both delays, times the speed of light, and the curve.
    """
    model = found.model
    if model.settings.constants == "pair":
        of_pairs = METRES_A_NS**2 * np.diag(delays_ns2)
    else:
        of_pairs = variance_of_delays(model.pairs.ends, model.tags, delays_ns2)
    if (directions := model.covariates.get("pattern")) is not None:
        # Effects of places that depend on direction are not corrected.
        parts = ((*directions.entries(kind, model.pairs)[1:], found.values[kind]) for kind in OF_PLACES)
        left = sum(np.sum(entries * values[columns], axis=1) for columns, entries, values in parts)
        of_pairs = of_pairs + np.var(left)
    variance = np.full(len(lifted), float(np.mean(of_pairs)))
    if model.curve is not None:
        splines = basis(lifted, model.curve.knots)
        variance += np.sum(splines @ _bias_covariance(found) * splines, axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def variance_of_delays(ends: Ints, tags: Sequence[int], delays_ns2: Floats) -> Floats:
    """Return the variance of ranges of pairs (pairs,), in m^2, by the covariance of delays (tags, tags)."""
    delays = np.sum(ends[:, :, None] == np.array(tags), axis=1) * METRES_A_NS / 2
    return np.asarray(np.sum(delays @ delays_ns2 * delays, axis=1))


def _bias_covariance(found: RangeFit) -> Floats:
    """Return the covariance of the coefficients of the average of the groups' curves."""
    if found.model.curve is None:
        return np.zeros((DEGREE + 1,) * 2)
    count = len(found.model.curve_kinds())
    average = np.kron(np.full((1, count), 1 / count), np.eye(found.model.curve.size))
    return np.asarray(average @ found.covariances["curve"] @ average.T)


def _average(curves: list[Curve]) -> Curve:
    """Return the mean of curves over the same knots."""
    mean = np.mean([curve.coefficients for curve in curves], axis=0)
    return Curve(curves[0].knots, tuple(mean.tolist()), curves[0].degree, curves[0].range)


def error_model(model: RangeModel, residual: Floats, errors: DescribedErrors, blocks: TimeBlocks) -> ErrorModel:
    """Return the error model of residuals (n,), in the order of the model's ranges."""
    values, number = errors.values, model.pairs.number
    found = errors.slopes
    lasting = lasting_in_pairs(found.by["odds"], number, blocks)
    pairs = len(model.pairs.ends)
    information = np.bincount(number, found.by["odds"] ** 2, pairs)
    # A wall has one detour: the number of reflections counts for the mean, not the number of ranges.
    reflected = np.bincount(number, found.reflected, pairs)
    odds, odds_var, any_odds, any_odds_var = _shrunk_to_mean(
        values["odds of pair"], lasting / np.maximum(information, 1e-6), WIDEST_ODDS
    )
    detour, detour_var, any_detour, any_detour_var = _shrunk_to_mean(
        values["detour of pair"], lasting / np.maximum(reflected, 1e-6), WIDEST_DETOUR
    )
    lifted, noise, curve = _at_nodes(model, values)
    level = float(values["odds level"][0])
    middle = level + float(np.mean(curve))
    common = float(_expected_odds(np.array(any_odds + middle), np.array(any_odds_var)))
    own = _expected_odds(odds + middle, odds_var)
    long = LongDetours(share=float(expit(values["long detours"][0])), factor=LONG_FACTOR)
    above = float(np.exp(values["detour level"][0]))
    any_mean = above * float(np.exp(any_detour + any_detour_var / 2))
    means = above * np.exp(detour + detour_var / 2)
    reach = BEYOND_MEANS * long.longest * float(means.max())
    outlying = np.clip(1 - found.inlier, 0, 1) * (np.abs(residual - errors.location_m) < reach)
    square = float(np.sum(outlying * (residual - errors.location_m) ** 2))
    stated = ErrorModel(
        lifted=tuple(lifted.tolist()),
        noise_m=tuple(noise.tolist()),
        tail_share=tuple(np.clip(expit(common + curve - np.mean(curve)), 1e-4, 1 - 1e-4).tolist()),
        least_m=float(np.exp(values["least detour"][0])),
        detour_m=any_mean,
        outlier_share=max(float(np.mean(outlying)), 1e-9),
        outlier_m=float(np.sqrt(square / max(float(np.sum(outlying)), 1e-9))) or reach,
        location_m=errors.location_m,
        long_share=long.share,
        long_factor=long.factor,
        pairs={
            name: PairErrors(noise=float(one), odds=float(np.exp(two - common)), detour=float(three / any_mean))
            for name, one, two, three in zip(
                model.pairs.names, np.exp(values["noise of pair"]), own, means, strict=True
            )
        },
    )
    if (features := ReflectionFeatures.of(model.ranges)) is not None:
        share = stated.shapes(model.lifted, model.ranges.initiator, model.ranges.target).tail_share
        stated = features.state(stated, values["odds of feature"], share)
    return _with_quantiles(stated, model, residual)


def between_recordings(found: RangeFit, errors: DescribedErrors) -> float:
    """Return the standard deviation, in metres, of the difference of a pair's offset between this and another
    recording.

    Several sessions determine it: by offsets of pairs, if these are determined, and by offsets of pairs in spells. One
    recording determines only a lower bound, because its delays contain the offsets that change until the next one.
    """
    optimum, pair, score = found.searches[0].optimum, found.model.pairs.number, errors.slopes.by[RESIDUAL]
    pairs, cell = len(found.model.pairs.ends), pair * SPELLS + np.arange(len(pair)) * SPELLS // len(pair)
    lasting = lasting_in_pairs(score, pair, found.blocks, SPELLS)
    slope, known = (
        np.bincount(cell, column, pairs * SPELLS).reshape(pairs, SPELLS) / lasting for column in (score, score**2)
    )
    # The common part of all spells is the offset of the pair.
    slope -= known * slope.sum(axis=1, keepdims=True) / np.maximum(known.sum(axis=1, keepdims=True), 1e-300)
    spells_m = math.sqrt(mean_variance(known.ravel(), slope.ravel(), TYPICAL_OFFSET_M, OFFSETS[1:]))
    every = (OFFSET_OF_BODIES, OFFSET_OF_PAIR, "offset of pair in session")
    kinds = [kind for kind in every if kind in optimum.layout.where]
    between_m = math.hypot(spells_m, *(map(optimum.priors.deviation, kinds) if kinds else [spells_m]))
    return between_m if np.ptp(found.model.ranges.session) else max(between_m, BETWEEN_M)


def mean_variance(information: Floats, slope: Floats, typical: float, bounds: tuple[float, float]) -> float:
    """Return the posterior mean of the variance of independent draws (k,).

    `information` (k,) and `slope` (k,) are information and slope of the log likelihood of each draw at zero: its
    marginal likelihood under a variance s is (1 + s l)^-1/2 exp(b^2 s / (1 + s l) / 2). The prior of the standard
    deviation is half-normal with scale `typical`, within `bounds` (Gelman 2006). With few uncertain values the maximum
    of the likelihood would be at zero.
    """
    deviation = np.geomspace(*bounds, 200)
    variance = deviation[:, None] ** 2
    spread = 1 + variance * information
    likelihood = 0.5 * np.sum(slope**2 * variance / spread - np.log(spread), axis=1)
    # The steps are equal in the logarithm, so their widths are proportional to the deviation.
    posterior = likelihood - 0.5 * (deviation / typical) ** 2 + np.log(deviation)
    share = np.exp(posterior - posterior.max())
    return float(share @ deviation**2 / share.sum())


def _at_nodes(model: RangeModel, values: dict[str, Floats]) -> tuple[Floats, Floats, Floats]:
    """Return lifted powers (NODES,), the noise there in metres, and the log odds there minus their level."""
    level = float(values["noise level"][0])
    if model.noise is None:
        return np.array([0.999, 1.001]) * np.median(model.lifted), np.full(2, np.exp(level)), np.zeros(2)
    nodes = np.quantile(model.lifted, (np.arange(NODES) + 0.5) / NODES) + 1e-9 * np.arange(NODES)
    splines, several = basis(nodes, model.noise.knots), list(model.settings.groups) or [""]
    noise, odds = (
        splines @ np.mean([values[f"{parameter} curve {name}".strip()] for name in several], axis=0)
        for parameter in ("noise", "odds")
    )
    return nodes, np.exp(level + noise), odds


def _shrunk_to_mean(value: Floats, variance: Floats, widest: float) -> tuple[Floats, Floats, float, float]:
    """Shrink values (pairs,) with known variances to their mean; return them, their variances, and value and variance
    of a new pair.

    The variance between pairs is the maximum of a normal likelihood (by expectation-maximisation). Returned variances
    are `widest` at most.
    """
    between = float(np.var(value)) + 1e-3
    for _ in range(50):
        weight = 1 / (between + variance)
        centre = float(np.sum(weight * value) / np.sum(weight))
        kept = between / (between + variance)
        between = max(float(np.mean((kept * (value - centre)) ** 2 + kept * variance)), 1e-4)
    of_centre = float(1 / np.sum(1 / (between + variance)))
    kept = between / (between + variance)
    drawn, left = centre + kept * (value - centre), kept * variance + (1 - kept) ** 2 * of_centre
    return np.asarray(drawn), np.minimum(left, widest), centre, min(between + of_centre, widest)


def _expected_odds(log_odds: Floats, variance: Floats) -> Floats:
    """Return the log odds of the mean share, for log odds with a variance (MacKay 1992)."""
    return np.asarray(log_odds / np.sqrt(1 + np.pi / 8 * variance))


def _with_quantiles(model: ErrorModel, of: RangeModel, residual: Floats) -> ErrorModel:
    """Correct the quantiles and the total standard deviation so that they hold for the fitted ranges on average."""
    if len(residual) < 200:
        # With two hundred ranges, one range determines the outer quantiles (0.5 %).
        return model
    # More than 20 000 ranges do not change the result.
    rows = np.linspace(0, len(residual) - 1, min(20_000, len(residual))).astype(np.int64)
    error = residual[rows]
    some = of.ranges[rows]
    shapes = model.shapes(of.lifted[rows], some.initiator, some.target, model.log_odds_of(some.features))
    level = np.quantile(model.below(error, shapes), QUANTILE_SHARES)
    away = error - model.mean_m(shapes)
    within = np.abs(away) < BEYOND_MEANS * (model.least_m + model.long.longest * shapes.detour_m)
    z = away[within] / model.total_m(shapes)[within]
    levels = tuple(zip(QUANTILE_SHARES, np.maximum.accumulate(level).tolist(), strict=True))
    return replace(model, scale=float(np.sqrt(np.mean(z**2))), levels=levels)
