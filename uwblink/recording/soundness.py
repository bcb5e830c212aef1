"""What a file is before DuckDB reads it: in use by another process, or cut off, or no recording at all."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from uwblink.database import log_of
from uwblink.display import printable
from uwblink.errors import RecordingError, first_line
from uwblink.output import is_utf8
from uwblink.recording.schema import SUFFIX

HEADER_BYTES: Final = 3 * 4096
BLOCK_BYTES: Final = 16_384
"""Smallest block of a DuckDB file; every larger one is a multiple of it."""

WRITER: Final = slice(52, 84)
"""Where the first header of a file has the version of the DuckDB that wrote it."""

_TABLES: Final = (".csv", ".tsv", ".txt", ".gz", ".parquet", ".jsonl", ".ndjson")
IMPORTED_AS: Final = {**dict.fromkeys(_TABLES, "csv"), **dict.fromkeys((".bag", ".mcap", ".db3"), "bag")}
"""Endings of other people's files, and the importer that reads them."""


def is_locked(path: Path, *, update: bool) -> bool:
    """Whether another process holds the lock that DuckDB takes on a file it writes, or reads."""
    try:
        import fcntl
    except ImportError:  # not a POSIX system, where opening the file says it
        return False
    if not path.is_file():  # opening a FIFO would wait
        return False
    try:
        with path.open("r+b" if update else "rb") as file:
            fcntl.lockf(file, (fcntl.LOCK_EX if update else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return True
    except OSError:
        return False
    return False


def damaged(path: Path, error: Exception) -> RecordingError:
    """Return what to raise for a file that DuckDB cannot open."""
    if "version number" in str(error):
        from duckdb import __version__ as installed

        return RecordingError(
            f"{path}: {_writer(path)} stored it in a way that the installed DuckDB {installed} cannot read; "
            "update DuckDB, or export the recording where it was made"
        )
    return _no_recording(path, first_line(error))


def _writer(path: Path) -> str:
    """Return which DuckDB wrote a file, as its first header says."""
    with path.open("rb") as file:
        text = file.read(WRITER.stop)[WRITER].split(b"\0")[0].decode(errors="replace")
    return f"DuckDB {printable(text)}" if text else "another DuckDB"


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

    Beside a log it may have any length: a disk that was full while the log was put into it leaves half a block at its
    end, to which nothing refers, and everything is in the log.
    """
    log = log_of(path)
    if log.exists() and log.stat().st_size:
        return
    if path.stat().st_size % BLOCK_BYTES != HEADER_BYTES % BLOCK_BYTES:
        raise _no_recording(path, "its length is odd")
