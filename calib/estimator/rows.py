"""Rows of a fit: measurements as log likelihoods with slopes by the unknowns.

A kind of row is a class with a method `terms` that yields, for some rows at a time, their log likelihood and slopes.
The search, the covariance and the score tests sum over them. Kinds are ranges (`calib.estimator.range_rows`), linear
measurements with normal errors (`NormalRows`: anchors, poses, heights), and others with a class of their own, such as
lengths by tape (`calib.trajectories.motion`, `calib.surveys.network`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy import sparse

from calib.estimator.inverse import MOST_DENSE, Matrix
from uwblink.arrays import Floats, Ints

ROWS_AT_ONCE = 16_384
"""Rows that are computed together, so that intermediate results stay in the processor's cache."""

LONG_BLOCKS = 8
"""Rows per block from which a dense product per block is faster than a sparse product of all rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Squares:
    """Information of rows (n,): the sum of `weight`, one or (n,), times the outer square of `entries` (K, n).

    `residual` (n,) are the entries of a unit offset of each row's residual.
    """

    entries: Floats
    residual: Floats
    weight: Floats | float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Movements:
    """Movements of the ends of distances (n,) by unknowns.

    `derivative` (n, k) is that of a row's residual by the unknowns `columns` (n, k). The vector between both points has
    the derivative `shares` (n, j) by the unknowns `axes` (n, 3, j) of each axis. `bend` (n,) is the size of the second
    derivative of the log likelihood by movements across the distance: slope over distance, per square metre.
    """

    columns: Ints
    derivative: Floats
    axes: Ints
    shares: Floats
    bend: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Terms:
    """Some rows (n,), each of which depends on K unknowns: the rows of a block depend on the same unknowns.

    `slopes` (K, n) are derivatives of a row's log likelihood by the unknowns `columns` (blocks, K), `score` (n,) those
    by its residual; `starts` (blocks + 1,) bound the blocks. The information of the rows is the sum of `squares`: of
    the slopes themselves (Berndt, Hall, Hall, Hausman 1974), or expected information.
    """

    value: float
    slopes: Floats
    score: Floats
    columns: Ints
    starts: Ints
    squares: Sequence[Squares]
    movements: Movements | None = None

    def as_matrix(self, values: Floats, residual: Floats, size: int) -> sparse.csr_matrix:
        """Return a sparse matrix (n, size): `values` (K, n) at the unknowns of blocks, and `residual` (n,) times the
        derivatives of residuals by movements.
        """
        columns, entries = np.repeat(self.columns, np.diff(self.starts), axis=0), values.T
        if self.movements is not None:
            columns = np.concatenate([columns, self.movements.columns], axis=1)
            entries = np.concatenate([entries, residual[:, None] * self.movements.derivative], axis=1)
        return sparse_rows(columns, entries, size)

    def gradient(self, size: int) -> Floats:
        """Return the sum of the slopes by all unknowns (size,)."""
        sums = np.add.reduceat(self.slopes, self.starts[:-1], axis=1)
        found = np.zeros(size)
        found += np.bincount(self.columns.ravel(), sums.T.ravel(), size)
        if self.movements is not None:
            by_movements = self.score[:, None] * self.movements.derivative
            found += np.bincount(self.movements.columns.ravel(), by_movements.ravel(), size)
        return found


def sparse_rows(columns: Ints, entries: Floats, size: int) -> sparse.csr_matrix:
    """Return entries (n, k) at columns (n, k) as a sparse matrix (n, size)."""
    bounds = np.arange(len(columns) + 1) * columns.shape[1]
    return sparse.csr_matrix((entries.ravel(), columns.ravel(), bounds), shape=(len(columns), size))


class Rows(Protocol):
    """A kind of row."""

    def terms(self, x: Floats) -> Iterable[Terms]:
        """Yield all rows at unknowns (p,), some at a time."""
        ...


@dataclass(frozen=True, slots=True)
class Sums:
    """Log likelihood of all rows, its slope (p,), and the information of the rows (p, p), sparse for many unknowns.

    `curvature` (p, p) is the information plus the second derivatives of distances, with positive signs.
    """

    value: float
    gradient: Floats
    information: Matrix
    curvature: Matrix


def sum_rows(rows: Sequence[Rows], x: Floats) -> Sums:
    """Sum over all rows at unknowns (p,)."""
    size, value, gradient = len(x), 0.0, np.zeros(len(x))
    few = size <= MOST_DENSE
    whole, loose, bends = np.zeros(size * size if few else 0), list[sparse.csc_matrix](), list[sparse.csc_matrix]()
    for kind in rows:
        for terms in kind.terms(x):
            value += terms.value
            gradient += terms.gradient(size)
            if terms.movements is None and terms.slopes.shape[1] < LONG_BLOCKS * len(terms.columns):
                loose += _of_few_rows(terms, size)
                continue
            first, *others = (_block_products(part, terms.starts) for part in terms.squares)
            products = sum(others, first).ravel()
            place = (terms.columns[:, :, None] * size + terms.columns[:, None, :]).ravel()
            if few:
                np.add.at(whole, place, products)
            else:
                loose.append(_placed(products, place, size))
            if terms.movements is not None:
                loose.append(_of_movements(terms, terms.movements, size))
                bends.append(_bends(terms.movements, size))
    information = _plus(whole.reshape(size, size) if few else sparse.csc_matrix((size, size)), loose)
    return Sums(value, gradient, information, _plus(information, bends))


def _plus(matrix: Matrix, parts: Sequence[sparse.csc_matrix]) -> Matrix:
    """Return a matrix (p, p) plus sparse ones, as dense or sparse as the first."""
    # Small ones first, because each sum takes as long as its larger part.
    for part in sorted(parts, key=lambda one: one.nnz):
        matrix = matrix + part
    return sparse.csc_matrix(matrix) if sparse.issparse(matrix) else np.asarray(matrix)


def _of_few_rows(terms: Terms, size: int) -> list[sparse.csc_matrix]:
    """Return the information of rows as products of sparse matrices."""
    found = list[sparse.csc_matrix]()
    for part in terms.squares:
        own = terms.as_matrix(part.entries, part.residual, size)
        found.append(own.T @ sparse.diags(np.broadcast_to(part.weight, len(terms.score))) @ own)
    return found


def _placed(products: Floats, place: Ints, size: int) -> sparse.csc_matrix:
    """Return products (n,) summed at their places (n,) in a matrix whose rows have `size` entries."""
    if len(products) > size * size:
        # Sorting so many entries would take longer.
        whole = np.zeros(size * size)
        np.add.at(whole, place, products)
        return sparse.csc_matrix(whole.reshape(size, size))
    return sparse.csc_matrix((products, divmod(place, size)), shape=(size, size))


def _of_movements(terms: Terms, movements: Movements, size: int) -> sparse.csc_matrix:
    """Return the information between the unknowns that move residuals, and between these and the others."""
    own = sparse_rows(movements.columns, movements.derivative, size)
    alone, across = np.zeros(len(terms.score)), np.zeros_like(terms.slopes)
    for part in terms.squares:
        pull = part.weight * part.residual
        alone += pull * part.residual
        across += pull * part.entries
    others = sparse_rows(np.repeat(terms.columns, np.diff(terms.starts), axis=0), across.T, size)
    half = sparse.csc_matrix(own.T @ (sparse.diags(0.5 * alone) @ own + others))
    return sparse.csc_matrix(half + half.T)


def _bends(movements: Movements, size: int) -> sparse.csc_matrix:
    """Return the sizes of the second derivatives by movements of points, as a sum of squares.

    The distance d of points with a vector v between them has the second derivative (I - v v'/d^2)/d. Its product with
    the slope of the likelihood is replaced by its absolute value, and movements along v, whose information is much
    larger, are included.
    """
    shares = np.broadcast_to((np.sqrt(movements.bend)[:, None] * movements.shares)[:, None, :], movements.axes.shape)
    moved = sparse_rows(movements.axes.reshape(-1, shares.shape[-1]), shares.reshape(-1, shares.shape[-1]), size)
    return sparse.csc_matrix(moved.T @ moved)


def _block_products(part: Squares, starts: Ints) -> Floats:
    """Return the sums of squares of each block (blocks, K, K)."""
    # A common weight of all rows multiplies their products, which are fewer.
    one = np.ndim(part.weight) == 0
    left, bounds = part.entries if one else part.entries * part.weight, starts.tolist()
    found = np.empty((len(bounds) - 1, len(left), len(left)))
    for k in range(len(bounds) - 1):
        own = slice(bounds[k], bounds[k + 1])
        np.matmul(left[:, own], part.entries[:, own].T, out=found[k])
    return found * part.weight if one else found


@dataclass(frozen=True, slots=True, kw_only=True)
class NormalRows:
    """Linear measurements with normal errors: `value` (n,) = sum of `entries` (n, K) times the unknowns, +- `std` (n,).

    `columns` (n, K) are indices into all unknowns. A kind that is not linear needs a separate class that yields
    `Terms`.
    """

    value: Floats
    std: Floats
    entries: Floats
    columns: Ints

    def left(self, x: Floats) -> Floats:
        """Return measured minus predicted values (n,)."""
        return np.asarray(self.value - np.sum(self.entries * x[self.columns], axis=1))

    def terms(self, x: Floats) -> Iterator[Terms]:
        """Yield all rows."""
        yield normal_terms(self.left(x), self.std, self.entries.T, self.columns)


def normal_terms(left: Floats, std: Floats, derivative: Floats, columns: Ints) -> Terms:
    """Return the terms of rows with normal errors from residuals `left` (n,), measured minus predicted.

    `derivative` (K, n) is the derivative of the prediction by the unknowns `columns` (n, K), or (1, K) where all rows
    depend on the same ones; `std` (n,) are the standard deviations.
    """
    z = left / std
    return Terms(
        value=-0.5 * float(z @ z),
        slopes=derivative * (z / std),
        score=-z / std,
        columns=columns,
        starts=np.arange(len(columns) + 1) * (len(left) // max(len(columns), 1)),
        squares=[Squares(entries=derivative / std, residual=-1 / std)],
    )
