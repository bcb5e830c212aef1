"""The slopes of a fit's log likelihood, range by range: what a fit is solved, judged and doubted with.

Parameters come in two kinds. Those of the design (delays and curves) enter through the residual, so a range's slope by
them is its `score` times its row. Of the others (a share of reflections by pair, a noise by power) a range has one of
each sort: its slope by a sort is one of few numbers that sorts share, and which of the sort's parameters it belongs to
follows from the range's place. No matrix of ranges by parameters is ever built: sums by block of the design come first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from calib.estimation.design import PIECES_AT_ONCE, Design
from calib.estimation.row_order import Runs
from calib.long_columns import EVERY, ROWS_AT_ONCE, let_go, spans
from uwblink.arrays import Floats, Ints

_NOTHING: Final = np.zeros((0, 0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sort:
    """A sort of parameters, `count` of them: number `slope` of the slopes, and whose a place's ranges are (places,).

    `whose` None says that all ranges share one. Every one of the `count` has a place.
    """

    slope: int
    whose: Ints | None = None
    count: int = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """Slopes at a point: `score` (n,) by the residual, `curvature` (n,) what a range knows of it, in 1/m and 1/m^2.

    Parameters are those of `design` (n, m), then those of `sorts`, in their order, with `slopes` of (n,) each; `place`
    (blocks,) numbers the `places` of the design's blocks. `curvature` None says that it is the square of the score.
    Rows are in the order in which the design keeps them, here and in all that is asked of slopes.
    """

    design: Design
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

    def places_given(self) -> Ints:
        """Return the place of each range (n,), in the order of given rows."""
        place = np.zeros(len(self.design.counts), dtype=np.int64) if self.place is None else self.place
        return self.design.given(np.repeat(place, self.design.counts))

    def known(self, rows: slice = EVERY) -> Floats:
        """Return what each range knows of its residual (n,), in 1/m^2, or some of them."""
        return self.score[rows] * self.score[rows] if self.curvature is None else self.curvature[rows]

    def spans(self, runs: Runs) -> Iterator[tuple[slice, slice]]:
        """Yield runs, and their rows, as many as are worked on at once."""
        edges, first = runs.starts, 0
        while first < len(edges) - 1:
            last = max(int(np.searchsorted(edges, edges[first] + ROWS_AT_ONCE, side="right")) - 1, first + 1)
            yield slice(first, last), slice(int(edges[first]), int(edges[last]))
            first = last

    def let_go(self) -> None:
        """Leave what lies in files to them."""
        let_go(self.design.values, self.score, self.curvature, *self.slopes)

    def gradient(self) -> Floats:
        """Return the slope of the log likelihood by all parameters."""
        return self.sums(squares=False).gradient()

    def information(self) -> Floats:
        """Return what the ranges know of the parameters: curvature of the design, squared slopes of the rest."""
        if self.curvature is not None and not self.sorts:
            return self.design.normal(self.curvature)
        return self.sums().information()

    def sums(self, *, squares: bool = True) -> Sums:
        """Return sums over the ranges, with those of `squares`, from which the information follows."""
        summing = Summing(self.design, len(self.slopes), squares=squares)
        for k, (blocks, rows) in enumerate(self.design.passing()):
            summing.add(blocks, rows, self.score[rows], [slope[rows] for slope in self.slopes])
            if k % PIECES_AT_ONCE == 0:
                self.let_go()
        self.let_go()
        return summing.sums(self.place, self.places, self.sorts, self.curvature)

    def by_block(self, blocks: Ints, count: int) -> Floats:
        """Return slopes summed within blocks of time (blocks, parameters), of which `blocks` (n,) are the numbers."""
        found = np.zeros((count, self.size))
        found[:, : self.design.shape[1]] = self.design.by_group(self.score, blocks, count)
        for rows in spans(len(self.score)) if self.sorts else ():
            every = self.design.block_of(rows)
            some = [slope[rows] for slope in self.slopes]
            for sums, where in zip(self._of_sorts(some, blocks[rows], every, count), self.slices(), strict=False):
                found[:, where] += sums
            let_go(*self.slopes)
        return found

    def linked(self, weight: Floats | float, runs: Runs, ends: Sequence[tuple[Ints, float]], count: int) -> Floats:
        """Return what links offsets to the parameters (count, parameters).

        An offset in metres that a group of runs has, times a range's `weight` (n,); each of `ends` says which group of
        `count` a run belongs to (runs,), and with which sign.
        """
        own = self.design.values.shape[0]
        sums = np.empty((len(runs.block), own + len(self.slopes)))
        for which, rows in self.spans(runs):
            by = weight[rows] if isinstance(weight, np.ndarray) else weight
            known, slope = self.known(rows) * by, self.score[rows] * by
            starts = runs.starts[which] - rows.start
            for k, column in enumerate([*self.design.values, *self.slopes]):
                sums[which, k] = np.add.reduceat(column[rows] * (known if k < own else slope), starts)
            self.let_go()
            let_go(weight if isinstance(weight, np.ndarray) else None)
        found = np.zeros((count, self.size))
        for group, sign in ends:
            found[:, : self.design.shape[1]] += sign * self.design.grouped(sums[:, :own], group, count, runs.block)
            parts = self._of_sorts([sums[:, own + k] for k in range(len(self.slopes))], group, runs.block, count)
            for part, where in zip(parts, self.slices(), strict=True):
                found[:, where] += sign * part
        return found

    def _of_sorts(self, sums: Sequence[Floats], group: Ints, block: Ints, count: int) -> list[Floats]:
        """Return sums of slopes over runs of blocks (runs,) by group and by each sort's parameters (count, own)."""
        if not self.sorts:
            return []
        both = group * self.places + (0 if self.place is None else self.place[block])
        tables = [np.asarray(np.bincount(both, some, count * self.places), float) for some in sums]
        by_place = [table.reshape(count, self.places).T for table in tables]
        return [_whose(sort, by_place[sort.slope]).T for sort in self.sorts]


class Summing:
    """Sums of slopes over the blocks of a design, piece by piece."""

    def __init__(self, design: Design, slopes: int, *, squares: bool) -> None:
        """Begin at nothing; with `squares`, products of slopes are summed too."""
        self._design, self._slopes = design, slopes
        blocks, self._own = design.columns.shape
        size = self._own + slopes
        self._plain = np.empty((blocks, size))
        self._squares = np.empty((blocks, size, size)) if squares else None

    def add(self, blocks: slice, rows: slice, score: Floats, slopes: list[Floats] | tuple[Floats, ...]) -> None:
        """Sum slopes of the kept rows of some blocks."""
        stacked = np.empty((self._plain.shape[1], len(score)))
        np.multiply(self._design.values[:, rows], score, out=stacked[: self._own])
        for k, slope in enumerate(slopes):
            stacked[self._own + k] = slope
        self._plain[blocks] = np.add.reduceat(stacked, self._design.starts[blocks] - rows.start, axis=1).T
        if self._squares is not None:
            self._design.squares_of(stacked, blocks, rows, self._squares)

    def sums(self, place: Ints | None, places: int, sorts: tuple[Sort, ...], curvature: Floats | None = None) -> Sums:
        """Return what was summed, by place; `place` (blocks,) is that of each block."""
        own, design, each = self._own, self._design, range(self._slopes)
        where = np.zeros(len(self._plain), dtype=np.int64) if place is None else place
        plain, squares = self._plain, self._squares

        def by_place(values: Floats) -> Floats:
            return np.asarray(np.bincount(where, values, places), float)

        slopes = np.array([by_place(plain[:, own + k]) for k in each])
        total = design.grouped(plain[:, :own], np.zeros_like(where), 1)[0]
        if squares is None:
            return Sums(sorts=sorts, design=total, slopes=slopes, design_square=_NOTHING, squares={}, links=[])
        return Sums(
            sorts=sorts,
            design=total,
            slopes=slopes,
            design_square=design.squared(squares[:, :own, :own]) if curvature is None else design.normal(curvature),
            squares={(k, other): by_place(squares[:, own + k, own + other]) for k in each for other in each[k:]},
            links=[design.grouped(squares[:, own + k, :own], where, places) for k in each],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Sums:
    """What slopes of ranges sum to: by the design (m,), by place (slopes, places), squares and links between them."""

    sorts: tuple[Sort, ...]
    design: Floats
    slopes: Floats
    design_square: Floats
    squares: dict[tuple[int, int], Floats]
    links: list[Floats]

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
    order = np.argsort(sort.whose, kind="stable")
    return np.add.reduceat(sums[order], np.searchsorted(sort.whose[order], np.arange(sort.count)), axis=0)


def _crossed(sums: Floats, first: Sort, second: Sort) -> Floats:
    """Return sums by place (places,) as those by two sorts' parameters (count, count)."""
    if first.whose is None or second.whose is None:
        one = second if first.whose is None else first
        return _whose(one, sums).reshape(first.count, second.count)
    both = np.bincount(first.whose * second.count + second.whose, sums, minlength=first.count * second.count)
    return np.asarray(both, float).reshape(first.count, second.count)


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
    try:
        half = np.linalg.inv(np.linalg.cholesky(matrix))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(matrix, rcond=1e-10, hermitian=True))
    return np.asarray(half.T @ half)


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
