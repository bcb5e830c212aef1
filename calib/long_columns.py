"""Columns of many rows, worked on some rows at a time so that what leads to a result stays small beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

ROWS_AT_ONCE: Final = 1 << 20
"""Rows that are worked on together: 8 MB of a column."""

EVERY: Final = slice(None)


def empty(rows: int, dtype: DTypeLike = np.float64, *, each: tuple[int, ...] = ()) -> NDArray[Any]:
    """Return room for a column (rows,), or for several (*each, rows) at once."""
    return np.empty((*each, rows), np.dtype(dtype))


def spans(rows: int) -> Iterator[slice]:
    """Yield slices of so many rows together, as many as are worked on at once."""
    for begin in range(0, rows, ROWS_AT_ONCE):
        yield slice(begin, min(begin + ROWS_AT_ONCE, rows))


def computed(rows: int, of: Callable[[slice], NDArray[Any]], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """Return the column (rows,) that a function of slices of rows makes, some at once if there are many."""
    found = np.empty(rows, np.dtype(dtype))
    for some in spans(rows):
        found[some] = of(some)
    return found


def let_go(*columns: NDArray[Any] | None) -> None:
    """Do nothing: columns stay in memory."""


def put(column: NDArray[Any], rows: slice, values: NDArray[Any]) -> None:
    """Set some rows of a column (n,)."""
    column[rows] = values


def picked(column: NDArray[Any], rows: NDArray[Any] | slice) -> NDArray[Any]:
    """Return some rows of a column (n,)."""
    return np.asarray(column[rows])


def few(rows: NDArray[Any], *columns: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield some rows of each column (n,)."""
    return (column[rows] for column in columns)


def std_of(column: NDArray[Any]) -> float:
    """Return the standard deviation of a column (n,)."""
    return float(np.std(column))
