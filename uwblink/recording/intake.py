"""Checks of a file before anything in it is read: its lock, its length, and that it holds tables and nothing else.

A DuckDB file can have views, macros, types and defaults, which are programs: they run when they are read, and a macro
can even replace a function of the database. So the catalogue is checked first, by names that a file cannot redefine
(`system.main.`), and a file with any of them is refused.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import Timer
from typing import Any, Final

from uwblink.database import duckdb, log_of
from uwblink.display import printable
from uwblink.errors import RecordingError, first_line, raising
from uwblink.output import is_utf8
from uwblink.recording.schema import SUFFIX, TABLES

Ask = Callable[[str], list[tuple[Any, ...]]]
"""Executes a query and returns its rows."""

MOST_META_BYTES: Final = 64_000_000
"""Bytes of text in `meta`: a thousand times what a simulated flight with its scenario has."""

ROWS_OF_ANY_FILE: Final = 20_000_000
"""Rows that any file may hold. Further rows take at least two bytes each in a file: stamps and powers are noise, which
does not compress. A file with more rows was made to exhaust memory."""

_REFUSED: Final = (
    # Macros first, because older versions of DuckDB would take a macro of the file for what the others ask.
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
    # What runs when somebody writes to a table; triggers came with DuckDB 2.0.
    ("a trigger", "trigger_name", "duckdb_triggers()"),
    ("a constraint", "constraint_text", "duckdb_constraints()"),
    ("an index", "index_name", "duckdb_indexes()"),
)
"""Objects that recordings do not have: a word, and the column and the function of DuckDB with their names."""

COLUMNS_OF_FILE: Final = (
    "SELECT table_name, column_name, data_type FROM system.main.duckdb_columns() "
    "WHERE NOT internal AND schema_name = 'main'"
)
"""The query for a file's columns, by names that the file cannot redefine."""

_ROWS: Final = "SELECT table_name, estimated_size FROM system.main.duckdb_tables() WHERE NOT internal"
"""The query for the number of rows of its tables."""

IMPORTED_AS: Final = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".gz", ".parquet", ".jsonl", ".ndjson"), "csv"),
    **dict.fromkeys((".bag", ".mcap", ".db3"), "bag"),
}
"""Endings of files in other formats, and the importer that reads them."""


def check_tables(ask: Ask, path: Path, size: int, tables: Mapping[str, Mapping[str, str]]) -> None:
    """Raise `RecordingError` for a file of `size` bytes that holds programs, or other columns than `tables` have."""
    known = {name for (name,) in ask("SELECT function_name FROM system.main.duckdb_functions() WHERE internal")}
    for word, column, source in _REFUSED:
        found = ask(f"SELECT {column} FROM system.main.{source}") if source.partition("(")[0] in known else []  # noqa: S608 - constants
        if found:
            raise RecordingError(
                f"{path}: holds {word}, {printable(str(found[0][0]))}, and such files consist of tables alone; "
                "it is not read, because such objects are programs"
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
    """Raise `RecordingError` for a file of `size` bytes with anything in it that is not data of a recording."""
    check_tables(ask, path, size, TABLES)
    if ask(f"{_ROWS} AND table_name = 'meta'"):
        ((length,),) = ask("SELECT coalesce(sum(strlen(key) + strlen(value)), 0)::HUGEINT FROM meta")
        if length > MOST_META_BYTES:
            raise RecordingError(f"{path}: table meta holds {length} bytes, at most {MOST_META_BYTES} are read")


def longest_read_s(size: int) -> float:
    """Return the seconds that a read from a file of `size` bytes may take: a minute, and 1 s for each 500 kB.

    That is a hundredth of the speed of a slow disk.
    """
    return 60.0 + size / 500_000.0


@contextmanager
def interrupted_after(seconds: float, interrupt: Callable[[], None]) -> Iterator[None]:
    """Call `interrupt` if the block takes longer than that; DuckDB then raises `InterruptException`."""
    watch = Timer(seconds, interrupt)
    watch.daemon = True
    watch.start()
    try:
        yield
    finally:
        watch.cancel()


def decode_json(text: object, path: Path, key: str) -> Any:
    """Return a value of `meta`.

    Raises `RecordingError` for what is no JSON, not finite (NaN, 1e400), or nested too deeply.
    """
    if not isinstance(text, str):
        raise RecordingError(f"{path}: table meta: {printable(key)} has no value")
    wrong = f"{path}: table meta holds a value that is not JSON, that of {printable(key)}"
    with raising(RecordingError, wrong, ValueError, RecursionError):
        value = json.loads(text)
        json.dumps(value, allow_nan=False)  # Python reads NaN and 1e400, which are not JSON
    return value


def is_locked(path: Path, *, update: bool) -> bool:
    """Whether another process holds the lock that DuckDB takes on a file it writes, or reads."""
    if not path.is_file():  # opening a FIFO would wait
        return False
    try:
        import fcntl

        with path.open("r+b" if update else "rb") as file:
            fcntl.lockf(file, (fcntl.LOCK_EX if update else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return True
    except (OSError, ImportError):  # without fcntl, on no POSIX system, opening the file reports the lock
        return False
    return False


def damaged(path: Path, error: Exception) -> RecordingError:
    """Return what to raise for a file that DuckDB cannot open."""
    if "version number" not in str(error):
        return _no_recording(path, first_line(error))
    with path.open("rb") as file:  # the first header has the version of its writer in bytes 52 to 83
        writer = printable(file.read(84)[52:].split(b"\0")[0].decode(errors="replace"))
    return RecordingError(
        f"{path}: {f'DuckDB {writer}' if writer else 'another DuckDB'} stored it in a way that the installed DuckDB "
        f"{duckdb.__version__} cannot read; update DuckDB, or export the recording where it was made"
    )


def _no_recording(path: Path, seen: str) -> RecordingError:
    form = IMPORTED_AS.get(path.suffix.lower())
    if form:
        return RecordingError(f"{path}: is no recording yet; `uwblink import {form}` makes one of it")
    return RecordingError(f"{path}: not a {SUFFIX} recording, or a truncated one ({seen})")


def check_name(path: Path) -> None:
    """Raise `RecordingError` for a name that DuckDB cannot take."""
    if not is_utf8(path):
        raise RecordingError(f"{path}: its name and those of its folders must be UTF-8; give another one")


def check_length(path: Path) -> None:
    """Raise `RecordingError` for a file that was cut: DuckDB's are headers and whole blocks, and may still open.

    Three headers of 4096 bytes come first; the smallest block has 16384 bytes, and every larger one a multiple of it.
    Beside a log a file may have any length: a disk that was full while the log was put into it leaves half a block at
    its end, to which nothing refers, and everything is in the log.
    """
    log = log_of(path)
    if not (log.exists() and log.stat().st_size) and path.stat().st_size % 16_384 != 3 * 4096:
        raise _no_recording(path, "its length is odd")
