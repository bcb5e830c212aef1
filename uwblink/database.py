"""Connections to DuckDB, restricted because files can come from anyone.

A connection can open its own file and the named files only, cannot load extensions, and has locked settings. No other
module opens DuckDB, which a test checks.
"""

from __future__ import annotations

import csv
import stat
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from uwblink.errors import OutputError, RecordingError, raising
from uwblink.output import check_utf8, interrupts_held, whole

with interrupts_held():  # an interrupt within this import ends the process in C++
    import duckdb as duckdb

STORAGE_VERSION: Final = "v1.5.0"
"""Storage of new files: that of the lowest version in pyproject.toml, so that every allowed version reads them."""

_LOCKED: Final = {"enable_external_access": False, "lock_configuration": True}
"""The second locks all settings, so it comes last."""


def connect(
    path: Path | None = None,
    *,
    read_only: bool = False,
    paths: Iterable[Path] = (),
    folders: Iterable[Path] = (),
    memory_mb: int | None = None,
    threads: int | None = None,
    temporary: str | None = None,
) -> duckdb.DuckDBPyConnection:
    """Open a DuckDB file, or a database in memory, with access to `paths` and to files in `folders` only.

    It uses up to `memory_mb` of memory, by default most of the machine's, and the folder `temporary` for the rest.
    Raises DuckDB's errors, and what `check_log` raises.
    """
    if path is not None:
        check_log(path)
    limits = {
        "memory_limit": None if memory_mb is None else f"{memory_mb}MB",
        "threads": threads,
        "temp_directory": temporary,
    }
    config: dict[str, Any] = {name: value for name, value in limits.items() if value is not None} | {
        "autoinstall_known_extensions": False,
        "autoload_known_extensions": False,
        "allow_community_extensions": False,
        "allow_persistent_secrets": False,
        "storage_compatibility_version": STORAGE_VERSION,
    }
    place = ":memory:" if path is None else str(path)
    named, within = [str(each) for each in paths], [str(each.absolute()) for each in folders]
    if path is not None and not named and not within:
        # A file of somebody else: everything is locked before it is opened.
        return duckdb.connect(place, read_only=read_only, config=config | _LOCKED)
    db = duckdb.connect(place, read_only=read_only, config=config)
    db.execute("SET TimeZone = 'UTC'")
    db.execute("SET enable_progress_bar = false")
    # Types of a data frame's objects are found from up to ten million rows, because those of a sample may not fit all.
    db.execute("SET pandas_analyze_sample = 10_000_000")
    # What is allowed can be set only while access is open.
    db.execute("SET allowed_paths = ?", [named])
    db.execute("SET allowed_directories = ?", [within])
    for name, value in _LOCKED.items():
        db.execute(f"SET {name} = {str(value).lower()}")
    return db


def selected(cells: Mapping[str, str]) -> str:
    """Return the columns of a SELECT: SQL expressions by name."""
    return ", ".join(f'{cell} AS "{name}"' for name, cell in cells.items())


def write_tables(table: Path, parquet: Path, rows: Iterable[Mapping[str, Any]], *, force: bool) -> None:
    """Write rows as CSV and as Parquet, both or neither; raises what `whole` raises.

    The rows can be iterated over more than once; the columns are those of all of them.
    """
    check_utf8(parquet, OutputError)
    with whole(table, force=force) as text, whole(parquet, force=force) as packed:
        columns = dict.fromkeys(key for row in rows for key in row)
        with text.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, list(columns), restval="")
            writer.writeheader()
            writer.writerows(rows)
        wrong = raising(OutputError, f"{parquet}: cannot be written", duckdb.IOException)
        with connect(paths=[text, packed]) as db, wrong:
            db.read_csv(str(text), header=True, sample_size=-1).write_parquet(str(packed))


def log_of(path: Path) -> Path:
    """Return the path of DuckDB's write-ahead log of a file."""
    return path.with_name(path.name + ".wal")


def check_log(path: Path) -> None:
    """Raise `RecordingError` if a file is not regular, or if what DuckDB writes beside it is a link, pipe or device.

    DuckDB would follow the link when it writes its log, and would wait for a pipe forever.
    """
    if path.exists() and not path.is_file():
        raise RecordingError(f"{path}: is no regular file")
    place = path.resolve()  # the log of what a link leads to lies beside that
    for name in (log_of(place), place.with_name(place.name + ".tmp")):
        with suppress(FileNotFoundError, NotADirectoryError):
            mode = name.lstat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise RecordingError(f"{name}: is no regular file, and DuckDB would write to it; remove it")
