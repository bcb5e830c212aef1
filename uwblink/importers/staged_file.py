"""One table of strangers that is parsed once: its columns are put aside, and read again by their rows."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import DISTANCES, EVENT, IDS, ISO, NAMES, POWERS, TIME_UNITS, ColumnMap
from uwblink.importers.ids import Numbering
from uwblink.importers.staging import Kept, Stage
from uwblink.importers.stamps import NEVER, whole
from uwblink.importers.table import EXACT, Cell, Table
from uwblink.importers.table_rows import RECEIVED, SENT, Rows
from uwblink.twr import LARGEST_ID, LATEST_NS, STAMPS

WORDS_FROM: Final = 0.01
"""Share of ids that are no numbers from which on all are taken for words; fewer are faults."""

TOO_LARGE: Final = f"NOT isnan(x) AND abs(x) >= {EXACT}"
"""Of numbers of which a float may not be what stood in the file."""

AN_ID: Final = f"x >= 0 AND x <= {LARGEST_ID} AND x = trunc(x)"

_COUNTED: Final = (*STAMPS, "tx", "rx", "stamp")

Piece = Callable[[Kept, Collection[str]], dict[str, NDArray[Any]]]
"""Reads columns of some rows of what was put aside."""


class StagedFile:
    """A table, and where its columns are: what was put aside, and what of it, by our names."""

    def __init__(self, path: Path, column_map: ColumnMap, stage: Stage, number: int) -> None:
        """Read the columns that a map names, and those that have our names; raises `ImportTableError`."""
        self.column_map = column_map
        self.table = table = Table(path, column_map.delimiter, column_map.decimal, stage=stage, number=number)
        present = [n for n in NAMES if n not in column_map.constants and column_map.header(n) in table.names]
        for name in column_map.columns:
            if name not in present and name not in column_map.constants:
                raise missing_column(table, column_map, name)
        if not present:
            raise missing_column(table, column_map, "from_id")
        self.headers = {name: column_map.header(name) for name in present}
        table.require(self.headers.values())
        self.places = {name: f"r{k}" for k, name in enumerate(self.headers)}
        self.kept = table.keep(_cells(table, self.headers, self.places))
        self.exact: dict[str, Kept] = {}
        self.words: dict[str, Kept] = {}
        self.time: Kept | None = None
        self._keep_exact()
        self._keep_words()
        self._keep_times()

    def counts(self, condition: str, names: Collection[str]) -> dict[str, int]:
        """Return in how many rows of some columns a condition on x holds."""
        if not names:
            return {}
        asked = ", ".join(f"count_if({condition.replace('x', self.places[name])})" for name in names)
        (found,) = self.kept.ask(asked)
        return {name: int(count or 0) for name, count in zip(names, found, strict=True)}

    def whole_ids(self, name: str) -> set[str]:
        """Return the different ids of a column that are numbers, as text."""
        x = self.places[name]
        rows = self.kept.ask(f"DISTINCT CASE WHEN {AN_ID.replace('x', x)} THEN {x} END")
        return {str(int(number)) for (number,) in rows if number is not None}

    def _keep_exact(self) -> None:
        """Put ticks aside that no float holds."""
        if self.column_map.ticks_per_unit != 1.0:
            return
        names = [name for name in _COUNTED if name in self.headers]
        for name, count in self.counts(TOO_LARGE, names).items():
            if count:
                self.exact[name] = self.table.keep({"r": self.table.whole_number(self.headers[name])})

    def _keep_words(self) -> None:
        names = [name for name in IDS if name in self.headers]
        for name, good in self.counts(AN_ID, names).items():
            if self.kept.count - good > WORDS_FROM * self.kept.count:
                self.words[name] = self.table.keep({"r": self.table.word(self.headers[name])})

    def _keep_times(self) -> None:
        """Put times aside that are words, or that no float holds."""
        if "time_s" not in self.headers:
            return
        header, unit = self.headers["time_s"], self.column_map.time_unit
        if unit == ISO or (unit is None and not self.counts("isfinite(x)", ["time_s"])["time_s"]):
            self.time = self.table.keep({"r": self.table.time_ns(header)})
        elif TIME_UNITS[unit or "s"] == 1.0 and self.counts(TOO_LARGE, ["time_s"])["time_s"]:
            self.time = self.table.keep({"r": self.table.whole_number(header)})

    def rows(self, names: Collection[str] | None, piece: Piece, origin: Ints, numbering: Numbering) -> Rows:
        """Return the rows that a piece holds, with the cells of some columns (None: of all)."""
        count = len(origin)
        wanted = [n for n in self.headers if n not in IDS and n != "time_s" and (names is None or n in names)]
        read = [*wanted, *(n for n in IDS if n in self.headers and n not in self.words)]
        if "time_s" in self.headers and self.time is None:
            read.append("time_s")
        found = piece(self.kept, [self.places[name] for name in read])
        cells = {name: _floats(found[self.places[name]]) for name in read if name != EVENT}
        if EVENT in read:
            cells[EVENT] = _events(found[self.places[EVENT]])
        for name, kept in self.exact.items():
            if name in cells:
                cells[name] = _low(piece(kept, ["r"])["r"])
        constants = {n: v for n, v in self.column_map.constants.items() if not isinstance(v, str)}
        cells |= {n: np.full(count, v) for n, v in constants.items() if names is None or n in (*names, *IDS)}
        for name in DISTANCES:
            if name in cells:
                cells[name] = cells[name] * self.column_map.metres_per_unit
        if self.column_map.power_sign < 0:
            cells |= {name: -cells[name] for name in POWERS if name in cells}
        words = {name: _words(piece(kept, ["r"])["r"]) for name, kept in self.words.items()}
        if numbering.known is not None:
            words |= {n: np.full(count, v) for n, v in self.column_map.constants.items() if isinstance(v, str)}
        seconds = cells.pop("time_s", None)
        return Rows(
            column_map=self.column_map,
            ids={n: numbering.numbers(cells.get(n), words.get(n)) for n in IDS if n in cells or n in words},
            cells={name: column for name, column in cells.items() if name not in IDS},
            time_ns=self.time_ns(piece, count, seconds),
            origin=origin,
        )

    def time_ns(self, piece: Piece, count: int, seconds: Floats | None = None) -> Ints | None:
        """Return times in nanoseconds, None where there are none."""
        if self.time is not None:
            return np.ma.filled(piece(self.time, ["r"])["r"].astype(np.int64), NEVER)
        if "time_s" in self.column_map.constants:
            seconds = np.full(count, self.column_map.constants["time_s"], dtype=np.float64)
        elif seconds is None and "time_s" in self.headers:
            seconds = _floats(piece(self.kept, [self.places["time_s"]])[self.places["time_s"]])
        if seconds is None:
            return None
        with np.errstate(invalid="ignore"):
            scaled = seconds * TIME_UNITS[self.column_map.time_unit or "s"]
            return whole(np.where(np.abs(scaled) > LATEST_NS, np.nan, scaled))


def _cells(table: Table, headers: dict[str, str], places: dict[str, str]) -> dict[str, Cell]:
    of = {name: table.word if name == EVENT else table.number for name in headers}
    return {places[name]: of[name](header) for name, header in headers.items()}


def _floats(column: NDArray[Any]) -> Floats:
    return np.asarray(np.ma.filled(column.astype(np.float64, copy=False), np.nan), dtype=np.float64)


def _words(column: NDArray[Any]) -> NDArray[np.str_]:
    return np.ma.filled(column, "").astype(np.str_)


def _low(exact: NDArray[Any]) -> Floats:
    """Return the low 40 bits of ticks, which are all that differences need."""
    low = (np.ma.filled(exact, 0).astype(np.int64) & np.int64((1 << 40) - 1)).astype(np.float64)
    return np.where(np.ma.getmaskarray(exact), np.nan, low)


def _events(column: NDArray[Any]) -> Floats:
    """Return 1 where a word is of sending ("tx", "sent"), 2 where it is of receiving ("rx", "received"), else NaN."""
    first = np.char.lower(_words(column).astype("U1"))
    return np.select([np.isin(first, ["t", "s"]), first == "r"], [SENT, RECEIVED], np.nan)


def missing_column(table: Table, column_map: ColumnMap, name: str) -> ImportTableError:
    """Return the error that says which column a table lacks."""
    remedy = "a `map_file` can rename columns or give constants, and `uwblink import guess` proposes one"
    if {"qx", "qy", "qz", "qw"} <= {header.lower() for header in table.names}:
        remedy = "these are poses, which `uwblink poses` puts into a recording"
    there = ", ".join(table.names)[:400]
    return ImportTableError(f"{table.path}: column {column_map.header(name)!r} is missing; there are {there}; {remedy}")
