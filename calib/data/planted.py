"""What a simulation says that it planted: read from files, so its form is checked before anything is drawn by it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import BadInputError
from uwblink.arrays import Floats
from uwblink.display import printable

CURVES: Final = ("bias_curve", "sigma_curve")
HIGHEST_DEGREE: Final = 5
LARGEST: Final = 1e9
"""What is planted is nanoseconds, metres and lifted powers."""


def check_planted(planted: Mapping[str, Any], where: str) -> None:
    """Raise `BadInputError`, beginning with `where`, for delays that are no numbers by tag and curves that are none."""
    delays = planted.get("delays_ns", {})
    if not isinstance(delays, Mapping) or not all(str(tag).isdecimal() for tag in delays):
        raise _wrong(where, "delays_ns", delays, "numbers by tag")
    if len(_numbers([*delays.values()])) != len(delays):
        raise _wrong(where, "delays_ns", delays, "numbers by tag")
    for name in CURVES:
        curve = planted.get(name)
        if curve and not _fits(curve):
            raise _wrong(where, name, curve, "knots, coefficients and degree of a B-spline")


def _fits(curve: Any) -> bool:
    if not isinstance(curve, Mapping):
        return False
    degree = curve.get("degree")
    knots, coefficients = _numbers(curve.get("knots")), _numbers(curve.get("coefficients"))
    if not isinstance(degree, int) or not 0 <= degree <= HIGHEST_DEGREE:
        return False
    sizes = len(coefficients) > degree and len(knots) == len(coefficients) + degree + 1
    return bool(sizes and (np.diff(knots) >= 0).all() and knots[degree] < knots[-1 - degree])


def _numbers(values: ArrayLike | None) -> Floats:
    """Return a list of numbers as an array; an empty one where one of them is none, or is too large."""
    try:
        found = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)
    return found if found.ndim == 1 and (np.abs(found) <= LARGEST).all() else np.empty(0)


def _wrong(where: str, key: str, found: object, expected: str) -> BadInputError:
    return BadInputError(f"{where}: planted: {key}: found {printable(repr(found))[:60]}, expected {expected}")
