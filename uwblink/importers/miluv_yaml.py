"""The YAML files of the MILUV dataset: plain values by name, and vectors by name and number."""

from __future__ import annotations

import reprlib
from pathlib import Path
from typing import Any

import yaml

from uwblink.errors import ImportTableError, first_line
from uwblink.text_files import read_text

Vector = tuple[float, float, float]


def read_mapping(path: Path) -> dict[str, Any]:
    """Return a YAML file whose top level is a mapping; raises `ImportTableError`."""
    try:
        table = yaml.safe_load(read_text(path, ImportTableError))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ImportTableError(f"{path}: not YAML ({first_line(error)})") from error
    if not isinstance(table, dict):
        raise ImportTableError(f"{path}: expected names and values, as in `name: value`")
    return {str(name): value for name, value in table.items()}


def read_vectors(path: Path) -> dict[str, dict[int, Vector]]:
    """Return vectors of three numbers by name and number; each is a list, or text such as "[1.0, 2.0, 3.0]".

    Raises `ImportTableError`.
    """
    found: dict[str, dict[int, Vector]] = {}
    for name, group in read_mapping(path).items():
        if not isinstance(group, dict):
            raise ImportTableError(f"{path}: {name[:40]}: expected numbers, each with [x, y, z]")
        found[name] = {}
        for number, value in group.items():
            cells = value.strip("[] ").split(",") if isinstance(value, str) else value
            try:
                x, y, z = (float(cell) for cell in cells)
                found[name][int(number)] = (x, y, z)
            except (TypeError, ValueError) as error:
                raise ImportTableError(
                    f"{path}: {name[:40]}: {str(number)[:20]}: found {reprlib.repr(value)[:40]}, expected [x, y, z]"
                ) from error
    return found
