"""The boards of a scenario as devices: temperature, supply voltage, and group delay over direction."""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from uwbsim.scenario.base import NotNegative, Positive, Section


class Constant(Section):
    """The same all the time; a number alone means this."""

    model: Literal["constant"] = "constant"
    value: float


class Ramp(Section):
    """From one value to another, evenly, over `duration_s` from `begin_s` on; constant before and after."""

    model: Literal["ramp"]
    start: float
    end: float
    duration_s: Positive
    begin_s: float = 0.0


class WarmUp(Section):
    """From one value to another as what is heated does: the distance shrinks by e in every `time_constant_s`.

    Constant before `begin_s`; a negative one means that part of it is over when the run begins.
    """

    model: Literal["warm-up"]
    start: float
    end: float
    time_constant_s: Positive
    begin_s: float = 0.0


class Table(Section):
    """Values at times, linear between them and constant beyond: given here, or read from a CSV file.

    The file has the columns time_s and the key that it stands at, temperature_c or supply_v.
    """

    model: Literal["table"]
    file: str | None = None
    times_s: tuple[float, ...]
    values: tuple[float, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.times_s or len(self.times_s) != len(self.values):
            raise ValueError(f"values: found {len(self.values)} at {len(self.times_s)} times, give one a time")
        if any(b <= a for a, b in itertools.pairwise(self.times_s)):
            raise ValueError("times_s: must increase")
        return self


def _constant(value: Any) -> Any:
    return {"model": "constant", "value": value} if isinstance(value, int | float) else value


Profile = Annotated[
    Annotated[Constant | Ramp | WarmUp | Table, Field(discriminator="model")], BeforeValidator(_constant)
]
"""Something over the time of a run."""


class Devices(Section):
    """What temperature and supply voltage do to boards, and what boards tell of them.

    `range_mm_per_k` and `range_cm_per_v` are by how much each of the two tags of a range lengthens it, a kelvin above
    `reference_c` and a volt above `reference_v`: its antenna delay grows by twice that way, 0.44 of it before
    transmissions and 0.56 in receptions. The DW1000's manual (8.3.1) calls 2.15 mm and 5.35 cm typical, without a sign.
    `skew_ppm_per_k` is what a kelvin adds to the rate of clocks. Tags may have their own. Where tags have a temperature
    or a voltage, the recording has their readings `readings_hz` times a second, with noise.
    """

    range_mm_per_k: float = 0.0
    range_cm_per_v: float = 0.0
    skew_ppm_per_k: float = 0.0
    reference_c: float = 23.0
    reference_v: float = 3.3
    readings_hz: Positive = 1.0
    reading_noise_k: NotNegative = 0.0
    reading_noise_v: NotNegative = 0.0


class GroupDelayHarmonics(Section):
    """Group delay of an antenna over direction, in centimetres of way, as low-order harmonics of azimuth.

    mean + sum over k of (cosine_cm[k-1] cos k a + sine_cm[k-1] sin k a) cos e + elevation_cm sin e, with azimuth a and
    elevation e in the frame of the body; `turned_deg` is how far the board is turned about the body's z axis.
    """

    model: Literal["harmonics"]
    mean_cm: float = 0.0
    cosine_cm: tuple[float, ...] = ()
    sine_cm: tuple[float, ...] = ()
    elevation_cm: float = 0.0
    turned_deg: float = 0.0


class GroupDelayTable(Section):
    """Group delay in centimetres over azimuth and elevation in the body's frame: a full grid, interpolated linearly.

    `file` is a CSV table with the columns azimuth_deg, elevation_deg, delay_cm.
    """

    model: Literal["table"]
    file: str | None = None
    azimuth_deg: tuple[float, ...]
    elevation_deg: tuple[float, ...]
    delay_cm: tuple[tuple[float, ...], ...]
    turned_deg: float = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_grid(self.azimuth_deg, self.elevation_deg, "delay_cm", self.delay_cm)
        return self


GroupDelay = Annotated[GroupDelayHarmonics | GroupDelayTable, Field(discriminator="model")]


def check_grid(
    azimuth_deg: tuple[float, ...], elevation_deg: tuple[float, ...], name: str, rows: tuple[tuple[float, ...], ...]
) -> None:
    """Raise `ValueError` where azimuths by elevations are no full grid of all directions, with a value each."""
    for axis, values, low, high in (
        ("azimuth_deg", azimuth_deg, -180.0, 180.0),
        ("elevation_deg", elevation_deg, -90.0, 90.0),
    ):
        if len(values) < 2 or any(b <= a for a, b in itertools.pairwise(values)):
            raise ValueError(f"{axis}: must increase, and hold two values or more")
        if values[0] != low or values[-1] != high:
            raise ValueError(f"{axis}: runs from {values[0]:g} to {values[-1]:g}, expected {low:g} to {high:g}")
    if len(rows) != len(azimuth_deg):
        raise ValueError(f"{name}: found {len(rows)} rows, the azimuths are {len(azimuth_deg)}")
    for k, row in enumerate(rows):
        if len(row) != len(elevation_deg):
            raise ValueError(f"{name}[{k}]: found {len(row)} values, the elevations are {len(elevation_deg)}")
