"""Gains over direction by a few coefficients: real spherical harmonics."""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial, isqrt, sqrt

import numpy as np

from uwblink.arrays import Floats


def harmonics(direction: Floats, degree: int) -> Floats:
    """Return the real spherical harmonics of degree 0 to `degree` at unit vectors (n, 3), (n, (degree + 1)^2).

    In order of degree l, and in each of m from -l to l: the sine of azimuth for negative ones. Their root mean square
    over all directions is one.
    """
    from scipy.special import lpmv

    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    height = np.clip(direction[:, 2], -1, 1)
    columns = []
    for l in range(degree + 1):  # noqa: E741 - the letter that everybody writes
        for m in range(-l, l + 1):
            scale = sqrt((2 * l + 1) * factorial(l - abs(m)) / factorial(l + abs(m)) * (2 if m else 1))
            # lpmv has the sign of Condon and Shortley, which is taken out again.
            wave = (-1) ** m * (np.sin(-m * azimuth) if m < 0 else np.cos(m * azimuth))
            columns.append(scale * lpmv(abs(m), l, height) * wave)
    return np.column_stack(columns)


def pattern_gain_db(coefficients: Sequence[float], direction: Floats) -> Floats:
    """Return the gain in dB that coefficients stand for at unit vectors (n, 3) in the body's frame, (n,)."""
    return np.asarray(harmonics(direction, isqrt(len(coefficients)) - 1) @ np.array(coefficients))
