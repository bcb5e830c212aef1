"""Tails of the normal and of Student's distribution, in NumPy: to import SciPy's takes longer than to fit a flight."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from uwblink.arrays import Floats

TWO_SIDED_95: Final = 1.959963984540054
"""How many standard deviations about its mean hold 95 % of a normal distribution."""

CENTRE: Final = 3.0
"""Where the variable of the series below is zero."""

SERIES: Final = (
    1.2530080582697296,
    -0.13562110612457576,
    -0.04756229435342038,
    0.12964515870228346,
    -0.11927366341676002,
    0.06830802735638397,
    -0.023770514891530075,
    0.0025293916672051724,
    0.0018886900977441495,
    -0.0007798312797290158,
    -0.00010515831297813128,
    0.00012509531076254534,
    4.94412434222366e-06,
    -2.0089997833284275e-05,
    -7.187883834404266e-07,
    3.454294770277738e-06,
    3.3669790806407595e-07,
    -5.963983625522741e-07,
    -1.205414228648938e-07,
    8.765881411730558e-08,
    2.7843881265502222e-08,
    -7.641962892589975e-09,
    -3.1813541434969274e-09,
)
"""Coefficients of (1 + 2x) erfcx(x) in powers of t = (x - 3)/(x + 3): Chebyshev's of 80 nodes, found with 60 digits."""

DOWNWARDS: Final = SERIES[-2::-1]
FEW: Final = 8
"""Values up to which Python's own arithmetic is quicker than to call NumPy's for each coefficient."""

STEPS: Final = 100


def erfcx(x: Floats) -> Floats:
    """Return exp(x^2) erfc(x) of values (n,), to a relative 2e-15; it overflows below -26.

    One polynomial for all x from 0 (in the form of Shepherd and Laframboise 1981), and 2 exp(x^2) less that beyond.
    """
    size = np.abs(x)
    t = (size - CENTRE) / (size + CENTRE)
    found = _series(t)
    found /= 1 + 2 * size
    below = x < 0
    if below.any():
        some = size[below]
        found[below] = 2 * np.exp(some * some) - found[below]
    return found


def _series(t: Floats) -> Floats:
    """Return the sum of the series at values (n,), by Horner's rule; of few value by value, to the same bits."""
    if t.size <= FEW:
        return np.array([_at(value) for value in t.ravel().tolist()], dtype=float).reshape(t.shape)
    found = np.full_like(t, SERIES[-1])
    for coefficient in DOWNWARDS:
        found *= t
        found += coefficient
    return found


def _at(value: float) -> float:
    found = SERIES[-1]
    for coefficient in DOWNWARDS:
        found = found * value + coefficient
    return found


def normal_below(x: Floats) -> Floats:
    """Return the share of a standard normal distribution below values (n,)."""
    size = np.minimum(np.abs(x), 40.0)
    beyond = 0.5 * erfcx(size * math.sqrt(0.5)) * np.exp(-0.5 * size * size)
    return np.where(x < 0, beyond, 1 - beyond)


def log_normal_below(x: Floats) -> Floats:
    """Return the logarithm of the share of a standard normal distribution below values (n,), exact far below too."""
    size = np.abs(x)
    beyond = 0.5 * erfcx(size * math.sqrt(0.5))
    with np.errstate(divide="ignore"):
        far = np.log(beyond) - 0.5 * size * size
    return np.where(x < 0, far, np.log1p(-np.exp(far)))


def students_quantile(freedom: float, share: float) -> float:
    """Return the value that a share between a half and 1 of Student's distribution lies below (Newton's steps)."""
    wanted = 2 * (1 - share)
    scale = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(freedom * math.pi)
    value = 0.0
    # The tail is convex beyond zero, so steps from below never overshoot.
    for _ in range(STEPS):
        slope = 2 * scale * (1 + value * value / freedom) ** (-(freedom + 1) / 2)
        step = (students_beyond(freedom, value) - wanted) / slope
        value += step
        if abs(step) <= 1e-14 * value:
            break
    return value


def students_beyond(freedom: float, value: float) -> float:
    """Return the share of Student's distribution farther from zero than a value: the incomplete beta function of
    freedom/2 and 1/2, by its continued fraction (DLMF 8.17.22), on the side where that converges.
    """
    x = freedom / (freedom + value * value)
    if x == 1:
        return 1.0
    a, b = freedom / 2, 0.5
    front = math.exp(math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x))
    if x < (a + 1) / (a + b + 2):
        return front / (a * _fraction(a, b, x))
    return 1 - front / (b * _fraction(b, a, 1 - x))


def _fraction(a: float, b: float, x: float) -> float:
    """Return the continued fraction of the incomplete beta function, from its far end, where it has long settled."""
    found = 1.0
    for m in range(int(50 + 4 * math.sqrt(a + b)), -1, -1):
        even = (m + 1) * (b - m - 1) * x / ((a + 2 * m + 1) * (a + 2 * m + 2))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        found = 1 + odd / (1 + even / found)
    return found
