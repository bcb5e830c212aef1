"""Rows that are put aside in files without a name, where they are too many to be in memory."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Ints
from uwblink.importers.column_map import IDS, ColumnMap
from uwblink.importers.staging import Stage
from uwblink.importers.table_rows import ROWS_AT_ONCE, Rows


class RowFile:
    """Rows one after the other: ids, origin, time if there is one, and cells."""

    def __init__(self, stage: Stage, like: Rows) -> None:
        """Make room for rows with the columns of some that are given."""
        timed = [("time_ns", "<i8")] if like.time_ns is not None else []
        whole = [*((name, "<i4") for name in IDS), ("origin", "<i8"), *timed]
        self.kind = np.dtype([*whole, *((name, "<f8") for name in like.cells)])
        self.column_map, self.cells, self.count = like.column_map, tuple(like.cells), 0
        self._stage, self._file = stage, stage.file()

    def append(self, rows: Rows) -> None:
        """Write rows; raises `ImportTableError` where the disk does not take them."""
        records = np.empty(len(rows), dtype=self.kind)
        for name, column in (rows.ids | rows.cells | {"origin": rows.origin}).items():
            records[name] = column
        if rows.time_ns is not None:
            records["time_ns"] = rows.time_ns
        try:
            self._file.write(records.tobytes())
        except OSError as error:
            raise self._stage.unwritable(error) from error
        self.count += len(rows)

    def read(self, pieces: Iterable[tuple[int, int]], names: Collection[str] | None = None) -> Rows:
        """Return the rows from some places until before others, with the cells of some columns (None: of all)."""
        found = np.concatenate([np.empty(0, self.kind), *(self._records(start, stop) for start, stop in pieces)])
        timed = "time_ns" in (self.kind.names or ())
        return Rows(
            column_map=self.column_map,
            cells={name: found[name].copy() for name in self.cells if names is None or name in names},
            ids={name: found[name].astype(np.int64) for name in IDS},
            time_ns=found["time_ns"].copy() if timed else None,
            origin=found["origin"].copy(),
        )

    def close(self) -> None:
        """Forget everything."""
        self._file.close()

    def _records(self, start: int, stop: int) -> NDArray[Any]:
        self._file.seek(start * self.kind.itemsize)
        return np.frombuffer(self._file.read((stop - start) * self.kind.itemsize), dtype=self.kind)


@dataclass(frozen=True, slots=True)
class FiledRows:
    """Rows in a file, as a source of rows."""

    file: RowFile

    @property
    def column_map(self) -> ColumnMap:
        """What the columns are called, and in which units they are."""
        return self.file.column_map

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.file.count

    def has(self, name: str) -> bool:
        """Return whether there is a column of one of `NAMES`."""
        return ("time_ns" if name == "time_s" else name) in (self.file.kind.names or ())

    def blocks(self, names: Collection[str] | None = None) -> Iterator[Rows]:
        """Yield all rows in their order, some at a time, with the cells of some columns (None: of all)."""
        for start in range(0, len(self), ROWS_AT_ONCE):
            yield self.file.read([(start, min(start + ROWS_AT_ONCE, len(self)))], names)

    def at(self, places: Ints, names: Collection[str]) -> Rows:
        """Return the rows at some places, with the cells of some columns."""
        return self.file.read([(place, place + 1) for place in places.tolist()], names)
