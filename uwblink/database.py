"""The one place that opens DuckDB: files and tables of strangers pass through it, so nothing of it is left open.

A connection reaches the file that it is opened for and what the caller names, and no other file; it loads no extension,
and its settings are locked. A test holds that nothing else in the packages opens DuckDB.
"""

from __future__ import annotations

import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from uwblink.errors import RecordingError
from uwblink.output import interrupts_held

with interrupts_held():  # an interrupt within this import ends the process in C++
    import duckdb as duckdb

STORAGE_VERSION: Final = "v1.5.0"
"""Storage of new files: that of the lowest version in pyproject.toml, so that every allowed version reads them."""

_LOCKED: Final = {"enable_external_access": False, "lock_configuration": True}
"""The second makes all settings last, so it comes last."""


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
    """Open a file of DuckDB, or a database in memory, that reaches only `paths` and what lies in `folders`.

    It keeps `memory_mb` in memory, by default most of what there is, and the rest in the folder `temporary`. Raises
    what DuckDB raises, and what `check_log` raises.
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
    # What is allowed can be set only while access is open.
    db.execute("SET allowed_paths = ?", [named])
    db.execute("SET allowed_directories = ?", [within])
    for name, value in _LOCKED.items():
        db.execute(f"SET {name} = {str(value).lower()}")
    return db


def log_of(path: Path) -> Path:
    """Return where DuckDB keeps what was committed to a file and is not in the file itself yet."""
    return path.with_name(path.name + ".wal")


def check_log(path: Path) -> None:
    """Raise `RecordingError` where a file, or what DuckDB writes beside it, is a link, a pipe or a device.

    DuckDB would write its log through a link, over whatever that leads to, and wait for ever for a pipe.
    """
    if path.exists() and not path.is_file():
        raise RecordingError(f"{path}: is no regular file")
    place = path.resolve()  # the log of what a link leads to lies beside that
    for name in (log_of(place), place.with_name(place.name + ".tmp")):
        with suppress(FileNotFoundError, NotADirectoryError):
            mode = name.lstat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise RecordingError(f"{name}: is no regular file, and DuckDB would write to it; remove it")
