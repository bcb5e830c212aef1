"""The result of a fit: a frozen value, JSON both ways, and how to apply it."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from calib.dataset import Ranges
from calib.errors import BadInputError
from calib.power import LIFTS, Curve, lifted_power
from uwblink.recording import check_output

Floats = NDArray[np.float64]

SCHEMA_VERSION: Final = 1


@dataclass(frozen=True, slots=True)
class Applied:
    """Ranges in three stages, metres, and what is known of them, shape (n,).

    `clamped` marks lifted powers at which the curves had no data and are held constant.
    """

    raw_m: Floats
    delays_m: Floats
    full_m: Floats
    sigma_m: Floats
    lifted: Floats
    clamped: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Antenna delays of tags, in nanoseconds, and the curves of bias and standard deviation."""

    delays_ns: dict[int, float]
    delays_std_ns: dict[int, float]
    loss: str
    scale_ns: float
    lift: str
    alpha_dbm: float
    speed_of_light: float
    bias_curve: Curve
    sigma_curve: Curve
    provenance: dict[str, Any] = field(default_factory=dict)

    def lifted(self, ranges: Ranges) -> Floats:
        """Return the lifted power of each range, as this calibration defines it."""
        return lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, self.lift, self.alpha_dbm)

    def apply(self, ranges: Ranges) -> Applied:
        """Correct ranges: c (w_i d_i + w_j d_j) for the delays (ICRA 2023, section IV), then the curve.

        Raises `BadInputError` naming the tags that have no delay in this calibration.
        """
        missing = [t for t in ranges.tags() if t not in self.delays_ns]
        if missing:
            known = ", ".join(map(str, sorted(self.delays_ns)))
            raise BadInputError(
                f"{ranges.source}: no delay for tag {', '.join(map(str, missing))} in the calibration, "
                f"which knows {known}; fit one from a recording with all tags"
            )
        size = max(ranges.tags()) + 1
        delay_s = np.array([self.delays_ns.get(t, math.nan) for t in range(size)]) * 1e-9
        flight = ranges.weight_initiator * delay_s[ranges.initiator] + ranges.weight_target * delay_s[ranges.target]
        delays = ranges.raw_m + self.speed_of_light * flight
        lifted = self.lifted(ranges)
        return Applied(
            raw_m=ranges.raw_m,
            delays_m=delays,
            full_m=delays - self.bias_curve(lifted),
            sigma_m=self.sigma_curve(lifted),
            lifted=lifted,
            clamped=~self.bias_curve.inside(lifted),
        )

    def to_json(self) -> str:
        """Return the calibration as JSON text."""
        document = {
            "schema_version": SCHEMA_VERSION,
            "delays_ns": {str(t): d for t, d in sorted(self.delays_ns.items())},
            "delays_std_ns": {str(t): d for t, d in sorted(self.delays_std_ns.items())},
            "loss": self.loss,
            "scale_ns": self.scale_ns,
            "lift": self.lift,
            "alpha_dbm": self.alpha_dbm,
            "speed_of_light": self.speed_of_light,
            "bias_curve": _curve_table(self.bias_curve),
            "sigma_curve": _curve_table(self.sigma_curve),
            "provenance": self.provenance,
        }
        return json.dumps(document, indent=1, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str, where: str = "calibration") -> Self:
        """Read a calibration; raises `BadInputError` that says `where`, and which key is wrong."""
        try:
            table = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise BadInputError(f"{where}: not JSON ({error})") from error
        if not isinstance(table, dict) or "schema_version" not in table:
            raise BadInputError(f"{where}: not a calibration (no schema_version)")
        if table["schema_version"] != SCHEMA_VERSION:
            raise BadInputError(
                f"{where}: schema version {table['schema_version']!r}, this uwbcal reads {SCHEMA_VERSION}"
            )
        read = _Reader(table, where)
        lift = read.word("lift")
        if lift not in LIFTS:
            raise BadInputError(f"{where}: lift: found {lift!r}, allowed: {', '.join(LIFTS)}")
        return cls(
            delays_ns=read.delays("delays_ns"),
            delays_std_ns=read.delays("delays_std_ns"),
            loss=read.word("loss"),
            scale_ns=read.number("scale_ns"),
            lift=lift,
            alpha_dbm=read.number("alpha_dbm"),
            speed_of_light=read.number("speed_of_light"),
            bias_curve=read.curve("bias_curve"),
            sigma_curve=read.curve("sigma_curve"),
            provenance=read.table("provenance"),
        )


def load(path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration file; raises `BadInputError`."""
    source = Path(path)
    try:
        return Calibration.from_json(source.read_text(encoding="utf-8"), str(path))
    except FileNotFoundError as error:
        raise BadInputError(f"{path}: no such calibration file") from error
    except IsADirectoryError as error:
        raise BadInputError(f"{path}: is a directory, expected a calibration (.json)") from error
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path}: not JSON (not UTF-8 text)") from error
    except OSError as error:
        raise BadInputError(f"{path}: cannot be read ({error.strerror})") from error


def save(calibration: Calibration, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a calibration file, whole or not at all; refuses to replace one unless `force`."""
    write_text(Path(path), calibration.to_json(), force=force)


def write_text(path: Path, text: str, *, force: bool) -> None:
    """Write a text file by way of a neighbour that takes its name when complete."""
    check_output(path, force=force)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise BadInputError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        partial.unlink(missing_ok=True)


def _curve_table(curve: Curve) -> dict[str, Any]:
    return {
        "knots": list(curve.knots),
        "coefficients": list(curve.coefficients),
        "degree": curve.degree,
        "range": list(curve.range),
    }


class _Reader:
    """Takes typed values out of a table; every mistake names the key."""

    def __init__(self, table: dict[str, Any], where: str) -> None:
        self._table, self._where = table, where

    def _value(self, key: str) -> Any:
        if key not in self._table:
            raise BadInputError(f"{self._where}: {key}: missing")
        return self._table[key]

    def _wrong(self, key: str, expected: str) -> BadInputError:
        found = repr(self._table[key])
        return BadInputError(f"{self._where}: {key}: found {found[:60]}, expected {expected}")

    def number(self, key: str) -> float:
        value = self._value(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self._wrong(key, "a finite number")
        return float(value)

    def word(self, key: str) -> str:
        value = self._value(key)
        if not isinstance(value, str):
            raise self._wrong(key, "text")
        return value

    def table(self, key: str) -> dict[str, Any]:
        value = self._value(key)
        if not isinstance(value, dict):
            raise self._wrong(key, "a table")
        return value

    def delays(self, key: str) -> dict[int, float]:
        table = self.table(key)
        inner = _Reader(table, f"{self._where}: {key}")
        if not all(tag.isdecimal() and tag.isascii() for tag in table):
            raise self._wrong(key, "tag ids as keys")
        return {int(tag): inner.number(tag) for tag in table}

    def numbers(self, key: str) -> tuple[float, ...]:
        value = self._value(key)
        if not isinstance(value, list) or not value:
            raise self._wrong(key, "a list of numbers")
        inner = _Reader({str(k): v for k, v in enumerate(value)}, f"{self._where}: {key}")
        return tuple(inner.number(str(k)) for k in range(len(value)))

    def curve(self, key: str) -> Curve:
        inner = _Reader(self.table(key), f"{self._where}: {key}")
        knots, coefficients = inner.numbers("knots"), inner.numbers("coefficients")
        span, degree = inner.numbers("range"), int(inner.number("degree"))
        fits = len(knots) == len(coefficients) + degree + 1 and 0 <= degree <= 5
        if not fits or list(knots) != sorted(knots) or len(span) != 2 or span[0] >= span[1]:
            raise BadInputError(f"{self._where}: {key}: knots, coefficients, degree, range do not fit")
        return Curve(knots, coefficients, degree, (span[0], span[1]))
