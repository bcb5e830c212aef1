"""Tables staged in a database: columns by the names of a map, ids as numbers, SI units; and the exchanges in them.

The database is temporary and mostly on disk (`tables.connected`), so memory does not grow with the tables.

Rows of one exchange are combined, and unusable rows are recorded as faults with file, line and cell. A row is an
exchange, or a message with the stamps of its sender and its receiver ("messages"), or one of these stamps ("stamps"),
or has some of the columns of an exchange, for example if both devices report ("parts"). Rows belong to one group if
they have the same devices and numbers and follow each other within `within_s` of the map. The rows are sorted by these
keys, so that each group is contiguous. Only DuckDB's sort holds many rows at once.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import duckdb
import numpy as np

from uwblink.arrays import Columns
from uwblink.database import selected
from uwblink.errors import ArgumentError, ImportTableError, raising
from uwblink.importers.column_map import (
    ALL_IDS,
    IDS,
    KINDS,
    NAMES,
    POWERS,
    SKEWS,
    TEMPERATURES,
    UNITS_BY_KEY,
    ColumnMap,
)
from uwblink.importers.devices import CHIPS, power_sql
from uwblink.importers.plausibility import SAMPLE_ROWS, counter_format
from uwblink.importers.tables import (
    SourceTable,
    is_by_target,
    message_number,
    number,
    time_ns,
    whole_number,
)
from uwblink.receptions import Receptions, contradicted, exchanges_in, times_by_stamps
from uwblink.recording.schema import Fault
from uwblink.ticks import TICK_S
from uwblink.twr import LARGEST_ID, STAMPS

ROWS_PER_BLOCK: Final = 245_760
"""Size of a block, two row groups of DuckDB: smaller blocks would remain separate row groups in a recording."""

Watch = Callable[[str, float], object]
"""Callback for progress: the current step ("reading", "writing" ...) and its completed share."""


@dataclass(frozen=True, slots=True)
class StagedRows:
    """The rows of a table for which an SQL condition is true; `origin` is their number among all rows read.

    `from_id` and `to_id` are INTEGER, `time_ns` and stamps in ticks BIGINT, all other `columns` DOUBLE; missing values
    are NULL.
    """

    db: duckdb.DuckDBPyConnection
    name: str
    columns: tuple[str, ...]
    condition: str = "true"

    def where(self, condition: str) -> StagedRows:
        """Return the rows for which this condition is also true."""
        return replace(self, condition=f"{self.condition} AND ({condition})")

    def has(self, name: str) -> bool:
        """Return whether there is a column of one of `NAMES`."""
        return ("time_ns" if name == "time_s" else name) in self.columns

    def values(self, expressions: str) -> tuple[int, ...]:
        """Return SQL aggregates over the rows."""
        return tuple(self.db.execute(f"SELECT {expressions} FROM {self.name} WHERE {self.condition}").fetchall()[0])

    def count(self) -> int:
        """Return the number of rows."""
        return int(self.values("count(*)")[0])

    def read(self, more: str = "") -> Columns:
        """Return the rows as arrays (n,), missing integers as 0, floats as NaN; `more` ends the query."""
        query = f"SELECT {', '.join(self.columns)} FROM {self.name} WHERE {self.condition} {more}"
        found = self.db.execute(query).fetchnumpy()
        return {
            name: np.ma.filled(column.astype(np.int64), 0)
            if column.dtype.kind in "iu"
            else np.ma.filled(column.astype(np.float64, copy=False), np.nan)
            for name, column in found.items()
        }

    def blocks(self) -> Iterator[Columns]:
        """Yield the rows in their order, block by block; empty blocks are left out."""
        for start in range(0, replace(self, condition="true").count(), ROWS_PER_BLOCK):
            # DuckDB keeps the order of rows; ORDER BY would sort them.
            columns = self.read(f"AND rowid >= {start} AND rowid < {start + ROWS_PER_BLOCK}")
            if len(columns["origin"]):
                yield columns

    def sample(self, size: int) -> Columns:
        """Return a pseudo-random sample of the rows, in their order."""
        some = f"SELECT rowid FROM {self.name} WHERE {self.condition} ORDER BY hash(rowid) LIMIT {size}"
        return self.read(f"AND rowid IN ({some}) ORDER BY rowid")


class Staging:
    """Tables staged as one; `rows` are their rows.

    `names` are the words for ids, by assigned number; `offsets` are the numbers of each table's first row among all
    rows, and the number of all rows. `faults` are the rows that proved unusable, `notes` lines for the user, and
    `watch` is called with the progress.
    """

    def __init__(
        self, db: duckdb.DuckDBPyConnection, paths: Sequence[Path], column_map: ColumnMap, watch: Watch
    ) -> None:
        """Stage tables: the columns that the map names, and those whose names are in `NAMES`.

        Raises `ImportTableError`.
        """
        self.db, self.paths, self.column_map, self.watch = db, tuple(paths), column_map, watch
        self.tables: list[SourceTable] = []
        self.notes: list[str] = []
        self.names: dict[int, str] = {}
        self.offsets = [0]
        columns: Collection[str] = ()
        for k, path in enumerate(paths):
            watch("reading", k / len(paths))
            table = SourceTable(db, path, column_map, key=k)
            self.tables.append(table)
            cells = staged_cells(table)
            if cells.keys() != (columns or cells.keys()):
                raise ImportTableError(f"{path}: has other columns than {paths[0]}, so they are not one table")
            columns = cells.keys()
            with table.reading():
                into = "INSERT INTO staged" if k else "CREATE TABLE staged AS"
                db.execute(f"{into} SELECT {selected(cells)} FROM {table.source}")
            self.offsets.append(StagedRows(db, "staged", ()).count())
        if not self.offsets[-1]:
            raise ImportTableError(f"{paths[0]}: has a header but no rows")
        (self.blanks,) = StagedRows(db, "staged", ()).values("count(*) FILTER (blank)")
        """Number of omitted rows without a range, such as an empty cell of a wide table."""
        self.beside: dict[str, Columns] = {}
        """Further rows for other tables of a recording, by table."""
        self._filled = "NOT blank" if self.blanks else "true"
        others = tuple(name for name in columns if name not in (*ALL_IDS, "blank"))
        ids = selected(self._ids([n for n in ALL_IDS if n in columns]))
        listed = ", ".join(("CAST(rowid AS UINTEGER) AS origin", ids, *others))
        db.execute(f"CREATE TABLE rows AS SELECT {listed} FROM staged WHERE {self._filled}")
        db.execute("DROP TABLE staged")
        self.rows = StagedRows(db, "rows", ("origin", *(n for n in ALL_IDS if n in columns), *others))
        self.faults = Faults(self)

    def words_in(self, names: Iterable[str]) -> Iterator[str]:
        """Yield a note for each of some columns with cells that are not numbers, which are treated as missing.

        Raises `ImportTableError` if at least half of the non-empty cells are not numbers.
        """
        there = [
            name
            for name in names
            if self.rows.has(name) and name not in {*self.column_map.registers, *self.column_map.constants}
        ]
        lacking = self.rows.values(", ".join(f"count(*) - count({name})" for name in there)) if there else ()
        none = "'', 'nan', 'none', 'null', 'na', 'n/a', '-', '--', 'inf', '-inf'"  # words for a missing number
        for name in (name for name, count in zip(there, lacking, strict=True) if count):
            header, cells = self.column_map.header(name), list[tuple[str, int, bool]]()
            for table in self.tables:
                text = table.text(header, numeric=True)
                kept = f"WHERE lower(trim({text})) NOT IN ({none}) AND NOT {_is_missing(table, text)}"
                is_word = f"{_cell(table, name, text)} IS NULL"
                found = table.read({"first": f"any_value({text})", "n": "count(*)", "w": is_word}, f"{kept} GROUP BY 3")
                cells += zip(found["first"].tolist(), found["n"].tolist(), found["w"].tolist(), strict=True)
            words = [cell for cell in cells if cell[2]]
            count, total = sum(n for _, n, _ in words), sum(n for _, n, _ in cells)
            what = "plain degrees Celsius (-65 to 150)" if name in TEMPERATURES else "numbers"
            note = f"{count} of {total} cells of column {header[:60]!r} are no {what}"
            if words and 2 * count >= total:
                first = json.dumps(words[0][0][:40])
                remedy = f"name another column for {name} in the map, or state missing = [{first}]"
                raise ImportTableError(f"{self.paths[0]}: {note}, such as {first}; {remedy}")
            if words:
                yield f"{note}, such as {words[0][0][:40]!r}, and are taken as missing"

    def require(self, rows: StagedRows, names: Iterable[str]) -> None:
        """Raise the error for the first missing column."""
        for name in names:
            if not rows.has(name):
                raise self.tables[0].missing(self.column_map.header(name))

    def _ids(self, names: Sequence[str]) -> dict[str, str]:
        """Return SQL of ids as whole numbers, NULL if missing; words get numbers."""
        words: set[str] = set()
        for name in names:
            query = f"SELECT {name}, count(*) FROM staged WHERE {self._filled} GROUP BY {name} LIMIT 200000"
            counts: dict[str, int] = dict(self.db.execute(query).fetchall())
            if len(counts) == 200_000:
                raise self._too_many_ids()
            # Up to 1 % of ids that are not numbers are faults; with more, ids are words.
            odd = {word for word in counts if word not in numbers_of([word])}
            few = sum(counts[word] for word in odd) <= 0.01 * self.offsets[-1]
            words |= counts.keys() - (odd if few else {"", *(word for word in odd if word.lower() in SUMMARIES)})
        numbers = self._number_words(sorted(words))
        self.db.execute("SET VARIABLE words = ?", [["", *numbers]])
        self.db.execute("SET VARIABLE numbers = ?", [[None, *numbers.values()]])
        self.db.execute("CREATE TYPE word AS ENUM (SELECT unnest(getvariable('words')))")
        return {
            name: f"CAST(getvariable('numbers')[enum_code(TRY_CAST({name} AS word)) + 1] AS INTEGER)" for name in names
        }

    def _number_words(self, words: list[str]) -> dict[str, int]:
        """Return the number of each id: the map's number, the id itself, or else the next free one in alphabetical
        order.
        """
        numbers = numbers_of(words) | self.column_map.ids
        if not numbers.keys() >= set(words):
            free = iter(sorted({*range(1, LARGEST_ID + 1)} - {*numbers.values()}))
            numbers |= dict(zip((word for word in words if word not in numbers), free, strict=False))
        if not numbers.keys() >= set(words):
            raise self._too_many_ids()
        self.names = {numbers[word]: word for word in words if numbers[word] != numbers_of([word]).get(word)}
        return {word: numbers[word] for word in words}

    def _too_many_ids(self) -> ImportTableError:
        return ImportTableError(
            f"{self.paths[0]}: more than {LARGEST_ID} different ids; check that from_id and to_id are ids"
        )


def staged_cells(table: SourceTable) -> dict[str, str]:
    """Return SQL of the columns to stage, from cells of a table or constants; ids are words at first."""
    column_map, found = table.column_map, dict[str, str]()
    blank, constants = table.blank, column_map.constants
    for name, value in constants.items():
        table.db.execute(f"SET VARIABLE {name} = ?", [str(value)])
    for name in NAMES:
        header = column_map.header(name)
        if name in column_map.registers:
            cells = {key: number(table.text(one, numeric=True)) for key, one in column_map.registers[name].items()}
            found[name] = power_sql(CHIPS[column_map.chip or "other"], column_map.prf, cells)
            continue
        if name in constants:
            value = constants[name]
            if value in table.names and value not in column_map.columns.values():
                why = f"{value!r:.40} is the name of a column; state it in [columns], or rename the column"
                raise ImportTableError(f"{table.path}: constants.{name}: {why}")
            text = f"getvariable('{name}')"
        elif header in table.names or name in column_map.columns or name == "to_id" or (name in IDS and not table.live):
            text = table.text(header, numeric=name not in ALL_IDS)
        else:
            continue
        found["time_ns" if name == "time_s" else name] = _cell(table, name, text)
        if name in ("range_m", "difference_m") and column_map.missing:
            blank = " OR ".join(filter(None, [blank, _is_missing(table, text)]))
    message = column_map.header("message")
    if message in table.names and all(n in constants or column_map.header(n) in table.named for n in IDS):
        # The ids are the same pair for all messages; words tell which end sent a message.
        turned, (one, two) = is_by_target(table.text(message)), (found[n] for n in IDS)
        found |= {
            n: f"CASE WHEN {turned} THEN {a} ELSE {b} END" for n, a, b in zip(IDS, (two, one), (one, two), strict=True)
        }
    return found | {"blank": f"coalesce({blank or 'false'}, false)"}


def _is_missing(table: SourceTable, text: str) -> str:
    """Return SQL that is true for a text that means a missing value by the map."""
    missing = table.column_map.missing
    words = table.variable("missing", ["", *(one.strip().lower() for one in missing if isinstance(one, str))])
    numbers = ", ".join(repr(float(one)) for one in missing if not isinstance(one, str))
    is_word = f"list_contains({words}, lower(trim({text})))"
    return f"({is_word} OR TRY_CAST({text} AS DOUBLE) IN ({numbers}))" if numbers else is_word


def _cell(table: SourceTable, name: str, text: str) -> str:
    """Return SQL of a cell in SI units, from its text."""
    kind, column_map = KINDS[name], table.column_map
    if kind == "id":
        return f"trim({text})"
    if kind == "time":
        unit = column_map.unit_of(name)
        return time_ns(text, unit, UNITS_BY_KEY["time"][unit or "s"])
    if kind == "message":
        return message_number(text)
    if kind == "event":
        first = f"lower(left(trim({text}), 1))"
        return f"CASE WHEN {first} IN ('t', 's') THEN 1.0 WHEN {first} = 'r' THEN 2.0 END"
    # Stamps in other units are converted to ticks later, all of an exchange together (`plausibility.to_ticks`).
    factor = column_map.factor(name)
    if kind == "stamps":
        return whole_number(text) if factor == 1.0 else number(text)
    value = number(text) + (f" * {factor!r}" if factor != 1.0 else "")
    if name in TEMPERATURES:  # storage temperatures (DW1000 data sheet, maximum ratings)
        return f"CASE WHEN {value} BETWEEN -65 AND 150 THEN {value} END"
    if column_map.missing and name in ("range_m", "difference_m", "gt_range_m", *POWERS, *SKEWS):
        return f"CASE WHEN NOT {_is_missing(table, text)} THEN {value} END"
    return value


SUMMARIES: Final = frozenset(
    {
        "mean", "average", "avg", "median", "std", "stdev", "std dev", "min", "max", "sum", "total", "count", "rms",
        "rmse", "mittelwert", "summe", "anzahl",
    }
)  # fmt: skip
"""Words instead of an id that mark a row as a summary of others."""


def numbers_of(words: Iterable[str]) -> dict[str, int]:
    """Return the ids that are whole numbers, such as "7" and "7.0"."""
    matches = {word: re.fullmatch(r"([0-9]{1,9})([.,]0*)?", word) for word in words}
    return {word: int(match[1]) for word, match in matches.items() if match and int(match[1]) <= LARGEST_ID}


def rows_back(rows: StagedRows) -> tuple[int, float]:
    """Return the number of rows that are earlier than the previous one, and the largest difference in seconds."""
    if not rows.has("time_s"):
        return 0, 0.0
    steps = f"SELECT lag(time_ns) OVER () - time_ns AS back FROM {rows.name} WHERE {rows.condition}"
    count, most_ns = rows.db.execute(f"SELECT count(*), max(back) FROM ({steps}) WHERE back > 0").fetchall()[0]
    return int(count), (most_ns or 0) * 1e-9


def in_time_order(rows: StagedRows) -> StagedRows:
    """Return the rows in order of time; rows with equal times keep their order."""
    if not rows_back(rows)[0]:
        return rows
    listed = f"SELECT {', '.join(rows.columns)} FROM {rows.name} WHERE {rows.condition} ORDER BY time_ns, rowid"
    rows.db.execute(f"CREATE TABLE ordered AS {listed}")
    return StagedRows(rows.db, "ordered", rows.columns)


FAULTS_AT_ONCE: Final = 100_000


class Condition(NamedTuple):
    """A condition that makes a row unusable: column, expected value, and SQL that is true for unusable rows."""

    column: str
    expected: str
    wrong: str


SOUND_IDS: Final = (
    *(Condition(name, f"a whole number from 0 to {LARGEST_ID}", f"{name} IS NULL") for name in IDS),
    Condition("to_id", "another tag than from_id", "from_id = to_id"),
)
"""Conditions on the ids of the two devices."""
OF_DIFFERENCES: Final = (
    Condition("at_id", f"a whole number from 0 to {LARGEST_ID}", "at_id IS NULL"),
    Condition("at_id", "another tag than from_id and to_id", "at_id IN (from_id, to_id)"),
)
"""Further conditions if a tag measured the difference of arrival from both."""


class Faults:
    """Unusable rows, with the first reason of each."""

    def __init__(self, staging: Staging) -> None:
        """See `reject`."""
        self._staging = staging
        self._reasons: list[Condition] = []
        staging.db.execute("CREATE TABLE faulty (origin BIGINT, reason INTEGER)")

    def reject(self, rows: StagedRows, conditions: Sequence[Condition]) -> StagedRows:
        """Record the rows that meet a condition as unusable; returns the others."""
        cases = " ".join(f"WHEN {one.wrong} THEN {k}" for k, one in enumerate(conditions, start=len(self._reasons)))
        self._reasons += conditions
        query = f"SELECT origin, CASE {cases} END AS reason FROM {rows.name} WHERE {rows.condition}"
        rows.db.execute(f"INSERT INTO faulty SELECT * FROM ({query}) WHERE reason IS NOT NULL")
        return rows.where(f"CASE {cases} END IS NULL")

    def __len__(self) -> int:
        """Return the number of unusable rows, without those with too many cells."""
        return StagedRows(self._staging.db, "faulty", ()).count()

    def __iter__(self) -> Iterator[list[Fault]]:
        """Yield blocks of faults: for each file in the order of rows, then rows with too many cells."""
        staging, timed = self._staging, self._staging.rows.has("time_s")
        query = (
            f"SELECT origin, reason, {'coalesce(time_ns, 0)' if timed else '0'} FROM faulty JOIN rows USING (origin) "
            f"WHERE origin >= ? AND origin < ? ORDER BY origin, reason LIMIT {FAULTS_AT_ONCE} OFFSET ?"
        )
        for table, first, last in zip(staging.tables, staging.offsets, staging.offsets[1:], strict=False):
            done = 0
            while found := staging.db.execute(query, [first, last, done]).fetchall():
                done += len(found)
                yield self._describe(table, [(row - first, reason, time_ns) for row, reason, time_ns in found])
            lines = table.rejected()
            for start in range(0, len(lines), FAULTS_AT_ONCE):
                details = (f"row {n}: more cells than the header has" for n in lines[start : start + FAULTS_AT_ONCE])
                yield [Fault(0, table.path.name, "unusable row", detail) for detail in details]

    def check(self, total: int) -> None:
        """Raise `ImportTableError` with the first unusable row if half of all rows or more are unusable."""
        if len(self) and 2 * len(self) >= total:
            fault, *_ = next(iter(self))
            path = next(path for path in self._staging.paths if path.name == fault.board)
            raise ImportTableError(f"{path}: {fault.detail}")

    def _describe(self, table: SourceTable, found: Sequence[tuple[int, int, int]]) -> list[Fault]:
        """Return faults of a table: its rows, reasons and times."""
        column_map, faults = self._staging.column_map, []
        headers = {column_map.header(self._reasons[reason].column) for _, reason, _ in found}
        words = table.words_at([name for name in table.names if name in headers], [row for row, *_ in found])
        for row, reason, when_ns in found:
            column, expected, _ = self._reasons[reason]
            header = column_map.header(column)
            place = f"column {header[:60]!r}"
            if column in column_map.constants:
                place = f"constant {column!r}: found {str(column_map.constants[column])[:40]!r}"
            elif header in words.get(row, ()):
                place += f": found {words[row][header][:40]!r}"
            detail = f"row {table.line(row)}, {place}, expected {expected}"
            faults.append(Fault(when_ns, table.path.name, "unusable row", detail))
        return faults


def time_conditions(rows: StagedRows) -> list[Condition]:
    """Return the condition that a row has a time; none if there is no column of times."""
    return [Condition("time_s", "a time", "time_ns IS NULL")] if rows.has("time_s") else []


def usable_exchanges(staging: Staging, rows: StagedRows, stamps: Sequence[str]) -> tuple[StagedRows, int, int, str]:
    """Return the rows that have all stamps, without repetitions of an exchange.

    Also returns the number of repetitions, and width and format of the counter.
    """
    column_map, sample = staging.column_map, rows.sample(SAMPLE_ROWS)
    scale = column_map.factor("tx1")
    bits, counter = counter_format((sample[name] * scale for name in stamps), column_map.bits, column_map.counter)
    low = 0 if counter == "wrapped" else -(1 << (bits - 1))
    expected = "a whole number" if scale == 1.0 else "a stamp in ticks"
    conditions = time_conditions(rows)
    for name in stamps:
        conditions.append(Condition(name, "a whole number" if scale == 1.0 else "a finite number", f"{name} IS NULL"))
        if counter != "unwrapped":
            value, high = f"{name} * CAST('{scale!r}' AS DOUBLE)" if scale != 1.0 else name, low + (1 << bits)
            wrong = f"{value} < {low} OR {value} >= {high}"
            conditions.append(Condition(name, f"{expected} from {low} to {high - 1}", wrong))
    good = staging.faults.reject(rows, conditions)
    # Two of 10 million different exchanges have the same hash of 64 bits once in 400,000 tables.
    some = good.where(" OR ".join(f"{name} <> 0" for name in stamps))
    number = f"row_number() OVER (PARTITION BY hash({', '.join([*IDS, *stamps])}) ORDER BY rowid)"
    later = f"SELECT rowid FROM {rows.name} WHERE {some.condition} QUALIFY {number} > 1"
    staging.db.execute(f"CREATE TABLE repeats AS {later}")
    repeats = StagedRows(staging.db, "repeats", ()).count()
    return good.where("rowid NOT IN (SELECT rowid FROM repeats)") if repeats else good, repeats, bits, counter


def assemble_exchanges(staging: Staging, layout: str) -> tuple[StagedRows, str | None]:
    """Combine rows of "messages", "stamps" or "parts" into exchanges.

    Returns complete exchanges, and the protocol, if the rows determine it. Incomplete exchanges are faults. Messages
    are numbered 1, 2 and 3 (or 0, 1 and 2) by a column, or by their order. The sender of the first is the initiator;
    the sender of the third distinguishes "ds" from "ds-alt". Raises `ImportTableError`.
    """
    rows, of_messages = staging.rows, layout != "parts"
    staging.require(rows, {"messages": ("tx", "rx"), "stamps": ("stamp", "event", "message")}.get(layout, ()))
    staging.watch("sorting", 0.0)
    rows = staging.faults.reject(rows, SOUND_IDS)
    message, follows = "place", ""
    if of_messages and rows.has("message"):
        some, zeros, largest = rows.values("count(message), count(*) FILTER (message = 0), max(message)")
        # Numbers start at 0 if many are 0; a few zeros are damaged cells.
        message = "message + 1" if some and largest <= 2 and 4 * zeros > some else "message"
        # A group ends if a message does not follow the previous one. Stamps of one message have any order; with numbers
        # of exchanges these identify a group, because the devices' logs may be out of step.
        follows = "message > lag(message) OVER ()" if layout == "messages" else ""
        follows = "message >= lag(message) OVER ()" if layout == "stamps" and not rows.has("sequence") else follows
    first, cells = f"{message} = 1", dict[str, tuple[str, str]]()
    if of_messages:
        theirs = {name: name for name in ("tx", "rx", "fpp", "rxp", "skew", "sts") if rows.has(name)} | {
            "sender": "from_id"
        }
        if layout == "stamps":
            theirs |= {name: f"CASE WHEN event = {k} THEN stamp END" for k, name in ((1.0, "tx"), (2.0, "rx"))}
        for n in (1, 2, 3):
            cells |= {f"{name}{n}": (cell, f"{message} = {n}") for name, cell in theirs.items()}
        cells |= {name: (name, "true") for name in ("gt_range_m", "range_m") if rows.has(name)}
    else:
        # The initiator is the first id in the row with the first stamp.
        first = "tx1 IS NOT NULL" if rows.has("tx1") else "false"
        cells = {name: (name, "true") for name in rows.columns if name not in ("origin", *IDS, "time_ns")}
    # Numbers distinguish the rows of messages.
    told_apart = STAMPS if layout != "messages" else ()
    twice = [f"count({cell}) FILTER ({where}) > 1" for n, (cell, where) in cells.items() if n in told_apart]
    values: dict[str, str] = {
        name: f"any_value({name}) FILTER (first)" for name in ("origin", "time_ns") if name in rows.columns
    }
    values |= {n: f"coalesce(arg_min({n}, serial) FILTER ({first}), any_value({n}) FILTER (first))" for n in IDS}
    values |= {name: f"max({cell}) FILTER ({where})" for name, (cell, where) in cells.items()}
    values |= {"conflict": " OR ".join(twice) or "false"}
    staging.watch("grouping", 0.0)
    groups = _group(rows, values, follows, staging.column_map.within_s)
    conflict = Condition("event" if layout == "stamps" else "sequence", "one value of each stamp", "conflict")
    columns = tuple(name for name in values if name != "conflict" and not name.startswith("sender"))
    if not of_messages:
        return replace(staging.faults.reject(groups, [conflict]), columns=columns), None
    second, third, by_initiator = groups.values("count(sender2), count(sender3), count(*) FILTER (sender3 = from_id)")
    protocol = "ss" if 2 * third <= second else "ds-alt" if 2 * by_initiator > third else "ds"
    senders = ["from_id", "to_id", *({"ds": ["to_id"], "ds-alt": ["from_id"]}.get(protocol, []))]
    whole = " AND ".join(f"coalesce(sender{n} = {sender}, false)" for n, sender in enumerate(senders, start=1))
    incomplete = Condition("message", "messages 1, 2 (and 3) of one exchange", f"NOT ({whole})")
    columns = tuple(name for name in columns if protocol != "ss" or name not in ("tx3", "rx3"))
    return replace(staging.faults.reject(groups, [incomplete, conflict]), columns=columns), protocol


def broadcast_exchanges(staging: Staging) -> tuple[StagedRows, str]:
    """Return the exchanges in broadcasts whose senders list receptions, and their protocol.

    Adds the receptions, and overheard exchanges of third tags, to the other rows. Raises `ImportTableError`.
    """
    staging.require(staging.rows, ("tx", "rx", "sequence", "heard"))
    if staging.column_map.factor("tx") != 1.0:
        raise ImportTableError(f"{staging.paths[0]}: units.stamps: broadcasts need ticks")
    whole = [Condition(name, "a whole number", f"{name} IS NULL") for name in ("tx", "rx", "sequence", "heard")]
    rows = staging.faults.reject(staging.rows, [*SOUND_IDS, *time_conditions(staging.rows), *whole])
    sample, db = rows.sample(SAMPLE_ROWS), staging.db
    bits, _ = counter_format((sample[name] for name in ("tx", "rx")), staging.column_map.bits, "wrapped")
    named = "from_id, sequence, tx, min(origin) AS first" + (", min(time_ns) AS time_ns" if rows.has("time_s") else "")
    # Without times, a restart (numbers restart) takes longer than a wrap of the counter, so no exchange spans it.
    again = "sum(coalesce((sequence < before)::INT, 0)) OVER (ORDER BY first)"
    time = f"{again} * {round(2**bits * TICK_S * 2e9)} AS time_ns"
    db.execute(
        f"CREATE TABLE frames AS SELECT * EXCLUDE (before){'' if rows.has('time_s') else f', {time}'} FROM (SELECT *, "
        f"lag(sequence) OVER (PARTITION BY from_id ORDER BY first) AS before FROM (SELECT {named} FROM {rows.name} "
        f"WHERE {rows.condition} GROUP BY from_id, sequence, tx)) ORDER BY first"
    )
    # Numbers of frames restart if a board restarts. A broadcast may be logged after broadcasts that list it.
    heard = (
        "SELECT f.time_ns, f.rowid AS frame, f.from_id AS sender, r.from_id AS listener, f.tx, min(r.rx) AS rx "
        f"FROM (SELECT *, origin + 1000 AS until FROM {rows.name} WHERE {rows.condition}) r ASOF JOIN frames f "
        "ON r.to_id = f.from_id AND r.heard = f.sequence AND r.until >= f.first GROUP BY ALL ORDER BY frame, listener"
    )
    with raising(ImportTableError, str(staging.paths[0]), ArgumentError):
        receptions = Receptions.from_arrays(**dict(db.execute(heard).fetchnumpy()), bits=bits)
        if not rows.has("time_s"):
            receptions = replace(receptions, time_ns=receptions.time_ns + times_by_stamps(receptions))
        exchanges, overheard = exchanges_in(receptions)
    if wrong := np.count_nonzero(contradicted(receptions)):
        staging.notes.append(
            f"{wrong} of {len(receptions)} receptions are not used, because others of their link contradict them"
        )
    staging.beside = {"receptions": receptions.to_dict(), "overheard": overheard}
    db.register(
        "found",
        {"from_id": exchanges.initiator, "to_id": exchanges.target, "time_ns": exchanges.time_ns}
        | {n: getattr(exchanges, n) for n in STAMPS},
    )
    db.execute("CREATE TABLE exchanges AS SELECT row_number() OVER () - 1 AS origin, * FROM found")
    return StagedRows(db, "exchanges", ("origin", *IDS, "time_ns", *STAMPS)), "ds"


def _group(rows: StagedRows, values: Mapping[str, str], follows: str, within_s: float) -> StagedRows:
    """Return a table with one row for each group; `values` are its columns as SQL aggregates over the group's rows.

    In them `first` is true for the first row of a group, and `place` counts its rows from 1. Rows are sorted by keys,
    time and original order. A group also ends if the condition `follows` is not true.
    """
    # DuckDB sorts in half the time if the keys have 32 bytes or less, including one for each column.
    cells = {name: name for name in rows.columns}
    kinds = {"sequence": "BIGINT", "message": "TINYINT"}
    cells |= {name: f"TRY_CAST(trunc({name}) AS {kind})" for name, kind in kinds.items() if name in cells}
    cells["link"] = "CAST(CAST(least(from_id, to_id) AS UINTEGER) * 65536 + greatest(from_id, to_id) AS UINTEGER)"
    keys = ["link", *(name for name in ("sequence",) if name in cells)]
    order = ", ".join([*keys, *(name for name in ("time_ns",) if name in cells), "origin"])
    rows.db.execute(
        f"CREATE TABLE sorted AS SELECT {selected(cells)} FROM {rows.name} WHERE {rows.condition} ORDER BY {order}"
    )
    same = [f"{key} IS NOT DISTINCT FROM lag({key}) OVER ()" for key in keys]
    if "time_ns" in cells:
        gap = "CAST(time_ns AS DOUBLE) - CAST(lag(time_ns) OVER () AS DOUBLE)"
        same.append(f"coalesce({gap} <= {within_s * 1e9!r}, time_ns IS NULL AND lag(time_ns) OVER () IS NULL)")
    same += [f"coalesce({follows}, false)"] if follows else []
    marked = f"SELECT *, rowid AS serial, NOT ({' AND '.join(same)}) AS first FROM sorted"
    # Windows without ORDER BY stream through the rows.
    start = "max(CASE WHEN first THEN serial END) OVER (ROWS UNBOUNDED PRECEDING)"
    placed = f"SELECT *, {start} AS start, serial - {start} + 1 AS place FROM ({marked})"
    rows.db.execute(
        f"CREATE TABLE exchanges AS SELECT {selected(values)} FROM ({placed}) GROUP BY start ORDER BY start"
    )
    rows.db.execute("DROP TABLE sorted")
    return StagedRows(rows.db, "exchanges", tuple(values))
