"""How a CSV file is written: what separates its cells, the decimal mark, and what its header says."""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from uwblink.errors import ImportTableError
from uwblink.text_files import require_regular

HEAD_BYTES: Final = 65_536
DELIMITERS: Final = (",", ";", "\t", "|", " ")
_DECIMAL_COMMA: Final = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_DECIMAL_POINT: Final = re.compile(r"[+-]?\d*\.\d+([eE][+-]?\d+)?")


@dataclass(frozen=True, slots=True)
class CsvDialect:
    """How to take a CSV file apart; `skip` lines come before the first row of values."""

    names: tuple[str, ...]
    delimiter: str
    decimal_comma: bool
    skip: int


def detect(path: Path, delimiter: str | None = None, decimal: str | None = None) -> CsvDialect:
    """Look at the beginning of a file, plain or gzipped; `delimiter` and `decimal` override what is seen.

    Lines before the header that are empty or begin with "#" are left out. Raises `ImportTableError` for what is no text
    with a header.
    """
    text = _head(path)
    lines = text.splitlines()
    first = next((k for k, line in enumerate(lines) if line.strip() and not line.startswith("#")), None)
    if first is None:
        raise ImportTableError(f"{path}: empty, expected a header and rows")
    rest = lines[first:]
    mark = delimiter or _delimiter(rest)
    reader = csv.reader(io.StringIO("\n".join(rest) + "\n"), delimiter=mark)
    try:
        rows = [row for row, _ in zip(reader, range(200), strict=False)]
    except csv.Error as error:
        raise ImportTableError(f"{path}: not a CSV table ({error})") from error
    names = tuple(name.strip() for name in rows[0])
    if not any(names):
        raise ImportTableError(f"{path}: empty, expected a header and rows")
    comma = _has_decimal_comma(rows[1:]) if decimal is None else decimal == ","
    skip = first + next(csv_line for csv_line in _header_lines(rest, mark))
    return CsvDialect(names, mark, comma and mark != ",", skip)


def _header_lines(lines: list[str], delimiter: str) -> list[int]:
    """Return how many lines the header takes: a quoted name may hold a line break."""
    reader = csv.reader(iter(f"{line}\n" for line in lines), delimiter=delimiter)
    next(reader)
    return [reader.line_num]


def _head(path: Path) -> str:
    require_regular(path, ImportTableError, "table (.csv or .csv.gz)")
    try:
        opener = gzip.open if path.suffix == ".gz" else open
        with opener(path, "rb") as file:
            raw = file.read(HEAD_BYTES)
        # A letter of several bytes may be cut in two at the end of what was read.
        return raw.decode("utf-8-sig", errors="strict" if len(raw) < HEAD_BYTES else "ignore")
    except UnicodeDecodeError as error:
        raise ImportTableError(f"{path}: not a text file in UTF-8") from error
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ImportTableError(f"{path}: broken or truncated gzip ({error})") from error
    except OSError as error:
        raise ImportTableError(f"{path}: cannot be read ({error.strerror})") from error


def _delimiter(lines: list[str]) -> str:
    """Return the mark that cuts the header and the rows into equally many cells, and into most."""

    def cells(mark: str) -> tuple[int, int]:
        counts = [len(row) for row in csv.reader(lines[:50], delimiter=mark) if row]
        return (sum(n == counts[0] for n in counts) if counts[0] > 1 else 0, counts[0])

    return max(DELIMITERS, key=lambda mark: (cells(mark)[1] > 1, cells(mark)))


def _has_decimal_comma(rows: list[list[str]]) -> bool:
    cells = [cell.strip() for row in rows for cell in row]
    commas = sum(bool(_DECIMAL_COMMA.fullmatch(cell)) for cell in cells)
    return commas > sum(bool(_DECIMAL_POINT.fullmatch(cell)) for cell in cells)
