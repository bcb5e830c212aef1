"""The slopes of a fit's log likelihood, range by range: what a fit is solved, judged and doubted with.

Parameters come in two kinds. Those of the design (delays and curves) enter through the residual, so a range's slope by
them is its `score` times its row. Of the others (a share of reflections by pair, a noise by power) a range has one of
each sort: its slope by a sort is one of few numbers that sorts share, and which of the sort's parameters it belongs to
follows from the range's place. No matrix of ranges by parameters is ever built: sums by place come first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints

Places = NDArray[np.signedinteger[Any]]
"""Numbers of places, in as few bytes as they take."""

CHUNK: Final = 1024
"""Rows of a matrix worked on at once, so that they stay in the cache."""

SUMMED_AT_ONCE: Final = 65_536
"""Rows summed by place at once, so that what leads to the sums is small beside the matrix."""

_NOTHING: Final = np.zeros((0, 0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sort:
    """A sort of parameters, `count` of them: number `slope` of the slopes, and whose a place's ranges are (places,).

    `whose` None says that all ranges share one.
    """

    slope: int
    whose: Ints | None = None
    count: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Slopes at a point: `score` (n,) by the residual, `curvature` (n,) what a range knows of it, in 1/m and 1/m^2.

    Parameters are those of `design` (n, m), then those of `sorts`, in their order, with `slopes` of (n,) each; `place`
    (n,) numbers the `places` of ranges. `curvature` None says that it is the square of the score.
    """

    design: Floats
    score: Floats
    curvature: Floats | None = None
    slopes: tuple[Floats, ...] = ()
    place: Ints | None = None
    places: int = 1
    sorts: tuple[Sort, ...] = ()

    @property
    def size(self) -> int:
        """Return the number of parameters."""
        return int(self.design.shape[1]) + sum(sort.count for sort in self.sorts)

    def slices(self) -> list[slice]:
        """Return where the parameters of each sort stand."""
        ends = np.cumsum([self.design.shape[1], *(sort.count for sort in self.sorts)]).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]

    def known(self) -> Floats:
        """Return what each range knows of its residual (n,), in 1/m^2."""
        return self.score * self.score if self.curvature is None else self.curvature

    def gradient(self) -> Floats:
        """Return the slope of the log likelihood by all parameters."""
        return self.sums(squares=False).gradient()

    def information(self) -> Floats:
        """Return what the ranges know of the parameters: curvature of the design, squared slopes of the rest."""
        return self.sums().information()

    def sums(self, *, squares: bool = True) -> Sums:
        """Return sums over the ranges, with those of `squares`, from which the information follows."""
        slopes = range(len(self.slopes))
        return Sums(
            sorts=self.sorts,
            design=self.score @ self.design,
            slopes=np.array([self._by_place(slope) for slope in self.slopes]),
            design_square=self._of_design() if squares else _NOTHING,
            squares={
                (k, other): self._by_place(self.slopes[k] * self.slopes[other])
                for k in slopes
                for other in range(k, len(slopes))
            }
            if squares
            else {},
            links=self._links() if squares else [],
        )

    def by_block(self, blocks: Ints, count: int) -> Floats:
        """Return slopes summed within blocks of time (blocks, parameters); blocks (n,) ascend."""
        columns = self.design.shape[1]
        found = np.zeros((count, self.size))
        for begin in range(0, len(blocks), CHUNK):
            rows = slice(begin, begin + CHUNK)
            starts = np.flatnonzero(np.diff(blocks[rows], prepend=-1))
            part = self.design[rows] * self.score[rows, None]
            found[blocks[rows][starts], :columns] += np.add.reduceat(part, starts)
        for sums, where in zip(self._in_groups(None, blocks, count), self.slices(), strict=True):
            found[:, where] = sums
        return found

    def with_groups(self, weight: Floats, group: Places, count: int) -> Floats:
        """Return what links offsets to the parameters (count, parameters).

        An offset in metres that a group of ranges has, times a range's `weight` (n,); `group` (n,) says which group.
        """
        own = sums_by_place(self.design, self.known() * weight, group, count)
        return np.hstack([own, *self._in_groups(self.score * weight, group, count)])

    def _of_design(self) -> Floats:
        if self.curvature is not None:
            return weighted_square(self.design, self.curvature)
        found = np.zeros((self.design.shape[1],) * 2)
        for begin in range(0, len(self.score), CHUNK):
            part = self.design[begin : begin + CHUNK] * self.score[begin : begin + CHUNK, None]
            # A matrix times its own transpose takes half of the work.
            found += part.T @ part
        return found

    def _by_place(self, values: Floats) -> Floats:
        if self.place is None:
            return np.array([values.sum()])
        return np.asarray(np.bincount(self.place, values, minlength=self.places), float)

    def _links(self) -> list[Floats]:
        """Return score times each slope times rows of the design by place, by all where no sort needs more."""
        placed = sorted({sort.slope for sort in self.sorts if sort.whose is not None})
        weights = [self.score * slope for slope in self.slopes]
        found = [
            np.empty((0, 0)) if k in placed else (weight @ self.design)[None, :] for k, weight in enumerate(weights)
        ]
        if placed and self.place is not None:
            # All of them at once, so that rows of the design are read once.
            weight = np.column_stack([weights[k] for k in placed])
            place = self.place[:, None] + self.places * np.arange(len(placed))
            sums = sums_by_place(self.design, weight, place, self.places * len(placed))
            for k, part in zip(placed, np.split(sums, len(placed)), strict=True):
                found[k] = part
        return found

    def _in_groups(self, weight: Floats | None, group: Places, count: int) -> list[Floats]:
        """Return sums of slopes (n,), times a weight, by group and by the parameters of each sort (count, own)."""
        both = group if self.place is None else group * self.places + self.place
        tables = [
            np.asarray(np.bincount(both, slope if weight is None else slope * weight, count * self.places), float)
            for slope in self.slopes
        ]
        by_place = [table.reshape(count, self.places).T for table in tables]
        return [_whose(sort, by_place[sort.slope]).T for sort in self.sorts]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sums:
    """What slopes of ranges sum to: by the design (m,), by place (slopes, places), squares and links between them."""

    sorts: tuple[Sort, ...]
    design: Floats
    slopes: Floats
    design_square: Floats
    squares: dict[tuple[int, int], Floats]
    links: list[Floats]

    def __add__(self, other: Sums) -> Sums:
        """Return the sums over the ranges of both."""
        return replace(
            self,
            design=self.design + other.design,
            slopes=self.slopes + other.slopes,
            design_square=self.design_square + other.design_square,
            squares={key: value + other.squares[key] for key, value in self.squares.items()},
            links=[first + second for first, second in zip(self.links, other.links, strict=True)],
        )

    def gradient(self) -> Floats:
        """Return the slope of the log likelihood by all parameters."""
        return np.concatenate([self.design, *(_whose(sort, self.slopes[sort.slope]) for sort in self.sorts)])

    def information(self) -> Floats:
        """Return what the ranges know of the parameters."""
        columns = len(self.design)
        ends = np.cumsum([columns, *(sort.count for sort in self.sorts)]).tolist()
        where = [slice(a, b) for a, b in pairwise(ends)]
        found = np.zeros((ends[-1],) * 2)
        found[:columns, :columns] = self.design_square
        for k, (sort, rows) in enumerate(zip(self.sorts, where, strict=True)):
            found[rows, :columns] = _whose(sort, self.links[sort.slope])
            found[:columns, rows] = found[rows, :columns].T
            for other, others in zip(self.sorts[k:], where[k:], strict=True):
                both = self.squares[min(sort.slope, other.slope), max(sort.slope, other.slope)]
                found[rows, others] = _crossed(both, sort, other)
                found[others, rows] = found[rows, others].T
        return found


def _whose(sort: Sort, sums: Floats) -> Floats:
    """Return sums by place (places, ...) as those by a sort's parameters (count, ...)."""
    if sort.whose is None:
        return np.asarray(sums.sum(axis=0, keepdims=True))
    if sums.ndim == 1:
        return np.asarray(np.bincount(sort.whose, sums, minlength=sort.count))
    return sums_by_place(sums, np.ones(len(sums)), sort.whose, sort.count)


def _crossed(sums: Floats, first: Sort, second: Sort) -> Floats:
    """Return sums by place (places,) as those by two sorts' parameters (count, count)."""
    if first.whose is None or second.whose is None:
        one = second if first.whose is None else first
        return _whose(one, sums).reshape(first.count, second.count)
    both = np.bincount(first.whose * second.count + second.whose, sums, minlength=first.count * second.count)
    return np.asarray(both, float).reshape(first.count, second.count)


def sums_by_place(matrix: Floats, weight: Floats, place: Places, count: int) -> Floats:
    """Return weighted rows of a matrix (n, m) summed by place (count, m); a row may go to more than one (n, k)."""
    from scipy.sparse import csc_array

    if len(matrix) > SUMMED_AT_ONCE:
        pieces = [slice(begin, begin + SUMMED_AT_ONCE) for begin in range(0, len(matrix), SUMMED_AT_ONCE)]
        found = np.zeros((count, matrix.shape[1]))
        for rows in pieces:
            found += sums_by_place(matrix[rows], weight[rows], place[rows], count)
        return found
    each = weight.size // max(len(matrix), 1)
    starts = np.arange(0, weight.size + 1, max(each, 1))
    return np.asarray(csc_array((weight.ravel(), place.ravel(), starts), shape=(count, len(matrix))) @ matrix)


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
