"""What the errors of ranges yet to come are made of, from those that were fitted.

Reflections last, so a pair's share in one recording says less of its share in another than as many independent ranges
would: how much less is read off the slopes by the shares, summed over blocks of time. Pairs are drawn to what they have
in common by that, and what stays unknown of a share is in the share that is predicted.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from calib.calibration.error_model import ErrorModel, PairErrors
from calib.estimator.range_model import OFFSETS, TYPICAL_OFFSET_M, RangeModel, Spline
from calib.estimator.range_rows import RESIDUAL
from calib.estimator.time_blocks import TimeBlocks, lasting_in_pairs
from calib.range_errors.densities import LONG_FACTOR, LongDetours
from calib.range_errors.density import error_slopes
from uwblink.arrays import Floats

if TYPE_CHECKING:
    from calib.estimator.known_distances import DescribedErrors

NODES = 8
"""Powers at which noise and share are stated; both are straight between them."""

JUDGED = 20_000
"""Ranges by which quantiles and the total sigma are put right; more would say nothing else."""

FEWEST_JUDGED = 200
"""Of fewer the model's own quantiles are the better guess."""

LEVELS = (0.005, 0.025, 0.05, 0.16, 0.5, 0.84, 0.95, 0.975, 0.995)
"""Shares of errors at which the model's quantiles are put right."""

BEYOND_MEANS = 8.0
"""Errors longer than so many means of the longer detours are no part of the total sigma.

An exponential leaves 0.03 % of its values beyond, which carry 1.4 % of their mean square.
"""

SMALLEST_SHARE = 1e-4
WIDEST_ODDS, WIDEST_DETOUR = 4.0, 1.0
"""Variances of a pair's log odds and log detour: two in three pairs between an eighth and eight times the common odds,
a third and three times the common detour. What a few lasting reflections leave open is more than any room has."""


SPELLS = 8
"""Parts of a recording between which what stays for a spell is compared."""


def error_model(model: RangeModel, residual: Floats, errors: DescribedErrors, blocks: TimeBlocks) -> ErrorModel:
    """Return what errors are made of, from residuals (n,) in the order of the model's ranges."""
    values, number = errors.values, model.pairs.number
    found = error_slopes(residual - errors.location_m, errors.parameters, span_m=errors.span_m)
    lasting = lasting_in_pairs(found.by["odds"], number, blocks)
    pairs = len(model.pairs.ends)
    told = np.bincount(number, found.by["odds"] ** 2, pairs)
    # One wall has one detour: a mean is known from as many reflections as there were, not from as many ranges.
    reflected = np.bincount(number, found.reflected, pairs)
    odds, odds_var, any_odds, any_odds_var = _drawn(values["odds of pair"], lasting / np.maximum(told, 1e-6))
    detour, detour_var, any_detour, any_detour_var = _drawn(
        values["detour of pair"], lasting / np.maximum(reflected, 1e-6)
    )
    odds_var, any_odds_var = np.minimum(odds_var, WIDEST_ODDS), min(any_odds_var, WIDEST_ODDS)
    detour_var, any_detour_var = np.minimum(detour_var, WIDEST_DETOUR), min(any_detour_var, WIDEST_DETOUR)
    lifted, noise, curve = _at_nodes(model, values)
    level = float(values["odds level"][0])
    middle = level + float(np.mean(curve))
    common = float(_expected_odds(np.array(any_odds + middle), np.array(any_odds_var)))
    own = _expected_odds(odds + middle, odds_var)
    long = LongDetours(share=float(1 / (1 + np.exp(-values["long detours"][0]))), factor=LONG_FACTOR)
    above = float(np.exp(values["detour level"][0]))
    any_mean = above * float(np.exp(any_detour + any_detour_var / 2))
    means = above * np.exp(detour + detour_var / 2)
    reach = BEYOND_MEANS * long.longest * long.mean * float(means.max())
    wild = np.clip(1 - found.inlier, 0, 1) * (np.abs(residual - errors.location_m) < reach)
    square = float(np.sum(wild * (residual - errors.location_m) ** 2))
    stated = ErrorModel(
        lifted=tuple(lifted.tolist()),
        noise_m=tuple(noise.tolist()),
        tail_share=tuple(_share(common + curve - np.mean(curve)).tolist()),
        least_m=float(np.exp(values["least detour"][0])),
        detour_m=long.mean * any_mean,
        outlier_share=max(float(np.mean(wild)), 1e-9),
        outlier_m=float(np.sqrt(square / max(float(np.sum(wild)), 1e-9))) or reach,
        location_m=errors.location_m,
        long_share=long.share,
        long_factor=long.factor,
        pairs={
            f"{a}-{b}": PairErrors(noise=float(one), odds=float(np.exp(two - common)), detour=float(three / any_mean))
            for (a, b), one, two, three in zip(
                model.pairs.ends.tolist(), np.exp(values["noise of pair"]), own, means, strict=True
            )
        },
    )
    return _put_right(stated, model, residual)


def between_recordings(
    model: RangeModel, residual: Floats, errors: DescribedErrors, blocks: TimeBlocks, pairs_m: float | None
) -> float:
    """Return the standard deviation in metres of what another recording has in the ranges of a pair that this has not.

    One recording shows offsets of pairs (`pairs_m`, None where they are not determined) and of pairs in spells of it,
    which are as large as those of another day (public flights: 3 to 4 cm both).
    """
    found = error_slopes(residual - errors.location_m, errors.parameters, span_m=errors.span_m)
    pair, score = model.pairs.number, found.by[RESIDUAL]
    pairs, cell = len(model.pairs.ends), pair * SPELLS + np.arange(len(pair)) * SPELLS // len(pair)
    lasting = lasting_in_pairs(score, pair, blocks, SPELLS)
    slope, known = (
        np.bincount(cell, column, pairs * SPELLS).reshape(pairs, SPELLS) / lasting for column in (score, score**2)
    )
    # What is the same in all spells is the pair's.
    slope -= known * slope.sum(axis=1, keepdims=True) / np.maximum(known.sum(axis=1, keepdims=True), 1e-300)
    spells_m = math.sqrt(mean_variance(known.ravel(), slope.ravel(), TYPICAL_OFFSET_M, OFFSETS[1:]))
    return math.hypot(spells_m, spells_m if pairs_m is None else pairs_m)


def mean_variance(information: Floats, slope: Floats, typical: float, bounds: tuple[float, float]) -> float:
    """Return the posterior mean of the variance of draws (k,), of which data tell independently.

    `information` (k,) and `slope` (k,) are those of the log likelihood of each draw at zero: under a variance s it is
    (1 + s l)^-1/2 exp(b^2 s / (1 + s l) / 2). The standard deviation is half-normal beforehand, about `typical`, within
    `bounds` (Gelman 2006). A likeliest variance would be zero where few values are uncertain.
    """
    deviation = np.geomspace(*bounds, 200)
    variance = deviation[:, None] ** 2
    told = 1 + variance * information
    likelihood = 0.5 * np.sum(slope**2 * variance / told - np.log(told), axis=1)
    # In steps of the logarithm, each is as wide as the deviation.
    posterior = likelihood - 0.5 * (deviation / typical) ** 2 + np.log(deviation)
    share = np.exp(posterior - posterior.max())
    return float(share @ deviation**2 / share.sum())


def _at_nodes(model: RangeModel, values: dict[str, Floats]) -> tuple[Floats, Floats, Floats]:
    """Return lifted powers (NODES,), the noise there in metres, and the log odds there less their level."""
    level = float(values["noise level"][0])
    if model.noise is None:
        return np.array([0.999, 1.001]) * np.median(model.lifted), np.full(2, np.exp(level)), np.zeros(2)
    nodes = np.quantile(model.lifted, (np.arange(NODES) + 0.5) / NODES) + 1e-9 * np.arange(NODES)
    at, several = Spline.at(nodes, model.noise.knots), list(model.groups) or [""]
    curves = {}
    for parameter in ("noise", "odds"):
        mean = np.mean([values[f"{parameter} curve {name}".strip()] for name in several], axis=0)
        curves[parameter] = np.sum(at.values * mean[at.columns], axis=1)
    return nodes, np.exp(level + curves["noise"]), curves["odds"]


def _drawn(value: Floats, variance: Floats) -> tuple[Floats, Floats, float, float]:
    """Draw values (pairs,) with known variances to a common one; return them, their variances, and those of another.

    The variance between pairs is the likeliest of normal values (by expectation-maximisation).
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
    return np.asarray(drawn), np.asarray(left), centre, between + of_centre


def _expected_odds(log_odds: Floats, variance: Floats) -> Floats:
    """Return the log odds of the mean share, where log odds are known with a variance (MacKay 1992)."""
    return np.asarray(log_odds / np.sqrt(1 + np.pi / 8 * variance))


def _share(log_odds: Floats) -> Floats:
    return np.clip(1 / (1 + np.exp(-log_odds)), SMALLEST_SHARE, 1 - SMALLEST_SHARE)


def _put_right(model: ErrorModel, of: RangeModel, residual: Floats) -> ErrorModel:
    """Let quantiles and the total standard deviation hold in what was fitted, as far as one number for all can."""
    rows = np.linspace(0, len(residual) - 1, min(JUDGED, len(residual))).astype(np.int64)
    if len(rows) < FEWEST_JUDGED:
        return model
    error = residual[rows]
    shapes = model.shapes(of.lifted[rows], of.ranges.initiator[rows], of.ranges.target[rows])
    level = np.quantile(model.below(error, shapes), LEVELS)
    away = error - model.mean_m(shapes)
    within = np.abs(away) < BEYOND_MEANS * (model.least_m + model.long.longest * shapes.detour_m)
    z = away[within] / model.total_m(shapes)[within]
    levels = tuple(zip(LEVELS, np.maximum.accumulate(level).tolist(), strict=True))
    return replace(model, scale=float(np.sqrt(np.mean(z**2))), levels=levels)
