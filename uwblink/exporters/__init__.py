"""Export of recordings to files of other formats; programs can register exporters of their own.

Every table of a recording becomes a CSV or Parquet file, which `uwblink import exported` takes back, and each body a
TUM file; messages are in `mcap`. CSV cannot tell a list or bytes from text, so impulse responses are written as
`[1, 2]` and bytes as hexadecimal digits. A missing value is an empty cell; text is quoted, so that an empty one is not
missing. `truth_m` of the exchanges is what was measured beside them, or else the distance by the poses; `truth_from`
says which.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from itertools import count
from pathlib import Path
from typing import Final

import duckdb
import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.database import connect, log_of, selected
from uwblink.errors import ArgumentError, RecordingError, RecordingExistsError, raising
from uwblink.exporters.mcap import write_mcap, write_rosbag2
from uwblink.output import check_ending, check_utf8, place_beside, take_name
from uwblink.plugins import Registry, check_row
from uwblink.recording.contents import READING_MB, distances_by_poses_m, pieces
from uwblink.recording.file import Recording
from uwblink.recording.schema import BY_POSES, TABLES, TRUTH_FROM


def _write(recording: Path, folder: Path, *, suffix: str, options: str, cells: Mapping[str, str]) -> dict[str, int]:
    """Write a file a table; returns the rows by file. `cells` are SQL of values by kind. Raises `RecordingError`."""
    with Recording.open(recording) as opened:
        # The checks of every reader, before DuckDB reads the file directly.
        counts = {table: opened.count(table) for table in TABLES}
        by_poses = list(distances_by_poses_m(opened, opened.exchange_blocks())) if counts["poses"] else []
    wanted = {table: folder / f"{table}.{suffix}" for table in TABLES if counts[table] or table == "exchanges"}
    # The log is beside the file, not beside a link to it.
    place = recording.resolve()
    with (
        raising(RecordingError, f"{recording}: cannot be exported", duckdb.Error),
        # Several threads buffer rows to keep their order. One takes no more processor time, and 0.29 GB instead of
        # 0.41 GB for 4 million exchanges as CSV (2026-11-22). The limit is for reading; buffers for writing add to it.
        connect(paths=[place, log_of(place)], folders=[folder], memory_mb=400, threads=1) as db,
    ):
        db.execute(f"ATTACH {_literal(place)} AS source (READ_ONLY)")
        if by_poses:
            db.register("truths", {"by_poses": np.concatenate(by_poses)})
        for table, path in wanted.items():
            words = [f'"{n}"' for n, kind in TABLES[table].items() if kind in ("VARCHAR", "BLOB", "USMALLINT[]")]
            quoted = f", FORCE_QUOTE ({', '.join(words)})" if words and suffix == "csv" else ""
            query = _query(db, table, cells, truths=bool(by_poses))
            db.execute(f"COPY ({query}) TO {_literal(path)} ({options}{quoted})")
    return {path.name: counts[table] for table, path in wanted.items()}


def _query(db: duckdb.DuckDBPyConnection, table: str, cells: Mapping[str, str], *, truths: bool) -> str:
    found = db.execute(
        "SELECT column_name FROM duckdb_columns() WHERE database_name = 'source' AND table_name = ?", [table]
    ).fetchall()
    present = {str(name) for (name,) in found}
    columns = {
        name: cells.get(kind, "{0}").format(f'"{name}"') if name in present else f"NULL::{kind}"
        for name, kind in TABLES[table].items()
    }
    source = f"source.main.{table}"
    if table == "exchanges":
        measured, by_poses = f"nullif({columns['truth_m']}, 'nan')", "NULL::DOUBLE"
        if truths:
            source, by_poses = f"{source} POSITIONAL JOIN truths", "nullif(by_poses, 'nan')"
        columns["truth_m"] = f"coalesce({measured}, {by_poses})"
        origin = f"WHEN {measured} IS NOT NULL THEN 'measured' WHEN {by_poses} IS NOT NULL THEN '{BY_POSES}'"
        columns[TRUTH_FROM] = f"CASE {origin} END"
    # DuckDB keeps the order of rows; ORDER BY would hold all of them in memory.
    return f"SELECT {selected(columns)} FROM {source}"  # noqa: S608 - keys of TABLES


def _literal(path: Path) -> str:
    """Return a path as a literal of SQL; statements that name files take no bound values."""
    return "'" + str(path).replace("'", "''") + "'"


def write_tum(recording: Path, folder: Path) -> dict[str, int]:
    """Write the poses of each body, times in seconds with nine decimals; returns the poses by file.

    Letters of a body's name that are not safe in a file's name become "_". Raises `RecordingError`.
    """
    with Recording.open(recording, memory_mb=READING_MB) as opened, ExitStack() as files:
        bodies = sorted(body for (body,) in opened.tally("poses", "body"))
        if not bodies:
            raise RecordingError(f"{recording}: contains no poses")
        names = {body: f"{name}.tum" for body, name in zip(bodies, file_names(bodies), strict=True)}
        out = {body: files.enter_context((folder / name).open("w", encoding="utf-8")) for body, name in names.items()}
        written = dict.fromkeys(names.values(), 0)
        for held in pieces(opened):
            for body in np.unique(held.poses.body).tolist():
                mine = held.poses[held.poses.body == body]
                out[body].writelines(tum_lines(mine.time_ns, mine.position_m, mine.quaternion))
                written[names[body]] += len(mine)
    return written


def file_names(texts: Iterable[str]) -> list[str]:
    """Return a name of a file for each text, without what is not safe there; equal ones are numbered."""
    found: list[str] = []
    for text in texts:
        plain = "".join(c if c.isalnum() or c in "-_" else "_" for c in text) or "_"
        numbered = (f"{plain}_{k}" for k in count(2))
        found.append(plain if plain not in found else next(name for name in numbered if name not in found))
    return found


def tum_lines(time_ns: Ints, position_m: Floats, quaternion: Floats) -> Iterator[str]:
    """Yield the lines of a trajectory (n,): time in seconds, position, quaternion x y z w."""
    for time, place, turn in zip(time_ns.tolist(), position_m.tolist(), quaternion.tolist(), strict=True):
        seconds = f"{Decimal(time).scaleb(-9):f}"  # exactly
        yield " ".join([seconds, *map(repr, [*place, *turn])]) + "\n"


@dataclass(frozen=True, slots=True)
class Exporter:
    """A format to which recordings can be exported.

    `write(recording, folder)` writes files into an empty folder and returns what each holds, rows by the file's name;
    it raises `RecordingError`.
    """

    name: str
    write: Callable[[Path, Path], dict[str, int]]
    help: str


EXPORTERS: Final[Registry[Exporter]] = Registry(
    "exporter",
    "uwbcal.exporters",
    (
        Exporter(
            "csv",
            partial(
                _write,
                suffix="csv",
                options="FORMAT csv, HEADER true, NULLSTR ''",
                cells={"BLOB": "hex({0})", "USMALLINT[]": "CAST({0} AS VARCHAR)"},
            ),
            "a CSV file a table",
        ),
        Exporter(
            "parquet",
            partial(_write, suffix="parquet", options="FORMAT parquet, COMPRESSION zstd", cells={}),
            "a Parquet file a table",
        ),
        Exporter("tum", write_tum, "a trajectory a body (time x y z qx qy qz qw)"),
        Exporter("mcap", write_mcap, "one file of JSON messages, for Foxglove and PlotJuggler"),
        Exporter("rosbag2", write_rosbag2, "a bag of ROS 2: PoseStamped, tf, sensor_msgs/Range and Imu"),
    ),
    partial(check_row, "exporter", Exporter, {"write": (callable, "a function of two paths")}),
)
"""Exporters by name: the project's, those of `register_exporter`, and those of installed distributions."""


def register_exporter(row: Exporter, *, replace: bool = False) -> None:
    """Add a format to `EXPORTERS`, for `export_recording` and `uwblink export`.

    `replace` puts it in place of one registered before. Raises `ArgumentError` for a name that is taken.
    """
    EXPORTERS.register(row, replace=replace)


def check_export(folder: str | os.PathLike[str], *, to: str, force: bool) -> None:
    """Raise what `export_recording` raises for an unknown format, or a folder that cannot be written."""
    final = Path(folder)
    if to not in EXPORTERS:
        raise ArgumentError(f"found {to!r:.40}, allowed: {', '.join(EXPORTERS)}", parameter="to")
    check_utf8(final, RecordingError)
    check_ending(final)
    if final.name in ("", "..") and final.is_dir():  # a new folder cannot take such a name
        example = final / "tables"
        raise RecordingExistsError(f"{final}: is an existing folder; name a new folder for the export, as in {example}")
    if final.exists() and (not force or not final.is_dir()):
        raise RecordingExistsError(f"{final}: already exists; give another name, or replace it with `force`")
    if not final.parent.is_dir():
        raise RecordingError(f"{final}: the folder {final.parent} does not exist; create it first")


def export_recording(
    recording: str | os.PathLike[str], folder: str | os.PathLike[str], *, to: str, force: bool = False
) -> dict[str, int]:
    """Write a recording as files in a new folder; returns the rows of each file.

    `to` names a row of `EXPORTERS`. Files are written to a hidden folder, which takes the name when all went well.
    Raises `ArgumentError`, `RecordingError` and `RecordingExistsError` (a folder that is there, unless `force`).

    >>> import pathlib, tempfile, uwblink
    >>> from uwblink.exporters import export_recording
    >>> place = pathlib.Path(tempfile.mkdtemp())
    >>> x = uwblink.Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
    >>> uwblink.Contents(exchanges=x).save(place / "mine.uwb")
    >>> export_recording(place / "mine.uwb", place / "mine", to="csv")["exchanges.csv"]
    1
    """
    final = Path(folder)
    check_export(final, to=to, force=force)
    with raising(RecordingError, f"{final}: cannot be written"), place_beside(final) as partial:
        partial.mkdir()
        with EXPORTERS.calling(to, RecordingError):
            written = EXPORTERS[to].write(Path(recording), partial)
        take_name(partial, final)
    return written
