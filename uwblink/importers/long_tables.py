"""Tables in which an exchange has several rows, converted into one row for each exchange.

A row is a message with the stamps of its sender and its receiver ("messages"), or one of these stamps ("stamps"), or
has some of the columns of an exchange, for example if both devices report ("parts"). Rows belong to one group if they
have the same devices and numbers and follow each other within `within_s` of the map. The rows are sorted by these keys,
so that each group is contiguous. Only DuckDB's sort holds many rows at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from uwblink.importers.staging import StagedRows, Staging, Watch
from uwblink.importers.usable_rows import ENDS, Condition, Faults
from uwblink.twr import STAMPS

_PAIR: Final = "CAST(least(from_id, to_id) AS UINTEGER) * 65536 + greatest(from_id, to_id)"
_POWERS: Final = ("fpp", "rxp", "skew")
_WHOLE: Final = ("gt_range_m", "range_m")
"""Columns that belong to the whole exchange."""


def assemble_exchanges(
    staging: Staging, layout: str, faults: Faults, watch: Watch | None = None
) -> tuple[StagedRows, str, str | None]:
    """Combine rows of "messages", "stamps" or "parts" into exchanges.

    Returns the rows, an SQL condition that holds for complete exchanges, and the protocol, if the rows determine it.
    Incomplete exchanges are faults. Raises `ImportTableError`.
    """
    rows, within_s = staging.rows, staging.column_map.within_s
    needed = {"messages": ("tx", "rx"), "stamps": ("stamp", "event", "message"), "parts": ()}
    for name in needed[layout]:
        if not rows.has(name):
            raise staging.missing(name)
    if watch:
        watch("sorting", 0.0)
    good = faults.reject(rows, ENDS)
    if layout == "stamps":
        rows, good = _messages_of_stamps(rows, good, faults, within_s)
    if watch:
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
