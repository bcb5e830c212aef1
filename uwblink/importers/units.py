"""Check the units of lengths and powers that a map does not state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from uwblink.arrays import Floats
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import DISTANCE_UNITS, POSITIONS, POWERS, ColumnMap
from uwblink.importers.stamps import MIN_ROWS
from uwblink.importers.tables import Columns
from uwblink.recording.antenna_delays import REGISTER_MAX
from uwblink.ticks import METRES_PER_TICK

Errors = Callable[[float], Floats]
"""Returns ranges less distances (n,) with some lengths multiplied by a factor, in the given unit of the ranges.

In this unit noise does not depend on the factor; otherwise ranges of boards at rest would seem to be in feet.
"""


def other_unit(errors: Mapping[str, Errors]) -> tuple[str, str] | None:
    """Return the name and unit of lengths that are evidently not in metres; None if all are in metres.

    `errors` are by the name of the lengths that are multiplied. The residuals of the errors from a constant (antenna
    delays) are compared: a unit is found if they are smaller by more than the square root of its factor. Residuals of
    distances that are unrelated to the ranges shrink to the spread of the ranges, by at most the square root of two.
    """
    best, found = 0.0, None
    for name, of in errors.items():
        plain = _remaining(of(1.0))
        for unit, factor in DISTANCE_UNITS.items():
            if factor == 1.0 or not plain > 0:
                continue
            gain = np.log(plain / max(_remaining(of(factor)), METRES_PER_TICK))
            if gain > max(best, -np.log(factor) / 2):
                best, found = gain, (name, unit)
    return found


def _remaining(errors_m: Floats) -> float:
    """Return the median absolute residual of errors from a constant within antenna delays; NaN of few values."""
    finite = errors_m[np.isfinite(errors_m)]
    if len(finite) < MIN_ROWS:
        return float("nan")
    longest = REGISTER_MAX * METRES_PER_TICK  # the registers of both ends at their maximum
    constant = np.clip(np.median(finite), -longest, longest)
    return float(np.median(np.abs(finite - constant)))


def reason_against_metres(ranges: Floats) -> str:
    """Return why numbers (n,) cannot be ranges in metres; empty text if they can."""
    finite = ranges[np.isfinite(ranges)]
    if len(finite) < MIN_ROWS:
        return ""
    middle = float(np.median(np.abs(finite)))
    if middle > 300.0:  # DW1000 devices reach 290 m in the open by their data sheet
        return f"{middle:.6g} in the middle, farther than devices reach in metres"
    # With noise of centimetres, ranges are not all integers, unless one number repeats.
    if len(np.unique(finite)) > MIN_ROWS // 4 and np.array_equal(finite, np.rint(finite)):
        return "whole numbers all, as no ranges in metres are"
    return ""


def reason_against_dbm(powers: Floats) -> str:
    """Return why numbers (n,) cannot be received powers in dBm; empty text if they can."""
    finite = powers[np.isfinite(powers) & (powers != 0)]  # boards print 0 for an unknown power
    middle = float(np.median(finite)) if len(finite) else -1.0
    # The legal limit of transmitted power is -41.3 dBm/MHz, -14 dBm in 500 MHz.
    return f"{middle:+.4g} in the middle, and no received power is above 0 dBm" if middle > 0 else ""


def truth_m(rows: Columns) -> Floats:
    """Return measured distances (n,), or else those between the antenna positions; NaN if unknown."""
    if "gt_range_m" in rows or not all(name in rows for name in POSITIONS):
        return optional(rows, "gt_range_m")
    ends = np.array([rows[name] for name in POSITIONS])
    return np.asarray(np.sqrt(((ends[3:] - ends[:3]) ** 2).sum(axis=0)))


def optional(rows: Columns, name: str) -> Floats:
    """Return a column (n,), or NaN if there is no such column."""
    return rows[name] if name in rows else np.full(len(rows["origin"]), np.nan)


def check_units(column_map: ColumnMap, path: Path, rows: Columns, raw_m: Floats | None) -> None:
    """Raise `ImportTableError` if a sample of rows shows that lengths or powers are in another unit.

    Implausible numbers are refused unless the map states their unit; lengths that contradict each other always are.
    `raw_m` are the ranges by the stamps (n,), if there are any.
    """
    for name in POWERS:
        if column_map.power_unit is None and (why := reason_against_dbm(optional(rows, name))):
            raise ImportTableError(
                f"{path}: column {column_map.header(name)!r}: its powers are {why}; say units.power in the map: "
                '"-dBm" where they lack their sign'
            )
    ranges, true = optional(rows, "range_m"), truth_m(rows)
    if column_map.distance_unit is None and (why := reason_against_metres(ranges)):
        raise ImportTableError(
            f"{path}: column {column_map.header('range_m')!r}: its ranges are {why}; say units.distance in the map"
        )
    if raw_m is None:
        found = other_unit({"ranges": lambda f: ranges - true / f, "true distances": lambda f: ranges - f * true})
    else:
        found = other_unit({"ranges": lambda f: raw_m - f * ranges, "true distances": lambda f: raw_m - f * true})
    if found:
        beside = "the others" if raw_m is None else "its stamps"
        raise ImportTableError(
            f"{path}: {found[0]} are in {found[1]} by {beside}, and in {column_map.distance_unit or 'm'} by the map; "
            "units.distance says one unit for all ranges, true distances and positions"
        )
