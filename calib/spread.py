"""Robust standard deviations of values, of all or by group, and the factor of 95 % intervals."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import ndimage, special

from uwblink.arrays import Floats, Ints

__all__ = [
    "SIGMA_OF_MAD",
    "STD_OF_MEDIAN",
    "TWO_SIDED_95",
    "less_medians",
    "medians",
    "radius_95",
    "robust_spread",
    "spreads",
    "students_factor",
]

TWO_SIDED_95: Final = 1.959963984540054
"""97.5 % quantile of the standard normal distribution: half of a 95 % interval, in standard deviations."""

SIGMA_OF_MAD: Final = 1.4826
"""Ratio of the standard deviation of a normal distribution to its median absolute deviation."""

STD_OF_MEDIAN: Final = 1.2533
"""Ratio of the standard errors of the median and of the mean of many normal values: the root of pi/2."""


def radius_95(covariance: Floats) -> float:
    """Return the distance from the mean within which 95 % of a normal distribution with a covariance (k, k) lie.

    The squared distance is taken as a scaled chi-square with the same mean and variance (Satterthwaite 1946), which is
    exact for equal variances, also if some of them are zero.
    """
    mean, square = float(np.trace(covariance)), float(np.sum(np.square(covariance)))
    return float(np.sqrt(special.chdtri(mean**2 / square, 0.05) * square / mean)) if mean > 0 else 0.0


def students_factor(freedom: float) -> float:
    """Return the ratio of the 95 % intervals of Student's t with so many degrees of freedom and of a normal value."""
    return float(special.stdtrit(freedom, 0.975)) / TWO_SIDED_95


def robust_spread(values: Floats, centre: float | None = None) -> float:
    """Return 1.4826 times the median absolute deviation of values (n,), the standard deviation of normal values.

    Deviations are from `centre`, by default the median.
    """
    middle = np.median(values) if centre is None else centre
    return SIGMA_OF_MAD * float(np.median(np.abs(values - middle)))


def medians(values: Floats, group: Ints) -> Floats:
    """Return the median of the values (n,) in each group (k,).

    `group` (n,) is the number of each value's group, from 0; no group may be empty.
    """
    return np.asarray(ndimage.median(values, group, np.arange(group.max() + 1))) if len(values) else np.zeros(0)


def less_medians(values: Floats, group: Ints) -> Floats:
    """Return values (n,) minus the median of their `group` (n,)."""
    return np.asarray(values - medians(values, group)[group])


def spreads(values: Floats, group: Ints) -> Floats:
    """Return the robust standard deviation of the values (n,) in each group (k,)."""
    return SIGMA_OF_MAD * medians(np.abs(less_medians(values, group)), group)
