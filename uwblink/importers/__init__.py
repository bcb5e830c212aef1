"""Import of files in other formats; programs and other distributions can register importers of their own.

A registered reader takes a path and returns `Contents`. This module writes the recording, and never overwrites one
unless it is told to. It also reads back what `uwblink export --to csv` or `parquet` wrote.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, Protocol

import duckdb

from uwblink.errors import ArgumentError, ImportTableError, first_line
from uwblink.importers.bags import BAG_SUFFIXES, open_exchange_bag
from uwblink.importers.exchange_tables import TABLE_SUFFIXES, open_tables
from uwblink.importers.miluv import read_miluv
from uwblink.importers.poses import add_poses
from uwblink.importers.staging import Watch, unwatched
from uwblink.importers.tables import connect_to
from uwblink.output import check_output
from uwblink.plugins import Registry, check_row, is_text
from uwblink.recording.contents import Contents, load
from uwblink.recording.schema import BY_POSES, TABLES, TRUTH_FROM
from uwblink.recording.store import Store

__all__ = [
    "IMPORTERS",
    "Imported",
    "Importer",
    "add_poses",
    "import_file",
    "import_recording",
    "read_source",
    "register_importer",
]


class Importing(Protocol):
    """The contents of files, which do not need to be in memory at once."""

    def write(self, path: str | os.PathLike[str], *, force: bool = False) -> tuple[dict[str, int], list[str]]:
        """Write a recording; returns the number of rows by table, and notes for the user."""


@dataclass(frozen=True, slots=True)
class Importer:
    """A kind of file that can become a recording.

    `read(source, map)` returns what the file at `source` holds and raises `ImportTableError`; `map` is the path of a
    file that explains it, for kinds with a `map_help`, else None. `suffixes` are what names of such files end with, in
    small letters, none for a kind of folder; `name` is that of the command `uwblink import NAME`, and `help` its line.
    `read_all` takes a list of paths instead of one; formats without it take one file. `open_all` is for formats whose
    files do not need to be in memory at once: it takes a list of paths, the path of the map and a callback for
    progress, and yields an object with a method `write`.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[Path, Path | None], Contents]
    help: str
    map_help: str | None = None
    read_all: Callable[[Sequence[Path], Path | None], Contents] | None = None
    _: KW_ONLY
    open_all: Callable[[Sequence[Path], Path | None, Watch], AbstractContextManager[Importing]] | None = None


def check_importer(row: Any) -> None:
    """Raise `ArgumentError` for a row that cannot be an importer."""
    check_row(
        "importer",
        row,
        Importer,
        {
            "suffixes": (
                lambda found: isinstance(found, tuple) and all(isinstance(s, str) and s[:1] == "." for s in found),
                "a tuple such as ('.csv', '.csv.gz')",
            ),
            "read": (callable, "a function of a path and a map's path"),
            "help": (is_text, "a line of text"),
            "map_help": (lambda found: found is None or is_text(found), "a line of text"),
        },
    )


def read_table(source: Path | Sequence[Path], map_file: Path | None = None) -> Contents:
    """Return the exchanges of one table, all tables of a folder, or several tables; raises `ImportTableError`."""
    with open_tables([source] if isinstance(source, Path) else source, map_file) as found:
        return found.contents()


def _read_bag(source: Path, map_file: Path | None = None) -> Contents:
    with open_exchange_bag([source], map_file) as found:
        return found.contents()


def read_exported(folder: Path, _map_file: Path | None = None) -> Contents:
    """Read an export to CSV or Parquet, every column of every table; raises `ImportTableError`."""
    if not folder.is_dir():
        raise ImportTableError(f"{folder}: no such folder; expected one that 'uwblink export' wrote")
    places = [(table, folder / f"{table}{suffix}") for table in TABLES for suffix in (".parquet", ".csv")]
    paths = {table: path for table, path in places if path.is_file()}
    if "exchanges" not in paths:
        raise ImportTableError(f"{folder}: holds no exchanges.csv or exchanges.parquet, as 'uwblink export' writes")
    with TemporaryDirectory() as place:
        path = Path(place) / "exported.uwb"
        store = Store.write(path, path)
        try:
            for table, source in paths.items():
                with connect_to([source]) as db:
                    store.insert(table, dict(db.execute(_query(db, table, source), [str(source)]).fetchnumpy()))
        except (duckdb.Error, UnicodeDecodeError, csv.Error) as error:
            raise ImportTableError(f"{source}: not in the form of 'uwblink export' ({first_line(error)})") from error
        finally:
            store.close()
        return load(path)


def _query(db: duckdb.DuckDBPyConnection, table: str, source: Path) -> str:
    """Return the query that reads an exported table; text from the file never becomes part of it."""
    columns, read = TABLES[table] | {TRUTH_FROM: "VARCHAR"}, "read_parquet(?)"
    cells = {name: f'"{name}"' for name in TABLES[table]}
    if source.suffix == ".csv":
        with source.open(encoding="utf-8-sig", newline="") as file:
            header = next(csv.reader(file), [])
        there = [name if name in columns else f"other{k}" for k, name in enumerate(header)]
        kinds = ", ".join(f"'{name}': 'VARCHAR'" for name in there)
        read = (
            f"read_csv(?, auto_detect=false, header=true, delim=',', quote='\"', escape='\"', nullstr='', "
            f"allow_quoted_nulls=false, columns={{{kinds}}}, max_line_size=64000000, parallel=false)"
        )
        for name, kind in TABLES[table].items():
            cells[name] = f"CAST({f'unhex({cells[name]})' if kind == 'BLOB' else cells[name]} AS {kind})"
    else:
        found = db.execute(f"DESCRIBE SELECT * FROM {read}", [str(source)]).fetchall()  # noqa: S608 - nothing of a file
        there = [str(row[0]) for row in found]
    if TRUTH_FROM in there and table == "exchanges":
        # Distances by poses are left out, because the poses are imported, too.
        cells["truth_m"] = f"CASE WHEN {TRUTH_FROM} = '{BY_POSES}' THEN NULL ELSE {cells['truth_m']} END"
    listed = ", ".join(f'{cell} AS "{name}"' for name, cell in cells.items())
    return f"SELECT {listed} FROM {read}"  # noqa: S608 - keys of TABLES


IMPORTERS: Final[Registry[Importer]] = Registry(
    "importer",
    "uwbcal.importers",
    (
        Importer(
            "csv",
            TABLE_SUFFIXES,
            read_table,
            "Import exchanges, messages or ranges from a table: CSV, Parquet or JSON lines.",
            map_help="Names, units and constants (.toml).",
            read_all=read_table,
            open_all=open_tables,
        ),
        Importer(
            "bag",
            BAG_SUFFIXES,
            _read_bag,
            "Import exchanges from messages in a bag of ROS 1, ROS 2 or MCAP.",
            map_help="Topics, names of fields, units and constants (.toml).",
            open_all=open_exchange_bag,
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
    """Add a kind of file to `IMPORTERS`: `import_recording` and the command `uwblink import` then know it.

    `replace` puts it in place of one registered before. Raises `ArgumentError` for a name that is taken, and for a row
    that cannot work.

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
"""A path, or several of a kind of which several can be one recording."""


def import_recording(
    source: Source,
    output: str | os.PathLike[str],
    *,
    importer: str | None = None,
    map_file: str | os.PathLike[str] | None = None,
    force: bool = False,
) -> int:
    """Import a file, or several tables as one, into a new recording; returns the number of exchanges.

    `importer` names a row of `IMPORTERS`; without it the name of the file decides. `map_file` explains a table's
    columns. Raises `ArgumentError`, `ImportTableError` and what `Recording.create` raises; nothing is written then.

    >>> import pathlib, tempfile, uwblink
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> size = (folder / "t.csv").write_text("time_s,from_id,to_id,tx1,rx1,tx2,rx2\\n0.5,1,2,0,5,1005,3000\\n")
    >>> uwblink.import_recording(folder / "t.csv", folder / "t.uwb")
    1
    """
    return import_file(source, output, importer=importer, map_file=map_file, force=force).counts["exchanges"]


@dataclass(frozen=True, slots=True)
class Imported:
    """What was imported: the number of rows by table, exchanges first, and notes for the user."""

    counts: dict[str, int]
    notes: list[str]


def import_file(
    source: Source,
    output: str | os.PathLike[str],
    *,
    importer: str | None = None,
    map_file: str | os.PathLike[str] | None = None,
    force: bool = False,
    watch: Watch = unwatched,
) -> Imported:
    """Do what `import_recording` does; returns what was imported.

    `watch` is called with what is being done ("reading", "checking", "writing", and between the first two "sorting" and
    "grouping" where an exchange has several rows) and which share of it is done, by importers that say so.
    """
    check_output(Path(output), force=force, recording=True)
    sources, row, explained = _chosen(source, importer, map_file)
    if row.open_all is not None:
        with IMPORTERS.calling(row.name, ImportTableError), row.open_all(sources, explained, watch) as found:
            return Imported(*found.write(output, force=force))
    contents = _read(sources, row, explained)
    contents.save(output, force=force)
    return Imported(contents.counts(), list(contents.meta.get("notes", ())))


def read_source(
    source: Source, *, importer: str | None = None, map_file: str | os.PathLike[str] | None = None
) -> Contents:
    """Read a file without writing anything; parameters and errors are those of `import_recording`.

    Importers put notes for the user into `meta["notes"]`, a list of lines.
    """
    return _read(*_chosen(source, importer, map_file))


def _chosen(
    source: Source, importer: str | None, map_file: str | os.PathLike[str] | None
) -> tuple[list[Path], Importer, Path | None]:
    """Return the files, their importer, and the map."""
    sources = [Path(source)] if isinstance(source, str | os.PathLike) else [Path(one) for one in source]
    if not sources:
        raise ArgumentError("found no files, expected a path or several", parameter="source")
    row = _importer(sources[0], importer)
    if map_file is not None and row.map_help is None:
        raise ArgumentError(f"map_file: importer {row.name!r} takes none")
    if len(sources) > 1 and row.read_all is None:
        raise ArgumentError(f"importer {row.name!r} takes one file, found {len(sources)}", parameter="source")
    return sources, row, None if map_file is None else Path(map_file)


def _read(sources: list[Path], row: Importer, map_file: Path | None) -> Contents:
    several = row.read_all if len(sources) > 1 else None
    with IMPORTERS.calling(row.name, ImportTableError):
        contents = several(sources, map_file) if several else row.read(sources[0], map_file)
    if not isinstance(contents, Contents):
        raise ArgumentError(f"importer {row.name!r}: returned {contents!r:.60}, expected Contents")
    return contents


def _importer(source: Path, name: str | None) -> Importer:
    if name is not None:
        if name not in IMPORTERS:
            raise ArgumentError(f"importer: found {name!r:.40}, allowed: {', '.join(IMPORTERS)}")
        return IMPORTERS[name]
    ending = source.name.lower()
    for row in IMPORTERS.values():
        if ending.endswith(row.suffixes):
            return row
    known = ", ".join(suffix for row in IMPORTERS.values() for suffix in row.suffixes)
    raise ImportTableError(f"{source}: no importer for such a file; known are {known}; or name one with importer=")
