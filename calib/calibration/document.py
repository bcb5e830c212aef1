"""The JSON of a calibration: the keys, writing, and reading with every mistake named by its key."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from calib.calibration.error_model import ErrorModel, PairErrors
from calib.calibration.parts import Matrix, PairOffset, TagGroup, Uncertainty, pair_name
from calib.calibration.power_curves import LIFTS, Curve
from calib.data.ranges import MAX_RANGE_M
from calib.errors import BadInputError
from uwblink.recording.antenna_delays import REGISTER_MAX, AntennaDelay
from uwblink.text_files import FileKey
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import LARGEST_ID

if TYPE_CHECKING:
    from calib.calibration.model import Calibration


def _curve_keys(name: str, of: str) -> tuple[FileKey, ...]:
    return (
        FileKey(f"{name}.knots", "numbers", "needed", f"Knots of the B-spline of the {of} over lifted power."),
        FileKey(
            f"{name}.coefficients", "numbers, m", "needed", "Its coefficients, as many as knots less degree less 1."
        ),
        FileKey(f"{name}.degree", "whole number", "needed", "Degree of its pieces."),
        FileKey(f"{name}.range", "2 numbers", "needed", "Lifted powers that it was fitted on; constant beyond them."),
    )


FILE_KEYS: Final = (
    FileKey(
        "schema_version", "1 to 4", "needed", "2 with `groups`, 3 with `power_at` reception, 4 with `pair_offsets`."
    ),
    FileKey("delays_ns.TAG", "number, ns", "needed", "Aggregate antenna delay of a tag, transmit less receive."),
    FileKey("delays_std_ns.TAG", "number, ns, or null", "needed", "Its standard error; null where data leave it free."),
    FileKey("loss", "text", "needed", "What the fit minimized."),
    FileKey("scale_ns", "number, ns", "needed", "The loss's scale: beyond it a range counts less."),
    FileKey(
        "lift",
        '"mean-of-lifted" or "lift-of-mean"',
        "needed",
        "How the two powers of an exchange make its lifted power.",
    ),
    FileKey("alpha_dbm", "number, dBm", "needed", "Power whose lifted power is 1."),
    FileKey("speed_of_light", "number, m/s", "needed", "With which times were made distances."),
    *_curve_keys("bias_curve", "bias, which corrected ranges are less by"),
    *_curve_keys("sigma_curve", "standard deviation of corrected ranges without reflections"),
    FileKey("provenance.KEY", "anything", "needed", "Writer, recordings, counts, recipe, gauge, warnings: for people."),
    FileKey(
        "power_at",
        '"exchange" or "reception"',
        '"exchange"',
        "Where the bias curve is taken: at an exchange's lifted power, or half at each of both powers.",
    ),
    FileKey("groups.NAME.tags", "whole numbers", "no groups", "Tags of one antenna design."),
    *_curve_keys("groups.NAME.bias_curve", "bias of these tags"),
    *_curve_keys("groups.NAME.sigma_curve", "standard deviation of these tags"),
    FileKey("errors.lifted", "numbers, increasing", "no errors", "Lifted powers of the two next keys."),
    FileKey("errors.noise_m", "numbers, m", "needed", "Standard deviation without reflections there."),
    FileKey("errors.tail_share", "numbers, 0 to 1", "needed", "Share of ranges on reflections there."),
    FileKey("errors.least_m", "number, m", "needed", "Shortest detour of a reflection."),
    FileKey("errors.detour_m", "number, m", "needed", "Mean of what reflections travel beyond that, exponential."),
    FileKey("errors.long_share", "number, 0 to 1", "0", "Share of the reflections that are of the long kind."),
    FileKey("errors.long_factor", "number, above 0", "1", "Mean of the long detours over that of the others."),
    FileKey("errors.outlier_share", "number, 0 to 1", "needed", "Share of ranges that belong to nothing else."),
    FileKey("errors.outlier_m", "number, m", "needed", "Standard deviation of those."),
    FileKey("errors.location_m", "number, m", "needed", "Where the middle of the noise lies."),
    FileKey("errors.scale", "number", "needed", "Factor that makes the total standard deviation hold."),
    FileKey(
        "errors.levels", "pairs of numbers, 0 to 1", "needed", "Shares, and the model's levels that held for them."
    ),
    FileKey("errors.pairs.PAIR.noise", "number, above 0", "1", "Factor of a pair, as 1-2, on the noise."),
    FileKey("errors.pairs.PAIR.odds", "number, above 0", "1", "Its factor on the odds of a reflection."),
    FileKey("errors.pairs.PAIR.detour", "number, above 0", "1", "Its factor on the mean detour."),
    FileKey("pair_offsets.PAIR.offset_m", "number, m", "no constants", "How much longer ranges of a pair read."),
    FileKey("pair_offsets.PAIR.std_m", "number, m", "needed", "Its standard error."),
    *(
        FileKey(f"antenna_delays.TAG.{name}", "whole number, ticks", "not known", f"{what}, when it was recorded.")
        for name, what in (
            ("tx", "Transmit antenna delay register of a tag"),
            ("rx", "Receive antenna delay register of a tag"),
            ("reply", "What a tag's firmware added to the stamps of its delayed replies"),
        )
    ),
    FileKey("uncertainty.tags", "whole numbers", "not known", "Tags in the order of the next key."),
    FileKey("uncertainty.delays_ns2", "matrix, ns²", "needed", "Covariance of the delays."),
    FileKey("uncertainty.bias_m2", "matrix, m²", "needed", "Covariance of the bias curve's coefficients."),
    FileKey("uncertainty.sigma_m2", "matrix, m²", "needed", "Covariance of the other curve's coefficients."),
)


def text_of(calibration: Calibration) -> str:
    """Return a calibration as JSON text.

    The version is what a program must support to read it: 2 with groups of tags, 3 with a curve that is taken at each
    reception (taken at the mean power it is wrong by up to a decimetre), 4 with constants of pairs.
    """
    version = 2 if calibration.groups else 1
    version = 3 if calibration.power_at != "exchange" else version
    version = 4 if calibration.pair_offsets else version
    document: dict[str, Any] = {
        "schema_version": version,
        "delays_ns": {str(t): d for t, d in sorted(calibration.delays_ns.items())},
        "delays_std_ns": {str(t): d if STD_NS.hold(d) else None for t, d in sorted(calibration.delays_std_ns.items())},
        "loss": calibration.loss,
        "scale_ns": calibration.scale_ns,
        "lift": calibration.lift,
        "alpha_dbm": calibration.alpha_dbm,
        "speed_of_light": calibration.speed_of_light,
        "bias_curve": curve_table(calibration.bias_curve),
        "sigma_curve": curve_table(calibration.sigma_curve),
        "provenance": calibration.provenance,
    }
    if calibration.power_at != "exchange":
        document["power_at"] = calibration.power_at
    if calibration.groups:
        document["groups"] = {
            name: {
                "tags": list(group.tags),
                "bias_curve": curve_table(group.bias_curve),
                "sigma_curve": curve_table(group.sigma_curve),
            }
            for name, group in calibration.groups.items()
        }
    if calibration.errors:
        document["errors"] = asdict(calibration.errors)
    if calibration.pair_offsets:
        document["pair_offsets"] = {pair_name(p): one._asdict() for p, one in sorted(calibration.pair_offsets.items())}
    if calibration.antenna_delays:
        document["antenna_delays"] = {
            str(tag): one._asdict() for tag, one in sorted(calibration.antenna_delays.items(), key=str)
        }
    if calibration.uncertainty:
        document["uncertainty"] = asdict(calibration.uncertainty)
    text = json.dumps(document, indent=1, allow_nan=False)
    # Lists of numbers stand on one line each: a matrix reads as rows.
    on_lines = re.sub(
        r"\[[-+.e\d,\s]+\]", lambda found: " ".join(found[0].split()).replace("[ ", "[").replace(" ]", "]"), text
    )
    return on_lines + "\n"


def curve_table(curve: Curve) -> dict[str, Any]:
    """Return a curve as a table of a file."""
    return {
        "knots": list(curve.knots),
        "coefficients": list(curve.coefficients),
        "degree": curve.degree,
        "range": list(curve.range),
    }


class Bounds(NamedTuple):
    """Between which numbers a quantity lies, and what errors call it."""

    least: float
    most: float
    what: str

    def hold(self, value: float) -> bool:
        """Return whether a number lies between them; NaN does not."""
        return self.least <= value <= self.most


MAX_DELAY_NS: Final = 1e4
"""A register holds 1026 ns and a device has two; ten metres of cable are 50 ns. The rest is margin (3 km of range)."""

# Squares and products of numbers up to 1e100 are finite.
ANY: Final = Bounds(-1e100, 1e100, "a finite number up to 1e+100")
POSITIVE: Final = Bounds(1e-100, 1e100, "a number above 0")
SHARE: Final = Bounds(0.0, 1.0, "a share, 0 to 1")
DELAY_NS: Final = Bounds(-MAX_DELAY_NS, MAX_DELAY_NS, f"nanoseconds, up to ±{MAX_DELAY_NS:g}")
STD_NS: Final = Bounds(0.0, MAX_DELAY_NS, f"nanoseconds, 0 to {MAX_DELAY_NS:g}")
METRES: Final = Bounds(-MAX_RANGE_M, MAX_RANGE_M, f"metres, up to ±{MAX_RANGE_M:g}, the longest range that is read")
STD_M: Final = Bounds(0.0, MAX_RANGE_M, f"metres, 0 to {MAX_RANGE_M:g}")
POWER_DBM: Final = Bounds(-200.0, 100.0, "dBm, -200 to 100: the noise in a bandwidth of 500 MHz is -87 dBm")
REGISTER: Final = Bounds(0, REGISTER_MAX, f"ticks of a register of 16 bits, 0 to {REGISTER_MAX}")
LIGHT: Final = Bounds(
    0.999 * SPEED_OF_LIGHT, 1.001 * SPEED_OF_LIGHT, f"metres a second in air or vacuum, about {SPEED_OF_LIGHT:.0f}"
)
"""The refractive index of air is 1.0003; a thousandth is three centimetres in thirty metres."""


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

    def each(self, key: str, *, needed: bool = False) -> Iterator[tuple[str, Reader]]:
        """Yield name and reader of each table in the table at a key, none where the key is absent and not needed."""
        if needed or self.has(key):
            inner = self.inside(key)
            for name in self.table(key):
                yield name, inner.inside(name)

    def inside(self, key: str) -> Reader:
        """Return a reader of the table at a key."""
        return Reader(self.table(key), f"{self._where}: {key}")

    def _value(self, key: str) -> Any:
        if key not in self._table:
            raise BadInputError(f"{self._where}: {key}: missing")
        return self._table[key]

    def wrong(self, key: str, expected: str) -> BadInputError:
        """Return the error that quotes the value at a key, and states what was expected."""
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

    def one_of(self, key: str, allowed: Iterable[str]) -> str:
        """Return one of the texts that are allowed."""
        found = self.word(key)
        if found not in allowed:
            raise BadInputError(f"{self._where}: {key}: found {found!r}, allowed: {', '.join(allowed)}")
        return found

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
        # A variance of 0 may come out of a decomposition a little below 0.
        if any(len(row) != size or row[k] < -1e-9 for k, row in enumerate(rows)):
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
        if positive and min(coefficients) < 0 and not np.all(found(np.linspace(*span, 200)) >= 0):
            raise inner.wrong("coefficients", "a standard deviation that is nowhere below 0 m")
        return found


def fields_of(text: str, where: str) -> dict[str, Any]:
    """Return the fields of a `Calibration`; raises `BadInputError` that names `where` and the key."""
    read = _reader(text, where)
    return {
        "lift": read.one_of("lift", LIFTS),
        "power_at": read.one_of("power_at", ("exchange", "reception")) if read.has("power_at") else "exchange",
        "delays_ns": read.delays("delays_ns", DELAY_NS),
        "delays_std_ns": read.delays("delays_std_ns", STD_NS, missing=math.inf),
        "loss": read.word("loss"),
        "scale_ns": read.number("scale_ns", STD_NS),
        "alpha_dbm": read.number("alpha_dbm", POWER_DBM),
        "speed_of_light": read.number("speed_of_light", LIGHT),
        "bias_curve": read.curve("bias_curve"),
        "sigma_curve": read.curve("sigma_curve", positive=True),
        "provenance": read.table("provenance"),
        "uncertainty": _uncertainty(read) if read.has("uncertainty") else None,
        "groups": {name: _group(inner) for name, inner in read.each("groups")},
        "errors": _errors(read.inside("errors")) if read.has("errors") else None,
        "antenna_delays": dict(_antenna_delays(read)),
        "pair_offsets": dict(_pair_offsets(read)),
    }


def _reader(text: str, where: str) -> Reader:
    try:
        table = json.loads(text, parse_float=finite, parse_constant=finite)
    except (ValueError, RecursionError) as error:
        raise BadInputError(f"{where}: not JSON ({error})") from error
    if not isinstance(table, dict) or "schema_version" not in table:
        raise BadInputError(f"{where}: not a calibration (no schema_version)")
    if table["schema_version"] not in (1, 2, 3, 4):
        raise BadInputError(f"{where}: schema version {table['schema_version']!r}, this uwbcal reads 1, 2, 3 and 4")
    return Reader(table, where)


def finite(text: str) -> float:
    """Return a number of JSON; raises `ValueError` for infinities and NaN, which could not be written again."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no finite number")
    return value


def _uncertainty(read: Reader) -> Uncertainty:
    inner = read.inside("uncertainty")
    tags = tuple(int(tag) for tag in inner.numbers("tags", least=0))
    bias, sigma = (len(read.curve(name).coefficients) for name in ("bias_curve", "sigma_curve"))
    matrices = (inner.matrix("delays_ns2", len(tags)), inner.matrix("bias_m2", bias), inner.matrix("sigma_m2", sigma))
    return Uncertainty(tags, *matrices)


def _antenna_delays(read: Reader) -> Iterator[tuple[int, AntennaDelay]]:
    for name, inner in read.each("antenna_delays"):
        if not is_tag(name):
            raise read.wrong("antenna_delays", "tag ids as keys")
        yield int(name), AntennaDelay(*(int(inner.number(key, REGISTER)) for key in AntennaDelay._fields))


def _group(read: Reader) -> TagGroup:
    tags = tuple(int(tag) for tag in read.numbers("tags"))
    return TagGroup(tags, read.curve("bias_curve"), read.curve("sigma_curve", positive=True))


def _pair_offsets(read: Reader) -> Iterator[tuple[tuple[int, int], PairOffset]]:
    for name, inner in read.each("pair_offsets"):
        if not _is_pair(name):
            raise read.wrong("pair_offsets", "two tag ids as keys, as in 1-2")
        first, second = sorted(map(int, name.split("-")))
        yield (first, second), PairOffset(inner.number("offset_m", METRES), inner.number("std_m", STD_M))


def _errors(read: Reader) -> ErrorModel:
    lifted, noise, share = (read.numbers(name) for name in ("lifted", "noise_m", "tail_share"))
    fit = len(lifted) == len(noise) == len(share) and len(lifted) > 1
    fit = fit and all(one < two for one, two in pairwise(lifted))
    if not fit or min(noise) <= 0 or not all(0 < value < 1 for value in share):
        raise read.wrong("lifted", "ascending powers, with as many noises above 0 and shares between 0 and 1")
    pairs = dict(read.each("pairs", needed=True))
    if not all(map(_is_pair, pairs)):
        raise read.wrong("pairs", "names of pairs, as in 1-2")
    bounds = dict.fromkeys(("least_m", "detour_m", "outlier_m"), STD_M)
    bounds |= {"outlier_share": SHARE, "location_m": METRES, "scale": POSITIVE}
    if read.has("long_share"):  # the second kind of detour, which calibrations of uwbcal up to 0.2.0 do not have
        bounds |= {"long_share": SHARE, "long_factor": POSITIVE}
    return ErrorModel(
        lifted=lifted,
        noise_m=noise,
        tail_share=share,
        levels=read.couples("levels", SHARE),
        pairs={
            name: PairErrors(**{key: inner.number(key, POSITIVE) for key in ("noise", "odds", "detour")})
            for name, inner in pairs.items()
        },
        **{key: read.number(key, of) for key, of in bounds.items()},
    )


def _is_pair(name: str) -> bool:
    ends = name.split("-")
    return len(ends) == 2 and all(map(is_tag, ends))
