"""How bodies of a scenario move."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from uwbsim.scenario.base import Positive, Section, Vector


class RandomFlight(Section):
    """Smooth flight through random points of a box."""

    model: Literal["random-flight"] = Field(description="Smoothly through random points of a box.")
    box_min_m: Vector = Field(description="Lowest corner of the box.")
    box_max_m: Vector = Field(description="Highest corner of the box.")
    speed_mps: Positive = Field(
        1.0,
        description="Speed, roughly: that at which it would go straight from each point to the next.",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(lo >= hi for lo, hi in zip(self.box_min_m, self.box_max_m, strict=True)):
            raise ValueError("box_min_m: must be below box_max_m in every direction")
        return self


class Waypoints(Section):
    """Through points: at times, on a smooth spline; or straight, with limits of speed and acceleration."""

    model: Literal["waypoints"] = Field(description="Through given points.")
    points_m: tuple[Vector, ...] = Field(description="The points, two or more.")
    times_s: tuple[float, ...] | None = Field(
        None,
        description="When it is at each of them, on a smooth spline; or give speed_mps.",
    )
    speed_mps: Positive | None = Field(
        None,
        description="Highest speed on straight ways between the points; or give times_s.",
    )
    acceleration_mps2: Positive = Field(2.0, description="Highest acceleration on straight ways.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.times_s is None) == (self.speed_mps is None):
            raise ValueError("times_s: give either times_s or speed_mps")
        if len(self.points_m) < 2:
            raise ValueError(f"points_m: found {len(self.points_m)} points, give two or more")
        if self.times_s is not None:
            if len(self.times_s) != len(self.points_m):
                raise ValueError(
                    f"points_m: found {len(self.points_m)} points at {len(self.times_s)} times, give one time each"
                )
            if any(b <= a for a, b in zip(self.times_s, self.times_s[1:], strict=False)):
                raise ValueError("times_s: must increase")
        if any(a == b for a, b in zip(self.points_m, self.points_m[1:], strict=False)) and self.times_s is None:
            raise ValueError("points_m: found the same point twice in a row")
        return self


class Figure(Section):
    """A structured training figure around a centre, turning all the way: every direction and distance comes up."""

    model: Literal["figure"] = Field(description="A training figure, turning all the way.")
    shape: Literal["circle", "eight", "helix"] = Field(description="Which figure.")
    centre_m: Vector = Field(description="Its centre.")
    radius_m: Positive = Field(description="Its radius.")
    period_s: Positive = Field(12.0, description="How long one round takes.")
    climb_m: float = Field(0.0, description="How far its lowest point is below its highest.")
    phase_deg: float = Field(0.0, description="Where on it the body begins.")
    turns_per_period: float = Field(1.0, description="How often the body turns about its z axis in a round.")


class Static(Section):
    """A body that does not move, such as an anchor."""

    model: Literal["static"] = Field(description="Does not move, such as an anchor.")
    position_m: Vector = Field(description="Where it stands.")
    yaw_deg: float = Field(0.0, description="How far it is turned about the z axis.")


class Carried(Section):
    """A body that stands still in one place after the other, and is carried from each to the next; then stays."""

    model: Literal["carried"] = Field(description="Put in one place after the other.")
    places_m: tuple[Vector, ...] = Field(description="The places, one or more, in the order of its stays.")
    stay_s: Positive = Field(description="How long it stands in each place.")
    carry_s: Positive = Field(10.0, description="How long it is carried from a place to the next.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.places_m:
            raise ValueError("places_m: found no place, give one or more")
        return self


class Recorded(Section):
    """A trajectory from a file: TUM, CSV, or the poses of a recording, of `body` there; filled in on reading."""

    model: Literal["recorded"] = Field(description="As a file says.")
    file: str = Field(description="TUM, CSV, or a recording (.uwb); from the folder of the scenario.")
    body: str | None = Field(None, description="Which body of the file; needed where it has several.")
    times_s: tuple[float, ...] = Field((), description="Filled in on reading.")
    positions_m: tuple[Vector, ...] = Field((), description="Filled in on reading.")
    quaternions: tuple[tuple[float, float, float, float], ...] = Field(
        (),
        description="Filled in on reading: x y z w, body to world.",
    )


Motion = Annotated[RandomFlight | Waypoints | Figure | Static | Carried | Recorded, Field(discriminator="model")]
