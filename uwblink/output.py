"""Files that are whole or not there at all."""

from __future__ import annotations

import os
from pathlib import Path

from uwblink.errors import OutputError, RecordingError, RecordingExistsError


def write_text(path: Path, text: str, *, force: bool) -> None:
    """Write a text file as UTF-8; raises what `write_bytes` raises."""
    write_bytes(path, text.encode(), force=force)


def write_bytes(path: Path, data: bytes, *, force: bool) -> None:
    """Write a file by way of a hidden neighbour that takes its name when complete.

    Raises what `check_output` raises, and `OutputError` where the disk does not take it; a file that was there stays.
    """
    check_output(path, force=force)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        partial.unlink(missing_ok=True)


def check_output(path: Path, *, force: bool) -> None:
    """Raise the one clear error if `path` cannot be written to; writes nothing."""
    if path.is_dir():
        raise RecordingError(f"{path}: is a directory, expected the name of an output file")
    if path.exists() and not force:
        raise RecordingExistsError(f"{path}: exists already; give another name, or `force` to replace it")
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: the folder {path.parent} does not exist; create it first")
    if not os.access(path.parent, os.W_OK):
        raise RecordingError(f"{path}: no permission to write in {path.parent}")
