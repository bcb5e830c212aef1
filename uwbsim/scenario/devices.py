"""The boards of a scenario: tags with antenna delays and clocks, temperature, supply voltage, group delay."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from uwblink.arrays import Floats
from uwblink.errors import PlanError, restating
from uwblink.recording.antenna_delays import REGISTER_MAX, delay_of, load_antenna_delays
from uwblink.ticks import ANTENNA_DELAY_TICKS, TICK_S, TX_SHARE
from uwbsim.errors import ScenarioError
from uwbsim.scenario.base import Increasing, NotNegative, Positive, Section, TagId, Vector, require
from uwbsim.scenario.bodies import Height, Imu, Motion, Shadow


class Constant(Section):
    """The same all the time; a number alone means this."""

    model: Literal["constant"] = Field("constant", description="The same all the time.")
    value: float = Field(description="Its value.")

    def at(self, time_s: Floats) -> Floats:
        """Return the value at times (n,)."""
        return np.full(time_s.shape, self.value)


class Ramp(Section):
    """From one value to another, evenly, over `duration_s` from `begin_s` on; constant before and after."""

    model: Literal["ramp"] = Field(description="From one value to another, evenly.")
    start: float = Field(description="The value before.")
    end: float = Field(description="The value after.")
    duration_s: Positive = Field(description="How long it takes.")
    begin_s: float = Field(0.0, description="When it begins.")

    def at(self, time_s: Floats) -> Floats:
        """Return the values at times (n,)."""
        return np.asarray(
            self.start + (self.end - self.start) * np.clip((time_s - self.begin_s) / self.duration_s, 0, 1)
        )


class WarmUp(Section):
    """From one value towards another exponentially: the difference shrinks by e in every `time_constant_s`.

    Constant before `begin_s`; a negative one means that part of it is over when the run begins.
    """

    model: Literal["warm-up"] = Field(description="From one value towards another, exponentially.")
    start: float = Field(description="The value before.")
    end: float = Field(description="The value in the limit.")
    time_constant_s: Positive = Field(description="Time in which the difference decreases by the factor e.")
    begin_s: float = Field(0.0, description="When it begins; negative: part of it is over when the run begins.")

    def at(self, time_s: Floats) -> Floats:
        """Return the values at times (n,)."""
        left = np.exp(-np.maximum(time_s - self.begin_s, 0) / self.time_constant_s)
        return np.asarray(self.end + (self.start - self.end) * left)


class ProfileTable(Section):
    """Values at times, linear between them and constant beyond: given here, or read from a CSV file.

    The file has the columns time_s and the key that it stands at, temperature_c or supply_v.
    """

    model: Literal["table"] = Field(description="Values at times.")
    file: str | None = Field(
        None,
        description="CSV file with the columns time_s and the key that it stands at; times_s and values are then read "
        "from it.",
    )
    times_s: Increasing = Field(description="When; increasing.")
    values: tuple[float, ...] = Field(description="The value at each of these times.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        matched = self.times_s and len(self.times_s) == len(self.values)
        require(matched, f"values: found {len(self.values)} at {len(self.times_s)} times, give one a time")
        return self

    def at(self, time_s: Floats) -> Floats:
        """Return the values at times (n,)."""
        return np.asarray(np.interp(time_s, self.times_s, self.values))


def _constant(value: Any) -> Any:
    return {"model": "constant", "value": value} if isinstance(value, int | float) else value


Profile = Annotated[
    Annotated[Constant | Ramp | WarmUp | ProfileTable, Field(discriminator="model")], BeforeValidator(_constant)
]
"""A quantity as a function of time."""


class Devices(Section):
    """Effects of temperature and supply voltage on boards, and the boards' readings of them.

    A tag's antenna delay grows by twice what each end of a range lengthens it, 0.44 of it before transmissions and 0.56
    in receptions. Typical values are from the DW1000's manual (8.3.1), which gives no sign. Tags may have their own.
    Where tags have a temperature or a voltage, the recording has their readings.
    """

    range_mm_per_k: float = Field(
        0.0,
        description="Increase of a range per tag and kelvin above reference_c (typically 2.15 by the DW1000's manual).",
    )
    range_cm_per_v: float = Field(
        0.0,
        description="Increase of a range per tag and volt above reference_v (typically 5.35 by the DW1000's manual).",
    )
    skew_ppm_per_k: float = Field(0.0, description="Increase of clocks' rates per kelvin above reference_c.")
    reference_c: float = Field(23.0, description="The temperature at which delays and skews are as the tags say.")
    reference_v: float = Field(3.3, description="The supply voltage at which delays are as the tags say.")
    readings_hz: Positive = Field(
        1.0,
        description="Readings per second of tags that have a temperature or a voltage.",
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


class DirectionTable(Section):
    """A quantity over azimuth and elevation in the body's frame: a full grid, interpolated linearly.

    `quantity` is the key of its values, a row for each azimuth.
    """

    quantity: ClassVar[str]

    azimuth_deg: tuple[float, ...] = Field(description="Azimuths in the body's frame, from -180 to 180, increasing.")
    elevation_deg: tuple[float, ...] = Field(description="Elevations in the body's frame, from -90 to 90, increasing.")

    @model_validator(mode="after")
    def _check_grid(self) -> Self:
        for axis, values, end in (
            ("azimuth_deg", self.azimuth_deg, 180.0),
            ("elevation_deg", self.elevation_deg, 90.0),
        ):
            rising = all(a < b for a, b in itertools.pairwise(values))
            require(len(values) > 1 and rising, f"{axis}: must increase, and hold two values or more")
            ends = f"{axis}: runs from {values[0]:g} to {values[-1]:g}, expected {-end:g} to {end:g}"
            require((values[0], values[-1]) == (-end, end), ends)
        name, rows = self.quantity, getattr(self, self.quantity)
        found = f"{name}: found {len(rows)} rows, the azimuths are {len(self.azimuth_deg)}"
        require(len(rows) == len(self.azimuth_deg), found)
        count = len(self.elevation_deg)
        for k, row in enumerate(rows):
            require(len(row) == count, f"{name}[{k}]: found {len(row)} values, the elevations are {count}")
        return self


class GroupDelayTable(DirectionTable):
    """Group delay in centimetres over azimuth and elevation in the body's frame: a full grid, interpolated linearly.

    `file` is a CSV table with the columns azimuth_deg, elevation_deg, delay_cm.
    """

    quantity = "delay_cm"

    model: Literal["table"] = Field(description="As a table over directions.")
    file: str | None = Field(
        None,
        description="CSV file with the columns azimuth_deg, elevation_deg, delay_cm; the other keys are then read from "
        "it.",
    )
    delay_cm: tuple[tuple[float, ...], ...] = Field(
        description="A row for each azimuth, a delay in it for each elevation.",
    )
    turned_deg: float = Field(0.0, description="How far the board is turned about the body's z axis.")


GroupDelay = Annotated[GroupDelayHarmonics | GroupDelayTable, Field(discriminator="model")]


Register = Annotated[int, Field(ge=0, le=REGISTER_MAX)]


class Body(Section):
    """A body that carries tags, and may attenuate waves."""

    name: Annotated[str, Field(min_length=1)] = Field(description="Name of the body; names must differ.")
    motion: Motion = Field(description="How it moves.")
    shadow: Shadow | None = Field(
        None,
        description="The part of it that attenuates waves; by default none.",
    )
    temperature_c: Profile | None = Field(
        None,
        description="Temperature over time of its tags, unless they have their own.",
    )
    supply_v: Profile | None = Field(
        None,
        description="Supply voltage over time of its tags, unless they have their own.",
    )
    imu: Imu | None = Field(None, description="Its inertial sensor, whose readings the recording has.")
    height: Height | None = Field(None, description="Its height sensor, whose readings the recording has.")


class Programmed(Section):
    """Antenna delays that are programmed into a board, in ticks of 15.65 ps.

    The chip adds `tx` to the stamps of what it sends, and takes `rx` from those of what it receives. The firmware works
    out the stamp of a reply that it schedules, with a constant of its build, `reply`.
    """

    tx: Register = Field(ANTENNA_DELAY_TICKS, description="Register of the transmitter.")
    rx: Register = Field(ANTENNA_DELAY_TICKS, description="Register of the receiver.")
    reply: Register = Field(ANTENNA_DELAY_TICKS, description="Constant in the stamps of delayed replies (TX_ANT_DLY).")


class ScenarioTag(Section):
    """A board: where it sits, its antenna delay and its clock.

    Give the aggregate `delay_ns` = transmit - receive, split 0.44 / 0.56, or both parts. What temperature and voltage
    do to a tag is in `Devices`.
    """

    id: TagId = Field(description="Id of the board; ids must differ.")
    body: str = Field(description="Name of the body that carries it.")
    lever_arm_m: Vector = Field((0.0, 0.0, 0.0), description="Position of its antenna in the frame of the body.")
    delay_ns: float | None = Field(
        None,
        description="Aggregate antenna delay, transmit less receive, split 0.44 / 0.56; 0 where no delay is given.",
    )
    tx_delay_ns: float | None = Field(
        None,
        description="Delay added to transmit stamps; requires rx_delay_ns, excludes delay_ns.",
    )
    rx_delay_ns: float | None = Field(
        None,
        description="Delay added to receive stamps; requires tx_delay_ns, excludes delay_ns.",
    )
    antenna_delay: Programmed = Field(
        Programmed(),
        description="Antenna delays programmed into the board; delay_ns is relative to the default of 16436 ticks.",
    )
    skew_ppm: Annotated[float, Field(ge=-100, le=100)] = Field(
        0.0,
        description="Rate of the clock relative to true time at the start.",
    )
    drift_ppm_per_sqrt_s: NotNegative = Field(
        0.0,
        description="Random walk of the clock's rate (Allan deviation q sqrt(tau/3)).",
    )
    white_ppm_sqrt_s: NotNegative = Field(
        0.0,
        description="White noise of the clock's rate (Allan deviation h/sqrt(tau)).",
    )
    flicker_ppm: NotNegative = Field(
        0.0,
        description="Flicker noise of the clock's rate (the same Allan deviation at every tau).",
    )
    ramp_ppm_per_s: float = Field(0.0, description="Steady change of the clock's rate.")
    warm_up_ppm: float = Field(
        0.0,
        description="Amplitude of an exponential transient of the clock's rate.",
    )
    warm_up_s: Positive = Field(60.0, description="Time constant of that transient.")
    temperature_c: Profile | None = Field(
        None,
        description="Its temperature over time; by default that of its body.",
    )
    supply_v: Profile | None = Field(
        None,
        description="Its supply voltage over time; by default that of its body.",
    )
    range_mm_per_k: float | None = Field(None, description="Overrides devices.range_mm_per_k for this tag.")
    range_cm_per_v: float | None = Field(None, description="Overrides devices.range_cm_per_v for this tag.")
    skew_ppm_per_k: float | None = Field(None, description="Overrides devices.skew_ppm_per_k for this tag.")
    group_delay: GroupDelay | None = Field(
        None,
        description="Group delay of its antenna over direction; by default radio.group_delay.",
    )
    passive: bool = Field(
        False,
        description="Whether it records the exchanges that it overhears; with plan broadcast, whether it only listens.",
    )
    tx_power_db: float = Field(0.0, description="Offset of its transmit power.")
    power_offset_db: float = Field(0.0, description="Offset of its power readings.")
    pattern_db: tuple[float, ...] = Field(
        (),
        description="Gain of its antenna relative to radio.antenna by direction in its body's frame: 1, 4, 9, 16 or 25 "
        "coefficients of real spherical harmonics of degree 0, 1 and so on (m from -l to l), whose root "
        "mean square over all directions is one.",
    )
    clock_offset_s: NotNegative | None = Field(
        None,
        description="Reading of its clock at the start of the run; by default drawn from the seed.",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        parts = (self.tx_delay_ns is not None, self.rx_delay_ns is not None)
        either = not any(parts) or (all(parts) and self.delay_ns is None)
        require(either, "delay_ns: give it alone, or both tx_delay_ns and rx_delay_ns instead")
        found = f"pattern_db: found {len(self.pattern_db)} coefficients"
        require(len(self.pattern_db) in (0, 1, 4, 9, 16, 25), f"{found}, expected 1, 4, 9, 16, 25 or none")
        return self

    def delays_ns(self) -> tuple[float, float]:
        """Return the errors of a transmit and of a receive stamp, in nanoseconds.

        These are the antenna's delays, and differences of the programmed delays from 16436 ticks.
        """
        aggregate = self.delay_ns or 0.0
        transmit = TX_SHARE * aggregate if self.tx_delay_ns is None else self.tx_delay_ns
        receive = (TX_SHARE - 1) * aggregate if self.rx_delay_ns is None else self.rx_delay_ns
        more = [
            (ticks - ANTENNA_DELAY_TICKS) * TICK_S / 1e-9 for ticks in (self.antenna_delay.tx, self.antenna_delay.rx)
        ]
        return transmit + more[0], receive - more[1]


def with_antenna_delays(tags: tuple[ScenarioTag, ...], path: Path) -> tuple[ScenarioTag, ...]:
    """Return tags with the antenna delays of a file programmed into them; raises `ScenarioError`."""
    with restating(ScenarioError, PlanError):
        delays = load_antenna_delays(path)
    found = {tag.id: delay_of(delays, tag.id) for tag in tags}
    programmed = {tag: Programmed(**one._asdict()) for tag, one in found.items() if one is not None}
    return tuple(tag.model_copy(update={"antenna_delay": programmed.get(tag.id, tag.antenna_delay)}) for tag in tags)
