"""What a query reads of a stranger's file: its columns by their places, and nothing of it as SQL."""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from uwblink.errors import ImportTableError, first_line
from uwblink.importers.csv_dialect import CsvDialect
from uwblink.importers.file_lines import LONGEST_LINE, MOST_CELLS

if TYPE_CHECKING:
    import duckdb

LINES_LOOKED_AT: Final = 1000


@dataclass(frozen=True, slots=True)
class Relation:
    """What a query reads: SQL in which nothing is a stranger's, what is bound to it, and the cells by column."""

    source: str
    names: tuple[str, ...]
    cells: tuple[str, ...]
    numeric: tuple[bool, ...]
    bound: tuple[str | None, ...]
    decimal_comma: bool = False


def csv_relation(dialect: CsvDialect, rejects: str) -> Relation:
    """Return the columns of a CSV file; lines with too many cells go to the table `rejects`."""
    cells = tuple(f"c{k}" for k in range(len(dialect.names)))
    columns = ", ".join(f"'{cell}': 'VARCHAR'" for cell in cells)
    delimiter = "\\t" if dialect.delimiter == "\t" else dialect.delimiter
    source = (
        f"read_csv(?, auto_detect=false, header=false, skip={dialect.skip}, delim='{delimiter}', quote='\"', "
        f"escape='\"', columns={{{columns}}}, null_padding=true, store_rejects=true, rejects_limit=0, "
        f"rejects_table='{rejects}', rejects_scan='{rejects}_scans', "
        f"max_line_size={LONGEST_LINE})"
    )
    none = (None,) * len(cells)
    return Relation(source, dialect.names, cells, (False,) * len(cells), none, dialect.decimal_comma)


def json_relation(path: Path) -> Relation:
    """Return the fields of the first lines; those of objects in objects are called as `pose.x`."""
    fields: dict[str, str] = {}
    for line in _first_lines(path):
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(row, dict):
            fields |= dict(_fields(row, "", ""))
    if not fields:
        raise ImportTableError(f"{path}: holds no JSON objects, one a line")
    count = len(fields)
    if count > MOST_CELLS:
        raise ImportTableError(f"{path}: its lines have more than {MOST_CELLS} fields")
    cells = ("json_extract_string(json, ?)",) * count
    source = "read_ndjson_objects(?, ignore_errors=true)"
    return Relation(source, tuple(fields), cells, (False,) * count, tuple(fields.values()))


def _fields(row: dict[str, Any], name: str, pointer: str) -> Iterable[tuple[str, str]]:
    for key, value in row.items():
        where = f"{pointer}/{key.replace('~', '~0').replace('/', '~1')}"
        if isinstance(value, dict) and pointer.count("/") < 5:
            yield from _fields(value, f"{name}{key}.", where)
        else:
            yield f"{name}{key}", where


def _first_lines(path: Path) -> list[str]:
    try:
        with (gzip.open if path.suffix == ".gz" else open)(path, "rt", encoding="utf-8-sig") as file:
            return list(islice(file, LINES_LOOKED_AT))
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise ImportTableError(f"{path}: cannot be read as JSON lines ({first_line(error)})") from error


def parquet_relation(db: duckdb.DuckDBPyConnection, path: Path) -> Relation:
    """Return the columns of a Parquet file; raises `ImportTableError` for what is none."""
    import duckdb

    try:
        rows = db.execute("DESCRIBE SELECT * FROM read_parquet(?)", [str(path)]).fetchall()
    except duckdb.Error as error:
        raise ImportTableError(f"{path}: cannot be read as Parquet ({first_line(error)})") from error
    if len(rows) > MOST_CELLS:
        raise ImportTableError(f"{path}: has {len(rows)} columns, expected {MOST_CELLS} at most")
    cells = tuple(f"c{k}" for k in range(len(rows)))
    kinds = ("INT", "DOUBLE", "FLOAT", "DECIMAL")
    return Relation(
        f"read_parquet(?) AS t({', '.join(cells)})",
        tuple(str(row[0]) for row in rows),
        cells,
        tuple(any(kind in str(row[1]) for kind in kinds) and "[" not in str(row[1]) for row in rows),
        (None,) * len(rows),
    )
