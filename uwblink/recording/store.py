"""Tables of a recording in a DuckDB file: columns in, columns out, and every error with the file's name.

Files from strangers are data: they are opened read-only, with every access to other files switched off and the settings
locked, and are looked over (`uwblink.recording.intake`) before anything in them is read.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.database import connect, log_of
from uwblink.errors import RecordingError, RecordingInUseError, first_line
from uwblink.recording.batches import batch_of
from uwblink.recording.intake import COLUMNS, check_intake, interrupted_after, longest_read_s
from uwblink.recording.schema import ADDED_LATER, SUFFIX, TABLES
from uwblink.recording.soundness import check_length, check_name, damaged, is_locked

if TYPE_CHECKING:
    import duckdb

LONGEST_LOOK_S: Final = 2.0
"""A reader that finds a new recording before its writer has opened it again looks it over in this time."""

ROWS_AT_A_TIME: Final = 100_000
"""Rows that a copy holds in memory at once; of impulse responses, which are the largest, 0.2 GB."""


class Store:
    """An open file with the tables of `TABLES`; `path` is what messages call it."""

    def __init__(
        self, connection: duckdb.DuckDBPyConnection, path: Path, size: int = 0, *, writes: bool, vanishes: bool = False
    ) -> None:
        """Wrap an open connection to a file of `size` bytes, which bounds how long reading may take.

        It may be one that `writes`; where that fails, the file of one that `vanishes` is removed by its owner.
        """
        self._db, self._second = connection, connection.cursor()
        self._second_lock = threading.Lock()
        self.path, self.writes, self.vanishes = path, writes, vanishes
        self._longest_read_s = longest_read_s(size)
        self._columns: dict[str, set[str]] | None = None

    @classmethod
    def create(cls, place: Path, path: Path, memory_mb: int | None = None) -> Self:
        """Make a file at `place` with empty tables, for a recording that is called `path`; raises `RecordingError`."""
        check_name(path)
        store = cls._writing(place, path, memory_mb)
        store.vanishes = True
        store._create_missing()
        return store

    @classmethod
    def grow(cls, path: Path, memory_mb: int | None = None) -> Self:
        """Open a file that was just made, for a recording that goes on for long; raises `RecordingError`."""
        end_s = time.monotonic() + LONGEST_LOOK_S
        while True:
            try:
                return cls._writing(path, path, memory_mb)
            except RecordingError:
                if time.monotonic() > end_s or not is_locked(path, update=True):
                    raise
                time.sleep(0.02)

    @classmethod
    def _writing(cls, place: Path, path: Path, memory_mb: int | None) -> Self:
        import duckdb

        try:
            # Snapshots are written beside the recording, and nothing ever elsewhere.
            return cls(connect(place, folders=[place.parent], memory_mb=memory_mb), path, writes=True)
        except duckdb.Error as error:
            raise RecordingError(f"{path}: cannot be written ({first_line(error)})") from error

    @classmethod
    def open(cls, path: Path, *, update: bool, memory_mb: int | None = None) -> Self:
        """Open a file for reading, or to `update` it; raises `RecordingError` for what is none, or is in use.

        Of what was read, and of what a query works on, no more than `memory_mb` is kept in memory, by default most of
        what there is; a file that is open in this program already keeps what it was opened with.
        """
        import duckdb

        check_name(path)
        check_length(path)
        size = path.stat().st_size
        try:
            try:
                connection = connect(path, read_only=not update, memory_mb=memory_mb)
            except duckdb.ConnectionException:
                if memory_mb is None:
                    raise
                connection = connect(path, read_only=not update)
            store = cls(connection, path, size, writes=update)
        except duckdb.ConnectionException as error:
            raise RecordingError(f"{path}: is open in this program in another way; close it there first") from error
        except duckdb.IOException as error:
            if is_locked(path, update=update):
                use = "has it open" if update else "is writing it"
                raise RecordingInUseError(f"{path}: another process {use}; wait until that ends") from error
            raise damaged(path, error) from error
        except duckdb.Error as error:
            raise damaged(path, error) from error
        try:
            check_intake(store.rows, path, size)
            store.check_columns()
            if update:
                store._create_missing()
        except RecordingError:
            store.close()
            raise
        return store

    def close(self) -> None:
        """Close the file."""
        self._second.close()
        self._db.close()

    def finish(self) -> None:
        """Put everything into the file itself, none of it left in the log beside it; raises `RecordingError`.

        Closing does so too, and says nothing where it cannot.
        """
        import duckdb

        try:
            self._db.execute("CHECKPOINT")
        except duckdb.Error as error:
            if self.vanishes:
                raise self._unwritable(error) from error
            raise RecordingError(
                f"{self.path}: cannot be completed ({first_line(error)}); everything is kept, "
                f"some of it in {log_of(self.path).name} beside it: keep the two together"
            ) from error

    def shorten_log(self) -> None:
        """Put what is in the log into the file, while others go on writing; raises `RecordingError`."""
        import duckdb

        try:
            with self._second_lock:
                self._second.execute("CHECKPOINT")
        except duckdb.Error as error:
            raise self._unwritable(error) from error

    def copy_to(self, place: Path) -> None:
        """Write what is committed to a new file, on a connection of its own; raises `RecordingError`."""
        import duckdb

        target = str(place).replace("'", "''")
        try:
            with self._second_lock:
                (source,) = self._second.execute("SELECT current_database()").fetchone() or ("",)
                named = source.replace('"', '""')
                self._second.execute(f"ATTACH '{target}' AS uwblink_snapshot")
                try:
                    self._second.execute(f'COPY FROM DATABASE "{named}" TO uwblink_snapshot')
                finally:
                    self._second.execute("DETACH uwblink_snapshot")
        except duckdb.Error as error:
            place.unlink(missing_ok=True)
            raise RecordingError(f"{place}: cannot be written ({first_line(error)})") from error

    def execute(self, statement: str, values: list[Any] | None = None) -> None:
        """Execute a statement of SQL; raises `RecordingError` where the file cannot be written."""
        import duckdb

        try:
            self._db.execute(statement, values)
        except (duckdb.DataError, duckdb.InvalidInputException, duckdb.BinderException):
            raise  # of values, and who inserts them knows of which table
        except duckdb.Error as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: duckdb.Error) -> RecordingError:
        import duckdb

        disk = isinstance(error, duckdb.IOException | duckdb.TransactionException | duckdb.FatalException)
        reason = f"{first_line(error)}){'; is the disk full?' if disk else '.'}"
        if self.vanishes:
            return RecordingError(f"{self.path}: cannot be written ({reason} Nothing was written")
        return RecordingError(f"{self.path}: cannot be written any more ({reason} What was written before is kept")

    def insert(self, table: str, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add rows from columns with the table's names; what is masked in them is missing in the table.

        Raises `RecordingError` for values that do not fit into the table.
        """
        names = [name for name in TABLES[table] if name in columns]
        lengths = {name: len(columns[name]) for name in names}
        if len(set(lengths.values())) > 1:
            raise RecordingError(f"{self.path}: table {table}: columns of different lengths, {lengths}")
        if not lengths or not lengths[names[0]]:
            return
        batch = batch_of(table, {name: columns[name] for name in names})
        listed = ", ".join(f'"{name}"' for name in names)
        self._db.register("batch", batch.columns)
        with self._fitting(table):
            self.execute(f"INSERT INTO {table} ({listed}) SELECT {batch.values} FROM batch", batch.bound)  # noqa: S608 - keys of TABLES
        self._db.unregister("batch")

    def insert_row(self, table: str, values: list[Any]) -> None:
        """Add one row, a value a column; raises `RecordingError` for values that do not fit into the table."""
        marks = ", ".join("?" * len(values))
        with self._fitting(table):
            self.execute(f"INSERT INTO {table} VALUES ({marks})", values)  # noqa: S608 - a key of TABLES

    @contextmanager
    def _fitting(self, table: str) -> Iterator[None]:
        import duckdb

        try:
            yield
        except (duckdb.DataError, duckdb.InvalidInputException, duckdb.BinderException) as error:
            raise RecordingError(
                f"{self.path}: table {table}: values that do not fit ({first_line(error)}); "
                f"its columns are {', '.join(f'{name} {kind}' for name, kind in TABLES[table].items())}"
            ) from error

    def read(self, query: str) -> dict[str, NDArray[Any]]:
        """Return what a query finds, as columns; masked where it is missing. Raises `RecordingError`."""
        with self._reading():
            return dict(self._db.execute(query).fetchnumpy())

    def rows(self, query: str) -> list[tuple[Any, ...]]:
        """Return what a query finds, as rows; raises `RecordingError`."""
        with self._reading():
            return self._db.execute(query).fetchall()

    @contextmanager
    def _reading(self) -> Iterator[None]:
        import duckdb

        with interrupted_after(self._longest_read_s, self._db.interrupt) as late:
            try:
                yield
            except duckdb.Error as error:
                why = f"took longer than {self._longest_read_s:.0f} s" if late.is_set() else first_line(error)
                raise RecordingError(f"{self.path}: cannot be read, truncated or damaged ({why})") from error

    def take(self, source: Store, table: str) -> None:
        """Add all rows of another file's table in their order, missing values included, some at a time."""
        present = source.columns().get(table, set())
        if not present:
            return
        names = ", ".join(f'"{name}"' for name in present & TABLES[table].keys())
        (last,) = source.read(f"SELECT max(rowid) AS last FROM {table}")["last"]  # noqa: S608 - a key of TABLES
        for start in range(0, 0 if last is np.ma.masked else int(last) + 1, ROWS_AT_A_TIME):
            piece = f"rowid >= {start} AND rowid < {start + ROWS_AT_A_TIME} ORDER BY rowid"
            self.insert(table, source.read(f"SELECT {names} FROM {table} WHERE {piece}"))  # noqa: S608 - keys of TABLES

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Have everything inserted in the block written at once, or not at all; raises `RecordingError`."""
        import duckdb

        try:
            self.execute("BEGIN")
            yield
            self.execute("COMMIT")
        except duckdb.Error as error:
            with suppress(RecordingError):
                self.execute("ROLLBACK")
            raise self._unwritable(error) from error
        except RecordingError:
            with suppress(RecordingError):
                self.execute("ROLLBACK")
            raise

    def columns(self) -> dict[str, set[str]]:
        """Return the names of the columns of each table that the file has."""
        if self._columns is None or self.writes:
            self._columns = self._listed_columns()
        return self._columns

    def _listed_columns(self) -> dict[str, set[str]]:
        found: dict[str, set[str]] = {}
        for table, column, _kind in self.rows(COLUMNS):
            found.setdefault(table, set()).add(column)
        return found

    def _create_missing(self) -> None:
        """Create the tables that the file does not have: all of a new one, and those that an old one is older than."""
        for table, columns in TABLES.items():
            spec = ", ".join(f'"{name}" {kind}' for name, kind in columns.items())
            self.execute(f"CREATE TABLE IF NOT EXISTS {table} ({spec})")

    def check_columns(self) -> None:
        """Raise `RecordingError` where the file lacks a table or a column of those that recordings always had."""
        found = self.columns()
        if "meta" not in found:
            raise RecordingError(f"{self.path}: a DuckDB file, but not a {SUFFIX} recording (no table meta)")
        for table, columns in TABLES.items():
            present, later = found.get(table, set()), ADDED_LATER.get(table, frozenset())
            came_whole = later == columns.keys()
            missing = sorted(columns.keys() - present - (later if not (present and came_whole) else set()))
            if missing:
                raise RecordingError(f"{self.path}: table {table} lacks {', '.join(missing)}")
