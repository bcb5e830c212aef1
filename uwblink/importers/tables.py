"""Tables in CSV, Parquet or JSON lines, read by DuckDB: SQL expressions of their columns, and columns as arrays.

DuckDB can open the named files only, and text of a file or a map never becomes SQL: columns are named by their number,
and paths and JSON keys are variables of the connection. Dialect, limits of lines and line numbers of CSV files are
found here, because DuckDB reports none of them reliably.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import IO, Any, Final

import duckdb
import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.closing import Closing
from uwblink.database import connect
from uwblink.errors import ImportTableError, first_line
from uwblink.output import is_utf8
from uwblink.text_files import require_regular

PIECE_BYTES: Final = 1 << 20
"""Size of the blocks in which line numbers are counted."""

MAX_LINE_BYTES: Final = 4_000_000
"""An impulse response in one cell takes 6,000."""

MAX_CELLS: Final = 4096
"""Cells of a row; an impulse response in cells of its own takes 2,032."""


def open_file(path: Path) -> IO[bytes]:
    """Open a file, plain or gzipped."""
    return gzip.open(path) if path.suffix == ".gz" else path.open("rb")  # type: ignore[return-value]  # it reads alike


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Convert errors of reading a text file into `ImportTableError`."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise ImportTableError(f"{path}: not a text file in UTF-8") from error
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ImportTableError(f"{path}: broken or truncated gzip ({error})") from error
    except OSError as error:
        raise ImportTableError(f"{path}: cannot be read ({error.strerror})") from error
    except csv.Error as error:
        raise ImportTableError(f"{path}: not a CSV table ({first_line(error)})") from error


def detect(path: Path, delimiter: str | None, decimal: str | None) -> tuple[tuple[str, ...], str, bool, int]:
    """Return the dialect of a CSV file by its first 64 KiB; `delimiter` and `decimal` override what is found.

    It consists of the names of the columns, the delimiter, whether the decimal mark is a comma, and the number of lines
    before the first row of values. Lines before the header that are empty or begin with "#" are skipped. Raises
    `ImportTableError` for a file that is not text with a header.
    """
    require_regular(path, ImportTableError, "table (.csv or .csv.gz)")
    with reading(path), open_file(path) as file:
        raw = file.read(65_536)
        # A letter of several bytes may be cut in two at the end of what was read.
        lines = raw.decode("utf-8-sig", errors="strict" if len(raw) < 65_536 else "ignore").splitlines()
        first = next((k for k, line in enumerate(lines) if line.strip() and not line.startswith("#")), len(lines))
        mark = delimiter or _delimiter(lines[first:])
        reader = csv.reader((f"{line}\n" for line in lines[first:]), delimiter=mark)
        names = tuple(name.strip() for name in next(reader, []))
        skip = first + reader.line_num  # a quoted name may hold a line break
        cells = [cell.strip() for row, _ in zip(reader, range(200), strict=False) for cell in row]
    if not any(names):
        raise ImportTableError(f"{path}: empty, expected a header and rows")
    if decimal is None:
        commas, points = (
            sum(bool(re.fullmatch(rf"[+-]?\d{digits}{mark}\d+([eE][+-]?\d+)?", cell)) for cell in cells)
            for digits, mark in (("+", ","), ("*", r"\."))
        )
        decimal = "," if commas > points else "."
    return names, mark, decimal == "," and mark != ",", skip


def _delimiter(lines: list[str]) -> str:
    """Return the delimiter that splits header and rows into equal numbers of cells, and into the most."""

    def quality(mark: str) -> tuple[bool, int, int]:
        counts = [len(row) for row in csv.reader(lines[:50], delimiter=mark) if row] or [0]
        return counts[0] > 1, sum(n == counts[0] for n in counts) if counts[0] > 1 else 0, counts[0]

    return max((",", ";", "\t", "|", " "), key=quality)


def check_lines(path: Path, delimiter: str | None = None) -> None:
    """Read a text file to its end; raises `ImportTableError` for a line that is too long or has too many cells.

    Without a `delimiter` only the length is checked. DuckDB would store the whole line for each extra cell, and would
    never finish a broken compressed file.
    """
    mark, block = (delimiter or "").encode(), 4096
    length = cells = 0
    with reading(path), open_file(path) as file:
        while piece := file.read(16 * block):
            for start in range(0, len(piece), block):
                # Only lines that fill whole blocks are measured, which takes a hundredth of the time.
                if piece.find(b"\n", start, start + block) >= 0:
                    length = cells = 0
                    continue
                length += block
                cells += piece.count(mark, start, start + block) if mark else 0
                if length > MAX_LINE_BYTES or cells > MAX_CELLS:
                    most = f"{MAX_CELLS} cells" if cells > MAX_CELLS else f"{MAX_LINE_BYTES} bytes"
                    end = file.tell() - len(piece) + start
                    file.seek(0)
                    line = 1 + sum(file.read(min(block, end - at)).count(b"\n") for at in range(0, end, block))
                    raise ImportTableError(f"{path}: row {line}: more than {most}; are lines ended as in a table?")


def lines_of(path: Path, skip: int, rejected: Ints, rows: Ints) -> Ints:
    """Return the lines (n,) of rows (n,), past empty lines and line breaks in quotes; the first line is 1.

    Row 0 is the first after `skip` lines that is none of the lines `rejected`, which ascend.
    """
    wanted = np.unique(rows)
    lines = wanted + 1 + skip
    row, found = 0, 0
    with open_file(path) as file:
        for begins in _first_lines_of_rows(file, skip):
            if row == len(wanted):
                break
            out = np.searchsorted(rejected, [begins[0], begins[-1] + 1]) if len(begins) else (0, 0)
            kept = np.setdiff1d(begins, rejected[out[0] : out[1]], assume_unique=True)
            until = int(np.searchsorted(wanted, found + len(kept)))
            lines[row:until] = kept[wanted[row:until] - found]
            row, found = until, found + len(kept)
    return np.asarray(lines[np.searchsorted(wanted, rows)], dtype=np.int64)


def _first_lines_of_rows(file: IO[bytes], skip: int) -> Iterator[Ints]:
    """Yield the line numbers at which rows begin, in ascending order, block by block."""
    before, quoted = 0, False
    while piece := file.read(PIECE_BYTES):
        piece += file.readline()
        if before >= skip and not quoted and _is_plain(piece):
            count = piece.count(b"\n") + (not piece.endswith(b"\n"))
            yield np.arange(before + 1, before + count + 1)
        else:
            count, found = 0, []
            # Only the first piece can begin with a mark of the order of bytes, which is no text.
            text = piece.decode("utf-8" if before else "utf-8-sig", errors="replace")
            for count, line in enumerate(io.StringIO(text, newline=None), start=1):
                if not quoted and line.strip() and before + count > skip:
                    found.append(before + count)
                quoted ^= bool(line.count('"') % 2)
            yield np.array(found, dtype=np.int64)
        before += count


def _is_plain(piece: bytes) -> bool:
    """Return whether each line of a block is a row: no quotes, and each begins with a printable ASCII character."""
    if b'"' in piece or piece.count(b"\r") != piece.count(b"\r\n"):
        return False
    letters = np.frombuffer(piece, dtype=np.uint8)
    first = letters[np.concatenate([[0], np.flatnonzero(letters[:-1] == ord("\n")) + 1])]
    return bool(np.all((first > ord(" ")) & (first < 127)))


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
            with suppress(ValueError, RecursionError):
                row = json.loads(line)
                fields |= dict(_fields(row, "", "")) if isinstance(row, dict) else {}
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
