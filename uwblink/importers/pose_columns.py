"""Poses of whole files as columns, as quickly as they can be read: for files in which every cell is as it should be.

Where one is not, nothing is returned, and whoever reads row by row says which cell it is.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.table import Table
from uwblink.recording.schema import Poses

NUMBERS: Final = ("x", "y", "z", "qx", "qy", "qz", "qw")
LATEST_NS: Final = 2**62
_NEVER: Final = np.iinfo(np.int64).min
_EUROC_ORDER: Final = (0, 1, 2, 4, 5, 6, 3)
"""Where x y z qx qy qz qw are among x y z qw qx qy qz."""


def poses_of_table(path: Path, body: str | None) -> Poses | None:
    """Return the poses of a CSV file with a header, in order of time; None where a cell cannot be read so."""
    try:
        with Table(path, ",", ".") as table:
            times = [name for name in ("time_ns", "time_s") if name in table.names]
            if not times or (body is None and "body" not in table.names):
                return None
            numbers, words = table.read([*NUMBERS, times[0]], [] if body is not None else ["body"])
            time_ns = _times(table, times[0], numbers.pop(times[0]))
            if len(table.rejected()):
                return None
    except ImportTableError:
        return None
    values = np.column_stack([numbers[name] for name in NUMBERS])
    # A file that somebody is still writing is longer when the second of its columns is read.
    count = min(len(time_ns), len(values))
    bodies = np.full(count, body) if body is not None else words["body"][:count]
    return _checked(time_ns[:count], bodies, values[:count])


def poses_of_lines(path: Path, body: str, *, euroc: bool) -> Poses | None:
    """Return the poses of a TUM or a EuRoC file, in order of time; None where a cell cannot be read so."""
    kind = np.dtype([("time", np.int64 if euroc else np.float64), ("values", np.float64, 7)])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)  # of a file without any data
            rows = np.loadtxt(
                path, dtype=kind, comments="#", delimiter="," if euroc else None, usecols=range(8) if euroc else None,
                encoding="utf-8", ndmin=1,
            )  # fmt: skip
    except (ValueError, OSError, IndexError, UserWarning):
        return None
    if not len(rows):
        return None
    time_ns = rows["time"] if euroc else _nanoseconds(rows["time"] * 1e9)
    values = rows["values"][:, _EUROC_ORDER] if euroc else rows["values"]
    return _checked(time_ns, np.full(len(rows), body), values)


def _times(table: Table, name: str, numbers: Floats) -> Ints:
    # Seconds since 1970 have ten digits; a float of them is good to 0.2 us.
    return table.whole_numbers(name, _NEVER) if name == "time_ns" else _nanoseconds(numbers * 1e9)


def _nanoseconds(values: Floats) -> Ints:
    with np.errstate(invalid="ignore"):
        good = np.abs(values) <= LATEST_NS
    return np.where(good, np.rint(np.where(good, values, 0.0)), _NEVER).astype(np.int64)


def _checked(time_ns: Ints, body: np.ndarray, values: Floats) -> Poses | None:
    norm = np.linalg.norm(values[:, 3:], axis=1)
    good = np.isfinite(values).all() and (np.abs(time_ns.astype(np.float64)) <= LATEST_NS).all()
    if not good or (body == "").any() or ((norm < 0.9) | (norm > 1.1)).any():
        return None
    if (np.diff(time_ns) >= 0).all():
        return Poses(time_ns, body, values[:, :3], values[:, 3:] / norm[:, None])
    order = np.argsort(time_ns, kind="stable")
    return Poses(time_ns[order], body[order], values[order, :3], values[order, 3:] / norm[order, None])
