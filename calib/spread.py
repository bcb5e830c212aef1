"""Robust spread of values, and the factor of 95 % intervals."""

from __future__ import annotations

from typing import Final

import numpy as np

from uwblink.arrays import Floats

__all__ = ["SIGMA_OF_MAD", "TWO_SIDED_95", "robust_spread"]

TWO_SIDED_95: Final = 1.959963984540054
"""Standard deviations about the mean that contain 95 % of a normal distribution."""

SIGMA_OF_MAD: Final = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def robust_spread(values: Floats, centre: float | None = None) -> float:
    """Return 1.4826 times the median absolute deviation of values (n,): their standard deviation, were they normal.

    Deviations are from the median, unless another `centre` is known.
    """
    middle = np.median(values) if centre is None else centre
    # Of millions of values one copy at a time: it is made absolute, and put into order, where it lies.
    apart = np.asarray(values - middle)
    np.abs(apart, out=apart)
    return SIGMA_OF_MAD * float(np.median(apart, overwrite_input=True))
