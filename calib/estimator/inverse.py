"""Inverses of information matrices: dense for few unknowns, by a sparse factorisation for many.

Flights have thousands of unknowns, each of which shares rows with few others. Both have the same operations: products
with vectors, some columns, a block of the diagonal, traces.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

from uwblink.arrays import Floats, Ints

MOST_DENSE = 400
"""Unknowns up to which matrices are dense: a dense factorisation takes as long as a sparse one of a flight there."""

HELD = 1e-13
"""Share of its own information that is added to each unknown: it makes combinations determinate that neither rows nor
priors determine, and is some hundred times the rounding error."""

PROBES = 24
"""Random vectors by which traces of large products are estimated (Hutchinson 1990). The relative error is the root of 2
over their number times the number of unknowns: 3 % for a hundred unknowns."""

Matrix = Floats | sparse.csc_matrix


class SparseInverse:
    """The inverse (p, p) of a sparse positive definite matrix among free unknowns, zero elsewhere."""

    def __init__(self, matrix: sparse.csc_matrix, free: Ints) -> None:
        """Factor the matrix; unknowns are scaled to the same size first."""
        own = sparse.csc_matrix(matrix[free][:, free])
        self.shape, self._free = matrix.shape, free
        self._scale = 1 / np.sqrt(np.maximum(own.diagonal(), 1e-300))
        scale = sparse.diags(self._scale)
        unit = sparse.csc_matrix(scale @ own @ scale + HELD * sparse.eye(len(free)))
        # A positive definite matrix needs no pivots, which would destroy its symmetry. In the order of least degree of
        # the matrix itself, factors of a flight have a quarter of the entries that SuperLU's default order leaves.
        self._factor = splu(unit, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def __matmul__(self, right: Floats) -> Floats:
        """Return the inverse times a vector (p,) or columns (p, k)."""
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        found = np.zeros(right.shape)
        found[self._free] = scale * self._factor.solve(scale * right[self._free])
        return found

    def __getitem__(self, key: tuple[Any, Any]) -> Floats:
        """Return some rows of some columns, as of an array."""
        rows, columns = key
        chosen = np.arange(self.shape[1])[columns]
        unit = np.zeros((self.shape[0], len(chosen)))
        unit[chosen, np.arange(len(chosen))] = 1.0
        return np.asarray((self @ unit)[rows])


Inverse = Floats | SparseInverse


def inverse_of(matrix: Matrix, free: Ints) -> Inverse:
    """Return the inverse (p, p) of a positive definite matrix among the free unknowns, zero elsewhere."""
    if sparse.issparse(matrix):
        return SparseInverse(matrix, free)
    found = np.zeros_like(matrix)
    own = matrix[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.maximum(np.diag(own), 1e-300))
    unit = own * scale[:, None] * scale
    unit[np.diag_indices_from(unit)] += HELD
    try:
        factor = linalg.cho_factor(unit, lower=True, check_finite=False)
        inverse = linalg.cho_solve(factor, np.eye(len(free)), check_finite=False)
    except linalg.LinAlgError:
        values, vectors = np.linalg.eigh(unit)
        inverse = (vectors / np.maximum(np.abs(values), HELD)) @ vectors.T
    found[np.ix_(free, free)] = inverse * scale[:, None] * scale
    return found


def positive_part(matrix: Floats) -> Floats:
    """Return a symmetric matrix (k, k) with its negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def diagonal_of(matrix: sparse.csr_matrix, inverse: Inverse) -> Floats:
    """Return the diagonal (n,) of M C M' for rows M (n, p) and an inverse C (p, p), estimated for a sparse one."""
    if isinstance(inverse, SparseInverse):
        # Twice as many random vectors as for traces: 14 % of each (Bekas, Kokiopoulou and Saad 2007).
        probes = np.random.default_rng(0).choice([-1.0, 1.0], (matrix.shape[0], 2 * PROBES))
        return np.asarray(np.mean(probes * (matrix @ (inverse @ (matrix.T @ probes))), axis=1))
    return np.asarray(matrix.multiply(matrix @ inverse).sum(axis=1)).ravel()


def trace_of_product(inverse: Inverse, matrix: Matrix, where: slice = slice(None)) -> float:
    """Return the trace of the block `where` of an inverse times a symmetric matrix (k, k), estimated for a sparse one.

    For an information matrix this is the number of unknowns that the rows determine, for a prior the number that it
    determines.
    """
    if isinstance(inverse, SparseInverse):
        probes = np.zeros((inverse.shape[0], PROBES))
        probes[where] = np.random.default_rng(0).choice([-1.0, 1.0], (matrix.shape[0], PROBES))
        return float(np.sum(probes[where] * (matrix @ (inverse @ probes)[where]))) / PROBES
    if sparse.issparse(matrix):
        return float(matrix.multiply(inverse[where, where]).sum())
    return float(np.sum(inverse[where, where] * matrix))


def variances(inverse: Inverse, where: slice) -> Floats:
    """Return the diagonal (k,) of the block `where` of an inverse.

    For a sparse one, each value is the mean of the diagonal, which is estimated.
    """
    if not isinstance(inverse, SparseInverse):
        return np.diag(inverse[where, where])
    count = where.stop - where.start
    return np.full(count, trace_of_product(inverse, sparse.eye(count, format="csc"), where) / count)
