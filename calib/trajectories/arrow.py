"""Normal equations in the shape of an arrow: unknowns in order of time, which meet only near ones, and a border.

The unknowns of a trajectory have a banded matrix H; the few of the border (delays, curves, anchors) meet them all. The
band is factored once (Cholesky), and the border is solved by Schur's complement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.errors import UnanswerableError
from uwblink.arrays import Floats

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, slots=True)
class Normal:
    """Weighted squares of a Jacobian: those of the band (L, L) sparse, between band and border (L, b), and (b, b)."""

    band: csr_array[Any]
    across: Floats
    border: Floats

    def __add__(self, other: Normal) -> Normal:
        """Return the sum of two."""
        return Normal(self.band + other.band, self.across + other.across, self.border + other.border)


def normal_of(local: csr_array[Any], border: Floats, weight: Floats) -> Normal:
    """Return J' W J of rows with a sparse part (n, L), a dense one (n, b) and weights (n,)."""
    weighted = local.multiply(weight[:, None]).tocsr()
    return Normal((local.T @ weighted).tocsr(), np.asarray(weighted.T @ border), border.T @ (border * weight[:, None]))


class Factored:
    """A solved arrow: `schur` (b, b) is what is known of the border, `reach` (L, b) is the band's inverse on it."""

    def __init__(self, normal: Normal, damping: float = 0.0) -> None:
        """Factor; `damping` adds so much of each diagonal entry. Raises `UnanswerableError` where that fails."""
        from scipy.linalg import LinAlgError, cholesky_banded

        size = normal.band.shape[0]
        self._factor: Floats | None = None
        self.reach = np.zeros((size, normal.border.shape[1]))
        if size:
            band = _lower_band(normal.band)
            band[0] = band[0] * (1 + damping) + 1e-9 * float(band[0].max())
            try:
                self._factor = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
            except LinAlgError as error:
                raise UnanswerableError("the ranges leave a part of the trajectories without any hold") from error
            self.reach = self._solved(normal.across)
        border = normal.border + damping * np.diag(np.diag(normal.border))
        self.schur = border - normal.across.T @ self.reach

    def solve(self, local: Floats, border: Floats) -> tuple[Floats, Floats]:
        """Return the solution for a right-hand side (L,) and (b,)."""
        inner = self._solved(local) if len(local) else local
        outer = np.linalg.lstsq(self.schur, border - self.reach.T @ local, rcond=1e-13)[0] if len(border) else border
        return np.asarray(inner - self.reach @ outer), np.asarray(outer, dtype=np.float64)

    def inverse_on(self, local: Floats) -> Floats:
        """Return the band's inverse times columns (L, k)."""
        return self._solved(local)

    def _solved(self, right: Floats) -> Floats:
        from scipy.linalg import cho_solve_banded

        if self._factor is None or not right.size:
            return np.zeros_like(right)
        return np.asarray(cho_solve_banded((self._factor, True), right, check_finite=False))


def _lower_band(matrix: csr_array[Any]) -> Floats:
    entries = matrix.tocoo()
    below = entries.row >= entries.col
    row, column, value = entries.row[below], entries.col[below], entries.data[below]
    band = np.zeros((int((row - column).max(initial=0)) + 1, matrix.shape[0]))
    band[row - column, column] = value
    return band
