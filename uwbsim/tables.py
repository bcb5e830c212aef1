"""Tables: columns in order of time, and rows as CSV and Parquet files that are whole or not there at all."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwblink.database import connect
from uwblink.errors import OutputError, first_line
from uwblink.output import is_utf8, whole

Rows = Sequence[Mapping[str, Any]]


Columns = dict[str, NDArray[Any]]
"""A table of a recording as columns by name."""


def in_time_order(parts: Sequence[Columns]) -> Columns:
    """Return the rows of several tables as one, in order of their `time_ns`; no columns for no tables."""
    if not parts:
        return {}
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(columns["time_ns"], kind="stable")
    return {name: column[order] for name, column in columns.items()}


def write_csv(path: Path, rows: Rows, *, force: bool) -> None:
    """Write rows as CSV; the columns are those of the first row. Raises what `whole` raises."""
    with whole(path, force=force) as partial:
        fill_csv(partial, list(rows[0]), rows)


def fill_csv(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows one by one, with a line of the columns' names before."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def write_parquet(path: Path, rows: Rows, *, force: bool) -> None:
    """Write rows as Parquet; raises what `whole` raises."""
    if not is_utf8(path):
        raise OutputError(f"{path}: its name and those of its folders must be UTF-8; give another one")
    with whole(path, force=force) as partial, connect(paths=[partial]) as db:
        columns = {key: _type(key, rows) for key in rows[0]}
        declared = ", ".join(f'"{key.replace(chr(34), 2 * chr(34))}" {kind}' for key, kind in columns.items())
        db.execute(f"CREATE TABLE rows ({declared})")
        places = ", ".join("?" * len(columns))
        db.executemany(f"INSERT INTO rows VALUES ({places})", [[row.get(key) for key in columns] for row in rows])  # noqa: S608 - only question marks
        fill_parquet(partial, db.table("rows"), path)


def fill_parquet(partial: Path, relation: Any, path: Path) -> None:
    """Write a relation of DuckDB as Parquet to what will be `path`; raises `OutputError` where there is no room."""
    import duckdb

    try:
        relation.write_parquet(str(partial))
    except duckdb.IOException as error:
        raise OutputError(f"{path}: cannot be written ({first_line(error)})") from error


def _type(key: str, rows: Rows) -> str:
    known = {type(row[key]) for row in rows if row.get(key) is not None}
    # Whole numbers among others are numbers; anything else mixed is text.
    if known == {int, float}:
        return "DOUBLE"
    types = {bool: "BOOLEAN", int: "BIGINT", float: "DOUBLE"}
    return types.get(next(iter(known)), "VARCHAR") if len(known) == 1 else "VARCHAR"
