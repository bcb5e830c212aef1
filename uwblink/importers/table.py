"""Tables of strangers, read by DuckDB: columns by their names in, arrays out.

DuckDB may open the named file and nothing else, and no text of a file or of a map becomes SQL: columns get names of
ours, by their place, and what a JSON line calls a value is bound.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.errors import ImportTableError, first_line
from uwblink.importers.csv_dialect import CsvDialect, detect
from uwblink.importers.file_lines import check_file, check_lines, lines_of
from uwblink.importers.relations import csv_relation, json_relation, parquet_relation
from uwblink.importers.staging import Kept, Stage, confined

EXACT: Final = 2.0**53
"""Whole numbers above are not all floats."""


class Cell(NamedTuple):
    """What becomes of a column: SQL in which nothing is a stranger's, and what is bound to it."""

    sql: str
    bound: tuple[str, ...]


class Table:
    """One file, whose columns are read when asked for. Close it, or use it as a context manager."""

    def __init__(
        self,
        path: Path,
        delimiter: str | None = None,
        decimal: str | None = None,
        *,
        stage: Stage | None = None,
        number: int = 0,
    ) -> None:
        """Open a CSV file (plain or gzipped), a Parquet file or JSON lines, by its suffix; raises `ImportTableError`.

        `delimiter` and `decimal` override what a CSV file looks like. Its columns can be put aside on a `stage`, on
        which each table has a `number` of its own.
        """
        check_file(path)
        self.path = path
        self._stage = stage
        self._dialect: CsvDialect | None = None
        self._rejects = f"rejects{number}"
        self._rejected: Ints = np.empty(0, dtype=np.int64)
        ending = path.name.lower().removesuffix(".gz")
        if ending.endswith(".parquet"):
            self._db = stage.db if stage else confined([path])
            self._relation = parquet_relation(self._db, path)
        elif ending.endswith((".jsonl", ".ndjson", ".json")):
            check_lines(path)
            self._relation = json_relation(path)
            self._db = stage.db if stage else confined([path])
        else:
            self._dialect = detect(path, delimiter, decimal)
            check_lines(path, self._dialect.delimiter)
            self._relation = csv_relation(self._dialect, self._rejects)
            self._db = stage.db if stage else confined([path])
        self.names = self._relation.names

    def __enter__(self) -> Self:
        """Return the table itself."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Close the file."""
        if self._stage is None:
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
        found = self._read([*map(self.number, wanted), *map(self.word, texts)])
        columns = [np.ma.filled(column.astype(np.float64, copy=False), np.nan) for column in found[: len(wanted)]]
        text = [np.ma.filled(column, "").astype(np.str_) for column in found[len(wanted) :]]
        return dict(zip(wanted, columns, strict=True)), dict(zip(texts, text, strict=True))

    def numbers(self, names: Iterable[str]) -> dict[str, Floats]:
        """Return columns as float64 (n,), NaN where a cell is empty or no number."""
        return self.read(numbers=names)[0]

    def words_at(self, name: str, rows: Iterable[int]) -> dict[int, str]:
        """Return cells of a column as text, by their rows (0 is the first)."""
        cell = self.word(name)
        counted = f"SELECT {cell.sql} AS word, row_number() OVER () - 1 AS row FROM {self._relation.source}"  # noqa: S608 - columns by place
        query = f"SELECT row, word FROM ({counted}) WHERE row IN (SELECT unnest(?::BIGINT[]))"  # noqa: S608 - as above
        bound = [*cell.bound, str(self.path), sorted(set(rows))]
        with self._reading():
            return {int(row): str(word) for row, word in self._db.execute(query, bound).fetchall()}

    def keep(self, cells: Mapping[str, Cell]) -> Kept:
        """Put columns aside by names of the caller's, which become SQL; raises `ImportTableError`."""
        if self._stage is None:
            raise TypeError("a table without a stage puts nothing aside")
        chosen = ", ".join(f"{cell.sql} AS {name}" for name, cell in cells.items())
        bound = [key for cell in cells.values() for key in cell.bound]
        query = f"SELECT {chosen} FROM {self._relation.source}"  # noqa: S608 - columns by place, names of the caller's
        with self._reading():
            kept = self._stage.keep(query, [*bound, str(self.path)], cells)
            self._note_rejected()
        return kept

    def number(self, name: str) -> Cell:
        """Return what a column is as numbers, null where a cell is empty or no number."""
        place = self._place(name)
        if self._relation.numeric[place]:
            return self._cell(place, f"CAST({self._relation.cells[place]} AS DOUBLE)")
        # Not the bare column: a cast of that is done while the file is read, where a cell that is no number makes the
        # whole row vanish among those with too many cells.
        text = f"coalesce({self._text(place)}, '')"
        text = f"replace({text}, ',', '.')" if self._relation.decimal_comma else text
        return self._cell(place, f"TRY_CAST({text} AS DOUBLE)")

    def word(self, name: str) -> Cell:
        """Return what a column is as text without blanks around it."""
        place = self._place(name)
        return self._cell(place, f"coalesce(trim({self._text(place)}), '')")

    def whole_number(self, name: str) -> Cell:
        """Return what a column is as whole numbers, also those that a float does not hold; null where it is none."""
        return self._cell(self._place(name), f"TRY_CAST({self.word(name).sql} AS BIGINT)")

    def time_ns(self, name: str) -> Cell:
        """Return what a column of ISO 8601 times is as nanoseconds since 1970, UTC where no zone is named, or null."""
        place = self._place(name)
        if self._relation.numeric[place]:
            raise ImportTableError(f"{self.path}: column {name[:60]!r} holds numbers, not times as 2024-05-06T07:08:09")
        text = self.word(name).sql
        # A zone is a shift of whole minutes, which the finer type would drop.
        shift = f"TRY_CAST({text} AS TIMESTAMPTZ)"
        zone = f"regexp_matches({text}, '[T ].*[+-][0-9]{{2}}:?([0-9]{{2}})?$')"
        time = f"CASE WHEN {zone} THEN epoch_ns({shift}) ELSE epoch_ns(TRY_CAST({text} AS TIMESTAMP_NS)) END"
        return self._cell(place, time)

    def whole_numbers(self, name: str, missing: int) -> Ints:
        """Return a column of whole numbers exactly, also those that a float does not hold; others are `missing`."""
        (found,) = self._read([self.whole_number(name)])
        return np.ma.filled(found.astype(np.int64), missing)

    def lists(self, name: str) -> NDArray[np.object_]:
        """Return a column of lists such as `[1, 2]` as arrays of whole numbers, None where a cell is no such list."""
        place = self._place(name)
        (found,) = self._read([self._cell(place, f"TRY_CAST({self.word(name).sql} AS USMALLINT[])")])
        filled = np.empty(len(found), dtype=object)
        filled[:] = [None if value is np.ma.masked else value for value in found]
        return filled

    def lines(self, rows: Ints, *, rejected: bool = True) -> Ints:
        """Return where in the file some rows are: its lines, the first being 1; rows of Parquet from 1.

        Lines that were `rejected` are passed over, unless one looks for what was before anything was.
        """
        if self._dialect is None and self._relation.source.startswith("read_parquet"):
            return np.asarray(rows + 1, dtype=np.int64)
        skip = self._dialect.skip if self._dialect else 0
        return lines_of(self.path, skip, self._rejected if rejected else self._rejected[:0], rows)

    def rejected(self) -> Ints:
        """Return the lines that were left out of everything read so far: they have more cells than the header."""
        return self._rejected

    def _place(self, name: str) -> int:
        self.require([name])
        return self.names.index(name)

    def _text(self, place: int) -> str:
        return f"CAST({self._relation.cells[place]} AS VARCHAR)"

    def _cell(self, place: int, sql: str) -> Cell:
        key = self._relation.bound[place]
        return Cell(sql, () if key is None else (key,) * sql.count(self._relation.cells[place]))

    def _read(self, cells: list[Cell]) -> list[NDArray[Any]]:
        if not cells:
            return []
        chosen = ", ".join(f"{cell.sql} AS r{k}" for k, cell in enumerate(cells))
        keys = [key for cell in cells for key in cell.bound]
        query = f"SELECT {chosen} FROM {self._relation.source}"  # noqa: S608 - columns by place, r0, r1 ...
        with self._reading():
            found = self._db.execute(query, [*keys, str(self.path)]).fetchnumpy()
            self._note_rejected()
        return [found[f"r{k}"] for k in range(len(cells))]

    def _note_rejected(self) -> None:
        if self._dialect is not None:
            found = self._db.execute(f"SELECT DISTINCT line FROM {self._rejects} ORDER BY line").fetchnumpy()  # noqa: S608 - a name of ours
            self._rejected = np.ma.filled(found["line"].astype(np.int64), 0)

    @contextmanager
    def _reading(self) -> Iterator[None]:
        """Have what DuckDB says of a file, or of the disk, as an error of this project."""
        import duckdb

        try:
            yield
        except (duckdb.OutOfMemoryException, duckdb.IOException) as error:
            if self._stage is None or str(self.path) in str(error):
                raise ImportTableError(f"{self.path}: cannot be read as a table ({first_line(error)})") from error
            raise self._stage.unwritable(error) from error
        except duckdb.Error as error:
            raise ImportTableError(f"{self.path}: cannot be read as a table ({first_line(error)})") from error
