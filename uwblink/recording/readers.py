"""What reads a recording: a method a table, in memory and as Python's own values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Ints
from uwblink.display import printable
from uwblink.errors import RecordingError
from uwblink.recording.blocks import ROWS_AT_ONCE, PoseWindows, exchange_blocks, filled, read_exchanges
from uwblink.recording.intake import decode_json
from uwblink.recording.schema import TABLES, Arrangement, CirRow, Fault, FrameRow, KnownDistance, Poses, Tag
from uwblink.recording.store import Store
from uwblink.ticks import REPORT_BITS
from uwblink.twr import BITS, Exchanges

_EMPTY: Final = {"BIGINT": np.int64, "BOOLEAN": np.bool_, "DOUBLE": np.float64, "USMALLINT": np.uint16}

SAMPLED: Final = 16
"""Rows that are looked at for each time of `some_times`."""


class TableReaders:
    """Reads the tables of an open recording; each method raises `RecordingError` where it cannot."""

    _store: Store
    path: Path

    def meta(self) -> dict[str, Any]:
        """Return all entries of `meta`, decoded."""
        rows = self._store.rows("SELECT key, value FROM meta ORDER BY key")
        return {str(key): decode_json(value, self.path, str(key)) for key, value in rows}

    def tags(self) -> list[Tag]:
        """Return the tags in order of id."""
        rows = self._store.rows("SELECT tag, body, x, y, z FROM tags ORDER BY tag")
        for row in rows:
            if None in row:
                raise RecordingError(f"{self.path}: table tags: a tag with nothing in one of its columns, {row}")
        return [Tag(int(t), str(b), (float(x), float(y), float(z))) for t, b, x, y, z in rows]

    def count(self, table: str) -> int:
        """Return the number of rows of one of `TABLES`."""
        known_tables([table])
        if table not in self._store.columns():
            return 0
        return int(self._store.read(f"SELECT count(*) AS n FROM {table}")["n"][0])  # noqa: S608 - a key of TABLES

    def exchanges(self) -> Exchanges:
        """Return all exchanges in the order in which they were written."""
        return read_exchanges(self._store, self._bits())

    def exchange_blocks(self, rows: int = ROWS_AT_ONCE) -> Iterator[Exchanges]:
        """Yield the same exchanges in the same order, about so many `rows` at once."""
        return exchange_blocks(self._store, self._bits(), rows)

    def pose_windows(self) -> PoseWindows:
        """Return the poses by stretches of time, for those who need not have all of them at once."""
        return PoseWindows(self._store)

    def exchanges_between(self, start_ns: int, end_ns: int) -> Exchanges:
        """Return the exchanges from `start_ns` until before `end_ns`, in the order in which they were written."""
        where = f"WHERE time_ns >= {int(start_ns)} AND time_ns < {int(end_ns)} ORDER BY rowid"
        return read_exchanges(self._store, self._bits(), where)

    def rows_between(self, start_ns: int, end_ns: int) -> Ints:
        """Return the numbers of the rows of `exchanges_between`, in their order."""
        where = f"WHERE time_ns >= {int(start_ns)} AND time_ns < {int(end_ns)} ORDER BY rowid"
        return filled(self._store.read(f"SELECT rowid AS row FROM exchanges {where}")["row"])  # noqa: S608 - numbers

    def exchange_blocks_without(self, left_out: Bools, rows: int = ROWS_AT_ONCE) -> Iterator[Exchanges]:
        """Yield what `exchange_blocks` yields without some exchanges: `left_out` (n,) says which, by row number."""
        starts = range(0, len(left_out), rows)
        for start, block in zip(starts, self.exchange_blocks(rows), strict=True):
            where = f"WHERE rowid >= {start} AND rowid < {start + rows} ORDER BY rowid"
            numbers = filled(self._store.read(f"SELECT rowid AS row FROM exchanges {where}")["row"])  # noqa: S608 - numbers
            yield block[~left_out[numbers]]

    def row_end(self) -> int:
        """Return the number after the last row of the exchanges."""
        ((last,),) = self._store.rows("SELECT max(rowid) FROM exchanges")
        return 0 if last is None else int(last) + 1

    def stretches(self, rows: int) -> list[tuple[int, int]]:
        """Return spans of time (from, until before, in ns), one after the other, with about so many exchanges each."""
        time = np.sort(filled(self._store.read("SELECT time_ns FROM exchanges")["time_ns"]), kind="stable")
        edges = sorted({*time[:: max(rows, 1)].tolist(), *(time[-1:] + 1).tolist()})
        return list(pairwise(edges))

    def has_target_reports(self) -> bool:
        """Return whether targets reported exchanges, too, of which each may then stand there twice."""
        query = "SELECT count(*) FROM exchanges WHERE reporter = target AND initiator <> target"
        return bool(self._store.rows(query)[0][0])

    def tally(self, table: str, *columns: str) -> dict[tuple[Any, ...], int]:
        """Return how many rows of one of `TABLES` have the same values, by these values in order.

        Rows without one of the values are left out; where the file is older than a column, all are.
        """
        known_tables([table])
        if not set(columns) <= self._store.columns().get(table, set()) & TABLES[table].keys():
            return {}
        names = ", ".join(f'"{name}"' for name in columns)
        there = " AND ".join(f'"{name}" IS NOT NULL' for name in columns)
        query = f"SELECT {names}, count(*) FROM {table} WHERE {there} GROUP BY ALL ORDER BY ALL"  # noqa: S608 - keys of TABLES
        return {tuple(row[:-1]): int(row[-1]) for row in self._store.rows(query)}

    def _bits(self) -> int:
        bits = self.meta().get("timestamp_bits", REPORT_BITS)
        if isinstance(bits, bool) or bits not in BITS:
            listed = " or ".join(map(str, BITS))
            raise RecordingError(f"{self.path}: meta timestamp_bits is {printable(bits):.40}, expected {listed}")
        return int(bits)

    def poses(self, start_ns: int | None = None, end_ns: int | None = None) -> Poses:
        """Return all poses in order of time."""
        r = self._store.read(f"SELECT * FROM poses {_within(start_ns, end_ns)} ORDER BY time_ns, body")  # noqa: S608 - numbers
        return Poses(
            time_ns=filled(r["time_ns"]),
            body=np.asarray(r["body"], dtype=np.str_),
            position_m=np.column_stack([filled(r[c]) for c in ("x", "y", "z")]),
            quaternion=np.column_stack([filled(r[c]) for c in ("qx", "qy", "qz", "qw")]),
        )

    def some_times(self, table: str, rows: int) -> Ints:
        """Return times of about every so many `rows` of one of `TABLES`, in order; none of one with fewer."""
        known_tables([table])
        if self.count(table) <= rows:
            return np.empty(0, dtype=np.int64)
        step = max(rows // SAMPLED, 1)
        found = self._store.read(f"SELECT time_ns FROM {table} WHERE rowid % {step} = 0")  # noqa: S608 - a key of TABLES
        return np.unique(np.sort(filled(found["time_ns"]))[:: max(rows // step, 1)])

    def column_blocks(
        self, table: str, columns: Iterable[str], rows: int = ROWS_AT_ONCE
    ) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield columns of numbers of one of `TABLES` in the order of its rows, so many `rows` at once."""
        known_tables([table])
        names = ", ".join(f'"{name}"' for name in columns if name in TABLES[table])
        for start in range(0, self.count(table), rows):
            piece = f"rowid >= {start} AND rowid < {start + rows} ORDER BY rowid"
            found = self._store.read(f"SELECT {names} FROM {table} WHERE {piece}")  # noqa: S608 - keys of TABLES
            yield {name: filled(column) for name, column in found.items()}

    def columns(self, table: str, start_ns: int | None = None, end_ns: int | None = None) -> dict[str, NDArray[Any]]:
        """Return one of `TABLES` as columns in the order of its rows, masked where a value is missing.

        Of a table with `time_ns` only what is from `start_ns` until before `end_ns`, where these are given.

        Columns that an older file does not have are left out; of a table that it does not have, all are empty. Raises
        `RecordingError` for a table that recordings do not have.
        """
        known_tables([table])
        present = self._store.columns().get(table)
        if present is None:
            return {name: np.empty(0, dtype=_EMPTY.get(kind, object)) for name, kind in TABLES[table].items()}
        names = ", ".join(f'"{name}"' for name in TABLES[table] if name in present)
        return self._store.read(f"SELECT {names} FROM {table} {_within(start_ns, end_ns)} ORDER BY rowid")  # noqa: S608 - keys of TABLES

    def frames(self) -> list[FrameRow]:
        """Return all raw bytes in order of time."""
        r = self._store.read("SELECT * FROM frames ORDER BY time_ns, rowid")
        rows = zip(r["time_ns"].tolist(), r["board"], r["direction"], r["bytes"], strict=True)
        return [FrameRow(t, str(board), str(direction), bytes(data)) for t, board, direction, data in rows]

    def cirs(self) -> list[CirRow]:
        """Return all impulse responses in order of time."""
        r = self._store.read(f"SELECT {', '.join(TABLES['cirs'])} FROM cirs ORDER BY time_ns, rowid")  # noqa: S608
        whole = zip(*(filled(r[n]).tolist() for n in ("time_ns", "board", "initiator", "target")), strict=True)
        index = filled(r["first_path_index"]).tolist()
        taps = (() if row is None else tuple(map(int, row)) for row in r["magnitudes"].tolist())
        return [CirRow(*row, *rest) for row, *rest in zip(whole, index, taps, strict=True)]

    def overheard(self) -> dict[str, NDArray[Any]]:
        """Return the passively heard exchanges as columns of the table `overheard`, in order of time.

        Integers are int64, everything else is float64: NaN where there was nothing.
        """
        rows = self._store.read(f"SELECT {', '.join(TABLES['overheard'])} FROM overheard ORDER BY time_ns")  # noqa: S608
        return {name: filled(column) for name, column in rows.items()}

    def corrected(self, start_ns: int | None = None, end_ns: int | None = None) -> dict[str, NDArray[Any]]:
        """Return what a calibration said of each exchange, in their order, as columns of the table `corrected`.

        NaN where it said nothing; recordings whose ranges are as they were measured have no rows.
        """
        found = self.columns("corrected", start_ns, end_ns)
        flags = ("clamped", "outlier")
        numbers = {name: filled(column) for name, column in found.items() if name not in flags}
        return numbers | {name: np.ma.filled(found[name], False).astype(bool) for name in flags}

    def faults(self, start_ns: int | None = None, end_ns: int | None = None) -> list[Fault]:
        """Return all faults in order of time."""
        r = self._store.read(f"SELECT * FROM faults {_within(start_ns, end_ns)} ORDER BY time_ns, rowid")  # noqa: S608 - numbers
        none = np.ma.array(np.zeros(len(r["time_ns"]), np.int64), mask=True)
        ends = (r.get(name, none).tolist() for name in ("initiator", "target"))
        rows = zip(r["time_ns"], r["board"], r["kind"], r["detail"], *ends, strict=True)
        return [Fault(int(t), str(b), str(k), str(d), i, j) for t, b, k, d, i, j in rows]

    def arrangements(self) -> list[Arrangement]:
        """Return the stretches of time in which boards stood still, in order of time; none in older files.

        Raises `RecordingError` where what is known of one is neither a shape nor a line with the order of its tags.
        """
        rows = self._whole_rows("arrangements", "start_ns")
        return [Arrangement(str(n), int(start), int(end), *self._known(str(known))) for start, end, n, known in rows]

    def _known(self, text: str) -> tuple[str, tuple[int, ...]]:
        shape, *order = text.split(" ")
        tags = all(word.isascii() and word.isdigit() and len(word) < 6 for word in order)
        if not tags or len(set(order)) < len(order) or (order and shape != "line"):
            expected = "a shape, or line and tags in their order, each once"
            raise RecordingError(f"{self.path}: table arrangements: known: found {text!r:.40}, expected {expected}")
        return shape, tuple(map(int, order))

    def known_distances(self) -> list[KnownDistance]:
        """Return the distances between tags that were measured otherwise, in order of tags; none in older files."""
        rows = self._whole_rows("distances", "first, second")
        return [KnownDistance(int(i), int(j), float(d), float(s), str(a)) for i, j, d, s, a in rows]

    def _whole_rows(self, table: str, order: str) -> list[tuple[Any, ...]]:
        """Return the rows of a table that older files lack; raises `RecordingError` where one lacks a value."""
        if table not in self._store.columns():
            return []
        names = ", ".join(f'"{name}"' for name in TABLES[table])
        rows = self._store.rows(f"SELECT {names} FROM {table} ORDER BY {order}, rowid")  # noqa: S608 - keys of TABLES
        for row in rows:
            if None in row:
                raise RecordingError(f"{self.path}: table {table}: a row with nothing in one of its columns, {row}")
        return rows

    def imu(self, start_ns: int | None = None, end_ns: int | None = None) -> dict[str, NDArray[Any]]:
        """Return inertial readings as columns of the table `imu`, in order of time (rad/s, m/s^2, axes of the body)."""
        return self._readings("imu", start_ns, end_ns)

    def heights(self, start_ns: int | None = None, end_ns: int | None = None) -> dict[str, NDArray[Any]]:
        """Return what height sensors read as columns of the table `height`, in order of time."""
        return self._readings("height", start_ns, end_ns)

    def _readings(self, table: str, start_ns: int | None = None, end_ns: int | None = None) -> dict[str, NDArray[Any]]:
        found = self.columns(table, start_ns, end_ns)
        order = np.argsort(filled(found["time_ns"]), kind="stable")
        as_words = {"body": np.ma.filled(found.pop("body"), "").astype(np.str_)}
        numbers = {name: filled(column) for name, column in found.items()}
        return {name: (numbers | as_words)[name][order] for name in TABLES[table]}

    def powers(self) -> dict[str, NDArray[Any]]:
        """Return the total powers of exchanges as columns of the table `powers`, in order of time; NaN where none."""
        return self._numbers("powers")

    def temperatures(self, start_ns: int | None = None, end_ns: int | None = None) -> dict[str, NDArray[Any]]:
        """Return what tags read of themselves as columns of the table `temperature`, in order of time.

        Temperature in degrees Celsius and supply voltage in volts; NaN where there is none.
        """
        return self._numbers("temperature", start_ns, end_ns)

    def _numbers(self, table: str, start_ns: int | None = None, end_ns: int | None = None) -> dict[str, NDArray[Any]]:
        found = {name: filled(column) for name, column in self.columns(table, start_ns, end_ns).items()}
        order = np.argsort(found["time_ns"], kind="stable")
        return {name: column[order] for name, column in found.items()}


def known_tables(names: Iterable[str]) -> None:
    """Raise `RecordingError` for a table that recordings do not have."""
    for name in names:
        if name not in TABLES:
            raise RecordingError(f"no table {name!r} in a recording; there are {', '.join(TABLES)}")


def _within(start_ns: int | None, end_ns: int | None) -> str:
    """Return the clause of a query for a span of time, of which either end may be open."""
    ends = ((">=", start_ns), ("<", end_ns))
    said = [f"time_ns {sign} {int(time_ns)}" for sign, time_ns in ends if time_ns is not None]
    return f"WHERE {' AND '.join(said)}" if said else ""
