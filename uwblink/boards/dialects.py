"""Boards of other firmware, which print ranges as lines of text: dialects, and their ranges as they arrive.

A dialect is a function from lines to ranges. The project's dialects are the forms of logs of `uwblink import guess`
(`uwblink.importers.devices`); they are read like logs, with the same column map, templates and SQL.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import chain, product
from pathlib import Path
from typing import Any, Final

from uwblink.boards.listeners import Heard, Listener, Pair, Progress, Turn, as_listeners
from uwblink.boards.ports import Ports, SerialPorts, Transport
from uwblink.boards.record import RecordingWriter
from uwblink.database import connect
from uwblink.errors import ArgumentError, BoardError, PlanError
from uwblink.importers.column_map import ColumnMap, load_map
from uwblink.importers.devices import LINES
from uwblink.importers.staging import numbers_of, staged_cells
from uwblink.importers.tables import SourceTable
from uwblink.output import check_output
from uwblink.plugins import Registry, check_row, is_text
from uwblink.recording.file import Recording
from uwblink.recording.schema import Tag
from uwblink.twr import LARGEST_ID, STAMPS
from uwblink.wire.messages import RangeReport


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintedRange:
    """A range in metres as printed by a board. Ids are numbers or words; without `from_id` it is the board itself.

    `power_dbm` is the first-path power, or the received power if a board prints only this.
    """

    to_id: int | str
    range_m: float
    from_id: int | str | None = None
    power_dbm: float = math.nan


@dataclass(frozen=True, slots=True)
class Dialect:
    """The text format of a firmware: `parse` returns the ranges in some lines, and ignores other lines.

    `start` is sent to a board once its port is open, so that it begins to print; `baud_rate` is the rate of the port.
    """

    name: str
    help: str
    parse: Callable[[Sequence[str]], Iterable[PrintedRange]]
    start: bytes = b""
    baud_rate: int = 115_200


def parser_of(known: ColumnMap) -> Callable[[Sequence[str]], list[PrintedRange]]:
    """Return the parser of lines by a column map with a `line`; lines have the same meaning as in an imported log.

    It raises `ImportTableError` for a map without the second device of ranges.
    """

    @cache
    def prepared() -> tuple[SourceTable, dict[str, str], str]:
        table = SourceTable(connect(threads=1), Path("lines"), known, live=True)
        cells = {"from_id": "''"} | staged_cells(table)
        if "range_m" not in cells:
            raise table.missing("range_m")
        power = next((cells[name] for name in ("fpp2", "rxp2", "fpp1", "rxp1") if name in cells), "NULL")
        found = {name: cells[name] for name in ("from_id", "to_id", "range_m")}
        # Boards print 0 for an absent device.
        kept = f"WHERE {cells['range_m']} > 0 AND {cells['to_id']} <> '' AND NOT {cells['blank']}"
        return table, found | {"power_dbm": f"coalesce({power}, 'nan'::DOUBLE)"}, kept

    def parse(lines: Sequence[str]) -> list[PrintedRange]:
        table, cells, kept = prepared()
        table.db.execute("SET VARIABLE lines = ?", [list(lines)])
        rows = zip(*(column.tolist() for column in table.read(cells, kept).values()), strict=True)
        return [
            PrintedRange(from_id=number(one) if one else None, to_id=number(other), range_m=far, power_dbm=power)
            for one, other, far, power in rows
        ]

    def number(text: str) -> int | str:
        return (numbers_of([text]) | known.ids).get(text, text)

    return parse


# Two carriage returns open the shell of the DWM1001; `lec` prints distances as comma-separated lines.
_START: Final = {"dwm1001-lec": b"\r\rlec\r", "dwm1001-les": b"\r\rles\r"}

DIALECTS: Final[Registry[Dialect]] = Registry(
    "dialect",
    "uwbcal.dialects",
    tuple(
        Dialect(name, form["line"], parser_of(ColumnMap(**form)), _START.get(name, b"")) for name, form in LINES.items()
    ),
    partial(
        check_row,
        "dialect",
        Dialect,
        {
            "help": (is_text, "a line of text"),
            "parse": (callable, "a function from lines to ranges"),
            "start": (lambda found: isinstance(found, bytes), "bytes"),
        },
    ),
)
"""Dialects by name: the project's, and those of installed distributions."""


def dialect_of(name: str) -> Dialect:
    """Return a dialect by its name, or by the path of a column map with a `line` (.toml), as logs are imported.

    Raises `ArgumentError` for another name, and what `load_map` raises.
    """
    if name.endswith(".toml"):
        known = load_map(Path(name))
        if known.line is None:
            raise ArgumentError(f"{name}: has no key line, the template of a printed line", parameter="dialect")
        parse = parser_of(known)
        parse([])  # for the errors of the map
        return Dialect("lines", "a template", parse)
    if name not in DIALECTS:
        raise ArgumentError(
            f"found {name!r:.60}, allowed: {', '.join(DIALECTS)}, or a map (.toml)", parameter="dialect"
        )
    return DIALECTS[name]


@dataclass(slots=True, kw_only=True)
class Printed(Progress):
    """Counts of printed ranges, and the numbers of devices by their printed names."""

    lines: int = 0
    numbers: dict[int | str, int] = field(default_factory=dict)

    def number(self, name: int | str) -> int:
        """Return the number of a device; a word gets the first free number. Raises `BoardError` if two devices have one
        number.
        """
        if name not in self.numbers:
            taken = set(self.numbers.values())
            free = name if isinstance(name, int) else next(k for k in range(1, LARGEST_ID + 1) if k not in taken)
            if free in taken:
                raise BoardError(
                    f"device {free} has the number that was given to a device whose id is a word; change its id"
                )
            self.numbers[name] = free
        return self.numbers[name]

    def on_turn(self, turn: Turn) -> None:
        """Count a range; boards print nothing for failed exchanges, so their share is unknown."""
        Progress.on_turn(self, turn)
        self.pairs[turn.pair].tried = 0

    def __str__(self) -> str:
        """Return the counts in words."""
        return f"{self.exchanges} ranges of {len(self.numbers)} devices in {self.lines} lines, {self.time_s:.1f} s"


def printed_ranges(
    ports: Iterable[str],
    dialect: Dialect,
    *,
    ids: Sequence[int] = (),
    duration_s: float = math.inf,
    stop: Callable[[], bool] = lambda: False,
    using: Ports | None = None,
    seen: Printed | None = None,
) -> Iterator[list[Turn]]:
    """Yield printed ranges as turns, with reports without stamps; None if nothing arrives for a while.

    Their time is the host's. `ids` are the ids of the boards at `ports`, for lines without an initiator; 1, 2 ... by
    default. `seen` counts the ranges. Raises the errors of opening ports, `BoardError` if a board prints lines without
    ranges, and `PlanError` for ids that do not fit the ports.
    """
    names, using, seen = list(ports), using or SerialPorts(dialect.baud_rate), seen or Printed()
    own = list(ids) or list(range(1, len(names) + 1))
    if len(own) != len(names) or len(set(own)) < len(own):
        raise PlanError(f"{len(names)} ports, but {len(own)} ids of boards; give each port its own id")
    seen.numbers |= {one: one for one in own}
    with ExitStack() as stack:
        boards: dict[Transport, tuple[int, _Lines]] = {}
        for name, board in zip(names, own, strict=True):
            port = using.open(name)
            stack.callback(port.close)
            boards[port] = board, _Lines(name)
        for port in boards if dialect.start else ():
            port.write(dialect.start)
        start_s, seen.start_ns = using.now_s(), using.host_ns()
        while not stop() and seen.time_s < duration_s:
            turns = []
            for port in using.wait([*boards], min(0.1, duration_s - seen.time_s)):
                board, lines = boards[port]
                came = lines.feed(port.read(0.0))
                found = list(dialect.parse(came)) if came else []
                lines.note(came, found)
                seen.lines += len(came)
                for printed in found:
                    whose = board if printed.from_id is None else printed.from_id
                    pair = seen.number(whose), seen.number(printed.to_id)
                    report = replace(_REPORT, neighbour=pair[1], range_m=printed.range_m, fpp2_dbm=printed.power_dbm)
                    turns += [Turn(using.host_ns(), pair, report)] if pair[0] != pair[1] else []
                    if pair[0] == pair[1] and printed.from_id is None:
                        raise BoardError(
                            f"{port.name}: prints a range to {pair[1]}, its own id; give it another by `ids`"
                        )
            seen.time_s = using.now_s() - start_s
            for turn in turns:
                seen.on_turn(turn)
            yield turns


_REPORT: Final = RangeReport(
    neighbour=0, range_m=math.nan, fpp1_dbm=math.nan, fpp2_dbm=math.nan, skew1_ppm=math.nan, skew2_ppm=math.nan,
    **dict.fromkeys(STAMPS, 0),
)  # fmt: skip
"""A report with default values for fields that boards with printed ranges do not send."""


class _Lines:
    """The lines of one board."""

    def __init__(self, name: str) -> None:
        self.name, self._rest, self._others, self._good = name, b"", 0, False

    def feed(self, data: bytes) -> list[str]:
        """Add bytes; return the lines that are complete."""
        *lines, self._rest = re.split(rb"[\r\n]+", self._rest + data)
        self._rest = self._rest[-4096:]  # of a line without an end; a list of 64 ranges takes half of that
        return [line.decode("latin-1") for line in lines if line.strip()]

    def note(self, lines: Sequence[str], found: Sequence[PrintedRange]) -> None:
        """Note lines and their ranges; raises `BoardError` if the board prints another form."""
        self._good, self._others = self._good or bool(found), self._others + len(lines)
        # Banners and menus are shorter (a judgement).
        if not self._good and self._others > 50:
            raise BoardError(
                f"{self.name}: no range in {self._others} lines, the last is {lines[-1]!r:.80}; name another dialect, "
                "or a template of lines"
            )


def record_printed(
    ports: Iterable[str],
    output: str | os.PathLike[str],
    dialect: Dialect,
    *,
    force: bool = False,
    watch: Callable[[Progress], None] = lambda _: None,
    listeners: Iterable[Listener | Callable[[Heard], object]] = (),
    **how: Any,
) -> Printed:
    """Record ranges that boards print until `stop` returns true or the time is over; returns the counts.

    `how` are other parameters of `printed_ranges`, whose errors are raised; no file remains if no range was printed.
    `watch` and `listeners` are as in `uwblink.record`, and `KeyboardInterrupt` ends a recording like `stop`.
    """
    path, seen, others = Path(output), Printed(), as_listeners(listeners)
    check_output(path, force=force, recording=True)
    batches = printed_ranges(ports, dialect, seen=seen, **how)
    first = next(filter(None, batches), None)
    if first is None:
        raise BoardError(f"no range was printed ({seen}); nothing is recorded")
    meta = {"source": "record", "dialect": dialect.name, "notes": ["ranges without stamps, as the boards print them"]}
    with Recording.create(path, meta=meta, force=force, live=True) as recording:
        try:
            with suppress(KeyboardInterrupt), RecordingWriter(recording) as writer:
                begun, watched_s = set[Pair](), -1.0
                for turns in chain([first], batches):
                    for listener in others:
                        listener.on_start(sorted({turn.pair for turn in turns} - begun))
                    begun |= {turn.pair for turn in turns}
                    for listener, turn in product([writer, *others], turns):
                        if turn.report is not None:
                            listener.on_message(Heard(turn.time_ns, turn.pair[0], turn.report))
                        listener.on_turn(turn)
                    writer.check()
                    if seen.time_s - watched_s > 0.25:
                        watched_s = seen.time_s
                        watch(seen)
        finally:
            names = {number: name if isinstance(name, str) else f"tag{name}" for name, number in seen.numbers.items()}
            recording.append("tags", [Tag(number, names[number], (0.0, 0.0, 0.0)) for number in sorted(names)])
    return seen
