"""Tables in CSV, Parquet or JSON lines, read by DuckDB: SQL expressions of their columns, and columns as arrays.

DuckDB can open only the named files, and text of a file or a map is never part of SQL: columns are named by their
number, and paths and JSON keys are variables of the connection. Dialect, limits of lines and line numbers of CSV files
are found here, because DuckDB reports none of them reliably.

Files of every form are converted to one long table: lines of a log by a template, elements of a list (`each`), and
columns that differ by a device (`wide`) become rows, and values in the name of a file become columns.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import json
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any, Final, NamedTuple

import duckdb
import numpy as np

from uwblink.arrays import Columns, Floats, Ints
from uwblink.database import connect
from uwblink.errors import ImportTableError, first_line, raising
from uwblink.importers.column_map import JSON_LINE, ColumnMap
from uwblink.importers.templates import Template
from uwblink.output import check_utf8
from uwblink.text_files import require_regular
from uwblink.twr import LATEST_NS

MAX_LINE_BYTES: Final = 4_000_000
"""Maximum length of a line; an impulse response in one cell takes 6,000."""

MAX_CELLS: Final = 4096
"""Cells of a row; an impulse response in cells of its own takes 2,032."""


@contextmanager
def opened(path: Path) -> Iterator[io.BufferedReader]:
    """Open a text file, plain or gzipped; raises `ImportTableError` for UTF-16, and if it cannot be read as text."""
    with (
        raising(ImportTableError, f"{path}: not a CSV table", csv.Error),
        raising(ImportTableError, f"{path}: cannot be read", OSError),
        raising(ImportTableError, f"{path}: broken or truncated gzip", gzip.BadGzipFile, EOFError, zlib.error),
        raising(ImportTableError, f"{path}: not a text file in UTF-8", UnicodeDecodeError, remedy="; save it in UTF-8"),
        gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file,
    ):
        if file.peek(2).startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            raise ImportTableError(f"{path}: is text in UTF-16; save it in UTF-8")
        yield file  # type: ignore[misc]  # both read alike


def check_text(path: Path, raw: bytes) -> None:
    """Raise `ImportTableError` if the first bytes of a table are not text, but binary."""
    if b"\0" in raw:
        raise ImportTableError(f"{path}: not a text file (it contains zero bytes); expected a table in UTF-8")


class TableForm(NamedTuple):
    """The form of a CSV file: names of columns, delimiter, decimal mark, encoding, and lines before the first values.

    Text that is not UTF-8 is taken as Latin-1, which older programs write.
    """

    names: tuple[str, ...]
    delimiter: str
    decimal_comma: bool
    skip: int
    encoding: str


def _decoded(raw: bytes) -> tuple[str, str]:
    """Return the text of the first bytes of a file, and its encoding as DuckDB calls it; raises `UnicodeDecodeError`
    for bytes that are control characters in Latin-1.
    """
    try:
        # A letter of several bytes may be cut at the end, which this decoder waits for.
        return codecs.getincrementaldecoder("utf-8-sig")().decode(raw), "utf-8"
    except UnicodeDecodeError:
        if re.search(rb"[\x80-\x9f]", raw):
            raise
        return raw.decode("latin-1"), "latin-1"


def detect(path: Path, column_map: ColumnMap) -> TableForm:
    """Return the dialect of a CSV file by its first 64 KiB, for parts that the map does not state.

    Without a header the names are "1", "2" and so on. Lines before the header that are empty or begin with "#" are
    skipped. Raises `ImportTableError` for a file that is not text with a header.
    """
    delimiter, decimal = column_map.delimiter, column_map.decimal
    with opened(path) as file:
        raw = file.read(65_536)
        check_text(path, raw)
        text, encoding = _decoded(raw)
        lines = text.splitlines()
        first = next((k for k, line in enumerate(lines) if line.strip() and not line.startswith("#")), len(lines))
        mark = delimiter or _delimiter(lines[first:])
        reader = csv.reader((f"{line}\n" for line in lines[first:]), delimiter=mark)
        names = tuple(name.strip() for name in next(reader, []))
        skip = first + reader.line_num  # a quoted name may hold a line break
        cells = [cell.strip() for row in islice(reader, 200) for cell in row]
    if not any(names):
        raise ImportTableError(f"{path}: empty, expected a header and rows")
    if column_map.headerless:
        names, skip = tuple(str(k) for k in range(1, len(names) + 1)), first
    if decimal is None and mark != ",":
        commas, points = (
            sum(bool(re.fullmatch(rf"[+-]?\d{digits}{mark}\d+([eE][+-]?\d+)?", cell)) for cell in cells)
            for digits, mark in (("+", ","), ("*", r"\."))
        )
        decimal = "," if commas > points else "."
    return TableForm(names, mark, decimal == "," and mark != ",", skip, encoding)


def lacks_header(names: Sequence[str]) -> bool:
    """Return whether the first line of a table is a row of numbers, except 0, 1, 2 ..., which are names written by a
    program.
    """
    numbers = [name for name in names if re.fullmatch(r"[-+]?[0-9]+([.,][0-9]*)?([eE][-+]?[0-9]+)?", name)]
    if [name for name in names if name] == [str(k) for k in range(len(numbers))]:
        return False
    return len(numbers) == len(names) or (2 * len(numbers) >= len(names) and any("." in one for one in numbers))


def _delimiter(lines: list[str]) -> str:
    """Return the delimiter that splits header and rows into equal numbers of cells, and into the most."""

    def quality(mark: str) -> tuple[bool, int, int]:
        counts = [len(row) for row in csv.reader(lines[:50], delimiter=mark) if row] or [0]
        return counts[0] > 1, sum(n == counts[0] for n in counts) if counts[0] > 1 else 0, counts[0]

    return max((",", ";", "\t", "|", " "), key=quality)


def check_lines(path: Path, delimiter: str) -> None:
    """Read a text file to its end; raises `ImportTableError` for a line that is too long or has too many cells.

    DuckDB would store the whole line for each extra cell, and would never finish a broken compressed file.
    """
    line, length, cells = 1, 0, 0
    with opened(path) as file:
        while piece := file.read(8192):
            ends = piece.count(b"\n")
            line += ends
            # Only lines that fill whole pieces are measured, which saves time for short ones.
            length, cells = (0, 0) if ends else (length + len(piece), cells + piece.count(delimiter.encode()))
            if length > MAX_LINE_BYTES or cells > MAX_CELLS:
                most = f"{MAX_CELLS} cells" if cells > MAX_CELLS else f"{MAX_LINE_BYTES} bytes"
                raise ImportTableError(f"{path}: row {line}: more than {most}; check the line ends of the table")


@contextmanager
def connected(paths: Sequence[Path]) -> Iterator[duckdb.DuckDBPyConnection]:
    """Yield a temporary database that can open only these files; raises `ImportTableError` if the disk is full.

    It keeps 350 MB in memory and the rest in a temporary folder (`TMPDIR`).
    """
    for path in paths:
        check_utf8(path, ImportTableError)
    full = raising(
        ImportTableError,
        f"{gettempdir()}: temporary data cannot be written there",
        duckdb.OutOfMemoryException,
        duckdb.IOException,
        remedy="; choose another folder with TMPDIR",
    )
    with (
        TemporaryDirectory(prefix="uwblink-") as folder,
        connect(paths=paths, temporary=folder, memory_mb=350) as db,
        full,
    ):
        yield db


def number(text: str) -> str:
    """Return SQL of a text as finite DOUBLE, NULL if it is no number."""
    value = f"TRY_CAST({text} AS DOUBLE)"
    return f"CASE WHEN isfinite({value}) THEN {value} END"


def whole_number(text: str) -> str:
    """Return SQL of a text as BIGINT, exact also beyond the whole numbers of a DOUBLE; NULL if it is none."""
    value = f"TRY_CAST({text} AS DOUBLE)"
    return f"CASE WHEN {value} = trunc({value}) THEN TRY_CAST({text} AS BIGINT) END"


REPORT: Final = "report|range_?report"
"""Word for a third message of the target; a final is a message of the initiator."""


def is_by_target(text: str) -> str:
    """Return SQL that is true for the word of a message of the target."""
    return f"regexp_full_match(lower(trim({text})), 'resp.*|ack.*|answer|{REPORT}')"


def message_number(text: str) -> str:
    """Return SQL of a message as its number, from a number or a word such as "POLL"; NULL if it is neither."""
    kinds = {1: "poll|init.*|request|blink", 2: "resp.*|ack.*|answer", 3: f"final|{REPORT}"}
    cases = " ".join(f"WHEN regexp_full_match(lower(trim({text})), '{kind}') THEN {n}" for n, kind in kinds.items())
    return f"coalesce({number(text)}, CASE {cases} END)"


def time_ns(text: str, unit: str | None, ns_per_unit: float) -> str:
    """Return SQL of a time as nanoseconds, NULL if it is none: a number in units, or ISO 8601, UTC without a zone.

    Without a unit both are read, with "iso" only the latter; a time of day is counted from midnight.
    """
    scaled = f"TRY_CAST({number(text)} * {ns_per_unit!r} AS BIGINT)"
    scaled = f"coalesce({whole_number(text)}, {scaled})" if unit == "ns" else scaled
    # TIMESTAMP_NS ignores time zones; TIMESTAMPTZ has microseconds, and zones are whole minutes.
    zone = f"regexp_matches({text}, '[T ].*[+-][0-9]{{2}}:?([0-9]{{2}})? *$')"
    iso = (
        f"CASE WHEN {zone} THEN epoch_ns(TRY_CAST({text} AS TIMESTAMPTZ)) "
        f"ELSE coalesce(epoch_ns(TRY_CAST({text} AS TIMESTAMP_NS)), epoch_ns(TRY_CAST({text} AS TIME))) END"
    )
    found = {None: f"coalesce({scaled}, {iso})", "iso": iso}.get(unit, scaled)
    return f"CASE WHEN {found} BETWEEN -{LATEST_NS} AND {LATEST_NS} THEN {found} END"


class SourceTable:
    """One file: `names` are its columns, `source` is what a query reads FROM, `text` returns SQL of a column."""

    def __init__(
        self,
        db: duckdb.DuckDBPyConnection,
        path: Path,
        column_map: ColumnMap | None = None,
        key: int = 0,
        *,
        live: bool = False,
    ) -> None:
        """Open a CSV file (plain or gzipped), a Parquet file or JSON lines, by its suffix, or a log by its template.

        A `live` log has the lines in the variable `lines` of the connection, instead of a file. Raises
        `ImportTableError`. Tables of one connection have different keys.
        """
        self.live = live
        if not live:
            require_regular(path, ImportTableError, "table (.csv, .csv.gz, .parquet or .jsonl)")
        self.db, self.path, self._key = db, path, key
        self.column_map = column_map = column_map or ColumnMap()
        self._skip, self._decimal_comma, self._expanded = 0, False, False
        self.named: frozenset[str] = frozenset()
        """Columns with values in the name of the file."""
        self.lists: tuple[str, ...] = ()
        """Fields of JSON lines that are lists of objects."""
        self.blank = ""
        """SQL that is true for rows without any range, such as an empty cell of a wide table; "" for none."""
        self._file = self.variable("file", str(path))
        ending = path.name.lower().removesuffix(".gz")
        self._is_parquet = ending.endswith(".parquet")
        self._is_csv = not ending.endswith((".parquet", ".jsonl", ".ndjson", ".json")) and not column_map.line
        open_log = self._open_log if column_map.line not in (None, JSON_LINE) else None
        open_table = self._open_csv if self._is_csv else self._open_parquet if self._is_parquet else self._open_json
        (open_log or open_table)()
        self._unpivot()
        self._add_names()
        if len(self.names) > MAX_CELLS:
            raise ImportTableError(f"{path}: has {len(self.names)} columns, expected {MAX_CELLS} at most")

    def variable(self, name: str, value: Any) -> str:
        """Return SQL of a value that comes from a file or a map, as a variable of the connection."""
        self.db.execute(f"SET VARIABLE {name}{self._key} = ?", [value])
        return f"getvariable('{name}{self._key}')"

    def _open_csv(self) -> None:
        if self.column_map.each:
            raise ImportTableError(
                f"{self.path}: the key each is for JSON lines, bags and logs (with line), not for tables"
            )
        self.names, mark, self._decimal_comma, self._skip, encoding = detect(self.path, self.column_map)
        check_lines(self.path, mark)
        self._cells = [f"c{k}" for k in range(len(self.names))]
        columns = ", ".join(f"'{cell}': 'VARCHAR'" for cell in self._cells)
        mark = "\\t" if mark == "\t" else mark
        self.source = (
            f"read_csv({self._file}, auto_detect=false, header=false, skip={self._skip}, "
            f"delim='{mark}', quote='\"', escape='\"', columns={{{columns}}}, null_padding=true, store_rejects=true, "
            f"rejects_limit=0, rejects_table='rejects{self._key}', rejects_scan='scans{self._key}', "
            f"encoding='{encoding}', max_line_size={MAX_LINE_BYTES})"
        )

    def _open_log(self) -> None:
        """Use the lines that match a template, and each match of a second one (`each`) in them as a row."""
        line = Template(self.column_map.line or "")
        self._decimal_comma = self.column_map.decimal == ","
        pattern, cells = self.variable("line", line.pattern), line.columns("s")
        matching = f"FROM {self._source_of_lines()} WHERE regexp_matches(line, {pattern})"
        self.source = f"(SELECT row_number() OVER () AS row, line, {line.extract('line', pattern)} AS s {matching})"
        if self.column_map.each:
            each = Template(self.column_map.each)
            pattern, cells = self.variable("each", each.pattern), cells | each.columns("e")
            elements = f"SELECT *, unnest(regexp_extract_all(line, {pattern})) AS element FROM {self.source}"
            self.source = f"(SELECT *, {each.extract('element', pattern)} AS e FROM ({elements}))"
        self.names, self._cells, self._expanded = tuple(cells), list(cells.values()), True

    def _source_of_lines(self) -> str:
        """Return SQL of the lines of a log; noise of a serial port is read as letters."""
        if self.live:
            return "(SELECT unnest(getvariable('lines')) AS line)"
        check_lines(self.path, "\n")
        return (
            f"read_csv({self._file}, auto_detect=false, header=false, delim='\x01', quote='', "
            f"escape='', columns={{'line': 'VARCHAR'}}, strict_mode=false, encoding='latin-1', "
            f"max_line_size={MAX_LINE_BYTES})"
        )

    def _open_json(self) -> None:
        """Use the fields of the first lines as columns; nested fields have names such as `pose.x`.

        Elements of a list are fields, too, or rows if the map names the list (`each`).
        """
        check_lines(self.path, "\n")
        fields, each, lists = dict[str, str](), self.column_map.each, dict[str, None]()
        with opened(self.path) as file:
            lines = [
                line.decode("utf-8-sig", "replace" if self.column_map.line else "strict") for line in islice(file, 1000)
            ]
        for row in filter(None, map(object_in, lines)):
            found = {name: value for name, value in row.items() if isinstance(value, list) and is_objects(value)}
            lists |= dict.fromkeys(found)
            for one in [row | {each: one} for one in found.get(each, ())] if each else [row]:
                fields |= dict(_fields(one, "", ""))
        self.lists = tuple(lists)
        if not fields:
            wanted = f"a list {each[:60]!r} of objects (each)" if each else "JSON objects"
            raise ImportTableError(f"{self.path}: holds no {wanted}, one a line")
        self.names = tuple(fields)
        listed = self.variable("fields", list(fields.values()))
        self._cells = [f"json_extract_string(json, {listed}[{k}])" for k in range(1, len(fields) + 1)]
        self.source = f"read_ndjson_objects({self._file}, ignore_errors=true)"
        if self.column_map.line:
            ends = f"SELECT TRY_CAST(regexp_extract(line, '[{{].*') AS JSON) AS json FROM {self._source_of_lines()}"
            self.source = f"(SELECT json FROM ({ends}) WHERE json_type(json) = 'OBJECT')"
        if each:
            # An element replaces its list.
            name = self.variable("each", each)
            escaped = f"replace(replace({name}, '~', '~0'), '/', '~1')"
            elements = f"unnest(CAST(json_extract(json, '/' || {escaped}) AS JSON[])) AS element"
            self.source = f"(SELECT row_number() OVER () AS row, json, {elements} FROM {self.source})"
            merged = f"json_merge_patch(json, json_object({name}, element)) AS json"
            self.source, self._expanded = f"(SELECT row, {merged} FROM {self.source})", True

    def _open_parquet(self) -> None:
        read = f"read_parquet({self._file})"
        with self.reading():
            rows = self.db.execute(f"DESCRIBE SELECT * FROM {read}").fetchall()
        self.names = tuple(str(row[0]) for row in rows)
        self._cells = [f"c{k}" for k in range(len(rows))]
        self.source = f"{read} AS t({', '.join(self._cells)})"

    def _unpivot(self) -> None:
        """Make a row of each column of a family (`wide`), such as `r_AN0` to `r_AN4`; empty ones are blank rows."""
        families = {ours: self._family(ours, stated) for ours, stated in self.column_map.wide.items()}
        if not families:
            return
        labels = list(dict.fromkeys(label for family in families.values() for label in family))
        lists = {
            ours: [self.text(family[n]) if n in family else "''" for n in labels] for ours, family in families.items()
        }
        ends = dict.fromkeys(re.findall(r"\{(from_id|to_id)\}", str(self.column_map.wide)) or ["to_id"])
        for end, own in zip(ends, zip(*labels, strict=False), strict=False):
            if end not in lists:
                listed = self.variable(f"{end}s", own)
                lists[end] = [f"{listed}[{n}]" for n in range(1, len(labels) + 1)]
        cells = {ours: f"[{', '.join(cells)}][k]" for ours, cells in lists.items()}
        numbered = "" if self._expanded else ", row_number() OVER () AS row"
        self.source = f"(SELECT *{numbered}, unnest(range(1, {len(labels) + 1})) AS k FROM {self.source})"
        value = "range_m" if "range_m" in families else next(iter(families))
        self.blank = f"trim({cells[value]}) = ''"
        if "mask" in self.names:  # a mask of bits: the devices that answered
            self.blank += f" OR TRY_CAST({self.text('mask')} AS BIGINT) & (1 << (k - 1)) = 0"
        self.names, self._cells, self._expanded = (*self.names, *cells), [*self._cells, *cells.values()], True

    def _family(self, ours: str, stated: str | dict[str, str]) -> dict[tuple[str, ...], str]:
        """Return the columns of a family by the different part of their names."""
        if isinstance(stated, dict):
            return {(label,): name for label, name in stated.items()}
        pattern = "(.+)".join(map(re.escape, re.split(r"\{\w+\}", stated)))
        found = {match.groups(): name for name in self.names if (match := re.fullmatch(pattern, name))}
        if not found:
            there = ", ".join(self.names)[:400]
            raise ImportTableError(f"{self.path}: wide.{ours}: no column {stated[:60]!r}; there are {there}")
        return found

    def _add_names(self) -> None:
        """Add values in the name of the file (`from_name`) as columns."""
        if self.column_map.from_name is None:
            return
        values = Template(self.column_map.from_name).match(self.path.as_posix())
        if values is None:
            raise ImportTableError(f"{self.path}: its name does not match {self.column_map.from_name!r} of the map")
        self.named = frozenset(values)
        self.names = (*self.names, *values)
        self._cells += [self.variable(f"name{k}_", value) for k, value in enumerate(values.values())]

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Convert DuckDB's errors about the file into `ImportTableError`; errors of the disk are passed on."""
        try:
            yield
        except duckdb.Error as error:
            of_disk = isinstance(error, duckdb.OutOfMemoryException | duckdb.IOException)
            if of_disk and str(self.path) not in str(error):
                raise
            raise ImportTableError(f"{self.path}: cannot be read as a table ({first_line(error)})") from error

    def text(self, name: str, *, numeric: bool = False) -> str:
        """Return SQL of a column's cells as text, with decimal points if `numeric`; raises `ImportTableError`."""
        if self.names.count(name) > 1:
            raise ImportTableError(f"{self.path}: row 1: two columns are called {name[:60]!r}")
        if name not in self.names:
            raise self.missing(name)
        # DuckDB would cast a bare column while it reads the file, and would reject the whole row for a cell that is not
        # a number.
        text = f"coalesce(CAST({self._cells[self.names.index(name)]} AS VARCHAR), '')"
        return f"replace({text}, ',', '.')" if numeric and self._decimal_comma else text

    def missing(self, header: str) -> ImportTableError:
        """Return the error for a missing column."""
        remedy = "a `map_file` can rename columns or give constants, and `uwblink import guess` proposes one"
        if lacks_header(self.names):
            remedy = "its first line is a row of values: give the numbers of its columns in a map, such as from_id = 2"
        if {"qx", "qy", "qz", "qw"} <= {name.lower() for name in self.names}:
            remedy = "these are poses, which `uwblink poses` adds to a recording"
        there = ", ".join(self.names)[:400]
        return ImportTableError(f"{self.path}: column {header[:60]!r} is missing; there are {there}; {remedy}")

    def read(self, cells: Mapping[str, str], more: str = "") -> Columns:
        """Return SQL expressions as arrays (n,) by name, masked where values are missing.

        `more` follows the source in the query.
        """
        chosen = ", ".join(f"{cell} AS v{k}" for k, cell in enumerate(cells.values()))
        with self.reading():
            found = self.db.execute(f"SELECT {chosen} FROM {self.source} {more}").fetchnumpy() if cells else {}
        return dict(zip(cells, found.values(), strict=True))

    def numbers(self, names: Iterable[str], limit: int | None = None) -> dict[str, Floats]:
        """Return columns, or their first rows, as float64 (n,), NaN where a cell is empty or no number."""
        cells = {name: number(self.text(name, numeric=True)) for name in names}
        found = self.read(cells, f"LIMIT {limit}" if limit else "")
        return {name: np.ma.filled(column.astype(np.float64), np.nan) for name, column in found.items()}

    def words_at(self, names: Sequence[str], rows: Sequence[int]) -> dict[int, dict[str, str]]:
        """Return the text of some columns in some rows, by the row (0 is the first) and the column's name."""
        cells = ", ".join(f"trim({self.text(name)}) AS w{k}" for k, name in enumerate(names))
        counted = f"SELECT row_number() OVER () - 1 AS row, {cells} FROM {self.source}"
        query = f"SELECT * FROM ({counted}) WHERE row IN (SELECT unnest(?::BIGINT[]))"
        with self.reading():
            found = self.db.execute(query, [list(rows)]).fetchall() if names else []
        return {row: dict(zip(names, texts, strict=True)) for row, *texts in found}

    def rejected(self) -> list[int]:
        """Return the line numbers of rows with too many cells, which are skipped, in ascending order."""
        query = f"SELECT DISTINCT line FROM rejects{self._key} ORDER BY line"
        return [int(line) for (line,) in self.db.execute(query).fetchall()] if self._is_csv else []

    def line(self, row: int) -> int:
        """Return the line of a row (0 is the first), counted from 1, or the number of the row of a Parquet file."""
        row = int(self._origins[row]) if self._expanded else row
        return row + 1 if self._is_parquet else int(self._lines[row])

    @cached_property
    def _origins(self) -> Ints:
        """The row of the file, from 0, of each row."""
        found = self.db.execute(f"SELECT row - 1 AS row FROM {self.source}").fetchnumpy()
        return np.asarray(np.ma.getdata(found["row"]), np.int64)

    @cached_property
    def _lines(self) -> Ints:
        """The line of each row; DuckDB skips empty lines, and refuses line breaks in quotes."""
        rejected, blank = set(self.rejected()), "\r\n" if self._is_csv else None
        line = self.column_map.line
        counts = re.compile(Template(line).pattern).search if line else lambda text: text.strip(blank)
        counts = object_in if line == JSON_LINE else counts
        with opened(self.path) as raw, io.TextIOWrapper(raw, "latin-1" if line else "utf-8-sig", "replace") as file:
            lines = enumerate(file, start=1)
            filled = (n for n, text in lines if n > self._skip and counts(text) and n not in rejected)
            return np.fromiter(filled, np.int64)


def object_in(line: str) -> dict[str, Any]:
    """Return the object of JSON at the end of a line, an empty one where there is none."""
    with suppress(ValueError, RecursionError):
        found = json.loads(line[max(line.find("{"), 0) :])
        return found if isinstance(found, dict) else {}
    return {}


def is_objects(values: list[Any]) -> bool:
    """Return whether a list has objects of JSON."""
    return any(isinstance(one, dict) for one in values)


def _fields(row: dict[str, Any], name: str, pointer: str) -> Iterator[tuple[str, str]]:
    """Yield names of fields such as `pose.x` or `ranges.0`, and their JSON pointers."""
    for key, value in row.items():
        where = f"{pointer}/{key.replace('~', '~0').replace('/', '~1')}"
        # A list of objects is a column of JSON; long lists are images or similar data.
        of_numbers = isinstance(value, list) and len(value) <= 16 and not is_objects(value)
        inner = {str(k): one for k, one in enumerate(value)} if of_numbers else value
        if isinstance(inner, dict) and pointer.count("/") < 5:
            yield from _fields(inner, f"{name}{key}.", where)
        else:
            yield f"{name}{key}", where
