"""The one covariance, a sandwich: squared slopes summed by block of time, between inverse information matrices.

Errors that share a cause (a reflection, a pose) last for some time, so a sum of many blocks varies more than a sum of
independent blocks. The ratio is estimated from the variances of sums over 1, 2, 4 ... blocks, all components pooled,
and fitted with an autocorrelation a rho^h (`persistence`). The covariance is corrected for the degrees of freedom that
the fit used (HC1 of MacKinnon and White 1985, for a penalised fit), and the bias by priors is added (Wahba 1983; Nychka
1988).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from calib.estimator.inverse import trace_of_product
from calib.estimator.optimize import Optimum
from calib.estimator.rows import Rows, sum_rows
from calib.estimator.score_tests import Slopes
from calib.estimator.time_blocks import Persistence, persistence
from calib.spread import students_factor
from uwblink.arrays import Floats, Ints

CURVE_SERIES = 5
"""Number of independent values of a smooth curve, over which the persistence of its errors is averaged: published ones
have four coefficients. Half or twice as many move no delay (`python -m benchmarks.constants`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """Unknowns (k,) whose errors have one persistence, estimated from `combinations` (m, k) with this number of
    independent ones."""

    indices: Ints
    combinations: Floats
    independent: int
    freedom: float = np.inf

    @classmethod
    def delays(cls, indices: Ints, each: float, held: Floats) -> Kept:
        """Return delays; `each` is the number of ranges per pair, `held` (k, m) are directions that ranges do not
        determine.

        Their common part is the constant of the curve and is excluded from the persistence, unless ranges determine
        only this part (as with one pair). The parameters of a pair's errors are known from its own ranges, so intervals
        are those of Student's t with as many degrees of freedom as a pair has ranges beyond one.
        """
        count = len(indices)
        determined = np.eye(count) - (held @ np.linalg.pinv(held) if held.size and count else 0.0)
        apart = determined - determined.sum(axis=0) / max(count, 1)
        # Clock skews leave some 1e-5 of a difference that ranges of one pair do not determine.
        apart = apart if np.linalg.norm(apart) > 1e-3 else determined
        return cls(indices=indices, combinations=apart, independent=max(count - 1, 1), freedom=max(each - 1, 2.0))

    @classmethod
    def curve(cls, indices: Ints) -> Kept:
        """Return the coefficients of a smooth curve."""
        return cls(indices=indices, combinations=np.eye(len(indices)), independent=CURVE_SERIES)

    def beside(self, indices: Ints) -> Kept:
        """Return these unknowns and others after them, which are too few to estimate how long their errors last.

        Errors of ranges of the same pairs cause the errors of both.
        """
        whole = block_diag(self.combinations, np.eye(len(indices)))
        return replace(self, indices=np.append(self.indices, indices), combinations=whole)


def sandwich(
    slopes: Slopes, kept: Mapping[str, Kept], beside: Sequence[Rows] = ()
) -> dict[str, tuple[Floats, Persistence]]:
    """Return the covariance (k, k) of each group of kept unknowns by its name, and the persistence of its errors.

    1.96 standard errors make 95 % intervals: the factor of small samples is included. For rows `beside` ranges (poses,
    tapes) the stated standard errors are used.
    """
    optimum, count, found = slopes.optimum, slopes.count, {}
    information, stated = optimum.information, optimum.priors.precision()
    if beside:
        information, others = (sum_rows(some, optimum.x).information for some in ([slopes.rows], beside))
        stated = stated + others
    # Slopes at the optimum are smaller than at the truth: with information I and penalty P, the squares of so many
    # ranges are smaller by the share tr((I + P)^-1 I) / n on average, the unknowns that ranges determine by their
    # number.
    used = trace_of_product(optimum.covariance, information)
    inflation = count / max(count - used, 0.2 * count)
    for name, group in kept.items():
        reach = optimum.covariance[:, group.indices]
        series = slopes.own @ reach
        lasting = persistence(series @ group.combinations.T, slopes.blocks, group.independent)
        width = students_factor(min(lasting.freedom, group.freedom))
        sampled = inflation * lasting.factor * width**2 * (series.T @ series)
        found[name] = sampled + reach.T @ (stated @ reach) + of_weights(optimum, group.indices), lasting
    return found


def of_weights(optimum: Optimum, keep: Ints) -> Floats:
    """Return the covariance (k, k) that uncertain weights of priors add to the covariance of some unknowns (k,).

    A change of the logarithm of a weight moves the unknowns by covariance times precision times their distance from the
    prior's centre. The variance of that logarithm is 2 over the degrees of freedom of the prior, as for the variance of
    so many values (first-order correction of Kass and Steffey 1989).
    """
    found = np.zeros((len(keep),) * 2)
    priors = optimum.priors
    for k, (where, prior) in enumerate(priors.all):
        if prior.bounds is not None:
            weight, structure, pulled = priors.weights[k], priors.structures[k], np.zeros(optimum.layout.size)
            pulled[where] = weight * np.asarray(structure @ (optimum.x[where] - prior.centre))
            pull = (optimum.covariance @ pulled)[keep]
            free = priors.ranks[k] - weight * trace_of_product(optimum.covariance, structure, where)
            found += np.outer(pull, pull) * (2 / max(free, 1.0))
    return found


def of_few_draws(optimum: Optimum, keep: Ints) -> Floats:
    """Return the covariance (k, k) that is added to the covariance of some unknowns (k,), because few values determine
    the variance of a prior: its part of the covariance is scaled from a normal distribution to Student's t."""
    found = np.zeros((len(keep),) * 2)
    for number, (_, prior) in enumerate(optimum.priors.all):
        if np.isfinite(prior.freedom):
            found += (students_factor(prior.freedom) ** 2 - 1) * of_prior(optimum, number, keep)
    return found


def of_prior(optimum: Optimum, number: int, keep: Ints) -> Floats:
    """Return the part (k, k) of the covariance of some unknowns (k,) that a prior, by its number, has as knowledge."""
    priors = optimum.priors
    reach = optimum.covariance[:, keep][priors.all[number][0]]
    return np.asarray(priors.weights[number] * reach.T @ (priors.structures[number] @ reach))
