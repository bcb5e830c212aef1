"""Files of tables as lines of text: whether they can be read at all, and at which line a row stands."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from io import StringIO
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from uwblink.arrays import Ints
from uwblink.errors import ImportTableError
from uwblink.text_files import require_regular

AT_ONCE: Final = 1 << 20
"""Bytes of a file that are looked at together."""

BLOCK: Final = 4096
LONGEST_LINE: Final = 4_000_000
"""Bytes; an impulse response in one cell takes 6,000."""

MOST_CELLS: Final = 4096
"""Cells of a row; an impulse response in cells of its own takes 2,032."""


def lines_of(path: Path, skip: int, rejected: Ints, rows: Ints) -> Ints:
    """Return the lines of rows (0 is the first that was not rejected), past empty lines and breaks in quotes.

    `skip` lines come before the first row, and the lines `rejected`, in ascending order, are none of the rows.
    """
    wanted = np.unique(rows)
    lines = wanted + 1 + skip
    row, found = 0, 0
    with (gzip.open if path.suffix == ".gz" else open)(path, "rb") as file:
        for begins in _beginnings(file, skip):
            if row == len(wanted):
                break
            out = np.searchsorted(rejected, [begins[0], begins[-1] + 1]) if len(begins) else (0, 0)
            kept = np.setdiff1d(begins, rejected[out[0] : out[1]], assume_unique=True)
            until = int(np.searchsorted(wanted, found + len(kept)))
            lines[row:until] = kept[wanted[row:until] - found]
            row, found = until, found + len(kept)
    return np.asarray(lines[np.searchsorted(wanted, rows)], dtype=np.int64)


def _beginnings(file: BinaryIO | gzip.GzipFile, skip: int) -> Iterator[Ints]:
    """Yield the lines at which rows begin, in ascending order, those of some bytes at a time."""
    before, quoted = 0, False
    while piece := file.read(AT_ONCE):
        piece += file.readline()
        if before >= skip and not quoted and _is_plain(piece):
            count = piece.count(b"\n") + (not piece.endswith(b"\n"))
            yield np.arange(before + 1, before + count + 1)
        else:
            count, found = 0, []
            # Only the first piece can begin with a mark of the order of bytes, which is no text.
            text = piece.decode("utf-8" if before else "utf-8-sig", errors="replace")
            for count, line in enumerate(StringIO(text, newline=None), start=1):
                if not quoted and line.strip() and before + count > skip:
                    found.append(before + count)
                quoted ^= bool(line.count('"') % 2)
            yield np.array(found, dtype=np.int64)
        before += count


def _is_plain(piece: bytes) -> bool:
    """Whether each line of a piece of a file is a row: it begins with a letter, a digit or a sign of ASCII."""
    if b'"' in piece or piece.count(b"\r") != piece.count(b"\r\n"):
        return False
    letters = np.frombuffer(piece, dtype=np.uint8)
    first = letters[np.concatenate([[0], np.flatnonzero(letters[:-1] == ord("\n")) + 1])]
    return bool(np.all((first > ord(" ")) & (first < 127)))


def check_file(path: Path) -> None:
    """Raise `ImportTableError` for a path at which there is no file that can be read."""
    require_regular(path, ImportTableError, "table (.csv, .csv.gz, .parquet or .jsonl)")


def check_lines(path: Path, delimiter: str | None = None) -> None:
    """Read a file of text through; raises `ImportTableError` for a line that is too long, or has too many cells.

    Cells stand between delimiters, if there is one. Of each cell too many DuckDB would note the whole line, and it
    would read a broken compressed file for ever.
    """
    mark = (delimiter or "").encode()
    length = cells = 0
    try:
        with (gzip.open if path.suffix == ".gz" else open)(path, "rb") as file:
            while piece := file.read(16 * BLOCK):
                for start in range(0, len(piece), BLOCK):
                    # Only lines that fill whole blocks are looked at: a hundredth of the time of looking at all.
                    if piece.find(b"\n", start, start + BLOCK) >= 0:
                        length = cells = 0
                        continue
                    length += BLOCK
                    cells += piece.count(mark, start, start + BLOCK) if mark else 0
                    if length > LONGEST_LINE or cells > MOST_CELLS:
                        most = f"{MOST_CELLS} cells" if cells > MOST_CELLS else f"{LONGEST_LINE} bytes"
                        line = _line_at(path, file.tell() - len(piece) + start)
                        raise ImportTableError(f"{path}: row {line}: more than {most}; are lines ended as in a table?")
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ImportTableError(f"{path}: broken or truncated gzip ({error})") from error
    except OSError as error:
        raise ImportTableError(f"{path}: cannot be read ({error.strerror})") from error


def _line_at(path: Path, position: int) -> int:
    """Return the line that has the byte at some position; the first is 1."""
    count = 1
    with (gzip.open if path.suffix == ".gz" else open)(path, "rb") as file:
        while position > 0 and (piece := file.read(min(AT_ONCE, position))):
            count += piece.count(b"\n")
            position -= len(piece)
    return count
