"""Reads text files of other people: whatever keeps one from being read is one line in the caller's own error."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path


def read_text(path: str | os.PathLike[str], error: Callable[[str], Exception], what: str = "file") -> str:
    """Return the text of a file in UTF-8.

    Raises what `error` makes of a line that names the path: no such `what`, a directory, no text, or not readable.
    """
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError as problem:
        raise error(f"{path}: no such {what}") from problem
    except IsADirectoryError as problem:
        raise error(f"{path}: is a directory, expected a {what}") from problem
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not a text file in UTF-8 (byte {problem.start}), expected a {what}") from problem
    except OSError as problem:
        raise error(f"{path}: cannot be read ({problem.strerror})") from problem
    except ValueError as problem:  # a NUL in the path
        raise error(f"{str(path)!r}: no path of a {what} ({problem})") from problem
