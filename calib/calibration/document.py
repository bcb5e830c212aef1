"""The JSON file of a calibration: its keys, the types of its values, reading and writing."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any, Final, TypeVar

from pydantic import (
    AfterValidator,
    PlainSerializer,
    PlainValidator,
    TypeAdapter,
    ValidationError,
    WrapSerializer,
    WrapValidator,
)
from pydantic_core import ErrorDetails

from calib.data.ranges import MAX_RANGE_M
from calib.errors import BadInputError
from uwblink.display import first_few
from uwblink.errors import raising
from uwblink.text_files import FileKey
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import LARGEST_ID

Value = TypeVar("Value")


def _curve_keys(name: str, of: str) -> tuple[FileKey, ...]:
    return (
        FileKey(f"{name}.knots", "numbers", "needed", f"Knots of the B-spline of the {of} over lifted power."),
        FileKey(
            f"{name}.coefficients", "numbers, m", "needed", "Its coefficients, as many as knots less degree less 1."
        ),
        FileKey(f"{name}.degree", "whole number", "needed", "Degree of its pieces."),
        FileKey(f"{name}.range", "2 numbers", "needed", "Fitted lifted powers; the curve is constant outside them."),
    )


CALIBRATION_KEYS: Final = (
    FileKey(
        "schema_version",
        "1 to 7",
        "needed",
        "2 with `groups`, 3 with `power_at` reception, 4 with `pair_offsets`, 5 with `undetermined_splits`, 6 with "
        "`patterns`, 7 with `temperatures`.",
    ),
    FileKey("delays_ns.TAG", "number, ns", "needed", "Aggregate antenna delay of a tag, transmit minus receive."),
    FileKey(
        "delays_std_ns.TAG",
        "number, ns, or null",
        "needed",
        "Its standard error; null if the data do not determine it.",
    ),
    FileKey("loss", "text", "needed", "Loss or likelihood of the fit."),
    FileKey("scale_ns", "number, ns", "needed", "Scale of the loss: ranges with larger errors have less weight."),
    FileKey(
        "lift",
        '"mean-of-lifted" or "lift-of-mean"',
        "needed",
        "Lifted power of an exchange from its two powers.",
    ),
    FileKey("alpha_dbm", "number, dBm", "needed", "Power whose lifted power is 1."),
    FileKey("speed_of_light", "number, m/s", "needed", "Speed of light of the conversion from times to distances."),
    *_curve_keys("bias_curve", "bias, which is subtracted from ranges"),
    *_curve_keys("sigma_curve", "standard deviation of corrected ranges without reflections"),
    FileKey(
        "provenance.KEY",
        "anything",
        "needed",
        "Program, recordings, counts, settings, gauge, warnings: information for people.",
    ),
    FileKey(
        "power_at",
        '"exchange" or "reception"',
        '"exchange"',
        "Argument of the bias curve: the lifted power of the exchange, or of each reception (half of the bias each).",
    ),
    FileKey("groups.NAME.tags", "whole numbers", "no groups", "Tags of one antenna design."),
    *_curve_keys("groups.NAME.bias_curve", "bias of these tags"),
    *_curve_keys("groups.NAME.sigma_curve", "standard deviation of these tags"),
    FileKey("errors.lifted", "numbers, increasing", "no errors", "Lifted powers of the next two keys."),
    FileKey("errors.noise_m", "numbers, m", "needed", "Standard deviation without reflections there."),
    FileKey("errors.tail_share", "numbers, 0 to 1", "needed", "Share of reflected ranges there."),
    FileKey("errors.least_m", "number, m", "needed", "Shortest detour of a reflection."),
    FileKey("errors.detour_m", "number, m", "needed", "Mean of the additional detour, which is exponential."),
    FileKey("errors.long_share", "number, 0 to 1", "0", "Share of the long kind among the reflections."),
    FileKey("errors.long_factor", "number, above 0", "1", "Ratio of the mean long detour to the mean of the others."),
    FileKey(
        "errors.between_m",
        "number, m",
        "0",
        "Part of the noise that is constant for a pair in a recording and differs between recordings.",
    ),
    FileKey("errors.outlier_share", "number, 0 to 1", "needed", "Share of outliers."),
    FileKey("errors.outlier_m", "number, m", "needed", "Standard deviation of outliers."),
    FileKey("errors.location_m", "number, m", "needed", "Centre of the noise."),
    FileKey("errors.scale", "number", "needed", "Correction factor of the total standard deviation."),
    FileKey(
        "errors.levels",
        "pairs of numbers, 0 to 1",
        "needed",
        "Shares of errors, and the model's probabilities that correspond to them.",
    ),
    FileKey(
        "errors.lasting.mean",
        "number",
        "no persistence",
        "Mean of the errors within the gate of a filter, in units of sigma.",
    ),
    FileKey("errors.lasting.own_variance", "number, above 0", "needed", "Variance of the independent part of errors."),
    FileKey(
        "errors.lasting.lasting_variance",
        "number, above 0",
        "needed",
        "Variance of the part that successive ranges of a pair share.",
    ),
    FileKey("errors.lasting.time_s", "number, s", "needed", "Correlation time of the shared part."),
    FileKey("errors.lasting.renewal_s", "number, s", "0", "Mean time for which a reflection lasts."),
    FileKey(
        "errors.features.NAME.log_odds",
        "number",
        "no features",
        "Change of the log odds of a reflection per unit of a feature (`response_db`, `rise_taps`).",
    ),
    FileKey(
        "errors.features.NAME.centre",
        "number, dB or taps",
        "needed",
        "Value of the feature at which the change is zero.",
    ),
    FileKey(
        "errors.features.NAME.bounds",
        "2 numbers, dB or taps",
        "needed",
        "Bounds of the feature; the change is constant outside them.",
    ),
    FileKey(
        "errors.known_log_odds",
        "number",
        "0",
        "Additional log odds of ranges with a known feature, relative to `tail_share`.",
    ),
    FileKey("errors.pairs.PAIR.noise", "number, above 0", "1", "Factor on the noise of a pair, such as 1-2."),
    FileKey("errors.pairs.PAIR.odds", "number, above 0", "1", "Factor on the pair's odds of a reflection."),
    FileKey("errors.pairs.PAIR.detour", "number, above 0", "1", "Factor on the pair's mean detour."),
    FileKey(
        "pair_offsets.PAIR.offset_m",
        "number, m",
        "no constants",
        "Constant error of the ranges of a pair, positive if they are too long.",
    ),
    FileKey("pair_offsets.PAIR.std_m", "number, m", "needed", "Its standard error."),
    *(
        FileKey(
            f"antenna_delays.TAG.{name}", "whole number, ticks", "not known", f"{what}, at the time of the recording."
        )
        for name, what in (
            ("tx", "Transmit antenna delay register of a tag"),
            ("rx", "Receive antenna delay register of a tag"),
            ("reply", "Constant that a tag's firmware added to the stamps of its delayed replies"),
        )
    ),
    FileKey("uncertainty.tags", "whole numbers", "not known", "Tags in the order of the next key."),
    FileKey("uncertainty.delays_ns2", "matrix, ns²", "needed", "Covariance of the delays."),
    FileKey("uncertainty.bias_m2", "matrix, m²", "needed", "Covariance of the bias curve's coefficients."),
    FileKey(
        "uncertainty.sigma_m2", "matrix, m²", "needed", "Covariance of the standard-deviation curve's coefficients."
    ),
    FileKey(
        "undetermined_splits",
        "pairs of lists of tags",
        "none",
        "Two sides of tags that ranged only with each other: only ranges between the two sides can be corrected. If "
        "one side is empty, only differences of arrival can be corrected.",
    ),
    FileKey(
        "patterns",
        "list of tables",
        "none",
        "`tags`; `coefficients_m` of 8 spherical harmonics minus their `centre`, whose sum makes ranges longer; "
        "their `covariance_m2`; `rms_m`, the uncertainty without directions.",
    ),
    FileKey(
        "temperatures",
        "list of tables",
        "none",
        "`tags`; `m_per_k`, the growth of ranges per kelvin of one end above `reference_c`; its standard error "
        "`std_m_per_k`; `span_c`, lowest and highest fitted temperature.",
    ),
)


def with_current_keys(provenance: dict[str, Any]) -> dict[str, Any]:
    """Return a provenance with the present names of two keys that had other names in version 0.2."""
    renamed = {"rests_on": "geometry", "left_open": "undetermined_text"}
    return {renamed.get(key, key): value for key, value in provenance.items()}


def number(least: float, most: float, what: str, kind: Callable[[float], Any] = float) -> PlainValidator:
    """Return the check of a number between two bounds; `what` describes it in errors. The `kind` int allows whole
    numbers only.
    """

    def good(value: Any) -> bool:
        within = isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most
        return bool(within and kind(value) == value)

    return expect(what, good, kind)


def one_of(allowed: Iterable[str]) -> PlainValidator:
    """Return the check that a text is one of the allowed ones."""
    return expect(f"one of {', '.join(allowed)}", lambda value: isinstance(value, str) and value in allowed)


def expect(what: str, good: Callable[[Any], bool], kind: Callable[[Any], Any] = lambda value: value) -> PlainValidator:
    """Return the check of a value by the function `good`; `what` describes it in errors, `kind` converts it."""
    return PlainValidator(_checker(good, f"expected {what}", kind))


def joint(good: Callable[[Any], bool], mistake: str) -> AfterValidator:
    """Return the check by `good` that the fields of a dataclass agree; `mistake` is the text of the error."""
    return AfterValidator(_checker(good, mistake))


def _checker(
    good: Callable[[Any], bool], mistake: str, kind: Callable[[Any], Any] = lambda value: value
) -> Callable[[Any], Any]:
    def check(value: Any) -> Any:
        if not good(value):
            raise ValueError(mistake)
        return kind(value)

    return check


def is_tag_key(text: object) -> bool:
    """Return whether a text is the id of a tag, as a key of a calibration."""
    return isinstance(text, str) and text.isascii() and text.isdecimal() and len(text) < 9 and int(text) <= LARGEST_ID


def is_pair(text: object) -> bool:
    """Return whether a text names a pair of tags, such as 1-2."""
    ends = str(text).split("-")
    return len(ends) == 2 and all(map(is_tag_key, ends))


def ends_of(name: str) -> tuple[int, int]:
    """Return the tags of a pair, the smaller id first, from its name, such as 1-2."""
    low, high = sorted(map(int, name.split("-")))
    return low, high


def pair_name(pair: Sequence[int]) -> str:
    """Return the name of a pair in files and tables, such as 1-2."""
    return "-".join(map(str, pair))


def known_of_splits(splits: Iterable[Split]) -> str:
    """Return a sentence on the measurements that can be corrected in spite of undetermined splits.

    They are ranges between the two sides of a split, or differences of arrival within one.
    """

    def named(tags: Sequence[int]) -> str:
        return f"tag{'s' * (len(tags) > 1)} {first_few(map(str, tags))}"

    known = (
        f"ranges between {named(one)} and {named(other)}"
        if one and other
        else f"differences of arrival from {named(one or other)}"
        for one, other in splits
    )
    return f"only {'; '.join(known)} are determined"


def split_text(splits: Iterable[Split]) -> str:
    """Return `known_of_splits` with the reason."""
    splits = list(splits)
    why = (
        "delays of one side can increase by the amount by which those of the other decrease"
        if any(map(all, splits))
        else "a common shift of their delays cancels in these"
    )
    return f"{known_of_splits(splits)}, because {why}"


MAX_DELAY_NS: Final = 1e4
"""Largest delay: 3 km of range. A register holds up to 1026 ns and a device has two of them; ten metres of cable are
50 ns. The rest is margin."""

# Squares and products of numbers up to 1e100 are finite.
Number = Annotated[float, number(-1e100, 1e100, "a finite number up to 1e+100")]
Positive = Annotated[float, number(1e-100, 1e100, "a number above 0")]
OpenShare = Annotated[float, number(1e-100, 1 - 2**-53, "a share between 0 and 1")]
Share = Annotated[float, number(0.0, 1.0, "a share, 0 to 1")]
DelayNs = Annotated[float, number(-MAX_DELAY_NS, MAX_DELAY_NS, f"nanoseconds, up to ±{MAX_DELAY_NS:g}")]
StdNs = Annotated[float, number(0.0, MAX_DELAY_NS, f"nanoseconds, 0 to {MAX_DELAY_NS:g}")]
Metres = Annotated[
    float, number(-MAX_RANGE_M, MAX_RANGE_M, f"metres, up to ±{MAX_RANGE_M:g}, the longest range that is read")
]
Celsius = Annotated[float, number(-273.15, 1e3, "degrees Celsius, -273 to 1000")]
StdM = Annotated[float, number(0.0, MAX_RANGE_M, f"metres, 0 to {MAX_RANGE_M:g}")]
PowerDbm = Annotated[float, number(-200.0, 100.0, "dBm, -200 to 100: the noise in a bandwidth of 500 MHz is -87 dBm")]
Light = Annotated[
    float,
    number(
        0.999 * SPEED_OF_LIGHT,
        1.001 * SPEED_OF_LIGHT,
        f"metres a second in air or vacuum, about {SPEED_OF_LIGHT:.0f}",
    ),
]
"""The refractive index of air is 1.0003; a thousandth is three centimetres in thirty metres."""

FreeStdNs = Annotated[
    StdNs,
    WrapValidator(lambda value, check: math.inf if value is None else check(value)),
    PlainSerializer(lambda value: value if math.isfinite(value) else None),
]
"""A standard error; infinite (null in files) if the data do not determine the delay."""

Matrix = tuple[tuple[Number, ...], ...]
"""A matrix as a tuple of rows."""

Tags = tuple[Annotated[int, number(0, LARGEST_ID, "the id of a tag", int)], ...]
Split = tuple[Tags, Tags]
TagKey = Annotated[int, expect("tag ids as keys", is_tag_key, int)]
PairKey = Annotated[
    tuple[int, int], expect("two tag ids as keys, as in 1-2", is_pair, ends_of), PlainSerializer(pair_name)
]
PairName = Annotated[str, expect("names of pairs, as in 1-2", is_pair, lambda name: pair_name(ends_of(name)))]
IN_ORDER: Final = WrapSerializer(lambda table, write: write(dict(sorted(table.items()))))
"""Writes a table in the order of its keys."""


def write(calibration: Value, adapter: TypeAdapter[Value]) -> str:
    """Return a calibration as JSON text.

    The version states the features that a program must support to read the file: 2 groups of tags; 3 a bias curve at
    the power of each reception (at the mean power, corrections are wrong by up to a decimetre); 4 constants of pairs;
    5 pairs that cannot be corrected; 6 patterns over direction (without them, ranges are wrong by up to a decimetre); 7
    slopes over temperature.
    """
    table = adapter.dump_python(calibration, mode="json")
    # These keys are left out if they are empty; they are the last ones, in this order.
    optional = ("power_at", "groups", "errors", "pair_offsets", "antenna_delays", "uncertainty", "undetermined_splits",
                "patterns", "temperatures")  # fmt: skip
    used = {key: value for key in optional if (value := table.pop(key)) and value != "exchange"}
    needed = ("groups", "power_at", "pair_offsets", "undetermined_splits", "patterns", "temperatures")
    version = max((number for number, key in enumerate(needed, 2) if key in used), default=1)
    text = json.dumps({"schema_version": version} | table | used, indent=1, allow_nan=False)
    # Write each list of numbers on one line, so that a matrix appears as rows.
    on_lines = re.sub(
        r"\[[-+.e\d,\s]+\]", lambda found: " ".join(found[0].split()).replace("[ ", "[").replace(" ]", "]"), text
    )
    return on_lines + "\n"


def read(adapter: TypeAdapter[Value], text: str, where: str) -> Value:
    """Return the object that an adapter reads from JSON text; raises `BadInputError` that names `where` and the key."""
    with raising(BadInputError, f"{where}: not JSON", ValueError, RecursionError):
        table = json.loads(text, parse_float=finite, parse_constant=finite)
    if not isinstance(table, dict) or "schema_version" not in table:
        raise BadInputError(f"{where}: not a calibration (no schema_version)")
    if table["schema_version"] not in range(1, 8):
        raise BadInputError(f"{where}: schema version {table['schema_version']!r}, this uwbcal reads 1 to 7")
    try:
        found = adapter.validate_python(table)
        adapter.dump_python(found, mode="json")  # raises ValueError if it is nested too deeply to be written again
        return found
    except ValidationError as error:
        raise BadInputError(f"{where}: {_explained(error.errors(include_url=False))}") from None
    except ValueError as error:
        raise BadInputError(f"{where}: nested too deeply ({error})") from None


def _explained(errors: list[ErrorDetails]) -> str:
    """Return the text of the first error; errors of values come before missing keys."""
    first = min(errors, key=lambda one: one["type"] == "missing")
    path = [str(part) for part in first["loc"]]
    message = "missing" if first["type"] == "missing" else first["msg"].removeprefix("Value error, ")
    found = "" if isinstance(first["input"], dict) else f"found {first['input']!r:.60}, "
    return ": ".join([*(path[:-2] if path[-1:] == ["[key]"] else path), found + message])


@contextmanager
def reading_provenance() -> Iterator[None]:
    """Raise `BadInputError` for damaged entries of a provenance, as a context or as a decorator of a function.

    A provenance is information for people, so entries are only checked where one is used.
    """
    wrong = "calibration: its provenance is not as uwbcal writes it"
    with raising(BadInputError, wrong, AttributeError, KeyError, TypeError, ValueError):
        yield


def for_json(value: Any) -> Any:
    """Return a value for JSON, also within dictionaries: None for numbers that are not finite, keys as text."""
    if isinstance(value, dict):
        return {str(key): for_json(inner) for key, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def finite(text: str) -> float:
    """Return a number of JSON; raises `ValueError` for infinities and NaN, which JSON cannot hold."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no finite number")
    return value
