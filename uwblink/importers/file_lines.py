"""Files of tables as lines of text: whether they can be read at all, and at which line a row stands."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

import numpy as np

from uwblink.arrays import Ints
from uwblink.errors import ImportTableError


def lines_of(path: Path, skip: int, rejected: Ints, rows: Ints) -> Ints:
    """Return the lines of rows (0 is the first that was not rejected), past empty lines and breaks in quotes.

    `skip` lines come before the first row, and the lines `rejected`, in ascending order, are none of the rows.
    """
    wanted = np.unique(rows)
    lines = wanted + 1 + skip
    left_out = iter(rejected.tolist())
    row, found, quoted, out = 0, -1, False, next(left_out, 0)
    with (gzip.open if path.suffix == ".gz" else open)(path, "rt", encoding="utf-8-sig", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            if row == len(wanted):
                break
            begins = not quoted
            quoted ^= bool(line.count('"') % 2)
            while out and out < number:
                out = next(left_out, 0)
            if number <= skip or not begins or not line.strip() or number == out:
                continue
            found += 1
            if found == wanted[row]:
                lines[row] = number
                row += 1
    return np.asarray(lines[np.searchsorted(wanted, rows)], dtype=np.int64)


def check_file(path: Path) -> None:
    """Raise `ImportTableError` for a path at which there is no file that can be read."""
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
