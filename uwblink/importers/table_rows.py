"""Rows of tables by the names of a map: numbers in our units, ids as numbers, times in nanoseconds."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.importers.column_map import ColumnMap
from uwblink.importers.stamps import NEVER

ROWS_AT_ONCE: Final = 245_760
"""Twice what DuckDB keeps together: parts of that would stay apart in a recording."""
SENT, RECEIVED = 1.0, 2.0
"""What becomes of the words in a column of events."""


@dataclass(slots=True, kw_only=True)
class Rows:
    """Some rows, columns by the names of `column_map` (n,): NaN or `NEVER` where a cell holds none.

    `origin` is their place among all rows that were read.
    """

    column_map: ColumnMap
    cells: dict[str, Floats]
    ids: dict[str, Ints]
    time_ns: Ints | None
    origin: Ints

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.origin)


class RowSource(Protocol):
    """Rows that need not be in memory at once."""

    @property
    def column_map(self) -> ColumnMap:
        """What the columns are called, and in which units they are."""

    def __len__(self) -> int:
        """Return the number of rows."""

    def has(self, name: str) -> bool:
        """Return whether there is a column of one of `NAMES`."""

    def blocks(self, names: Collection[str] | None = None) -> Iterator[Rows]:
        """Yield all rows in their order, some at a time, with the cells of some columns (None: of all)."""

    def at(self, places: Ints, names: Collection[str]) -> Rows:
        """Return the rows at some places, in ascending order without repetition, with the cells of some columns."""


@dataclass(frozen=True, slots=True)
class HeldRows:
    """Rows in memory."""

    rows: Rows

    @property
    def column_map(self) -> ColumnMap:
        """What the columns are called, and in which units they are."""
        return self.rows.column_map

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.rows)

    def has(self, name: str) -> bool:
        """Return whether there is a column of one of `NAMES`."""
        return has(self.rows, name)

    def blocks(self, names: Collection[str] | None = None) -> Iterator[Rows]:
        """Yield all rows in their order, some at a time, with all cells."""
        for start in range(0, len(self.rows), ROWS_AT_ONCE):
            yield take(self.rows, np.arange(start, min(start + ROWS_AT_ONCE, len(self.rows))))

    def at(self, places: Ints, names: Collection[str]) -> Rows:
        """Return the rows at some places, with all cells."""
        return take(self.rows, places)


def has(rows: Rows, name: str) -> bool:
    """Return whether there is a column of one of `NAMES`."""
    return name in rows.cells or name in rows.ids or (name == "time_s" and rows.time_ns is not None)


def has_ends(rows: Rows) -> Bools:
    """Return which rows name two different devices, (n,)."""
    one, other = rows.ids["from_id"], rows.ids["to_id"]
    return np.asarray((one != NEVER) & (other != NEVER) & (one != other))


def take(rows: Rows, chosen: Ints | Bools) -> Rows:
    """Return some rows, in the order given."""
    return replace(
        rows,
        cells={name: column[chosen] for name, column in rows.cells.items()},
        ids={name: column[chosen] for name, column in rows.ids.items()},
        time_ns=None if rows.time_ns is None else rows.time_ns[chosen],
        origin=rows.origin[chosen],
    )


def joined(parts: list[Rows]) -> Rows:
    """Return rows as one."""
    first = parts[0]
    return replace(
        first,
        cells={name: np.concatenate([part.cells[name] for part in parts]) for name in first.cells},
        ids={name: np.concatenate([part.ids[name] for part in parts]) for name in first.ids},
        time_ns=None if first.time_ns is None else np.concatenate([p.time_ns for p in parts if p.time_ns is not None]),
        origin=np.concatenate([part.origin for part in parts]),
    )
