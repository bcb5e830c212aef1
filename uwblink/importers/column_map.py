"""The TOML map of `uwblink import csv`: names and units of a table's columns.

Every key is optional; docs/importing.md explains each.

```toml
layout = "exchanges"       # or "messages", "stamps", "parts" (of an exchange), "ranges", "differences", "broadcasts"
bits = 32                  # of the counter that the stamps come from, 32 or 40
counter = "wrapped"        # or "signed", "unwrapped"
protocol = "ss"            # a protocol of uwblink.twr
delimiter = ";"
decimal = ","
within_s = 0.5             # rows of one exchange lie no further apart
line = "from: {to_id} Range: {range_m} m"   # of logs: the lines that are rows, or a name of LINES
each = "measurements"      # rows are the elements of this list of a message, or matches of this template in a line
from_name = "anchor_{to_id}_at_{gt_range_cm}.csv"   # columns from the names of files
missing = [-1, "---"]      # values of ranges, powers and skews that mean none
chip = "dw1000"            # or "dw3000", "other"
prf = 64                   # pulse repetition frequency in MHz, of powers from registers
[columns]                  # our name = "their name", or the number of the column of a table without a header
tx1 = "poll_tx_ticks"
fpp2 = {f1 = "FP_AMPL1", f2 = "FP_AMPL2", f3 = "FP_AMPL3", n = "RXPACC"}   # power from registers
[wide]                     # a column a device
range_m = "r_AN{to_id}"    # or {3 = "front", 7 = "back"}
[units]
range_m = "mm"             # of one column
stamps = "ticks"           # or "ns", "us", "s", or the length of a unit in seconds
time = "s"                 # or "ms", "us", "ns", "iso"
distance = "m"             # or "cm", "mm", "ft", "in"
power = "dBm"              # or "-dBm": without its sign
[constants]                # columns that the table does not have
from_id = 1
[ids]                      # numbers for ids that are words or too large
"AA:01" = 1
[antenna_delays]           # what was programmed into the devices; write zeros if nothing was
unit = "ticks"             # or "ns"
tx = 16436
rx = 16436
[antenna_delays.tags.7]
tx = 16400
rx = 16400
[topics."/uwb/{from_id}/range_{to_id}"]   # of bags: topics to read, or a template of them, and constants for each
fpp2 = -80
```
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from uwblink.errors import ImportTableError
from uwblink.importers.devices import CHIPS, LINES, REGISTERS
from uwblink.importers.templates import Template, is_template, places
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.antenna_delays import AntennaDelays, read_antenna_delays
from uwblink.recording.schema import POSE, is_id
from uwblink.text_files import FileKey, TomlReader, heads, is_number
from uwblink.ticks import METRES_PER_TICK, TICKS_PER_SECOND
from uwblink.twr import BITS, LARGEST_ID, STAMPS

POSITIONS: Final = tuple(f"{end}_{axis}_m" for end in ("from", "to") for axis in "xyz")
DISTANCES: Final = ("range_m", "gt_range_m", "difference_m", *POSITIONS)
TEMPERATURES: Final = ("from_temperature_c", "to_temperature_c")
IDS: Final = {"from_id": "the initiator of each exchange", "to_id": "its target"}
ALL_IDS: Final = IDS | {"at_id": "the tag at which a difference of arrival was measured"}
SIGN: Final = "a difference is the distance from at_id to to_id minus that to from_id"
"""Explanation of the order of the ids of a difference of arrival."""

ASKED: Final = "?"
"""Placeholder of `uwblink import guess` for a value that the user must give."""

NAMES: Final = (
    "time_s", *ALL_IDS, *STAMPS, "fpp1", "fpp2", "skew1", "skew2", "rxp1", "rxp2", "sts1", "sts2", *DISTANCES,
    *TEMPERATURES,
    "sequence", "message", "tx", "rx", "fpp", "rxp", "skew", "sts", "stamp", "event", "heard",
)  # fmt: skip
"""The columns of tables; `event` has words for a stamp of transmission or of reception."""

STAMP_UNITS: Final = {
    "ticks": 1.0,
    "ps": TICKS_PER_SECOND * 1e-12,
    "ns": TICKS_PER_SECOND * 1e-9,
    "us": TICKS_PER_SECOND * 1e-6,
    "s": float(TICKS_PER_SECOND),
}
TIME_UNITS: Final = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
DISTANCE_UNITS: Final = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048, "in": 0.0254}
FLIGHT_UNITS: Final = {unit: STAMP_UNITS[unit] * METRES_PER_TICK for unit in STAMP_UNITS}
"""Units of times of flight, which are ranges, too."""
POWERS: Final = ("fpp1", "fpp2", "rxp1", "rxp2", "fpp", "rxp")
SKEWS: Final = ("skew1", "skew2", "skew")
KINDS: Final = (
    dict.fromkeys(NAMES, "number")
    | {"time_s": "time", "message": "message", "event": "event"}
    | dict.fromkeys(ALL_IDS, "id")
    | dict.fromkeys((*STAMPS, "tx", "rx", "stamp"), "stamps")
    | dict.fromkeys(DISTANCES, "distance")
    | dict.fromkeys(POWERS, "power")
    | dict.fromkeys(SKEWS, "skew")
)
"""The kind of each column; columns with units have the name of their key in `units`."""

UNITS_BY_KEY: Final[dict[str, Mapping[str, float]]] = (
    {"stamps": STAMP_UNITS, "time": TIME_UNITS | {"iso": 1.0}, "skew": CHIPS["other"].skew_ppm}
    | dict.fromkeys(("distance", *DISTANCES), DISTANCE_UNITS)
    | dict.fromkeys(("range_m", "difference_m"), DISTANCE_UNITS | FLIGHT_UNITS)
    | {name: {"dBm": 1.0, "-dBm": -1.0} for name in ("power", *POWERS)}
)
"""Units by key of `units`, for a kind of columns or one column: the value of a unit in ticks, ns, m, dBm or ppm."""
MAP_KEYS: Final = (
    FileKey(
        "layout",
        '"exchanges", "messages", "stamps", "parts", "ranges", "differences" or "broadcasts"',
        "by the columns; parts and broadcasts must be stated",
        "Meaning of a row: an exchange; a message; a stamp with `message`, as devices log their own; a part of an "
        "exchange, for example if both devices report; a range without stamps; a difference of arrival without "
        "stamps (distance from at_id to to_id minus that to from_id); or a reception in a broadcast: the broadcast "
        "(sequence, tx) of from_id contains when (rx) it received an earlier one (heard) of to_id.",
    ),
    FileKey("bits", "32 or 40", "32 if the stamps fit, else 40", "Width of the counter of the stamps, in bits."),
    FileKey(
        "counter",
        '"wrapped", "signed" or "unwrapped"',
        "by the numbers",
        "Stamps from 0 to 2^bits; negative in the upper half; or without wraps.",
    ),
    FileKey(
        "protocol",
        '"ss", "ss-cfo", "ds", "ds-alt", "ds-sym" or a registered one',
        "ds if there are six stamps, or ds-alt if only that makes plausible ranges; else ss",
        "The protocol of the exchanges.",
    ),
    FileKey("delimiter", "one of , ; tab | and blank", "by the first lines", "Separator of cells."),
    FileKey("decimal", '"." or ","', "by the first lines", "Decimal mark of numbers."),
    FileKey("within_s", "number, s", "1", "Longest time between rows of one exchange."),
    FileKey(
        "line",
        f"template, or one of {', '.join(LINES)}",
        "the file is a table",
        "Of logs: the lines that are rows. Places in braces are columns; `{x:hex}` and `{x:int}` take digits, `{r[8]}` "
        "is a list whose values are `r.0` to `r.7`, `{_}` and `{*}` are not used. `{json}` alone: lines that end with "
        "an object of JSON.",
    ),
    FileKey(
        "each",
        "text; a template of parts of a line",
        "a message or line is a row",
        "The list in a message, or the parts of a line, whose elements are the rows.",
    ),
    FileKey(
        "from_name",
        "template",
        "none",
        "Columns that are in the names of files, and of folders before a slash, such as "
        '"anchor_{to_id}_at_{gt_range_cm}.csv".',
    ),
    FileKey(
        "missing",
        "list of numbers and words",
        "none",
        "Values that stand for a missing range, power, skew or true distance. Rows without a range are left out.",
    ),
    FileKey(
        "chip",
        f"one of {', '.join(CHIPS)}",
        "not known",
        "The chip of the devices: powers from registers, offsets of clocks, limits of powers. Kept in the recording.",
    ),
    FileKey("prf", "16 or 64, MHz", "64", "Pulse repetition frequency, for powers from registers."),
    FileKey(
        "columns.NAME",
        "text; whole number; table of registers",
        "our name",
        "The name of the column NAME in the table, or its number, from 1, where no column has a name. A power can be "
        "made of registers: f1, f2, f3 (FP_AMPL1 to 3) and n (RXPACC), or c (CIR_PWR) and n, and d (DGC) of a DW3000.",
    ),
    FileKey(
        "wide.NAME",
        "text with one place (two of difference_m); or a table of columns by device",
        "none",
        "Families of columns, one for each device: `r_AN{to_id}` makes a row of each column, `d{from_id}-{to_id}` of "
        "each difference_m. Families are joined by what differs; "
        "`{_}` is no id. A column called mask has a bit for each device with a range.",
    ),
    FileKey(
        "units.stamps",
        '"ticks", "ps", "ns", "us", "s", or the length of a unit in seconds',
        "ticks",
        "Unit of stamps; a tick is 15.65 ps, as the DW1000 counts.",
    ),
    FileKey(
        "units.time",
        '"s", "ms", "us", "ns" or "iso"',
        "s, or iso if the column has no numbers",
        "Unit of `time_s`; iso: 2024-05-06T07:08:09.5+02:00, in UTC without a zone, or 07:08:09.",
    ),
    FileKey(
        "units.distance",
        '"m", "cm", "mm", "ft" or "in"',
        "m if the numbers can be metres; otherwise it must be stated",
        "Unit of ranges, true distances and positions.",
    ),
    FileKey(
        "units.power",
        '"dBm" or "-dBm"',
        "dBm if the numbers are negative; otherwise it must be stated",
        "Unit of powers; -dBm: written without their sign.",
    ),
    FileKey(
        "units.skew",
        '"ppm", "-ppm", "integrator-2", "integrator-5", "integrator-9", "offset" or "-offset"',
        "ppm",
        "Unit of skews: the carrier integrator on a channel, or the clock offset register of the DW3000, needs a chip. "
        "offset is positive if the receiver's clock is faster; -offset is the opposite, because sources contradict "
        "each other.",
    ),
    FileKey(
        "units.NAME",
        'as for all; for range_m and difference_m also "ticks", "ps", "ns", "us", "s"',
        "that for all",
        "Unit of one column of distances or powers; a range may be a time of flight, and a difference one of times.",
    ),
    FileKey(
        "constants.NAME", "number; text for an id", "none", "A value for all rows, for a column that the table lacks."
    ),
    FileKey(
        'ids."WORD"',
        "whole number",
        "the next free ones, in alphabetical order",
        "The number of an id, such as a word.",
    ),
    FileKey("antenna_delays.unit", '"ticks" or "ns"', "ticks", "Unit of the antenna delays below."),
    FileKey(
        "antenna_delays.tx",
        "number",
        "not known; 16436 is assumed",
        "Transmit antenna delay programmed into all devices.",
    ),
    FileKey(
        "antenna_delays.rx",
        "number",
        "not known; 16436 is assumed",
        "Receive antenna delay that was programmed into all devices; 0 if none was.",
    ),
    FileKey(
        "antenna_delays.tags.ID.tx", "number", "as all", "Transmit antenna delay that was programmed into one device."
    ),
    FileKey(
        "antenna_delays.tags.ID.rx", "number", "as all", "Receive antenna delay that was programmed into one device."
    ),
    FileKey(
        'topics."TOPIC"',
        "table of constants",
        "the only topic of the bag",
        "Of bags: a topic to read, and constants that its messages lack. Places in braces, as of `line`, match many "
        "topics and are columns.",
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnMap:
    """How to read a table; fields that are None are determined from the table.

    `units` are by column, or by kind of columns. `antenna_delays` are the programmed delays by device, in ticks.
    """

    layout: str | None = None
    bits: int | None = None
    counter: str | None = None
    protocol: str | None = None
    delimiter: str | None = None
    decimal: str | None = None
    within_s: float = 1.0
    columns: dict[str, str] = field(default_factory=dict)
    constants: dict[str, float | str] = field(default_factory=dict)
    ids: dict[str, int] = field(default_factory=dict)
    antenna_delays: AntennaDelays = field(default_factory=dict)
    each: str | None = None
    line: str | None = None
    from_name: str | None = None
    missing: tuple[float | str, ...] = ()
    chip: str | None = None
    prf: int = 64
    headerless: bool = False
    registers: dict[str, dict[str, str]] = field(default_factory=dict)
    wide: dict[str, str | dict[str, str]] = field(default_factory=dict)
    units: dict[str, Any] = field(default_factory=dict)
    topics: dict[str, dict[str, float | str]] = field(default_factory=dict)

    def header(self, name: str) -> str:
        """Return the table's name of a column of `NAMES`."""
        return self.columns.get(name, name)

    def unit_of(self, name: str) -> Any:
        """Return the unit of a column of `NAMES`; None if the map does not state it."""
        return self.units.get(name, "dBm" if name in self.registers else self.units.get(KINDS[name]))

    def factor(self, name: str) -> float:
        """Return the factor that converts a column of `NAMES` to ticks, m, dBm or ppm."""
        known = UNITS_BY_KEY | {"skew": CHIPS[self.chip or "other"].skew_ppm}
        units, unit = known.get(name, known.get(KINDS[name], {})), self.unit_of(name)
        return unit * TICKS_PER_SECOND if is_number(unit) else units.get(unit, 1.0)


JSON_LINE: Final = "{json}"
"""The `line` of logs whose lines end with an object of JSON."""


def load_map(path: Path) -> ColumnMap:
    """Read a map; raises `ImportTableError` that names the key."""
    file = TomlReader(path, ImportTableError, "map")
    table = file.table
    file.known(table, heads(MAP_KEYS))
    for name in ("line", "each", "from_name"):
        file.check(name, table.get(name), isinstance(table.get(name, ""), str) and table.get(name) != ASKED, "text")
    if known := LINES.get(table.get("line", "")):
        file.table = table = known | table | {"line": known["line"]}
    columns, units, constants, ids, wide = (file.section(n) for n in ("columns", "units", "constants", "ids", "wide"))
    file.known(
        columns, (*NAMES, "body", *POSE), "columns."
    )  # the last names are columns of poses, for `uwblink poses --map`
    file.known(wide, NAMES, "wide.")
    templates = [
        name for name in ("line", "from_name", "each") if name in table and (name != "each" or "line" in table)
    ]
    for name in templates:
        file.check(
            name, table[name], is_template(table[name]), "text with different places such as {range_m} or {r[8]}"
        )
    for text in (*(table[name] for name in templates), *file.section("topics")):
        for place in places(Template(text)):
            _place(place, columns, units)
    file.known(units, UNITS_BY_KEY, "units.")
    chip = file.choice("chip", table.get("chip"), (None, *CHIPS))
    _check_columns(file, columns, wide, chip)
    _check_values(file, ids)
    registers = {name: value for name, value in columns.items() if isinstance(value, dict)}
    allowed = UNITS_BY_KEY | {"skew": CHIPS[chip or "other"].skew_ppm}
    for name, unit in units.items():
        if name != "stamps" or not is_number(unit) or unit <= 0:  # the length of a unit of stamps in seconds
            file.choice(f"units.{name}", unit, allowed[name])
    return ColumnMap(
        layout=file.choice(
            "layout",
            table.get("layout"),
            (None, "exchanges", "messages", "stamps", "parts", "ranges", "differences", "broadcasts"),
        ),
        bits=file.choice("bits", table.get("bits"), (None, *BITS)),
        counter=file.choice("counter", table.get("counter"), (None, "wrapped", "signed", "unwrapped")),
        protocol=file.choice("protocol", table.get("protocol"), (None, *PROTOCOLS)),
        delimiter=file.choice("delimiter", table.get("delimiter"), (None, ",", ";", "\t", "|", " ")),
        decimal=file.choice("decimal", table.get("decimal"), (None, ".", ",")),
        within_s=float(table.get("within_s", 1.0)),
        columns={name: str(value) for name, value in columns.items() if name not in registers},
        constants={name: v if isinstance(v, str) else float(v) for name, v in constants.items()},
        ids=ids,
        antenna_delays=read_antenna_delays(file, {name: STAMP_UNITS[name] for name in ("ticks", "ns")}),
        each=table.get("each"),
        line=table.get("line"),
        from_name=table.get("from_name"),
        missing=tuple(table.get("missing", [])),
        chip=chip,
        prf=file.choice("prf", table.get("prf", 64), (16, 64)),
        headerless=any(type(value) is int for value in columns.values()),
        registers=registers,
        wide=wide,
        units=units,
        topics=file.section("topics"),
    )


def _check_columns(file: TomlReader, columns: dict[str, Any], wide: dict[str, Any], chip: str | None) -> None:
    """Raise the file's error for invalid names of columns, registers and families."""
    registers = {name: value for name, value in columns.items() if isinstance(value, dict)}
    for name, value in registers.items():
        file.known(value, REGISTERS, f"columns.{name}.")
        whole = {"n"} < value.keys() and (value.keys() >= {"f1", "f2", "f3"}) != ("c" in value)
        whole &= name in POWERS and all(isinstance(one, str) for one in value.values())
        file.check(f"columns.{name}", value, whole, "columns of f1, f2, f3 and n, or of c and n, for a power")
        file.check("chip", chip, bool(CHIPS[chip or "other"].offset_db), 'a chip whose registers are known: "dw1000"')
    numbered = {type(value) is int for value in columns.values() if not isinstance(value, dict)}
    for name, value in columns.items():
        one = (isinstance(value, str) and value != ASKED) or name in registers or (type(value) is int and value > 0)
        file.check(
            f"columns.{name}", value, one and len(numbered) < 2, "the name of a column, or for all their numbers"
        )
    for name, value in wide.items():
        by_device = isinstance(value, dict) and value and all(isinstance(one, str) for one in value.values())
        most = 2 if name == "difference_m" else 1
        is_family = isinstance(value, str) and is_template(value) and 0 < len(re.findall(r"\{\w+\}", value)) <= most
        file.check(f"wide.{name}", value, by_device or is_family, "a name with one place, such as r_AN{to_id}")


def _check_values(file: TomlReader, ids: dict[str, Any]) -> None:
    """Raise the file's error for invalid markers of missing values, constants, topics and numbers of ids."""
    missing, within = file.table.get("missing", []), file.table.get("within_s", 1.0)
    listed = isinstance(missing, list) and all(
        is_number(one) or (isinstance(one, str) and one != ASKED) for one in missing
    )
    file.check("missing", missing, listed, "a list of numbers and words")
    _constants(file, "constants", file.section("constants"))
    for topic, values in file.section("topics").items():
        file.check(f"topics.{topic}", values, isinstance(values, dict), "a table of constants, which may be empty")
        _constants(file, f"topics.{topic}", values)
    for name, value in ids.items():
        file.check(f"ids.{name}", value, is_id(value), f"a whole number from 0 to {LARGEST_ID}")
    file.check("within_s", within, is_number(within) and within > 0, "seconds")


def _place(place: str, columns: dict[str, Any], units: dict[str, Any]) -> None:
    """Return the column of a place such as `gt_range_cm`, and its unit."""
    stem, _, unit = place.rpartition("_")
    for name in ("time_s", *DISTANCES):
        if stem == name.rpartition("_")[0] and unit in UNITS_BY_KEY[name if name in UNITS_BY_KEY else "time"]:
            columns.setdefault(name, place)
            if place == name and "distance" in units:
                continue  # our own name, whose unit is stated
            units.setdefault(name if name != "time_s" else "time", unit)


def _constants(file: TomlReader, where: str, values: dict[str, Any]) -> None:
    file.known(values, NAMES, f"{where}.")
    for name, value in values.items():
        is_word = name in ALL_IDS and isinstance(value, str) and value != ASKED
        of_id = f"{ALL_IDS.get(name)}: a number or a word; or name its column in [columns]"
        expected = of_id if name in ALL_IDS else "a finite number"
        expected += ", degrees Celsius from -65 to 150" if name in TEMPERATURES else ""
        good = is_number(value) and (name not in TEMPERATURES or -65 <= value <= 150)
        file.check(f"{where}.{name}", value, good or is_word, expected)
