"""B-splines evaluated in columns: the few that are not zero at each point, by the recursion of Cox and de Boor.

Piegl and Tiller, The NURBS Book, algorithm A2.2, for many points at once. scipy does the same in general; this is what
a fit needs of it, without the quarter of a second that importing `scipy.interpolate` takes.
"""

from __future__ import annotations

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
    left = [x - knots[span + 1 - j] for j in range(1, degree + 1)]
    right = [knots[span + j] - x for j in range(1, degree + 1)]
    values = [np.ones_like(x)]
    for j in range(1, degree + 1):
        saved = np.zeros_like(x)
        for r in range(j):
            share = values[r] / (right[r] + left[j - r - 1])
            values[r] = saved + right[r] * share
            saved = left[j - r - 1] * share
        values.append(saved)
    return span - degree, values


def combination(x: Floats, knots: Floats, coefficients: Floats, degree: int) -> Floats:
    """Return the sum of splines times coefficients (m,) at points (n,) inside the knots."""
    if len(x) > ROWS_AT_ONCE:
        pieces = [x[begin : begin + ROWS_AT_ONCE] for begin in range(0, len(x), ROWS_AT_ONCE)]
        return np.concatenate([combination(piece, knots, coefficients, degree) for piece in pieces])
    first, values = nonzero(x, knots, degree)
    total = coefficients[first] * values[0]
    for k in range(1, degree + 1):
        total += coefficients[first + k] * values[k]
    return np.asarray(total)


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
