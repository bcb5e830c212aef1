"""The exchanges in staged tables: rows of one exchange combined, and unusable rows as faults with file, line and cell.

A row is an exchange, or a message with the stamps of its sender and its receiver ("messages"), or one of these stamps
("stamps"), or has some of the columns of an exchange, for example if both devices report ("parts"). Rows belong to one
group if they have the same devices and numbers and follow each other within `within_s` of the map. The rows are sorted
by these keys, so that each group is contiguous. Only DuckDB's sort holds many rows at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

from uwblink.errors import ImportTableError
from uwblink.importers.column_map import IDS
from uwblink.importers.plausibility import SAMPLE_ROWS, counter_format
from uwblink.importers.staging import Rows, Staging, Watch
from uwblink.importers.tables import Table
from uwblink.recording.schema import Fault
from uwblink.twr import LARGEST_ID, STAMPS

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


class Faults:
    """Unusable rows, with the first reason of each."""

    def __init__(self, staging: Staging) -> None:
        """See `reject`."""
        self._staging = staging
        self._reasons: list[Condition] = []
        staging.db.execute("CREATE TABLE faulty (origin BIGINT, reason INTEGER)")

    def reject(self, rows: Rows, conditions: Sequence[Condition]) -> Rows:
        """Record the rows that fulfil a condition as unusable; returns the others."""
        cases = " ".join(f"WHEN {one.wrong} THEN {k}" for k, one in enumerate(conditions, start=len(self._reasons)))
        self._reasons += conditions
        query = f"SELECT origin, CASE {cases} END AS reason FROM {rows.name} WHERE {rows.condition}"
        rows.db.execute(f"INSERT INTO faulty SELECT * FROM ({query}) WHERE reason IS NOT NULL")
        return rows.where(f"CASE {cases} END IS NULL")

    def __len__(self) -> int:
        """Return the number of unusable rows, without those with too many cells."""
        return int(self._staging.db.execute("SELECT count(*) FROM faulty").fetchall()[0][0])

    def __iter__(self) -> Iterator[list[Fault]]:
        """Yield blocks of faults, those of each file in the order of their rows, then rows with too many cells."""
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

    def _describe(self, table: Table, found: Sequence[tuple[int, int, int]]) -> list[Fault]:
        """Return faults of a table: its rows, reasons and times."""
        column_map, faults = self._staging.column_map, []
        headers = {column_map.header(self._reasons[reason].column) for _, reason, _ in found}
        words = table.words_at([name for name in table.names if name in headers], [row for row, *_ in found])
        for row, reason, time_ns in found:
            column, expected, _ = self._reasons[reason]
            header = column_map.header(column)
            place = f"column {header[:60]!r}"
            if column in column_map.constants:
                place = f"constant {column!r}: found {str(column_map.constants[column])[:40]!r}"
            elif header in words.get(row, ()):
                place += f": found {words[row][header][:40]!r}"
            detail = f"row {table.line(row)}, {place}, expected {expected}"
            faults.append(Fault(time_ns, table.path.name, "unusable row", detail))
        return faults


def usable_ranges(rows: Rows, faults: Faults) -> Rows:
    """Return the rows that have a range without stamps."""
    return faults.reject(rows, [*_times(rows), Condition("range_m", "a finite number", "range_m IS NULL")])


def _times(rows: Rows) -> list[Condition]:
    return [Condition("time_s", "a time", "time_ns IS NULL")] if rows.has("time_s") else []


def usable_exchanges(staging: Staging, rows: Rows, faults: Faults, stamps: Sequence[str]) -> tuple[Rows, int, int, str]:
    """Return the rows that have all stamps, without repetitions of an exchange.

    Also returns the number of repetitions, and width and format of the counter.
    """
    column_map, sample = staging.column_map, rows.sample(SAMPLE_ROWS)
    scale = column_map.ticks_per_unit
    bits, counter = counter_format((sample[name] * scale for name in stamps), column_map.bits, column_map.counter)
    low = 0 if counter == "wrapped" else -(1 << (bits - 1))
    number = "a whole number" if scale == 1.0 else "a stamp in ticks"
    conditions = _times(rows)
    for name in stamps:
        conditions.append(Condition(name, "a whole number" if scale == 1.0 else "a finite number", f"{name} IS NULL"))
        if counter != "unwrapped":
            value, high = f"{name} * CAST('{scale!r}' AS DOUBLE)" if scale != 1.0 else name, low + (1 << bits)
            wrong = f"{value} < {low} OR {value} >= {high}"
            conditions.append(Condition(name, f"{number} from {low} to {high - 1}", wrong))
    good = faults.reject(rows, conditions)
    # Two of 10 million different exchanges have the same hash of 64 bits once in 400,000 tables.
    code, some = f"hash({', '.join([*IDS, *stamps])})", good.where(" OR ".join(f"{name} <> 0" for name in stamps))
    within = f"FROM {rows.name} WHERE {some.condition}"
    twice = f"SELECT {code} AS code, min(rowid) AS first {within} GROUP BY code HAVING count(*) > 1"
    later = (
        f"SELECT r.rowid FROM {rows.name} r JOIN ({twice}) ON {code} = code WHERE {some.condition} AND r.rowid > first"
    )
    staging.db.execute(f"CREATE TABLE repeats AS {later}")
    (repeats,) = Rows(staging.db, "repeats", ()).values("count(*)")
    return good.where("rowid NOT IN (SELECT rowid FROM repeats)") if repeats else good, repeats, bits, counter


def assemble_exchanges(staging: Staging, layout: str, faults: Faults, watch: Watch) -> tuple[Rows, str | None]:
    """Combine rows of "messages", "stamps" or "parts" into exchanges.

    Returns complete exchanges, and the protocol, if the rows determine it. Incomplete exchanges are faults. Messages
    are numbered 1, 2 and 3 (or 0, 1 and 2) by a column, or by their order. The sender of the first is the initiator;
    the sender of the third distinguishes "ds" from "ds-alt". Raises `ImportTableError`.
    """
    rows, of_messages = staging.rows, layout != "parts"
    staging.require(rows, {"messages": ("tx", "rx"), "stamps": ("stamp", "event", "message")}.get(layout, ()))
    watch("sorting", 0.0)
    rows = faults.reject(rows, SOUND_IDS)
    number, follows = "place", ""
    if of_messages and rows.has("message"):
        some, zeros, largest = rows.values("count(message), count(*) FILTER (message = 0), max(message)")
        # Numbers begin at 0 if many are 0; a few zeros are damaged cells.
        number = "message + 1" if some and largest <= 2 and 4 * zeros > some else "message"
        # A group ends where a message does not follow the one before. Stamps of one message have any order; those of a
        # sequence are told by its number, because the devices' logs may be out of step.
        follows = "message > lag(message) OVER ()" if layout == "messages" else ""
        follows = "message >= lag(message) OVER ()" if layout == "stamps" and not rows.has("sequence") else follows
    first, cells = f"{number} = 1", dict[str, tuple[str, str]]()
    if of_messages:
        theirs = {name: name for name in ("tx", "rx", "fpp", "rxp", "skew") if rows.has(name)} | {"sender": "from_id"}
        if layout == "stamps":
            theirs |= {name: f"CASE WHEN event = {k} THEN stamp END" for k, name in ((1.0, "tx"), (2.0, "rx"))}
        for n in (1, 2, 3):
            cells |= {f"{name}{n}": (cell, f"{number} = {n}") for name, cell in theirs.items()}
        cells |= {name: (name, "true") for name in ("gt_range_m", "range_m") if rows.has(name)}
    else:
        # The initiator is whoever the row with its first stamp names first.
        first = "tx1 IS NOT NULL" if rows.has("tx1") else "false"
        cells = {name: (name, "true") for name in rows.columns if name not in ("origin", *IDS, "time_ns")}
    # The rows of messages are told apart by their numbers.
    told_apart = STAMPS if layout != "messages" else ()
    twice = [f"count({cell}) FILTER ({where}) > 1" for n, (cell, where) in cells.items() if n in told_apart]
    values: dict[str, str] = {
        name: f"any_value({name}) FILTER (first)" for name in ("origin", "time_ns") if name in rows.columns
    }
    values |= {n: f"coalesce(arg_min({n}, serial) FILTER ({first}), any_value({n}) FILTER (first))" for n in IDS}
    values |= {name: f"max({cell}) FILTER ({where})" for name, (cell, where) in cells.items()}
    values |= {"conflict": " OR ".join(twice) or "false"}
    watch("grouping", 0.0)
    groups = _group(rows, values, follows, staging.column_map.within_s)
    conflict = Condition("event" if layout == "stamps" else "sequence", "one value of each stamp", "conflict")
    columns = tuple(name for name in values if name != "conflict" and not name.startswith("sender"))
    if not of_messages:
        return replace(faults.reject(groups, [conflict]), columns=columns), None
    second, third, by_initiator = groups.values("count(sender2), count(sender3), count(*) FILTER (sender3 = from_id)")
    protocol = "ss" if 2 * third <= second else "ds-alt" if 2 * by_initiator > third else "ds"
    senders = ["from_id", "to_id", *({"ds": ["to_id"], "ds-alt": ["from_id"]}.get(protocol, []))]
    whole = " AND ".join(f"coalesce(sender{n} = {sender}, false)" for n, sender in enumerate(senders, start=1))
    incomplete = Condition("message", "messages 1, 2 (and 3) of one exchange", f"NOT ({whole})")
    columns = tuple(name for name in columns if protocol != "ss" or name not in ("tx3", "rx3"))
    return replace(faults.reject(groups, [incomplete, conflict]), columns=columns), protocol


def _group(rows: Rows, values: Mapping[str, str], follows: str, within_s: float) -> Rows:
    """Return a table with one row for each group; `values` are its columns as SQL aggregates over the group's rows.

    In these `first` is true for the first row of a group, and `place` counts its rows from 1. Rows are sorted by keys,
    time and original order. A group also ends where the condition `follows` is not true.
    """
    # DuckDB sorts in half the time if the keys have 32 bytes or less, including one for each column.
    cells = {name: name for name in rows.columns}
    kinds = {"sequence": "BIGINT", "message": "TINYINT"}
    cells |= {name: f"TRY_CAST(trunc({name}) AS {kind})" for name, kind in kinds.items() if name in cells}
    cells["link"] = "CAST(CAST(least(from_id, to_id) AS UINTEGER) * 65536 + greatest(from_id, to_id) AS UINTEGER)"
    listed = ", ".join(f"{cell} AS {column}" for column, cell in cells.items())
    keys = ["link", *(name for name in ("sequence",) if name in cells)]
    order = ", ".join([*keys, *(name for name in ("time_ns",) if name in cells), "origin"])
    rows.db.execute(f"CREATE TABLE sorted AS SELECT {listed} FROM {rows.name} WHERE {rows.condition} ORDER BY {order}")
    same = [f"{key} IS NOT DISTINCT FROM lag({key}) OVER ()" for key in keys]
    if "time_ns" in cells:
        gap = "CAST(time_ns AS DOUBLE) - CAST(lag(time_ns) OVER () AS DOUBLE)"
        same.append(f"coalesce({gap} <= {within_s * 1e9!r}, time_ns IS NULL AND lag(time_ns) OVER () IS NULL)")
    same += [f"coalesce({follows}, false)"] if follows else []
    marked = f"SELECT *, rowid AS serial, NOT ({' AND '.join(same)}) AS first FROM sorted"
    # Windows without ORDER BY stream through the rows.
    start = "max(CASE WHEN first THEN serial END) OVER (ROWS UNBOUNDED PRECEDING)"
    placed = f"SELECT *, {start} AS start, serial - {start} + 1 AS place FROM ({marked})"
    listed = ", ".join(f"{value} AS {column}" for column, value in values.items())
    rows.db.execute(f"CREATE TABLE exchanges AS SELECT {listed} FROM ({placed}) GROUP BY start ORDER BY start")
    rows.db.execute("DROP TABLE sorted")
    return Rows(rows.db, "exchanges", tuple(values))
