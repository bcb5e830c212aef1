"""Rows of a fit: measurements as log likelihoods with slopes by the unknowns.

A kind of row is a class with a method `terms` that yields, for some rows at a time, their log likelihood and slopes.
The search, the covariance and the score tests sum over them. Ranges are one kind (`calib.estimator.range_rows`);
measurements with normal errors (tapes, anchors, poses, heights) are the other, `NormalRows`.
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

    The entries are those of the unknowns `columns` (blocks, K). `residual` (n,) are the entries of a unit offset of
    each row's residual.
    """

    columns: Ints
    entries: Floats
    residual: Floats
    weight: Floats | float = 1.0


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

    def as_matrix(self, values: Floats, columns: Ints, size: int) -> sparse.csr_matrix:
        """Return values (K, n) at the columns (blocks, K) of the rows as a sparse matrix (n, size)."""
        bounds = np.arange(values.shape[1] + 1) * len(values)
        each = np.repeat(columns, np.diff(self.starts), axis=0)
        return sparse.csr_matrix((values.T.ravel(), each.ravel(), bounds), shape=(values.shape[1], size))


class Rows(Protocol):
    """A kind of row."""

    def terms(self, x: Floats) -> Iterable[Terms]:
        """Yield all rows at unknowns (p,), some at a time."""
        ...


@dataclass(frozen=True, slots=True)
class Sums:
    """Log likelihood of all rows, its slope (p,), and the information of the rows (p, p), sparse for many unknowns."""

    value: float
    gradient: Floats
    information: Matrix


def sum_rows(rows: Sequence[Rows], x: Floats) -> Sums:
    """Sum over all rows at unknowns (p,)."""
    size, value = len(x), 0.0
    many = size > MOST_DENSE
    gradient, square = np.zeros(size), np.zeros(0 if many else size * size)
    loose: list[sparse.csr_matrix] = []
    for kind in rows:
        for terms in kind.terms(x):
            value += terms.value
            sums = np.add.reduceat(terms.slopes, terms.starts[:-1], axis=1)
            gradient += np.bincount(terms.columns.ravel(), sums.T.ravel(), size)
            for part in terms.squares:
                # A common weight of all rows multiplies their products, which are fewer.
                one = np.ndim(part.weight) == 0
                weighed, times = (part.entries, part.weight) if one else (part.entries * part.weight, 1.0)
                if part.entries.shape[1] < LONG_BLOCKS * len(part.columns):
                    left, right = (terms.as_matrix(each, part.columns, size) for each in (weighed, part.entries))
                    loose.append(left.T @ right * times)
                    continue
                products = _block_products(weighed, part.entries, terms.starts).ravel() * times
                place = (part.columns[:, :, None] * size + part.columns[:, None, :]).ravel()
                if many:
                    loose.append(sparse.csr_matrix((products, divmod(place, size)), shape=(size, size)))
                else:
                    np.add.at(square, place, products)
    if many:
        return Sums(value, gradient, sparse.csc_matrix(sum(loose, sparse.csr_matrix((size, size)))))
    found = square.reshape(size, size)
    for product in loose:
        found += product.toarray()
    return Sums(value, gradient, found)


def _block_products(left: Floats, right: Floats, starts: Ints) -> Floats:
    bounds = starts.tolist()
    found = np.empty((len(bounds) - 1, len(left), len(left)))
    for k in range(len(bounds) - 1):
        own = slice(bounds[k], bounds[k + 1])
        np.matmul(left[:, own], right[:, own].T, out=found[k])
    return found


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

    `derivative` (K, n) is the derivative of the prediction by the unknowns `columns` (n, K), `std` (n,) the standard
    deviations.
    """
    z = left / std
    return Terms(
        value=-0.5 * float(z @ z),
        slopes=derivative * (z / std),
        score=-z / std,
        columns=columns,
        starts=np.arange(len(left) + 1),
        squares=[Squares(columns=columns, entries=derivative / std, residual=-1 / std)],
    )
