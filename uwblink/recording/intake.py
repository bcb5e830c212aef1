"""What a file may hold before anything in it is read: base tables with the names and types of recordings, no more.

A DuckDB file can carry views, macros, types and defaults, which are programs: they run when somebody reads what they
stand for, and a macro can even stand for a function of the database itself. So this looks at the catalogue first, by
names that nothing in a file can take (`system.main.`), and refuses the file if it finds any.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Timer
from typing import Any, Final, NamedTuple, NoReturn

from uwblink.display import printable
from uwblink.errors import RecordingError
from uwblink.recording.schema import TABLES

Ask = Callable[[str], list[tuple[Any, ...]]]
"""Executes a query and returns its rows."""

MOST_META_BYTES: Final = 64_000_000
"""Bytes of text in `meta`: a thousand times what a simulated flight with its scenario has."""

ROWS_OF_ANY_FILE: Final = 20_000_000
BYTES_A_ROW: Final = 2
"""Rows beyond `ROWS_OF_ANY_FILE` take at least this in a file: stamps and powers are noise, which does not compress.

What is longer than that was made to fill a memory.
"""

LONGEST_READ_S: Final = 60.0
READ_BYTES_PER_S: Final = 500_000.0
"""A read may take `LONGEST_READ_S` and a second for this many bytes of the file: a hundredth of a slow disk's speed."""


class _Kind(NamedTuple):
    """Something that recordings do not have, and the query that finds its name, where DuckDB has this function."""

    word: str
    query: str
    function: str = "duckdb_functions"


_REFUSED: Final = (
    # First, because older versions of DuckDB would take a macro of the file for what the others ask.
    _Kind("a macro", "SELECT function_name FROM system.main.duckdb_functions() WHERE NOT internal"),
    _Kind("a schema", "SELECT schema_name FROM system.main.duckdb_schemas() WHERE NOT internal"),
    _Kind("a view", "SELECT view_name FROM system.main.duckdb_views() WHERE NOT internal"),
    _Kind("a type", "SELECT type_name FROM system.main.duckdb_types() WHERE NOT internal"),
    _Kind("a sequence", "SELECT sequence_name FROM system.main.duckdb_sequences()"),
    _Kind(
        "a computed column or a default",
        "SELECT table_name || '.' || column_name FROM system.main.duckdb_columns() "
        "WHERE NOT internal AND column_default IS NOT NULL",
    ),
    # What runs when somebody writes to a table; triggers came with DuckDB 2.0.
    _Kind("a trigger", "SELECT trigger_name FROM system.main.duckdb_triggers()", "duckdb_triggers"),
    _Kind("a constraint", "SELECT constraint_text FROM system.main.duckdb_constraints()"),
    _Kind("an index", "SELECT index_name FROM system.main.duckdb_indexes()"),
)

_FUNCTIONS: Final = "SELECT DISTINCT function_name FROM system.main.duckdb_functions() WHERE internal"

COLUMNS: Final = (
    "SELECT table_name, column_name, data_type FROM system.main.duckdb_columns() "
    "WHERE NOT internal AND schema_name = 'main'"
)
_ROWS: Final = "SELECT table_name, estimated_size FROM system.main.duckdb_tables() WHERE NOT internal"
_META: Final = "SELECT coalesce(sum(strlen(key) + strlen(value)), 0)::HUGEINT FROM meta"


def check_tables(ask: Ask, path: Path, size: int, tables: Mapping[str, Mapping[str, str]]) -> None:
    """Raise `RecordingError` for a file of `size` bytes that holds programs, or other columns than `tables` have."""
    known = {name for (name,) in ask(_FUNCTIONS)}
    for kind in _REFUSED:
        found = ask(kind.query) if kind.function in known else []
        if found:
            raise RecordingError(
                f"{path}: holds {kind.word}, {printable(str(found[0][0]))}, and such files consist of tables alone; "
                "it is not read, because such things are programs"
            )
    for table, column, kind_found in ask(COLUMNS):
        expected = tables.get(table, {}).get(column)
        if expected not in (None, kind_found):
            raise RecordingError(
                f"{path}: table {table}: column {column} is {printable(str(kind_found))}, expected {expected}"
            )
    most = ROWS_OF_ANY_FILE + size // BYTES_A_ROW
    for table, count in ask(_ROWS):
        if table in tables and count > most:
            raise RecordingError(
                f"{path}: table {table} holds {count} rows, and a file of {size} bytes at most {most}; it is not read"
            )


def check_intake(ask: Ask, path: Path, size: int) -> None:
    """Raise `RecordingError` for a file of `size` bytes with anything in it that is not data of a recording."""
    check_tables(ask, path, size, TABLES)
    if "meta" in TABLES and ask(f"{_ROWS} AND table_name = 'meta'"):
        ((length,),) = ask(_META)
        if length > MOST_META_BYTES:
            raise RecordingError(f"{path}: table meta holds {length} bytes, at most {MOST_META_BYTES} are read")


def longest_read_s(size: int) -> float:
    """Return the seconds that a read from a file of `size` bytes may take."""
    return LONGEST_READ_S + size / READ_BYTES_PER_S


@contextmanager
def interrupted_after(seconds: float, interrupt: Callable[[], None]) -> Iterator[Event]:
    """Call `interrupt` if the block takes longer than that; the event says whether it was."""
    late = Event()

    def stop() -> None:
        late.set()
        interrupt()

    watch = Timer(seconds, stop)
    watch.daemon = True
    watch.start()
    try:
        yield late
    finally:
        watch.cancel()


def decode_json(text: object, path: Path, key: str) -> Any:
    """Return a value of `meta`.

    Raises `RecordingError` for what is no JSON, not finite (NaN, 1e400), or nested beyond all reason.
    """
    if not isinstance(text, str):
        raise RecordingError(f"{path}: table meta: {printable(key)} has no value")
    try:
        return json.loads(text, parse_constant=_refuse, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: table meta holds a value that is not JSON, that of {printable(key)}") from error


def _refuse(word: str) -> NoReturn:
    raise ValueError(word)


def _finite(word: str) -> float:
    number = float(word)
    return number if math.isfinite(number) else _refuse(word)
