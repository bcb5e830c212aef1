"""Inverses of information matrices: dense for few unknowns; for many, factors that give the columns asked for.

Flights have thousands of unknowns of which each meets few others. Whatever is asked of an inverse (its product with
vectors, some of its columns, a block of its diagonal, a trace) is written the same for both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from uwblink.arrays import Bools, Floats, Ints

MOST_DENSE = 400
"""Unknowns up to which matrices are dense: a dense factorisation takes as long as a sparse one of a flight there."""

PROBES = 24
"""Random vectors by which traces of large products are estimated (Hutchinson 1990), to some per cent."""

Matrix = Floats | sparse.csc_matrix


class SparseInverse:
    """The inverse (p, p) of a sparse positive definite matrix among free unknowns, zero elsewhere.

    Unknowns that meet many others (delays, curves) are the border of an arrow; the rest, ordered by Cuthill and McKee's
    method, have a banded matrix (control points meet near ones only). The band is factored by Cholesky's method, the
    border is solved by its Schur complement.
    """

    def __init__(self, matrix: sparse.csc_matrix, free: Ints, local: Bools | None = None) -> None:
        """Factor the matrix; unknowns are scaled to the same size first.

        `local` (p,) marks those that meet only near ones; without any that are marked, those that meet few are taken.
        """
        own = sparse.csc_matrix(matrix[free][:, free])
        self.shape, self._free = matrix.shape, free
        self._scale = 1 / np.sqrt(np.maximum(own.diagonal(), 1e-300))
        unit = sparse.diags(self._scale) @ own @ sparse.diags(self._scale) + 1e-13 * sparse.eye(len(free))
        unit = sparse.csr_matrix(unit)
        meets = np.diff(unit.indptr)
        wide = meets > 2 * np.median(meets) if local is None or not local.any() else ~local[free]
        inner = np.flatnonzero(~wide)
        inner = inner[reverse_cuthill_mckee(sparse.csr_matrix(unit[inner][:, inner]), symmetric_mode=True)]
        self._inner, self._border = inner, np.flatnonzero(wide)
        self._band = linalg.cholesky_banded(_lower_band(unit[inner][:, inner]), lower=True, check_finite=False)
        across = unit[inner][:, self._border].toarray()
        self._reach = self._solve_band(across)
        schur = unit[self._border][:, self._border].toarray() - across.T @ self._reach
        self._outer = inverse_of(schur, np.arange(len(schur)))

    def _solve_band(self, right: Floats) -> Floats:
        if not right.size:
            return np.zeros_like(right)
        return np.asarray(linalg.cho_solve_banded((self._band, True), right, check_finite=False))

    def __matmul__(self, right: Floats) -> Floats:
        """Return the inverse times a vector (p,) or columns (p, k)."""
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        given = scale * right[self._free]
        own = np.empty_like(given)
        inner = given[self._inner]
        own[self._border] = self._outer @ (given[self._border] - self._reach.T @ inner)
        own[self._inner] = self._solve_band(inner) - self._reach @ own[self._border]
        found = np.zeros(right.shape)
        found[self._free] = scale * own
        return found

    def __getitem__(self, key: tuple[Any, Any]) -> Floats:
        """Return some rows of some columns, as of an array."""
        rows, columns = key
        chosen = np.arange(self.shape[1])[columns]
        unit = np.zeros((self.shape[0], len(chosen)))
        unit[chosen, np.arange(len(chosen))] = 1.0
        return np.asarray((self @ unit)[rows])


Inverse = Floats | SparseInverse


def inverse_of(matrix: Matrix, free: Ints, local: Bools | None = None) -> Inverse:
    """Return the inverse (p, p) of a positive definite matrix among the free unknowns, zero elsewhere.

    Unknowns are scaled to the same size first; what neither rows nor priors determine is held by a share of 1e-13.
    """
    if sparse.issparse(matrix):
        return SparseInverse(matrix, free, local)
    found = np.zeros_like(matrix)
    if not len(free):
        return found
    own = matrix[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.maximum(np.diag(own), 1e-300))
    unit = own * scale[:, None] * scale
    unit[np.diag_indices_from(unit)] += 1e-13
    try:
        factor = linalg.cho_factor(unit, lower=True, check_finite=False)
        inverse = linalg.cho_solve(factor, np.eye(len(free)), check_finite=False)
    except linalg.LinAlgError:
        values, vectors = np.linalg.eigh(unit)
        inverse = (vectors / np.maximum(np.abs(values), 1e-13)) @ vectors.T
    found[np.ix_(free, free)] = inverse * scale[:, None] * scale
    return found


def trace_of_product(inverse: Inverse, matrix: Matrix, where: slice = slice(None)) -> float:
    """Return the trace of the block `where` of an inverse times a symmetric matrix (k, k), estimated for a sparse one.

    For an information matrix that is how many unknowns the rows determine, for a prior how many it does.
    """
    if isinstance(inverse, SparseInverse):
        probes = np.zeros((inverse.shape[0], PROBES))
        probes[where] = np.random.default_rng(0).choice([-1.0, 1.0], (matrix.shape[0], PROBES))
        return float(np.sum(probes[where] * (matrix @ (inverse @ probes)[where]))) / PROBES
    if sparse.issparse(matrix):
        return float(matrix.multiply(inverse[where, where]).sum())
    return float(np.sum(inverse[where, where] * matrix))


def _lower_band(matrix: sparse.csr_matrix) -> Floats:
    """Return the diagonals (width, n) of a symmetric matrix from the main one down, as LAPACK has them."""
    entries = matrix.tocoo()
    below = entries.row >= entries.col
    row, column = entries.row[below], entries.col[below]
    band = np.zeros((int((row - column).max(initial=0)) + 1, matrix.shape[0]))
    band[row - column, column] = entries.data[below]
    return band
