"""B-splines as scipy evaluates them, bit for bit, without the third of a second that importing it takes.

The recursion of de Boor (A Practical Guide to Splines, chapter X), many points at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints

ROWS_AT_ONCE: Final = 8192
"""Points evaluated together, so that what leads to them stays in the cache."""


@dataclass(frozen=True, slots=True)
class BSpline:
    """A spline by knots (m + degree + 1,) that rise, and coefficients (m,) or (m, k)."""

    knots: Floats
    coefficients: Floats
    degree: int

    def __call__(self, x: Floats) -> Floats:
        """Return it at points (n,), beyond the inner knots its end pieces: (n,), or (n, k)."""
        if len(x) <= ROWS_AT_ONCE:
            return self._block(x)
        begins = range(0, len(x), ROWS_AT_ONCE)
        return np.concatenate([self._block(x[begin : begin + ROWS_AT_ONCE]) for begin in begins])

    def _block(self, x: Floats) -> Floats:
        count = len(self.knots) - self.degree - 1
        span = np.clip(np.searchsorted(self.knots, x, side="right") - 1, self.degree, count - 1)
        values = self._nonzero(x, span)
        wide = (slice(None), *(None,) * (self.coefficients.ndim - 1))
        total = np.zeros((len(x), *self.coefficients.shape[1:]))
        for k, value in enumerate(values):
            total += self.coefficients[span - self.degree + k] * value[wide]
        return total

    def _nonzero(self, x: Floats, span: Ints) -> list[Floats]:
        """Return the values of the degree + 1 splines that are not zero at each point."""
        above = [self.knots[span + n] for n in range(1, self.degree + 1)]
        below = [self.knots[span - n] for n in range(self.degree)]
        values = [np.ones_like(x)]
        for j in range(1, self.degree + 1):
            before, values = values, [np.zeros_like(x)]
            for n in range(1, j + 1):
                high, low = above[n - 1], below[j - n]
                share = before[n - 1] / (high - low)
                values[n - 1] = values[n - 1] + share * (high - x)
                values.append(share * (x - low))
        return values
