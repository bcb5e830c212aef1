"""Files that are whole or not there at all."""

from __future__ import annotations

import os
from pathlib import Path

from uwblink.errors import OutputError
from uwblink.recording.file import check_output

__all__ = ["check_output", "write_bytes", "write_text"]


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
