"""Columns as DuckDB takes them in: arrays by name, and the SQL that makes a table's values of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwblink.columns import few_words
from uwblink.recording.schema import TABLES


class Batch(NamedTuple):
    """Arrays (n,) by name, the values that are selected from them, and what is bound to those."""

    columns: dict[str, NDArray[Any]]
    values: str
    bound: list[Any]


def batch_of(table: str, columns: Mapping[str, NDArray[Any]]) -> Batch:
    """Return columns (n,) of one of `TABLES` for an insertion; what is masked in them becomes missing."""
    batch: dict[str, NDArray[Any]] = {}
    values, bound = [], list[Any]()
    for name, column in columns.items():
        batch[name] = np.ascontiguousarray(np.ma.getdata(column))
        values.append(f'"{name}"')
        if (coded := few_words(column)) is not None:
            # Words of an array are sorted, which would be the longest part of an insertion.
            bound.append(coded[0].tolist())
            batch[name] = coded[1] + 1
            values[-1] = f'CAST(? AS VARCHAR[])["{name}"]'
        if TABLES[table][name] == "BLOB":
            # Not every version takes bytes from an array; all take digits.
            batch[name] = np.array([data.hex() for data in batch[name].tolist()], dtype=object)
            values[-1] = f'unhex("{name}")'
        if np.ma.is_masked(column):
            batch[f"no_{name}"] = np.ma.getmaskarray(column)
            values[-1] = f'CASE WHEN "no_{name}" THEN NULL ELSE {values[-1]} END'
    return Batch(batch, ", ".join(values), bound)
