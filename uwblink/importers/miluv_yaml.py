"""The YAML files of the MILUV dataset: one level of plain values, or two levels down to vectors.

They are that simple that YAML itself, with its tags and references, is not needed to read them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from uwblink.errors import ImportTableError
from uwblink.text_files import read_text

Vector = tuple[float, float, float]

_LINE: Final = re.compile(
    r"""^(?P<indent> *)["']?(?P<key>[^"':#]+)["']?\s*:\s*["']?(?P<value>[^"'#]*)["']?\s*(#.*)?$"""
)


def read_mapping(path: Path) -> dict[str, str]:
    """Return keys and values of a file of `key: value` lines; raises `ImportTableError`."""
    return {key: value for _, indent, key, value in _lines(path) if not indent and value}


def read_vectors(path: Path) -> dict[str, dict[int, Vector]]:
    """Return three numbers by name and number, from lines `name:` and below each `number: "[x, y, z]"`.

    Raises `ImportTableError` with the line.
    """
    found: dict[str, dict[int, Vector]] = {}
    group: dict[int, Vector] | None = None
    for number, indent, key, value in _lines(path):
        if not indent and not value:
            group = found.setdefault(key, {})
            continue
        cells = value.strip("[]").split(",")
        try:
            x, y, z = (float(cell) for cell in cells)
            if group is None or not indent:
                raise ValueError
            group[int(key)] = (x, y, z)
        except ValueError as error:
            raise ImportTableError(
                f"{path}: row {number}: found {key[:20]}: {value[:40]!r}, expected a number and [x, y, z] below a name"
            ) from error
    return found


def _lines(path: Path) -> list[tuple[int, int, str, str]]:
    text = read_text(path, ImportTableError)
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise ImportTableError(f"{path}: row {number}: found {line[:60]!r}, expected key: value")
        found.append((number, len(match["indent"]), match["key"].strip(), match["value"].strip()))
    return found
