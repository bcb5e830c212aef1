"""Tables of strangers as rows of which little is in memory: each file is parsed once, and its columns are put aside.

What all rows decide - whether ids are words, whether times are - is asked of what was put aside.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import DISTANCES, EVENT, IDS, ISO, NAMES, TIME_UNITS, ColumnMap
from uwblink.importers.ids import Numbering, is_id, numbering, too_many
from uwblink.importers.staging import Kept, Stage
from uwblink.importers.stamps import NEVER, whole
from uwblink.importers.table import EXACT, Cell, Table
from uwblink.importers.table_rows import RECEIVED, ROWS_AT_ONCE, SENT, Rows, joined
from uwblink.importers.unusable import FAULT, Reason, Unusable
from uwblink.recording.schema import Fault
from uwblink.twr import LARGEST_ID, LATEST_NS, STAMPS

WORDS_FROM: Final = 0.01
"""Share of ids that are no numbers from which on all are taken for words; fewer are faults."""

FAULTS_AT_ONCE: Final = 100_000
TOO_LARGE: Final = f"NOT isnan(x) AND abs(x) >= {EXACT}"
"""Of numbers of which a float may not be what stood in the file."""

MOST_WORDS: Final = 1_000_000
"""Different words, more than ids can be written in."""

_COUNTED: Final = (*STAMPS, "tx", "rx", "stamp")

Watch = Callable[[str, float], object]
"""Is told what is being done, and which share of it is."""


@dataclass(slots=True, kw_only=True)
class _File:
    """A table, and where its columns are: what was put aside, and what of it, by our names."""

    table: Table
    headers: dict[str, str]
    kept: Kept
    places: dict[str, str]
    exact: dict[str, Kept] = field(default_factory=dict)
    words: dict[str, Kept] = field(default_factory=dict)
    time: Kept | None = None

    def counts(self, condition: str, names: Collection[str]) -> dict[str, int]:
        """Return in how many rows of some columns a condition on x holds."""
        if not names:
            return {}
        asked = ", ".join(f"count_if({condition.replace('x', self.places[name])})" for name in names)
        (found,) = self.kept.ask(asked)
        return {name: int(count or 0) for name, count in zip(names, found, strict=True)}


class StagedTables:
    """The rows of several files as one table. Close it, or use it as a context manager."""

    def __init__(self, paths: Sequence[Path], column_map: ColumnMap, watch: Watch | None = None) -> None:
        """Read the columns that a map names, and those that have our names; raises `ImportTableError`."""
        self.paths, self.column_map = tuple(paths), column_map
        self._stage = Stage(paths)
        try:
            self._files: list[_File] = []
            for k, path in enumerate(paths):
                if watch:
                    watch("reading", k / len(paths))
                self._files.append(self._file(k, path))
            self._check_alike()
            self._numbering = self._numbered()
            if self._numbering.known is None:
                for file in self._files:
                    file.words.clear()
        except BaseException:
            self._stage.close()
            raise
        self._offsets = np.cumsum([0, *(file.kept.count for file in self._files)])

    def __enter__(self) -> StagedTables:
        """Return the tables themselves."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Forget everything."""
        self._stage.close()

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self._offsets[-1])

    @property
    def names(self) -> dict[int, str]:
        """The ids that were words, by number."""
        return self._numbering.names

    @property
    def stage(self) -> Stage:
        """Where more can be put aside."""
        return self._stage

    def has(self, name: str) -> bool:
        """Return whether there is a column of one of `NAMES`."""
        if name in self._files[0].headers:
            return True
        told = self.column_map.constants.get(name)
        # A word that is a number is no name.
        return told is not None and not (isinstance(told, str) and self._numbering.known is None)

    def blocks(self, names: Collection[str] | None = None) -> Iterator[Rows]:
        """Yield all rows in their order, some at a time, with the cells of some columns (None: of all)."""
        for k, file in enumerate(self._files):
            for start in range(0, file.kept.count, ROWS_AT_ONCE):
                stop = min(start + ROWS_AT_ONCE, file.kept.count)

                def piece(kept: Kept, columns: Collection[str], start: int = start, stop: int = stop) -> _Columns:
                    return kept.between(start, stop, columns)

                yield self._rows(file, names, piece, self._offsets[k] + np.arange(start, stop))

    def at(self, places: Ints, names: Collection[str]) -> Rows:
        """Return the rows at some places, in ascending order without repetition, with the cells of some columns."""
        parts = []
        for k, file in enumerate(self._files):
            here = places[(places >= self._offsets[k]) & (places < self._offsets[k + 1])]

            def piece(kept: Kept, columns: Collection[str], rows: Ints = here - self._offsets[k]) -> _Columns:
                return kept.at(rows, columns)

            parts.append(self._rows(file, names, piece, here))
        return joined(parts)

    def missing(self, name: str) -> ImportTableError:
        """Return the error that says which column a table lacks."""
        return _missing(self._files[0].table, self.column_map, name)

    def path_of(self, origin: int) -> Path:
        """Return the file that a row is from."""
        return self.paths[int(np.searchsorted(self._offsets, origin, side="right")) - 1]

    def too_long(self) -> int:
        """Return how many rows have more cells than the header."""
        return sum(len(file.table.rejected()) for file in self._files)

    def fault(self, reason: Reason, origin: int) -> Fault:
        """Return one row that cannot be used as a fault, with its line as if none were too long."""
        k = int(np.searchsorted(self._offsets, origin, side="right")) - 1
        place = np.array([origin - self._offsets[k]])
        lines = self._files[k].table.lines(place, rejected=False)
        return next(self._faults(k, reason, place, lines))[0]

    def faults(self, unusable: Unusable) -> Iterator[list[Fault]]:
        """Yield rows that cannot be used as faults with file, line, column and cell; those with too many cells, too."""
        for k, file in enumerate(self._files):
            first, last = self._offsets[k], self._offsets[k + 1]
            here = [(reason, rows[(rows >= first) & (rows < last)] - first) for reason, rows in unusable.reasons()]
            places = np.concatenate([np.empty(0, np.int64), *(rows for _, rows in here)])
            lines = file.table.lines(places) if len(places) else places
            for reason, rows in here:
                yield from self._faults(k, reason, rows, lines[: len(rows)])
                lines = lines[len(rows) :]
            long = file.table.rejected()
            for start in range(0, len(long), FAULTS_AT_ONCE):
                yield [self._too_long(k, line) for line in long[start : start + FAULTS_AT_ONCE].tolist()]

    def _too_long(self, k: int, line: int) -> Fault:
        return Fault(0, self.paths[k].name, FAULT, f"row {line}: more cells than the header has")

    def _faults(self, k: int, reason: Reason, rows: Ints, lines: Ints) -> Iterator[list[Fault]]:
        file, path = self._files[k], self.paths[k]
        for start in range(0, len(rows), FAULTS_AT_ONCE):
            some = rows[start : start + FAULTS_AT_ONCE]
            times = self._times_at(file, some)
            found = self._found(file, reason.name, some)
            yield [
                Fault(
                    max(when, 0) if when == NEVER else when,
                    path.name,
                    FAULT,
                    f"row {line}, {text}, expected {reason.expected}",
                )
                for when, line, text in zip(times, lines[start : start + FAULTS_AT_ONCE].tolist(), found, strict=True)
            ]

    def _times_at(self, file: _File, rows: Ints) -> list[int]:
        if not self.has("time_s"):
            return [0] * len(rows)
        chosen, back = np.unique(rows, return_inverse=True)
        time_ns = self._time(file, lambda kept, columns: kept.at(chosen, columns), len(chosen))
        return [0] * len(rows) if time_ns is None else list(time_ns[back].tolist())

    def _found(self, file: _File, name: str, rows: Ints) -> list[str]:
        """Say what stands in the cells of a column."""
        if name in self.column_map.constants:
            return [f"constant {name!r}: found {str(self.column_map.constants[name])[:40]!r}"] * len(rows)
        header = self.column_map.header(name)
        words = file.table.words_at(header, rows.tolist()) if header in file.table.names else {}
        column = f"column {header[:60]!r}"
        return [f"{column}: found {words[row][:40]!r}" if row in words else column for row in rows.tolist()]

    def _file(self, number: int, path: Path) -> _File:
        column_map = self.column_map
        table = Table(path, column_map.delimiter, column_map.decimal, stage=self._stage, number=number)
        present = [n for n in NAMES if n not in column_map.constants and column_map.header(n) in table.names]
        for name in column_map.columns:
            if name not in present and name not in column_map.constants:
                raise _missing(table, column_map, name)
        if not present:
            raise _missing(table, column_map, "from_id")
        headers = {name: column_map.header(name) for name in present}
        table.require(headers.values())
        places = {name: f"r{k}" for k, name in enumerate(headers)}
        file = _File(table=table, headers=headers, kept=table.keep(_cells(table, headers, places)), places=places)
        self._keep_exact(file)
        self._keep_words(file)
        self._keep_times(file)
        return file

    def _keep_exact(self, file: _File) -> None:
        """Put ticks aside that no float holds."""
        if self.column_map.ticks_per_unit != 1.0:
            return
        names = [name for name in _COUNTED if name in file.headers]
        for name, count in file.counts(TOO_LARGE, names).items():
            if count:
                file.exact[name] = file.table.keep({"r": file.table.whole_number(file.headers[name])})

    def _keep_words(self, file: _File) -> None:
        names = [name for name in IDS if name in file.headers]
        for name, good in file.counts(f"x >= 0 AND x <= {LARGEST_ID} AND x = trunc(x)", names).items():
            if file.kept.count - good > WORDS_FROM * file.kept.count:
                file.words[name] = file.table.keep({"r": file.table.word(file.headers[name])})

    def _keep_times(self, file: _File) -> None:
        """Put times aside that are words, or that no float holds."""
        if "time_s" not in file.headers:
            return
        header, unit = file.headers["time_s"], self.column_map.time_unit
        if unit == ISO or (unit is None and not file.counts("isfinite(x)", ["time_s"])["time_s"]):
            file.time = file.table.keep({"r": file.table.time_ns(header)})
        elif TIME_UNITS[unit or "s"] == 1.0 and file.counts(TOO_LARGE, ["time_s"])["time_s"]:
            file.time = file.table.keep({"r": file.table.whole_number(header)})

    def _check_alike(self) -> None:
        first = self._files[0]
        for file in self._files[1:]:
            if set(file.headers) != set(first.headers) or set(file.words) != set(first.words):
                raise ImportTableError(
                    f"{file.table.path}: has other columns than {first.table.path}, so they are not one table"
                )
        if not sum(file.kept.count for file in self._files):
            raise ImportTableError(f"{first.table.path}: a header and no rows")

    def _numbered(self) -> Numbering:
        words: dict[str, set[str]] = {n: {v} for n, v in self.column_map.constants.items() if isinstance(v, str)}
        for name in self._files[0].words:
            words[name] = set().union(*(self._distinct(file.words[name], "r") for file in self._files))
        told = (*self._files[0].headers, *self.column_map.constants)
        plain: list[str] = [name for name in IDS if name in told and name not in words]
        others = {name: self._distinct_numbers(name) for name in plain} if words else {}
        return numbering(self.paths[0], self.column_map.ids, words, others)

    def _distinct(self, kept: Kept, column: str) -> set[str]:
        ((count,),) = kept.ask(f"approx_count_distinct({column})")
        if int(count) > MOST_WORDS:
            raise too_many(self.paths[0])
        found = [str(word) for (word,) in kept.ask(f"DISTINCT {column}")]
        return set(np.array(found, dtype=np.str_).tolist())

    def _distinct_numbers(self, name: str) -> set[str]:
        if name in self.column_map.constants:
            value = np.array([self.column_map.constants[name]], dtype=np.float64)
            return {str(int(number)) for number in value[is_id(value)].tolist()}
        good = "x >= 0 AND x <= 65535 AND x = trunc(x)"
        found: set[str] = set()
        for file in self._files:
            x = file.places[name]
            rows = file.kept.ask(f"DISTINCT CASE WHEN {good.replace('x', x)} THEN {x} END")
            found |= {str(int(number)) for (number,) in rows if number is not None}
        return found

    def _rows(self, file: _File, names: Collection[str] | None, piece: _Piece, origin: Ints) -> Rows:
        count = len(origin)
        wanted = [n for n in file.headers if n not in IDS and n != "time_s" and (names is None or n in names)]
        read = [*wanted, *(n for n in IDS if n in file.headers and n not in file.words)]
        if "time_s" in file.headers and file.time is None:
            read.append("time_s")
        found = piece(file.kept, [file.places[name] for name in read])
        cells = {name: _floats(found[file.places[name]]) for name in read if name != EVENT}
        if EVENT in read:
            cells[EVENT] = _events(found[file.places[EVENT]])
        for name, kept in file.exact.items():
            if name in cells:
                cells[name] = _low(piece(kept, ["r"])["r"])
        constants = {n: v for n, v in self.column_map.constants.items() if not isinstance(v, str)}
        cells |= {n: np.full(count, v) for n, v in constants.items() if names is None or n in (*names, *IDS)}
        for name in DISTANCES:
            if name in cells:
                cells[name] = cells[name] * self.column_map.metres_per_unit
        words = {name: _words(piece(kept, ["r"])["r"]) for name, kept in file.words.items()}
        if self._numbering.known is not None:
            words |= {n: np.full(count, v) for n, v in self.column_map.constants.items() if isinstance(v, str)}
        seconds = cells.pop("time_s", None)
        return Rows(
            column_map=self.column_map,
            ids={n: self._numbering.numbers(cells.get(n), words.get(n)) for n in IDS if n in cells or n in words},
            cells={name: column for name, column in cells.items() if name not in IDS},
            time_ns=self._time(file, piece, count, seconds),
            origin=origin,
        )

    def _time(self, file: _File, piece: _Piece, count: int, seconds: Floats | None = None) -> Ints | None:
        """Return times in nanoseconds, None where there are none."""
        if file.time is not None:
            return np.ma.filled(piece(file.time, ["r"])["r"].astype(np.int64), NEVER)
        if "time_s" in self.column_map.constants:
            seconds = np.full(count, self.column_map.constants["time_s"], dtype=np.float64)
        elif seconds is None and "time_s" in file.headers:
            seconds = _floats(piece(file.kept, [file.places["time_s"]])[file.places["time_s"]])
        if seconds is None:
            return None
        with np.errstate(invalid="ignore"):
            scaled = seconds * TIME_UNITS[self.column_map.time_unit or "s"]
            return whole(np.where(np.abs(scaled) > LATEST_NS, np.nan, scaled))


_Columns = dict[str, NDArray[Any]]
_Piece = Callable[[Kept, Collection[str]], _Columns]
"""Reads columns of some rows of what was put aside."""


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


def _missing(table: Table, column_map: ColumnMap, name: str) -> ImportTableError:
    return ImportTableError(
        f"{table.path}: column {column_map.header(name)!r} is missing; there are {', '.join(table.names)[:400]}; "
        "a `map_file` can rename columns or give constants, and `uwblink import guess` proposes one"
    )
