"""The bodies of a scenario (motion, inertial and height sensors, shadow), and the room and obstacles around them."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, ClassVar, Final, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from uwbsim.scenario.base import Increasing, NotNegative, Positive, Section, Vector, known_in, require


class Box(Section):
    """A table with two corners of a box."""

    corner: ClassVar[str] = ""

    @model_validator(mode="after")
    def _check_corners(self) -> Self:
        low, high = (f"{self.corner}{end}_m" for end in ("min", "max"))
        sides = zip(getattr(self, low), getattr(self, high), strict=True)
        require(all(lo < hi for lo, hi in sides), f"{low}: must be below {high} in every direction")
        return self


class RandomFlight(Box):
    """Smooth flight through random points of a box."""

    corner = "box_"

    model: Literal["random-flight"] = Field(description="Smoothly through random points of a box.")
    box_min_m: Vector = Field(description="Lowest corner of the box.")
    box_max_m: Vector = Field(description="Highest corner of the box.")
    speed_mps: Positive = Field(
        1.0,
        description="Approximate speed: that of straight legs between the points.",
    )


class Waypoints(Section):
    """Through points: at times, on a smooth spline; or straight, with limits of speed and acceleration."""

    model: Literal["waypoints"] = Field(description="Through given points.")
    points_m: Annotated[tuple[Vector, ...], Field(min_length=2)] = Field(description="The points, two or more.")
    times_s: Increasing | None = Field(
        None,
        description="Time at each point, for a smooth spline; or give speed_mps.",
    )
    speed_mps: Positive | None = Field(
        None,
        description="Highest speed on straight legs between the points; or give times_s.",
    )
    acceleration_mps2: Positive = Field(2.0, description="Highest acceleration on straight legs.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        require((self.times_s is None) != (self.speed_mps is None), "times_s: give either times_s or speed_mps")
        if self.times_s is not None and len(self.times_s) != len(self.points_m):
            raise ValueError(
                f"points_m: found {len(self.points_m)} points at {len(self.times_s)} times, give one time each"
            )
        apart = self.times_s is not None or all(a != b for a, b in pairwise(self.points_m))
        require(apart, "points_m: found the same point twice in a row")
        return self


class Figure(Section):
    """A structured training figure around a centre with a steady turn, which covers all directions and many
    distances.
    """

    model: Literal["figure"] = Field(description="A training figure, with a steady turn of the body.")
    shape: Literal["circle", "eight", "helix"] = Field(description="Which figure.")
    centre_m: Vector = Field(description="Its centre.")
    radius_m: Positive = Field(description="Its radius.")
    period_s: Positive = Field(12.0, description="Duration of one round.")
    climb_m: float = Field(0.0, description="Height of its highest point above its lowest.")
    phase_deg: float = Field(0.0, description="Phase at the start.")
    turns_per_period: float = Field(1.0, description="Turns of the body about its z axis per round.")


class Static(Section):
    """A body that does not move, such as an anchor."""

    model: Literal["static"] = Field(description="Does not move, such as an anchor.")
    position_m: Vector = Field(description="Its position.")
    yaw_deg: float = Field(0.0, description="Its rotation about the z axis.")


class Carried(Section):
    """A body that stands still at several places in turn, and is carried from one to the next; it stays at the last."""

    model: Literal["carried"] = Field(description="Stands still at several places in turn.")
    places_m: Annotated[tuple[Vector, ...], Field(min_length=1)] = Field(
        description="The places, one or more, in the order of its stays."
    )
    stay_s: Positive = Field(description="Duration of each stay.")
    carry_s: Positive = Field(10.0, description="Duration of each move from a place to the next.")


class Recorded(Section):
    """A trajectory from a file: TUM, CSV, or the poses of a recording, of `body` there; filled in on reading."""

    model: Literal["recorded"] = Field(description="From a file.")
    file: str = Field(description="TUM, CSV, or a recording (.uwb); from the folder of the scenario.")
    body: str | None = Field(None, description="Body of the file; needed if it has several.")
    times_s: tuple[float, ...] = Field((), description="Filled in on reading.")
    positions_m: tuple[Vector, ...] = Field((), description="Filled in on reading.")
    quaternions: tuple[tuple[float, float, float, float], ...] = Field(
        (),
        description="Filled in on reading: x y z w, body to world.",
    )


Motion = Annotated[RandomFlight | Waypoints | Figure | Static | Carried | Recorded, Field(discriminator="model")]


GRADES: Final = {
    "consumer": {"gyro": (0.5, 0.01, 0.01), "force": (0.1, 2e-3, 3e-3)},
    "industrial": {"gyro": (0.1, 2e-3, 5e-3), "force": (0.03, 5e-4, 1e-3)},
    "tactical": {"gyro": (5e-3, 1e-4, 1e-3), "force": (0.01, 5e-5, 3e-4)},
    "perfect": {"gyro": (0.0, 0.0, 0.0), "force": (0.0, 0.0, 0.0)},
}
"""Constant bias, its walk in a second, and noise per root of Hz, of gyroscopes in degrees and of accelerometers.

Orders of magnitude of data sheets: phones and small drones, better drones, aircraft.
"""


class Imu(Section):
    """A gyroscope and an accelerometer in the middle of a body, along its axes.

    What is not given follows from the grade. Consumer: 0.5 deg/s and 0.1 m/s^2 of constant bias an axis, 0.01 deg/s and
    0.003 m/s^2 a root of Hz of noise; industrial: 0.1, 0.03, 0.005, 0.001; tactical: 0.005, 0.01, 0.001, 0.0003. Biases
    walk, too.
    """

    grade: Literal["consumer", "industrial", "tactical", "perfect"] = Field(
        "consumer", description="Grade of the sensor, which sets the defaults of its errors."
    )
    rate_hz: Positive = Field(200.0, description="Readings per second.")
    gyro_bias_dps: NotNegative | None = Field(
        None, description="Standard deviation of the gyroscope's constant bias an axis, degrees a second."
    )
    gyro_noise_dps_per_sqrt_hz: NotNegative | None = Field(
        None, description="White noise of the gyroscope, degrees a second a root of Hz."
    )
    accel_bias_mps2: NotNegative | None = Field(
        None, description="Standard deviation of the accelerometer's constant bias an axis."
    )
    accel_noise_mps2_per_sqrt_hz: NotNegative | None = Field(
        None, description="White noise of the accelerometer, m/s^2 a root of Hz."
    )
    vibration_mps2: NotNegative = Field(
        0.0, description="Standard deviation of vibration in each reading of the accelerometer."
    )

    def errors(self, which: str) -> tuple[float, float, float]:
        """Return bias, its walk in a second, and noise per root of Hz, of the "gyro" or "force", in SI units."""
        given = {
            "gyro": (self.gyro_bias_dps, self.gyro_noise_dps_per_sqrt_hz),
            "force": (self.accel_bias_mps2, self.accel_noise_mps2_per_sqrt_hz),
        }[which]
        scale, (bias, wander, noise) = math.pi / 180 if which == "gyro" else 1.0, GRADES[self.grade][which]
        bias, noise = (known if own is None else own for own, known in zip(given, (bias, noise), strict=True))
        return scale * bias, scale * wander, scale * noise


class Height(Section):
    """A sensor of the height of a body's middle above the world's zero."""

    rate_hz: Positive = Field(30.0, description="Readings per second.")
    noise_m: NotNegative = Field(0.02, description="White noise of a reading, standard deviation.")
    bias_m: NotNegative = Field(0.0, description="Standard deviation of its constant bias.")


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
    """Material of an obstacle: loss in dB per metre, and refractive index."""

    loss_db_per_m: NotNegative = Field(description="Loss of waves inside.")
    index: Annotated[float, Field(ge=1)] = Field(1.0, description="Refractive index.")


KnownMaterial = Annotated[str | Material, AfterValidator(lambda material: known_in(MATERIALS, material))]


class Obstacle(Box):
    """A box that attenuates and delays waves. `material` is a name or a table of its own.

    In the geometric model its faces reflect; `roughness_mm` is the standard deviation of their heights.
    """

    name: str = Field("obstacle", description="Its name.")
    min_m: Vector = Field(description="Lowest corner.")
    max_m: Vector = Field(description="Highest corner.")
    material: KnownMaterial = Field(description="A known material by its name, or a table of its own.")
    roughness_mm: NotNegative = Field(
        3.0,
        description="Standard deviation of its faces' heights, in the geometric model.",
    )


def properties(material: str | Material) -> tuple[float, float]:
    """Return loss in dB a metre and refractive index of a material, by its name or as given."""
    if isinstance(material, str):
        return MATERIALS[material]
    return material.loss_db_per_m, material.index


class Room(Box):
    """The room: a box, whose six surfaces reflect with `reflection_loss_db` where it is given.

    In the geometric model they reflect as their `material` does, or `floor` and `ceiling` where these are given;
    `roughness_mm` is the standard deviation of their heights.
    """

    min_m: Vector = Field(description="Lowest corner.")
    max_m: Vector = Field(description="Highest corner.")
    reflection_loss_db: NotNegative | None = Field(
        None,
        description="Loss of a reflection by a surface; by default surfaces do not reflect. Not in the geometric "
        "model.",
    )
    material: KnownMaterial = Field("concrete", description="Of walls, in the geometric model.")
    floor: KnownMaterial | None = Field(None, description="Material of the floor, if not that of the walls.")
    ceiling: KnownMaterial | None = Field(None, description="Material of the ceiling, if not that of the walls.")
    roughness_mm: NotNegative = Field(
        3.0,
        description="Standard deviation of surfaces' heights, in the geometric model.",
    )

    def materials(self) -> tuple[str | Material, ...]:
        """Return those of the six surfaces: two walls across x, two across y, floor and ceiling."""
        return (*[self.material] * 4, self.floor or self.material, self.ceiling or self.material)


class Shadow(Section):
    """The part of a body that attenuates waves: an ellipsoid in the body's frame."""

    semi_axes_m: tuple[Positive, Positive, Positive] = Field(description="Semi-axes of the ellipsoid along x, y, z.")
    centre_m: Vector = Field((0.0, 0.0, 0.0), description="Its centre in the frame of the body.")
    loss_db_per_m: NotNegative = Field(40.0, description="Loss of waves inside.")
