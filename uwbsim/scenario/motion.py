"""How bodies of a scenario move."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from uwbsim.scenario.base import Positive, Section, Vector


class RandomFlight(Section):
    """Smooth flight through random points of a box."""

    model: Literal["random-flight"]
    box_min_m: Vector
    box_max_m: Vector
    speed_mps: Positive = 1.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(lo >= hi for lo, hi in zip(self.box_min_m, self.box_max_m, strict=True)):
            raise ValueError("box_min_m: must be below box_max_m in every direction")
        return self


class Waypoints(Section):
    """Through points: at times, on a smooth spline; or straight, with limits of speed and acceleration."""

    model: Literal["waypoints"]
    points_m: tuple[Vector, ...]
    times_s: tuple[float, ...] | None = None
    speed_mps: Positive | None = None
    acceleration_mps2: Positive = 2.0

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

    model: Literal["figure"]
    shape: Literal["circle", "eight", "helix"]
    centre_m: Vector
    radius_m: Positive
    period_s: Positive = 12.0
    climb_m: float = 0.0
    phase_deg: float = 0.0
    turns_per_period: float = 1.0


class Static(Section):
    """A body that does not move, such as an anchor."""

    model: Literal["static"]
    position_m: Vector
    yaw_deg: float = 0.0


class Recorded(Section):
    """A trajectory from a file: TUM, CSV, or the poses of a recording, of `body` there; filled in on reading."""

    model: Literal["recorded"]
    file: str
    body: str | None = None
    times_s: tuple[float, ...] = ()
    positions_m: tuple[Vector, ...] = ()
    quaternions: tuple[tuple[float, float, float, float], ...] = ()


Motion = Annotated[RandomFlight | Waypoints | Figure | Static | Recorded, Field(discriminator="model")]
