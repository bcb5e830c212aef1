"""The recording: one DuckDB file (`.uwb`), which simulator, recorder and importers write.

The columns of exchanges are described at `uwblink.twr.Exchanges`, all tables in docs/reference/recording.md.

If a process has opened a DuckDB file for writing, no other process can open it. The writer appends committed rows to a
log beside the file. A reader of a recording in use copies file and log and opens the copy, whose files it unlinks at
once.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Columns
from uwblink.database import log_of
from uwblink.display import first_few, printable
from uwblink.errors import RecordingError, RecordingInUseError, RecordingMissingError, raising
from uwblink.output import check_output, place_beside
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.schema import (
    FORMAT_VERSION,
    POSE,
    SUFFIX,
    TABLES,
    Arrangement,
    CirRow,
    Fault,
    FrameRow,
    KnownDistance,
    Poses,
    Tag,
    standard_meta,
)
from uwblink.recording.store import Store, decode_json, is_locked
from uwblink.recording.summary import Summary, summarize
from uwblink.text_files import require_regular
from uwblink.ticks import REPORT_BITS
from uwblink.twr import BITS, COLUMNS, Exchanges

_MISSING: Final[dict[str, tuple[Any, type]]] = {
    "VARCHAR": ("", np.str_),
    "BOOLEAN": (False, np.bool_),
    "DOUBLE": (np.nan, np.float64),
    "BIGINT": (0, np.int64),
    "USMALLINT": (0, np.int64),
}
"""Value in place of missing ones, and type of the array, by type of the column."""

_ORDER: Final = {
    "poses": "time_ns, body",
    "corrected": "rowid",
    "tags": "tag",
    "arrangements": "start_ns",
    "distances": "first, second",
}
"""Order of the rows of tables that are not read in order of time."""


class Recording(Store):
    """An open recording. Use `create` to write and `open` to read; both are context managers.

    Methods that read or append rows raise `RecordingError` if they fail. Those with `start_ns` and `end_ns` return rows
    with start_ns <= time_ns < end_ns.

    >>> import pathlib, tempfile
    >>> from uwblink import Exchanges, Recording, Tag
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "mine.uwb"
    >>> with Recording.create(path, meta={"place": "roof"}) as recording:
    ...     recording.append("tags", [Tag(1, "mast", (0.0, 0.0, 2.0)), Tag(2, "drone", (0.1, 0.0, 0.0))])
    ...     recording.append("exchanges", Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000]))
    >>> with Recording.open(path) as recording:
    ...     print(recording.show())
    mine.uwb: 1 exchanges in 0.0 s, protocols ss 1
      tags: 1 on mast, 2 on drone
      poses: none
      faults: none
          1 -> 2             1 exchanges
    """

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        *,
        meta: Mapping[str, Any] | None = None,
        force: bool = False,
        live: bool = False,
        memory_mb: int | None = None,
    ) -> Self:
        """Create a recording; the file is named `path` when the `with` block ends without an error.

        After an error nothing remains. A `live` recording is named `path` from the start, and keeps all appended rows
        after an error. At most `memory_mb` of the written data are kept in memory. Raises `RecordingExistsError` if
        `path` exists and `force` is False, and `RecordingError` if it cannot be written.
        """
        final = Path(path)
        check_output(final, force=force, recording=True)
        if final.exists() and is_locked(final, update=False):
            raise RecordingInUseError(f"{final}: another process is writing it; give another name")
        with raising(RecordingError, f"{final}: cannot be written"):
            with ExitStack() as place:
                recording = cls._open_to_write(final, place.enter_context(place_beside(final)), memory_mb)
                # A copy of a recording has all entries.
                given = dict(meta or {})
                recording.append_meta(given if "format_version" in given else standard_meta() | given)
                if not live:
                    recording._place = place.pop_all()
                    return recording
                # Close and open again, so that the tables are in the file, and the log has only rows.
                recording._complete()
            return cls._open_to_write(final, None, memory_mb)

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, update: bool = False, memory_mb: int | None = None) -> Self:
        """Open a recording for reading, or to `update` it in place.

        At most `memory_mb` of the read data are kept in memory; sorting can take more. If another process is writing
        the recording, a copy of all committed rows is opened. Raises `RecordingMissingError`, `RecordingInUseError`, or
        `RecordingError` (a directory, not a recording, truncated, tables or columns missing, a newer format).
        """
        source = Path(path)
        if not source.exists():
            raise RecordingMissingError(f"{source}: no such recording")
        require_regular(source, RecordingError, f"{SUFFIX} recording")
        try:
            return cls._open_to_read(source, update=update, memory_mb=memory_mb)
        except RecordingInUseError:
            if update:
                raise
            return cls._open_copy(source, memory_mb)

    def _check_tables(self) -> None:
        """Check tables, columns, and the version of the format; raises `RecordingError`."""
        super()._check_tables()
        version = self.meta().get("format_version")
        if not isinstance(version, int):
            raise RecordingError(f"{self.path}: not a {SUFFIX} recording (no format_version in meta)")
        if version > FORMAT_VERSION:
            raise RecordingError(
                f"{self.path}: format version {version} is newer than this uwbcal reads ({FORMAT_VERSION}); "
                "update uwbcal"
            )

    def __enter__(self) -> Self:
        """Return the recording itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the recording. A written file gets its name, or is removed if the block raised an error.

        Raises `RecordingError` if it cannot be written completely.
        """
        with self._place, closing(self._db), raising(RecordingError, f"{self.path}: cannot be written"):
            if kind is None and self._writes:
                self._complete()

    def _complete(self) -> None:
        """Write the log into the file, close it, and give it its name."""
        self.shorten_log()
        self._db.close()
        if self._partial:
            log_of(self.path).unlink(missing_ok=True)  # of the file that had the name before
            self._partial.replace(self.path)

    def show(self) -> Summary:
        """Return the summary of the recording, which has a text form."""
        return summarize(self)

    @contextmanager
    def copying(
        self,
        path: str | os.PathLike[str],
        *,
        without: Collection[str] = (),
        meta: Mapping[str, Any] | None = None,
        force: bool = False,
    ) -> Iterator[Self]:
        """Yield a copy of this recording at `path`, with all rows of all tables in their order.

        Tables in `without` are left out; the block can append their new rows, also in parts. `meta` are entries to add
        or to replace. Raises the errors of `create`, and `RecordingError` for an unknown table.
        """
        known_tables(without)
        entries = {} if "meta" in without else self.meta()
        entries |= dict(meta or {})
        # Without this limit, the copy would need as much memory as the size of the file.
        with type(self).create(path, meta=entries, force=force, memory_mb=300) as written:
            for table in TABLES:
                if table != "meta" and table not in without:
                    written._take(self, table)
            yield written

    @classmethod
    def _open_copy(cls, source: Path, memory_mb: int | None) -> Self:
        """Open a copy of a recording that another process is writing, with all committed rows.

        File and log are consistent if the file did not change while both were copied. DuckDB ignores an incomplete
        entry at the end of the log, which was not committed. Raises `RecordingInUseError` if no copy is possible.
        """
        file, why = source.resolve(), "changes faster than it can be copied"
        try:
            with place_beside(file) as copy:
                # The file changes rarely, when the writer merges the log into it. Try again then.
                for _ in range(20):
                    before = file.stat()
                    shutil.copyfile(file, copy)
                    log_of(copy).unlink(missing_ok=True)
                    with suppress(FileNotFoundError):
                        shutil.copyfile(log_of(file), log_of(copy))
                    after = file.stat()
                    if (before.st_mtime_ns, before.st_size) == (after.st_mtime_ns, after.st_size):
                        recording = cls._open_to_read(copy, update=False, memory_mb=memory_mb)
                        recording.path = source
                        return recording
        except OSError as error:
            why = f"cannot be copied ({error.strerror})"
        raise RecordingInUseError(f"{source}: another process is writing it, and it {why}; wait until that ends")

    def append(self, table: str, what: Any) -> None:
        """Append exchanges, poses, columns or rows to one of `TABLES`, in the form in which they are read.

        Rows can also be mappings by the names of columns. Raises `RecordingError` for an unknown table, and for values
        that do not fit.
        """
        known_tables([table])
        if isinstance(what, Exchanges | Poses):
            what = what.to_dict()
        elif not isinstance(what, Mapping):
            values = zip(*(_record(row, table) for row in what), strict=True)
            what = {n: _column(kind, v) for (n, kind), v in zip(TABLES[table].items(), values, strict=False)}
        self._insert(table, what)

    def append_meta(self, meta: Mapping[str, Any]) -> None:
        """Add entries to `meta`, or replace those with the same key; values are stored as JSON."""
        for key, value in meta.items():
            with raising(RecordingError, f"{self.path}: meta {key!r}: cannot be stored as JSON", TypeError, ValueError):
                text = json.dumps(value, sort_keys=True, allow_nan=False)
            self._execute("DELETE FROM meta WHERE key = ?", [key])
            self._execute("INSERT INTO meta VALUES (?, ?)", [key, text])

    def replace_poses(self, poses: Poses, meta: Mapping[str, Any], tags: Iterable[Tag] | None = None) -> None:
        """Replace the poses, and the tags if given, and add entries to `meta`, in one transaction."""
        with self.transaction():
            self._execute("DELETE FROM poses")
            self.append("poses", poses)
            self.append_meta(meta)
            if tags is not None:
                self._execute("DELETE FROM tags")
                self.append("tags", tags)

    def meta(self) -> dict[str, Any]:
        """Return all entries of `meta`, decoded."""
        rows = self._fetch("SELECT key, value FROM meta ORDER BY key")
        return {str(key): decode_json(value, self.path, str(key)) for key, value in rows}

    def count(self, table: str) -> int:
        """Return the number of rows of one of `TABLES`."""
        known_tables([table])
        return int(self._fetch(f"SELECT count(*) FROM {table}")[0][0])  # noqa: S608 - a key of TABLES

    def tally(self, table: str, *columns: str) -> dict[tuple[Any, ...], int]:
        """Return the number of rows of one of `TABLES` for each combination of values of some columns.

        Keys are in ascending order. Rows with a missing value in these columns are left out.
        """
        known_tables([table])
        there = " AND ".join(f"{name} IS NOT NULL" for name in columns)
        query = f"SELECT {', '.join(columns)}, count(*) FROM {table} WHERE {there} GROUP BY ALL ORDER BY ALL"  # noqa: S608 - names
        return {tuple(row[:-1]): int(row[-1]) for row in self._fetch(query)}

    def exchanges(self, start_ns: int | None = None, end_ns: int | None = None) -> Exchanges:
        """Return the exchanges in the order in which they were written."""
        return self._exchanges(_within(start_ns, end_ns))

    def exchange_blocks(self, rows: int = 131_072) -> Iterator[Exchanges]:
        """Return all exchanges in the same order, in blocks of `rows`.

        The default is slightly more than a row group of DuckDB (122,880).
        """
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
        strange = [repr(printable(name)[:40]) for (name,) in self.tally("exchanges", "protocol") if name not in known]
        raise RecordingError(
            f"{self.path}: exchanges of an unknown protocol, {first_few(strange or ['NULL'])}; registered are "
            f"{', '.join(known)}; install the distribution that adds it (entry point group uwbcal.protocols), or call "
            "uwblink.register_protocol"
        )

    def dividing_times(self, table: str, rows: int) -> list[int]:
        """Return times that divide one of `TABLES` into parts of about `rows` rows, with the first and the last time.

        The list is empty for an empty table.
        """
        parts = max(self.count(table) // rows, 1)
        shares = [part / parts for part in range(parts + 1)]
        ((found,),) = self._fetch(f"SELECT quantile_disc(time_ns, {shares}) FROM {table}")  # noqa: S608 - a key of TABLES
        return sorted(set(found or []))

    def poses(self, start_ns: int | None = None, end_ns: int | None = None) -> Poses:
        """Return the poses in order of time.

        Raises `RecordingError` for a body without a name and for a pose without a time.
        """
        if self._fetch("SELECT 1 FROM poses WHERE body IS NULL OR time_ns IS NULL LIMIT 1"):
            raise RecordingError(f"{self.path}: table poses: a body without a name, or a pose without a time")
        r = self.columns("poses", start_ns, end_ns)
        position, quaternion = (np.column_stack([r[name] for name in names]) for names in (POSE[:3], POSE[3:]))
        return Poses(r["time_ns"], r["body"], position, quaternion)

    def columns(self, table: str, start_ns: int | None = None, end_ns: int | None = None) -> Columns:
        """Return one of `TABLES` as columns (n,) by name, in order of time; `corrected` in the order of exchanges.

        Missing values become "", False, NaN or 0.
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
        """Return the arrangements, spans of time in which boards stood still, in order of time.

        Raises `RecordingError` if the column `known` is neither a word nor a line with the order of its tags.
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
        """Return the independently measured distances between tags, in order of tags."""
        return [KnownDistance(*row) for row in self._rows("distances")]

    def _rows(self, table: str, start_ns: int | None = None, end_ns: int | None = None) -> list[tuple[Any, ...]]:
        """Return the rows of a table in its order; raises `RecordingError` for a missing value."""
        rows = self._fetch(_query(table, start_ns, end_ns))
        needed = 4 if table == "faults" else None  # initiator and target of faults may be missing
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
    """Return a column of a type of DuckDB with the value of `_MISSING` in place of missing ones."""
    missing, dtype = _MISSING.get(kind, (None, np.object_))
    return np.asarray(np.ma.filled(column, missing), dtype=dtype)


def known_tables(names: Iterable[str]) -> None:
    """Raise `RecordingError` if a name is not one of `TABLES`."""
    if unknown := set(names) - TABLES.keys():
        raise RecordingError(f"no table {min(unknown)!r} in a recording; there are {', '.join(TABLES)}")


def _query(table: str, start_ns: int | None, end_ns: int | None) -> str:
    """Return the query for the rows of a table in a span of time, in the table's order."""
    where, order = _within(start_ns, end_ns), _ORDER.get(table, "time_ns")
    return f"SELECT {', '.join(TABLES[table])} FROM {table} {where} ORDER BY {order}, rowid"  # noqa: S608 - keys of TABLES


def _within(start_ns: int | None, end_ns: int | None) -> str:
    """Return the WHERE clause for a span of time; None is an open end."""
    ends = ((">=", start_ns), ("<", end_ns))
    given = [f"time_ns {sign} {int(time_ns)}" for sign, time_ns in ends if time_ns is not None]
    return f"WHERE {' AND '.join(given)}" if given else ""
