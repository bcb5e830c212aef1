"""Tables in CSV, Parquet or JSON lines, read by DuckDB: SQL expressions of their columns, and columns as arrays.

DuckDB can open the named files only, and text of a file or a map never becomes SQL: columns are named by their number,
and paths and JSON keys are variables of the connection.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.closing import Closing
from uwblink.database import connect
from uwblink.errors import ImportTableError, first_line
from uwblink.importers.csv_text import MAX_CELLS, MAX_LINE_BYTES, check_lines, detect, lines_of, open_file, reading
from uwblink.output import is_utf8
from uwblink.text_files import require_regular

if TYPE_CHECKING:
    import duckdb

Columns = dict[str, NDArray[Any]]


def connect_to(paths: Sequence[Path], folder: str | None = None) -> duckdb.DuckDBPyConnection:
    """Return a connection that can open only these files, and whose settings are locked.

    With a `folder` it keeps 350 MB in memory, and the rest there.
    """
    for path in paths:
        if not is_utf8(path):
            raise ImportTableError(f"{path}: its name and those of its folders must be UTF-8; rename it")
    # With 250 MB messages take a tenth longer (2026-11-22).
    return connect(paths=paths, temporary=folder, memory_mb=None if folder is None else 350)


class Table(Closing):
    """One file, whose columns are read on request. Close it, or use it as a context manager.

    `names` are its columns. `source` is what a query reads FROM, and `number`, `word`, `whole_number` and `time_ns`
    return SQL expressions of columns of it.
    """

    def __init__(
        self,
        path: Path,
        delimiter: str | None = None,
        decimal: str | None = None,
        *,
        db: duckdb.DuckDBPyConnection | None = None,
        key: int = 0,
    ) -> None:
        """Open a CSV file (plain or gzipped), a Parquet file or JSON lines, by its suffix; raises `ImportTableError`.

        `delimiter` and `decimal` override what is detected in a CSV file. Tables that share a connection `db` have
        different keys.
        """
        require_regular(path, ImportTableError, "table (.csv, .csv.gz, .parquet or .jsonl)")
        self.path, self._own = path, db is None
        self.db = connect_to([path]) if db is None else db
        self._key, self._skip, self._decimal_comma, self._is_csv = key, 0, False, False
        self._numeric: tuple[bool, ...] = ()
        self.db.execute(f"SET VARIABLE file{key} = ?", [str(path)])
        ending = path.name.lower().removesuffix(".gz")
        self._is_parquet = ending.endswith(".parquet")
        if self._is_parquet:
            self._open_parquet()
        elif ending.endswith((".jsonl", ".ndjson", ".json")):
            self._open_json()
        else:
            self._open_csv(delimiter, decimal)

    def _open_csv(self, delimiter: str | None, decimal: str | None) -> None:
        self._is_csv = True
        self.names, mark, self._decimal_comma, self._skip = detect(self.path, delimiter, decimal)
        check_lines(self.path, mark)
        self._cells = tuple(f"c{k}" for k in range(len(self.names)))
        columns = ", ".join(f"'{cell}': 'VARCHAR'" for cell in self._cells)
        mark = "\\t" if mark == "\t" else mark
        self.source = (
            f"read_csv(getvariable('file{self._key}'), auto_detect=false, header=false, skip={self._skip}, "
            f"delim='{mark}', quote='\"', escape='\"', columns={{{columns}}}, null_padding=true, store_rejects=true, "
            f"rejects_limit=0, rejects_table='rejects{self._key}', rejects_scan='scans{self._key}', "
            f"max_line_size={MAX_LINE_BYTES})"
        )

    def _open_json(self) -> None:
        """Use the fields of the first lines as columns; nested fields have names such as `pose.x`."""
        check_lines(self.path)
        fields: dict[str, str] = {}
        with reading(self.path), open_file(self.path) as file:
            lines = [line.decode("utf-8-sig") for line in islice(file, 1000)]
        for line in lines:
            try:
                row = json.loads(line)
            except (ValueError, RecursionError):
                continue
            if isinstance(row, dict):
                fields |= dict(_fields(row, "", ""))
        if not fields:
            raise ImportTableError(f"{self.path}: holds no JSON objects, one a line")
        self._check_count(len(fields))
        self.names = tuple(fields)
        self._cells = tuple(
            f"json_extract_string(json, getvariable('field{self._key}_{k}'))" for k in range(len(fields))
        )
        for k, pointer in enumerate(fields.values()):
            self.db.execute(f"SET VARIABLE field{self._key}_{k} = ?", [pointer])
        self.source = f"read_ndjson_objects(getvariable('file{self._key}'), ignore_errors=true)"

    def _open_parquet(self) -> None:
        read = f"read_parquet(getvariable('file{self._key}'))"
        with self.reading():
            rows = self.db.execute(f"DESCRIBE SELECT * FROM {read}").fetchall()
        self._check_count(len(rows))
        self.names = tuple(str(row[0]) for row in rows)
        self._cells = tuple(f"c{k}" for k in range(len(rows)))
        kinds = ("INT", "DOUBLE", "FLOAT", "DECIMAL")
        self._numeric = tuple(any(kind in str(row[1]) for kind in kinds) and "[" not in str(row[1]) for row in rows)
        self.source = f"{read} AS t({', '.join(self._cells)})"

    def _check_count(self, count: int) -> None:
        if count > MAX_CELLS:
            raise ImportTableError(f"{self.path}: has {count} columns, expected {MAX_CELLS} at most")

    def close(self) -> None:
        """Close the file."""
        if self._own:
            self.db.close()

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Convert DuckDB's errors about the file into `ImportTableError`; errors of the disk pass."""
        import duckdb

        try:
            yield
        except duckdb.Error as error:
            of_disk = isinstance(error, duckdb.OutOfMemoryException | duckdb.IOException)
            if of_disk and not self._own and str(self.path) not in str(error):
                raise
            raise ImportTableError(f"{self.path}: cannot be read as a table ({first_line(error)})") from error

    def number(self, name: str) -> str:
        """Return a column as finite DOUBLE, NULL where a cell is empty or no number; raises `ImportTableError`."""
        place = self._place(name)
        if self._is_parquet and self._numeric[place]:
            value = f"CAST({self._cells[place]} AS DOUBLE)"
        else:
            # DuckDB would cast a bare column while it reads the file, and would reject the whole row for a cell that is
            # not a number.
            text = f"coalesce({self._text(place)}, '')"
            text = f"replace({text}, ',', '.')" if self._decimal_comma else text
            value = f"TRY_CAST({text} AS DOUBLE)"
        return f"CASE WHEN isfinite({value}) THEN {value} END"

    def word(self, name: str) -> str:
        """Return a column as text without blanks around it."""
        return f"coalesce(trim({self._text(self._place(name))}), '')"

    def whole_number(self, name: str) -> str:
        """Return a column as BIGINT, also numbers that no DOUBLE holds; NULL where a cell is no whole number."""
        return f"TRY_CAST({self.word(name)} AS BIGINT)"

    def time_ns(self, name: str) -> str:
        """Return a column of ISO 8601 times as nanoseconds since 1970, UTC where no zone is named, or NULL."""
        if self._is_parquet and self._numeric[self._place(name)]:
            raise ImportTableError(f"{self.path}: column {name[:60]!r} holds numbers, not times as 2024-05-06T07:08:09")
        text = self.word(name)
        # TIMESTAMP_NS ignores time zones; TIMESTAMPTZ has microseconds, and zones are whole minutes.
        zone = f"regexp_matches({text}, '[T ].*[+-][0-9]{{2}}:?([0-9]{{2}})?$')"
        return (
            f"CASE WHEN {zone} THEN epoch_ns(TRY_CAST({text} AS TIMESTAMPTZ)) "
            f"ELSE epoch_ns(TRY_CAST({text} AS TIMESTAMP_NS)) END"
        )

    def _place(self, name: str) -> int:
        if name not in self.names:
            raise ImportTableError(
                f"{self.path}: column {name[:60]!r} is missing; there are {', '.join(self.names)[:400]}"
            )
        if self.names.count(name) > 1:
            raise ImportTableError(f"{self.path}: row 1: two columns are called {name[:60]!r}")
        return self.names.index(name)

    def _text(self, place: int) -> str:
        return f"CAST({self._cells[place]} AS VARCHAR)"

    def query(self, cells: Mapping[str, str], more: str = "") -> Columns:
        """Return SQL expressions of columns as arrays (n,) by name, masked where values are missing.

        `more` follows the source in the query.
        """
        chosen = ", ".join(f"{cell} AS {name}" for name, cell in cells.items())
        with self.reading():
            return dict(self.db.execute(f"SELECT {chosen} FROM {self.source} {more}").fetchnumpy())

    def read(
        self, numbers: Iterable[str] = (), words: Iterable[str] = (), limit: int | None = None
    ) -> tuple[dict[str, Floats], dict[str, NDArray[np.str_]]]:
        """Return columns as float64 (n,), NaN where a cell is empty or no number, and columns as text (n,).

        With a `limit` only the first rows are read.
        """
        listed, texts = list(dict.fromkeys(numbers)), list(dict.fromkeys(words))
        if not listed and not texts:
            return {}, {}
        cells = {f"n{k}": self.number(name) for k, name in enumerate(listed)}
        cells |= {f"w{k}": self.word(name) for k, name in enumerate(texts)}
        found = self.query(cells, f"LIMIT {limit}" if limit else "")
        return (
            {name: np.ma.filled(found[f"n{k}"].astype(np.float64), np.nan) for k, name in enumerate(listed)},
            {name: np.ma.filled(found[f"w{k}"], "").astype(np.str_) for k, name in enumerate(texts)},
        )

    def words_at(self, names: Sequence[str], rows: Ints) -> dict[int, dict[str, str]]:
        """Return the text of some columns in some rows (n,), by the row (0 is the first) and the column's name."""
        cells = ", ".join(f"{self.word(name)} AS w{k}" for k, name in enumerate(names))
        counted = f"SELECT row_number() OVER () - 1 AS row, {cells} FROM {self.source}"
        query = f"SELECT * FROM ({counted}) WHERE row IN (SELECT unnest(?::BIGINT[]))"
        with self.reading():
            found = self.db.execute(query, [np.unique(rows).tolist()]).fetchall() if names else []
        return {row: dict(zip(names, texts, strict=True)) for row, *texts in found}

    def rejected(self) -> Ints:
        """Return the line numbers of rows with too many cells, which are not read, in ascending order."""
        if not self._is_csv:
            return np.empty(0, dtype=np.int64)
        found = self.db.execute(f"SELECT DISTINCT line FROM rejects{self._key} ORDER BY line").fetchnumpy()
        return np.ma.filled(found["line"].astype(np.int64), 0)

    def lines(self, rows: Ints) -> Ints:
        """Return the line numbers of rows (n,), counted from 1, or the row numbers of Parquet."""
        return rows + 1 if self._is_parquet else lines_of(self.path, self._skip, self.rejected(), rows)


def _fields(row: dict[str, Any], name: str, pointer: str) -> Iterator[tuple[str, str]]:
    """Yield names of fields such as `pose.x`, and their JSON pointers."""
    for key, value in row.items():
        where = f"{pointer}/{key.replace('~', '~0').replace('/', '~1')}"
        if isinstance(value, dict) and pointer.count("/") < 5:
            yield from _fields(value, f"{name}{key}.", where)
        else:
            yield f"{name}{key}", where
