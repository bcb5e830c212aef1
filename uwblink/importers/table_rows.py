"""Rows of one or several tables by the names of a map: numbers in our units, ids as numbers, times in nanoseconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import DISTANCES, EVENT, IDS, ISO, NAMES, TIME_UNITS, ColumnMap
from uwblink.importers.stamps import NEVER, whole
from uwblink.importers.table import EXACT, Table
from uwblink.recording.schema import Fault
from uwblink.twr import LARGEST_ID, LATEST_NS, STAMPS

WORDS_FROM: Final = 0.01
"""Share of ids that are no numbers from which on all are taken for words; fewer are faults."""

FAULT: Final = "unusable row"
SENT, RECEIVED = 1.0, 2.0
"""What becomes of the words in a column of events."""

_COUNTED: Final = (*STAMPS, "tx", "rx", "stamp")


@dataclass(frozen=True, slots=True)
class Bad:
    """A row that cannot be used: its place among all rows read, the column (ours), and what is expected there."""

    row: int
    name: str
    expected: str


@dataclass(slots=True, kw_only=True)
class Rows:
    """Rows of all files, columns by the names of `column_map` (n,): NaN or `NEVER` where a cell holds none.

    `file` is which of `paths` a row is from, `row` its place there, and `origin` its place among all that were read.
    `names` are ids that were words, by number; `too_long` the lines by file that have too many cells.
    """

    paths: tuple[Path, ...]
    column_map: ColumnMap
    cells: dict[str, Floats]
    ids: dict[str, Ints]
    time_ns: Ints | None
    file: Ints
    row: Ints
    origin: Ints
    names: dict[int, str] = field(default_factory=dict)
    too_long: dict[int, list[int]] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.row)

    def has(self, name: str) -> bool:
        """Return whether there is a column of one of `NAMES`."""
        return name in self.cells or name in self.ids or (name == "time_s" and self.time_ns is not None)

    def faults(self, bad: Sequence[Bad]) -> list[Fault]:
        """Return bad rows as faults with file, line, column and cell; those with too many cells, too."""
        found = []
        for k, path in enumerate(self.paths):
            here = [one for one in bad if self.file[one.row] == k]
            lines = dict(zip((one.row for one in here), self._lines(path, here), strict=True))
            cells = self._cells(path, here)
            for one in here:
                when = 0 if self.time_ns is None else int(self.time_ns[one.row])
                text = self._found(one, cells)
                detail = f"row {lines[one.row]}, {text}, expected {one.expected}"
                found.append(Fault(max(when, 0) if when == NEVER else when, path.name, FAULT, detail))
            for line in self.too_long.get(k, ()):
                found.append(Fault(0, path.name, FAULT, f"row {line}: more cells than the header has"))
        return found

    def _lines(self, path: Path, bad: list[Bad]) -> list[int]:
        if not bad:
            return []
        with Table(path, self.column_map.delimiter, self.column_map.decimal) as table:
            if self.too_long:
                table.read(words=table.names[:1])
            return table.lines(np.array([self.row[one.row] for one in bad], dtype=np.int64))

    def _cells(self, path: Path, bad: list[Bad]) -> dict[tuple[str, int], str]:
        """Return what stands in the cells of bad rows of a file, by the column's header and the row's place."""
        headers: dict[str, list[int]] = {}
        for one in bad:
            if one.name not in self.column_map.constants:
                headers.setdefault(self.column_map.header(one.name), []).append(int(self.row[one.row]))
        found: dict[tuple[str, int], str] = {}
        with Table(path, self.column_map.delimiter, self.column_map.decimal) as table:
            for header, places in headers.items():
                if header in table.names:
                    found |= {(header, place): word for place, word in table.words_at(header, places).items()}
        return found

    def _found(self, bad: Bad, cells: dict[tuple[str, int], str]) -> str:
        header = self.column_map.header(bad.name)
        if bad.name in self.column_map.constants:
            return f"constant {bad.name!r}: found {str(self.column_map.constants[bad.name])[:40]!r}"
        cell = cells.get((header, int(self.row[bad.row])))
        return f"column {header[:60]!r}" if cell is None else f"column {header[:60]!r}: found {cell[:40]!r}"


def read_rows(paths: Sequence[Path], column_map: ColumnMap) -> Rows:
    """Read the columns that a map names, and those that have our names; raises `ImportTableError`."""
    parts = [_read_file(path, column_map) for path in paths]
    first = parts[0]
    for part in parts[1:]:
        if set(part.cells) != set(first.cells) or set(part.words) != set(first.words):
            raise ImportTableError(f"{part.path}: has other columns than {first.path}, so they are not one table")
    if not sum(part.count for part in parts):
        raise ImportTableError(f"{first.path}: a header and no rows")
    cells = {name: _joined([part.cells[name] for part in parts]) for name in first.cells}
    words = {name: _joined([part.words[name] for part in parts]) for name in first.words}
    ids, names = _numbered(paths[0], column_map, cells, words)
    times = [part.time_ns for part in parts if part.time_ns is not None]
    return Rows(
        paths=tuple(paths),
        column_map=column_map,
        cells={name: column for name, column in cells.items() if name not in IDS},
        ids=ids,
        time_ns=_joined(times) if times else None,
        file=np.repeat(np.arange(len(parts)), [part.count for part in parts]),
        row=np.concatenate([np.arange(part.count) for part in parts]),
        origin=np.arange(sum(part.count for part in parts)),
        names=names,
        too_long={k: part.too_long for k, part in enumerate(parts) if part.too_long},
    )


def _joined(parts: list[Any]) -> Any:
    """Return arrays as one, without a copy of one alone."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


@dataclass(frozen=True, slots=True)
class _File:
    path: Path
    count: int
    cells: dict[str, Floats]
    words: dict[str, NDArray[np.str_]]
    time_ns: Ints | None
    too_long: list[int]


def _read_file(path: Path, column_map: ColumnMap) -> _File:
    with Table(path, column_map.delimiter, column_map.decimal) as table:
        present = [n for n in NAMES if n not in column_map.constants and column_map.header(n) in table.names]
        for name in column_map.columns:
            if name not in present and name not in column_map.constants:
                raise _missing(table, column_map, name)
        if not present:
            raise _missing(table, column_map, "from_id")
        headers = {name: column_map.header(name) for name in present}
        table.require(headers.values())
        found = table.numbers(headers.values())
        cells = {name: found[header] for name, header in headers.items()}
        if EVENT in headers:
            cells[EVENT] = _events(table.read(words=[headers[EVENT]])[1][headers[EVENT]])
        count = len(next(iter(cells.values())))
        cells |= {n: np.full(count, v) for n, v in column_map.constants.items() if not isinstance(v, str)}
        constant = {n: np.full(count, v) for n, v in column_map.constants.items() if isinstance(v, str)}
        _keep_exact(table, column_map, headers, cells)
        for name in DISTANCES:
            if name in cells:
                cells[name] = cells[name] * column_map.metres_per_unit
        wordy = [name for name in IDS if name in headers and _is_wordy(cells[name])]
        words = {name: table.read(words=[headers[name]])[1][headers[name]] for name in wordy} | constant
        time_ns = _times(table, column_map, headers, cells)
        return _File(path, count, cells, words, time_ns, table.rejected())


def _events(words: NDArray[np.str_]) -> Floats:
    """Return 1 where a word is of sending ("tx", "sent"), 2 where it is of receiving ("rx", "received"), else NaN."""
    first = np.char.lower(words.astype("U1"))
    return np.select([np.isin(first, ["t", "s"]), first == "r"], [SENT, RECEIVED], np.nan)


def _missing(table: Table, column_map: ColumnMap, name: str) -> ImportTableError:
    return ImportTableError(
        f"{table.path}: column {column_map.header(name)!r} is missing; there are {', '.join(table.names)[:400]}; "
        "a `map_file` can rename columns or give constants, and `uwblink import guess` proposes one"
    )


def missing(rows: Rows, name: str) -> ImportTableError:
    """Return the error that says which column a table lacks."""
    with Table(rows.paths[0], rows.column_map.delimiter, rows.column_map.decimal) as table:
        return _missing(table, rows.column_map, name)


def _keep_exact(table: Table, column_map: ColumnMap, headers: dict[str, str], cells: dict[str, Floats]) -> None:
    """Put ticks that no float holds back to the low 40 bits, which are all that differences need."""
    for name in _COUNTED:
        if name not in headers or column_map.ticks_per_unit != 1.0:
            continue
        with np.errstate(invalid="ignore"):
            large = np.abs(cells[name]) >= EXACT
        if large.any():
            exact = table.whole_numbers(headers[name], NEVER)
            low = (exact & np.int64((1 << 40) - 1)).astype(np.float64)
            cells[name] = np.where(exact == NEVER, np.nan, low)


def _times(table: Table, column_map: ColumnMap, headers: dict[str, str], cells: dict[str, Floats]) -> Ints | None:
    """Return times in nanoseconds, None where there are none; words are ISO 8601."""
    if "time_s" not in cells:
        return None
    seconds, unit = cells.pop("time_s"), column_map.time_unit
    if "time_s" in headers and (unit == ISO or (unit is None and not np.isfinite(seconds).any())):
        return table.times_ns(headers["time_s"])
    scale = TIME_UNITS[unit or "s"]
    with np.errstate(invalid="ignore"):
        scaled = seconds * scale
        large = np.abs(seconds) >= EXACT
        scaled = np.where(np.abs(scaled) > LATEST_NS, np.nan, scaled)
    if scale == 1.0 and large.any():
        return table.whole_numbers(headers["time_s"], NEVER)
    return whole(scaled)


def _is_wordy(cells: Floats) -> bool:
    return bool(np.count_nonzero(~_is_id(cells)) > WORDS_FROM * len(cells))


def _is_id(cells: Floats) -> Bools:
    with np.errstate(invalid="ignore"):
        return np.asarray((cells >= 0) & (cells <= LARGEST_ID) & (cells == np.rint(cells)))


def _numbered(
    path: Path, column_map: ColumnMap, cells: dict[str, Floats], words: dict[str, NDArray[np.str_]]
) -> tuple[dict[str, Ints], dict[int, str]]:
    """Return ids as numbers, `NEVER` where there is none, and the words by their numbers."""
    if not words or _mostly_empty(words):
        plain: dict[str, Ints] = {n: np.where(_is_id(cells[n]), whole(cells[n]), NEVER) for n in IDS if n in cells}
        return plain, {}
    text = {n: words[n] if n in words else _as_words(cells[n]) for n in IDS if n in cells or n in words}
    distinct = sorted({name for column in text.values() for name in np.unique(column).tolist()} - {""})
    numbers = dict(column_map.ids)
    numbers |= {n: int(n) for n in distinct if n not in numbers and _is_tag(n)}
    free = iter(sorted(set(range(1, LARGEST_ID + 1)) - set(numbers.values())))
    for name in distinct:
        if name not in numbers:
            number = next(free, None)
            if number is None:
                raise ImportTableError(f"{path}: more than {LARGEST_ID} different ids; are from_id and to_id ids?")
            numbers[name] = number
    known = np.array(["", *distinct])
    value = np.array([NEVER, *(numbers[name] for name in distinct)], dtype=np.int64)
    ids: dict[str, Ints] = {n: value[np.searchsorted(known, column)] for n, column in text.items()}
    return ids, {numbers[name]: name for name in distinct if name != str(numbers[name])}


def _mostly_empty(words: dict[str, NDArray[np.str_]]) -> bool:
    """Whether what is no number is nothing: empty cells are faults, not names."""
    filled = np.concatenate([column[column != ""] for column in words.values()])
    return all(map(_is_tag, np.unique(filled).tolist()))


def _as_words(cells: Floats) -> NDArray[np.str_]:
    good = _is_id(cells)
    return np.where(good, np.where(good, cells, 0).astype(np.int64).astype(np.str_), "")


def take(rows: Rows, chosen: Ints) -> Rows:
    """Return some rows, in the order given."""
    return replace(
        rows,
        cells={name: column[chosen] for name, column in rows.cells.items()},
        ids={name: column[chosen] for name, column in rows.ids.items()},
        time_ns=None if rows.time_ns is None else rows.time_ns[chosen],
        file=rows.file[chosen],
        row=rows.row[chosen],
        origin=rows.origin[chosen],
    )


def _is_tag(text: str) -> bool:
    # Texts of thousands of digits are no numbers to Python, either.
    return text.isdecimal() and len(text) < 9 and int(text) <= LARGEST_ID
