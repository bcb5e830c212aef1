"""B-splines evaluated in columns: the few that are not zero at each point, by the recursion of Cox and de Boor.

De Boor, A Practical Guide to Splines, chapter X, for many points at once. scipy does the same in general, with the same
bits; this is what fits and scenarios need of it, without the third of a second that importing `scipy.interpolate`
takes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints

ROWS_AT_ONCE: Final = 8192
"""Points evaluated together, so that what leads to them stays in the cache."""


def nonzero(x: Floats, knots: Floats, degree: int) -> tuple[Ints, list[Floats]]:
    """Return at points (n,) inside the knots the number of the first spline that is not zero, and degree + 1 values.

    The value k, shape (n,), is that of the spline `first + k`.
    """
    count = len(knots) - degree - 1
    span = np.clip(np.searchsorted(knots, x, side="right") - 1, degree, count - 1)
    above = [knots[span + n] for n in range(1, degree + 1)]
    below = [knots[span - n] for n in range(degree)]
    values = [np.ones_like(x)]
    for j in range(1, degree + 1):
        before, values = values, [np.zeros_like(x)]
        for n in range(1, j + 1):
            high, low = above[n - 1], below[j - n]
            share = before[n - 1] / (high - low)
            values[n - 1] = values[n - 1] + share * (high - x)
            values.append(share * (x - low))
    return span - degree, values


def combination(x: Floats, knots: Floats, coefficients: Floats, degree: int) -> Floats:
    """Return the sum of splines times coefficients (m,) or (m, k) at points (n,): (n,) or (n, k).

    Beyond the inner knots the end pieces go on.
    """
    if len(x) > ROWS_AT_ONCE:
        pieces = [x[begin : begin + ROWS_AT_ONCE] for begin in range(0, len(x), ROWS_AT_ONCE)]
        return np.concatenate([combination(piece, knots, coefficients, degree) for piece in pieces])
    first, values = nonzero(x, knots, degree)
    wide = (slice(None), *(None,) * (coefficients.ndim - 1))
    total = np.zeros((len(x), *coefficients.shape[1:]))
    for k, value in enumerate(values):
        total += coefficients[first + k] * value[wide]
    return total


def matrix(x: Floats, knots: Floats, degree: int) -> Floats:
    """Return every spline at points (n,) inside the knots, shape (n, m)."""
    first, values = nonzero(x, knots, degree)
    dense = np.zeros((len(x), len(knots) - degree - 1))
    flat, start = dense.ravel(), np.arange(len(x)) * dense.shape[1] + first
    for k, value in enumerate(values):
        flat[start + k] = value
    return dense


def derivative(knots: Floats, degree: int) -> tuple[Floats, Floats]:
    """Return what turns coefficients into those of the derivative, (m - 1, m), and the knots of the latter."""
    count = len(knots) - degree - 1
    spans = knots[degree + 1 : degree + count] - knots[1:count]
    return np.diff(np.eye(count), axis=0) * (degree / spans)[:, None], knots[1:-1]


@dataclass(frozen=True, slots=True)
class BSpline:
    """A spline by knots (m + degree + 1,) that rise, and coefficients (m,) or (m, k)."""

    knots: Floats
    coefficients: Floats
    degree: int

    def __call__(self, x: Floats) -> Floats:
        """Return it at points (n,), beyond the inner knots its end pieces: (n,), or (n, k)."""
        return combination(x, self.knots, self.coefficients, self.degree)
