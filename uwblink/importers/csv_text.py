"""CSV files: their dialect, limits of their lines, and the line numbers of rows."""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Final, NamedTuple

import numpy as np

from uwblink.arrays import Ints
from uwblink.errors import ImportTableError, first_line
from uwblink.text_files import require_regular

PIECE_BYTES: Final = 1 << 20
"""Size of the blocks in which line numbers are counted."""

MAX_LINE_BYTES: Final = 4_000_000
"""An impulse response in one cell takes 6,000."""

MAX_CELLS: Final = 4096
"""Cells of a row; an impulse response in cells of its own takes 2,032."""


class CsvDialect(NamedTuple):
    """Dialect of a CSV file; the first row of values follows after `skip` lines."""

    names: tuple[str, ...]
    delimiter: str
    decimal_comma: bool
    skip: int


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


def detect(path: Path, delimiter: str | None = None, decimal: str | None = None) -> CsvDialect:
    """Return the dialect of a CSV file by its first 64 KiB; `delimiter` and `decimal` override what is found.

    Lines before the header that are empty or begin with "#" are skipped. Raises `ImportTableError` for a file that is
    not text with a header.
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
    return CsvDialect(names, mark, decimal == "," and mark != ",", skip)


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
