"""The error model of future ranges, from fitted ones.

Reflections last, so the share of reflections of a pair in one recording predicts its share in another less well than
independent ranges would. The loss of information is estimated from sums of slopes over blocks of time. Parameters of
pairs are shrunk to their common value accordingly, and the remaining uncertainty of a share enters the predicted share.
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
from uwblink.arrays import Floats

if TYPE_CHECKING:
    from calib.estimator.known_distances import DescribedErrors

NODES = 8
"""Number of powers at which noise and share are stated; between them both are linear."""

JUDGED = 20_000
"""Number of ranges from which quantiles and the total sigma are corrected; more change nothing."""

FEWEST_JUDGED = 200
"""With fewer ranges the quantiles of the model are not corrected."""

LEVELS = (0.005, 0.025, 0.05, 0.16, 0.5, 0.84, 0.95, 0.975, 0.995)
"""Shares of errors at which the model's quantiles are corrected."""

BEYOND_MEANS = 8.0
"""Errors longer than so many means of the longer detours are excluded from the total sigma. An exponential distribution
has 0.03 % of its values beyond, which carry 1.4 % of its mean square."""

SMALLEST_SHARE = 1e-4
WIDEST_ODDS, WIDEST_DETOUR = 4.0, 1.0
"""Variances of a pair's log odds and log detour: two in three pairs between an eighth and eight times the common odds,
a third and three times the common detour. What a few lasting reflections leave open is more than any room has."""


SPELLS = 8
"""Number of spells of a recording that are compared."""

BETWEEN_M = 0.05
"""Standard deviation of a pair's offset between recordings, where only one is fitted.

4 cm by which pairs of MILUV differ between two days (3.2 to 4.3 cm), and 2.15 mm/K for each of both tags (DW1000 user
manual, section 8.3.1) whose temperatures differ by 10 K. Chosen without STAR-loc, on which it is tested.
"""


def error_model(model: RangeModel, residual: Floats, errors: DescribedErrors, blocks: TimeBlocks) -> ErrorModel:
    """Return the error model of residuals (n,), in the order of the model's ranges."""
    values, number = errors.values, model.pairs.number
    found = errors.slopes
    lasting = lasting_in_pairs(found.by["odds"], number, blocks)
    pairs = len(model.pairs.ends)
    told = np.bincount(number, found.by["odds"] ** 2, pairs)
    # A wall has one detour: the number of reflections counts for the mean, not the number of ranges.
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


def between_recordings(model: RangeModel, errors: DescribedErrors, blocks: TimeBlocks, pairs_m: float | None) -> float:
    """Return the standard deviation, in metres, of the difference of a pair's offset between this and another
    recording.

    Several sessions show it: by offsets of pairs (`pairs_m`, None if they are not determined), and of pairs in spells.
    One recording does not, because its delays contain what changes by the next; it shows the least.
    """
    pair, score = model.pairs.number, errors.slopes.by[RESIDUAL]
    pairs, cell = len(model.pairs.ends), pair * SPELLS + np.arange(len(pair)) * SPELLS // len(pair)
    lasting = lasting_in_pairs(score, pair, blocks, SPELLS)
    slope, known = (
        np.bincount(cell, column, pairs * SPELLS).reshape(pairs, SPELLS) / lasting for column in (score, score**2)
    )
    # The common part of all spells is the offset of the pair.
    slope -= known * slope.sum(axis=1, keepdims=True) / np.maximum(known.sum(axis=1, keepdims=True), 1e-300)
    spells_m = math.sqrt(mean_variance(known.ravel(), slope.ravel(), TYPICAL_OFFSET_M, OFFSETS[1:]))
    found = math.hypot(spells_m, spells_m if pairs_m is None else pairs_m)
    return found if np.ptp(model.ranges.session) else max(found, BETWEEN_M)


def mean_variance(information: Floats, slope: Floats, typical: float, bounds: tuple[float, float]) -> float:
    """Return the posterior mean of the variance of independent draws (k,).

    `information` (k,) and `slope` (k,) are those of the log likelihood of each draw at zero: its marginal likelihood
    under a variance s is (1 + s l)^-1/2 exp(b^2 s / (1 + s l) / 2). The prior of the standard deviation is half-normal
    with scale `typical`, within `bounds` (Gelman 2006). The maximum of the likelihood would be zero with few uncertain
    values.
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
    """Shrink values (pairs,) with known variances to their mean; return them, their variances, and those of a new pair.

    The variance between pairs is the maximum of a normal likelihood (by expectation-maximisation).
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
    """Correct the quantiles and the total standard deviation so that they hold for the fitted ranges on average."""
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
