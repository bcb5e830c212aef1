"""The robust spread of values, which a few outliers do not move."""

from __future__ import annotations

from typing import Final

import numpy as np

from uwblink.arrays import Floats

SIGMA_OF_MAD: Final = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def robust_spread(values: Floats, centre: float | None = None) -> float:
    """Return 1.4826 times the median absolute deviation of values (n,): their standard deviation, were they normal.

    Deviations are from the median, unless another `centre` is known.
    """
    middle = np.median(values) if centre is None else centre
    return SIGMA_OF_MAD * float(np.median(np.abs(values - middle)))
