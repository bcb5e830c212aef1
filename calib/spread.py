"""Robust spread of values, all together or by groups, and the factor of 95 % intervals."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import ndimage
from scipy.special import stdtrit

from uwblink.arrays import Floats, Ints

__all__ = [
    "SIGMA_OF_MAD",
    "STD_OF_MEDIAN",
    "TWO_SIDED_95",
    "less_medians",
    "medians",
    "robust_spread",
    "spreads",
    "students_factor",
]

TWO_SIDED_95: Final = 1.959963984540054
"""Standard deviations about the mean that contain 95 % of a normal distribution."""

SIGMA_OF_MAD: Final = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

STD_OF_MEDIAN: Final = 1.2533
"""Standard error of a median over that of a mean, of normal values: the root of pi/2."""


def students_factor(freedom: float) -> float:
    """Return the ratio of the 95 % intervals of Student's t with so many degrees of freedom and of a normal value."""
    return float(stdtrit(freedom, 0.975)) / TWO_SIDED_95


def robust_spread(values: Floats, centre: float | None = None) -> float:
    """Return 1.4826 times the median absolute deviation of values (n,): their standard deviation, were they normal.

    Deviations are from the median, unless another `centre` is known.
    """
    middle = np.median(values) if centre is None else centre
    return SIGMA_OF_MAD * float(np.median(np.abs(values - middle)))


def medians(values: Floats, group: Ints) -> Floats:
    """Return the median of the values (n,) of each group (k,), by the numbers of groups (n,), which all have some."""
    return np.asarray(ndimage.median(values, group, np.arange(group.max() + 1))) if len(values) else np.zeros(0)


def less_medians(values: Floats, group: Ints) -> Floats:
    """Return values (n,) less the median of their group (n,)."""
    return np.asarray(values - medians(values, group)[group])


def spreads(values: Floats, group: Ints) -> Floats:
    """Return the robust spread of the values (n,) of each group (k,)."""
    return SIGMA_OF_MAD * medians(np.abs(less_medians(values, group)), group)
