"""Every table of a recording as a file of its own: CSV and Parquet, which `uwblink import exported` takes back.

CSV cannot tell a list or bytes from text, so impulse responses are written as `[1, 2]` and bytes as hexadecimal digits.
A missing value is an empty cell; text is quoted, so that an empty one is not missing.

`truth_m` of the exchanges is what was measured beside them, or else the distance by the poses; `truth_from` says which.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.database import check_log, connect, log_of
from uwblink.errors import RecordingError, first_line
from uwblink.recording.contents import distances_by_poses_m
from uwblink.recording.file import Recording
from uwblink.recording.schema import BY_POSES, TABLES, TRUTH_FROM

if TYPE_CHECKING:
    import duckdb

MEMORY_MB: Final = 400
"""What DuckDB may keep of the file that it reads; what it writes comes on top of that."""

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
        by_poses = [np.empty(0), *distances_by_poses_m(opened, opened.exchange_blocks())] if counts["poses"] else []
    paths = {table: folder / f"{table}.{suffix}" for table in TABLES}
    wanted = {table: paths[table] for table in TABLES if counts[table] or table == "exchanges"}
    try:
        _copy(recording, folder, wanted, options, cells, by_poses)
    except duckdb.Error as error:
        raise RecordingError(f"{recording}: cannot be exported ({first_line(error)})") from error
    return {path.name: counts[table] for table, path in paths.items() if path.exists()}


def _copy(
    recording: Path,
    folder: Path,
    wanted: Mapping[str, Path],
    options: str,
    cells: Mapping[str, str],
    by_poses: list[Floats],
) -> None:
    """Write tables to their paths; raises what DuckDB raises. `by_poses` are true distances, if there are poses."""
    # What a link leads to has its log beside it, not beside the link.
    place = recording.resolve()
    check_log(place)
    # What one of several threads is behind with, the others keep in memory; one takes no more processor time, and
    # for 4 million exchanges as CSV 0.29 GB in place of 0.41 GB (2026-11-22).
    with connect(paths=[place, log_of(place)], folders=[folder], memory_mb=MEMORY_MB, threads=1) as db:
        db.execute(f"ATTACH {_literal(place)} AS source (READ_ONLY)")
        if by_poses:
            db.register("truths", {"by_poses": np.concatenate(by_poses)})
        for table, path in wanted.items():
            query = _query(db, table, cells, truths=bool(by_poses))
            db.execute(f"COPY ({query}) TO {_literal(path)} ({_options(options, table)})")


def _query(db: duckdb.DuckDBPyConnection, table: str, cells: Mapping[str, str], *, truths: bool) -> str:
    found = db.execute(
        "SELECT column_name FROM duckdb_columns() WHERE database_name = 'source' AND table_name = ?", [table]
    ).fetchall()
    present = {str(name) for (name,) in found}
    columns = {
        name: cells.get(kind, "{0}").format(f'"{name}"') if name in present else f"NULL::{kind}"
        for name, kind in TABLES[table].items()
    }
    source = f"source.main.{table}"
    if table == "exchanges":
        measured, by_poses = f"nullif({columns['truth_m']}, 'nan')", "NULL::DOUBLE"
        if truths:
            source, by_poses = f"{source} POSITIONAL JOIN truths", "nullif(by_poses, 'nan')"
        columns["truth_m"] = f"coalesce({measured}, {by_poses})"
        origin = f"WHEN {measured} IS NOT NULL THEN 'measured' WHEN {by_poses} IS NOT NULL THEN '{BY_POSES}'"
        columns[TRUTH_FROM] = f"CASE {origin} END"
    listed = ", ".join(f'{cell} AS "{name}"' for name, cell in columns.items())
    # In their order without a word, which DuckDB keeps; asked to sort them it would hold all of them.
    return f"SELECT {listed} FROM {source}"  # noqa: S608 - keys of TABLES


def _options(options: str, table: str) -> str:
    words = [f'"{name}"' for name, kind in TABLES[table].items() if kind in ("VARCHAR", "BLOB", "USMALLINT[]")]
    return options.replace("FORCE_QUOTE ({words})", f"FORCE_QUOTE ({', '.join(words)})" if words else "QUOTE '\"'")


def _literal(path: Path) -> str:
    """Return a path as a literal of SQL; statements that name files take no bound values."""
    return "'" + str(path).replace("'", "''") + "'"
