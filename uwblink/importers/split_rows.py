"""Rows that are too many to be in memory, put in order: in parts of which each holds what sorts between two rows.

Where parts meet is told by some of the rows, drawn by chance, so that parts are about as large as each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Final

import numpy as np

from uwblink.arrays import Ints
from uwblink.importers.belonging import Belonging
from uwblink.importers.row_files import FiledRows, RowFile
from uwblink.importers.staging import Stage
from uwblink.importers.table_rows import ROWS_AT_ONCE, HeldRows, Rows, RowSource, joined, take

DRAWN: Final = 64
"""Rows of a part that are drawn by chance: its length is off by an eighth then."""


@dataclass(frozen=True, slots=True)
class Order:
    """How rows are put in order: by what they belong together by, and `sampled`, which returns some of them.

    Rows without time that come as they were read are in the order of their origin.
    """

    belonging: Belonging
    sampled: Callable[[], Rows]
    as_read: bool = True

    def keys(self, rows: Rows) -> list[Ints]:
        """Return what rows are in order by, (n,) each, the last that counts first."""
        last = rows.time_ns if rows.time_ns is not None else rows.origin if self.as_read else None
        return [*([] if last is None else [last]), *reversed(self.belonging.keys(rows))]


class SplitRows:
    """Rows in parts that follow each other."""

    def __init__(self, stage: Stage, like: Rows, order: Order) -> None:
        """Make room for rows with the columns of some that are given."""
        self._order, self._file = order, RowFile(stage, like)
        sample = order.sampled()
        keys = order.keys(sample)
        edges = np.lexsort(keys)[DRAWN::DRAWN]
        self._edges = [key[edges] for key in keys]
        self._pieces: list[Ints] = []

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._file.count

    def append(self, rows: Rows) -> None:
        """Write rows; raises `ImportTableError` where the disk does not take them."""
        pairs = zip(self._edges, self._order.keys(rows), strict=True)
        # Edges come before what is equal to them, which hence is in one part wherever it was read.
        place = np.lexsort([np.concatenate(pair) for pair in pairs])
        edge = place < len(self._edges[0])
        before = np.flatnonzero(edge) - np.arange(len(self._edges[0]))
        self._pieces.append(self._file.count + np.array([0, *before, len(rows)]))
        self._file.append(take(rows, place[~edge] - len(self._edges[0])))

    def blocks(self) -> Iterator[Rows]:
        """Yield all rows in order, a part at a time."""
        for pieces in zip(*(pairwise(edges.tolist()) for edges in self._pieces), strict=True):
            yield self._order.belonging.in_order(self._file.read(pieces))

    def close(self) -> None:
        """Forget everything."""
        self._file.close()


def drawn(total: int) -> Ints:
    """Return the places of some of many rows, drawn by chance: as many as `SplitRows` wants, in ascending order."""
    count = DRAWN * (2 * total // ROWS_AT_ONCE + 1)
    return np.unique(np.random.default_rng(0).integers(total, size=count))


def collected(stage: Stage, parts: Iterable[Rows]) -> RowSource:
    """Return rows as a source: in memory where they are few, else in a file; there is one part at least."""
    first, others = _first(parts)
    if others is None:
        return HeldRows(first)
    file = RowFile(stage, first)
    for rows in chain([first], others):
        file.append(rows)
    return FiledRows(file)


def split(stage: Stage, parts: Iterable[Rows], order: Order) -> HeldRows | SplitRows:
    """Return rows as `collected` does, but for those in files, which are put in order."""
    first, others = _first(parts)
    if others is None:
        return HeldRows(first)
    found = SplitRows(stage, first, order)
    for rows in chain([first], others):
        found.append(rows)
    return found


def _first(parts: Iterable[Rows]) -> tuple[Rows, Iterator[Rows] | None]:
    """Return the first rows, and the others, None where there are none and the first are few."""
    coming, first = iter(parts), list[Rows]()
    for part in coming:
        first.append(part)
        if sum(map(len, first)) > ROWS_AT_ONCE:
            return joined(first), coming
    return joined(first), None
