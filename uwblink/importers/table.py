"""Tables of strangers, read by DuckDB: columns by their names in, arrays out.

DuckDB may open the named file and nothing else, and no text of a file or of a map becomes SQL: columns get names of
ours, by their place, and what a JSON line calls a value is bound.
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.csv_dialect import CsvDialect, detect

if TYPE_CHECKING:
    import duckdb

LONGEST_LINE: Final = 4_000_000
"""Bytes; an impulse response in one cell takes 6,000."""

EXACT: Final = 2.0**53
"""Whole numbers above are not all floats."""

LINES_LOOKED_AT: Final = 1000


@dataclass(frozen=True, slots=True)
class _Relation:
    """What a query reads: SQL in which nothing is a stranger's, what is bound to it, and the cells by column."""

    source: str
    names: tuple[str, ...]
    cells: tuple[str, ...]
    numeric: tuple[bool, ...]
    bound: tuple[str | None, ...]
    decimal_comma: bool = False


class Table:
    """One file, whose columns are read when asked for. Close it, or use it as a context manager."""

    def __init__(self, path: Path, delimiter: str | None = None, decimal: str | None = None) -> None:
        """Open a CSV file (plain or gzipped), a Parquet file or JSON lines, by its suffix; raises `ImportTableError`.

        `delimiter` and `decimal` override what a CSV file looks like.
        """
        _check(path)
        self.path = path
        self._dialect: CsvDialect | None = None
        self._rejected: list[int] = []
        ending = path.name.lower().removesuffix(".gz")
        if ending.endswith(".parquet"):
            self._db = confined(path)
            self._relation = self._parquet()
        elif ending.endswith((".jsonl", ".ndjson", ".json")):
            self._relation = _json_lines(path)
            self._db = confined(path)
        else:
            self._dialect = detect(path, delimiter, decimal)
            self._relation = _csv(self._dialect)
            self._db = confined(path)
        self.names = self._relation.names

    def __enter__(self) -> Self:
        """Return the table itself."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Close the file."""
        self._db.close()

    def require(self, names: Iterable[str]) -> None:
        """Raise `ImportTableError` for the first name that no column has, or that two have."""
        for name in names:
            if name not in self.names:
                raise ImportTableError(
                    f"{self.path}: column {name[:60]!r} is missing; there are {', '.join(self.names)[:400]}"
                )
            if self.names.count(name) > 1:
                raise ImportTableError(f"{self.path}: row 1: two columns are called {name[:60]!r}")

    def read(self, numbers: Iterable[str] = (), words: Iterable[str] = ()) -> tuple[dict[str, Floats], dict[str, Any]]:
        """Return columns as float64 (n,), NaN where a cell is empty or no number, and columns as text (n,)."""
        wanted, texts = list(dict.fromkeys(numbers)), list(dict.fromkeys(words))
        cells = [(name, self._number(self._place(name))) for name in wanted]
        cells += [(name, self._word(self._place(name))) for name in texts]
        found = self._read(cells)
        columns = [np.ma.filled(column.astype(np.float64, copy=False), np.nan) for column in found[: len(wanted)]]
        text = [np.ma.filled(column, "").astype(np.str_) for column in found[len(wanted) :]]
        return dict(zip(wanted, columns, strict=True)), dict(zip(texts, text, strict=True))

    def numbers(self, names: Iterable[str]) -> dict[str, Floats]:
        """Return columns as float64 (n,), NaN where a cell is empty or no number."""
        return self.read(numbers=names)[0]

    def words_at(self, name: str, rows: Iterable[int]) -> dict[int, str]:
        """Return cells of a column as text, by their rows (0 is the first)."""
        import duckdb

        place = self._place(name)
        cell = self._word(place)
        counted = f"SELECT {cell} AS word, row_number() OVER () - 1 AS row FROM {self._relation.source}"  # noqa: S608 - columns by place
        query = f"SELECT row, word FROM ({counted}) WHERE row IN (SELECT unnest(?::BIGINT[]))"  # noqa: S608 - as above
        bound = [*self._keys(place, cell), str(self.path), sorted(set(rows))]
        try:
            return {int(row): str(word) for row, word in self._db.execute(query, bound).fetchall()}
        except duckdb.Error as error:
            raise ImportTableError(f"{self.path}: cannot be read as a table ({first_line(error)})") from error

    def whole_numbers(self, name: str, missing: int) -> Ints:
        """Return a column of whole numbers exactly, also those that a float does not hold; others are `missing`."""
        (found,) = self._read([(name, f"TRY_CAST({self._word(self._place(name))} AS BIGINT)")])
        return np.ma.filled(found.astype(np.int64), missing)

    def times_ns(self, name: str) -> Ints:
        """Return ISO 8601 times as nanoseconds since 1970 (n,), UTC where no zone is named; the least where none is."""
        place = self._place(name)
        if self._relation.numeric[place]:
            raise ImportTableError(f"{self.path}: column {name[:60]!r} holds numbers, not times as 2024-05-06T07:08:09")
        text = self._word(place)
        # A zone is a shift of whole minutes, which the finer type would drop.
        shift = f"TRY_CAST({text} AS TIMESTAMPTZ)"
        zone = f"regexp_matches({text}, '[T ].*[+-][0-9]{{2}}:?([0-9]{{2}})?$')"
        time = f"CASE WHEN {zone} THEN epoch_ns({shift}) ELSE epoch_ns(TRY_CAST({text} AS TIMESTAMP_NS)) END"
        (found,) = self._read([(name, time)])
        return np.ma.filled(found.astype(np.int64), np.iinfo(np.int64).min)

    def lists(self, name: str) -> NDArray[np.object_]:
        """Return a column of lists such as `[1, 2]` as arrays of whole numbers, None where a cell is no such list."""
        (found,) = self._read([(name, f"TRY_CAST({self._word(self._place(name))} AS USMALLINT[])")])
        filled = np.empty(len(found), dtype=object)
        filled[:] = [None if value is np.ma.masked else value for value in found]
        return filled

    def lines(self, rows: Ints) -> list[int]:
        """Return where in the file some rows are: its lines, the first being 1; rows of Parquet from 1."""
        if self._dialect is None and self._relation.source.startswith("read_parquet"):
            return [int(row) + 1 for row in rows]
        skip = self._dialect.skip if self._dialect else 0
        return _lines(self.path, skip, self.rejected(), rows)

    def rejected(self) -> list[int]:
        """Return the lines that were left out of everything read so far: they have more cells than the header."""
        return self._rejected

    def _place(self, name: str) -> int:
        self.require([name])
        return self.names.index(name)

    def _text(self, place: int) -> str:
        return f"CAST({self._relation.cells[place]} AS VARCHAR)"

    def _word(self, place: int) -> str:
        return f"coalesce(trim({self._text(place)}), '')"

    def _number(self, place: int) -> str:
        if self._relation.numeric[place]:
            return f"CAST({self._relation.cells[place]} AS DOUBLE)"
        # Not the bare column: a cast of that is done while the file is read, where a cell that is no number makes the
        # whole row vanish among those with too many cells.
        text = f"coalesce({self._text(place)}, '')"
        text = f"replace({text}, ',', '.')" if self._relation.decimal_comma else text
        return f"TRY_CAST({text} AS DOUBLE)"

    def _read(self, cells: list[tuple[str, str]]) -> list[NDArray[Any]]:
        import duckdb

        chosen = ", ".join(f"{cell} AS r{k}" for k, (_, cell) in enumerate(cells))
        places = [self.names.index(name) for name, _ in cells]
        keys = [key for k, place in enumerate(places) for key in self._keys(place, cells[k][1])]
        query = f"SELECT {chosen} FROM {self._relation.source}"  # noqa: S608 - columns by place, r0, r1 ...
        try:
            found = self._db.execute(query, [*keys, str(self.path)]).fetchnumpy()
            if self._dialect is not None:
                bad = self._db.execute("SELECT DISTINCT line FROM reject_errors ORDER BY line").fetchall()
                self._rejected = [int(line) for (line,) in bad]
        except duckdb.Error as error:
            raise ImportTableError(f"{self.path}: cannot be read as a table ({first_line(error)})") from error
        return [found[f"r{k}"] for k in range(len(cells))]

    def _keys(self, place: int, cell: str) -> list[str]:
        key = self._relation.bound[place]
        return [] if key is None else [key] * cell.count("?")

    def _parquet(self) -> _Relation:
        import duckdb

        try:
            rows = self._db.execute("DESCRIBE SELECT * FROM read_parquet(?)", [str(self.path)]).fetchall()
        except duckdb.Error as error:
            raise ImportTableError(f"{self.path}: cannot be read as Parquet ({first_line(error)})") from error
        cells = tuple(f"c{k}" for k in range(len(rows)))
        kinds = ("INT", "DOUBLE", "FLOAT", "DECIMAL")
        return _Relation(
            f"read_parquet(?) AS t({', '.join(cells)})",
            tuple(str(row[0]) for row in rows),
            cells,
            tuple(any(kind in str(row[1]) for kind in kinds) and "[" not in str(row[1]) for row in rows),
            (None,) * len(rows),
        )


def _csv(dialect: CsvDialect) -> _Relation:
    cells = tuple(f"c{k}" for k in range(len(dialect.names)))
    columns = ", ".join(f"'{cell}': 'VARCHAR'" for cell in cells)
    delimiter = "\\t" if dialect.delimiter == "\t" else dialect.delimiter
    source = (
        f"read_csv(?, auto_detect=false, header=false, skip={dialect.skip}, delim='{delimiter}', quote='\"', "
        f"escape='\"', columns={{{columns}}}, null_padding=true, store_rejects=true, rejects_limit=0, "
        f"max_line_size={LONGEST_LINE})"
    )
    none = (None,) * len(cells)
    return _Relation(source, dialect.names, cells, (False,) * len(cells), none, dialect.decimal_comma)


def _json_lines(path: Path) -> _Relation:
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
    cells = ("json_extract_string(json, ?)",) * count
    source = "read_ndjson_objects(?, ignore_errors=true)"
    return _Relation(source, tuple(fields), cells, (False,) * count, tuple(fields.values()))


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


def _lines(path: Path, skip: int, rejected: list[int], rows: Ints) -> list[int]:
    """Return the lines of rows (0 is the first that was not rejected), past empty lines and breaks in quotes."""
    wanted = iter(sorted({int(row) for row in rows}))
    row, found, out, quoted = next(wanted, None), -1, {}, False
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt", encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            if row is None:
                break
            begins = not quoted
            quoted ^= bool(line.count('"') % 2)
            if number <= skip or not begins or not line.strip() or number in rejected:
                continue
            found += 1
            if found == row:
                out[row] = number
                row = next(wanted, None)
    return [out.get(int(row), int(row) + 1 + skip) for row in rows]


def _check(path: Path) -> None:
    if path.is_dir():
        raise ImportTableError(f"{path}: is a directory, expected a table (.csv, .csv.gz, .parquet or .jsonl)")
    if not path.exists():
        raise ImportTableError(f"{path}: no such table")
    if path.suffix == ".gz":
        _check_gzip(path)


def _check_gzip(path: Path) -> None:
    """Read a compressed file through: DuckDB reads a broken one for ever."""
    try:
        with gzip.open(path, "rb") as file:
            while file.read(1 << 20):
                pass
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ImportTableError(f"{path}: broken or truncated gzip ({error})") from error
    except OSError as error:
        raise ImportTableError(f"{path}: cannot be read ({error.strerror})") from error


def first_line(error: Exception) -> str:
    """Return the first line of an error's text."""
    return (str(error).splitlines() or [""])[0][:200]


def confined(path: Path) -> duckdb.DuckDBPyConnection:
    """Return a connection that can open this file and no other, and whose settings are locked."""
    import duckdb

    db = duckdb.connect(":memory:")
    db.execute("SET TimeZone = 'UTC'")
    db.execute("SET enable_progress_bar = false")
    db.execute("SET allowed_paths = ?", [[str(path)]])
    db.execute("SET enable_external_access = false")
    db.execute("SET lock_configuration = true")
    return db
