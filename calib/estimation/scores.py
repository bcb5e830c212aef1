"""The slopes of a fit's log likelihood, range by range: what a fit is solved, judged and doubted with.

Parameters come in two kinds. Those of the design (delays and curves) enter through the residual, so a range's slope by
them is its `score` times its row. Of the others (a share of reflections by pair, a noise by power) a range has one of
each sort, so its slope by a sort is one number and the place that it belongs to. No matrix of ranges by parameters is
ever built.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints

CHUNK: Final = 512
"""Rows of a matrix worked on at once, so that they stay in the cache."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sort:
    """A sort of parameters, `count` of them: each range's slope (n,) by its own, and which one that is (n,).

    `place` None says that all ranges share one.
    """

    slope: Floats
    place: Ints | None = None
    count: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Slopes at a point: `score` (n,) by the residual, `curvature` (n,) what a range knows of it, in 1/m and 1/m^2.

    Parameters are those of `design` (n, m), then those of `sorts`, in their order.
    """

    design: Floats
    score: Floats
    curvature: Floats
    sorts: tuple[Sort, ...] = ()

    @property
    def size(self) -> int:
        """Return the number of parameters."""
        return int(self.design.shape[1]) + sum(sort.count for sort in self.sorts)

    def slices(self) -> list[slice]:
        """Return where the parameters of each sort stand."""
        ends = np.cumsum([self.design.shape[1], *(sort.count for sort in self.sorts)]).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]

    def gradient(self) -> Floats:
        """Return the slope of the log likelihood by all parameters."""
        return np.concatenate([self.design.T @ self.score, *(_placed(s.place, s.slope, s.count) for s in self.sorts)])

    def information(self) -> Floats:
        """Return what the ranges know of the parameters: curvature of the design, squared slopes of the rest."""
        found = np.zeros((self.size, self.size))
        columns = self.design.shape[1]
        found[:columns, :columns] = weighted_square(self.design, self.curvature)
        where = self.slices()
        for k, (sort, rows) in enumerate(zip(self.sorts, where, strict=True)):
            found[rows, :columns] = sums_by_place(self.design, self.score * sort.slope, sort.place, sort.count)
            found[:columns, rows] = found[rows, :columns].T
            for other, others in zip(self.sorts[k:], where[k:], strict=True):
                both = _crossed(sort.slope * other.slope, (sort.place, sort.count), (other.place, other.count))
                found[rows, others], found[others, rows] = both, both.T
        return found

    def by_block(self, blocks: Ints, count: int) -> Floats:
        """Return slopes summed within blocks of time (blocks, parameters); blocks (n,) ascend."""
        columns = self.design.shape[1]
        found = np.zeros((count, self.size))
        for begin in range(0, len(blocks), CHUNK):
            rows = slice(begin, begin + CHUNK)
            starts = np.flatnonzero(np.diff(blocks[rows], prepend=-1))
            part = self.design[rows] * self.score[rows, None]
            found[blocks[rows][starts], :columns] += np.add.reduceat(part, starts)
        for sort, where in zip(self.sorts, self.slices(), strict=True):
            found[:, where] = _crossed(sort.slope, (blocks, count), (sort.place, sort.count))
        return found

    def with_groups(self, weight: Floats, place: Ints, count: int) -> Floats:
        """Return what links offsets to the parameters (count, parameters).

        An offset in metres that a group of ranges has, times a range's `weight` (n,); `place` (n,) says which group.
        """
        found = [sums_by_place(self.design, self.curvature * weight, place, count)]
        found += [
            _crossed(self.score * weight * sort.slope, (place, count), (sort.place, sort.count)) for sort in self.sorts
        ]
        return np.hstack(found)


def _placed(place: Ints | None, values: Floats, count: int) -> Floats:
    return np.array([values.sum()]) if place is None else np.asarray(np.bincount(place, values, minlength=count), float)


def _crossed(values: Floats, first: tuple[Ints | None, int], second: tuple[Ints | None, int]) -> Floats:
    """Return sums of values (n,) by two places at once."""
    (row, rows), (column, columns) = first, second
    if row is None or column is None:
        one = _placed(row if column is None else column, values, rows * columns)
        return one.reshape(rows, columns)
    if row is column:
        return np.diag(np.bincount(row, values, minlength=rows))
    both = np.bincount(row * columns + column, values, minlength=rows * columns)
    return np.asarray(both, float).reshape(rows, columns)


def sums_by_place(matrix: Floats, weight: Floats, place: Ints | None, count: int) -> Floats:
    """Return weighted rows of a matrix (n, m) summed by place (count, m)."""
    from scipy.sparse import csc_array

    if place is None:
        return np.asarray(weight @ matrix)[None, :]
    return np.asarray(csc_array((weight, place, np.arange(len(place) + 1)), shape=(count, len(place))) @ matrix)


def weighted_square(matrix: Floats, weight: Floats) -> Floats:
    """Return the sum over rows of the weighted outer square of each, (m, m)."""
    found = np.zeros((matrix.shape[1],) * 2)
    for begin in range(0, len(matrix), CHUNK):
        part = matrix[begin : begin + CHUNK]
        found += (part * weight[begin : begin + CHUNK, None]).T @ part
    return found


def inverse_of(matrix: Floats, places: int = 0, sorts: int = 0) -> Floats:
    """Return the inverse of a positive matrix; directions that nothing determines stay where they are.

    Its last parameters may be `sorts` of one for each of `places`, in sorts, between which no two places meet (shares
    of pairs, noises of pairs): they are eliminated first, place by place.
    """
    # Logarithms and metres stand side by side: scaled to a diagonal of ones, the matrix is as well posed as can be.
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    scaled = matrix * scale[:, None] * scale + np.diag(np.full(len(matrix), 1e-10))
    found = _eliminated(scaled, places, sorts) if places else _positive(scaled)
    return np.asarray(found * scale[:, None] * scale)


def _positive(matrix: Floats) -> Floats:
    from scipy.linalg import lapack

    factor, failed = lapack.dpotrf(matrix, lower=1)
    if failed:
        return np.asarray(np.linalg.pinv(matrix, rcond=1e-10, hermitian=True))
    lower, _ = lapack.dpotri(factor, lower=1)
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


def _eliminated(matrix: Floats, places: int, sorts: int) -> Floats:
    """Return the inverse by Schur's complement: the parameters of a place meet those of no other, only common ones."""
    common = len(matrix) - places * sorts
    own = np.arange(places)[:, None] + places * np.arange(sorts) + common
    inner = np.linalg.inv(matrix[own[:, :, None], own[:, None, :]])
    across = np.einsum("pst,ptc->psc", inner, matrix[own, :common])
    flat = np.empty((places * sorts, common))
    flat[own - common] = across
    first = _positive(matrix[:common, :common] - matrix[:common, common:] @ flat)
    found = np.empty_like(matrix)
    found[:common, :common] = first
    found[:common, common:] = -first @ flat.T
    found[common:, :common] = found[:common, common:].T
    found[common:, common:] = flat @ first @ flat.T
    found[own[:, :, None], own[:, None, :]] += inner
    return found
