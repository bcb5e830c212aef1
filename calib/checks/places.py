"""Errors that depend on places: errors that all ranges between the same two bodies share, whichever of their tags
range.

A wall, a partition or an object lengthens all ranges between two bodies together, for as long as they stay in place.
One part varies as bodies move: it correlates residuals of different pairs of tags. The other part is constant for the
whole flight. If there are more pairs of bodies than bodies, it is an unknown of the fit. Otherwise delays absorb it,
and it is assumed to be about as large as the varying one. Trajectories that are estimated from ranges absorb both; then
reflections of different pairs still occur at the same times.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from calib.estimator.covariance import of_prior
from calib.estimator.known_distances import RangeFit
from calib.estimator.range_model import OFFSET_OF_BODIES, TYPICAL_OFFSET_M
from calib.estimator.score_tests import REACHED, Slopes, Tested
from calib.estimator.time_blocks import TimeBlocks
from calib.findings import BUDGET, FIT_LEVELS, SMALLEST_NS, Finding, warning
from calib.spread import TWO_SIDED_95
from uwblink.arrays import Floats, Ints

INFORMATION_LEFT = 0.03
"""Minimum share of an offset's information that delays leave: with less, slopes do not determine its size."""

SIZES_M = np.geomspace(3e-4, 0.2, 60)
"""Possible standard deviations of offsets; a larger offset is a detour, and counts as a reflection."""


def place_covariance(
    found: RangeFit, slopes: Slopes, bodies: Tested, group: Ints, before_ns2: Floats, undetermined: Sequence[int]
) -> tuple[Floats, list[Finding]]:
    """Return the covariance (tags, tags) that place-dependent errors add to that of the delays, and a finding if they
    matter, which has a p-value if they are certain.

    `bodies` are the slopes of offsets by pair of bodies, whose numbers are `group` (pairs,); `before_ns2` is the
    covariance without places. It contains offsets of bodies if these are fitted. The finding is about the delays that
    are not `undetermined`.
    """
    offsets, variances, p_stays = _not_absorbed(bodies)
    # Trajectories absorb errors that vary, which then leave no residuals.
    known = found.searches[0].rows.geometry is None
    variance, p_varies = _varying_part(found, slopes, group) if known else (0.0, 1.0)
    of_residuals = [*([p_stays] if len(offsets) else []), *([p_varies] if known else [])]
    p_values = [*of_residuals, *([] if known else [_simultaneous_reflections(found, group)])]
    # Fits of trajectories have no unknown for constant offsets, which rooms have even if a test does not find them.
    typical = len(offsets) > 0 and (not known or p_stays < BUDGET)
    if min(p_values) >= BUDGET and not typical:
        return np.zeros_like(before_ns2), []
    if typical:
        # The typical size is right within a factor of e.
        middle, width = TYPICAL_OFFSET_M, 1.0
    elif p_varies < BUDGET:
        # The constant part is as large as the varying one, within 0.8 logarithms (a factor of 2.2, a judgement): in
        # rooms of the simulator it was 1.2 to 4 times as large, in smooth fields of errors a sixth to two thirds.
        middle, width = float(np.sqrt(variance)), 0.8
    else:
        # Trajectories followed reflections by 0.4 to 1.9 cm (three flights in a hall of metal, six of tests).
        middle, width = 0.01, 0.8
    spread = SIZES_M[:, None] ** 2 + variances
    likely = -0.5 * np.sum(np.log(spread) + offsets**2 / spread, axis=1)
    size_m = _bound_of_size(likely - 0.5 * (np.log(SIZES_M / middle) / width) ** 2)
    optimum = found.searches[0].optimum
    widening, included = size_m**2 * bodies.effects @ bodies.effects.T, np.zeros_like(before_ns2)
    if OFFSET_OF_BODIES in optimum.layout.where:
        included = of_prior(
            optimum, optimum.priors.keys.index((OFFSET_OF_BODIES, 0)), optimum.layout.indices(["delay"])
        )
        widening = max(size_m / optimum.priors.deviation(OFFSET_OF_BODIES), 1.0) ** 2 * included
    # The common part of all delays also depends on the curve, and is far less certain; so are undetermined delays.
    which = ~np.isin(found.model.tags, undetermined)
    apart = (np.eye(len(which)) - which / max(int(which.sum()), 1))[which]
    own, more = (np.diag(apart @ one @ apart.T) for one in (before_ns2 - included, widening))
    if not np.any(more > np.maximum(own, SMALLEST_NS**2)):
        return widening - included, []
    shift = f"may change differences of delays by {1e3 * np.sqrt(more.max()):.0f} ps; intervals include this"
    if (p_value := _of_all(p_values)) >= FIT_LEVELS["places"]:
        text = "constant errors of the ranges between two bodies, which walls cause, are not well determined, and"
        return widening - included, [warning("unknown offsets of bodies", f"{text} {shift}")]
    certain, directions = _of_all(of_residuals) < FIT_LEVELS["places"], "pattern" not in found.model.covariates
    text = f"{_wrong_ranges(certain, directions)}, which {shift}"
    return widening - included, [warning("errors of places", text, p_value)]


def _wrong_ranges(certain: bool, directions: bool) -> str:
    """Return which errors ranges may have, if residuals show them for `certain`, or only reflections; `directions` may
    be their cause."""
    near = "as near walls and objects"
    if not certain:
        return (
            f"errors depend on places: ranges between the same two bodies are reflected together, {near}, and "
            f"trajectories may have followed them"
        )
    antenna = ", or an antenna whose delay depends on the direction" * directions
    return (
        f"errors depend on places{' or directions' * directions}: ranges between the same two bodies are wrong "
        f"together, {near}, or a wrong lever arm{antenna}"
    )


def _of_all(p_values: Sequence[float]) -> float:
    """Return the p-value of independent tests of one question, 1 without any (Fisher's method)."""
    if not p_values:
        return 1.0
    return float(special.chdtrc(2 * len(p_values), -2 * np.sum(np.log(np.maximum(p_values, 1e-300)))))


def _bound_of_size(likely: Floats) -> float:
    """Return the standard deviation with the 95 % interval of the mixture of all sizes, by their log likelihoods."""
    weight = np.exp(likely - likely.max())
    within = 2 * special.ndtr(TWO_SIDED_95 * SIZES_M[:, None] / SIZES_M) - 1
    return float(np.interp(0.95, within @ (weight / weight.sum()), SIZES_M))


def _not_absorbed(bodies: Tested) -> tuple[Floats, Floats, float]:
    """Return combinations (k,) of offsets that delays do not absorb, in metres, their variances (k,) without offsets,
    and the p-value of all."""
    values, vectors = np.linalg.eigh(bodies.information)
    some = values > REACHED * bodies.whole
    left = bodies.combined(vectors[:, some].T)
    return left.total / values[some], np.diag(left.covariance) / values[some] ** 2, left.joint_p_value(left.total)


def _varying_part(found: RangeFit, slopes: Slopes, group: Ints) -> tuple[float, float]:
    """Return the variance of varying errors that pairs of a group (pairs,) share, and the p-value of its deviation from
    zero.

    Products of slopes of different pairs of a group in the same second are summed: noise, and reflections of single
    pairs, contribute zero on average.
    """
    pair, second = found.model.pairs.number[slopes.order], _seconds(found.blocks)
    count, size, sums = int(second[-1]) + 1, len(group), np.eye(int(group.max()) + 1)[:, group]
    where = second[slopes.order] * size + pair
    slope, known = (
        np.bincount(where, values, count * size).reshape(count, size) for values in (slopes.score, slopes.information)
    )
    # With a robust loss, a pair with mostly large errors may have negative information.
    whole = known.sum(axis=0)
    some = whole > INFORMATION_LEFT * whole.max()
    slope, known, sums = slope[:, some], known[:, some], sums[:, some]
    slope = slope - known * (slope.sum(axis=0) / whole[some])
    product, expected = (((of @ sums.T) ** 2 - of**2 @ sums.T) / 2 for of in (slope, known))
    spread, reach = float(np.sqrt(np.sum(product**2))), float(expected.sum())
    if not spread > 0 or not reach > 0:
        return 0.0, 1.0
    return float(product.sum()) / reach, float(special.ndtr(-product.sum() / spread))


def _seconds(blocks: TimeBlocks) -> Ints:
    """Return the second of each range (n,): bodies are in the same places for about a second."""
    each = max(round(1.0 * blocks.count / max(blocks.seconds, 1e-9)), 1)
    return np.asarray(blocks.number // each)


def _simultaneous_reflections(found: RangeFit, group: Ints) -> float:
    """Return the p-value of simultaneous reflections of different pairs of a group (pairs,).

    Estimated trajectories absorb a common error of all ranges between two bodies, which then leaves no residuals.
    Reflected ranges still occur at the same times.
    """
    fitted, pair = found.searches[-1], found.model.pairs.number
    looks = fitted.rows.error_slopes(fitted.optimum.x, ("odds",))
    second, count = _seconds(found.blocks), np.bincount(pair)
    reflected, by_power = (
        values - (np.bincount(pair, values) / count)[pair]
        for values in (looks.reflected, looks.reflected - looks.by["odds"])
    )
    # Reflections reduce powers, and powers of all pairs change with distance: the smaller value of those with and
    # without the part explained by power is used.
    explained = by_power * (by_power @ reflected) / max(float(by_power @ by_power), 1e-300)
    of_all = (_correlation_of_pairs(values, second, pair, group) for values in (reflected, reflected - explained))
    return float(special.ndtr(-min(of_all)))


def _correlation_of_pairs(values: Floats, second: Ints, pair: Ints, group: Ints) -> float:
    """Return the correlation of sums of values (n,) by second between pairs of a group, in standard deviations.

    Products of two pairs are compared with those of the same two at every other lag (circular shifts), so that each
    may persist.
    """
    seconds, pairs = int(second[-1]) + 1, len(group)
    sums = np.bincount(second * pairs + pair, values, seconds * pairs).reshape(seconds, pairs)
    waves = np.fft.rfft(sums - sums.mean(axis=0), axis=0)
    a, b = np.nonzero(np.triu(group[:, None] == group, 1))
    at_lags = np.fft.irfft(waves[:, a] * np.conj(waves[:, b]), n=seconds, axis=0)
    spread = float(np.sqrt(np.sum(np.mean(at_lags**2, axis=0))))
    return float(at_lags[0].sum()) / spread if spread > 0 else 0.0
