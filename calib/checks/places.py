"""Errors that depend on places: errors that all ranges between the same two bodies share, whichever of their tags
range.

A wall, a partition or an object lengthens all ranges between two bodies together, for as long as they stay in place.
One part varies as bodies move: it correlates residuals of different pairs of tags. The other part is constant for the
whole flight, and delays absorb some of it. The remainder is visible if there are more pairs of bodies than bodies;
otherwise the constant part is assumed to be about as large as the varying one. Trajectories that are estimated from
ranges absorb both; then reflections of different pairs still occur at the same times.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from calib.estimator.known_distances import RangeFit
from calib.estimator.score_tests import Slopes, Tested
from calib.estimator.time_blocks import TimeBlocks
from calib.findings import BUDGET, FIT_LEVELS, SMALLEST_NS, Finding, warning
from calib.spread import TWO_SIDED_95
from uwblink.arrays import Floats, Ints

WIDENING_DEVIATION = -float(special.ndtri(BUDGET))
"""Deviation of one of the three statistics from which intervals are widened; 1 % of sound flights exceed it."""


INFORMATION_LEFT = 0.03
"""Minimum share of an offset's information that delays leave: with less, slopes do not determine its size."""

SIZES_M = np.geomspace(3e-4, 0.2, 60)
"""Possible standard deviations of offsets; a larger offset is a detour, and counts as a reflection."""


def place_covariance(
    found: RangeFit, slopes: Slopes, pairs: Tested, before_ns2: Floats
) -> tuple[Floats, list[Finding]]:
    """Return the covariance (tags, tags) that place-dependent errors add to that of the delays, and a finding if they
    matter.

    `pairs` are the slopes of offsets by pair, `before_ns2` is the covariance without places. Nothing is found if no
    body is known to carry two tags.
    """
    nothing = np.zeros_like(before_ns2), list[Finding]()
    group = _pairs_of_bodies(found)
    if group is None:
        return nothing
    sums = np.eye(int(group.max()) + 1)[:, group]
    values, reach = _constant_part(pairs, sums)
    variance, deviation = _varying_part(found, slopes, sums)
    # The significance of the constant part, as a deviation of one normal value.
    stays = -float(special.ndtri(special.chdtrc(max(len(values), 1), float(values @ values))))
    together = _simultaneous_reflections(found, group)
    certain = _chance(deviation, stays) < FIT_LEVELS["places"]
    if max(deviation, stays, together) <= WIDENING_DEVIATION:
        return nothing
    spread = 1 + reach[:, None] * SIZES_M**2
    likely = -0.5 * np.sum(np.log(spread) + values[:, None] ** 2 / spread, axis=0)
    # A partition or two that are always in between add 2 cm, within a factor of e.
    middle, width = 0.02, 1.0
    if deviation > WIDENING_DEVIATION:
        # The constant part is as large as the varying one, within 0.8 logarithms (a factor of 2.2, a judgement): in
        # rooms of the simulator it was 1.2 to 4 times as large, in smooth fields of errors a sixth to two thirds.
        middle, width = np.sqrt(variance), 0.8
    elif stays <= WIDENING_DEVIATION:
        # Trajectories followed reflections by 0.4 to 1.9 cm (three flights in a hall of metal, six of tests).
        middle, width = 0.01, 0.8
    effects = _deviation_of_mixture(likely - 0.5 * (np.log(SIZES_M / middle) / width) ** 2) * pairs.effects @ sums.T
    widening = effects @ effects.T
    # The common part of all delays also depends on the curve, and is far less certain.
    apart = np.eye(len(before_ns2)) - 1 / max(len(before_ns2), 1)
    own, more = (np.diag(apart @ one @ apart) for one in (before_ns2, widening))
    p_value = _chance(deviation, stays, together)
    if p_value >= FIT_LEVELS["places"] or not np.any(more > np.maximum(own, SMALLEST_NS**2)):
        return widening, []
    near, directions = "as near walls and objects", "pattern" not in found.model.covariates
    wrong = f"reflected together, {near}, and trajectories may have followed them"
    if certain:
        other = ", or an antenna whose delay depends on the direction" * directions
        wrong = f"wrong together, {near}, or a wrong lever arm{other}"
    text = (
        f"errors depend on places{' or directions' * (certain and directions)}: ranges between the same two bodies "
        f"are {wrong}, which may change differences of delays by {1e3 * np.sqrt(more.max()):.0f} ps; intervals are "
        f"widened for this"
    )
    return widening, [warning("errors of places", text, p_value)]


def _chance(*deviations: float) -> float:
    """Return the p-value of the largest of some of the three deviations, by the normal distribution (Bonferroni).

    They are those of the varying part, the constant part, and simultaneous reflections.
    """
    return min(1.0, 3 * float(special.ndtr(-max(deviations))))


def _deviation_of_mixture(likely: Floats) -> float:
    """Return the standard deviation with the 95 % interval of the mixture of all sizes, by their log likelihoods."""
    weight = np.exp(likely - likely.max())
    within = 2 * special.ndtr(TWO_SIDED_95 * SIZES_M[:, None] / SIZES_M) - 1
    return float(np.interp(0.95, within @ (weight / weight.sum()), SIZES_M))


def _pairs_of_bodies(found: RangeFit) -> Ints | None:
    """Return the number of the two bodies of each pair (pairs,); None if no two pairs have the same bodies."""
    carried = dict(found.model.ranges.bodies)
    if found.model.settings.constants == "pair" or not carried:
        return None
    ends = [frozenset(carried.get(tag, f"tag {tag}") for tag in both) for both in found.model.pairs.ends.tolist()]
    groups = list(dict.fromkeys(ends))
    return np.array([groups.index(both) for both in ends]) if len(groups) < len(ends) else None


def _constant_part(pairs: Tested, sums: Floats) -> tuple[Floats, Floats]:
    """Return the parts (k,) of offsets of groups of pairs that delays do not absorb, with unit variance without
    offsets.

    Also returns the derivative (k,) of their variances by the variance of offsets, in 1/m^2; `sums` (groups, pairs)
    maps pairs to groups.
    """
    total, information = sums @ pairs.total, sums @ pairs.information @ sums.T
    values, vectors = np.linalg.eigh(information)
    base = vectors[:, values > INFORMATION_LEFT * pairs.whole]
    variances, turned = np.linalg.eigh(base.T @ sums @ pairs.covariance @ sums.T @ base)
    sure = variances > 1e-9 * variances.max(initial=0.0)
    root = base @ turned[:, sure] / np.sqrt(variances[sure])
    through = root.T @ information
    reach, turned = np.linalg.eigh(through @ through.T)
    reach = np.maximum(reach, 0.0)
    largest = np.sqrt(1 + reach * (SIZES_M[-1] / 2) ** 2)
    return np.clip(turned.T @ root.T @ total, -largest, largest), reach


def _varying_part(found: RangeFit, slopes: Slopes, sums: Floats) -> tuple[float, float]:
    """Return the variance of varying errors that pairs of a group share, and its deviation from zero in standard
    errors.

    Products of slopes of different pairs of a group in the same second are summed: noise, and reflections of single
    pairs, contribute zero on average.
    """
    pair, second = found.model.pairs.number[slopes.order], _seconds(found.blocks)
    count, size = int(second[-1]) + 1, sums.shape[1]
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
        return 0.0, 0.0
    return float(product.sum()) / reach, float(product.sum()) / spread


def _seconds(blocks: TimeBlocks) -> Ints:
    """Return the second of each range (n,): bodies are in the same places for about a second."""
    each = max(round(1.0 * blocks.count / max(blocks.seconds, 1e-9)), 1)
    return np.asarray(blocks.number // each)


def _simultaneous_reflections(found: RangeFit, group: Ints) -> float:
    """Return the significance of simultaneous reflections of different pairs of a group (pairs,), in standard
    deviations.

    Estimated trajectories absorb a common error of all ranges between two bodies, which then leaves no residuals.
    Reflected ranges still occur at the same times. The value is 0 where distances are known.
    """
    fitted, pair = found.searches[-1], found.model.pairs.number
    if fitted.rows.geometry is None:
        return 0.0
    looks = fitted.rows.error_slopes(fitted.optimum.x, ("odds",))
    second, count = _seconds(found.blocks), np.bincount(pair)
    reflected, by_power = (
        values - (np.bincount(pair, values) / count)[pair]
        for values in (looks.reflected, looks.reflected - looks.by["odds"])
    )
    # Reflections reduce powers, and powers of all pairs change with distance: the smaller value of those with and
    # without the part explained by power is used.
    explained = by_power * (by_power @ reflected) / max(float(by_power @ by_power), 1e-300)
    return min(_correlation_of_pairs(values, second, pair, group) for values in (reflected, reflected - explained))


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
