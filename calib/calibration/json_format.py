"""Takes typed values out of a table read from JSON."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from calib.calibration.power_curves import Curve
from calib.data.ranges import MAX_RANGE_M
from calib.errors import BadInputError
from uwblink.recording.antenna_delays import REGISTER_MAX
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import LARGEST_ID

SAMPLED: Final = 200
"""Points at which a curve is looked at; it has some ten pieces."""

LARGEST: Final = 1e100
"""Whatever it is of, squares and products of such numbers are numbers still."""


class Bounds(NamedTuple):
    """Between which numbers a quantity lies, and what errors call it."""

    least: float
    most: float
    what: str

    def hold(self, value: float) -> bool:
        """Return whether a number lies between them; NaN does not."""
        return self.least <= value <= self.most


LARGEST_DELAY_NS: Final = 1e4
"""A register holds 1026 ns and a device has two; ten metres of cable are 50 ns. The rest is margin (3 km of range)."""

ANY: Final = Bounds(-LARGEST, LARGEST, f"a finite number up to {LARGEST:g}")
POSITIVE: Final = Bounds(1e-100, LARGEST, "a number above 0")
SHARE: Final = Bounds(0.0, 1.0, "a share, 0 to 1")
DELAY_NS: Final = Bounds(-LARGEST_DELAY_NS, LARGEST_DELAY_NS, f"nanoseconds, up to ±{LARGEST_DELAY_NS:g}")
STD_NS: Final = Bounds(0.0, LARGEST_DELAY_NS, f"nanoseconds, 0 to {LARGEST_DELAY_NS:g}")
METRES: Final = Bounds(-MAX_RANGE_M, MAX_RANGE_M, f"metres, up to ±{MAX_RANGE_M:g}, the longest range that is read")
STD_M: Final = Bounds(0.0, MAX_RANGE_M, f"metres, 0 to {MAX_RANGE_M:g}")
POWER_DBM: Final = Bounds(-200.0, 100.0, "dBm, -200 to 100: the noise in a bandwidth of 500 MHz is -87 dBm")
REGISTER: Final = Bounds(0, REGISTER_MAX, f"ticks of a register of 16 bits, 0 to {REGISTER_MAX}")
LIGHT: Final = Bounds(
    0.999 * SPEED_OF_LIGHT, 1.001 * SPEED_OF_LIGHT, f"metres a second in air or vacuum, about {SPEED_OF_LIGHT:.0f}"
)
"""The refractive index of air is 1.0003; a thousandth is three centimetres in thirty metres."""

ROUNDING: Final = 1e-9
"""A variance that is 0 may come out of a decomposition a little below it."""

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

    def number(self, key: str, bounds: Bounds = ANY) -> float:
        """Return a number within its bounds."""
        value = self._value(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not bounds.hold(value):
            raise self.wrong(key, bounds.what)
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

    def delays(self, key: str, bounds: Bounds, missing: float | None = None) -> dict[int, float]:
        """Return numbers by tag; `missing` stands for null, which is wrong by default."""
        table = self.table(key)
        inner = Reader(table, f"{self._where}: {key}")
        if not all(map(is_tag, table)):
            raise self.wrong(key, "tag ids as keys")
        return {
            int(tag): missing if value is None and missing is not None else inner.number(tag, bounds)
            for tag, value in table.items()
        }

    def matrix(self, key: str, size: int) -> Matrix:
        """Return rows of numbers, as many as there are in each."""
        value = self._value(key)
        if not isinstance(value, list) or len(value) != size:
            raise self.wrong(key, f"{size} rows")
        inner = Reader({str(k): row for k, row in enumerate(value)}, f"{self._where}: {key}")
        rows = tuple(inner.numbers(str(k)) for k in range(size))
        if any(len(row) != size or row[k] < -ROUNDING for k, row in enumerate(rows)):
            raise self.wrong(key, f"{size} numbers a row, and no variance below 0")
        return rows

    def numbers(self, key: str, bounds: Bounds = ANY, least: int = 1) -> tuple[float, ...]:
        """Return a list of numbers within their bounds, `least` of them or more."""
        value = self._value(key)
        if not isinstance(value, list) or len(value) < least:
            raise self.wrong(key, "a list of numbers")
        inner = Reader({str(k): v for k, v in enumerate(value)}, f"{self._where}: {key}")
        return tuple(inner.number(str(k), bounds) for k in range(len(value)))

    def couples(self, key: str, bounds: Bounds) -> tuple[tuple[float, float], ...]:
        """Return a list of two numbers each, which may be empty."""
        value = self._value(key)
        if not isinstance(value, list) or any(not isinstance(row, list) or len(row) != 2 for row in value):
            raise self.wrong(key, "a list of two numbers each")
        inner = Reader({str(k): row for k, row in enumerate(value)}, f"{self._where}: {key}")
        return tuple((row[0], row[1]) for row in (inner.numbers(str(k), bounds) for k in range(len(value))))

    def curve(self, key: str, *, positive: bool = False) -> Curve:
        """Return a curve in metres whose parts fit each other; one that is `positive` is nowhere below 0."""
        inner = Reader(self.table(key), f"{self._where}: {key}")
        knots, coefficients = inner.numbers("knots"), inner.numbers("coefficients", METRES)
        span, degree = inner.numbers("range"), int(inner.number("degree"))
        fits = len(knots) == len(coefficients) + degree + 1 and 0 <= degree <= 5
        if not fits or list(knots) != sorted(knots) or len(span) != 2 or span[0] >= span[1]:
            raise BadInputError(f"{self._where}: {key}: knots, coefficients, degree, range do not fit")
        found = Curve(knots, coefficients, degree, (span[0], span[1]))
        if positive and min(coefficients) < 0 and not np.all(found(np.linspace(*span, SAMPLED)) >= 0):
            raise inner.wrong("coefficients", "a standard deviation that is nowhere below 0 m")
        return found
