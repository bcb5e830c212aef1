"""Takes typed values out of a table read from JSON."""

from __future__ import annotations

from typing import Any, Final

from calib.calibration.power_curves import Curve
from calib.errors import BadInputError
from uwblink.twr import LARGEST_ID

LARGEST: Final = 1e100
"""Whatever it is of, squares and products of such numbers are numbers still."""

Matrix = tuple[tuple[float, ...], ...]


def is_tag(text: str) -> bool:
    """Whether a text is the id of a tag, as keys of calibrations are."""
    return text.isascii() and text.isdecimal() and len(text) < 9 and int(text) <= LARGEST_ID


class Reader:
    """Takes typed values out of a table; every mistake names the key."""

    def __init__(self, table: dict[str, Any], where: str) -> None:
        """Read from a table, which errors say is at `where`."""
        self._table, self._where = table, where

    def has(self, key: str) -> bool:
        """Return whether the key is there."""
        return key in self._table

    def inside(self, key: str) -> Reader:
        """Return a reader of the table at a key."""
        return Reader(self.table(key), f"{self._where}: {key}")

    def _value(self, key: str) -> Any:
        if key not in self._table:
            raise BadInputError(f"{self._where}: {key}: missing")
        return self._table[key]

    def wrong(self, key: str, expected: str) -> BadInputError:
        """Return the error that says what stands at a key, and what was expected."""
        found = repr(self._table[key])
        return BadInputError(f"{self._where}: {key}: found {found[:60]}, expected {expected}")

    def number(self, key: str) -> float:
        """Return a finite number."""
        value = self._value(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
            raise self.wrong(key, f"a finite number up to {LARGEST:g}")
        return float(value)

    def word(self, key: str) -> str:
        """Return a text."""
        value = self._value(key)
        if not isinstance(value, str):
            raise self.wrong(key, "text")
        return value

    def table(self, key: str) -> dict[str, Any]:
        """Return a table."""
        value = self._value(key)
        if not isinstance(value, dict):
            raise self.wrong(key, "a table")
        return value

    def delays(self, key: str, missing: float | None = None) -> dict[int, float]:
        """Return numbers by tag; `missing` stands for null, which is wrong by default."""
        table = self.table(key)
        inner = Reader(table, f"{self._where}: {key}")
        if not all(map(is_tag, table)):
            raise self.wrong(key, "tag ids as keys")
        return {
            int(tag): missing if value is None and missing is not None else inner.number(tag)
            for tag, value in table.items()
        }

    def matrix(self, key: str, size: int) -> Matrix:
        """Return rows of numbers, as many as there are in each."""
        value = self._value(key)
        if not isinstance(value, list) or len(value) != size:
            raise self.wrong(key, f"{size} rows")
        inner = Reader({str(k): row for k, row in enumerate(value)}, f"{self._where}: {key}")
        rows = tuple(inner.numbers(str(k)) for k in range(size))
        if any(len(row) != size for row in rows):
            raise self.wrong(key, f"{size} numbers a row")
        return rows

    def numbers(self, key: str, least: int = 1) -> tuple[float, ...]:
        """Return a list of finite numbers, `least` of them or more."""
        value = self._value(key)
        if not isinstance(value, list) or len(value) < least:
            raise self.wrong(key, "a list of numbers")
        inner = Reader({str(k): v for k, v in enumerate(value)}, f"{self._where}: {key}")
        return tuple(inner.number(str(k)) for k in range(len(value)))

    def couples(self, key: str) -> tuple[tuple[float, float], ...]:
        """Return a list of two numbers each, which may be empty."""
        value = self._value(key)
        if not isinstance(value, list) or any(not isinstance(row, list) or len(row) != 2 for row in value):
            raise self.wrong(key, "a list of two numbers each")
        inner = Reader({str(k): row for k, row in enumerate(value)}, f"{self._where}: {key}")
        return tuple((row[0], row[1]) for row in (inner.numbers(str(k)) for k in range(len(value))))

    def curve(self, key: str) -> Curve:
        """Return a curve whose parts fit each other."""
        inner = Reader(self.table(key), f"{self._where}: {key}")
        knots, coefficients = inner.numbers("knots"), inner.numbers("coefficients")
        span, degree = inner.numbers("range"), int(inner.number("degree"))
        fits = len(knots) == len(coefficients) + degree + 1 and 0 <= degree <= 5
        if not fits or list(knots) != sorted(knots) or len(span) != 2 or span[0] >= span[1]:
            raise BadInputError(f"{self._where}: {key}: knots, coefficients, degree, range do not fit")
        return Curve(knots, coefficients, degree, (span[0], span[1]))
