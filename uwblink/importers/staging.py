"""Staging of tables in a database: columns by the names of a map, ids as numbers, SI units.

The database is temporary. It keeps 350 MB in memory and the rest in a temporary folder (`TMPDIR`), so memory does not
grow with the tables. Whether ids or times are words depends on all rows: such columns are read a second time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Final

import duckdb
import numpy as np

from uwblink.errors import ImportTableError, first_line
from uwblink.importers.column_map import DISTANCE_UNITS, DISTANCES, IDS, NAMES, POWERS, TIME_UNITS, ColumnMap
from uwblink.importers.tables import Columns, Table, connect_to
from uwblink.twr import LARGEST_ID, LATEST_NS, STAMPS

ROWS_AT_ONCE: Final = 245_760
"""Two row groups of DuckDB: smaller blocks would remain separate row groups in a recording."""

Watch = Callable[[str, float], object]
"""Callback for progress: the current step ("reading", "writing" ...) and the share of it that is done."""


def unwatched(_step: str, _share: float) -> None:
    """Take no notice of progress."""


@dataclass(frozen=True, slots=True)
class StagedRows:
    """Rows of a table or view: `row` numbers them, and `origin` is their number among all rows read.

    `from_id` and `to_id` are INTEGER, `time_ns` is BIGINT, all other `columns` are DOUBLE; missing values are NULL.
    """

    db: duckdb.DuckDBPyConnection
    name: str
    columns: tuple[str, ...]

    def count(self, where: str = "true") -> int:
        """Return the number of rows that fulfil an SQL condition."""
        return int(self.db.execute(f"SELECT count(*) FROM {self.name} WHERE {where}").fetchall()[0][0])

    def has(self, name: str) -> bool:
        """Return whether there is a column of one of `NAMES`."""
        return ("time_ns" if name == "time_s" else name) in self.columns

    def read(self, more: str, columns: Collection[str] | None = None) -> Columns:
        """Return columns (None: all) as arrays (n,), NaN for missing values; `more` follows the table in the query.

        The rows must have ids and times.
        """
        chosen = ", ".join(name for name in self.columns if columns is None or name in columns)
        found = self.db.execute(f"SELECT {chosen} FROM {self.name} {more}").fetchnumpy()
        whole = ("from_id", "to_id", "time_ns", "origin")
        return {
            name: np.ma.getdata(column).astype(np.int64)
            if name in whole
            else np.ma.filled(column.astype(np.float64, copy=False), np.nan)
            for name, column in found.items()
        }

    def blocks(self, where: str = "true") -> Iterator[Columns]:
        """Yield the rows that fulfil a condition in their order, block by block."""
        for start in range(0, self.count(), ROWS_AT_ONCE):
            # DuckDB keeps the order of rows; ORDER BY would sort them.
            yield self.read(f"WHERE row >= {start} AND row < {start + ROWS_AT_ONCE} AND {where}")


@contextmanager
def staged(paths: Sequence[Path], column_map: ColumnMap, watch: Watch = unwatched) -> Iterator[Staging]:
    """Stage several tables as one for the duration of the block; raises `ImportTableError`, also if the disk is full.

    Columns are read if the map names them, or if their names are in `NAMES`.
    """
    with TemporaryDirectory(prefix="uwblink-") as folder, connect_to(paths, folder) as db:
        try:
            yield Staging(db, paths, column_map, watch)
        except (duckdb.OutOfMemoryException, duckdb.IOException) as error:
            raise ImportTableError(
                f"{gettempdir()}: what does not fit into memory cannot be written there ({first_line(error)}); "
                "TMPDIR names another folder"
            ) from error


class Staging:
    """Tables staged as one; `rows` are their rows.

    `names` are the ids that were words, by assigned number; `offsets` are the numbers of each table's first row among
    all rows, and the number of all rows.
    """

    def __init__(
        self, db: duckdb.DuckDBPyConnection, paths: Sequence[Path], column_map: ColumnMap, watch: Watch
    ) -> None:
        """See `staged`."""
        self.db, self.paths, self.column_map = db, tuple(paths), column_map
        self.tables: list[Table] = []
        self.names: dict[int, str] = {}
        self._headers: dict[str, str] = {}
        counts = [0]
        for k, path in enumerate(paths):
            watch("reading", k / len(paths))
            self._add(Table(path, column_map.delimiter, column_map.decimal, db=db, key=k))
            counts.append(self._query_number("count(*)"))
        self.offsets = np.array(counts)
        if not counts[-1]:
            raise ImportTableError(f"{paths[0]}: a header and no rows")
        self.rows = self._make_rows()

    def require(self, rows: StagedRows, names: Iterable[str]) -> None:
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

    def _add(self, table: Table) -> None:
        """Stage the columns of another table."""
        self.tables.append(table)
        column_map = self.column_map
        wanted = {name: column_map.header(name) for name in NAMES if name not in column_map.constants}
        headers = {name: header for name, header in wanted.items() if header in table.names}
        absent = [name for name in column_map.columns if name in wanted and name not in headers]
        if absent or not headers:
            raise self.missing([*absent, "from_id"][0])
        if headers.keys() != (self._headers or headers).keys():
            raise ImportTableError(f"{table.path}: has other columns than {self.paths[0]}, so they are not one table")
        self._headers = headers
        cells = {name: table.number(header) for name, header in headers.items()}
        if "event" in cells:
            first = f"lower(left({table.word(headers['event'])}, 1))"
            cells["event"] = f"CASE WHEN {first} IN ('t', 's') THEN 1.0 WHEN {first} = 'r' THEN 2.0 END"
        self._stage("staged", table, cells)

    def _stage(self, name: str, table: Table, cells: dict[str, str]) -> None:
        """Read SQL expressions of a table's columns into a table of the database."""
        chosen = ", ".join(f"{cell} AS {column}" for column, cell in cells.items())
        into = f"CREATE TABLE {name} AS" if table is self.tables[0] else f"INSERT INTO {name}"
        with table.reading():
            self.db.execute(f"{into} SELECT {chosen} FROM {table.source}")

    def _query_number(self, number: str) -> int:
        """Return the value of an SQL expression over the staged rows."""
        return int(self.db.execute(f"SELECT {number} FROM staged").fetchall()[0][0])

    def _add_columns(self, query: str) -> None:
        """Add the columns of a query to the staged rows, row by row."""
        self.db.execute(f"CREATE TABLE beside AS {query}")
        self.db.execute("CREATE TABLE wider AS SELECT * FROM staged POSITIONAL JOIN beside")
        self.db.execute("DROP TABLE staged")
        self.db.execute("DROP TABLE beside")
        self.db.execute("ALTER TABLE wider RENAME TO staged")

    def _make_rows(self) -> StagedRows:
        """Return a view of the staged rows with exact numbers, SI units, and ids as numbers."""
        exact, column_map = self._read_again(), self.column_map
        values = {name: name for name in self._headers}
        values |= {n: f"CAST({v!r} AS DOUBLE)" for n, v in column_map.constants.items() if not isinstance(v, str)}
        # Differences need only the low 40 bits of ticks.
        low = {n: f"CAST({n}_exact & {(1 << 40) - 1} AS DOUBLE)" for n in exact if n in _COUNTED}
        values |= {n: f"CASE WHEN {n} = trunc({n}) THEN {value} ELSE {n} END" for n, value in low.items()}
        factors = dict.fromkeys(DISTANCES, DISTANCE_UNITS[column_map.distance_unit or "m"])
        factors |= dict.fromkeys(POWERS, -1.0 if column_map.power_unit == "-dBm" else 1.0)
        values |= {n: f"{values[n]} * {factor!r}" for n, factor in factors.items() if n in values and factor != 1.0}
        ids = self._ids(values, exact)
        if "time_s" in values:
            seconds = f"{values['time_s']} * {TIME_UNITS.get(column_map.time_unit or 's', 1.0)!r}"
            time = "time_s_exact" if "time_s" in exact else seconds
            ids["time_ns"] = f"CASE WHEN {time} BETWEEN -{LATEST_NS} AND {LATEST_NS} THEN CAST({time} AS BIGINT) END"
        values = ids | {name: value for name, value in values.items() if name not in (*IDS, "time_s")}
        chosen = ", ".join(f"{value} AS {name}" for name, value in values.items())
        self.db.execute(f"CREATE VIEW rows AS SELECT rowid AS row, rowid AS origin, {chosen} FROM staged")
        return StagedRows(self.db, "rows", ("origin", *values))

    def _read_again(self) -> set[str]:
        """Read columns of words, and of integers that floats cannot represent, again; returns their names."""
        found: dict[str, Callable[[Table, str], str]] = {}
        for name in self._headers:
            unit = self.column_map.time_unit
            counted = name in _COUNTED and self.column_map.ticks_per_unit == 1.0
            if name in IDS:
                # Up to 1 % of ids that are not numbers are faults; with more, ids are words.
                if self._query_number(f"count(*) - count(*) FILTER ({_is_id(name)})") > 0.01 * self.offsets[-1]:
                    found[name] = Table.word
            elif name == "time_s" and (unit == "iso" or (unit is None and not self._query_number("count(time_s)"))):
                found[name] = Table.time_ns
            elif (counted or (name == "time_s" and unit == "ns")) and self._query_number(
                f"count(*) FILTER (abs({name}) >= {2**53})"
            ):
                found[name] = Table.whole_number  # not all whole numbers from 2**53 on are floats
        if found:
            for table in self.tables:
                cells = {f"{name}_exact": cell(table, self._headers[name]) for name, cell in found.items()}
                self._stage("again", table, cells)
            self._add_columns("SELECT * FROM again")
            self.db.execute("DROP TABLE again")
        return set(found)

    def _ids(self, values: dict[str, str], exact: set[str]) -> dict[str, str]:
        """Return SQL expressions of ids as whole numbers, NULL if missing; words get numbers."""
        told = {n: v for n, v in self.column_map.constants.items() if n in IDS and isinstance(v, str)}
        numbers = {
            n: f"CASE WHEN {_is_id(values[n])} THEN CAST({values[n]} AS INTEGER) END" for n in IDS if n in values
        }
        if not told and not exact & {*IDS}:
            return numbers
        words = {n: f"{n}_exact" if n in exact else f"coalesce(CAST({x} AS VARCHAR), '')" for n, x in numbers.items()}
        found = set(told.values())
        for word in words.values():
            # A million different words are more than ids can be written in.
            if self._query_number(f"approx_count_distinct({word})") > 1_000_000:
                raise self._too_many_ids()
            found |= {str(one) for (one,) in self.db.execute(f"SELECT DISTINCT {word} FROM staged").fetchall()}
        known = self._number_words(sorted(found - {""}))
        if words:
            columns = {"word": np.array(["", *known]), "number": np.array([-1, *known.values()])}
            self.db.register("known", columns)
            joined = " ".join(f"LEFT JOIN known {n} ON {n}.word = {word}" for n, word in words.items())
            chosen = ", ".join(f"CAST(nullif({n}.number, -1) AS INTEGER) AS {n}_number" for n in words)
            self._add_columns(f"SELECT {chosen} FROM staged {joined} ORDER BY staged.rowid")
            self.db.unregister("known")
        return {n: f"{n}_number" for n in words} | {n: f"CAST({known[word]} AS INTEGER)" for n, word in told.items()}

    def _number_words(self, words: list[str]) -> dict[str, int]:
        """Return the number of each id: its own, the map's, or else the next free one in alphabetical order."""
        # Python does not convert texts of thousands of digits.
        numbers = {w: int(w) for w in words if w.isdecimal() and len(w) < 9 and int(w) <= LARGEST_ID}
        if len(numbers) == len(words):
            return numbers
        numbers |= self.column_map.ids
        free = iter(sorted({*range(1, LARGEST_ID + 1)} - {*numbers.values()}))
        for word in words:
            if word not in numbers:
                number = next(free, None)
                if number is None:
                    raise self._too_many_ids()
                numbers[word] = number
        self.names = {numbers[word]: word for word in words if word != str(numbers[word])}
        return {word: numbers[word] for word in words}

    def _too_many_ids(self) -> ImportTableError:
        return ImportTableError(f"{self.paths[0]}: more than {LARGEST_ID} different ids; are from_id and to_id ids?")


_COUNTED: Final = (*STAMPS, "tx", "rx", "stamp")
"""Columns of stamps."""


def _is_id(value: str) -> str:
    return f"{value} BETWEEN 0 AND {LARGEST_ID} AND {value} = trunc({value})"
