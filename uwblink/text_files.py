"""Reading of text and TOML files, with errors of the caller's type that name the file and the key."""

from __future__ import annotations

import json
import math
import os
import stat
import sys
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from uwblink.errors import raising

__all__ = ["FileKey", "TomlReader", "heads", "is_number", "number_in", "read_text", "require_regular"]


def require_regular(
    path: str | os.PathLike[str], error: Callable[[str], Exception], what: str = "file", *, folders: bool = False
) -> None:
    """Raise `error` with a line of text if a path is not a regular file; directories pass with `folders`.

    FIFOs and devices must not be opened: reading them may never end.
    """
    not_path = raising(error, f"{str(path)!r}: no path of a {what}", ValueError)  # a NUL in the path
    with not_path, raising(error, f"{path}: cannot be read"):
        try:
            mode = os.stat(path).st_mode
        except FileNotFoundError as problem:
            raise error(f"{path}: no such {what}") from problem
    if stat.S_ISDIR(mode):
        if not folders:
            raise error(f"{path}: is a directory, expected a {what}")
    elif not stat.S_ISREG(mode):
        raise error(f"{path}: is a FIFO, socket or device, expected a {what} in a regular file")


def read_text(path: str | os.PathLike[str], error: Callable[[str], Exception], what: str = "file") -> str:
    """Return the text of a file in UTF-8.

    Raises `error` with a line of text if there is no such `what`, or if it is not a readable text file.
    """
    require_regular(path, error, what)
    not_text = raising(error, f"{path}: not a text file in UTF-8", UnicodeDecodeError, remedy=f", expected a {what}")
    with raising(error, f"{path}: cannot be read"), not_text:
        return Path(path).read_text(encoding="utf-8")


class FileKey(NamedTuple):
    """A key of a file, for the reference: dotted in tables, in capitals if the user chooses it."""

    name: str
    kind: str
    default: str
    meaning: str


def heads(keys: Iterable[FileKey]) -> tuple[str, ...]:
    """Return the keys and tables of the first level, in order."""
    return tuple(dict.fromkeys(key.name.split(".")[0] for key in keys))


class TomlReader:
    """Reads one file of TOML, or JSON by its suffix, and checks its values.

    Raises `error` with a text that begins with path and key.
    """

    def __init__(self, path: Path, error: Callable[[str], Exception], what: str = "file") -> None:
        """Read `path`, which holds a `what`."""
        self.path, self.error = path, error
        self.text = read_text(path, error, what)
        form, parse = ("JSON", json.loads) if path.suffix == ".json" else ("TOML", tomllib.loads)
        with raising(error, f"{path}: not valid {form}", ValueError, RecursionError):
            self.table: dict[str, Any] = parse(self.text)
        self.check(what, self.table, isinstance(self.table, dict), "an object of keys")

    def known(self, table: dict[str, Any], names: Iterable[str], prefix: str = "") -> None:
        """Raise for a key that is none of `names`."""
        listed = list(names)
        for key in table:
            if key not in listed:
                raise self.error(f"{self.path}: {prefix}{key}: unknown key; the known keys are {', '.join(listed)}")

    def section(self, name: str) -> dict[str, Any]:
        """Return a table of the file, empty where there is none."""
        found = self.table.get(name, {})
        self.check(name, found, isinstance(found, dict), "a table")
        return dict(found)

    def rows(self, name: str, keys: Iterable[str] | None) -> list[dict[str, Any]]:
        """Return an array of tables, which may be absent; raises for a key that is not in `keys` (None: any)."""
        found = self.table.get(name, [])
        good = isinstance(found, list) and all(isinstance(row, dict) for row in found)
        self.check(name, found, good, f"tables [[{name}]]" + (f" with {', '.join(keys)}" if keys else ""))
        for k, row in enumerate(found if keys is not None else ()):
            self.known(row, keys or (), f"{name}[{k}].")
        return list(found)

    def choice(self, key: str, value: Any, allowed: Iterable[Any]) -> Any:
        """Return a value that is one of `allowed`; None or "" among them allows a missing key."""
        listed = list(allowed)
        if not any(type(value) is type(one) and value == one for one in listed):
            names = ", ".join(str(a) for a in listed if a not in (None, ""))
            raise self.error(f"{self.path}: {key}: found {value!r}, allowed: {names}")
        return value

    def check(self, key: str, value: Any, good: bool, expected: str) -> None:
        """Raise `error` if a value is not good."""
        if not good:
            raise self.error(f"{self.path}: {key}: found {value!r}, expected {expected}")


def number_in(text: str) -> float:
    """Return a text as a number, NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number within the range of floats."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
