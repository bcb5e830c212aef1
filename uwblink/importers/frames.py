"""Data frames of pandas, Polars or Arrow, imported as tables: DuckDB reads them, and no library of theirs is needed."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import duckdb

from uwblink.database import connect
from uwblink.errors import ImportTableError, raising
from uwblink.importers.guess import guess_map

DATA_FRAME = "data frame"
"""What messages and recordings call a data frame."""


def write_frame(frame: Any, folder: Path) -> Path:
    """Write a data frame as Parquet into a folder, named indices as columns; raises `ImportTableError`."""
    path = folder / f"{DATA_FRAME}.parquet"
    if any(name is not None for name in getattr(getattr(frame, "index", None), "names", [])):
        frame = frame.reset_index()
    with (
        raising(ImportTableError, f"{DATA_FRAME}: cannot be read", duckdb.Error, TypeError, ValueError),
        connect(folders=[folder]) as db,
    ):
        db.register("frame", frame)
        written = str(path).replace("'", "''")
        db.execute(f"COPY frame TO '{written}' (FORMAT parquet)")
    return path


def map_of_frame(table: Path, given: str | os.PathLike[str] | Mapping[str, Any] | None) -> Path:
    """Return the path of the map of a written frame: the given one, one that says what a mapping says, or a guess.

    Raises `ImportTableError` where the frame does not tell everything, with what is missing.
    """
    if isinstance(given, str | os.PathLike):
        return Path(given)
    if given is not None:
        path = table.with_suffix(".json")
        path.write_text(json.dumps(given, default=dict), "utf-8")
        return path
    found, path = guess_map(table), table.with_suffix(".toml")
    if found.asked or not found.complete:
        what = f"state {' and '.join(found.asked)}" if found.asked else "name its columns"
        proposed = "\n".join(line for line in found.text.splitlines()[1:] if line)
        raise ImportTableError(f"{DATA_FRAME}: {what} in `map`, a mapping or a file such as\n{proposed}")
    path.write_text(found.text, "utf-8")
    return path
