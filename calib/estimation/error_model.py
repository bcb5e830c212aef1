"""What the errors of ranges yet to come are made of, from those that were fitted.

Reflections last, so a pair's share in one recording says less of its share in another than as many independent ranges
would: how much less is read off the slopes by the shares, summed over blocks of time (`persistence`). Pairs are drawn
to what they have in common by that, and what stays unknown of a share is in the share that is predicted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.calibration.error_model import ErrorModel, PairErrors
from calib.estimation.mixture_slopes import Errors
from calib.estimation.pair_mixture import PairMixture, fit_pair_mixture
from calib.estimation.problem import CELLS, Problem
from calib.estimator.time_blocks import TimeBlocks, lasting_in_pairs
from calib.long_columns import few, let_go, picked, spans
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints

DESCRIBED: Final = 400_000
"""Ranges by whose errors, drawn by chance, a model is fitted beside a robust loss.

All of 800 000 move shares of reflections by half a percentage point, and the centre by 0.4 mm.
"""

JUDGED: Final = 20_000
"""Ranges by which quantiles and the total sigma are put right; more would say nothing else."""

FEWEST_JUDGED: Final = 200
"""Of fewer the model's own quantiles are the better guess."""

LEVELS: Final = (0.005, 0.025, 0.05, 0.16, 0.5, 0.84, 0.95, 0.975, 0.995)
"""Shares of errors at which the model's quantiles are put right."""

BEYOND_MEANS: Final = 8.0
"""Errors longer than so many means of the longer detours are no part of the total sigma.

An exponential leaves 0.03 % of its values beyond, which carry 1.4 % of their mean square.
"""

LEAST_SPREAD_M: Final = 1e-6
"""Errors without any spread have no distribution."""

ROUNDS: Final = 50
SMALLEST_SHARE: Final = 1e-4


def error_model(problem: Problem, residual_m: Floats, mixture: PairMixture | None) -> ErrorModel | None:
    """Return what errors are made of; None where they have no spread.

    `residual_m` (n,) are fitted less true ranges, in order of time, `mixture` what they were fitted with; without one
    it is fitted here, about a centre of its own, to `DESCRIBED` errors at most.
    """
    if robust_spread(residual_m) < LEAST_SPREAD_M:
        return None
    pair, names = problem.pairs.number, [f"{low}-{high}" for low, high in problem.pairs.ends.tolist()]
    cell, blocks, centred = problem.cell, problem.blocks, residual_m
    location = 0.0
    if mixture is None:
        rows = _described(len(residual_m))
        pair, blocks, centred = pair[rows], blocks.among(rows), residual_m[rows]
        mixture = _about_their_centre(centred, pair, cell[rows], len(names))
        location = -float(mixture.of("design")[0])
        centred = centred - location
    nodes = _middles(problem.lifted, cell)
    known = _of_pairs(mixture, blocks, pair)
    wild = _outliers(mixture, centred)
    model = ErrorModel(
        lifted=tuple(nodes.tolist()),
        noise_m=tuple(np.exp(mixture.of("cell_noise")).tolist()),
        tail_share=tuple(_share(known.common_odds + _apart(mixture.of("cell_share"))).tolist()),
        least_m=float(np.exp(mixture.of("least")[0])),
        detour_m=known.common_detour_m,
        outlier_share=wild.share,
        outlier_m=wild.rms_m,
        location_m=location,
        long_share=mixture.long.share,
        long_factor=mixture.long.factor,
        pairs={
            name: PairErrors(noise=float(noise), odds=float(np.exp(odds - known.common_odds)), detour=float(detour))
            for name, noise, odds, detour in zip(names, mixture.noise, known.odds, known.detour, strict=True)
        },
    )
    return _put_right(model, problem, residual_m)


def _middles(lifted: Floats, cell: Ints) -> Floats:
    """Return the lifted power that stands for each step (CELLS,): of few powers, some steps hold no range."""
    held = np.flatnonzero(np.bincount(cell, minlength=CELLS))
    middles = np.interp(np.arange(CELLS), held, [np.median(picked(lifted, cell == k)) for k in held])
    # Powers may repeat; what is straight between two of them needs them apart.
    return np.asarray(middles + 1e-9 * np.arange(CELLS))


def _described(count: int) -> Ints | slice:
    """Return the rows by which errors are described: all, or as many as it takes, in their order."""
    if count <= DESCRIBED:
        return slice(None)
    # By chance, so that no schedule of pairs keeps in step; one is drawn of each of so many spans of rows.
    edges = np.arange(DESCRIBED + 1) * count // DESCRIBED
    return np.asarray(np.random.default_rng(0).integers(edges[:-1], edges[1:]))


def _about_their_centre(residual_m: Floats, pair: Ints, cell: Ints, pairs: int) -> PairMixture:
    """Fit a mixture to residuals (n,) of another loss, about a centre that is fitted along."""
    errors = Errors.of(residual_m, np.ones((len(residual_m), 1)), pair * CELLS + cell, pairs)
    return fit_pair_mixture(errors, np.array([-float(np.median(residual_m))]), np.zeros((1, 1)))


WIDEST_ODDS: Final = 4.0
"""Variance of a pair's log odds of a reflection: two in three pairs between an eighth and eight times the common."""

WIDEST_DETOUR: Final = 1.0
"""Variance of the logarithm of a pair's mean detour: two in three between a third and three times the common."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _PairsPredicted:
    """Log odds of each pair (pairs,) and of one not seen yet, at the middle step; detours over the common one."""

    odds: Floats
    common_odds: float
    detour: Floats
    common_detour_m: float


def _of_pairs(mixture: PairMixture, blocks: TimeBlocks, pair: Ints) -> _PairsPredicted:
    """Draw pairs to what they have in common, by what they know where reflections last."""
    by_share = mixture.slope("share")
    pairs = mixture.layout.pairs
    factor = lasting_in_pairs(by_share, pair, blocks)
    reflected = np.bincount(pair, minlength=pairs) * mixture.tail_share
    # One wall has one detour: a mean is known from as many reflections as there were, not from as many ranges.
    told = np.zeros(pairs)
    for rows in spans(len(pair)):
        told += np.bincount(pair[rows], by_share[rows] ** 2, pairs)
        let_go(by_share, pair)
    unknown = [factor / np.maximum(known, 1e-6) for known in (told, reflected)]
    share, share_var, any_share, any_share_var = _drawn(mixture.of("pair_share"), unknown[0])
    mean, mean_var, any_mean, any_mean_var = _drawn(mixture.of("pair_mean"), unknown[1])
    # What a few lasting reflections leave open is more than any room has, and the means of their exponentials explode.
    share_var, any_share_var = np.minimum(share_var, WIDEST_ODDS), min(any_share_var, WIDEST_ODDS)
    mean_var, any_mean_var = np.minimum(mean_var, WIDEST_DETOUR), min(any_mean_var, WIDEST_DETOUR)
    middle = float(np.mean(mixture.of("cell_share")))
    common = mixture.mean_m * float(np.exp(any_mean + any_mean_var / 2))
    return _PairsPredicted(
        odds=_expected_odds(share + middle, share_var),
        common_odds=float(_expected_odds(np.array(any_share + middle), np.array(any_share_var))),
        detour=np.exp(mean + mean_var / 2 - any_mean - any_mean_var / 2),
        common_detour_m=common,
    )


def _drawn(value: Floats, variance: Floats) -> tuple[Floats, Floats, float, float]:
    """Draw values (pairs,) with known variances to a common one; return them, their variances, and those of another.

    The variance between pairs is the likeliest of normal values (by expectation-maximisation).
    """
    between = float(np.var(value)) + 1e-3
    for _ in range(ROUNDS):
        weight = 1 / (between + variance)
        centre = float(np.sum(weight * value) / np.sum(weight))
        kept = between / (between + variance)
        between = max(float(np.mean((kept * (value - centre)) ** 2 + kept * variance)), 1e-4)
    of_centre = float(1 / np.sum(1 / (between + variance)))
    kept = between / (between + variance)
    return (
        np.asarray(centre + kept * (value - centre)),
        np.asarray(kept * variance + (1 - kept) ** 2 * of_centre),
        centre,
        between + of_centre,
    )


def _expected_odds(log_odds: Floats, variance: Floats) -> Floats:
    """Return the log odds of the mean share, where log odds are known with a variance (MacKay 1992)."""
    return np.asarray(log_odds / np.sqrt(1 + np.pi / 8 * variance))


def _apart(values: Floats) -> Floats:
    return np.asarray(values - values.mean())


def _share(log_odds: Floats) -> Floats:
    return np.clip(1 / (1 + np.exp(-log_odds)), SMALLEST_SHARE, 1 - SMALLEST_SHARE)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Outliers:
    """Share and root mean square of what neither core nor tail explains, those far beyond reach apart."""

    share: float
    rms_m: float


def _outliers(mixture: PairMixture, error_m: Floats) -> _Outliers:
    slope, always = mixture.slope("outliers"), 1 / (1 + np.exp(-mixture.of("outliers")[0]))
    reach = BEYOND_MEANS * mixture.long.longest * float(mixture.tail_mean_m.max())
    total, square = 0.0, 0.0
    for rows in spans(len(error_m)):
        some = error_m[rows]
        near = np.clip(slope[rows] + always, 0, 1) * (np.abs(some) < reach)
        total, square = total + float(near.sum()), square + float(np.sum(near * some**2))
        let_go(slope, error_m)
    share = max(total / len(error_m), 1e-9)
    return _Outliers(share=share, rms_m=float(np.sqrt(square / max(total, 1e-9))) or reach)


def _put_right(model: ErrorModel, problem: Problem, residual_m: Floats) -> ErrorModel:
    """Let quantiles and the total standard deviation hold in what was fitted, as far as one number for all can."""
    rows = np.linspace(0, len(residual_m) - 1, min(JUDGED, len(residual_m))).astype(np.int64)
    if len(rows) < FEWEST_JUDGED:
        return model
    ranges = problem.ranges
    problem.let_go()
    error, lifted, first, second = few(rows, residual_m, problem.lifted, ranges.initiator, ranges.target)
    shapes = model.shapes(lifted, first, second)
    level = np.quantile(model.below(error, shapes), LEVELS)
    away = error - model.mean_m(shapes)
    reach = BEYOND_MEANS * (model.least_m + model.long.longest * shapes.detour_m)
    within = np.abs(away) < reach
    z = away[within] / model.total_m(shapes)[within]
    return replace(
        model,
        scale=float(np.sqrt(np.mean(z**2))),
        levels=tuple(zip(LEVELS, np.maximum.accumulate(level).tolist(), strict=True)),
    )
