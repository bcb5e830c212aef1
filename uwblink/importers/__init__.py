"""Import of files in other formats; programs and other distributions can register importers of their own.

A registered reader takes a path and a map and returns `Contents`, or tables with a map. This module writes the
recording, and overwrites an existing one only with `force`. It also reads exports of `uwblink export --to csv` or
`parquet`, and data frames of pandas, Polars or Arrow, with DuckDB alone.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import duckdb

from uwblink.arrays import is_frame
from uwblink.database import connect, selected
from uwblink.errors import ArgumentError, ImportTableError, raising
from uwblink.importers.bags import BAG_SUFFIXES, bag_to_table
from uwblink.importers.column_map import ColumnMap
from uwblink.importers.exchange_tables import TABLE_SUFFIXES, Imported, find_tables, import_tables
from uwblink.importers.guess import guess_map
from uwblink.importers.miluv import read_miluv
from uwblink.importers.poses import add_poses, pose_topics
from uwblink.importers.staging import Watch
from uwblink.importers.tables import connected
from uwblink.output import check_output
from uwblink.plugins import Registry, check_row, is_text
from uwblink.recording.contents import Contents, load
from uwblink.recording.file import Recording
from uwblink.recording.schema import BY_POSES, TABLES, TRUTH_FROM
from uwblink.recording.store import decode_json

__all__ = [
    "IMPORTERS",
    "ColumnMap",
    "Imported",
    "Importer",
    "add_poses",
    "import_file",
    "import_recording",
    "pose_topics",
    "read_source",
    "register_importer",
]


@dataclass(frozen=True, slots=True)
class Importer:
    """A kind of file that can be imported; it has a function `read` or `tables`.

    `read(source, map)` returns the contents of the file at `source` and raises `ImportTableError`; `map` is the path of
    a file that explains it, for kinds with a `map_help`, else None. `suffixes` are the suffixes of such files in small
    letters, none for a kind of folder; `name` is the name of the command `uwblink import NAME`, and `help` its line.

    `tables(sources, map, folder)` returns paths of tables of exchanges, messages or ranges, and their `ColumnMap`. It
    writes files that are not tables as tables into `folder`, for example as JSON lines; no table needs to be in memory
    as a whole. With `several` it reads several files as one recording, otherwise one file.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[Path, Path | None], Contents] | None
    help: str
    map_help: str | None = None
    _: KW_ONLY
    tables: Callable[[Sequence[Path], Path | None, Path], tuple[Sequence[Path], ColumnMap]] | None = None
    several: bool = False


def check_importer(row: Any) -> None:
    """Raise `ArgumentError` for a row that cannot be an importer."""
    check_row(
        "importer",
        Importer,
        {
            "suffixes": (
                lambda found: isinstance(found, tuple) and all(isinstance(s, str) and s[:1] == "." for s in found),
                "a tuple such as ('.csv', '.csv.gz')",
            ),
            "read": (
                lambda found: callable(found) or callable(getattr(row, "tables", None)),
                "a function of a path and a map's path",
            ),
            "help": (is_text, "a line of text"),
            "map_help": (lambda found: found is None or is_text(found), "a line of text"),
        },
        row,
    )


def read_exported(folder: Path, _map_file: Path | None = None) -> Contents:
    """Read an export to CSV or Parquet, every column of every table; raises `ImportTableError`."""
    if not folder.is_dir():
        raise ImportTableError(f"{folder}: no such folder; expected one that 'uwblink export' wrote")
    places = [(table, folder / f"{table}{suffix}") for table in TABLES for suffix in (".parquet", ".csv")]
    paths = {table: path for table, path in places if path.is_file()}
    if "exchanges" not in paths:
        raise ImportTableError(
            f"{folder}: contains no exchanges.csv or exchanges.parquet, which 'uwblink export' writes"
        )
    with TemporaryDirectory() as place:
        path = Path(place) / "exported.uwb"
        with Recording.create(path) as recording:
            for table, source in paths.items():
                wrong = f"{source}: not in the form of 'uwblink export'"
                with raising(ImportTableError, wrong, duckdb.Error):
                    with connected([source]) as db:
                        columns = dict(db.execute(_query(db, table, source), [str(source)]).fetchnumpy())
                    if table == "meta":
                        rows = zip(columns["key"], columns["value"], strict=True)
                        recording.append_meta({str(key): decode_json(text, source, str(key)) for key, text in rows})
                    else:
                        recording.append(table, columns)
        return load(path)


def _query(db: duckdb.DuckDBPyConnection, table: str, source: Path) -> str:
    """Return the query that reads an exported table; text from the file is never part of it."""
    is_csv = source.suffix == ".csv"
    read = (
        "read_csv(?, auto_detect=true, all_varchar=true, header=true, delim=',', quote='\"', escape='\"', nullstr='', "
        "allow_quoted_nulls=false, max_line_size=64000000, parallel=false)"
        if is_csv
        else "read_parquet(?)"
    )
    cells = {name: f'CAST("{name}" AS {kind})' for name, kind in TABLES[table].items()}
    if is_csv:
        cells |= {name: f'unhex("{name}")' for name, kind in TABLES[table].items() if kind == "BLOB"}
    found = db.execute(f"DESCRIBE SELECT * FROM {read}", [str(source)]).fetchall()  # noqa: S608 - nothing of a file
    names = {row[0] for row in found}
    if lacking := [name for name in TABLES[table] if name not in names]:
        raise ImportTableError(
            f"{source}: lacks the columns {', '.join(lacking)}; {table} has {', '.join(TABLES[table])}"
        )
    if table == "exchanges" and TRUTH_FROM in names:
        # Distances by poses are left out, because the poses are also imported.
        cells["truth_m"] = f"CASE WHEN {TRUTH_FROM} = '{BY_POSES}' THEN NULL ELSE {cells['truth_m']} END"
    return f"SELECT {selected(cells)} FROM {read}"  # noqa: S608 - keys of TABLES


IMPORTERS: Final[Registry[Importer]] = Registry(
    "importer",
    "uwbcal.importers",
    (
        Importer(
            "csv",
            TABLE_SUFFIXES,
            None,
            "Import exchanges, messages or ranges from a table: CSV, Parquet or JSON lines.",
            map_help="Names, units and constants (.toml).",
            tables=find_tables,
            several=True,
        ),
        Importer(
            "bag",
            BAG_SUFFIXES,
            None,
            "Import exchanges from messages in a bag of ROS 1, ROS 2 or MCAP.",
            map_help="Topics, names of fields, units and constants (.toml).",
            tables=bag_to_table,
        ),
        Importer("exported", (), read_exported, "Import a folder that 'uwblink export' wrote as CSV or Parquet."),
        Importer(
            "miluv",
            (),
            read_miluv,
            "Import the folder of a flight of the MILUV dataset.",
            map_help='Which anchors of anchors.yaml (.toml: constellation = "0").',
        ),
    ),
    check_importer,
)
"""Importers by name: the project's, those of `register_importer`, and those of installed distributions."""


def register_importer(row: Importer, *, replace: bool = False) -> None:
    """Add a kind of file to `IMPORTERS`, for `import_recording` and the command `uwblink import`.

    With `replace` it replaces a registered one. Raises `ArgumentError` for a name that is taken, and for a row that
    cannot work.

    >>> import uwblink
    >>> from uwblink.importers import IMPORTERS, Importer
    >>> def read(source, _map):
    ...     rows = [[int(cell) for cell in line.split()] for line in source.read_text().splitlines()]
    ...     one, other, *stamps = zip(*rows)
    ...     columns = dict(zip(("tx1", "rx1", "tx2", "rx2"), stamps))
    ...     return uwblink.Contents(exchanges=uwblink.Exchanges.from_arrays(one, other, **columns))
    >>> uwblink.register_importer(Importer("blanks", (".ranges",), read, "Import six numbers a line."))
    >>> IMPORTERS.remove("blanks")
    """
    IMPORTERS.register(row, replace=replace)


Source = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""A path, or several paths of a kind that allows several files."""

MapSource = str | os.PathLike[str] | Mapping[str, Any]
"""Explanation of the columns of a table: the path of a map, or for a data frame also its keys."""


def import_recording(
    source: Source | Any,
    output: str | os.PathLike[str],
    *,
    importer: str | None = None,
    map_file: MapSource | None = None,
    force: bool = False,
) -> int:
    """Import a file, several tables as one, or a data frame into a new recording; returns the number of exchanges.

    `importer` names a row of `IMPORTERS`; by default the name of the file determines it. `map_file` explains a table's
    columns. A data frame is one of pandas or Polars, or another object with Arrow's interface in C; without a map, it
    is guessed as by `uwblink import guess`. Raises `ArgumentError`, `ImportTableError` and what `Recording.create`
    raises; nothing is written then.

    >>> import pathlib, tempfile, uwblink
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> size = (folder / "t.csv").write_text("time_s,from_id,to_id,tx1,rx1,tx2,rx2\\n0.5,1,2,0,5,1005,3000\\n")
    >>> uwblink.import_recording(folder / "t.csv", folder / "t.uwb")
    1
    """
    return import_file(source, output, importer=importer, map_file=map_file, force=force).counts["exchanges"]


def import_file(
    source: Source | Any,
    output: str | os.PathLike[str],
    *,
    importer: str | None = None,
    map_file: MapSource | None = None,
    force: bool = False,
    watch: Watch = lambda _step, _share: None,
) -> Imported:
    """Import like `import_recording`; returns the numbers of imported rows.

    `watch` is called with the current step ("reading", "checking", "writing", and between the first two "sorting" and
    "grouping" if an exchange has several rows) and its completed share, by importers that report it.
    """
    check_output(Path(output), force=force, recording=True)
    if is_frame(source):
        with _folder("data frame") as folder:
            table = _write_frame(source, folder)
            map_file = _map_of_frame(table, map_file)
            return import_file(table, output, importer="csv", map_file=map_file, force=force, watch=watch)
    if isinstance(map_file, Mapping):
        raise ArgumentError(
            "found a mapping, which is only allowed for a data frame; give the path of a file", parameter="map_file"
        )
    sources, row, explained = _choose(source, importer, map_file)
    with IMPORTERS.calling(row.name, ImportTableError), _folder(", ".join(map(str, sources))) as folder:
        if row.tables is not None:
            watch("reading", 0.0)
            paths, column_map = row.tables(sources, explained, folder)
            meta = {"source": f"import {row.name}", "imported_from": ", ".join(path.name for path in sources)}
            return import_tables(paths, column_map, Path(output), meta, watch, force=force)
        read: Any = row.read
        contents = read(sources[0], explained)
        if not isinstance(contents, Contents):
            raise ArgumentError(f"importer {row.name!r}: returned {contents!r:.60}, expected Contents")
        contents.save(output, force=force)
        return Imported(contents.counts(), list(contents.meta.get("notes", ())))


def read_source(source: Source | Any, *, importer: str | None = None, map_file: MapSource | None = None) -> Contents:
    """Read a file without writing anything; parameters and errors are those of `import_recording`.

    Importers put notes for the user into `meta["notes"]`, a list of lines.
    """
    with TemporaryDirectory(prefix="uwblink-") as folder:
        output = Path(folder) / "imported.uwb"
        import_file(source, output, importer=importer, map_file=map_file)
        return load(output)


@contextmanager
def _folder(named: str) -> Iterator[Path]:
    """Return a folder for temporary files of an import; errors name the source instead of these files."""
    with TemporaryDirectory(prefix="uwblink-") as folder:
        try:
            yield Path(folder)
        except ImportTableError as error:
            error.args = (re.sub(rf"{re.escape(folder)}[^:]*", lambda _: named, str(error)),)
            raise


def _choose(
    source: Source, importer: str | None, map_file: str | os.PathLike[str] | None
) -> tuple[list[Path], Importer, Path | None]:
    """Return the files, their importer, and the map."""
    sources = [Path(source)] if isinstance(source, str | os.PathLike) else [Path(one) for one in source]
    if not sources:
        raise ArgumentError("found no files, expected a path or several", parameter="source")
    if importer is not None and importer not in IMPORTERS:
        raise ArgumentError(f"importer: found {importer!r:.40}, allowed: {', '.join(IMPORTERS)}")
    ending = sources[0].name.lower()
    # Of several the longest ending decides, and of equal ones the first row.
    fitting = {len(one): row for row in [*IMPORTERS.values()][::-1] for one in row.suffixes if ending.endswith(one)}
    if importer is None and not fitting:
        known = ", ".join(suffix for row in IMPORTERS.values() for suffix in row.suffixes)
        raise ImportTableError(
            f"{sources[0]}: no importer for this kind of file; the known ones are {known}; or choose one with importer="
        )
    row = fitting[max(fitting)] if importer is None else IMPORTERS[importer]
    if map_file is not None and row.map_help is None:
        raise ArgumentError(f"importer {row.name!r} uses none", parameter="map_file")
    if len(sources) > 1 and not row.several:
        raise ArgumentError(f"importer {row.name!r} needs one file, found {len(sources)}", parameter="source")
    return sources, row, None if map_file is None else Path(map_file)


def _write_frame(frame: Any, folder: Path) -> Path:
    """Write a data frame as Parquet into a folder, named indices as columns; raises `ImportTableError`."""
    path = folder / "data frame.parquet"  # the name of the source in the recording
    if any(name is not None for name in getattr(getattr(frame, "index", None), "names", [])):
        frame = frame.reset_index()
    with (
        raising(ImportTableError, f"{path.stem}: cannot be read", duckdb.Error, TypeError, ValueError),
        connect(folders=[folder]) as db,
    ):
        db.register("frame", frame)
        db.view("frame").write_parquet(str(path))
    return path


def _map_of_frame(table: Path, given: str | os.PathLike[str] | Mapping[str, Any] | None) -> Path:
    """Return the path of the map of a written frame: the given one, one with the contents of a mapping, or a guess.

    Raises `ImportTableError` that names missing values if the frame does not contain all.
    """
    if isinstance(given, str | os.PathLike):
        return Path(given)
    if given is not None:
        path = table.with_suffix(".json")
        path.write_text(json.dumps(given, default=dict), "utf-8")
        return path
    found, path = guess_map(table), table.with_suffix(".toml")
    if found.asked or not found.complete:
        what = f"state {' and '.join(found.asked)}" if found.asked else "name its columns"
        proposed = "\n".join(line for line in found.text.splitlines()[1:] if line)
        raise ImportTableError(f"{table.stem}: {what} in `map`, a mapping or a file such as\n{proposed}")
    path.write_text(found.text, "utf-8")
    return path
