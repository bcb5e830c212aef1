"""Tables of strangers, read by DuckDB: columns by their names in, arrays out.

DuckDB may open the named file and nothing else, and no text of the file or of a map becomes SQL: the columns of a CSV
file get names of ours, and a cell of anything else is asked for by a value that is bound.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats
from uwblink.errors import ImportTableError
from uwblink.importers.csv_dialect import CsvDialect, detect

if TYPE_CHECKING:
    import duckdb

LONGEST_LINE: Final = 4_000_000
"""Bytes; an impulse response in one cell takes 6,000."""


@dataclass(frozen=True, slots=True)
class BadLine:
    """A row that has no place in the table, by its line in the file (the header is line 1)."""

    line: int
    reason: str


class CsvTable:
    """A CSV file, whose cells are read when asked for. Close it, or use it as a context manager."""

    def __init__(self, path: Path, dialect: CsvDialect | None = None) -> None:
        """Open a file; raises `ImportTableError`."""
        self.path = path
        self.dialect = dialect or detect(path)
        self.names = self.dialect.names
        self._db = _confined([path])

    def __enter__(self) -> CsvTable:
        """Return the table itself."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Close the file."""
        self._db.close()

    def require(self, names: Iterable[str]) -> None:
        """Raise `ImportTableError` for the first name that no column has, or that two have."""
        for name in names:
            if self.names.count(name) != 1:
                what = "is missing" if name not in self.names else "is there twice"
                raise ImportTableError(
                    f"{self.path}: column {name[:60]!r} {what}; there are {', '.join(self.names)[:400]}"
                )

    def numbers(self, names: Iterable[str]) -> dict[str, Floats]:
        """Return columns as float64 (n,), NaN where a cell is empty or no number."""
        wanted = list(names)
        number = "replace({0}, ',', '.')" if self.dialect.decimal_comma else "{0}"
        cells = [f"TRY_CAST({number} AS DOUBLE)" for _ in wanted]
        found = self._read(wanted, cells)
        return {name: np.ma.filled(column.astype(np.float64), np.nan) for name, column in found.items()}

    def words(self, names: Iterable[str]) -> dict[str, NDArray[np.str_]]:
        """Return columns as text (n,), empty where there is none."""
        wanted = list(names)
        found = self._read(wanted, ["coalesce(trim({0}), '')"] * len(wanted))
        return {name: np.asarray(column, dtype=np.str_) for name, column in found.items()}

    def lists(self, name: str) -> NDArray[np.object_]:
        """Return a column of lists such as `[1, 2]` as arrays of whole numbers, None where a cell is no such list."""
        found = self._read([name], ["TRY_CAST({0} AS USMALLINT[])"])[name]
        filled = np.empty(len(found), dtype=object)
        filled[:] = [None if value is np.ma.masked else value for value in found]
        return filled

    def _read(self, names: list[str], cells: list[str]) -> dict[str, NDArray[Any]]:
        import duckdb

        self.require(names)
        chosen = [
            f"{cell.format(f'c{self.names.index(name)}')} AS r{k}"
            for k, (name, cell) in enumerate(zip(names, cells, strict=True))
        ]
        query = f"SELECT {', '.join(chosen)} FROM {self._reader()}"  # noqa: S608 - c0, c1 ... and r0, r1 ...
        try:
            found = self._db.execute(query, [str(self.path)]).fetchnumpy()
        except duckdb.Error as error:
            raise ImportTableError(f"{self.path}: cannot be read as a table ({first_line(error)})") from error
        return {name: found[f"r{k}"] for k, name in enumerate(names)}

    def _reader(self) -> str:
        columns = ", ".join(f"'c{k}': 'VARCHAR'" for k in range(len(self.names)))
        delimiter = "\\t" if self.dialect.delimiter == "\t" else self.dialect.delimiter
        return (
            f"read_csv(?, auto_detect=false, header=false, skip={self.dialect.skip}, delim='{delimiter}', quote='\"', "
            f"escape='\"', columns={{{columns}}}, null_padding=true, max_line_size={LONGEST_LINE})"
        )


def first_line(error: Exception) -> str:
    """Return the first line of an error's text."""
    return (str(error).splitlines() or [""])[0][:200]


def _confined(paths: Iterable[Path]) -> duckdb.DuckDBPyConnection:
    """Return a connection that can open these files and no other, and whose settings are locked."""
    import duckdb

    db = duckdb.connect(":memory:")
    db.execute("SET allowed_paths = ?", [[str(path) for path in paths]])
    db.execute("SET enable_external_access = false")
    db.execute("SET lock_configuration = true")
    return db
