"""Base of all tables of a scenario file: kinds of numbers, and the largest value of each unit.

Beyond these limits numbers of a simulation would overflow, and its stamps mean nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, Final, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

BY_UNIT: Final = {
    "_per_k": (1e4, "effects of a kelvin are far smaller"),
    "_per_v": (1e4, "effects of a volt are far smaller"),
    "_mps2": (1e5, "bodies accelerate far less"),
    "_dps": (1e4, "bodies turn far more slowly"),
    "_dps_per_sqrt_hz": (1e3, "sensors have far less noise"),
    "_mps2_per_sqrt_hz": (1e3, "sensors have far less noise"),
    "_mps": (1e4, "bodies are far slower"),
    "_dbm": (500.0, "powers of radios are far smaller"),
    "_db": (500.0, "differences of powers are far smaller"),
    "_ppm": (1e4, "a crystal is good to some 20 ppm"),
    "_ppm_per_s": (1e4, "a crystal is good to some 20 ppm"),
    "_ppm_per_sqrt_s": (1e4, "a crystal is good to some 20 ppm"),
    "_ppm_sqrt_s": (1e4, "a crystal is good to some 20 ppm"),
    "_hz": (1e6, "a frame lasts longer than the interval"),
    "_ns": (1e6, "an antenna delays by less than a microsecond"),
    "_ps": (1e6, "a receiver times first paths to some nanoseconds"),
    "_m": (1e6, "the radio reaches some hundred metres"),
    "_rad": (1e3, "a full turn is 6.3"),
    "_deg": (1e6, "a full turn is 360"),
    "_s": (1e7, "time is simulated for 36 hours"),
    "_ms": (1e9, "time is simulated for 36 hours"),
    "_c": (1e3, "boards melt at lower temperatures"),
    "_v": (1e3, "boards take 3.6 V"),
    "": (1e6, "settings are far smaller"),
}
"""The largest absolute value by the unit at the end of a key, beyond what physics and the chip allow, and why."""


@cache
def limit_of(key: str) -> tuple[float, str]:
    """Return the limit of a key by the unit that it ends with, and the reason."""
    return BY_UNIT[max(filter(key.endswith, BY_UNIT), key=len)]


def require(met: object, text: str) -> None:
    """Raise `ValueError` with a text, of the key and of what was found, unless a condition is met."""
    if not met:
        raise ValueError(text)


def check_limits(key: str, value: Any) -> None:
    """Raise `ValueError` for a number beyond the limit of its key, alone or in tuples; anything else passes."""
    if isinstance(value, tuple):
        for one in value:
            check_limits(key, one)
    elif isinstance(value, int | float) and abs(value) > limit_of(key)[0]:
        (most, reason), shown = limit_of(key), f"{value:g}" if value < 1e300 else "a number with hundreds of digits"
        raise ValueError(f"{key}: found {shown}, at most {most:g} is allowed ({reason})")


def _increasing(values: Sequence[float]) -> Sequence[float]:
    require(
        all(a < b for a, b in pairwise(values)), "found a value that is not above the one before; they must increase"
    )
    return values


def not_decreasing(values: Sequence[float]) -> Sequence[float]:
    """Raise `ValueError` for values that do not increase or stay."""
    require(
        all(a <= b for a, b in pairwise(values)), "found a value that is below the one before; they must not decrease"
    )
    return values


def look_up(known: Mapping[str, Any], value: Any) -> Any:
    """Return what a name stands for, and any other value as it is; raises `ValueError` for an unknown name."""
    if not isinstance(value, str):
        return value
    if value not in known:  # to list the names of a table would load its plug-ins
        raise ValueError(f"found {value!r}, known are {', '.join(known)}")
    return known[value]


def known_in(known: Mapping[str, Any], value: Any) -> Any:
    """Return a value as it is; raises `ValueError` for a name that is none of `known`."""
    look_up(known, value)
    return value


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Vector = tuple[float, float, float]
Increasing = Annotated[tuple[float, ...], AfterValidator(_increasing)]
NotDecreasing = Annotated[tuple[float, ...], AfterValidator(not_decreasing)]
TagId = Annotated[int, Field(ge=0, le=65_535)]


def _limits_in_schema(schema: dict[str, Any]) -> None:
    """Add the limits of units to those of a key's own."""
    for key, described in schema.get("properties", {}).items():
        if key == "seed":  # which measures nothing
            continue
        for choice in (described, *described.get("anyOf", ())):
            if choice.get("type") in ("number", "integer"):
                most, _ = limit_of(key)
                if not {"minimum", "exclusiveMinimum"} & choice.keys():
                    choice["minimum"] = -most
                if "exclusiveMaximum" not in choice:
                    choice.setdefault("maximum", most)


class Section(BaseModel):
    """A table of the file: immutable, with no unknown keys, and numbers within the limits of their units only."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, json_schema_extra=_limits_in_schema)

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        for key in type(self).model_fields:
            if key != "seed":
                check_limits(key, getattr(self, key))
        return self
