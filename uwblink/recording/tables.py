"""The tables of an open recording: for each a method that reads it and one that appends to it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.display import printable
from uwblink.errors import RecordingError
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.distances import PoseWindows
from uwblink.recording.intake import decode_json
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
from uwblink.recording.store import Store
from uwblink.ticks import REPORT_BITS
from uwblink.twr import BITS, COLUMNS, Exchanges

Columns = dict[str, NDArray[Any]]
"""Columns of a table (n,) by name."""

ROWS_AT_ONCE: Final = 131_072
"""Exchanges of a block: a little more than a row group of DuckDB (122880)."""


class Tables:
    """Methods that read and append rows; each raises `RecordingError` if it fails.

    Methods with `start_ns` and `end_ns` return the rows from the first until before the second.
    """

    _store: Store
    path: Path

    def append(self, table: str, what: Any) -> None:
        """Append exchanges, poses, columns or rows to one of `TABLES`, in the form in which they are read."""
        known_tables([table])
        if isinstance(what, Mapping):
            self._store.insert(table, what)
        elif isinstance(what, Exchanges | Poses):
            self._store.insert(table, what.to_dict())
        else:
            records = [_record(row) for row in what]
            values = zip(*records, strict=True)
            kinds = TABLES[table].items()
            self._store.insert(table, {n: _column(kind, v) for (n, kind), v in zip(kinds, values, strict=False)})

    def append_meta(self, meta: Mapping[str, Any]) -> None:
        """Add entries to `meta`, replacing those with the same key; values are stored as JSON."""
        for key, value in meta.items():
            try:
                text = json.dumps(value, sort_keys=True, allow_nan=False)
            except (TypeError, ValueError) as error:
                raise RecordingError(f"{self.path}: meta {key!r}: cannot be stored as JSON ({error})") from error
            self._store.execute("DELETE FROM meta WHERE key = ?", [key])
            self._store.execute("INSERT INTO meta VALUES (?, ?)", [key, text])

    def append_tags(self, tags: Iterable[Tag]) -> None:
        """Add tags with their bodies and lever arms."""
        self.append("tags", tags)

    def append_exchanges(self, exchanges: Exchanges) -> None:
        """Add exchanges, in one transaction."""
        self.append("exchanges", exchanges)

    def append_poses(self, poses: Poses) -> None:
        """Add poses, in one transaction."""
        self.append("poses", poses)

    def append_faults(self, faults: Iterable[Fault]) -> None:
        """Add faults, in one transaction."""
        self.append("faults", faults)

    def append_arrangements(self, arrangements: Iterable[Arrangement]) -> None:
        """Add spans of time in which boards stood still."""
        self.append("arrangements", arrangements)

    def append_frames(self, rows: Iterable[FrameRow]) -> None:
        """Add raw bytes, in one transaction."""
        self.append("frames", rows)

    def append_overheard(self, rows: Iterable[Mapping[str, float]]) -> None:
        """Add overheard exchanges, one mapping of the table's columns each; NaN for missing values."""
        listed = list(rows)
        self.append("overheard", {n: np.array([row[n] for row in listed]) for n in TABLES["overheard"]})

    def append_cirs(self, rows: Iterable[CirRow]) -> None:
        """Add impulse responses, in one transaction."""
        self.append("cirs", rows)

    def transaction(self) -> AbstractContextManager[None]:
        """Return a context: everything appended in it is written at once, or not at all."""
        return self._store.transaction()

    def replace_poses(self, poses: Poses, meta: Mapping[str, Any], tags: Iterable[Tag] | None = None) -> None:
        """Replace the poses, and the tags if given."""
        with self.transaction():
            self._store.execute("DELETE FROM poses")
            self.append_poses(poses)
            self.append_meta(meta)
            if tags is not None:
                self._store.execute("DELETE FROM tags")
                self.append_tags(tags)

    def meta(self) -> dict[str, Any]:
        """Return all entries of `meta`, decoded."""
        rows = self._store.rows("SELECT key, value FROM meta ORDER BY key")
        return {str(key): decode_json(value, self.path, str(key)) for key, value in rows}

    def count(self, table: str) -> int:
        """Return the number of rows of one of `TABLES`."""
        known_tables([table])
        if table not in self._store.columns():
            return 0
        return int(self._store.rows(f"SELECT count(*) FROM {table}")[0][0])  # noqa: S608 - a key of TABLES

    def tally(self, table: str, *columns: str) -> dict[tuple[Any, ...], int]:
        """Return the number of rows of one of `TABLES` by the values of some columns, in ascending order.

        Rows with a missing value are left out; if the file lacks a column, all are.
        """
        known_tables([table])
        if not set(columns) <= self._store.columns().get(table, set()) & TABLES[table].keys():
            return {}
        names = ", ".join(f'"{name}"' for name in columns)
        there = " AND ".join(f'"{name}" IS NOT NULL' for name in columns)
        query = f"SELECT {names}, count(*) FROM {table} WHERE {there} GROUP BY ALL ORDER BY ALL"  # noqa: S608 - keys of TABLES
        return {tuple(row[:-1]): int(row[-1]) for row in self._store.rows(query)}

    def exchanges(self) -> Exchanges:
        """Return all exchanges in the order in which they were written."""
        return self._exchanges()

    def exchanges_between(self, start_ns: int, end_ns: int) -> Exchanges:
        """Return the exchanges from `start_ns` until before `end_ns`, in the order in which they were written."""
        return self._exchanges(f"{_within(start_ns, end_ns)} ORDER BY rowid")

    def exchange_blocks(self, rows: int = ROWS_AT_ONCE) -> Iterator[Exchanges]:
        """Yield all exchanges in the same order, about so many `rows` at once."""
        ((last,),) = self._store.rows("SELECT max(rowid) FROM exchanges")
        for start in range(0, 0 if last is None else int(last) + 1, rows):
            yield self._exchanges(f"WHERE rowid >= {start} AND rowid < {start + rows}")

    def _exchanges(self, where: str = "") -> Exchanges:
        bits = self.meta().get("timestamp_bits", REPORT_BITS)
        if isinstance(bits, bool) or bits not in BITS:
            listed = " or ".join(map(str, BITS))
            raise RecordingError(f"{self.path}: meta timestamp_bits is {printable(bits):.40}, expected {listed}")
        plain = ", ".join(name for name in COLUMNS if name != "protocol")
        # Plug-ins are loaded only for unknown protocols.
        for names in ([row.name for row in PROTOCOLS.known()], PROTOCOLS):
            known = list(names)
            code = f"list_position({known}, protocol)::TINYINT"
            columns = self._store.read(f"SELECT {plain}, {code} AS protocol FROM exchanges {where}")  # noqa: S608 - names are checked words
            if not np.ma.is_masked(columns["protocol"]):
                break
        else:
            raise RecordingError(f"{self.path}: exchanges of an unknown protocol; known are {', '.join(known)}")
        found = {name: filled(column) for name, column in columns.items()}
        protocol = np.array(known)[found.pop("protocol") - 1]
        return Exchanges(protocol=protocol, bits=int(bits), **found)

    def stretches(self, rows: int) -> list[tuple[int, int]]:
        """Return consecutive spans of time (start, end in ns) with about `rows` exchanges each."""
        time = np.sort(filled(self._store.read("SELECT time_ns FROM exchanges")["time_ns"]), kind="stable")
        edges = sorted({*time[:: max(rows, 1)].tolist(), *(time[-1:] + 1).tolist()})
        return list(pairwise(edges))

    def poses(self, start_ns: int | None = None, end_ns: int | None = None) -> Poses:
        """Return all poses in order of time.

        Raises `RecordingError` for a body without a name, and for a pose without a time.
        """
        self._check_poses()
        r = self._store.read(f"SELECT * FROM poses {_within(start_ns, end_ns)} ORDER BY time_ns, body")  # noqa: S608 - numbers
        return Poses(
            time_ns=filled(r["time_ns"]),
            body=np.asarray(r["body"], dtype=np.str_),
            position_m=np.column_stack([filled(r[name]) for name in POSE[:3]]),
            quaternion=np.column_stack([filled(r[name]) for name in POSE[3:]]),
        )

    def pose_windows(self) -> PoseWindows:
        """Return the poses by body, for distances and for those around a stretch of time.

        Raises `RecordingError` for a body without a name, and for a pose without a time.
        """
        self._check_poses()
        tracks: dict[str, Columns] = {}
        # By hash, because reading millions of words would take longer than everything else.
        for body, code in self._store.rows("SELECT body, hash(body) FROM poses GROUP BY body ORDER BY body"):
            query = f"SELECT time_ns, {', '.join(POSE)} FROM poses WHERE hash(body) = {code}::UBIGINT ORDER BY rowid"  # noqa: S608 - a number
            tracks[body] = {name: filled(column) for name, column in self._store.read(query).items()}
        return PoseWindows(tracks)

    def _check_poses(self) -> None:
        if self._store.rows("SELECT 1 FROM poses WHERE body IS NULL OR time_ns IS NULL LIMIT 1"):
            raise RecordingError(f"{self.path}: table poses: a body without a name, or a pose without a time")

    def columns(self, table: str, start_ns: int | None = None, end_ns: int | None = None) -> Columns:
        """Return one of `TABLES` as columns in the order of its rows, masked where a value is missing.

        Columns that an older file does not have are left out; of a table that it does not have, all are empty.
        """
        known_tables([table])
        present = self._store.columns().get(table)
        if present is None:
            types = {"BIGINT": "i8", "BOOLEAN": "?", "DOUBLE": "f8", "USMALLINT": "u2"}
            return {name: np.empty(0, dtype=types.get(kind, "O")) for name, kind in TABLES[table].items()}
        names = ", ".join(f'"{name}"' for name in TABLES[table] if name in present)
        return self._store.read(f"SELECT {names} FROM {table} {_within(start_ns, end_ns)} ORDER BY rowid")  # noqa: S608 - keys of TABLES

    def _readings(self, table: str, start_ns: int | None = None, end_ns: int | None = None) -> Columns:
        """Return a table in the order of its rows; missing values are "", False, NaN or 0."""
        found = self.columns(table, start_ns, end_ns)
        defaults: dict[str, tuple[Any, type]] = {"VARCHAR": ("", np.str_), "BOOLEAN": (False, bool)}
        for name, column in found.items():
            value, kind = defaults.get(TABLES[table][name], (None, object))
            found[name] = filled(column) if value is None else np.ma.filled(column, value).astype(kind)
        return found

    def _by_time(self, table: str, start_ns: int | None = None, end_ns: int | None = None) -> Columns:
        found = self._readings(table, start_ns, end_ns)
        order = np.argsort(found["time_ns"], kind="stable")
        return {name: column[order] for name, column in found.items()}

    def overheard(self) -> Columns:
        """Return the overheard exchanges as columns of the table `overheard`, in order of time.

        Integers are int64, other numbers float64, NaN for missing values.
        """
        return self._by_time("overheard")

    def imu(self, start_ns: int | None = None, end_ns: int | None = None) -> Columns:
        """Return inertial readings as columns of the table `imu`, in order of time (rad/s, m/s^2, axes of the body)."""
        return self._by_time("imu", start_ns, end_ns)

    def heights(self, start_ns: int | None = None, end_ns: int | None = None) -> Columns:
        """Return the readings of height sensors as columns of the table `height`, in order of time."""
        return self._by_time("height", start_ns, end_ns)

    def powers(self) -> Columns:
        """Return the total powers of exchanges as columns of the table `powers`, in order of time; NaN if unknown."""
        return self._by_time("powers")

    def temperatures(self, start_ns: int | None = None, end_ns: int | None = None) -> Columns:
        """Return temperatures and supply voltages of tags as columns of the table `temperature`, in order of time.

        Temperature in degrees Celsius and supply voltage in volts; NaN where there is none.
        """
        return self._by_time("temperature", start_ns, end_ns)

    def corrected(self, start_ns: int | None = None, end_ns: int | None = None) -> Columns:
        """Return the corrections of a calibration as columns of the table `corrected`, in the order of the exchanges.

        NaN if unknown; recordings of uncorrected ranges have no rows.
        """
        return self._readings("corrected", start_ns, end_ns)

    def corrected_is_of_exchanges(self) -> bool:
        """Return whether the table `corrected` has one row for each exchange; False if it is empty."""
        if not self.count("corrected"):
            return False
        differs = " OR ".join(f"e.{n} IS DISTINCT FROM c.{n}" for n in ("time_ns", "initiator", "target"))
        query = f"SELECT 1 FROM exchanges e POSITIONAL JOIN corrected c WHERE {differs} LIMIT 1"  # noqa: S608 - names
        return not self._store.rows(query)

    def times_apart(self, table: str, rows: int) -> list[int]:
        """Return times that divide one of `TABLES` into parts of about `rows` rows; none if it has fewer."""
        parts = self.count(table) // rows
        shares = [part / (parts + 1) for part in range(1, parts + 1)]
        found = self._store.rows(f"SELECT quantile_disc(time_ns, {shares}) FROM {table}") if shares else [([],)]  # noqa: S608 - a key of TABLES
        return list(found[0][0] or [])

    def tags(self) -> list[Tag]:
        """Return the tags in order of id."""
        return [Tag(tag, body, (x, y, z)) for tag, body, x, y, z in self._rows("tags", "tag")]

    def frames(self) -> list[FrameRow]:
        """Return all raw bytes in order of time."""
        return [FrameRow(*row) for row in self._rows("frames", "time_ns")]

    def cirs(self) -> list[CirRow]:
        """Return all impulse responses in order of time."""
        rows = self._rows("cirs", "time_ns", blank=True)
        return [CirRow(t, board, i, j, index, tuple(taps)) for t, board, i, j, index, taps in rows]

    def faults(self, start_ns: int | None = None, end_ns: int | None = None) -> list[Fault]:
        """Return all faults in order of time."""
        return [Fault(*row) for row in self._rows("faults", "time_ns", _within(start_ns, end_ns), blank=True)]

    def arrangements(self) -> list[Arrangement]:
        """Return the spans of time in which boards stood still, in order of time; none in older files.

        Raises `RecordingError` for unknown shapes, and for orders of tags that are not on a line.
        """
        found = []
        for start_ns, end_ns, name, known in self._rows("arrangements", "start_ns"):
            shape, *order = known.split(" ")
            tags = all(word.isascii() and word.isdigit() and len(word) < 6 for word in order)
            if not tags or len(set(order)) < len(order) or (order and shape != "line"):
                expected = "a shape, or line and tags in their order, each once"
                raise RecordingError(
                    f"{self.path}: table arrangements: known: found {known!r:.40}, expected {expected}"
                )
            found.append(Arrangement(name, start_ns, end_ns, shape, tuple(map(int, order))))
        return found

    def known_distances(self) -> list[KnownDistance]:
        """Return the independently measured distances between tags, in order of tags; none in older files."""
        return [KnownDistance(*row) for row in self._rows("distances", "first, second")]

    def _rows(self, table: str, order: str, where: str = "", *, blank: bool = False) -> list[tuple[Any, ...]]:
        """Return the rows of a table in an order; raises `RecordingError` for a missing value.

        If values may be `blank`, missing words, numbers and lists are "", NaN and [], and the ends of a fault None.
        """
        present = self._store.columns().get(table, set())
        if not present:
            return []
        default = {"VARCHAR": "''", "DOUBLE": "'nan'::DOUBLE", "USMALLINT[]": "[]"} if blank else {}
        names = ", ".join(
            f"""coalesce("{name}", {default.get(kind, "NULL")})""" if name in present else "NULL"
            for name, kind in TABLES[table].items()
        )
        rows = self._store.rows(f"SELECT {names} FROM {table} {where} ORDER BY {order}, rowid")  # noqa: S608 - keys of TABLES
        needed = 4 if table == "faults" else None  # all but the ends of the exchange, which most faults lack
        for row in rows:
            if None in row[:needed]:
                raise RecordingError(f"{self.path}: table {table}: a row with nothing in one of its columns, {row}")
        return rows


_SPREAD: Final[dict[type, Callable[[Any], tuple[Any, ...]]]] = {
    Tag: lambda tag: (tag.tag, tag.body, *tag.lever_arm_m),
    Arrangement: lambda one: (one.start_ns, one.end_ns, one.name, " ".join([one.known, *map(str, one.order)])),
}
"""Rows whose fields are not the columns of their table, in the same order."""


def _record(row: Any) -> tuple[Any, ...]:
    spread = _SPREAD.get(type(row))
    return spread(row) if spread else tuple(getattr(row, field.name) for field in fields(row))


def _column(kind: str, values: tuple[Any, ...]) -> NDArray[Any]:
    """Return values as a column, masked where they are None."""
    if kind == "BLOB" or kind.endswith("[]"):
        column = np.empty(len(values), dtype=object)
        column[:] = [list(value) if kind.endswith("[]") else value for value in values]
        return column
    missing = [value is None for value in values]
    if any(missing):
        return np.ma.array([0 if value is None else value for value in values], mask=missing)
    return np.array(values)


def filled(column: NDArray[Any]) -> NDArray[Any]:
    """Return a column of numbers as float64 or int64, in which missing values are NaN or zero."""
    missing, kind = (np.nan, np.float64) if column.dtype.kind == "f" else (0, np.int64)
    return np.asarray(np.ma.filled(column, missing), dtype=kind)


def known_tables(names: Iterable[str]) -> None:
    """Raise `RecordingError` for a table that recordings do not have."""
    for name in names:
        if name not in TABLES:
            raise RecordingError(f"no table {name!r} in a recording; there are {', '.join(TABLES)}")


def _within(start_ns: int | None, end_ns: int | None) -> str:
    """Return the clause of a query for a span of time, of which either end may be open."""
    ends = ((">=", start_ns), ("<", end_ns))
    given = [f"time_ns {sign} {int(time_ns)}" for sign, time_ns in ends if time_ns is not None]
    return f"WHERE {' AND '.join(given)}" if given else ""
