"""What is around the tags of a scenario: the room, obstacles, and the bodies that throw shadows."""

from __future__ import annotations

from typing import Annotated, Any, Final, Self

from pydantic import AfterValidator, Field, model_validator

from uwbsim.scenario.base import NotNegative, Positive, Section, Vector
from uwbsim.units import MM

MATERIALS: Final = {
    "air": (0.0, 1.0),
    "drywall": (15.0, 1.6),
    "wood": (25.0, 1.5),
    "glass": (40.0, 2.5),
    "brick": (45.0, 2.0),
    "concrete": (80.0, 2.4),
    "person": (60.0, 6.0),
    "metal": (2000.0, 1.0),
}


"""Loss in dB a metre and refractive index near 4 GHz: round values from ITU-R P.2040-3 (building materials; person as
wet tissue). Excess delay is (index - 1) times the thickness."""


class Material(Section):
    """What an obstacle is made of: loss in dB a metre, and refractive index."""

    loss_db_per_m: NotNegative = Field(description="Loss of waves on their way through.")
    index: Annotated[float, Field(ge=1)] = Field(1.0, description="Refractive index.")


def _known(material: Any) -> Any:
    if isinstance(material, str) and material not in MATERIALS:
        raise ValueError(f"found {material!r}, known are {', '.join(MATERIALS)}")
    return material


KnownMaterial = Annotated[str | Material, AfterValidator(_known)]


class Obstacle(Section):
    """A box that waves go through, at a loss and late. `material` is a name or a table of its own.

    In the geometric model its faces reflect; `roughness_mm` is the standard deviation of their heights.
    """

    name: str = Field("obstacle", description="What it is called.")
    min_m: Vector = Field(description="Lowest corner.")
    max_m: Vector = Field(description="Highest corner.")
    material: KnownMaterial = Field(description="A known material by its name, or a table of its own.")
    roughness_mm: NotNegative = Field(
        3.0,
        description="Standard deviation of its faces' heights, in the geometric model.",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(lo >= hi for lo, hi in zip(self.min_m, self.max_m, strict=True)):
            raise ValueError("min_m: must be below max_m in every direction")
        return self

    def properties(self) -> tuple[float, float]:
        """Return loss in dB a metre, and refractive index."""
        return properties(self.material)

    @property
    def roughness_m(self) -> float:
        """Return the standard deviation of its surface's heights in metres."""
        return self.roughness_mm * MM


def properties(material: str | Material) -> tuple[float, float]:
    """Return loss in dB a metre and refractive index of a material, by its name or as given."""
    if isinstance(material, str):
        return MATERIALS[material]
    return material.loss_db_per_m, material.index


class Room(Section):
    """The room: a box, whose six surfaces reflect with `reflection_loss_db` where it is given.

    In the geometric model they reflect as their `material` does, or `floor` and `ceiling` where these are given;
    `roughness_mm` is the standard deviation of their heights.
    """

    min_m: Vector = Field(description="Lowest corner.")
    max_m: Vector = Field(description="Highest corner.")
    reflection_loss_db: NotNegative | None = Field(
        None,
        description="How much weaker surfaces give waves back; they reflect nothing where it is left out. Not in the "
        "geometric model.",
    )
    material: KnownMaterial = Field("concrete", description="Of walls, in the geometric model.")
    floor: KnownMaterial | None = Field(None, description="Material of the floor, if not that of the walls.")
    ceiling: KnownMaterial | None = Field(None, description="Material of the ceiling, if not that of the walls.")
    roughness_mm: NotNegative = Field(
        3.0,
        description="Standard deviation of surfaces' heights, in the geometric model.",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(lo >= hi for lo, hi in zip(self.min_m, self.max_m, strict=True)):
            raise ValueError("min_m: must be below max_m in every direction")
        return self

    @property
    def roughness_m(self) -> float:
        """Return the standard deviation of its surfaces' heights in metres."""
        return self.roughness_mm * MM

    def materials(self) -> tuple[str | Material, ...]:
        """Return those of the six surfaces: two walls across x, two across y, floor and ceiling."""
        return (*[self.material] * 4, self.floor or self.material, self.ceiling or self.material)


class Shadow(Section):
    """The part of a body that waves do not pass unharmed: an ellipsoid in the body's frame."""

    semi_axes_m: tuple[Positive, Positive, Positive] = Field(description="Semi-axes of the ellipsoid along x, y, z.")
    centre_m: Vector = Field((0.0, 0.0, 0.0), description="Its centre in the frame of the body.")
    loss_db_per_m: NotNegative = Field(40.0, description="Loss of waves on their way through.")
