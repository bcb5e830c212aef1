"""The recording: one DuckDB file (`.uwb`) that simulator, recorder and importers write alike.

Column meanings are those of `uwblink.twr.Exchanges`; the tables are listed in
docs/architecture.md.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.display import printable
from uwblink.errors import RecordingError, RecordingInUseError, RecordingMissingError
from uwblink.output import check_output
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.intake import decode_json
from uwblink.recording.schema import (
    FORMAT_VERSION,
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
from uwblink.recording.snapshots import open_snapshot
from uwblink.recording.store import Store, is_locked
from uwblink.ticks import REPORT_BITS
from uwblink.twr import BITS, COLUMNS, Exchanges

if TYPE_CHECKING:
    from uwblink.recording.summary import Summary


class Recording:
    """An open recording. Use `create` to write and `open` to read; both are context managers.

    >>> import pathlib, tempfile
    >>> from uwblink import Exchanges, Recording, Tag
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "mine.uwb"
    >>> with Recording.create(path, meta={"place": "roof"}) as recording:
    ...     recording.append_tags([Tag(1, "mast", (0.0, 0.0, 2.0)), Tag(2, "drone", (0.1, 0.0, 0.0))])
    ...     recording.append_exchanges(Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000]))
    >>> with Recording.open(path) as recording:
    ...     print(recording.show())
    mine.uwb: 1 exchanges in 0.0 s, protocols ss 1
      tags: 1 on mast, 2 on drone
      poses: none
      faults: none
          1 -> 2             1 exchanges
    """

    def __init__(self, store: Store, partial: Path | None = None) -> None:
        """Wrap an open store; `partial` is the file that takes the store's name when writing went well."""
        self._store = store
        self.path = store.path
        self._partial = partial

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        *,
        meta: Mapping[str, Any] | None = None,
        force: bool = False,
        live: bool = False,
    ) -> Self:
        """Start a recording beside `path`; it takes that name when the `with` block ends well.

        A `live` one has its name from the start, and what was appended stays whatever happens. Raises
        `RecordingExistsError` if `path` is there and not `force`, `RecordingError` where it cannot be written. When
        the block raises, nothing is left behind of one that is not live.
        """
        final = Path(path)
        check_output(final, force=force)
        if final.exists() and is_locked(final, update=False):
            raise RecordingInUseError(f"{final}: another process is writing it; give another name")
        place = final if live else final.with_name(f".{final.name}.{os.getpid()}.partial")
        _remove(place)
        try:
            recording = cls(Store.create(place, final), None if live else place)
            recording.append_meta(standard_meta() | dict(meta or {}))
            if live:
                # So that the tables are in the file itself, and only rows ever in the log beside it.
                recording._store.finish()
        except RecordingError:
            _remove(place)
            raise
        return recording

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, update: bool = False) -> Self:
        """Open a recording for reading, or to `update` it in place.

        Of one that is being recorded a snapshot is opened, which its recorder makes: everything until now. Raises
        `RecordingMissingError` or `RecordingError` (a directory, not a recording, truncated, tables or columns missing,
        a newer format, in use by something that makes no snapshots).
        """
        source = Path(path)
        if not source.exists():
            raise RecordingMissingError(f"{source}: no such recording")
        if source.is_dir():
            raise RecordingError(f"{source}: is a directory, expected a {SUFFIX} recording")
        try:
            store = Store.open(source, update=update)
        except RecordingInUseError:
            if update:
                raise
            store = open_snapshot(source, partial(Store.open, update=False))
            store.path = source
        recording = cls(store)
        try:
            recording._check_version()
        except RecordingError:
            recording._store.close()
            raise
        return recording

    def __enter__(self) -> Self:
        """Return the recording itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close; a written file takes its name, or vanishes if the block raised.

        Raises `RecordingError` where the disk does not take all of it.
        """
        if self._partial is None:
            self._store.close()
            return
        try:
            if kind is None:
                self._store.finish()
            self._store.close()
            if kind is None:
                self._partial.replace(self.path)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be written ({error.strerror})") from error
        finally:
            self._store.close()
            _remove(self._partial)

    def snapshot(self, place: str | os.PathLike[str]) -> None:
        """Write everything committed so far to a new file, while others go on appending; raises `RecordingError`."""
        self._store.copy_to(Path(place))

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
        for t in tags:
            self._store.insert_row("tags", [t.tag, t.body, *t.lever_arm_m])

    def append_exchanges(self, exchanges: Exchanges) -> None:
        """Add exchanges, in one transaction."""
        self._store.insert("exchanges", {name: getattr(exchanges, name) for name in COLUMNS})

    def append_poses(self, poses: Poses) -> None:
        """Add poses, in one transaction."""
        self._store.insert("poses", poses.to_dict())

    def append_faults(self, faults: Iterable[Fault]) -> None:
        """Add faults, in one transaction."""
        rows = list(faults)
        columns = {n: np.array([getattr(r, n) for r in rows]) for n in ("time_ns", "board", "kind", "detail")}
        columns |= {n: _optional([getattr(r, n) for r in rows]) for n in ("initiator", "target")}
        self._store.insert("faults", columns)

    def append_arrangements(self, arrangements: Iterable[Arrangement]) -> None:
        """Add stretches of time in which boards stood still."""
        for a in arrangements:
            self._store.insert_row("arrangements", [a.start_ns, a.end_ns, a.name, a.known])

    def append_distances(self, distances: Iterable[KnownDistance]) -> None:
        """Add distances that were measured otherwise."""
        for d in distances:
            self._store.insert_row("distances", [d.first, d.second, d.distance_m, d.sigma_m, d.arrangement])

    def append_frames(self, rows: Iterable[FrameRow]) -> None:
        """Add raw bytes, in one transaction."""
        listed = list(rows)
        if listed:
            raw = np.empty(len(listed), dtype=object)
            raw[:] = [row.data for row in listed]
            columns = {n: np.array([getattr(row, n) for row in listed]) for n in ("time_ns", "board", "direction")}
            self._store.insert("frames", columns | {"bytes": raw})

    def append_overheard(self, rows: Iterable[Mapping[str, float]]) -> None:
        """Add passively heard exchanges, one mapping of the table's columns each; NaN where there was nothing."""
        listed = list(rows)
        if listed:
            self._store.insert("overheard", {n: np.array([row[n] for row in listed]) for n in TABLES["overheard"]})

    def append_columns(self, table: str, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add rows to one of `TABLES` from columns with its names, in one transaction; none where there are none."""
        if columns:
            self._store.insert(table, columns)

    def append_cirs(self, rows: Iterable[CirRow]) -> None:
        """Add impulse responses, in one transaction."""
        listed = list(rows)
        if listed:
            *plain, last = TABLES["cirs"]
            taps = np.empty(len(listed), dtype=object)
            taps[:] = [list(row.magnitudes) for row in listed]
            columns = {name: np.array([getattr(row, name) for row in listed]) for name in plain}
            self._store.insert("cirs", columns | {last: taps})

    def transaction(self) -> AbstractContextManager[None]:
        """Have everything appended in the block written at once, or not at all; raises `RecordingError`."""
        return self._store.transaction()

    def replace_poses(self, poses: Poses, meta: Mapping[str, Any], tags: Iterable[Tag] | None = None) -> None:
        """Put poses, and tags where given, in place of those there are."""
        with self.transaction():
            self._store.execute("DELETE FROM poses")
            self.append_poses(poses)
            self.append_meta(meta)
            if tags is not None:
                self._store.execute("DELETE FROM tags")
                self.append_tags(tags)

    def show(self) -> Summary:
        """Return what the recording holds, as a summary that prints itself."""
        from uwblink.recording.summary import summarize

        return summarize(self)

    def copy(
        self,
        path: str | os.PathLike[str],
        *,
        replacing: Mapping[str, Any] | None = None,
        meta: Mapping[str, Any] | None = None,
        force: bool = False,
    ) -> None:
        """Write this recording again at `path`: every row of every table, in its order, except what is replaced.

        `replacing` maps names of `TABLES` to what stands there instead: what the method of that name returns
        (`{"exchanges": corrected}`; an empty list empties a table of rows). `meta` adds entries, or replaces those
        with the same keys. Raises what `create` raises, and `RecordingError` for a table that recordings do not have.
        """
        instead = dict(replacing or {})
        _known_tables(instead)
        entries = instead.pop("meta", None)
        entries = self.meta() if entries is None else entries
        with type(self).create(path, meta=entries | dict(meta or {}), force=force) as written:
            for table in TABLES:
                if table in instead:
                    _APPENDERS[table](written, instead[table])
                elif table != "meta":
                    written._store.take(self._store, table)

    def frames(self) -> list[FrameRow]:
        """Return all raw bytes in order of time."""
        r = self._store.read("SELECT * FROM frames ORDER BY time_ns, rowid")
        rows = zip(r["time_ns"].tolist(), r["board"], r["direction"], r["bytes"], strict=True)
        return [FrameRow(t, str(board), str(direction), bytes(data)) for t, board, direction, data in rows]

    def cirs(self) -> list[CirRow]:
        """Return all impulse responses in order of time."""
        r = self._store.read(f"SELECT {', '.join(TABLES['cirs'])} FROM cirs ORDER BY time_ns, rowid")  # noqa: S608
        whole = zip(*(_filled(r[n]).tolist() for n in ("time_ns", "board", "initiator", "target")), strict=True)
        index = _filled(r["first_path_index"]).tolist()
        taps = (() if row is None else tuple(map(int, row)) for row in r["magnitudes"].tolist())
        return [CirRow(*row, *rest) for row, *rest in zip(whole, index, taps, strict=True)]

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
        _known_tables([table])
        if table not in self._store.columns():
            return 0
        return int(self._store.read(f"SELECT count(*) AS n FROM {table}")["n"][0])  # noqa: S608 - a key of TABLES

    def exchanges(self) -> Exchanges:
        """Return all exchanges in the order in which they were written."""
        plain = ", ".join(name for name in COLUMNS if name != "protocol")
        # Those of other distributions are looked for only where the ones in use do not suffice.
        for known in ((row.name for row in PROTOCOLS.known()), PROTOCOLS):
            names = sorted(known)
            listed = ", ".join(f"'{name}'" for name in names)
            query = f"SELECT {plain}, list_position([{listed}], protocol)::TINYINT AS protocol FROM exchanges"  # noqa: S608 - names are checked words
            rows = self._store.read(query)
            code = rows.pop("protocol")
            if not np.ma.is_masked(code):
                break
        else:
            raise RecordingError(f"{self.path}: exchanges of an unknown protocol; known are {', '.join(names)}")
        columns = {name: _filled(rows[name]) for name in rows}
        protocol = np.array(names)[np.asarray(code, dtype=np.int64) - 1]
        return Exchanges(protocol=protocol, bits=self._bits(), **columns)

    def _bits(self) -> int:
        bits = self.meta().get("timestamp_bits", REPORT_BITS)
        if isinstance(bits, bool) or bits not in BITS:
            listed = " or ".join(map(str, BITS))
            raise RecordingError(f"{self.path}: meta timestamp_bits is {printable(bits):.40}, expected {listed}")
        return int(bits)

    def columns(self, table: str) -> dict[str, NDArray[Any]]:
        """Return one of `TABLES` as columns in the order of its rows, masked where a value is missing.

        Columns that an older file does not have are left out; of a table that it does not have, all are empty. Raises
        `RecordingError` for a table that recordings do not have.
        """
        _known_tables([table])
        present = self._store.columns().get(table)
        if present is None:
            return {name: np.empty(0, dtype=_EMPTY.get(kind, object)) for name, kind in TABLES[table].items()}
        names = ", ".join(f'"{name}"' for name in TABLES[table] if name in present)
        return self._store.read(f"SELECT {names} FROM {table} ORDER BY rowid")  # noqa: S608 - keys of TABLES

    def imu(self) -> dict[str, NDArray[Any]]:
        """Return inertial readings as columns of the table `imu`, in order of time (rad/s, m/s^2, axes of the body)."""
        return self._readings("imu")

    def heights(self) -> dict[str, NDArray[Any]]:
        """Return what height sensors read as columns of the table `height`, in order of time."""
        return self._readings("height")

    def powers(self) -> dict[str, NDArray[Any]]:
        """Return the total powers of exchanges as columns of the table `powers`, in order of time; NaN where none."""
        return self._numbers("powers")

    def temperatures(self) -> dict[str, NDArray[Any]]:
        """Return what tags read of themselves as columns of the table `temperature`, in order of time.

        Temperature in degrees Celsius and supply voltage in volts; NaN where there is none.
        """
        return self._numbers("temperature")

    def _numbers(self, table: str) -> dict[str, NDArray[Any]]:
        found = {name: _filled(column) for name, column in self.columns(table).items()}
        order = np.argsort(found["time_ns"], kind="stable")
        return {name: column[order] for name, column in found.items()}

    def corrected(self) -> dict[str, NDArray[Any]]:
        """Return what a calibration said of each exchange, in their order, as columns of the table `corrected`.

        NaN where it said nothing; recordings whose ranges are as they were measured have no rows.
        """
        found = self.columns("corrected")
        flags = ("clamped", "outlier")
        numbers = {name: _filled(column) for name, column in found.items() if name not in flags}
        return numbers | {name: np.ma.filled(found[name], False).astype(bool) for name in flags}

    def _readings(self, table: str) -> dict[str, NDArray[Any]]:
        found = self.columns(table)
        order = np.argsort(_filled(found["time_ns"]), kind="stable")
        as_words = {"body": np.ma.filled(found.pop("body"), "").astype(np.str_)}
        numbers = {name: _filled(column) for name, column in found.items()}
        return {name: (numbers | as_words)[name][order] for name in TABLES[table]}

    def overheard(self) -> dict[str, NDArray[Any]]:
        """Return the passively heard exchanges as columns of the table `overheard`, in order of time.

        Integers are int64, everything else is float64: NaN where there was nothing.
        """
        rows = self._store.read(f"SELECT {', '.join(TABLES['overheard'])} FROM overheard ORDER BY time_ns")  # noqa: S608
        return {name: _filled(column) for name, column in rows.items()}

    def poses(self) -> Poses:
        """Return all poses in order of time."""
        r = self._store.read("SELECT * FROM poses ORDER BY time_ns, body")
        return Poses(
            time_ns=_filled(r["time_ns"]),
            body=np.asarray(r["body"], dtype=np.str_),
            position_m=np.column_stack([_filled(r[c]) for c in ("x", "y", "z")]),
            quaternion=np.column_stack([_filled(r[c]) for c in ("qx", "qy", "qz", "qw")]),
        )

    def faults(self) -> list[Fault]:
        """Return all faults in order of time."""
        r = self._store.read("SELECT * FROM faults ORDER BY time_ns, rowid")
        none = _optional([None] * len(r["time_ns"]))
        ends = (r.get(name, none).tolist() for name in ("initiator", "target"))
        rows = zip(r["time_ns"], r["board"], r["kind"], r["detail"], *ends, strict=True)
        return [Fault(int(t), str(b), str(k), str(d), i, j) for t, b, k, d, i, j in rows]

    def arrangements(self) -> list[Arrangement]:
        """Return the stretches of time in which boards stood still, in order of time; none in older files."""
        rows = self._whole_rows("arrangements", "start_ns")
        return [Arrangement(str(n), int(start), int(end), str(known)) for start, end, n, known in rows]

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

    def _check_version(self) -> None:
        version = self.meta().get("format_version")
        if not isinstance(version, int):
            raise RecordingError(f"{self.path}: not a {SUFFIX} recording (no format_version in meta)")
        if version > FORMAT_VERSION:
            raise RecordingError(
                f"{self.path}: format version {version} is newer than this uwbcal reads "
                f"({FORMAT_VERSION}); update uwbcal"
            )


_APPENDERS: Final[dict[str, Callable[[Recording, Any], None]]] = {
    "tags": Recording.append_tags,
    "poses": Recording.append_poses,
    "exchanges": Recording.append_exchanges,
    "overheard": lambda recording, columns: recording.append_columns("overheard", columns),
    "cirs": Recording.append_cirs,
    "frames": Recording.append_frames,
    "faults": Recording.append_faults,
    "imu": lambda recording, columns: recording.append_columns("imu", columns),
    "height": lambda recording, columns: recording.append_columns("height", columns),
    "powers": lambda recording, columns: recording.append_columns("powers", columns),
    "temperature": lambda recording, columns: recording.append_columns("temperature", columns),
    "corrected": lambda recording, columns: recording.append_columns("corrected", columns),
    "arrangements": Recording.append_arrangements,
    "distances": Recording.append_distances,
}

_EMPTY: Final = {"BIGINT": np.int64, "BOOLEAN": np.bool_, "DOUBLE": np.float64, "USMALLINT": np.uint16}


def _known_tables(names: Iterable[str]) -> None:
    for name in names:
        if name not in TABLES:
            raise RecordingError(f"no table {name!r} in a recording; there are {', '.join(TABLES)}")


def _filled(column: NDArray[Any]) -> NDArray[Any]:
    """Nulls become NaN in floats and zero in integers."""
    kind = np.float64 if column.dtype.kind == "f" else np.int64
    if isinstance(column, np.ma.MaskedArray):
        column = column.filled(np.nan if column.dtype.kind == "f" else 0)
    return np.asarray(column, dtype=kind)


def _optional(values: list[int | None]) -> NDArray[Any]:
    """Return whole numbers, masked where there is none."""
    return np.ma.array([0 if v is None else v for v in values], mask=[v is None for v in values], dtype=np.int64)


def _remove(path: Path) -> None:
    for name in (path, path.with_name(path.name + ".wal")):
        name.unlink(missing_ok=True)
