"""Rows of a table that can be used, as exchanges."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.importers.column_map import POSITIONS
from uwblink.importers.stamps import clocks, stamps_of, to_ticks
from uwblink.importers.table_rows import Rows
from uwblink.importers.trials import Reading
from uwblink.twr import STAMPS, Exchanges, raw_range

A_ROW_NS: Final = 1_000_000
"""Between rows of a table that has no times."""


def exchanges_of(rows: Rows, reading: Reading, before: int) -> Exchanges:
    """Return the exchanges of rows with stamps, `before` which others came; ranges as reported, or by the stamps."""
    names = stamps_of(reading.protocol)
    ticks = to_ticks(
        {name: rows.cells[name] for name in names},
        clocks(reading.protocol),
        rows.column_map.ticks_per_unit,
        reading.bits,
    )
    none = np.zeros(len(rows), dtype=np.int64)
    stamps = {name: ticks.get(name, none) for name in STAMPS}
    exchanges = _of_rows(rows, reading.protocol, reading.bits, stamps, before)
    reported = optional(rows, "range_m")
    known = np.isfinite(reported)
    exchanges.range_m[:] = reported if known.all() else np.where(known, reported, raw_range(exchanges))
    return exchanges


def plain_ranges(rows: Rows, before: int) -> Exchanges:
    """Return exchanges without stamps: single-sided ones, whose range is the one that was reported."""
    none = np.zeros(len(rows), dtype=np.int64)
    exchanges = _of_rows(rows, "ss", 32, dict.fromkeys(STAMPS, none), before)
    return replace(exchanges, range_m=rows.cells["range_m"].copy())


def _of_rows(rows: Rows, protocol: str, bits: int, stamps: dict[str, Ints], before: int) -> Exchanges:
    count = len(rows)
    when = rows.time_ns if rows.time_ns is not None else np.arange(before, before + count, dtype=np.int64) * A_ROW_NS
    return Exchanges(
        time_ns=when,
        initiator=rows.ids["from_id"],
        target=rows.ids["to_id"],
        reporter=rows.ids["from_id"],
        protocol=np.full(count, protocol),
        range_m=np.zeros(count),
        fpp1_dbm=optional(rows, "fpp1"),
        fpp2_dbm=optional(rows, "fpp2"),
        skew1_ppm=optional(rows, "skew1"),
        skew2_ppm=optional(rows, "skew2"),
        truth_m=truth_m(rows),
        bits=bits,
        **stamps,
    )


def optional(rows: Rows, name: str) -> Floats:
    """Return a column (n,), NaN where there is nothing in it, or no such column."""
    column = rows.cells.get(name)
    if column is None:
        return np.full(len(rows), np.nan)
    finite = np.isfinite(column)
    return column if finite.all() else np.where(finite, column, np.nan)


def truth_m(rows: Rows) -> Floats:
    """Return distances (n,) that were measured, or those between antennas; NaN where there are none."""
    if "gt_range_m" in rows.cells:
        return optional(rows, "gt_range_m")
    if not all(name in rows.cells for name in POSITIONS):
        return np.full(len(rows), np.nan)
    ends = np.array([optional(rows, name) for name in POSITIONS])
    return np.asarray(np.sqrt(((ends[3:] - ends[:3]) ** 2).sum(axis=0)))


def powers_of(rows: Rows, exchanges: Exchanges) -> dict[str, NDArray[Any]]:
    """Return the total powers of exchanges as columns of the table `powers`; none where the rows have none."""
    if "rxp1" not in rows.cells and "rxp2" not in rows.cells:
        return {}
    e = exchanges
    levels = {f"{name}_dbm": optional(rows, name) for name in ("rxp1", "rxp2")}
    return {"time_ns": e.time_ns, "initiator": e.initiator, "target": e.target, **levels}
