"""Types of arrays, tables of columns, and conversion of arguments into columns.

Shapes are given in the docstrings of functions that take or return arrays. Arguments are lists, arrays, data-frame
columns or one value for all rows; each check raises `ArgumentError` that names the column, the first wrong row, and
what is expected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwblink.display import as_html, as_text, excerpt
from uwblink.errors import ArgumentError, raising

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Complexes = NDArray[np.complex128]

Columns = dict[str, NDArray[Any]]
"""Columns (n,) by name."""


class ArrayRows:
    """Base of dataclasses whose arrays have n rows, along their first axis; other fields hold for all rows."""

    __slots__ = ()

    def _columns(self) -> Columns:
        fields: dict[str, Any] = self.__dataclass_fields__  # type: ignore[attr-defined]
        found = {name: getattr(self, name) for name in fields}
        return {name: value for name, value in found.items() if isinstance(value, np.ndarray)}

    def __len__(self) -> int:
        """Return the number of rows."""
        values = (getattr(self, name) for name in self.__dataclass_fields__)  # type: ignore[attr-defined]
        return next(len(one) for one in values if isinstance(one, np.ndarray))

    def __getitem__(self, rows: int | slice | Bools | Ints) -> Self:
        """Return the chosen rows, in their order; one row for a number."""
        chosen = [rows] if isinstance(rows, int | np.integer) else rows
        columns: dict[str, Any] = {name: column[chosen] for name, column in self._columns().items()}
        return replace(self, **columns)  # type: ignore[type-var]

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of one or more tables as one table; what holds for all rows is that of the first."""
        columns: dict[str, Any] = {n: np.concatenate([getattr(p, n) for p in parts]) for n in parts[0]._columns()}
        return replace(parts[0], **columns)  # type: ignore[type-var]


class ColumnTable(ArrayRows):
    """Base of dataclasses whose fields are columns of length n, in order of `time_ns`.

    A derived class defines `to_dict`, which names its columns for data frames, and `_title`.
    """

    __slots__ = ()
    time_ns: Ints

    def in_time_order(self) -> Self:
        """Return the rows in ascending order of `time_ns`; rows of equal times stay in their order."""
        return self if np.all(np.diff(self.time_ns) >= 0) else self[np.argsort(self.time_ns, kind="stable")]

    def to_dict(self) -> Columns:
        """Return the columns by name, (n,) each, as `pandas.DataFrame` and `polars.DataFrame` take them.

        >>> from uwblink import Exchanges
        >>> x = Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
        >>> [*x.to_dict()][:5], x.to_dict()["rx2"].tolist()
        (['time_ns', 'initiator', 'target', 'protocol', 'reporter'], [3000])
        """
        return self._columns()

    def to_pandas(self) -> Any:
        """Return the columns as a `pandas.DataFrame`; raises `ArgumentError` where pandas is not installed."""
        return data_frame(self.to_dict())

    def _title(self) -> str:
        raise NotImplementedError

    def _shown(self) -> Columns:
        return self.to_dict()

    def __repr__(self) -> str:
        """Return a headline and the first rows, in lines of 79 characters."""
        return as_text(self._title(), excerpt(self._shown()))

    def _repr_html_(self) -> str:
        """Return the same for a notebook, with every column."""
        return as_html(self._title(), excerpt(self._shown()))


def in_time_order(parts: Sequence[Columns]) -> Columns:
    """Return the rows of several tables of columns as one, in order of `time_ns`; no columns for no tables."""
    if not parts:
        return {}
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(columns["time_ns"], kind="stable")
    return {name: column[order] for name, column in columns.items()}


def is_frame(value: object) -> bool:
    """Return whether an object is a data frame, or a table that others can read by Arrow's interface in C."""
    return hasattr(value, "__arrow_c_stream__") or hasattr(value, "__dataframe__")


def data_frame(rows: Mapping[str, NDArray[Any]] | Sequence[Mapping[str, Any]]) -> Any:
    """Return columns, or rows of which values may be mappings, as a `pandas.DataFrame`.

    Raises `ArgumentError` where pandas is not installed.
    """
    with raising(ArgumentError, "a data frame needs pandas: `pip install pandas`, or use to_dict()", ImportError):
        import pandas
    return pandas.DataFrame(rows) if isinstance(rows, Mapping) else pandas.json_normalize(list(rows), sep="_")


def length(name: str, values: ArrayLike) -> int:
    """Return the number of rows of a column; raises `ArgumentError` if it is not one-dimensional."""
    shape = np.shape(values)
    if len(shape) != 1:
        raise ArgumentError(f"{name}: found an array of shape {shape}, expected one value a row, shape (n,)")
    return int(shape[0])


def whole_numbers(name: str, values: ArrayLike, count: int, low: int, high: int, hint: str = "") -> Ints:
    """Return int64 (count,) of whole numbers from `low` to `high`; `hint` is added to the error."""
    found = _rows(name, values, count, "iuf", "whole numbers")
    with np.errstate(invalid="ignore"):
        bad = ~((found >= low) & (found <= high))
        if found.dtype.kind == "f":
            bad |= found != np.rint(found)
    reject(name, found, bad, f"a whole number from {low} to {high}{hint}")
    return found.astype(np.int64)


def numbers(name: str, values: ArrayLike | None, count: int) -> Floats:
    """Return float64 (count,), NaN for unknown values; all are NaN if `values` is None."""
    if values is None:
        return np.full(count, np.nan)
    found = _rows(name, values, count, "iuf", "numbers")
    reject(name, found, np.isinf(found), "a finite number, or NaN where nothing is known")
    return found.astype(np.float64)


def words(name: str, values: ArrayLike, count: int) -> NDArray[np.str_]:
    """Return text (count,)."""
    if not count:  # an empty list has no type of its own
        return np.zeros(0, np.str_)
    return _rows(name, values, count, "UT", "text").astype(np.str_)


def vectors(name: str, values: ArrayLike, count: int, size: int) -> Floats:
    """Return float64 (count, size) of finite numbers; one vector stands for all rows."""
    with raising(ArgumentError, f"{name}: expected numbers of shape ({count}, {size})", TypeError, ValueError):
        found = np.asarray(values, dtype=np.float64)
    if not count and not found.size:
        return np.zeros((0, size))
    if found.shape not in ((size,), (count, size)):
        raise ArgumentError(f"{name}: found an array of shape {found.shape}, expected ({count}, {size}) or ({size},)")
    found = np.array(np.broadcast_to(found, (count, size)))
    reject(name, found, np.asarray(~np.isfinite(found).all(axis=1)), "finite numbers")
    return found


def reject(name: str, values: NDArray[Any], bad: Bools, expected: str) -> None:
    """Raise `ArgumentError` for the first bad row, if there is one."""
    if bad.any():
        row = int(np.argmax(bad))
        raise ArgumentError(f"{name}: row {row}: found {str(values[row])[:60]}, expected {expected}")


def _rows(name: str, values: ArrayLike, count: int, kinds: str, expected: str) -> NDArray[Any]:
    """Return a column (count,) of one of NumPy's kinds; raises `ArgumentError` for another."""
    with raising(ArgumentError, f"{name}: expected one value a row", ValueError):
        found = np.asarray(values)
    if found.dtype.kind == "O" and all(isinstance(value, str) for value in found.flat):
        found = found.astype(np.str_)  # text of a data frame
    if found.ndim and length(name, found) != count:
        raise ArgumentError(f"{name}: found {len(found)} rows, expected {count} as in the first column")
    if found.dtype.kind not in kinds:
        first = f"{str(found.flat[0])[:40]!r}" if found.size else "nothing"
        raise ArgumentError(f"{name}: found {first} (of type {found.dtype}), expected {expected}")
    return found if found.ndim else np.full(count, found)
