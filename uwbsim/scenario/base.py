"""What all tables of a scenario file have in common: kinds of numbers, and the largest value of each unit.

Beyond these limits a simulation would go on with numbers that overflow, and write stamps that mean nothing.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator


class Limit(NamedTuple):
    """The largest absolute value, and why."""

    most: float
    reason: str


BY_UNIT: Final = {
    "_per_k": Limit(1e4, "no board moves so far by a kelvin"),
    "_per_v": Limit(1e4, "no board moves so far by a volt"),
    "_mps2": Limit(1e5, "nothing that flies takes that"),
    "_dps": Limit(1e4, "nothing that flies turns so fast"),
    "_dps_per_sqrt_hz": Limit(1e3, "no sensor is so noisy"),
    "_mps2_per_sqrt_hz": Limit(1e3, "no sensor is so noisy"),
    "_mps": Limit(1e4, "nothing in air is so fast"),
    "_dbm": Limit(500.0, "between noise of nothing and a lightning"),
    "_db": Limit(500.0, "more than any two powers differ by"),
    "_ppm": Limit(1e4, "a crystal is good to some 20 ppm"),
    "_ppm_per_s": Limit(1e4, "a crystal is good to some 20 ppm"),
    "_ppm_per_sqrt_s": Limit(1e4, "a crystal is good to some 20 ppm"),
    "_ppm_sqrt_s": Limit(1e4, "a crystal is good to some 20 ppm"),
    "_hz": Limit(1e6, "a frame takes longer"),
    "_ns": Limit(1e6, "an antenna delays by less than a microsecond"),
    "_ps": Limit(1e6, "a receiver times first paths to some nanoseconds"),
    "_m": Limit(1e6, "the radio reaches some hundred metres"),
    "_rad": Limit(1e3, "a turn is 6.3"),
    "_deg": Limit(1e6, "a turn is 360"),
    "_s": Limit(1e7, "time is simulated for 36 hours"),
    "_ms": Limit(1e9, "time is simulated for 36 hours"),
    "_c": Limit(1e3, "boards melt before"),
    "_v": Limit(1e3, "boards take 3.6 V"),
    "": Limit(1e6, "no setting has sense so far out"),
}
"""By the unit at a key's end: what physics and the chip leave sense in."""


def limit_of(key: str) -> Limit:
    """Return the limit of a key by the unit that it ends with."""
    fitting = [unit for unit in BY_UNIT if key.endswith(unit)]
    return BY_UNIT[max(fitting, key=len)]


def check_limits(key: str, value: Any) -> None:
    """Raise `ValueError` for a number beyond the limit of its key, alone or in tuples; anything else passes."""
    if isinstance(value, tuple):
        leaf: Any = value
        while isinstance(leaf, tuple) and leaf:
            leaf = leaf[0]
        if not _is_number(leaf):
            return
        try:
            found = float(np.max(np.abs(np.asarray(value, dtype=np.float64))))
        except (ValueError, OverflowError):  # of several lengths, or mixed
            for item in value:
                check_limits(key, item)
            return
    elif _is_number(value):
        found = abs(value)
    else:
        return
    limit = limit_of(key)
    if found > limit.most:
        shown = f"{found:g}" if found < 1e300 else "a number of hundreds of digits"
        raise ValueError(f"{key}: found {shown}, at most {limit.most:g} can be ({limit.reason})")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Vector = tuple[float, float, float]
TagId = Annotated[int, Field(ge=0, le=254)]


def _limits_in_schema(schema: dict[str, Any]) -> None:
    """Put the limits of units beside those that a key has of its own."""
    for key, described in schema.get("properties", {}).items():
        if key == "seed":  # which measures nothing
            continue
        for choice in (described, *described.get("anyOf", ())):
            if choice.get("type") in ("number", "integer"):
                limit = limit_of(key)
                if not {"minimum", "exclusiveMinimum"} & choice.keys():
                    choice["minimum"] = -limit.most
                if "exclusiveMaximum" not in choice:
                    choice.setdefault("maximum", limit.most)


class Section(BaseModel):
    """A table of the file: immutable, with no unknown keys, and numbers within the limits of their units only."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, json_schema_extra=_limits_in_schema)

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        for key in type(self).model_fields:
            if key != "seed":
                check_limits(key, getattr(self, key))
        return self
