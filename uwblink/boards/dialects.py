"""Boards of other firmware, which print ranges as lines of text: dialects, and their ranges as they arrive.

A dialect is a function from a line to ranges. The project's own are the forms of logs that `uwblink import guess` knows
(`uwblink.importers.lines`), read by the same templates.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from uwblink.boards.ports import Ports, SerialPorts, Transport
from uwblink.errors import ArgumentError, BoardError, PlanError
from uwblink.importers.column_map import IDS, NAMES, RANGE_UNITS, ColumnMap, load_map
from uwblink.importers.lines import LINES
from uwblink.importers.templates import Template
from uwblink.output import check_output
from uwblink.plugins import Registry, check_row, is_text
from uwblink.recording.file import Recording
from uwblink.recording.schema import Tag
from uwblink.twr import LARGEST_ID, Exchanges

MAX_PRINTED_BYTES: Final = 4096
"""Bytes after which a line without an end is dropped; a list of 64 ranges takes half of that."""

PATIENCE_LINES: Final = 50
"""Lines without a range after which a board is taken to print another form: banners and menus are shorter (a
judgement)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintedRange:
    """A range in metres as a board printed it. Ids are numbers or words; no `from_id` stands for the board itself.

    `power_dbm` is the first-path power, or the received power where a board prints no other.
    """

    to_id: int | str
    range_m: float
    from_id: int | str | None = None
    power_dbm: float = math.nan


@dataclass(frozen=True, slots=True)
class Dialect:
    """What boards of some firmware print: `parse` returns the ranges of a line, none for any other line.

    `start` is sent to a board once its port is open, so that it begins to print; `baud_rate` is that of the port.
    """

    name: str
    help: str
    parse: Callable[[str], Iterable[PrintedRange]]
    start: bytes = b""
    baud_rate: int = 115_200


def parser_of(known: ColumnMap) -> Callable[[str], list[PrintedRange]]:
    """Return the parser of lines by a column map with a `line`: they mean what they mean in an imported log.

    Raises `ArgumentError` for what only whole tables have: powers of registers, and columns by device.
    """
    if known.registers or any(not isinstance(family, str) for family in known.wide.values()):
        raise ArgumentError("powers of registers and columns by device are for tables only", parameter="dialect")
    whole, each = (Template(text) if text else None for text in (known.line, known.each))

    def parse(line: str) -> list[PrintedRange]:
        if whole is None or not (found := re.search(whole.pattern, line)):
            return []
        common = whole.values(found.groups())
        rows = [common | each.values(m.groups()) for m in re.finditer(each.pattern, line)] if each else [common]
        printed = (_printed(row, known) for one in rows for row in _unpivoted(one, known.wide))
        return [one for one in printed if one is not None]

    return parse


def _unpivoted(row: Mapping[str, str], wide: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return a row for each device of columns such as r.0, r.1 ... (r.{to_id}), of those in a mask if there is one."""
    if not wide:
        return [dict(row)]
    by_device: dict[str, dict[str, str]] = {}
    for name, family in wide.items():
        before, place, after = re.split(r"\{(\w+)\}", family)
        for column, value in row.items():
            if match := re.fullmatch(rf"{re.escape(before)}(\w+){re.escape(after)}", column):
                by_device.setdefault(match[1], {})[name] = value
                if place != "_":
                    by_device[match[1]][place] = match[1]
    mask = int(row["mask"]) if "mask" in row else -1
    return [dict(row) | own for k, own in enumerate(by_device.values()) if mask >> k & 1]


def _printed(row: Mapping[str, str], known: ColumnMap) -> PrintedRange | None:
    """Return a range from texts by column, None where there is none: boards print 0 for a device that is not there."""
    texts = {name: row[known.header(name)] for name in NAMES if known.header(name) in row}
    ids = {name: _id(str(one), known) for name in IDS if (one := known.constants.get(name, texts.get(name, "")))}
    distance = _number(texts, "range_m", known) * RANGE_UNITS[known.distance_of("range_m") or "m"]
    if not (distance > 0 and "to_id" in ids):
        return None
    power = next((name for name in ("fpp2", "rxp2") if name in texts), "fpp2")
    sign = -1.0 if known.power_of(power) == "-dBm" else 1.0
    return PrintedRange(
        to_id=ids["to_id"], range_m=distance, from_id=ids.get("from_id"), power_dbm=sign * _number(texts, power, known)
    )


def _number(texts: Mapping[str, str], name: str, known: ColumnMap) -> float:
    """Return a text as a number, NaN where it is none or means that there is none."""
    text = texts.get(name, "").strip()
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and not {text, value} & {*known.missing} else math.nan


def _id(text: str, known: ColumnMap) -> int | str:
    """Return an id as a number, by the map if it has one, or as a word."""
    if text in known.ids:
        return known.ids[text]
    number = re.fullmatch(r"([0-9]{1,9})(\.0*)?", text)
    return int(number[1]) if number and int(number[1]) <= LARGEST_ID else text


def check_dialect(row: Any) -> None:
    """Raise `ArgumentError` for a row that cannot be a dialect."""
    parse = callable, "a function from a line to ranges"
    start = lambda found: isinstance(found, bytes), "bytes"
    check_row("dialect", row, Dialect, {"help": (is_text, "a line of text"), "parse": parse, "start": start})


def _map_of(form: Mapping[str, Any]) -> ColumnMap:
    return ColumnMap(
        line=form["line"], each=form.get("each"), wide=form.get("wide", {}), distance_unit=form["units"]["distance"]
    )


# The shell of the DWM1001 opens on two carriage returns; `lec` prints distances as comma-separated lines.
_START: Final = {"dwm1001-lec": b"\r\rlec\r", "dwm1001-les": b"\r\rles\r"}

DIALECTS: Final[Registry[Dialect]] = Registry(
    "dialect",
    "uwbcal.dialects",
    tuple(Dialect(name, form["line"], parser_of(_map_of(form)), _START.get(name, b"")) for name, form in LINES.items()),
    check_dialect,
)
"""Dialects by name: the project's, and those of installed distributions."""


def dialect_of(name: str) -> Dialect:
    """Return a dialect by its name, or by the path of a column map with a `line` (.toml), as logs are imported.

    Raises `ArgumentError` for another name, and what `load_map` raises.
    """
    if name.endswith(".toml"):
        known = load_map(Path(name))
        if known.line is None:
            raise ArgumentError(f"{name}: states no line, a template of what a board prints", parameter="dialect")
        return Dialect("lines", "a template", parser_of(known))
    if name not in DIALECTS:
        known_names = ", ".join(DIALECTS)
        raise ArgumentError(f"found {name!r:.60}, allowed: {known_names}, or a map (.toml)", parameter="dialect")
    return DIALECTS[name]


@dataclass
class Printed:
    """Counts of what boards printed, and the numbers of devices by what boards call them."""

    ranges: int = 0
    lines: int = 0
    others: int = 0
    numbers: dict[int | str, int] = field(default_factory=dict)

    def number(self, name: int | str) -> int:
        """Return the number of a device; a word gets the first one that is free. Raises `BoardError` for a clash."""
        if name not in self.numbers:
            taken = set(self.numbers.values())
            free = name if isinstance(name, int) else next(k for k in range(1, LARGEST_ID + 1) if k not in taken)
            if free in taken:
                raise BoardError(f"device {free} has the number of a device whose id is a word; give it another id")
            self.numbers[name] = free
        return self.numbers[name]

    def __str__(self) -> str:
        """Return the counts in words."""
        return f"{self.ranges} ranges of {len(self.numbers)} devices in {self.lines} lines, {self.others} other lines"


def printed_ranges(
    ports: Iterable[str],
    dialect: Dialect,
    *,
    ids: Sequence[int] = (),
    duration_s: float = math.inf,
    stop: Callable[[], bool] = lambda: False,
    using: Ports | None = None,
    seen: Printed | None = None,
) -> Iterator[Exchanges]:
    """Yield ranges that boards print as exchanges without stamps (n,), at the host's time at which they arrive.

    `ids` are those of the boards at `ports`, for lines that do not say who ranged; 1, 2 ... by default. `seen` counts.
    Raises the errors of opening ports, `BoardError` where a board prints lines and no range in them, and `PlanError`
    for ids that do not fit the ports.
    """
    names, using, seen = list(ports), using or SerialPorts(dialect.baud_rate), seen or Printed()
    own = list(ids) or list(range(1, len(names) + 1))
    if len(own) != len(names) or len(set(own)) < len(own):
        raise PlanError(f"{len(names)} ports and {len(own)} ids of boards; give each port an id of its own")
    for one in own:
        seen.number(one)
    with ExitStack() as stack:
        opened: list[Transport] = []
        for name in names:
            opened.append(using.open(name))
            stack.callback(using.close, opened[-1])
        begun = {id(port): (board, _Lines(port.name)) for port, board in zip(opened, own, strict=True)}
        for port in opened:
            if dialect.start:
                port.write(dialect.start)
        until_s = using.now_s() + duration_s
        while not stop() and using.now_s() < until_s:
            rows = []
            for port in using.wait(min(0.1, until_s - using.now_s())):
                board, lines = begun[id(port)]
                for line in lines.feed(port.read(0.0)):
                    found = list(dialect.parse(line))
                    lines.note(line, found)
                    seen.lines, seen.others = seen.lines + bool(found), seen.others + (not found)
                    rows += [(board if one.from_id is None else one.from_id, one) for one in found]
            if rows:
                yield _exchanges(rows, seen, using.host_ns())


class _Lines:
    """The lines of one board."""

    def __init__(self, name: str) -> None:
        self.name, self._rest, self._others, self._good = name, b"", 0, False

    def feed(self, data: bytes) -> list[str]:
        """Take bytes; return the lines that ended in them."""
        *lines, self._rest = re.split(rb"[\r\n]+", self._rest + data)
        self._rest = self._rest[-MAX_PRINTED_BYTES:]
        return [line.decode("utf-8", "replace") for line in lines if line.strip()]

    def note(self, line: str, found: Sequence[PrintedRange]) -> None:
        """Note a line and its ranges; raises `BoardError` where the board prints another form."""
        self._good, self._others = self._good or bool(found), self._others + 1
        if not self._good and self._others > PATIENCE_LINES:
            raise BoardError(
                f"{self.name}: no range in {self._others} lines, the last is {line!r:.80}; name another dialect, or a "
                "template of lines"
            )


def _exchanges(rows: Sequence[tuple[int | str, PrintedRange]], seen: Printed, time_ns: int) -> Exchanges:
    """Return ranges of boards as exchanges."""
    ends = [(seen.number(whose), seen.number(one.to_id)) for whose, one in rows]
    kept = [k for k, (one, other) in enumerate(ends) if one != other]
    seen.ranges += len(kept)
    zero = [0] * len(kept)
    return Exchanges.from_arrays(
        [ends[k][0] for k in kept],
        [ends[k][1] for k in kept],
        **dict.fromkeys(("tx1", "rx1", "tx2", "rx2"), zero),  # type: ignore[arg-type]
        time_ns=time_ns,
        range_m=[rows[k][1].range_m for k in kept],
        fpp2_dbm=[rows[k][1].power_dbm for k in kept],
    )


def record_printed(
    ports: Iterable[str],
    output: str | os.PathLike[str],
    dialect: Dialect,
    *,
    force: bool = False,
    watch: Callable[[Printed], None] | None = None,
    **how: Any,
) -> Printed:
    """Record ranges that boards print until `stop` returns true or the time is over; returns the counts.

    `how` are other parameters of `printed_ranges`, which raises; nothing is left where no range was printed.
    `KeyboardInterrupt` ends a recording like `stop`.
    """
    path, seen = Path(output), Printed()
    check_output(path, force=force, recording=True)
    batches = printed_ranges(ports, dialect, seen=seen, **how)
    first = next(batches, None)
    if first is None:
        raise BoardError(f"no range was printed ({seen}); nothing is recorded")
    meta = {"source": "record", "dialect": dialect.name, "notes": ["ranges without stamps, as the boards print them"]}
    with Recording.create(path, meta=meta, force=force, live=True) as recording:
        recording.append_exchanges(first)
        try:
            for batch in batches:
                recording.append_exchanges(batch)
                if watch:
                    watch(seen)
        except KeyboardInterrupt:
            pass
        finally:
            names = {number: name if isinstance(name, str) else f"tag{name}" for name, number in seen.numbers.items()}
            recording.append_tags(Tag(number, names[number], (0.0, 0.0, 0.0)) for number in sorted(names))
    return seen
