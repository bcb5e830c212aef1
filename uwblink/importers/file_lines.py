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
