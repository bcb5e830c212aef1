"""Columns in order of time, and rows as CSV and Parquet files that are whole or not there at all."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
from numpy.typing import NDArray

from uwblink.database import connect
from uwblink.errors import OutputError, first_line
from uwblink.output import is_utf8, whole

Columns = dict[str, NDArray[Any]]
"""A table of a recording as columns by name."""

Rows = Iterable[Mapping[str, Any]]
"""Rows that can be iterated over more than once; the columns are those of all of them."""


def in_time_order(parts: Sequence[Columns]) -> Columns:
    """Return the rows of several tables as one, in order of their `time_ns`; no columns for no tables."""
    if not parts:
        return {}
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(columns["time_ns"], kind="stable")
    return {name: column[order] for name, column in columns.items()}


def write_tables(table: Path, parquet: Path, rows: Rows, *, force: bool) -> None:
    """Write rows as CSV and as Parquet, both or neither; raises what `whole` raises."""
    if not is_utf8(parquet):
        raise OutputError(f"{parquet}: its name and those of its folders must be UTF-8; give another one")
    with whole(table, force=force) as text, whole(parquet, force=force) as packed:
        columns = dict.fromkeys(key for row in rows for key in row)
        with text.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, list(columns), restval="")
            writer.writeheader()
            writer.writerows(rows)
        with connect(paths=[text, packed]) as db:
            try:
                db.read_csv(str(text), header=True, sample_size=-1).write_parquet(str(packed))
            except duckdb.IOException as error:
                raise OutputError(f"{parquet}: cannot be written ({first_line(error)})") from error
