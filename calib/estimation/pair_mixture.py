"""Delays, curves and what the errors are made of, in one likelihood: reflections that differ by pair and by power.

Each pair has a share of reflected ranges, a mean detour and a noise of its own; each is drawn to what all pairs have in
common by how little the pair's own ranges say (empirical Bayes: the spreads between pairs are estimated along, by the
fixed point of Fellner and Schall). Share and noise also vary with power, in steps. Everything is estimated together by
Fisher's scoring with the squared slopes as information (Berndt, Hall, Hall, Hausman 1974), so the covariance of delays
and curves contains what the rest leaves open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.densities import LongDetours
from calib.estimation.mixture_slopes import SLOPES, Errors, Layout, long_detours, scores_at, slopes_at, sums_at
from calib.estimation.mixture_start import SPREADS, Prior, begin, between_pairs
from calib.estimation.scores import Scores, inverse_of
from uwblink.arrays import Floats

LEVELS: Final = 6
"""Each sample on which the fit converges has so many times the rows of the one before."""

FIRST_SAMPLE: Final = 9000
MAX_STEPS: Final = 60
PATIENCE: Final = 20
"""Steps after which it is enough that delays and curves stand still: a share of nothing may be any small number."""

ADAPTING: Final = 10
"""Steps after which variances between pairs stand, and steps are halved at first: two points that lead to each other
have their middle between them.
"""

SHORT: Final = 0.8
LONG: Final = 0.3
LONGEST: Final = 8.0
SHORTEST: Final = 0.25
"""Shares of what was promised above which a step was short and below which it was long, and bounds of its length."""

SETTLED: Final = 1e-2
"""A step that promises less log likelihood than this by delays and curves ends it: a tenth of a standard error."""

NEARLY: Final = 0.3
"""The same for all parameters together, of which there are many that delays do not depend on."""

ROUGHLY: Final = 1.0
"""The same on a sample, from which more ranges lead away by tens."""

CHORD: Final = 0.5
"""Nearer than this to the top, the information is that of the last point where it was asked for."""

LONGEST_STEP: Final = 0.7
"""Of a logarithm or a log odds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairMixture:
    """The likeliest parameters (D,), their model covariance (D, D), the slopes of every range there, and how it ended.

    `tail_share`, `tail_mean_m` and `noise` (pairs,) say what each pair's errors are made of, `noise` in the common one.
    """

    layout: Layout
    parameters: Floats
    covariance: Floats
    precision: Floats
    scores: Scores
    steps: int
    success: bool

    def of(self, sort: str) -> Floats:
        """Return the parameters of a sort."""
        return self.parameters[self.layout.slices()[sort]]

    def slope(self, name: str) -> Floats:
        """Return every range's slope by its own parameter of a kind of `SLOPES` (n,), in the order of given rows."""
        return self.scores.design.given(self.scores.slopes[SLOPES.index(name)])

    @property
    def tail_share(self) -> Floats:
        """Share of reflected ranges of each pair, at the middle step of power."""
        return np.asarray(1 / (1 + np.exp(-self.of("pair_share") - np.mean(self.of("cell_share")))))

    @property
    def tail_mean_m(self) -> Floats:
        """Mean detour of each pair's reflected ranges."""
        return np.asarray(np.exp(self.of("least")[0]) + self.mean_m * np.exp(self.of("pair_mean")))

    @property
    def mean_m(self) -> float:
        """Mean of the exponential detours of both kinds, without the factors of pairs."""
        return self.long.mean * (self.layout.shortest_m + float(np.exp(self.of("mean")[0])))

    @property
    def long(self) -> LongDetours:
        """Return the second kind of detour."""
        return long_detours(self.of("long_share"))

    @property
    def noise(self) -> Floats:
        """Noise of each pair over the common one."""
        return np.exp(self.of("pair_noise"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Top:
    """The top of a likelihood: parameters (D,), what is known beforehand, and how it was climbed."""

    layout: Layout
    parameters: Floats
    prior: Prior
    steps: int
    success: bool

    def slope(self, errors: Errors, name: str) -> Floats:
        """Return every range's slope by its own parameter of a kind of `SLOPES` (n,), in the order of given rows."""
        return errors.design.given(slopes_at(errors, self.layout, self.parameters, name))


def fit_pair_mixture(errors: Errors, start: Floats, ridge: Floats, lasting: float = 1.0) -> PairMixture:
    """Return the likeliest parameters and what is known of them; takes what `foot_of` takes."""
    return described(errors, climbed(foot_of(errors, start, ridge), lasting))


@dataclass(frozen=True, slots=True, kw_only=True)
class Foot:
    """Where a climb begins: samples of growing size, everything last, parameters (D,) and what is known beforehand."""

    layout: Layout
    samples: list[Errors]
    parameters: Floats
    prior: Prior


def foot_of(errors: Errors, start: Floats, ridge: Floats) -> Foot:
    """Return where to climb from, by a robust `start` (m,) of the parameters of the design.

    `ridge` (m, m) is the inverse covariance of what is known of them beforehand, in 1/m^2.
    """
    layout, theta, prior = begin(errors, start, ridge)
    return Foot(layout=layout, samples=list(_levels(errors)), parameters=theta, prior=prior)


def climbed(foot: Foot, lasting: float = 1.0) -> Top:
    """Return the likeliest parameters, where ranges count for independent that last so many times longer."""
    theta, prior = foot.parameters, replace(foot.prior, lasting=lasting)
    steps, success = 0, False
    for some in foot.samples:
        nearly = NEARLY if some is foot.samples[-1] else ROUGHLY
        theta, prior, taken, success = _climb(some, foot.layout, theta, prior, nearly)
        steps += taken
    return Top(layout=foot.layout, parameters=theta, prior=prior, steps=steps, success=success)


def described(errors: Errors, top: Top) -> PairMixture:
    """Return the top of a likelihood with every range's slopes and the covariance there."""
    scores, sums = scores_at(errors, top.layout, top.parameters)
    return PairMixture(
        layout=top.layout,
        parameters=top.parameters,
        covariance=inverse_of(sums.information() + top.prior.weighed, top.layout.pairs, len(SPREADS)),
        precision=top.prior.pull,
        scores=scores,
        steps=top.steps,
        success=top.success,
    )


def _levels(errors: Errors) -> Iterator[Errors]:
    """Yield samples of growing size, and everything last."""
    count = len(errors.error)
    order, size = np.random.default_rng(0).permutation(count), FIRST_SAMPLE
    while 2 * size < count:
        yield errors.sample(np.sort(order[:size]))
        size *= LEVELS
    yield errors


def _climb(
    errors: Errors, layout: Layout, theta: Floats, prior: Prior, nearly: float
) -> tuple[Floats, Prior, int, bool]:
    """Climb to the top of the likelihood of some errors: parameters, prior, steps, and whether it is the top."""
    best, top, step, shorter = -np.inf, theta, np.zeros_like(theta), 0
    information, gain, length, promised = np.zeros((0, 0)), np.inf, 1.0, 0.0
    for steps in range(1, MAX_STEPS + 1):
        fresh = steps == 1 or gain > CHORD
        sums, likelihood = sums_at(errors, layout, theta, squares=fresh)
        value = likelihood - 0.5 * float((theta - prior.centre) @ prior.weighed @ (theta - prior.centre))
        if value < best - SETTLED and shorter < 6:
            step, shorter, promised = 0.3 * step, shorter + 1, 0.0
            theta = top + step
            continue
        if steps == ADAPTING + 1:
            length = 0.5
        elif steps > ADAPTING and promised > 0:
            length = _length(length, (value - best) / promised)
        information = sums.information() if fresh else information
        covariance = inverse_of(information + prior.weighed, layout.pairs, len(SPREADS))
        slope = sums.gradient() - prior.weighed @ (theta - prior.centre)
        step, shorter = covariance @ slope, 0
        own = slice(0, layout.columns)
        still = abs(float(slope[own] @ step[own])) < SETTLED
        gain = float(slope @ step)
        if still and (gain < nearly or steps > PATIENCE):
            return theta, prior, steps, True
        longest = float(np.max(np.abs(step[layout.columns :])))
        step *= min(length, LONGEST_STEP / max(longest, 1e-12))
        promised = float(slope @ step)
        top, theta = theta, theta + step
        if steps <= ADAPTING:
            prior = between_pairs(theta, prior, layout, covariance)
        best = likelihood - 0.5 * float((top - prior.centre) @ prior.weighed @ (top - prior.centre))
    return theta, prior, steps, False


def _length(before: float, kept: float) -> float:
    """Return how much of a step to take, by the share that the last one kept of what its slope promised.

    Squared slopes are not quite the curvature: a step to the top keeps a half, one that keeps all was short.
    """
    if kept > SHORT:
        return min(2 * before, LONGEST)
    return max(before / 2, SHORTEST) if kept < LONG else before
