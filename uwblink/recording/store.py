"""A DuckDB file of tables: SQL in, rows and columns out, and every error with the file's name.

Files may come from anyone, so they are data: they are opened read-only, without access to other files and with locked
settings, and are checked (`uwblink.recording.intake`) before anything in them is read.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.database import connect, duckdb, log_of
from uwblink.errors import RecordingError, RecordingInUseError, first_line
from uwblink.recording.intake import (
    COLUMNS_OF_FILE,
    check_intake,
    check_length,
    check_name,
    damaged,
    interrupted_after,
    is_locked,
    longest_read_s,
)
from uwblink.recording.schema import ADDED_LATER, SUFFIX, TABLES

_UNFIT: Final = (duckdb.DataError, duckdb.InvalidInputException, duckdb.BinderException)
"""DuckDB's errors for values that do not fit into a table; other errors are of the file."""


class Store:
    """An open file with the tables of `TABLES`, on which `Recording` is built; `path` is its name in messages."""

    def __init__(
        self,
        connection: duckdb.DuckDBPyConnection,
        path: Path,
        *,
        writes: bool,
        size: int = 0,
        partial: Path | None = None,
    ) -> None:
        """Wrap an open connection to a file of `size` bytes, which limits the time of reading.

        `writes`: the file is open for writing. `partial` is the file that takes the name `path` when it is complete.
        """
        self._db, self.path, self._writes, self._partial = connection, path, writes, partial
        self._longest_read_s = longest_read_s(size)
        self._place = ExitStack()
        """The folder of `partial`, which is removed at the end."""

    @classmethod
    def _open_to_write(cls, path: Path, partial: Path | None, memory_mb: int | None = None) -> Self:
        """Open or make the file `partial`, or else `path`, for a recording called `path`; raises `RecordingError`.

        A reader that checks a file which was just made holds it for a moment: the writer waits up to two seconds.
        """
        check_name(path)
        place = partial or path
        end_s = time.monotonic() + 2.0
        while True:
            try:
                # Snapshots are written beside the recording, and nothing is ever written elsewhere.
                db = connect(place, folders=[place.parent], memory_mb=memory_mb)
                break
            except duckdb.Error as error:
                if time.monotonic() > end_s or not is_locked(place, update=True):
                    raise RecordingError(f"{path}: cannot be written ({first_line(error)})") from error
                time.sleep(0.02)
        store = cls(db, path, writes=True, partial=partial)
        store._create()
        return store

    @classmethod
    def _open_to_read(cls, path: Path, *, update: bool, memory_mb: int | None = None) -> Self:
        """Open a file for reading, or to `update` it; raises `RecordingError` if it is none, or is in use.

        At most `memory_mb` of what was read, and of what a query works on, is kept in memory, by default most of what
        there is; a file that is open in this program already keeps the limit with which it was opened.
        """
        check_name(path)
        check_length(path)
        size = path.stat().st_size
        try:
            try:
                connection = connect(path, read_only=not update, memory_mb=memory_mb)
            except duckdb.ConnectionException:
                connection = connect(path, read_only=not update)
        except duckdb.ConnectionException as error:
            raise RecordingError(f"{path}: is open in this program in another way; close it there first") from error
        except duckdb.Error as error:
            if isinstance(error, duckdb.IOException) and is_locked(path, update=update):
                use = "has it open" if update else "is writing it"
                raise RecordingInUseError(f"{path}: another process {use}; wait until that ends") from error
            raise damaged(path, error) from error
        store = cls(connection, path, writes=update, size=size)
        try:
            check_intake(store._fetch, path, size)
            store._check_tables()
            if update:
                store._create()
        except RecordingError:
            store._db.close()
            raise
        return store

    def shorten_log(self) -> None:
        """Write the log into the file, also while other threads write; raises `RecordingError`.

        Closing does so too, but does not report failures.
        """
        with self._writing(), self._db.cursor() as db:
            db.execute("CHECKPOINT")

    def _execute(self, statement: str, values: list[Any] | None = None) -> None:
        """Execute a statement of SQL; raises `RecordingError` where the file cannot be written."""
        with self._writing():
            self._db.execute(statement, values)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Raise `RecordingError` for what DuckDB raises where the file cannot be written."""
        try:
            yield
        except _UNFIT:
            raise  # `_insert` knows of which table
        except duckdb.Error as error:
            disk = isinstance(error, duckdb.IOException | duckdb.TransactionException | duckdb.FatalException)
            reason = f"{first_line(error)}){'; is the disk full?' if disk else ';'}"
            if self._partial:
                raise RecordingError(f"{self.path}: cannot be written ({reason} nothing was written") from error
            raise RecordingError(
                f"{self.path}: cannot be written any more ({reason} everything before is kept, perhaps some of it in "
                f"{log_of(self.path).name} beside it: keep the two together"
            ) from error

    def _insert(self, table: str, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add rows from columns with the table's names; masked values are missing in the table.

        Raises `RecordingError` for values that do not fit into the table.
        """
        names = [name for name in TABLES[table] if name in columns]
        lengths = {name: len(columns[name]) for name in names}
        if len(set(lengths.values())) > 1:
            raise RecordingError(f"{self.path}: table {table}: columns of different lengths, {lengths}")
        if not lengths or not lengths[names[0]]:
            return
        arrays, bound = dict[str, NDArray[Any]](), list[Any]()
        values = [_value(name, TABLES[table][name], columns[name], arrays, bound) for name in names]
        listed = ", ".join(f'"{name}"' for name in names)
        self._db.register("batch", arrays)
        try:
            self._execute(f"INSERT INTO {table} ({listed}) SELECT {', '.join(values)} FROM batch", bound)  # noqa: S608 - keys of TABLES
        except _UNFIT as error:
            raise RecordingError(
                f"{self.path}: table {table}: values that do not fit ({first_line(error)}); "
                f"its columns are {', '.join(f'{name} {kind}' for name, kind in TABLES[table].items())}"
            ) from error
        self._db.unregister("batch")

    def _select(self, query: str, values: list[Any] | None = None) -> dict[str, NDArray[Any]]:
        """Return the result of a query as columns, masked where values are missing; raises `RecordingError`."""
        with self._reading():
            return dict(self._db.execute(query, values).fetchnumpy())

    def _fetch(self, query: str) -> list[tuple[Any, ...]]:
        """Return the result of a query as rows; raises `RecordingError`."""
        with self._reading():
            return self._db.execute(query).fetchall()

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            with interrupted_after(self._longest_read_s, self._db.interrupt):
                yield
        except duckdb.Error as error:
            late = isinstance(error, duckdb.InterruptException)
            why = f"took longer than {self._longest_read_s:.0f} s" if late else first_line(error)
            raise RecordingError(f"{self.path}: cannot be read, truncated or damaged ({why})") from error

    def _blocks(self, table: str, rows: int) -> Iterator[str]:
        """Yield conditions of queries for all rows of a table in their order, some at a time."""
        ((last,),) = self._fetch(f"SELECT coalesce(max(rowid), -1) FROM {table}")  # noqa: S608 - a key of TABLES
        for start in range(0, last + 1, rows):
            yield f"WHERE rowid >= {start} AND rowid < {start + rows}"

    def _take(self, source: Store, table: str) -> None:
        """Add all rows of another file's table in their order, missing values included, some at a time."""
        # 100 000 impulse responses, which are the largest rows, take 0.2 GB.
        for block in source._blocks(table, 100_000):
            self._insert(table, source._select(f"SELECT {', '.join(TABLES[table])} FROM {table} {block}"))  # noqa: S608 - keys of TABLES

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Return a context: everything inserted in it is written at once, or not at all; raises `RecordingError`."""
        try:
            self._execute("BEGIN")
            yield
            self._execute("COMMIT")
        except BaseException:
            with suppress(duckdb.Error, RecordingError):
                self._execute("ROLLBACK")
            raise

    def _create(self) -> None:
        """Create the tables and columns that the file does not have: all in a new one, later ones in an older one."""
        for table, columns in TABLES.items():
            spec = ", ".join(f"{name} {kind}" for name, kind in columns.items())
            self._execute(f"CREATE TABLE IF NOT EXISTS {table} ({spec})")
            for name in ADDED_LATER.get(table, ()):
                self._execute(f"ALTER TABLE {table} ADD COLUMN IF NOT EXISTS {name} {columns[name]}")

    def _check_tables(self) -> None:
        """Raise `RecordingError` where the file lacks a table or column that every recording has.

        Later ones are read as empty ones in memory.
        """
        present: dict[str, set[str]] = {table: set() for table in TABLES}
        for table, column, _kind in self._fetch(COLUMNS_OF_FILE):
            present.setdefault(table, set()).add(column)
        if not present["meta"]:
            raise RecordingError(f"{self.path}: a DuckDB file, but not a {SUFFIX} recording (no table meta)")
        for table, columns in TABLES.items():
            missing = frozenset(columns.keys() - present[table])
            if missing and missing != ADDED_LATER.get(table, frozenset()):
                raise RecordingError(f"{self.path}: table {table} lacks {', '.join(sorted(missing))}")
            if missing and not self._writes:
                values = ", ".join(f"NULL::{columns[n]} AS {n}" if n in missing else n for n in columns)
                rows = f"FROM {table}" if present[table] else "LIMIT 0"
                self._execute(f"CREATE TEMP TABLE {table} AS SELECT {values} {rows}")


def _value(name: str, kind: str, column: NDArray[Any], arrays: dict[str, NDArray[Any]], bound: list[Any]) -> str:
    """Return the SQL of a column's values; adds to `arrays` the arrays to scan, and to `bound` the bound values."""
    arrays[name], value = np.ascontiguousarray(np.ma.getdata(column)), f'"{name}"'
    if arrays[name].dtype.kind == "U":
        # DuckDB would sort an array of words, which takes longer than the rest of an insertion.
        words, which = np.unique(arrays[name], return_inverse=True)
        bound.append(words.tolist())
        arrays[name], value = which + 1, f'CAST(? AS VARCHAR[])["{name}"]'
    if kind == "BLOB":
        # Not every version takes bytes from an array; all take digits.
        arrays[name] = np.array([data.hex() for data in arrays[name].tolist()], dtype=object)
        value = f'unhex("{name}")'
    if np.ma.is_masked(column):
        arrays[f"no_{name}"] = np.ma.getmaskarray(column)
        value = f'CASE WHEN "no_{name}" THEN NULL ELSE {value} END'
    return value
