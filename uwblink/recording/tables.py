"""The tables of an open recording: reading and appending rows."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Columns
from uwblink.display import printable
from uwblink.errors import RecordingError, raising
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.schema import (
    POSE,
    TABLES,
    Arrangement,
    CirRow,
    Fault,
    FrameRow,
    KnownDistance,
    Poses,
    Tag,
)
from uwblink.recording.store import Store, decode_json
from uwblink.ticks import REPORT_BITS
from uwblink.twr import BITS, COLUMNS, Exchanges

EXCHANGES_PER_BLOCK: Final = 131_072
"""Exchanges of a block: a little more than a row group of DuckDB (122880)."""


_MISSING: Final[dict[str, tuple[Any, type]]] = {
    "VARCHAR": ("", np.str_),
    "BOOLEAN": (False, np.bool_),
    "DOUBLE": (np.nan, np.float64),
    "BIGINT": (0, np.int64),
    "USMALLINT": (0, np.int64),
}
"""What stands for a missing value in a column, and the type of the column's array."""

_ORDER: Final = {
    "poses": "time_ns, body",
    "corrected": "rowid",
    "tags": "tag",
    "arrangements": "start_ns",
    "distances": "first, second",
}
"""Order of the rows of tables that are not read in order of time."""


class Tables(Store):
    """Methods that read and append rows; each raises `RecordingError` if it fails.

    Methods with `start_ns` and `end_ns` return the rows from the first until before the second.
    """

    def append(self, table: str, what: Any) -> None:
        """Append exchanges, poses, columns or rows to one of `TABLES`, in the form in which they are read.

        Rows can also be mappings of the table's columns.
        """
        known_tables([table])
        if isinstance(what, Exchanges | Poses):
            what = what.to_dict()
        elif not isinstance(what, Mapping):
            values = zip(*(_record(row, table) for row in what), strict=True)
            what = {n: _column(kind, v) for (n, kind), v in zip(TABLES[table].items(), values, strict=False)}
        self._insert(table, what)

    def append_meta(self, meta: Mapping[str, Any]) -> None:
        """Add entries to `meta`, replacing those with the same key; values are stored as JSON."""
        for key, value in meta.items():
            with raising(RecordingError, f"{self.path}: meta {key!r}: cannot be stored as JSON", TypeError, ValueError):
                text = json.dumps(value, sort_keys=True, allow_nan=False)
            self._execute("DELETE FROM meta WHERE key = ?", [key])
            self._execute("INSERT INTO meta VALUES (?, ?)", [key, text])

    def append_tags(self, tags: Iterable[Tag]) -> None:
        """Add tags with their bodies and lever arms."""
        self.append("tags", tags)

    def append_exchanges(self, exchanges: Exchanges) -> None:
        """Add exchanges, in one transaction."""
        self.append("exchanges", exchanges)

    def append_poses(self, poses: Poses) -> None:
        """Add poses, in one transaction."""
        self.append("poses", poses)

    def replace_poses(self, poses: Poses, meta: Mapping[str, Any], tags: Iterable[Tag] | None = None) -> None:
        """Replace the poses, and the tags if given."""
        with self.transaction():
            self._execute("DELETE FROM poses")
            self.append_poses(poses)
            self.append_meta(meta)
            if tags is not None:
                self._execute("DELETE FROM tags")
                self.append_tags(tags)

    def meta(self) -> dict[str, Any]:
        """Return all entries of `meta`, decoded."""
        rows = self._fetch("SELECT key, value FROM meta ORDER BY key")
        return {str(key): decode_json(value, self.path, str(key)) for key, value in rows}

    def count(self, table: str) -> int:
        """Return the number of rows of one of `TABLES`."""
        known_tables([table])
        return int(self._fetch(f"SELECT count(*) FROM {table}")[0][0])  # noqa: S608 - a key of TABLES

    def tally(self, table: str, *columns: str) -> dict[tuple[Any, ...], int]:
        """Return the number of rows of one of `TABLES` by the values of some columns, in ascending order.

        Rows with a missing value are left out.
        """
        known_tables([table])
        there = " AND ".join(f"{name} IS NOT NULL" for name in columns)
        query = f"SELECT {', '.join(columns)}, count(*) FROM {table} WHERE {there} GROUP BY ALL ORDER BY ALL"  # noqa: S608 - names
        return {tuple(row[:-1]): int(row[-1]) for row in self._fetch(query)}

    def exchanges(self, start_ns: int | None = None, end_ns: int | None = None) -> Exchanges:
        """Return all exchanges in the order in which they were written."""
        return self._exchanges(_within(start_ns, end_ns))

    def exchange_blocks(self, rows: int = EXCHANGES_PER_BLOCK) -> Iterator[Exchanges]:
        """Return all exchanges in the same order, about so many `rows` at once."""
        return map(self._exchanges, self._blocks("exchanges", rows))

    def _exchanges(self, where: str) -> Exchanges:
        bits = self.meta().get("timestamp_bits", REPORT_BITS)
        if isinstance(bits, bool) or bits not in BITS:
            listed = " or ".join(map(str, BITS))
            raise RecordingError(f"{self.path}: meta timestamp_bits is {printable(bits):.40}, expected {listed}")
        plain = ", ".join(name for name in COLUMNS if name != "protocol")
        # Plug-ins are loaded only for unknown protocols.
        for known in ([row.name for row in PROTOCOLS.known()], list(PROTOCOLS)):
            code = f"list_position({known}, protocol)::TINYINT"
            columns = self._select(f"SELECT {plain}, {code} AS protocol FROM exchanges {where}")  # noqa: S608 - names are checked words
            codes = columns.pop("protocol")
            if not np.ma.is_masked(codes):
                found = {name: _filled(TABLES["exchanges"][name], column) for name, column in columns.items()}
                return Exchanges(protocol=np.array(known)[np.asarray(codes) - 1], bits=int(bits), **found)
        raise RecordingError(f"{self.path}: exchanges of an unknown protocol; known are {', '.join(known)}")

    def dividing_times(self, table: str, rows: int) -> list[int]:
        """Return the first and the last time of one of `TABLES`, and times between that leave about `rows` rows apart.

        An empty table has none.
        """
        parts = max(self.count(table) // rows, 1)
        shares = [part / parts for part in range(parts + 1)]
        ((found,),) = self._fetch(f"SELECT quantile_disc(time_ns, {shares}) FROM {table}")  # noqa: S608 - a key of TABLES
        return sorted(set(found or []))

    def poses(self, start_ns: int | None = None, end_ns: int | None = None) -> Poses:
        """Return all poses in order of time.

        Raises `RecordingError` for a body without a name, and for a pose without a time.
        """
        if self._fetch("SELECT 1 FROM poses WHERE body IS NULL OR time_ns IS NULL LIMIT 1"):
            raise RecordingError(f"{self.path}: table poses: a body without a name, or a pose without a time")
        r = self.columns("poses", start_ns, end_ns)
        position, quaternion = (np.column_stack([r[name] for name in names]) for names in (POSE[:3], POSE[3:]))
        return Poses(r["time_ns"], r["body"], position, quaternion)

    def columns(self, table: str, start_ns: int | None = None, end_ns: int | None = None) -> Columns:
        """Return one of `TABLES` as columns (n,) by name, in order of time.

        `corrected` is in the order of the exchanges. Missing values are "", False, NaN or 0.
        """
        known_tables([table])
        found = self._select(_query(table, start_ns, end_ns))
        return {name: _filled(TABLES[table][name], column) for name, column in found.items()}

    def corrected_is_of_exchanges(self) -> bool:
        """Return whether the table `corrected` has one row for each exchange; False if it is empty."""
        if not self.count("corrected"):
            return False
        differs = " OR ".join(f"e.{n} IS DISTINCT FROM c.{n}" for n in ("time_ns", "initiator", "target"))
        return not self._fetch(f"SELECT 1 FROM exchanges e POSITIONAL JOIN corrected c WHERE {differs} LIMIT 1")  # noqa: S608 - names

    def tags(self) -> list[Tag]:
        """Return the tags in order of id."""
        return [Tag(tag, body, (x, y, z)) for tag, body, x, y, z in self._rows("tags")]

    def frames(self) -> list[FrameRow]:
        """Return all raw bytes in order of time."""
        return [FrameRow(*row) for row in self._rows("frames")]

    def cirs(self) -> list[CirRow]:
        """Return all impulse responses in order of time."""
        return [CirRow(t, board, i, j, index, tuple(taps)) for t, board, i, j, index, taps in self._rows("cirs")]

    def faults(self, start_ns: int | None = None, end_ns: int | None = None) -> list[Fault]:
        """Return all faults in order of time."""
        return [Fault(*row) for row in self._rows("faults", start_ns, end_ns)]

    def arrangements(self) -> list[Arrangement]:
        """Return the spans of time in which boards stood still, in order of time; none in older files.

        Raises `RecordingError` for unknown shapes, and for orders of tags that are not on a line.
        """
        found = []
        for start_ns, end_ns, name, known in self._rows("arrangements"):
            shape, *order = known.split(" ")
            if not re.fullmatch(r"\S*|line( [0-9]{1,5})+", known) or len(set(order)) < len(order):
                expected = "a shape, or line and tags in their order, each once"
                raise RecordingError(
                    f"{self.path}: table arrangements: known: found {known!r:.40}, expected {expected}"
                )
            found.append(Arrangement(name, start_ns, end_ns, shape, tuple(map(int, order))))
        return found

    def known_distances(self) -> list[KnownDistance]:
        """Return the independently measured distances between tags, in order of tags; none in older files."""
        return [KnownDistance(*row) for row in self._rows("distances")]

    def _rows(self, table: str, start_ns: int | None = None, end_ns: int | None = None) -> list[tuple[Any, ...]]:
        """Return the rows of a table in its order; raises `RecordingError` for a missing value."""
        rows = self._fetch(_query(table, start_ns, end_ns))
        needed = 4 if table == "faults" else None  # all but the ends of the exchange, which most faults lack
        if empty := [row for row in rows if None in row[:needed]]:
            raise RecordingError(f"{self.path}: table {table}: a row with nothing in one of its columns, {empty[0]}")
        return rows


def _record(row: Any, table: str) -> tuple[Any, ...]:
    """Return the values of a row in the order of its table's columns."""
    if isinstance(row, Tag):
        return (row.tag, row.body, *row.lever_arm_m)
    if isinstance(row, Arrangement):
        return (row.start_ns, row.end_ns, row.name, " ".join([row.known, *map(str, row.order)]))
    if isinstance(row, Mapping):
        return tuple(row[name] for name in TABLES[table])
    return tuple(getattr(row, field.name) for field in fields(row))


def _column(kind: str, values: tuple[Any, ...]) -> NDArray[Any]:
    """Return values as a column, masked where they are None."""
    if kind == "BLOB" or kind.endswith("[]"):
        column = np.empty(len(values), dtype=object)
        column[:] = [list(value) if isinstance(value, tuple) else value for value in values]
        return column
    return np.ma.array([0 if value is None else value for value in values], mask=[value is None for value in values])


def _filled(kind: str, column: NDArray[Any]) -> NDArray[Any]:
    """Return a column of one of DuckDB's types with a value in place of missing ones."""
    missing, dtype = _MISSING.get(kind, (None, np.object_))
    return np.asarray(np.ma.filled(column, missing), dtype=dtype)


def known_tables(names: Iterable[str]) -> None:
    """Raise `RecordingError` for a table that recordings do not have."""
    if unknown := set(names) - TABLES.keys():
        raise RecordingError(f"no table {min(unknown)!r} in a recording; there are {', '.join(TABLES)}")


def _query(table: str, start_ns: int | None, end_ns: int | None) -> str:
    """Return the query for the rows of a table in a span of time, in the table's order."""
    where, order = _within(start_ns, end_ns), _ORDER.get(table, "time_ns")
    return f"SELECT {', '.join(TABLES[table])} FROM {table} {where} ORDER BY {order}, rowid"  # noqa: S608 - keys of TABLES


def _within(start_ns: int | None, end_ns: int | None) -> str:
    """Return the clause of a query for a span of time, of which either end may be open."""
    ends = ((">=", start_ns), ("<", end_ns))
    given = [f"time_ns {sign} {int(time_ns)}" for sign, time_ns in ends if time_ns is not None]
    return f"WHERE {' AND '.join(given)}" if given else ""
