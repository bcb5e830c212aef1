"""Units of lengths and powers that a map does not state: whether the numbers can have the assumed unit."""

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
"""Ranges less distances (n,), if some lengths are multiplied by a factor, in the unit that the ranges have as they are.

So noise counts alike whatever the factor; else ranges of boards that stand still would pass for ranges in feet.
"""


def other_unit(errors: Mapping[str, Errors]) -> tuple[str, str] | None:
    """Return which lengths are in which other unit than metres, where that explains the ranges; else None.

    `errors` are by the name of the lengths that are multiplied. What remains of errors beside a constant (antenna
    delays) is compared: in another unit it must be less by more than the root of the unit's factor, that is nearer to
    what the factor would make of it than to what it is. Distances that have nothing to do with the ranges come down to
    the ranges' own spread, by the root of two at most.
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
    """Return the median size of errors beside a constant that antenna delays can make; NaN of few."""
    finite = errors_m[np.isfinite(errors_m)]
    if len(finite) < MIN_ROWS:
        return float("nan")
    longest = REGISTER_MAX * METRES_PER_TICK  # all that registers hold, at both ends
    constant = np.clip(np.median(finite), -longest, longest)
    return float(np.median(np.abs(finite - constant)))


def reason_against_metres(ranges: Floats) -> str:
    """Return why numbers (n,) cannot be ranges in metres; empty text where they can be."""
    finite = ranges[np.isfinite(ranges)]
    if len(finite) < MIN_ROWS:
        return ""
    middle = float(np.median(np.abs(finite)))
    if middle > 300.0:  # DW1000 devices reach 290 m in the open by their data sheet
        return f"{middle:.6g} in the middle, farther than devices reach in metres"
    # Noise of centimetres leaves no range a whole number of metres, those that repeat one number aside.
    if len(np.unique(finite)) > MIN_ROWS // 4 and np.array_equal(finite, np.rint(finite)):
        return "whole numbers all, as no ranges in metres are"
    return ""


def reason_against_dbm(powers: Floats) -> str:
    """Return why numbers (n,) cannot be received powers in dBm; empty text where they can be."""
    finite = powers[np.isfinite(powers) & (powers != 0)]  # boards that cannot tell a power print 0
    middle = float(np.median(finite)) if len(finite) else -1.0
    # What may be sent is -41.3 dBm/MHz, -14 dBm in 500 MHz.
    return f"{middle:+.4g} in the middle, and no received power is above 0 dBm" if middle > 0 else ""


def truth_m(rows: Columns) -> Floats:
    """Return distances (n,) that were measured, or those between antennas; NaN where there are none."""
    if "gt_range_m" in rows or not all(name in rows for name in POSITIONS):
        return optional(rows, "gt_range_m")
    ends = np.array([rows[name] for name in POSITIONS])
    return np.asarray(np.sqrt(((ends[3:] - ends[:3]) ** 2).sum(axis=0)))


def optional(rows: Columns, name: str) -> Floats:
    """Return a column (n,), NaN where there is no such column."""
    return rows[name] if name in rows else np.full(len(rows["origin"]), np.nan)


def check_units(column_map: ColumnMap, path: Path, rows: Columns, raw_m: Floats | None) -> None:
    """Raise `ImportTableError` where some rows of a table say that lengths or powers are in another unit.

    What is wrong by itself is asked for unless the map says the unit; lengths that contradict each other are refused.
    `raw_m` are ranges by the stamps (n,), if there are any.
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
