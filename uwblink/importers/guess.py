"""What a table might mean: a map that it would be read with, and the reason for each line of it.

Columns are recognised by their names; units by the ends of the names, by the size of the numbers, and by which of them
makes plausible ranges of the stamps; the protocol by trying all.
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
    EVENT,
    IDS,
    ISO,
    LAYOUTS,
    POWERS,
    STAMP_UNITS,
    TIME_UNITS,
)
from uwblink.importers.guess_columns import OF_MESSAGES, named_columns, placed, stamp_and_event
from uwblink.importers.stamps import how_counted, stamps_of
from uwblink.importers.table import Table
from uwblink.importers.trials import CLEARLY, GOOD_ENOUGH, SAMPLE, Reading, Sample, Trial
from uwblink.importers.units import ENOUGH_ROWS, doubted_dbm, doubted_metres
from uwblink.protocols.table import PROTOCOLS
from uwblink.twr import STAMPS

FULL: Final = 0.9
"""Share of a counter that some of 22 stamps pass in nine tables of ten, if they are ticks of it."""

_ANY_UNIT: Final = f"of any unit: write {', '.join(STAMP_UNITS)}"

RECORDING: Final = ".uwb"


@dataclass(frozen=True, slots=True)
class Guess:
    """A map as TOML text with its reasons as comments, and whether it is enough to import the table.

    `asked` are keys that the table does not tell: the map says "?" there, which somebody who knows must replace.
    """

    text: str
    complete: bool
    asked: tuple[str, ...] = ()


def guess_map(path: Path) -> Guess:
    """Look at a table and return the map that it would be read with; raises `ImportTableError`."""
    if path.suffix.lower() == RECORDING:
        raise ImportTableError(f"{path}: is a recording already, and needs no map; 'uwblink show' says what it holds")
    with Table(path) as table:
        columns = named_columns(table.names)
        columns = stamp_and_event(table, columns) or columns
        numbers = table.read(numbers=[header for name, header in columns.items() if name != EVENT])[0]
    cells = {name: numbers[header][:100_000] for name, header in columns.items() if name != EVENT}
    if not len(next(iter(cells.values()), np.empty(0))):
        raise ImportTableError(f"{path}: no column whose name is known, or no rows; there are {', '.join(table.names)}")
    layout = "stamps" if EVENT in columns else _layout(cells)
    if layout == "messages" and _only_words(cells, "message") and columns["message"] != "message":
        del columns["message"], cells["message"]  # without a column of that name messages are told by their order
    columns, cells, unplaced = placed(columns, cells)
    delays: list[str] = []
    top = [f'layout = "{layout}"  # {_WHY[layout]}' if layout in LAYOUTS else f"# {_WHY[layout]}"]
    units = _unit_lines(columns, cells)
    if layout in ("exchanges", "messages", "stamps"):
        stamps, unit, delays = _stamp_lines(columns, cells, layout)
        top, units = top + stamps, unit + units
    named = [f"{name} = {json.dumps(header)}" for name, header in columns.items() if _belongs(name, layout)]
    missing = [name for name in IDS if name not in columns]
    constants = [
        f'{name} = "{ASKED}"  # no column is seen to name {IDS[name]}: write a number or a word for all rows, or the '
        "column above"
        for name in missing
    ]
    asked = [*missing, *(line.split()[0] for line in [*top, *units] if f'= "{ASKED}"' in line)]
    left = [name for name in table.names if name not in columns.values()]
    # Names are a stranger's, and a line break in one would end the comment.
    lines = [
        f"# {json.dumps(path.name)}, as it would be read; every line can be changed",
        *top,
        "",
        "[columns]",
        *named,
    ]
    lines += ["", "[units]", *units] if units else []
    lines += ["", "[constants]", *constants] if constants else []
    lines += ["", f"# {unplaced}"] if unplaced else []
    lines += ["", f"# not used: {', '.join(map(json.dumps, left))[:300]}"] if left else []
    lacking = [name for name in _NEEDED[layout] if name not in cells or _only_words(cells, name)]
    lacking += ["message"] if layout == "messages" and _only_words(cells, "message") else []
    lines += [f"# a column of numbers is still needed: {', '.join(lacking)}"] if lacking else []
    mixed = _distance_units(columns)
    lines += [f"# distances have one unit for all, here they have {', '.join(sorted(mixed))}: convert some"] * (
        len(mixed) > 1
    )
    lines += delays or ["# what was programmed into the devices is not in the table: [antenna_delays] says it"]
    return Guess("\n".join(lines) + "\n", layout != "nothing" and not lacking and len(mixed) < 2, tuple(asked))


_NEEDED: Final = {
    "exchanges": STAMPS[:4],
    "messages": ("tx", "rx"),
    "stamps": ("message",),
    "ranges": ("range_m",),
    "nothing": (),
}
_WHY: Final = {
    "exchanges": "a row has the stamps of a whole exchange",
    "messages": "a row has one stamp of a sender and one of a receiver",
    "stamps": "a row has one stamp, and says whether it is of sending or of receiving",
    "ranges": "there are ranges and no stamps",
    "nothing": "neither stamps nor ranges were recognised: rename columns below",
}


def _only_words(cells: dict[str, Floats], name: str) -> bool:
    return name in cells and not np.isfinite(cells[name]).any()


def _layout(cells: dict[str, Floats]) -> str:
    if all(name in cells for name in STAMPS[:4]):
        return "exchanges"
    if "tx" in cells and "rx" in cells:
        return "messages"
    return "ranges" if "range_m" in cells else "nothing"


def _belongs(name: str, layout: str) -> bool:
    if layout in ("messages", "stamps"):
        return name not in (*STAMPS, "fpp1", "fpp2", "rxp1", "rxp2", "skew1", "skew2")
    return name not in OF_MESSAGES and not (layout == "ranges" and name in STAMPS)


def _stamp_lines(
    columns: dict[str, str], cells: dict[str, Floats], layout: str
) -> tuple[list[str], list[str], list[str]]:
    """Return lines of the map on protocol and counter, the unit of stamps, and antenna delays, with their reasons."""
    names = [name for name in (STAMPS if layout == "exchanges" else ("tx", "rx", "stamp")) if name in cells]
    stamps: dict[str, Floats] = {name: cells[name] for name in names}
    whole = all(np.array_equal(column, np.rint(column), equal_nan=True) for column in stamps.values())
    ended = {_suffix(columns[name], STAMP_UNITS) for name in names}
    if layout != "exchanges":
        named = next(iter(ended - {None}), None)
        bits, counter = how_counted({n: c * STAMP_UNITS[named or "ticks"] for n, c in stamps.items()}, None, None)
        largest = max(float(np.nanmax(column, initial=0.0)) for column in stamps.values())
        full = whole and FULL * 2.0**bits < largest < 2.0**bits
        unit = named or ("ticks" if full else ASKED)
        why = "by the columns' names" if named else f"whole numbers up to 2^{bits}" if full else _ANY_UNIT
        return [f"bits = {bits}", f'counter = "{counter}"'], [f'stamps = "{unit}"  # {why}'], []
    units = [u for u in ended if u] or (["ticks", "ns", "us", "s", "ps"] if whole else ["ns", "us", "s", "ps", "ticks"])
    metres = DISTANCE_UNITS[min(_distance_units(columns), default="m")]
    trials = [trial for unit in units for trial in _trials(stamps, cells, unit, metres)]
    unit, counter, best = max(trials, key=lambda found: round(found[2].plausible, 2))
    sure, known = best.plausible >= CLEARLY, best.plausible >= GOOD_ENOUGH
    share = f"{100 * best.plausible:.0f} % of its ranges are plausible, {best.low_m:.3g} to {best.high_m:.3g} m"
    lines = [
        f'protocol = "{best.reading.protocol if known else ASKED}"  # {share}'
        + ("" if sure else "; check columns and units"),
        f"bits = {best.reading.bits}  # the stamps fit",
        f'counter = "{counter}"',
    ]
    why = "by the columns' names" if ended - {None} else "whole numbers" if whole else "as ranges are plausible"
    delays = ["[antenna_delays]  # by the true distances nothing was programmed into the devices", "tx = 0", "rx = 0"]
    if not known and not ended - {None}:
        unit, why = ASKED, _ANY_UNIT
    return lines, [f'stamps = "{unit}"  # {why}'], ["", *delays] if best.reading.undelayed else []


def _trials(
    stamps: dict[str, Floats], cells: dict[str, Floats], unit: str, metres: float
) -> list[tuple[str, str, Trial]]:
    chosen = np.flatnonzero(np.all([np.isfinite(column) for column in stamps.values()], axis=0))[:SAMPLE]
    if not len(chosen):
        raise ImportTableError("its stamps are no numbers in any row")
    sampled = {name: column[chosen] for name, column in stamps.items()}
    bits, counter = how_counted({n: c * STAMP_UNITS[unit] for n, c in sampled.items()}, None, None)
    truth = cells["gt_range_m"][chosen] * metres if "gt_range_m" in cells else np.full(len(chosen), np.nan)
    nothing = np.zeros(len(chosen))
    sample = Sample(
        sampled, np.zeros(len(chosen), dtype=np.int64), truth, np.full(len(chosen), np.nan), nothing, STAMP_UNITS[unit]
    )
    names = [row.name for row in PROTOCOLS.known() if set(stamps_of(row.name)) == set(stamps)]
    names = [name for name in names if name not in ("ss-cfo", "ds-sym")] or ["ss"]
    readings = [Reading(name, bits) for name in names]
    if np.isfinite(truth).any():
        readings += [replace(reading, undelayed=True) for reading in readings]
    return [(unit, counter, sample.attempt(reading)) for reading in readings]


def _unit_lines(columns: dict[str, str], cells: dict[str, Floats]) -> list[str]:
    lines = []
    if "time_s" in columns:
        unit, why = _time_unit(columns["time_s"], cells["time_s"])
        lines.append(f'time = "{unit}"  # {why}')
    units = _distance_units(columns)
    if len(units) == 1:
        lines += [f'distance = "{unit}"  # by the columns\' names' for unit in units]
    elif not units and "range_m" in cells and (why := doubted_metres(cells["range_m"])):
        lines.append(f'distance = "{ASKED}"  # ranges are {why}: write {", ".join(DISTANCE_UNITS)}')
    doubts = [doubted_dbm(cells[name]) for name in POWERS if name in cells]
    if why := next(filter(None, doubts), ""):
        lines.append(f'power = "{ASKED}"  # powers are {why}: write -dBm where they lack their sign')
    return lines


def _distance_units(columns: dict[str, str]) -> set[str]:
    """Return the units that columns of ranges, true distances and positions are called after."""
    ended = (_suffix(columns[name], DISTANCE_UNITS) for name in DISTANCES if name in columns)
    return {unit for unit in ended if unit}


def _time_unit(header: str, values: Floats) -> tuple[str, str]:
    if not np.isfinite(values).any():
        return ISO, "no numbers"
    ended = _suffix(header, ("ns", "us", "ms", "s"))
    if ended:
        return ended, "by the column's name"
    largest = float(np.nanmax(np.abs(values)))
    for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)):
        if largest > least:
            return unit, f"{largest:.3g} would be no date in seconds"
    if len(values) < ENOUGH_ROWS or not np.array_equal(values, np.rint(values), equal_nan=True):
        return "s", f"numbers up to {largest:.6g}"
    return ASKED, f"whole numbers up to {largest:.6g}, of any unit: write {', '.join(TIME_UNITS)}"


def _suffix(header: str, units: Iterable[str]) -> str | None:
    """Return the unit that a name ends with, as in `range_mm` or `time [ns]`."""
    last = re.split(r"[^a-z0-9]+", header.lower().strip(")] "))[-1]
    last = {"tick": "ticks", "dtu": "ticks", "sec": "s"}.get(last, last)
    return last if last in units and last != header.lower() else None
