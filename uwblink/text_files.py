"""Reads files of other people: whatever keeps one from being read is one line in the caller's own error."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path


def require_regular(
    path: str | os.PathLike[str], error: Callable[[str], Exception], what: str = "file", *, folders: bool = False
) -> None:
    """Raise what `error` makes of a line that names the path, where there is no regular file.

    Opening a FIFO waits until somebody writes into it, and a device may never end, so neither is opened. A directory
    passes only with `folders`.
    """
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError as problem:
        raise error(f"{path}: no such {what}") from problem
    except OSError as problem:
        raise error(f"{path}: cannot be read ({problem.strerror})") from problem
    except ValueError as problem:  # a NUL in the path
        raise error(f"{str(path)!r}: no path of a {what} ({problem})") from problem
    if stat.S_ISDIR(mode):
        if not folders:
            raise error(f"{path}: is a directory, expected a {what}")
    elif not stat.S_ISREG(mode):
        raise error(f"{path}: is a FIFO, socket or device, expected a {what} in a regular file")


def read_text(path: str | os.PathLike[str], error: Callable[[str], Exception], what: str = "file") -> str:
    """Return the text of a file in UTF-8.

    Raises what `error` makes of a line that names the path: no such `what`, no regular file, no text, or not readable.
    """
    require_regular(path, error, what)
    try:
        return Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not a text file in UTF-8 (byte {problem.start}), expected a {what}") from problem
    except OSError as problem:
        raise error(f"{path}: cannot be read ({problem.strerror})") from problem
