"""Columns of many rows, which lie in files without a name: in memory is what is worked on, and no more.

A column of a million rows and more is a mapped file in the folder for temporary files (`TMPDIR`), which is gone when
nobody holds the column any more. It is an array like any other; `let_go` takes its pages out of this process, and the
next look at them brings them back from the file, of which the system keeps in memory what it has room for. `put` sets
rows by writing to the file, a third of the time that the same takes page by page through the array.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

from calib.errors import UnanswerableError

MANY: Final = 1_000_000
"""Rows from which a column lies in a file."""

ROWS_AT_ONCE: Final = 1 << 20

EVERY: Final = slice(None)


class _Mapped(mmap.mmap):
    """A mapped file, by `descriptor` open as long as the map is there; `address` is where it lies in memory."""

    descriptor: int = -1
    address: int

    def __del__(self) -> None:
        """Let the file go."""
        if self.descriptor >= 0:
            os.close(self.descriptor)


def empty(rows: int, dtype: DTypeLike = np.float64, *, each: tuple[int, ...] = ()) -> NDArray[Any]:
    """Return room for a column (rows,), or for several (*each, rows) at once.

    Raises `UnanswerableError` where a file is needed and the folder for temporary files has no room for it.
    """
    shape, kind = (*each, rows), np.dtype(dtype)
    if rows < MANY:
        return np.empty(shape, kind)
    size = int(np.prod(shape)) * kind.itemsize
    with tempfile.TemporaryFile(prefix="uwbcal-") as file:
        try:
            _take_room(file.fileno(), size)
        except OSError as error:
            raise UnanswerableError(
                f"{tempfile.gettempdir()}: no room for {size / 1e9:.1f} GB of columns ({error.strerror}); "
                "set TMPDIR to a folder with more"
            ) from error
        place = _Mapped(file.fileno(), size)
        place.descriptor = os.dup(file.fileno())
    found = np.frombuffer(place, kind).reshape(shape)
    place.address = _address(found)
    return found


def _address(column: NDArray[Any]) -> int:
    return int(column.__array_interface__["data"][0])


def _take_room(file: int, size: int) -> None:
    """Make a file so long; where the system can, its room on the disk is taken too, so that none lacks later."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)


def spans(rows: int) -> Iterator[slice]:
    """Yield slices of so many rows together, as many as are worked on at once."""
    for begin in range(0, rows, ROWS_AT_ONCE):
        yield slice(begin, min(begin + ROWS_AT_ONCE, rows))


def computed(rows: int, of: Callable[[slice], NDArray[Any]], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Return the column (rows,) that a function of slices of rows makes, some at once if there are many."""
    if rows < MANY:
        return np.asarray(of(slice(0, rows)), dtype)
    found = empty(rows, dtype)
    for some in spans(rows):
        put(found, some, of(some))
    return found


def let_go(*columns: NDArray[Any] | None) -> None:
    """Take the pages of columns that lie in files out of memory; what is in them stays."""
    for column in columns:
        place = _place_of(column)
        if place is not None and hasattr(mmap, "MADV_DONTNEED"):
            place.madvise(mmap.MADV_DONTNEED)


def _place_of(column: NDArray[Any] | None) -> _Mapped | None:
    """Return the map of the file in which a column lies, None for one in memory."""
    place: Any = column
    while isinstance(place, np.ndarray):
        place = place.base
    place = place.obj if isinstance(place, memoryview) else place
    return place if isinstance(place, _Mapped) else None


def put(column: NDArray[Any], rows: slice, values: NDArray[Any]) -> None:
    """Set some rows of a column (n,), one after the other, as `column[rows] = values` does."""
    place, room = _place_of(column), column[rows]
    if place is None or not room.flags.c_contiguous or not hasattr(os, "pwrite"):
        room[...] = values
        return
    data = np.ascontiguousarray(np.broadcast_to(values, room.shape), room.dtype)
    left = data.view(np.uint8).data
    at = _address(room) - place.address
    while left:
        done = os.pwrite(place.descriptor, left, at)
        left, at = left[done:], at + done


def picked(column: NDArray[Any], rows: NDArray[Any] | slice) -> NDArray[Any]:
    """Return some rows of a column (n,), as `column[rows]` does; one value for all of them stays one."""
    if column.strides == (0,) and len(column):
        return np.broadcast_to(np.asarray(column[0]), _count(rows, len(column)))
    if len(column) < MANY or column.ndim > 1 or isinstance(rows, slice):
        return np.asarray(column[rows])
    return _kept(column, rows) if rows.dtype == bool else _gathered(column, rows)


def few(rows: NDArray[Any], *columns: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield rows from all over each column (n,), which lie on most of its pages: one column at a time is in memory."""
    for column in columns:
        found = column[rows]
        let_go(column)
        yield found


def _count(rows: NDArray[Any] | slice, length: int) -> int:
    """Return how many rows are chosen of a column of a length."""
    if isinstance(rows, slice):
        return len(range(*rows.indices(length)))
    return int(np.count_nonzero(rows)) if rows.dtype == bool else len(rows)


def _kept(column: NDArray[Any], keep: NDArray[Any]) -> NDArray[Any]:
    """Return the rows of a column (n,) to keep (n,), in their order."""
    found, begin = empty(int(np.count_nonzero(keep)), column.dtype), 0
    for some in spans(len(column)):
        part = column[some][keep[some]]
        put(found, slice(begin, begin + len(part)), part)
        begin += len(part)
        let_go(column)
    return found


def _gathered(column: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
    """Return rows of a column (n,), anywhere in it, in the order of `rows`."""
    found = empty(len(rows), column.dtype)
    for some in spans(len(rows)):
        put(found, some, np.take(column, rows[some]))
    let_go(column)
    return found


def joined(columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return columns one after the other, as `numpy.concatenate` does."""
    count = sum(map(len, columns))
    if count < MANY:
        return np.concatenate(columns)
    found, begin = empty(count, np.result_type(*columns)), 0
    for column in columns:
        put(found, slice(begin, begin + len(column)), column)
        begin += len(column)
        let_go(column)
    return found


def std_of(column: NDArray[Any]) -> float:
    """Return the standard deviation of a column (n,), without copies of it."""
    if len(column) < MANY:
        return float(np.std(column))
    mean, square = float(np.mean(column)), 0.0
    for rows in spans(len(column)):
        square += float(np.sum((column[rows] - mean) ** 2))
        let_go(column)
    return float(np.sqrt(square / len(column)))
