"""What all tables of a scenario file have in common, and the kinds of numbers in them."""

from __future__ import annotations

from typing import Annotated, Any, Final, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from uwbsim.scenario.limits import check_limits, limit_of

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Vector = tuple[float, float, float]
TagId = Annotated[int, Field(ge=0, le=254)]


UNLIMITED: Final = ("seed",)
"""Keys whose numbers measure nothing."""


def _limits_in_schema(schema: dict[str, Any]) -> None:
    """Put the limits of units beside those that a key has of its own."""
    for key, described in schema.get("properties", {}).items():
        if key in UNLIMITED:
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
            if key not in UNLIMITED:
                check_limits(key, getattr(self, key))
        return self
