"""The exchanges in staged tables: rows of one exchange combined, and unusable rows as faults with file, line and cell.

A row is an exchange, or a message with the stamps of its sender and its receiver ("messages"), or one of these stamps
("stamps"), or has some of the columns of an exchange, for example if both devices report ("parts"). Rows belong to one
group if they have the same devices and numbers and follow each other within `within_s` of the map. The rows are sorted
by these keys, so that each group is contiguous. Only DuckDB's sort holds many rows at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from uwblink.arrays import Ints
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import IDS
from uwblink.importers.plausibility import counter_format
from uwblink.importers.staging import StagedRows, Staging, Watch, unwatched
from uwblink.importers.tables import Columns
from uwblink.recording.schema import Fault
from uwblink.twr import LARGEST_ID, STAMPS

FAULTS_AT_ONCE: Final = 100_000


class Condition(NamedTuple):
    """A condition that makes a row unusable: column, expected value, and SQL that is true for unusable rows."""

    column: str
    expected: str
    wrong: str


ENDS: Final = (
    *(Condition(name, f"a whole number from 0 to {LARGEST_ID}", f"{name} IS NULL") for name in IDS),
    Condition("to_id", "another tag than from_id", "from_id = to_id"),
)
"""Conditions on the ids of the two devices."""

_TIME: Final = Condition("time_s", "a time", "time_ns IS NULL")


class Faults:
    """Unusable rows, with the first reason of each."""

    def __init__(self, staging: Staging) -> None:
        """See `reject`."""
        self._staging = staging
        self._reasons: list[Condition] = []
        staging.db.execute("CREATE TABLE faulty (origin BIGINT, reason INTEGER)")

    def reject(self, rows: StagedRows, conditions: Sequence[Condition], among: str = "true") -> str:
        """Record the rows that fulfil a condition as unusable; returns SQL that is true for the others."""
        first = len(self._reasons)
        self._reasons += conditions
        cases = " ".join(f"WHEN {one.wrong} THEN {first + k}" for k, one in enumerate(conditions))
        query = f"SELECT origin, CASE {cases} END AS reason FROM {rows.name} WHERE {among}"
        rows.db.execute(f"INSERT INTO faulty SELECT * FROM ({query}) WHERE reason IS NOT NULL")
        return f"{among} AND CASE {cases} END IS NULL"

    def __len__(self) -> int:
        """Return the number of unusable rows, without those with too many cells."""
        return int(self._staging.db.execute("SELECT count(*) FROM faulty").fetchall()[0][0])

    def check(self, total: int) -> None:
        """Raise `ImportTableError` with the first unusable row if half of all rows or more are unusable."""
        if len(self) and 2 * len(self) >= total:
            order = "ORDER BY origin, reason LIMIT 1"
            ((origin, reason),) = self._staging.db.execute(f"SELECT origin, reason FROM faulty {order}").fetchall()
            path = self._staging.paths[int(self._files(np.array([origin]))[0])]
            (fault,) = self._described(np.array([origin]), np.array([reason]), np.array([0]))
            raise ImportTableError(f"{path}: {fault.detail}")

    def __iter__(self) -> Iterator[list[Fault]]:
        """Yield blocks of faults in the order of their rows; rows with too many cells come last."""
        db, timed = self._staging.db, self._staging.rows.has("time_s")
        time = "coalesce(time_ns, 0)" if timed else "0"
        joined = f"SELECT f.*, {time} AS time_ns FROM faulty f JOIN rows USING (origin) ORDER BY origin, reason"
        db.execute(f"CREATE OR REPLACE TABLE faults AS {joined}")
        for start in range(0, len(self), FAULTS_AT_ONCE):
            place = f"rowid >= {start} AND rowid < {start + FAULTS_AT_ONCE}"
            found = db.execute(f"SELECT * FROM faults WHERE {place}").fetchnumpy()
            yield self._described(*(np.ma.getdata(found[name]) for name in ("origin", "reason", "time_ns")))
        for table in self._staging.tables:
            lines = table.rejected().tolist()
            for start in range(0, len(lines), FAULTS_AT_ONCE):
                details = [f"row {n}: more cells than the header has" for n in lines[start : start + FAULTS_AT_ONCE]]
                yield [Fault(0, table.path.name, "unusable row", detail) for detail in details]

    def _files(self, origin: Ints) -> Ints:
        return np.searchsorted(self._staging.offsets, origin, side="right") - 1

    def _described(self, origin: Ints, reason: Ints, time_ns: Ints) -> list[Fault]:
        """Return faults of rows in ascending order; the arguments are arrays (n,)."""
        column_map, found = self._staging.column_map, []
        files = self._files(origin)
        for k in np.unique(files).tolist():
            table, mine = self._staging.tables[k], files == k
            rows = origin[mine] - self._staging.offsets[k]
            reasons = [self._reasons[number] for number in reason[mine].tolist()]
            headers = {one.column: column_map.header(one.column) for one in reasons}
            there = [name for name, header in headers.items() if header in table.names]
            words = table.words_at([headers[name] for name in there], rows)
            for row, line, when, why in zip(
                rows.tolist(), table.lines(rows).tolist(), time_ns[mine].tolist(), reasons, strict=True
            ):
                place = f"column {headers[why.column][:60]!r}"
                if why.column in column_map.constants:
                    place = f"constant {why.column!r}: found {str(column_map.constants[why.column])[:40]!r}"
                elif why.column in there and row in words:
                    place += f": found {words[row][headers[why.column]][:40]!r}"
                found.append(
                    Fault(when, table.path.name, "unusable row", f"row {line}, {place}, expected {why.expected}")
                )
        return found


@dataclass(frozen=True, slots=True)
class UsableRows:
    """The rows for which an SQL condition is true, and their number."""

    rows: StagedRows
    condition: str
    count: int

    def blocks(self) -> Iterator[Columns]:
        """Yield the rows in their order, block by block; empty blocks are left out."""
        return (columns for columns in self.rows.blocks(self.condition) if len(columns["origin"]))

    def sample(self, size: int) -> Columns:
        """Return a pseudo-random sample of the rows, in their order."""
        chosen = f"SELECT row FROM {self.rows.name} WHERE {self.condition} ORDER BY hash(row) LIMIT {size}"
        return self.rows.read(f"WHERE row IN ({chosen}) ORDER BY row")

    def tags(self) -> list[int]:
        """Return the ids of all devices, in ascending order."""
        ends = (f"SELECT {name} AS id FROM {self.rows.name} WHERE {self.condition}" for name in IDS)
        return [int(tag) for (tag,) in self.rows.db.execute(f"{' UNION '.join(ends)} ORDER BY id").fetchall()]


def usable_ranges(rows: StagedRows, faults: Faults, among: str) -> UsableRows:
    """Return the rows that have a range without stamps."""
    timed = [_TIME] if rows.has("time_s") else []
    return _usable(
        rows, faults.reject(rows, [*timed, Condition("range_m", "a finite number", "range_m IS NULL")], among)
    )


def usable_exchanges(
    staging: Staging, rows: StagedRows, faults: Faults, among: str, stamps: Iterable[str]
) -> tuple[UsableRows, int, int, str]:
    """Return the rows that have all stamps, without repetitions of an exchange.

    Also returns the number of repetitions, and width and format of the counter.
    """
    scale, names = staging.column_map.ticks_per_unit, list(stamps)
    ticks = {name: name if scale == 1.0 else f"{name} * {scale!r}" for name in names}

    def count(low: float, high: float) -> int:
        span = f">= CAST('{low!r}' AS DOUBLE)", f"< CAST('{high!r}' AS DOUBLE)"
        parts = (f"count(*) FILTER ({value} {span[0]} AND {value} {span[1]})" for value in ticks.values())
        return int(rows.db.execute(f"SELECT {' + '.join(parts)} FROM {rows.name}").fetchall()[0][0])

    bits, counter = counter_format(count, staging.column_map.bits, staging.column_map.counter)
    largest = (1 << bits) - 1
    low = 0 if counter == "wrapped" else -(1 << (bits - 1))
    expected = f"{'a whole number' if scale == 1.0 else 'a stamp in ticks'} from {low} to {largest}"
    conditions = [_TIME] if rows.has("time_s") else []
    for name, value in ticks.items():
        wrong = [] if counter == "unwrapped" else [f"{value} < {low} OR {value} >= {low + largest + 1}"]
        wrong += [f"{value} <> trunc({value})"] if scale == 1.0 else []
        conditions.append(Condition(name, "a finite number", f"{name} IS NULL"))
        conditions += [Condition(name, expected, " OR ".join(wrong))] if wrong else []
    good = faults.reject(rows, conditions, among)
    # Two of 10 million different exchanges have the same hash of 64 bits once in 400,000 tables.
    code = f"hash({', '.join([*IDS, *names])})"
    some = f"({good}) AND ({' OR '.join(f'{name} <> 0' for name in names)})"
    twice = f"SELECT {code} AS code, min(row) AS first FROM {rows.name} WHERE {some} GROUP BY code HAVING count(*) > 1"
    later = f"SELECT row FROM {rows.name} JOIN ({twice}) ON {code} = code WHERE {some} AND row > first"
    rows.db.execute(f"CREATE TABLE repeats AS {later}")
    repeats = int(rows.db.execute("SELECT count(*) FROM repeats").fetchall()[0][0])
    if repeats:
        good += " AND row NOT IN (SELECT row FROM repeats)"
    return _usable(rows, good), repeats, bits, counter


def _usable(rows: StagedRows, condition: str) -> UsableRows:
    return UsableRows(rows, condition, rows.count(condition))


_PAIR: Final = "CAST(least(from_id, to_id) AS UINTEGER) * 65536 + greatest(from_id, to_id)"
_POWERS: Final = ("fpp", "rxp", "skew")
_WHOLE: Final = ("gt_range_m", "range_m")
"""Columns that belong to the whole exchange."""


def assemble_exchanges(
    staging: Staging, layout: str, faults: Faults, watch: Watch = unwatched
) -> tuple[StagedRows, str, str | None]:
    """Combine rows of "messages", "stamps" or "parts" into exchanges.

    Returns the rows, an SQL condition that holds for complete exchanges, and the protocol, if the rows determine it.
    Incomplete exchanges are faults. Raises `ImportTableError`.
    """
    rows, within_s = staging.rows, staging.column_map.within_s
    needed = {"messages": ("tx", "rx"), "stamps": ("stamp", "event", "message"), "parts": ()}
    staging.require(rows, needed[layout])
    watch("sorting", 0.0)
    good = faults.reject(rows, ENDS)
    if layout == "stamps":
        rows, good = _messages_of_stamps(rows, good, faults, within_s)
    watch("grouping", 0.0)
    if layout == "parts":
        return _exchanges_of_parts(rows, good, faults, within_s)
    return _exchanges_of_messages(rows, good, faults, within_s)


def _grouped(
    rows: StagedRows,
    good: str,
    name: str,
    link: str,
    numbers: Sequence[str],
    within_s: float,
    values: Mapping[str, str],
    *,
    ascending: bool = False,
) -> StagedRows:
    """Return a table with one row for each group; `values` are its columns as SQL aggregates over the group's rows.

    In these `first` is true for the first row of a group, and `place` counts its rows from 1. Rows are sorted by keys,
    time and original order. With `ascending` a group ends where the number of the message does not increase.
    """
    # DuckDB sorts in half the time if the keys have 32 bytes or less, including one for each column.
    cells = {name: name for name in rows.columns} | {"origin": "CAST(origin AS UINTEGER)"}
    kinds = {"sequence": "BIGINT", "message": "TINYINT"}
    cells |= {name: f"TRY_CAST(trunc({name}) AS {kind})" for name, kind in kinds.items() if name in cells}
    cells |= {"link": f"CAST({link} AS UINTEGER)", "turn": "CAST(row AS UINTEGER)"}
    listed = ", ".join(f"{cell} AS {column}" for column, cell in cells.items())
    timed = ["time_ns"] if rows.has("time_s") else []
    keys = ["link", *(name for name in numbers if name in cells)]
    order = ", ".join([*keys, *timed, "turn"])
    rows.db.execute(f"CREATE TABLE sorted AS SELECT {listed} FROM {rows.name} WHERE {good} ORDER BY {order}")
    same = [f"{key} IS NOT DISTINCT FROM lag({key}) OVER ()" for key in keys]
    if timed:
        gap = "CAST(time_ns AS DOUBLE) - CAST(lag(time_ns) OVER () AS DOUBLE)"
        same.append(f"coalesce({gap} <= {within_s * 1e9!r}, time_ns IS NULL AND lag(time_ns) OVER () IS NULL)")
    if ascending:
        same.append("coalesce(message > lag(message) OVER (), false)")
    marked = f"SELECT *, rowid AS serial, NOT ({' AND '.join(same)}) AS first FROM sorted"
    # Windows without ORDER BY stream through the rows.
    start = "max(CASE WHEN first THEN serial END) OVER (ROWS UNBOUNDED PRECEDING)"
    placed = f"SELECT *, {start} AS start, serial - {start} + 1 AS place FROM ({marked})"
    listed = ", ".join(f"{value} AS {column}" for column, value in values.items())
    rows.db.execute(f"CREATE TABLE {name}_groups AS SELECT {listed} FROM ({placed}) GROUP BY start ORDER BY start")
    rows.db.execute("DROP TABLE sorted")
    rows.db.execute(f"CREATE VIEW {name} AS SELECT rowid AS row, * FROM {name}_groups")
    return StagedRows(rows.db, name, tuple(values))


def _of_first(rows: StagedRows, *more: str) -> dict[str, str]:
    """Return aggregates that take columns from the first row of a group."""
    names = ("origin", "from_id", "to_id", "time_ns", *more)
    return {name: f"any_value({name}) FILTER (first)" for name in names if name in rows.columns}


def _exchanges_of_messages(rows: StagedRows, good: str, faults: Faults, within_s: float) -> tuple[StagedRows, str, str]:
    """Combine messages into exchanges; returns rows, the condition for complete exchanges, and the protocol of most.

    Messages are numbered 1, 2 and 3 (or 0, 1 and 2) by a column, or by their order. The sender of the first is the
    initiator; the sender of the third distinguishes "ds" from "ds-alt".
    """
    number = "place"
    if rows.has("message"):
        numbers = "count(message), count(*) FILTER (message = 0), max(message)"
        ((some, zeros, largest),) = rows.db.execute(f"SELECT {numbers} FROM {rows.name} WHERE {good}").fetchall()
        # Numbers begin at 0 if many are 0; a few zeros are damaged cells.
        number = "message + 1" if some and largest <= 2 and 4 * zeros > some else "message"
    values = _of_first(rows, *_WHOLE)
    for n in (1, 2, 3):
        taken = {f"sender{n}": "from_id", f"tx{n}": "tx", f"rx{n}": "rx"}
        taken |= {f"{level}{n}": level for level in _POWERS if n < 3}
        values |= {o: f"max({theirs}) FILTER ({number} = {n})" for o, theirs in taken.items() if theirs in rows.columns}
    groups = _grouped(rows, good, "exchanges", _PAIR, ("sequence",), within_s, values, ascending=rows.has("message"))
    votes = "count(sender2), count(sender3), count(*) FILTER (sender3 = from_id)"
    ((second, third, by_initiator),) = rows.db.execute(f"SELECT {votes} FROM exchanges").fetchall()
    protocol = "ss" if 2 * third <= second else "ds-alt" if 2 * by_initiator > third else "ds"
    senders = ["from_id", "to_id", *({"ds": ["to_id"], "ds-alt": ["from_id"]}.get(protocol, []))]
    whole = " AND ".join(f"coalesce(sender{n} = {sender}, false)" for n, sender in enumerate(senders, start=1))
    condition = Condition("message", "messages 1, 2 (and 3) of one exchange", f"NOT ({whole})")
    columns = tuple(n for n in values if not n.startswith("sender") and (protocol != "ss" or n not in ("tx3", "rx3")))
    return StagedRows(rows.db, "exchanges", columns), faults.reject(groups, [condition]), protocol


def _messages_of_stamps(rows: StagedRows, good: str, faults: Faults, within_s: float) -> tuple[StagedRows, str]:
    """Combine stamps into messages; returns rows and the condition that both stamps are there once."""
    cells = [n for n in ("sequence", "message", *_POWERS, *_WHOLE) if n in rows.columns]
    values = _of_first(rows) | {name: f"max({name})" for name in cells}
    for name, event in (("tx", 1), ("rx", 2)):
        values |= {name: f"max(stamp) FILTER (event = {event})", f"{name}_count": f"count(*) FILTER (event = {event})"}
    messages = _grouped(
        rows, good, "messages", "CAST(from_id AS UINTEGER) * 65536 + to_id", ("sequence", "message"), within_s, values
    )
    wrong = Condition("event", "one tx and one rx of a message", "tx_count <> 1 OR rx_count <> 1")
    return messages, faults.reject(messages, [wrong])


def _exchanges_of_parts(rows: StagedRows, good: str, faults: Faults, within_s: float) -> tuple[StagedRows, str, None]:
    """Combine rows with some of the columns into exchanges; the condition is that no stamp has two values."""
    # The initiator is whoever the row with its first stamp names first.
    values = _of_first(rows)
    if rows.has("tx1"):
        values = {
            name: f"coalesce(arg_min({name}, serial) FILTER (tx1 IS NOT NULL), {value})"
            for name, value in values.items()
        }
    cells = [name for name in rows.columns if name not in values]
    counted = [name for name in STAMPS if name in cells]
    values |= {name: f"max({name})" for name in cells} | {f"{name}_count": f"count({name})" for name in counted}
    groups = _grouped(rows, good, "exchanges", _PAIR, ("sequence",), within_s, values)
    twice = " OR ".join(f"{name}_count > 1" for name in counted) or "false"
    wrong = Condition("sequence", "one value of each column an exchange", twice)
    columns = tuple(name for name in values if not name.endswith("_count"))
    return StagedRows(rows.db, "exchanges", columns), faults.reject(groups, [wrong]), None
