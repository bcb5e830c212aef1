"""A DuckDB file of tables: queries, rows and columns, with errors that name the file.

Files may come from untrusted sources. They are opened read-only, without access to other files and with locked
settings, and lock, length and catalogue are checked before data are read. A DuckDB file can contain views, macros,
types and defaults. These are programs that run when the file is read, and a macro can replace a function of the
database. So the catalogue is checked first, by names that a file cannot redefine (`system.main.`), and a file with any
of these objects is refused.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from threading import Timer
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Columns
from uwblink.database import connect, duckdb, log_of
from uwblink.display import printable
from uwblink.errors import RecordingError, RecordingInUseError, first_line, raising
from uwblink.output import check_utf8
from uwblink.recording.schema import ADDED_LATER, SUFFIX, TABLES

_UNFIT: Final = (duckdb.DataError, duckdb.InvalidInputException, duckdb.BinderException)
"""Errors of DuckDB for values that do not fit into a table; its other errors concern the file."""

Ask = Callable[[str], list[tuple[Any, ...]]]
"""A function that executes a query and returns its rows."""

MOST_META_BYTES: Final = 64_000_000
"""Largest number of bytes in `meta`: a thousand times that of a simulated flight with its scenario."""

ROWS_OF_ANY_FILE: Final = 20_000_000
"""Number of rows that are accepted in any file. More rows must have at least two bytes each in the file, because stamps
and powers contain noise, which does not compress; other files could be made to exhaust memory."""

_REFUSED: Final = (
    # Macros first: in older versions of DuckDB, a macro of the file could replace functions in the next queries.
    ("a macro", "function_name", "duckdb_functions() WHERE NOT internal"),
    ("a schema", "schema_name", "duckdb_schemas() WHERE NOT internal"),
    ("a view", "view_name", "duckdb_views() WHERE NOT internal"),
    ("a type", "type_name", "duckdb_types() WHERE NOT internal"),
    ("a sequence", "sequence_name", "duckdb_sequences()"),
    (
        "a computed column or a default",
        "table_name || '.' || column_name",
        "duckdb_columns() WHERE NOT internal AND column_default IS NOT NULL",
    ),
    # Triggers exist from DuckDB 2.0 on.
    *([("a trigger", "trigger_name", "duckdb_triggers()")] if not duckdb.__version__.startswith("1.") else []),
    ("a constraint", "constraint_text", "duckdb_constraints()"),
    ("an index", "index_name", "duckdb_indexes()"),
)
"""Objects that recordings do not have: kind, and the column and the table function of DuckDB that name them."""

COLUMNS_OF_FILE: Final = (
    "SELECT table_name, column_name, data_type FROM system.main.duckdb_columns() "
    "WHERE NOT internal AND schema_name = 'main'"
)
"""The query for the columns of a file, by names that the file cannot redefine."""

_ROWS: Final = "SELECT table_name, estimated_size FROM system.main.duckdb_tables() WHERE NOT internal"
"""The query for the numbers of rows of the tables of a file."""

IMPORTED_AS: Final = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".gz", ".parquet", ".jsonl", ".ndjson"), "csv"),
    **dict.fromkeys((".bag", ".mcap", ".db3"), "bag"),
}
"""Importers by the suffix of files in other formats."""


def check_tables(ask: Ask, path: Path, size: int, tables: Mapping[str, Mapping[str, str]]) -> None:
    """Raise `RecordingError` if a file of `size` bytes contains programs, columns of other types, or too many rows."""
    for word, column, source in _REFUSED:
        if found := ask(f"SELECT {column} FROM system.main.{source}"):  # noqa: S608 - constants
            raise RecordingError(
                f"{path}: contains {word}, {printable(str(found[0][0]))}; it is not read, because a recording has "
                f"only tables, and such objects are programs"
            )
    for table, column, kind_found in ask(COLUMNS_OF_FILE):
        expected = tables.get(table, {}).get(column)
        if expected not in (None, kind_found):
            raise RecordingError(
                f"{path}: table {table}: column {column} is {printable(str(kind_found))}, expected {expected}"
            )
    most = ROWS_OF_ANY_FILE + size // 2
    for table, count in ask(_ROWS):
        if table in tables and count > most:
            raise RecordingError(
                f"{path}: table {table} holds {count} rows, and a file of {size} bytes at most {most}; it is not read"
            )


def check_intake(ask: Ask, path: Path, size: int) -> None:
    """Raise the errors of `check_tables` for the tables of recordings, and `RecordingError` for a too large `meta`."""
    check_tables(ask, path, size, TABLES)
    if ask(f"{_ROWS} AND table_name = 'meta'"):
        ((length,),) = ask("SELECT coalesce(sum(strlen(key) + strlen(value)), 0)::HUGEINT FROM meta")
        if length > MOST_META_BYTES:
            raise RecordingError(f"{path}: table meta holds {length} bytes, at most {MOST_META_BYTES} are read")


@contextmanager
def interrupted_after(seconds: float, interrupt: Callable[[], None]) -> Iterator[None]:
    """Call `interrupt` if the block takes more than some seconds; DuckDB then raises `InterruptException`."""
    watch = Timer(seconds, interrupt)
    watch.daemon = True
    watch.start()
    try:
        yield
    finally:
        watch.cancel()


def decode_json(text: object, path: Path, key: str) -> Any:
    """Return the value of an entry of `meta`.

    Raises `RecordingError` if the text is not JSON, not finite (NaN, 1e400), or nested too deeply.
    """
    if not isinstance(text, str):
        raise RecordingError(f"{path}: table meta: {printable(key)} has no value")
    wrong = f"{path}: table meta holds a value that is not JSON, that of {printable(key)}"
    with raising(RecordingError, wrong, ValueError, RecursionError):
        value = json.loads(text)
        json.dumps(value, allow_nan=False)  # Python reads NaN and 1e400, which are not JSON
    return value


def is_locked(path: Path, *, update: bool) -> bool:
    """Return whether another process has locked a file: for writing, or with `update` also for reading."""
    if not path.is_file():  # opening a FIFO would wait
        return False
    try:
        import fcntl

        with path.open("r+b" if update else "rb") as file:
            fcntl.lockf(file, (fcntl.LOCK_EX if update else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return True
    except (OSError, ImportError):  # systems without fcntl (not POSIX) report the lock when the file is opened
        return False
    return False


def damaged(path: Path, error: Exception) -> RecordingError:
    """Return the error to raise for a file that DuckDB cannot open."""
    if "version number" not in str(error):
        return _no_recording(path, first_line(error))
    with path.open("rb") as file:  # the first header has the version of its writer in bytes 52 to 83
        writer = printable(file.read(84)[52:].split(b"\0")[0].decode(errors="replace"))
    return RecordingError(
        f"{path}: {f'DuckDB {writer}' if writer else 'another DuckDB'} stored it in a way that the installed DuckDB "
        f"{duckdb.__version__} cannot read; update DuckDB, or export the recording on the computer of the recording"
    )


def _no_recording(path: Path, seen: str) -> RecordingError:
    form = IMPORTED_AS.get(path.suffix.lower())
    if form:
        return RecordingError(f"{path}: is not a recording; convert it with `uwblink import {form}`")
    return RecordingError(f"{path}: not a {SUFFIX} recording, or a truncated one ({seen})")


def check_length(path: Path) -> None:
    """Raise `RecordingError` for a truncated file, which DuckDB may still open.

    A file has three headers of 4096 bytes and whole blocks of 16,384 bytes or a multiple of it. If there is a log, any
    length is accepted: a disk that was full during the merge of the log leaves a partial block at the end of the file,
    which is not used, and all data are in the log.
    """
    log = log_of(path)
    if not (log.exists() and log.stat().st_size) and path.stat().st_size % 16_384 != 3 * 4096:
        raise _no_recording(path, "its size is not that of whole blocks")


class Store:
    """An open file with the tables of `TABLES`, the base of `Recording`; `path` is its name in messages."""

    def __init__(
        self,
        connection: duckdb.DuckDBPyConnection,
        path: Path,
        *,
        writes: bool,
        size: int = 0,
        partial: Path | None = None,
    ) -> None:
        """Take an open connection to a file of `size` bytes, which limits the time of a query.

        `writes` states whether the file is open for writing. `partial` is the file that is renamed to `path` when it is
        complete.
        """
        self._db, self.path, self._writes, self._partial = connection, path, writes, partial
        # A minute, and 1 s for each 500 kB, a hundredth of the speed of a slow disk.
        self._longest_read_s = 60.0 + size / 500_000.0
        self._place = ExitStack()
        """Removes the folder of `partial` at the end."""

    @classmethod
    def _open_to_write(cls, path: Path, partial: Path | None, memory_mb: int | None = None) -> Self:
        """Open or create the file `partial`, by default `path`, for a recording called `path`; raises `RecordingError`.

        A reader that checks a new file locks it for a moment, so the writer waits up to two seconds for the lock.
        """
        check_utf8(path, RecordingError)
        place = partial or path
        end_s = time.monotonic() + 2.0
        while True:
            try:
                # DuckDB may write only in the folder of the recording.
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
        """Open a file for reading, or to `update` it; raises `RecordingError` if it is not a recording, or is in use.

        Queries and read data use at most `memory_mb` of memory, by default most of the computer's. If the file is
        already open in this program, its first limit remains.
        """
        check_utf8(path, RecordingError)
        check_length(path)
        size = path.stat().st_size
        try:
            try:
                connection = connect(path, read_only=not update, memory_mb=memory_mb)
            except duckdb.ConnectionException:
                connection = connect(path, read_only=not update)
        except duckdb.ConnectionException as error:
            raise RecordingError(f"{path}: is already open in this program in another mode; close it first") from error
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
        """Merge the log into the file, also while other threads write; raises `RecordingError`.

        Closing a connection also merges the log, but does not report failures.
        """
        with self._writing(), self._db.cursor() as db:
            db.execute("CHECKPOINT")

    def _execute(self, statement: str, values: list[Any] | None = None) -> None:
        """Execute an SQL statement; raises `RecordingError` if the file cannot be written."""
        with self._writing():
            self._db.execute(statement, values)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Raise `RecordingError` for errors of DuckDB that concern the file."""
        try:
            yield
        except _UNFIT:
            raise  # `_insert` adds the name of the table
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
        """Add rows from columns by the names of the table's columns; masked values are missing in the table.

        Raises `RecordingError` for columns of different lengths, and for values that do not fit into the table.
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

    def _select(self, query: str) -> Columns:
        """Return the result of a query as columns, in which missing values are masked; raises `RecordingError`."""
        with self._reading():
            return dict(self._db.execute(query).fetchnumpy())

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
        """Yield WHERE clauses for blocks of rows of a table, in their order."""
        ((last,),) = self._fetch(f"SELECT coalesce(max(rowid), -1) FROM {table}")  # noqa: S608 - a key of TABLES
        for start in range(0, last + 1, rows):
            yield f"WHERE rowid >= {start} AND rowid < {start + rows}"

    def _take(self, source: Store, table: str) -> None:
        """Add all rows of a table of another file in their order, in blocks, with missing values."""
        # 100,000 impulse responses, the largest rows, need 0.2 GB.
        for block in source._blocks(table, 100_000):
            self._insert(table, source._select(f"SELECT {', '.join(TABLES[table])} FROM {table} {block}"))  # noqa: S608 - keys of TABLES

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Return a context manager in which all insertions are one transaction; raises `RecordingError`."""
        try:
            self._execute("BEGIN")
            yield
            self._execute("COMMIT")
        except BaseException:
            with suppress(duckdb.Error, RecordingError):
                self._execute("ROLLBACK")
            raise

    def _create(self) -> None:
        """Create the tables that the file lacks."""
        with self.transaction():
            for table, columns in TABLES.items():
                spec = ", ".join(f"{name} {kind}" for name, kind in columns.items())
                self._execute(f"CREATE TABLE IF NOT EXISTS {table} ({spec})")

    def _check_tables(self) -> None:
        """Raise `RecordingError` if the file lacks a table or column that is not in `ADDED_LATER`.

        Those in `ADDED_LATER` are created: empty in a temporary table, or in the file if it is open for writing.
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
            for name in missing if self._writes and present[table] else ():
                self._execute(f"ALTER TABLE {table} ADD COLUMN {name} {columns[name]}")


def _value(name: str, kind: str, column: NDArray[Any], arrays: dict[str, NDArray[Any]], bound: list[Any]) -> str:
    """Return the SQL expression of a column; adds arrays to scan to `arrays`, and bound values to `bound`."""
    arrays[name], value = np.ascontiguousarray(np.ma.getdata(column)), f'"{name}"'
    if arrays[name].dtype.kind == "U":
        # Insert words as indices of a bound list: DuckDB would sort an array of words, which takes most of the time.
        words, which = np.unique(arrays[name], return_inverse=True)
        bound.append(words.tolist())
        arrays[name], value = which + 1, f'CAST(? AS VARCHAR[])["{name}"]'
    if kind == "BLOB":
        # Some versions of DuckDB cannot read bytes from an array; all can read hexadecimal digits.
        arrays[name] = np.array([data.hex() for data in arrays[name].tolist()], dtype=object)
        value = f'unhex("{name}")'
    if np.ma.is_masked(column):
        arrays[f"no_{name}"] = np.ma.getmaskarray(column)
        value = f'CASE WHEN "no_{name}" THEN NULL ELSE {value} END'
    return value
