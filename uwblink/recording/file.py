"""The recording: one DuckDB file (`.uwb`) that simulator, recorder and importers write alike.

Column meanings are those of `uwblink.twr.Exchanges`; the tables are listed in
docs/architecture.md. Files from strangers are data: they are opened read-only and with every
access to other files switched off.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.errors import RecordingError, RecordingExistsError, RecordingMissingError
from uwblink.recording.schema import FORMAT_VERSION, SUFFIX, TABLES, Fault, Poses, Tag, standard_meta
from uwblink.ticks import REPORT_BITS
from uwblink.twr import COLUMNS, PROTOCOLS, Exchanges

if TYPE_CHECKING:
    import duckdb

HEADER_BYTES: Final = 3 * 4096
BLOCK_BYTES: Final = 16_384
"""Smallest block of a DuckDB file; every larger one is a multiple of it."""

ROWS_AT_A_TIME: Final = 100_000
"""Rows that a copy holds in memory at once; of impulse responses, which are the largest, 0.2 GB."""


class Recording:
    """An open recording. Use `create` to write and `open` to read; both are context managers."""

    def __init__(self, connection: duckdb.DuckDBPyConnection, path: Path, final: Path | None) -> None:
        """Wrap an open connection; `final` is where `path` moves when writing went well."""
        self._db = connection
        self.path = path if final is None else final
        self._partial = None if final is None else path

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
        import duckdb

        final = Path(path)
        check_output(final, force=force)
        place = final if live else final.with_name(f".{final.name}.{os.getpid()}.partial")
        _remove(place)
        try:
            db = duckdb.connect(str(place))
        except duckdb.Error as error:
            raise RecordingError(f"{final}: cannot be written ({_first_line(error)})") from error
        recording = cls(db, place, None if live else final)
        for table, columns in TABLES.items():
            spec = ", ".join(f'"{name}" {kind}' for name, kind in columns.items())
            db.execute(f"CREATE TABLE {table} ({spec})")
        recording.append_meta(standard_meta() | dict(meta or {}))
        if live:
            # So that the tables are in the file itself, and only rows ever in the log beside it.
            db.execute("CHECKPOINT")
        return recording

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, update: bool = False) -> Self:
        """Open a recording for reading, or to `update` it in place.

        Raises `RecordingMissingError` or `RecordingError` (a directory, not a recording, truncated,
        tables or columns missing, a newer format, still being written).
        """
        import duckdb

        source = Path(path)
        if not source.exists():
            raise RecordingMissingError(f"{source}: no such recording")
        if source.is_dir():
            raise RecordingError(f"{source}: is a directory, expected a {SUFFIX} recording")
        _check_length(source)
        try:
            db = duckdb.connect(
                str(source),
                read_only=not update,
                config={"enable_external_access": "false", "lock_configuration": "true"},
            )
        except duckdb.IOException as error:
            if "lock" in str(error):
                raise RecordingError(f"{source}: another process is writing it; wait until that ends") from error
            raise _damaged(source, error) from error
        except duckdb.Error as error:
            raise _damaged(source, error) from error
        recording = cls(db, source, None)
        try:
            recording._check_shape()
        except RecordingError:
            db.close()
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
        """Close; a written file takes its name, or vanishes if the block raised."""
        self._db.close()
        if self._partial is None:
            return
        if kind is None:
            self._partial.replace(self.path)
        _remove(self._partial)

    def append_meta(self, meta: Mapping[str, Any]) -> None:
        """Add entries to `meta`, replacing those with the same key; values are stored as JSON."""
        for key, value in meta.items():
            self._db.execute("DELETE FROM meta WHERE key = ?", [key])
            text = json.dumps(value, sort_keys=True, allow_nan=False)
            self._db.execute("INSERT INTO meta VALUES (?, ?)", [key, text])

    def append_tags(self, tags: Iterable[Tag]) -> None:
        """Add tags with their bodies and lever arms."""
        for t in tags:
            self._db.execute("INSERT INTO tags VALUES (?, ?, ?, ?, ?)", [t.tag, t.body, *t.lever_arm_m])

    def append_exchanges(self, exchanges: Exchanges) -> None:
        """Add exchanges, in one transaction."""
        self._insert("exchanges", {name: getattr(exchanges, name) for name in COLUMNS})

    def append_poses(self, poses: Poses) -> None:
        """Add poses, in one transaction."""
        position, quaternion = poses.position_m.T, poses.quaternion.T
        columns = {"time_ns": poses.time_ns, "body": poses.body}
        columns |= dict(zip("xyz", position, strict=True))
        columns |= dict(zip(("qx", "qy", "qz", "qw"), quaternion, strict=True))
        self._insert("poses", columns)

    def append_faults(self, faults: Iterable[Fault]) -> None:
        """Add faults, in one transaction."""
        rows = list(faults)
        columns = {f.name: np.array([getattr(r, f.name) for r in rows]) for f in fields(Fault)}
        self._insert("faults", columns)

    def append_frames(self, rows: Iterable[tuple[int, str, str, bytes]]) -> None:
        """Add raw bytes: (time_ns, board, "in" or "out", bytes)."""
        listed = list(rows)
        if listed:
            time_ns, board, direction, data = zip(*listed, strict=True)
            raw = np.empty(len(listed), dtype=object)
            raw[:] = data
            columns = {"time_ns": np.array(time_ns), "board": np.array(board), "direction": np.array(direction)}
            self._insert("frames", columns | {"bytes": raw})

    def append_overheard(self, rows: Iterable[Mapping[str, float]]) -> None:
        """Add passively heard exchanges, one mapping of the table's columns each; NaN where there was nothing."""
        listed = list(rows)
        if listed:
            self._insert("overheard", {n: np.array([row[n] for row in listed]) for n in TABLES["overheard"]})

    def append_columns(self, table: str, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add rows to one of `TABLES` from columns with its names, in one transaction; none where there are none."""
        if columns:
            self._insert(table, columns)

    def append_cirs(self, rows: Iterable[tuple[int, int, int, int, float, tuple[int, ...]]]) -> None:
        """Add impulse responses: (time_ns, board, initiator, target, first_path_index, magnitudes)."""
        for row in rows:
            self._db.execute("INSERT INTO cirs VALUES (?, ?, ?, ?, ?, ?)", [*row[:5], list(row[5])])

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Have everything appended in the block written at once, or not at all; raises `RecordingError`."""
        import duckdb

        try:
            self._db.execute("BEGIN")
            yield
            self._db.execute("COMMIT")
        except duckdb.Error as error:
            with suppress(duckdb.Error):
                self._db.execute("ROLLBACK")
            raise RecordingError(
                f"{self.path}: cannot be written any more ({_first_line(error)}); is the disk full? "
                "What was written before is kept"
            ) from error

    def replace_poses(self, poses: Poses, meta: Mapping[str, Any], tags: Iterable[Tag] | None = None) -> None:
        """Put poses, and tags where given, in place of those there are."""
        with self.transaction():
            self._db.execute("DELETE FROM poses")
            self.append_poses(poses)
            self.append_meta(meta)
            if tags is not None:
                self._db.execute("DELETE FROM tags")
                self.append_tags(tags)

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
                    written._take(self, table)

    def _take(self, source: Recording, table: str) -> None:
        """Add all rows of another recording's table, missing values included, some at a time."""
        names = ", ".join(f'"{name}"' for name in TABLES[table])
        (last,) = source._read(f"SELECT max(rowid) AS last FROM {table}")["last"]  # noqa: S608 - a key of TABLES
        for start in range(0, 0 if last is np.ma.masked else int(last) + 1, ROWS_AT_A_TIME):
            piece = f"rowid >= {start} AND rowid < {start + ROWS_AT_A_TIME} ORDER BY rowid"
            columns = source._read(f"SELECT {names} FROM {table} WHERE {piece}")  # noqa: S608 - keys of TABLES
            self._insert(table, columns)

    def frames(self) -> list[tuple[int, str, str, bytes]]:
        """Return all raw bytes in order of time, as `append_frames` takes them."""
        r = self._read("SELECT * FROM frames ORDER BY time_ns, rowid")
        rows = zip(r["time_ns"].tolist(), r["board"], r["direction"], r["bytes"], strict=True)
        return [(t, str(board), str(direction), bytes(data)) for t, board, direction, data in rows]

    def meta(self) -> dict[str, Any]:
        """Return all entries of `meta`, decoded."""
        rows = self._read("SELECT key, value FROM meta ORDER BY key")
        try:
            return {key: json.loads(value) for key, value in zip(rows["key"], rows["value"], strict=True)}
        except ValueError as error:
            raise RecordingError(f"{self.path}: table meta holds a value that is not JSON") from error

    def tags(self) -> list[Tag]:
        """Return the tags in order of id."""
        r = self._read("SELECT * FROM tags ORDER BY tag")
        rows = zip(r["tag"], r["body"], r["x"], r["y"], r["z"], strict=True)
        return [Tag(int(t), str(b), (float(x), float(y), float(z))) for t, b, x, y, z in rows]

    def count(self, table: str) -> int:
        """Return the number of rows of one of `TABLES`."""
        _known_tables([table])
        return int(self._read(f"SELECT count(*) AS n FROM {table}")["n"][0])  # noqa: S608 - a key of TABLES

    def exchanges(self) -> Exchanges:
        """Return all exchanges in the order in which they were written."""
        names = sorted(PROTOCOLS)
        listed = ", ".join(f"'{name}'" for name in names)
        plain = ", ".join(name for name in COLUMNS if name != "protocol")
        query = f"SELECT {plain}, list_position([{listed}], protocol)::TINYINT AS protocol FROM exchanges"  # noqa: S608 - names are constants
        rows = self._read(query)
        code = rows.pop("protocol")
        if np.ma.is_masked(code):
            raise RecordingError(f"{self.path}: exchanges of an unknown protocol; known are {', '.join(names)}")
        columns = {name: _filled(rows[name]) for name in rows}
        protocol = np.array(names)[np.asarray(code, dtype=np.int64) - 1]
        bits = self.meta().get("timestamp_bits", REPORT_BITS)
        return Exchanges(protocol=protocol, bits=int(bits), **columns)

    def overheard(self) -> dict[str, NDArray[Any]]:
        """Return the passively heard exchanges as columns of the table `overheard`, in order of time.

        Integers are int64, everything else is float64: NaN where there was nothing.
        """
        rows = self._read(f"SELECT {', '.join(TABLES['overheard'])} FROM overheard ORDER BY time_ns")  # noqa: S608
        return {name: _filled(column) for name, column in rows.items()}

    def poses(self) -> Poses:
        """Return all poses in order of time."""
        r = self._read("SELECT * FROM poses ORDER BY time_ns, body")
        return Poses(
            time_ns=_filled(r["time_ns"]),
            body=np.asarray(r["body"], dtype=np.str_),
            position_m=np.column_stack([_filled(r[c]) for c in ("x", "y", "z")]),
            quaternion=np.column_stack([_filled(r[c]) for c in ("qx", "qy", "qz", "qw")]),
        )

    def faults(self) -> list[Fault]:
        """Return all faults in order of time."""
        r = self._read("SELECT * FROM faults ORDER BY time_ns")
        rows = zip(r["time_ns"], r["board"], r["kind"], r["detail"], strict=True)
        return [Fault(int(t), str(b), str(k), str(d)) for t, b, k, d in rows]

    def _insert(self, table: str, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add rows from columns; what is masked in them is missing in the table."""
        if not len(next(iter(columns.values()))):
            return
        batch: dict[str, NDArray[Any]] = {}
        values = []
        for name in TABLES[table]:
            column = columns[name]
            batch[name] = np.ascontiguousarray(np.ma.getdata(column))
            values.append(f'"{name}"')
            if np.ma.is_masked(column):
                batch[f"no_{name}"] = np.ma.getmaskarray(column)
                values[-1] = f'CASE WHEN "no_{name}" THEN NULL ELSE "{name}" END'
        self._db.register("batch", batch)
        self._db.execute(f"INSERT INTO {table} SELECT {', '.join(values)} FROM batch")  # noqa: S608 - keys of TABLES
        self._db.unregister("batch")

    def _read(self, query: str) -> dict[str, NDArray[Any]]:
        import duckdb

        try:
            return dict(self._db.execute(query).fetchnumpy())
        except duckdb.Error as error:
            raise RecordingError(f"{self.path}: cannot be read, truncated or damaged ({_first_line(error)})") from error

    def _check_shape(self) -> None:
        found: dict[str, set[str]] = {}
        rows = self._read(
            "SELECT table_name AS t, column_name AS c FROM information_schema.columns WHERE table_schema = 'main'"
        )
        for table, column in zip(rows["t"], rows["c"], strict=True):
            found.setdefault(str(table), set()).add(str(column))
        if "meta" not in found:
            raise RecordingError(f"{self.path}: a DuckDB file, but not a {SUFFIX} recording (no table meta)")
        version = self.meta().get("format_version")
        if not isinstance(version, int):
            raise RecordingError(f"{self.path}: not a {SUFFIX} recording (no format_version in meta)")
        if version > FORMAT_VERSION:
            raise RecordingError(
                f"{self.path}: format version {version} is newer than this uwbcal reads "
                f"({FORMAT_VERSION}); update uwbcal"
            )
        for table, columns in TABLES.items():
            missing = sorted(set(columns) - found.get(table, set()))
            if missing:
                raise RecordingError(f"{self.path}: table {table} lacks {', '.join(missing)}")


_APPENDERS: Final[dict[str, Callable[[Recording, Any], None]]] = {
    "tags": Recording.append_tags,
    "poses": Recording.append_poses,
    "exchanges": Recording.append_exchanges,
    "overheard": lambda recording, columns: recording.append_columns("overheard", columns),
    "cirs": Recording.append_cirs,
    "frames": Recording.append_frames,
    "faults": Recording.append_faults,
}


def _known_tables(names: Iterable[str]) -> None:
    for name in names:
        if name not in TABLES:
            raise RecordingError(f"no table {name!r} in a recording; there are {', '.join(TABLES)}")


def check_output(path: Path, *, force: bool) -> None:
    """Raise the one clear error if `path` cannot be written to; writes nothing."""
    if path.is_dir():
        raise RecordingError(f"{path}: is a directory, expected the name of an output file")
    if path.exists() and not force:
        raise RecordingExistsError(f"{path}: exists already; give another name, or --force to replace it")
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: the folder {path.parent} does not exist; create it first")
    if not os.access(path.parent, os.W_OK):
        raise RecordingError(f"{path}: no permission to write in {path.parent}")


def _damaged(path: Path, error: Exception) -> RecordingError:
    return RecordingError(f"{path}: not a {SUFFIX} recording, or a truncated one ({_first_line(error)})")


def _check_length(path: Path) -> None:
    """A DuckDB file is headers and whole blocks; one that was cut is not, and may still open."""
    if path.stat().st_size % BLOCK_BYTES != HEADER_BYTES % BLOCK_BYTES:
        raise RecordingError(f"{path}: not a {SUFFIX} recording, or a truncated one (its length is odd)")


def _filled(column: NDArray[Any]) -> NDArray[Any]:
    """Nulls become NaN in floats and zero in integers."""
    kind = np.float64 if column.dtype.kind == "f" else np.int64
    if isinstance(column, np.ma.MaskedArray):
        column = column.filled(np.nan if column.dtype.kind == "f" else 0)
    return np.asarray(column, dtype=kind)


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]


def _remove(path: Path) -> None:
    for name in (path, path.with_name(path.name + ".wal")):
        name.unlink(missing_ok=True)
