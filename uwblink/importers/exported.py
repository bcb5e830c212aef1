"""A folder that `uwblink export --to csv` or `parquet` wrote, back into a recording: every column of every table."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from uwblink.errors import ImportTableError, first_line
from uwblink.importers.staging import confined
from uwblink.recording.contents import Contents, load
from uwblink.recording.schema import TABLES
from uwblink.recording.store import Store

SUFFIXES: Final = (".csv", ".parquet")
_FROM_TEXT: Final = {"BLOB": "unhex({0})"}


def read_exported(folder: Path, _map_file: Path | None = None) -> Contents:
    """Return what an export to CSV or Parquet holds; raises `ImportTableError`."""
    if not folder.is_dir():
        raise ImportTableError(f"{folder}: no such folder; expected what 'uwblink export' wrote")
    paths = {table: _path(folder, table) for table in TABLES}
    if paths["exchanges"] is None:
        raise ImportTableError(f"{folder}: holds no exchanges.csv or exchanges.parquet, as 'uwblink export' writes")
    with TemporaryDirectory() as place:
        path = Path(place) / "exported.uwb"
        store = Store.create(path, path)
        try:
            for table, source in paths.items():
                if source is not None:
                    _take(store, table, source)
        finally:
            store.close()
        return load(path)


def _path(folder: Path, table: str) -> Path | None:
    return next((path for suffix in SUFFIXES if (path := folder / f"{table}{suffix}").is_file()), None)


def _take(store: Store, table: str, source: Path) -> None:
    import duckdb

    columns = TABLES[table]
    names = ", ".join(f'"{name}"' for name in columns)
    if source.suffix == ".csv":
        kinds = ", ".join(f"'{name}': 'VARCHAR'" for name in columns)
        reader = (
            f"read_csv(?, auto_detect=false, header=true, delim=',', quote='\"', escape='\"', nullstr='', "
            f"allow_quoted_nulls=false, columns={{{kinds}}}, max_line_size=64000000, parallel=false)"
        )
        cells = (_cell(name, kind) for name, kind in columns.items())
        query = f"SELECT {', '.join(cells)} FROM {reader}"  # noqa: S608 - names are keys of TABLES
    else:
        query = f"SELECT {names} FROM read_parquet(?)"  # noqa: S608 - names are keys of TABLES
    with confined([source]) as db:
        try:
            store.insert(table, dict(db.execute(query, [str(source)]).fetchnumpy()))
        except duckdb.Error as error:
            raise ImportTableError(f"{source}: not as 'uwblink export' wrote it ({first_line(error)})") from error


def _cell(name: str, kind: str) -> str:
    text = _FROM_TEXT.get(kind, "{0}").format(f'"{name}"')
    return f'CAST({text} AS {kind}) AS "{name}"'
