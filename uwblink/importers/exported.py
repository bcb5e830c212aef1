"""Import of folders that `uwblink export --to csv` or `parquet` wrote: every column of every table."""

from __future__ import annotations

import csv
from pathlib import Path
from tempfile import TemporaryDirectory

import duckdb

from uwblink.errors import ImportTableError, first_line
from uwblink.importers.tables import connect_to
from uwblink.recording.contents import Contents, load
from uwblink.recording.schema import BY_POSES, TABLES, TRUTH_FROM
from uwblink.recording.store import Store


def read_exported(folder: Path, _map_file: Path | None = None) -> Contents:
    """Read an export to CSV or Parquet; raises `ImportTableError`."""
    if not folder.is_dir():
        raise ImportTableError(f"{folder}: no such folder; expected one that 'uwblink export' wrote")
    paths = {table: _path(folder, table) for table in TABLES}
    if paths["exchanges"] is None:
        raise ImportTableError(f"{folder}: holds no exchanges.csv or exchanges.parquet, as 'uwblink export' writes")
    with TemporaryDirectory() as place:
        path = Path(place) / "exported.uwb"
        store = Store.write(path, path)
        try:
            for table, source in paths.items():
                if source is not None:
                    _take(store, table, source)
        finally:
            store.close()
        return load(path)


def _path(folder: Path, table: str) -> Path | None:
    return next((path for suffix in (".csv", ".parquet") if (path := folder / f"{table}{suffix}").is_file()), None)


def _take(store: Store, table: str, source: Path) -> None:
    with connect_to([source]) as db:
        try:
            store.insert(table, dict(db.execute(_query(db, table, source), [str(source)]).fetchnumpy()))
        except (duckdb.Error, UnicodeDecodeError, csv.Error) as error:
            raise ImportTableError(f"{source}: not in the form of 'uwblink export' ({first_line(error)})") from error


def _query(db: duckdb.DuckDBPyConnection, table: str, source: Path) -> str:
    """Return the query that reads a table; text from the file never becomes part of it."""
    columns, read = TABLES[table] | {TRUTH_FROM: "VARCHAR"}, "read_parquet(?)"
    if source.suffix == ".csv":
        with source.open(encoding="utf-8-sig", newline="") as file:
            header = next(csv.reader(file), [])
        there = [name if name in columns else f"other{k}" for k, name in enumerate(header)]
        kinds = ", ".join(f"'{name}': 'VARCHAR'" for name in there)
        read = (
            f"read_csv(?, auto_detect=false, header=true, delim=',', quote='\"', escape='\"', nullstr='', "
            f"allow_quoted_nulls=false, columns={{{kinds}}}, max_line_size=64000000, parallel=false)"
        )
    else:
        found = db.execute(f"DESCRIBE SELECT * FROM {read}", [str(source)]).fetchall()  # noqa: S608 - nothing of a file
        there = [str(row[0]) for row in found]
    cells = {name: f'"{name}"' for name in TABLES[table]}
    if source.suffix == ".csv":
        texts = {
            name: f"unhex({cells[name]})" if kind == "BLOB" else cells[name] for name, kind in TABLES[table].items()
        }
        cells = {name: f"CAST({text} AS {TABLES[table][name]})" for name, text in texts.items()}
    if TRUTH_FROM in there and table == "exchanges":
        # Distances by poses are left out, because the poses are imported, too.
        cells["truth_m"] = f"CASE WHEN {TRUTH_FROM} = '{BY_POSES}' THEN NULL ELSE {cells['truth_m']} END"
    listed = ", ".join(f'{cell} AS "{name}"' for name, cell in cells.items())
    return f"SELECT {listed} FROM {read}"  # noqa: S608 - keys of TABLES
