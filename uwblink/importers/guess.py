"""Propose a map for a table, with the reason for each line.

Columns are recognised by their names. Units are determined from suffixes of the names, from the size of the numbers,
and by which unit of the stamps makes plausible ranges; the protocol is found by trying all.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import (
    ASKED,
    DISTANCE_UNITS,
    DISTANCES,
    IDS,
    POSITIONS,
    POWERS,
    STAMP_UNITS,
    TIME_UNITS,
)
from uwblink.importers.guess_columns import OF_MESSAGES, named_columns, stamp_and_event, unusable_positions
from uwblink.importers.stamps import (
    ACCEPTED_SHARE,
    FITTING_SHARE,
    MIN_ROWS,
    SAMPLE_ROWS,
    Reading,
    Sample,
    Trial,
    counter_format_of,
    stamps_of,
)
from uwblink.importers.tables import Table
from uwblink.importers.units import reason_against_dbm, reason_against_metres
from uwblink.protocols.table import PROTOCOLS
from uwblink.twr import STAMPS

_ANY_UNIT: Final = f"of any unit: write {', '.join(STAMP_UNITS)}"
_LAYOUTS: Final = {
    "exchanges": (STAMPS[:4], "a row has the stamps of a whole exchange"),
    "messages": (("tx", "rx"), "a row has one stamp of a sender and one of a receiver"),
    "stamps": (("message",), "a row has one stamp, and says whether it is of sending or of receiving"),
    "ranges": (("range_m",), "there are ranges and no stamps"),
    "nothing": ((), "neither stamps nor ranges were recognised: rename columns below"),
}
"""The layouts that are recognised: the columns that each needs, and how it was recognised."""


@dataclass(frozen=True, slots=True)
class Guess:
    """A map as TOML text with reasons as comments, and whether it is sufficient to import the table.

    `asked` are keys that cannot be determined from the table: the map has "?" there, which the user must replace.
    """

    text: str
    complete: bool
    asked: tuple[str, ...] = ()


def guess_map(path: Path) -> Guess:
    """Return the proposed map of a table; raises `ImportTableError`."""
    if path.suffix.lower() == ".uwb":
        raise ImportTableError(f"{path}: is a recording already, and needs no map; 'uwblink show' says what it holds")
    with Table(path) as table:
        columns = named_columns(table.names)
        columns = stamp_and_event(table, columns) or columns
        headers = {name: header for name, header in columns.items() if name != "event"}
        numbers = table.read(numbers=headers.values(), limit=100_000)[0]
    cells = {name: numbers[header] for name, header in headers.items()}
    if not len(next(iter(cells.values()), np.empty(0))):
        raise ImportTableError(f"{path}: no column whose name is known, or no rows; there are {', '.join(table.names)}")
    layout = "stamps" if "event" in columns else _layout(cells)
    if layout == "messages" and _only_words(cells, "message") and columns["message"] != "message":
        del columns["message"], cells["message"]  # without a column of that name messages are told by their order
    unplaced = unusable_positions(columns, cells)
    for name in POSITIONS if unplaced else ():
        columns.pop(name, None)
        cells.pop(name, None)
    needed, why = _LAYOUTS[layout]
    top = [f"# {why}" if layout == "nothing" else f'layout = "{layout}"  # {why}']
    units, delays = _unit_lines(columns, cells), list[str]()
    if layout in ("exchanges", "messages", "stamps"):
        counter, unit, delays = _stamp_lines(columns, cells, layout)
        top, units = top + counter, [unit, *units]
    missing = [name for name in IDS if name not in columns]
    asked = [*missing, *(line.split()[0] for line in [*top, *units] if f'= "{ASKED}"' in line)]
    left = [name for name in table.names if name not in columns.values()]
    lacking = [name for name in needed if name not in cells or _only_words(cells, name)]
    lacking += ["message"] if layout == "messages" and _only_words(cells, "message") else []
    mixed = _distance_units(columns)
    # Names are a stranger's, and a line break in one would end the comment.
    lines = [f"# {json.dumps(path.name)}, as it would be read; every line can be changed", *top, "", "[columns]"]
    lines += [f"{name} = {json.dumps(header)}" for name, header in columns.items() if _belongs(name, layout)]
    lines += ["", "[units]", *units] if units else []
    lines += ["", "[constants]"] if missing else []
    lines += [
        f'{name} = "{ASKED}"  # no column is seen to name {IDS[name]}: write a number or a word for all rows, or the '
        "column above"
        for name in missing
    ]
    lines += ["", f"# {unplaced}"] if unplaced else []
    lines += ["", f"# not used: {', '.join(map(json.dumps, left))[:300]}"] if left else []
    lines += [f"# a column of numbers is still needed: {', '.join(lacking)}"] if lacking else []
    if len(mixed) > 1:
        lines.append(f"# distances have one unit for all, here they have {', '.join(sorted(mixed))}: convert some")
    lines += delays or ["# what was programmed into the devices is not in the table: [antenna_delays] says it"]
    return Guess("\n".join(lines) + "\n", layout != "nothing" and not lacking and len(mixed) < 2, tuple(asked))


def _only_words(cells: dict[str, Floats], name: str) -> bool:
    return name in cells and not np.isfinite(cells[name]).any()


def _layout(cells: dict[str, Floats]) -> str:
    return next(
        (one for one in ("exchanges", "messages", "ranges") if all(n in cells for n in _LAYOUTS[one][0])), "nothing"
    )


def _belongs(name: str, layout: str) -> bool:
    if layout in ("messages", "stamps"):
        return name not in (*STAMPS, "fpp1", "fpp2", "rxp1", "rxp2", "skew1", "skew2")
    return name not in OF_MESSAGES and not (layout == "ranges" and name in STAMPS)


def _stamp_lines(columns: dict[str, str], cells: dict[str, Floats], layout: str) -> tuple[list[str], str, list[str]]:
    """Return the map's lines on protocol and counter, on the unit of stamps, and on antenna delays, with reasons."""
    names = [name for name in (STAMPS if layout == "exchanges" else ("tx", "rx", "stamp")) if name in cells]
    stamps: dict[str, Floats] = {name: cells[name] for name in names}
    whole = all(np.array_equal(column, np.rint(column), equal_nan=True) for column in stamps.values())
    ended = {_suffix(columns[name], STAMP_UNITS) for name in names} - {None}
    if layout != "exchanges":
        named = next(iter(ended), None)
        scale = STAMP_UNITS[named or "ticks"]
        bits, kind = counter_format_of(column * scale for column in stamps.values())
        largest = max(float(np.nanmax(column, initial=0.0)) for column in stamps.values())
        # Of 22 stamps in ticks one at least is in the last tenth of the counter in nine tables of ten.
        full = whole and 0.9 * 2.0**bits < largest < 2.0**bits
        unit = named or ("ticks" if full else ASKED)
        why = "by the columns' names" if named else f"whole numbers up to 2^{bits}" if full else _ANY_UNIT
        return [f"bits = {bits}", f'counter = "{kind}"'], f'stamps = "{unit}"  # {why}', []
    units = sorted(filter(None, ended)) or (
        ["ticks", "ns", "us", "s", "ps"] if whole else ["ns", "us", "s", "ps", "ticks"]
    )
    metres = DISTANCE_UNITS[min(_distance_units(columns), default="m")]
    trials = [trial for unit in units for trial in _trials(stamps, cells, unit, metres)]
    unit, kind, best = max(trials, key=lambda found: round(found[2].plausible, 2))
    known = best.plausible >= ACCEPTED_SHARE
    check = "" if best.plausible >= FITTING_SHARE else "; check columns and units"
    share = f"{100 * best.plausible:.0f} % of its ranges are plausible, {best.low_m:.3g} to {best.high_m:.3g} m{check}"
    lines = [
        f'protocol = "{best.reading.protocol if known else ASKED}"  # {share}',
        f"bits = {best.reading.bits}  # the stamps fit",
        f'counter = "{kind}"',
    ]
    why = "by the columns' names" if ended else "whole numbers" if whole else "as ranges are plausible"
    if not known and not ended:
        unit, why = ASKED, _ANY_UNIT
    delays = [
        "",
        "[antenna_delays]  # by the true distances nothing was programmed into the devices",
        "tx = 0",
        "rx = 0",
    ]
    return lines, f'stamps = "{unit}"  # {why}', delays if best.reading.undelayed else []


def _trials(
    stamps: dict[str, Floats], cells: dict[str, Floats], unit: str, metres: float
) -> list[tuple[str, str, Trial]]:
    """Try stamps in a unit with each protocol; returns unit, format of the counter, and trial."""
    chosen = np.flatnonzero(np.all([np.isfinite(column) for column in stamps.values()], axis=0))[:SAMPLE_ROWS]
    if not len(chosen):
        raise ImportTableError("its stamps are no numbers in any row")
    sampled, scale, count = {name: column[chosen] for name, column in stamps.items()}, STAMP_UNITS[unit], len(chosen)
    bits, counter = counter_format_of(column * scale for column in sampled.values())
    truth = cells["gt_range_m"][chosen] * metres if "gt_range_m" in cells else np.full(count, np.nan)
    pair, unknown = np.zeros(count, dtype=np.int64), np.full(count, np.nan)
    sample = Sample(sampled, pair, truth, unknown, np.zeros(count), scale)
    names = [row.name for row in PROTOCOLS.known() if set(stamps_of(row.name)) == set(stamps)]
    names = [name for name in names if name not in ("ss-cfo", "ds-sym")] or ["ss"]
    readings = [Reading(name, bits) for name in names]
    if np.isfinite(truth).any():
        readings += [replace(reading, undelayed=True) for reading in readings]
    return [(unit, counter, sample.try_reading(reading)) for reading in readings]


def _unit_lines(columns: dict[str, str], cells: dict[str, Floats]) -> list[str]:
    lines = []
    if "time_s" in columns:
        unit, why = _time_unit(columns["time_s"], cells["time_s"])
        lines.append(f'time = "{unit}"  # {why}')
    units = _distance_units(columns)
    if len(units) == 1:
        lines += [f'distance = "{unit}"  # by the columns\' names' for unit in units]
    elif not units and "range_m" in cells and (why := reason_against_metres(cells["range_m"])):
        lines.append(f'distance = "{ASKED}"  # ranges are {why}: write {", ".join(DISTANCE_UNITS)}')
    reasons = [reason_against_dbm(cells[name]) for name in POWERS if name in cells]
    if why := next(filter(None, reasons), ""):
        lines.append(f'power = "{ASKED}"  # powers are {why}: write -dBm where they lack their sign')
    return lines


def _distance_units(columns: dict[str, str]) -> set[str]:
    """Return the units in the names of columns of ranges, true distances and positions."""
    ended = (_suffix(columns[name], DISTANCE_UNITS) for name in DISTANCES if name in columns)
    return {unit for unit in ended if unit}


def _time_unit(header: str, values: Floats) -> tuple[str, str]:
    if not np.isfinite(values).any():
        return "iso", "no numbers"
    if ended := _suffix(header, ("ns", "us", "ms", "s")):
        return ended, "by the column's name"
    largest = float(np.nanmax(np.abs(values)))
    for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)):
        if largest > least:
            return unit, f"{largest:.3g} would be no date in seconds"
    if len(values) < MIN_ROWS or not np.array_equal(values, np.rint(values), equal_nan=True):
        return "s", f"numbers up to {largest:.6g}"
    return ASKED, f"whole numbers up to {largest:.6g}, of any unit: write {', '.join(TIME_UNITS)}"


def _suffix(header: str, units: Iterable[str]) -> str | None:
    """Return the unit at the end of a name such as `range_mm` or `time [ns]`, None without one."""
    last = re.split(r"[^a-z0-9]+", header.lower().strip(")] "))[-1]
    last = {"tick": "ticks", "dtu": "ticks", "sec": "s"}.get(last, last)
    return last if last in units and last != header.lower() else None
