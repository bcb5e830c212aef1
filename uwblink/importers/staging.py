"""Staging of tables in a database: columns by the names of a map, ids as numbers, SI units.

The database is temporary and mostly on disk (`tables.connected`), so memory does not grow with the tables.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import duckdb
import numpy as np

from uwblink.errors import ImportTableError
from uwblink.importers.column_map import DISTANCE_UNITS, DISTANCES, IDS, NAMES, POWERS, TIME_UNITS, ColumnMap
from uwblink.importers.tables import Columns, Table, number, time_ns, whole_number
from uwblink.twr import LARGEST_ID, STAMPS

ROWS_PER_BLOCK: Final = 245_760
"""Two row groups of DuckDB: smaller blocks would remain separate row groups in a recording."""

Watch = Callable[[str, float], object]
"""Callback for progress: the current step ("reading", "writing" ...) and the share of it that is done."""


def unwatched(_step: str, _share: float) -> None:
    """Take no notice of progress."""


@dataclass(frozen=True, slots=True)
class Rows:
    """The rows of a table for which an SQL condition is true; `origin` is their number among all rows read.

    `from_id` and `to_id` are INTEGER, `time_ns` and stamps in ticks BIGINT, all other `columns` DOUBLE; missing values
    are NULL.
    """

    db: duckdb.DuckDBPyConnection
    name: str
    columns: tuple[str, ...]
    condition: str = "true"

    def where(self, condition: str) -> Rows:
        """Return the rows for which this condition is true, too."""
        return replace(self, condition=f"{self.condition} AND ({condition})")

    def has(self, name: str) -> bool:
        """Return whether there is a column of one of `NAMES`."""
        return ("time_ns" if name == "time_s" else name) in self.columns

    def values(self, expressions: str) -> tuple[int, ...]:
        """Return SQL aggregates over the rows."""
        ((*found,),) = self.db.execute(f"SELECT {expressions} FROM {self.name} WHERE {self.condition}").fetchall()
        return tuple(found)

    def count(self) -> int:
        """Return the number of rows."""
        return int(self.values("count(*)")[0])

    def read(self, more: str = "") -> Columns:
        """Return the rows as arrays (n,), missing integers as 0, floats as NaN; `more` ends the query."""
        query = f"SELECT {', '.join(self.columns)} FROM {self.name} WHERE {self.condition} {more}"
        found = self.db.execute(query).fetchnumpy()
        return {
            name: np.ma.filled(column.astype(np.int64), 0)
            if column.dtype.kind in "iu"
            else np.ma.filled(column.astype(np.float64, copy=False), np.nan)
            for name, column in found.items()
        }

    def blocks(self) -> Iterator[Columns]:
        """Yield the rows in their order, block by block; empty blocks are left out."""
        for start in range(0, replace(self, condition="true").count(), ROWS_PER_BLOCK):
            # DuckDB keeps the order of rows; ORDER BY would sort them.
            columns = self.read(f"AND rowid >= {start} AND rowid < {start + ROWS_PER_BLOCK}")
            if len(columns["origin"]):
                yield columns

    def sample(self, size: int) -> Columns:
        """Return a pseudo-random sample of the rows, in their order."""
        some = f"SELECT rowid FROM {self.name} WHERE {self.condition} ORDER BY hash(rowid) LIMIT {size}"
        return self.read(f"AND rowid IN ({some}) ORDER BY rowid")


class Staging:
    """Tables staged as one; `rows` are their rows.

    `names` are the ids that were words, by assigned number; `offsets` are the numbers of each table's first row among
    all rows, and the number of all rows.
    """

    def __init__(
        self, db: duckdb.DuckDBPyConnection, paths: Sequence[Path], column_map: ColumnMap, watch: Watch
    ) -> None:
        """Stage tables: the columns that the map names, and those whose names are in `NAMES`.

        Raises `ImportTableError`.
        """
        self.db, self.paths, self.column_map = db, tuple(paths), column_map
        self.tables: list[Table] = []
        self.names: dict[int, str] = {}
        self.offsets = [0]
        for name, value in column_map.constants.items():
            db.execute(f"SET VARIABLE {name} = ?", [str(value)])
        columns: Collection[str] = ()
        for k, path in enumerate(paths):
            watch("reading", k / len(paths))
            table = Table(db, path, column_map.delimiter, column_map.decimal, key=k)
            self.tables.append(table)
            cells = self._cells(table)
            if cells.keys() != (columns or cells.keys()):
                raise ImportTableError(f"{path}: has other columns than {paths[0]}, so they are not one table")
            columns = cells.keys()
            chosen = ", ".join(f"{cell} AS {name}" for name, cell in cells.items())
            with table.reading():
                into = "INSERT INTO staged" if k else "CREATE TABLE staged AS"
                db.execute(f"{into} SELECT {chosen} FROM {table.source}")
            self.offsets.append(Rows(db, "staged", ()).count())
        if not self.offsets[-1]:
            raise ImportTableError(f"{paths[0]}: a header and no rows")
        others = tuple(name for name in columns if name not in IDS)
        ids = ", ".join(f"{cell} AS {name}" for name, cell in self._ids().items())
        listed = ", ".join(("CAST(rowid AS UINTEGER) AS origin", ids, *others))
        db.execute(f"CREATE TABLE rows AS SELECT {listed} FROM staged")
        db.execute("DROP TABLE staged")
        self.rows = Rows(db, "rows", ("origin", *IDS, *others))

    def require(self, rows: Rows, names: Iterable[str]) -> None:
        """Raise the error for the first column that rows lack."""
        for name in names:
            if not rows.has(name):
                raise self.missing(name)

    def missing(self, name: str) -> ImportTableError:
        """Return the error for a missing column."""
        names, header = self.tables[0].names, self.column_map.header(name)
        remedy = "a `map_file` can rename columns or give constants, and `uwblink import guess` proposes one"
        if {"qx", "qy", "qz", "qw"} <= {name.lower() for name in names}:
            remedy = "these are poses, which `uwblink poses` adds to a recording"
        there = ", ".join(names)[:400]
        return ImportTableError(f"{self.paths[0]}: column {header!r} is missing; there are {there}; {remedy}")

    def _cells(self, table: Table) -> dict[str, str]:
        """Return SQL of the columns to stage, from cells of a table or constants; ids are words at first."""
        column_map, found = self.column_map, dict[str, str]()
        for name in NAMES:
            header = column_map.header(name)
            if name in column_map.constants:
                text = f"getvariable('{name}')"
            elif header in table.names:
                text = table.text(header, numeric=name not in IDS)
            elif name in column_map.columns or name in IDS:
                raise self.missing(name)
            else:
                continue
            found["time_ns" if name == "time_s" else name] = self._cell(name, text)
        return found

    def _cell(self, name: str, text: str) -> str:
        """Return SQL of a cell in SI units, from its text."""
        column_map = self.column_map
        if name in IDS:
            return f"trim({text})"
        if name == "time_s":
            return time_ns(text, column_map.time_unit, TIME_UNITS.get(column_map.time_unit or "s", 1.0))
        if name == "event":
            first = f"lower(left(trim({text}), 1))"
            return f"CASE WHEN {first} IN ('t', 's') THEN 1.0 WHEN {first} = 'r' THEN 2.0 END"
        if name in (*STAMPS, "tx", "rx", "stamp") and column_map.ticks_per_unit == 1.0:
            return whole_number(text)
        factor = DISTANCE_UNITS[column_map.distance_unit or "m"] if name in DISTANCES else 1.0
        if name in POWERS and column_map.power_unit == "-dBm":
            factor = -1.0
        return number(text) + (f" * {factor!r}" if factor != 1.0 else "")

    def _ids(self) -> dict[str, str]:
        """Return SQL of ids as whole numbers, NULL if missing; words get numbers."""
        words: set[str] = set()
        for name in IDS:
            query = f"SELECT {name}, count(*) FROM staged GROUP BY {name} LIMIT 200000"
            counts: dict[str, int] = dict(self.db.execute(query).fetchall())
            if len(counts) == 200_000:
                raise self._too_many_ids()
            # Up to 1 % of ids that are not numbers are faults; with more, ids are words.
            odd = {word for word in counts if word not in _numbers([word])}
            few = sum(counts[word] for word in odd) <= 0.01 * self.offsets[-1]
            words |= counts.keys() - (odd if few else {""})
        numbers = self._number_words(sorted(words))
        self.db.execute("SET VARIABLE words = ?", [["", *numbers]])
        self.db.execute("SET VARIABLE numbers = ?", [[None, *numbers.values()]])
        self.db.execute("CREATE TYPE word AS ENUM (SELECT unnest(getvariable('words')))")
        return {
            name: f"CAST(getvariable('numbers')[enum_code(TRY_CAST({name} AS word)) + 1] AS INTEGER)" for name in IDS
        }

    def _number_words(self, words: list[str]) -> dict[str, int]:
        """Return the number of each id: its own, the map's, or else the next free one in alphabetical order."""
        numbers = _numbers(words)
        if len(numbers) < len(words):
            numbers = numbers | self.column_map.ids
            free = iter(sorted({*range(1, LARGEST_ID + 1)} - {*numbers.values()}))
            numbers |= dict(zip((word for word in words if word not in numbers), free, strict=False))
        if not numbers.keys() >= set(words):
            raise self._too_many_ids()
        self.names = {numbers[word]: word for word in words if numbers[word] != _numbers([word]).get(word)}
        return {word: numbers[word] for word in words}

    def _too_many_ids(self) -> ImportTableError:
        return ImportTableError(f"{self.paths[0]}: more than {LARGEST_ID} different ids; are from_id and to_id ids?")


def _numbers(words: Iterable[str]) -> dict[str, int]:
    """Return the ids that are whole numbers, such as "7" and "7.0"."""
    matches = {word: re.fullmatch(r"([0-9]{1,9})([.,]0*)?", word) for word in words}
    found = {word: int(match[1]) for word, match in matches.items() if match}
    return {word: value for word, value in found.items() if value <= LARGEST_ID}
