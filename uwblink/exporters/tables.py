"""Every table of a recording as a file of its own: CSV and Parquet, which `uwblink import exported` takes back.

CSV cannot tell a list or bytes from text, so impulse responses are written as `[1, 2]` and bytes as hexadecimal digits.
A missing value is an empty cell; text is quoted, so that an empty one is not missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from uwblink.errors import RecordingError, first_line
from uwblink.recording.file import Recording
from uwblink.recording.schema import TABLES

MEMORY: Final = "400MB"
"""What DuckDB may keep of the file that it reads; what it writes comes on top of that."""

THREADS: Final = (None, 1)
"""Threads to write with, as many as DuckDB likes first: what one of them is behind with, the others keep in memory, so
that it may not suffice; one alone needs hardly any.
"""

CSV_CELLS: Final = {"BLOB": "hex({0})", "USMALLINT[]": "CAST({0} AS VARCHAR)"}


def write_csv(recording: Path, folder: Path) -> dict[str, int]:
    """Write a CSV file a table, with a header; returns the rows by file. Raises `RecordingError`."""
    return _write(recording, folder, "csv", "FORMAT csv, HEADER true, NULLSTR '', FORCE_QUOTE ({words})", CSV_CELLS)


def write_parquet(recording: Path, folder: Path) -> dict[str, int]:
    """Write a Parquet file a table; returns the rows by file. Raises `RecordingError`."""
    return _write(recording, folder, "parquet", "FORMAT parquet, COMPRESSION zstd", {})


def _write(recording: Path, folder: Path, suffix: str, options: str, cells: Mapping[str, str]) -> dict[str, int]:
    import duckdb

    with Recording.open(recording) as opened:
        # What every reader checks is checked here too, before the file is read past it.
        counts = {table: opened.count(table) for table in TABLES}
    paths = {table: folder / f"{table}.{suffix}" for table in TABLES}
    wanted = {table: paths[table] for table in TABLES if counts[table] or table == "exchanges"}
    for threads in THREADS:
        try:
            _copy(recording, wanted, options, cells, threads)
            break
        except duckdb.Error as error:
            if threads is None and isinstance(error, duckdb.OutOfMemoryException):
                continue
            raise RecordingError(f"{recording}: cannot be exported ({first_line(error)})") from error
    return {path.name: counts[table] for table, path in paths.items() if path.exists()}


def _copy(
    recording: Path, wanted: Mapping[str, Path], options: str, cells: Mapping[str, str], threads: int | None
) -> None:
    """Write tables to their paths by so many threads; raises what DuckDB raises."""
    import duckdb

    with duckdb.connect(":memory:") as db:
        # What a link leads to has its log beside it, not beside the link.
        place = recording.resolve()
        allowed = [str(place), f"{place}.wal", *map(str, wanted.values())]
        db.execute("SET allowed_paths = ?", [allowed])
        db.execute("SET enable_progress_bar = false")
        db.execute("SET preserve_insertion_order = true")
        db.execute(f"SET memory_limit = '{MEMORY}'")
        if threads is not None:
            db.execute(f"SET threads = {threads}")
        db.execute("SET enable_external_access = false")
        db.execute("SET lock_configuration = true")
        db.execute(f"ATTACH {_literal(place)} AS source (READ_ONLY)")
        for table, path in wanted.items():
            db.execute(f"COPY ({_query(db, table, cells)}) TO {_literal(path)} ({_options(options, table)})")


def _query(db: object, table: str, cells: Mapping[str, str]) -> str:
    found = db.execute(  # type: ignore[attr-defined]
        "SELECT column_name FROM duckdb_columns() WHERE database_name = 'source' AND table_name = ?", [table]
    ).fetchall()
    present = {str(name) for (name,) in found}
    columns = [
        f'{cells.get(kind, "{0}").format(f"{name!s}")} AS "{name}"' if name in present else f'NULL::{kind} AS "{name}"'
        for name, kind in TABLES[table].items()
    ]
    # In their order without a word, which DuckDB keeps; asked to sort them it would hold all of them.
    return f"SELECT {', '.join(columns)} FROM source.main.{table}"  # noqa: S608 - keys of TABLES


def _options(options: str, table: str) -> str:
    words = [f'"{name}"' for name, kind in TABLES[table].items() if kind in ("VARCHAR", "BLOB", "USMALLINT[]")]
    return options.replace("FORCE_QUOTE ({words})", f"FORCE_QUOTE ({', '.join(words)})" if words else "QUOTE '\"'")


def _literal(path: Path) -> str:
    """Return a path as a literal of SQL; statements that name files take no bound values."""
    return "'" + str(path).replace("'", "''") + "'"
