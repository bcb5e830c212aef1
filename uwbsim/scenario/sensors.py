"""Inertial and height sensors of a scenario's bodies."""

from __future__ import annotations

import math
from typing import Final, Literal, NamedTuple

from pydantic import Field

from uwbsim.scenario.base import NotNegative, Positive, Section

DEGREE: Final = math.pi / 180


class Errors(NamedTuple):
    """Of a gyroscope or accelerometer, in SI units: a constant bias, its walk in a second, noise a root of Hz."""

    bias: float
    wander: float
    noise: float


GRADES: Final = {
    "consumer": {"gyro": Errors(0.5 * DEGREE, 0.01 * DEGREE, 0.01 * DEGREE), "force": Errors(0.1, 2e-3, 3e-3)},
    "industrial": {"gyro": Errors(0.1 * DEGREE, 2e-3 * DEGREE, 5e-3 * DEGREE), "force": Errors(0.03, 5e-4, 1e-3)},
    "tactical": {"gyro": Errors(5e-3 * DEGREE, 1e-4 * DEGREE, 1e-3 * DEGREE), "force": Errors(0.01, 5e-5, 3e-4)},
    "perfect": {"gyro": Errors(0.0, 0.0, 0.0), "force": Errors(0.0, 0.0, 0.0)},
}
"""Orders of magnitude of data sheets: phones and small drones, better drones, aircraft."""


class Imu(Section):
    """A gyroscope and an accelerometer in the middle of a body, along its axes.

    What is not given follows from the grade. Consumer: 0.5 deg/s and 0.1 m/s^2 of constant bias an axis, 0.01 deg/s and
    0.003 m/s^2 a root of Hz of noise; industrial: 0.1, 0.03, 0.005, 0.001; tactical: 0.005, 0.01, 0.001, 0.0003. Biases
    walk, too.
    """

    grade: Literal["consumer", "industrial", "tactical", "perfect"] = Field(
        "consumer", description="How good it is: consumer, industrial, tactical or perfect."
    )
    rate_hz: Positive = Field(200.0, description="Readings a second.")
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
        0.0, description="What propellers add to each reading of the accelerometer, standard deviation."
    )

    def errors(self, which: str) -> Errors:
        """Return the errors of the "gyro" or of the "force", in SI units."""
        bias, wander, noise = GRADES[self.grade][which]
        if which == "gyro":
            own = self.gyro_bias_dps, self.gyro_noise_dps_per_sqrt_hz
            given = [None if value is None else DEGREE * value for value in own]
        else:
            given = [self.accel_bias_mps2, self.accel_noise_mps2_per_sqrt_hz]
        return Errors(bias if given[0] is None else given[0], wander, noise if given[1] is None else given[1])


class Height(Section):
    """A sensor of the height of a body's middle above the world's zero."""

    rate_hz: Positive = Field(30.0, description="Readings a second.")
    noise_m: NotNegative = Field(0.02, description="White noise of a reading, standard deviation.")
    bias_m: NotNegative = Field(0.0, description="Standard deviation of its constant bias.")
