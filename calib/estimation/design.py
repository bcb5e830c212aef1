"""Matrices of which a row has few entries that are not zero, kept as those few: what a fit is linear in.

A range has a weight of the delay of either end and four cubic splines; of two dozen columns it touches six. Rows that
touch the same columns stand together in blocks, so that sums over them are products of matrices six columns wide, and
neither the matrix nor its squares are ever written out. A block's raw columns become parameters by a small matrix: it
leaves out pinned delays, takes the splines' averages off and shares curves between groups of tags.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.estimation.row_order import Order, Runs, cut, stable_order
from calib.long_columns import empty, let_go, picked, put, spans
from uwblink.arrays import Bools, Floats, Ints

ROWS_AT_ONCE: Final = 8192
"""Rows worked on together, so that what leads to sums stays in the cache; no block has more."""

MANY: Final = 64
"""Rows a block from which blocks are worth a product of matrices each."""


PIECES_AT_ONCE: Final = 128
"""Pieces after which entries that lie in files are let go of."""


@dataclass(frozen=True)
class Design:
    """A matrix (n, m): entry `values[j, k]` of its k-th kept row stands in raw column `columns[block, j]`.

    Rows are kept in another order: `order` (n,) says which row each of them is, None where they are as given. `starts`
    (blocks + 1,) bound the blocks, `turn` (raw, m) turns raw columns into parameters.
    """

    values: Floats
    order: Order | None
    starts: Ints
    columns: Ints
    turn: Floats

    @classmethod
    def whole(cls, matrix: Floats) -> Design:
        """Return a matrix (n, m) of which all entries count."""
        count, columns = matrix.shape
        starts = cut(np.array([0, count]), ROWS_AT_ONCE)
        own = np.tile(np.arange(columns), (len(starts) - 1, 1))
        return cls(np.ascontiguousarray(matrix.T, dtype=np.float64), None, starts, own, np.eye(columns))

    @property
    def shape(self) -> tuple[int, int]:
        """Return the numbers of rows and of parameters."""
        return int(self.values.shape[1]), int(self.turn.shape[1])

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.shape[0]

    @cached_property
    def counts(self) -> Ints:
        """Return the number of rows of each block (blocks,)."""
        return np.diff(self.starts)

    @cached_property
    def pieces(self) -> list[tuple[slice, slice]]:
        """Return blocks and rows that are worked on together."""
        edges, found, first = self.starts, [], 0
        while first < len(edges) - 1:
            last = max(int(np.searchsorted(edges, edges[first] + ROWS_AT_ONCE, side="right")) - 1, first + 1)
            found.append((slice(first, last), slice(int(edges[first]), int(edges[last]))))
            first = last
        return found

    def passing(self) -> Iterator[tuple[slice, slice]]:
        """Yield the same in turn; of entries that lie in files no more than a few pieces' are in memory."""
        for k, piece in enumerate(self.pieces):
            yield piece
            if k % PIECES_AT_ONCE == PIECES_AT_ONCE - 1:
                let_go(self.values)
        let_go(self.values)

    def kept(self, given: NDArray[Any]) -> NDArray[Any]:
        """Return values of rows (n,) in the order in which rows are kept."""
        return given if self.order is None else picked(given, self.order)

    def given(self, kept: NDArray[Any]) -> NDArray[Any]:
        """Return values of kept rows (n,) in the order in which rows were given."""
        if self.order is None:
            return kept
        found = empty(len(kept), kept.dtype) if kept.ndim == 1 else np.empty_like(kept)
        found[self.order] = kept
        let_go(found)
        return found

    def __matmul__(self, x: Floats) -> Floats:
        """Return the matrix times parameters (m,), in the order of given rows."""
        return self.given(self.times(x))

    def times(self, x: Floats) -> Floats:
        """Return the matrix times parameters (m,), in the order of kept rows."""
        found = empty(len(self))
        for blocks, rows in self.passing():
            put(found, rows, self.piece_times(x, blocks, rows))
        return found

    def piece_times(self, x: Floats, blocks: slice, rows: slice) -> Floats:
        """Return the matrix times parameters (m,) at the kept rows of some blocks."""
        own, values = (self.turn @ x)[self.columns[blocks]], self.values[:, rows]
        if self._few_blocks(blocks, rows):
            bounds = (self.starts[blocks.start : blocks.stop + 1] - rows.start).tolist()
            found = np.empty(rows.stop - rows.start)
            for k, weights in enumerate(own):
                found[bounds[k] : bounds[k + 1]] = weights @ values[:, bounds[k] : bounds[k + 1]]
            return found
        counts, found = self.counts[blocks], np.zeros(rows.stop - rows.start)
        for weights, value in zip(own.T, values, strict=True):
            found += np.repeat(weights, counts) * value
        return found

    def _few_blocks(self, blocks: slice, rows: slice) -> bool:
        return bool(rows.stop - rows.start >= MANY * (blocks.stop - blocks.start))

    def pull(self, kept: Floats) -> Floats:
        """Return the sum over kept rows (n,) of values times rows of the matrix (m,)."""
        sums = np.empty(self.columns.shape)
        for blocks, rows in self.passing():
            weighed = self.values[:, rows] * kept[rows]
            sums[blocks] = np.add.reduceat(weighed, self.starts[blocks] - rows.start, axis=1).T
        let_go(kept)
        raw = np.bincount(self.columns.ravel(), sums.ravel(), len(self.turn))
        return np.asarray(raw @ self.turn)

    def normal(self, kept: Floats | None = None) -> Floats:
        """Return the sum over kept rows of weights (n,), of either sign, 1 by default, times outer squares of rows."""
        squares = np.empty((*self.columns.shape, self.columns.shape[1]))
        for blocks, rows in self.passing():
            values = self.values[:, rows]
            self._products(values if kept is None else values * kept[rows], values, blocks, rows, squares)
        let_go(kept)
        return self.squared(squares)

    def _products(self, left: Floats, right: Floats, blocks: slice, rows: slice, into: Floats) -> None:
        bounds = (self.starts[blocks.start : blocks.stop + 1] - rows.start).tolist()
        for k in range(blocks.stop - blocks.start):
            own = slice(bounds[k], bounds[k + 1])
            np.matmul(left[:, own], right[:, own].T, out=into[blocks.start + k])

    def squares_of(self, stacked: Floats, blocks: slice, rows: slice, into: Floats) -> None:
        """Put the products of stacked columns (k, n) of kept rows with each other into some blocks (blocks, k, k)."""
        self._products(stacked, stacked, blocks, rows, into)

    def squared(self, squares: Floats) -> Floats:
        """Return sums by block of products of kept entries (blocks, k, k) as those of parameters (m, m)."""
        size = len(self.turn)
        place = self.columns[:, :, None] * size + self.columns[:, None, :]
        raw = np.bincount(place.ravel(), squares.ravel(), size * size).reshape(size, size)
        return np.asarray(self.turn.T @ raw @ self.turn)

    def grouped(self, sums: Floats, group: Ints, count: int, block: Ints | None = None) -> Floats:
        """Return sums by block of kept entries (blocks, k) as those by group of blocks and parameter (count, m).

        `block` is whose sums they are, where not those of all blocks in turn.
        """
        size = len(self.turn)
        place = group[:, None] * size + (self.columns if block is None else self.columns[block])
        raw = np.bincount(place.ravel(), sums.ravel(), count * size).reshape(count, size)
        return np.asarray(raw @ self.turn)

    def runs(self, kept: Ints | None = None) -> Runs:
        """Return the blocks as runs, cut where a number of kept rows (n,) changes."""
        if kept is None:
            return Runs(self.starts, np.arange(len(self.counts)))
        steps = np.flatnonzero(kept[1:] != kept[:-1]) + 1
        starts = np.union1d(self.starts, steps)
        return Runs(starts, np.searchsorted(self.starts, starts[:-1], side="right") - 1)

    def by_group(self, kept: Floats, group: Ints, count: int) -> Floats:
        """Return kept values (n,) times rows of the matrix, summed by group of kept rows (n,): (count, m)."""
        size = len(self.turn)
        raw = np.zeros(count * size)
        for blocks, rows in self.passing():
            weight, own, counts = kept[rows], group[rows] * size, self.counts[blocks]
            for column, value in zip(self.columns[blocks].T, self.values[:, rows], strict=True):
                raw += np.bincount(own + np.repeat(column, counts), weight * value, count * size)
        let_go(kept, group)
        return np.asarray(raw.reshape(count, size) @ self.turn)

    def like(self, matrix: Floats) -> Design:
        """Return another matrix (n, k), of which all entries count, with the same order of rows and the same blocks."""
        columns = np.tile(np.arange(matrix.shape[1]), (len(self.counts), 1))
        values = np.ascontiguousarray(self.kept(matrix).T)
        return Design(values, self.order, self.starts, columns, np.eye(matrix.shape[1]))

    def part(self, parameters: slice) -> Design:
        """Return some columns of the matrix, without the entries that stand in none of them."""
        turn = self.turn[:, parameters]
        used = np.flatnonzero(np.any(np.any(turn != 0, axis=1)[self.columns], axis=0))
        # Those that stand together need no copy.
        together = len(used) and used[-1] - used[0] + 1 == len(used)
        chosen = slice(int(used[0]), int(used[-1]) + 1) if together else used
        return Design(self.values[chosen], self.order, self.starts, self.columns[:, chosen], turn)

    def chosen(self, rows: Ints | Bools | slice) -> Ints:
        """Return which of the kept rows some given ones are."""
        chosen = np.zeros(len(self), dtype=bool)
        chosen[rows] = True
        return np.flatnonzero(chosen if self.order is None else chosen[self.order])

    def sample(self, rows: Ints | Bools | slice) -> Design:
        """Return some of the given rows, which ascend."""
        chosen = np.zeros(len(self), dtype=bool)
        chosen[rows] = True
        keep = self.chosen(rows)
        order = None if self.order is None else (np.cumsum(chosen) - 1)[self.order[keep]]
        starts = np.searchsorted(keep, self.starts)
        there = np.diff(starts) > 0
        values = empty(len(keep), each=(len(self.values),))
        for into, column in zip(values, self.values, strict=True):
            for some in spans(len(keep)):
                put(into, some, np.take(column, keep[some]))
            let_go(column)
        return Design(values, order, np.append(starts[:-1][there], len(keep)), self.columns[there], self.turn)

    def without_rows(self) -> Design:
        """Return a matrix of the same columns, with nothing in it."""
        return Design(np.empty((len(self.values), 0)), None, np.zeros(1, np.int64), self.columns[:0], self.turn)

    def blocked(self, place: Ints) -> Design:
        """Return the same matrix, with one place of given rows (n,) in each block."""
        kept = self.kept(place)
        steps = np.flatnonzero(kept[1:] != kept[:-1]) + 1
        if np.isin(steps, self.starts).all():
            return self
        block = np.repeat(np.arange(len(self.counts)), self.counts)
        key = kept * len(self.counts) + block
        order = stable_order(key)
        sizes = np.bincount(key, minlength=1)
        which = np.flatnonzero(sizes)
        starts = np.concatenate([[0], np.cumsum(sizes[which])])
        old = order if self.order is None else self.order[order]
        found = Design(self.values[:, order], old, starts, self.columns[which % len(self.counts)], self.turn)
        return found.in_short_blocks()

    def in_short_blocks(self) -> Design:
        """Return the same matrix, with no block longer than what is worked on at once."""
        starts = cut(self.starts, ROWS_AT_ONCE)
        if len(starts) == len(self.starts):
            return self
        old = np.searchsorted(self.starts, starts[:-1], side="right") - 1
        return replace(self, starts=starts, columns=self.columns[old])

    def block_of(self, rows: slice) -> Ints:
        """Return the block of each of some kept rows that follow each other."""
        edges = np.clip(self.starts, rows.start, rows.stop)
        return np.repeat(np.arange(len(self.counts)), np.diff(edges))

    def first_of(self, kept: Ints) -> Ints:
        """Return what the first row of each block has (blocks,)."""
        return kept[self.starts[:-1]]

    def written_out(self) -> Floats:
        """Return the matrix (n, m)."""
        found = np.empty(self.shape)
        for block, (begin, end) in enumerate(zip(self.starts[:-1].tolist(), self.starts[1:].tolist(), strict=True)):
            rows = slice(begin, end) if self.order is None else self.order[begin:end]
            found[rows] = self.values[:, begin:end].T @ self.turn[self.columns[block]]
        return found


def as_design(matrix: Design | Floats) -> Design:
    """Return a matrix as a design."""
    return matrix if isinstance(matrix, Design) else Design.whole(matrix)
