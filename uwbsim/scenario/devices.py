"""The boards of a scenario as devices: temperature, supply voltage, and group delay over direction."""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from uwbsim.scenario.base import NotNegative, Positive, Section


class Constant(Section):
    """The same all the time; a number alone means this."""

    model: Literal["constant"] = Field("constant", description="The same all the time.")
    value: float = Field(description="Its value.")


class Ramp(Section):
    """From one value to another, evenly, over `duration_s` from `begin_s` on; constant before and after."""

    model: Literal["ramp"] = Field(description="From one value to another, evenly.")
    start: float = Field(description="The value before.")
    end: float = Field(description="The value after.")
    duration_s: Positive = Field(description="How long it takes.")
    begin_s: float = Field(0.0, description="When it begins.")


class WarmUp(Section):
    """From one value to another as what is heated does: the distance shrinks by e in every `time_constant_s`.

    Constant before `begin_s`; a negative one means that part of it is over when the run begins.
    """

    model: Literal["warm-up"] = Field(description="From one value to another, ever more slowly.")
    start: float = Field(description="The value before.")
    end: float = Field(description="The value that it comes close to.")
    time_constant_s: Positive = Field(description="In which time the distance shrinks by e.")
    begin_s: float = Field(0.0, description="When it begins; negative: part of it is over when the run begins.")


class Table(Section):
    """Values at times, linear between them and constant beyond: given here, or read from a CSV file.

    The file has the columns time_s and the key that it stands at, temperature_c or supply_v.
    """

    model: Literal["table"] = Field(description="Values at times.")
    file: str | None = Field(
        None,
        description="CSV file with the columns time_s and the key that it stands at; times_s and values are then read "
        "from it.",
    )
    times_s: tuple[float, ...] = Field(description="When; increasing.")
    values: tuple[float, ...] = Field(description="The value at each of these times.")

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

    A tag's antenna delay grows by twice what each end of a range lengthens it, 0.44 of it before transmissions and 0.56
    in receptions. Typical values are from the DW1000's manual (8.3.1), which gives no sign. Tags may have their own.
    Where tags have a temperature or a voltage, the recording has their readings.
    """

    range_mm_per_k: float = Field(
        0.0,
        description="By how much each of the two tags of a range lengthens it, a kelvin above reference_c (typically "
        "2.15 by the DW1000's manual).",
    )
    range_cm_per_v: float = Field(
        0.0,
        description="By how much each of the two tags of a range lengthens it, a volt above reference_v (typically "
        "5.35 by the DW1000's manual).",
    )
    skew_ppm_per_k: float = Field(0.0, description="What a kelvin above reference_c adds to the rate of clocks.")
    reference_c: float = Field(23.0, description="The temperature at which delays and skews are as the tags say.")
    reference_v: float = Field(3.3, description="The supply voltage at which delays are as the tags say.")
    readings_hz: Positive = Field(
        1.0,
        description="How often a tag that has a temperature or a voltage reads it, a second.",
    )
    reading_noise_k: NotNegative = Field(0.0, description="Standard deviation of temperatures read.")
    reading_noise_v: NotNegative = Field(0.0, description="Standard deviation of voltages read.")


class GroupDelayHarmonics(Section):
    """Group delay of an antenna over direction, in centimetres of way, as low-order harmonics of azimuth.

    mean + sum over k of (cosine_cm[k-1] cos k a + sine_cm[k-1] sin k a) cos e + elevation_cm sin e, with azimuth a and
    elevation e in the frame of the body; `turned_deg` is how far the board is turned about the body's z axis.
    """

    model: Literal["harmonics"] = Field(description="As low-order harmonics of azimuth.")
    mean_cm: float = Field(0.0, description="Mean over all directions.")
    cosine_cm: tuple[float, ...] = Field((), description="Factors of cos(k azimuth) cos(elevation), from k = 1 on.")
    sine_cm: tuple[float, ...] = Field((), description="Factors of sin(k azimuth) cos(elevation), from k = 1 on.")
    elevation_cm: float = Field(0.0, description="Factor of sin(elevation).")
    turned_deg: float = Field(0.0, description="How far the board is turned about the body's z axis.")


class GroupDelayTable(Section):
    """Group delay in centimetres over azimuth and elevation in the body's frame: a full grid, interpolated linearly.

    `file` is a CSV table with the columns azimuth_deg, elevation_deg, delay_cm.
    """

    model: Literal["table"] = Field(description="As a table over directions.")
    file: str | None = Field(
        None,
        description="CSV file with the columns azimuth_deg, elevation_deg, delay_cm; the other keys are then read from "
        "it.",
    )
    azimuth_deg: tuple[float, ...] = Field(description="Azimuths in the body's frame, from -180 to 180, increasing.")
    elevation_deg: tuple[float, ...] = Field(description="Elevations in the body's frame, from -90 to 90, increasing.")
    delay_cm: tuple[tuple[float, ...], ...] = Field(
        description="A row for each azimuth, a delay in it for each elevation.",
    )
    turned_deg: float = Field(0.0, description="How far the board is turned about the body's z axis.")

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
