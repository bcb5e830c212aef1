"""The radios of a scenario: power, noise and bias."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from uwbsim.scenario.base import NotNegative, Positive, Section
from uwbsim.scenario.devices import GroupDelay, check_grid
from uwbsim.scenario.multipath import Fading, IndependentMultipath, Multipath, Outages
from uwbsim.scenario.published_curves import BIAS, SIGMA
from uwbsim.units import PS


class Spline(Section):
    """A B-spline over lifted first-path power 10^((fpp_dbm + 82)/10), held constant beyond its ends."""

    knots: tuple[float, ...] = Field(description="Knots over lifted power, not decreasing.")
    coefficients: tuple[float, ...] = Field(
        description="Coefficients in metres, as many as knots less degree less one.",
    )
    degree: Annotated[int, Field(ge=0, le=5)] = Field(3, description="Degree of the pieces.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.knots) != len(self.coefficients) + self.degree + 1:
            raise ValueError(
                f"knots: found {len(self.knots)}, a spline of degree {self.degree} with "
                f"{len(self.coefficients)} coefficients has {len(self.coefficients) + self.degree + 1}"
            )
        if list(self.knots) != sorted(self.knots) or self.knots[0] == self.knots[-1]:
            raise ValueError("knots: must not decrease, and must span a range")
        return self


class SigmaSpline(Spline):
    """Standard deviation of the range in metres, where dt32/dt53 is `reply_ratio`."""

    reply_ratio: NotNegative = Field(
        0.0,
        description="At which dt32/dt53 the curve was measured: the noise of a double-sided range depends on it.",
    )


class BiasTable(Section):
    """Bias in metres at received powers in dBm, linear between them and constant beyond."""

    power_dbm: tuple[float, ...] = Field(description="Received powers, all rising or all falling.")
    bias_m: tuple[float, ...] = Field(description="Bias at each of them.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.power_dbm) != len(self.bias_m) or len(self.power_dbm) < 2:
            raise ValueError(
                f"bias_m: found {len(self.bias_m)} values at {len(self.power_dbm)} powers, give two or more of each"
            )
        steps = [b - a for a, b in zip(self.power_dbm, self.power_dbm[1:], strict=False)]
        if not (all(s > 0 for s in steps) or all(s < 0 for s in steps)):
            raise ValueError("power_dbm: must go one way")
        return self


def _named(known: dict[str, dict[str, Any] | None]) -> Any:
    def look_up(value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if value not in known:
            raise ValueError(f"found {value!r}, known curves are {', '.join(known)}")
        return known[value]

    return BeforeValidator(look_up)


class AntennaTable(Section):
    """Gain in dB over azimuth and elevation in the body's frame: a full grid, interpolated linearly."""

    azimuth_deg: tuple[float, ...] = Field(description="Azimuths in the body's frame, from -180 to 180, increasing.")
    elevation_deg: tuple[float, ...] = Field(description="Elevations in the body's frame, from -90 to 90, increasing.")
    gain_db: tuple[tuple[float, ...], ...] = Field(
        description="A row for each azimuth, a gain in it for each elevation.",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_grid(self.azimuth_deg, self.elevation_deg, "gain_db", self.gain_db)
        return self


class Radio(Section):
    """Power, noise and bias of every radio; the defaults are those of measured boards.

    Sources (firmware wire format, section 5): `rx_noise_ps` and `skew_noise_ppm`, `skew_bias_ppm` from 1833 exchanges
    of MILUV; `sensitivity_dbm` a little below the weakest first path seen there (-104.2 dBm); frame settings those of
    the firmware. `capture_db` and `dynamic_range_db` are typical of the chip's correlator, and not measured here.
    """

    first_path_at_1m_dbm: float = Field(-80.0, description="First-path power at a metre.")
    path_loss_exponent: NotNegative = Field(
        2.0,
        description="By which power of the distance the received power falls; 2 in free space.",
    )
    antenna: Literal["isotropic", "dipole"] | AntennaTable = Field(
        "isotropic",
        description="Gain of all antennas over direction in the frame of the body.",
    )
    shadowing_db: NotNegative = Field(
        0.0,
        description="Standard deviation of what the surroundings of a tag add to its gain over azimuth, smoothly, "
        "drawn for each.",
    )
    power_noise_db: NotNegative = Field(0.0, description="Standard deviation of what is drawn for each reception.")
    saturation_dbm: float | None = Field(
        None,
        description="Where readings of first-path power end; the chip's fall behind above -85, and those of the ICRA "
        "2023 flights end at -80. Nowhere where it is left out.",
    )
    sensitivity_dbm: float = Field(-105.0, description="First-path power below which a frame is not received.")
    tx_noise_ps: NotNegative = Field(0.0, description="Standard deviation of transmissions about their stamps.")
    rx_noise_ps: NotNegative = Field(
        116.0,
        description="Standard deviation of receive stamps that does not depend on power.",
    )
    skew_noise_ppm: NotNegative = Field(0.20, description="Standard deviation of the carrier integrator's reading.")
    skew_bias_ppm: float = Field(-0.13, description="Bias of the carrier integrator's reading at -90 dBm and below.")
    skew_bias_ppm_per_db: float = Field(
        0.0,
        description="By how much that bias grows above -90 dBm of first-path power.",
    )
    carrier_sign: Literal[-1, 1] = Field(
        1,
        description="1 where boards print by how much their clock is ahead of the sender's; -1 where by how much the "
        "sender is.",
    )
    group_delay: GroupDelay | None = Field(
        None,
        description="Group delay of the antennas of all tags that have none of their own.",
    )
    quantize: bool = Field(True, description="Whether stamps are whole ticks, as on boards.")
    preamble_symbols: Literal[64, 128, 256, 512, 1024, 1536, 2048, 4096] = Field(
        128,
        description="Length of the preamble, which is most of the time a frame takes.",
    )
    capture_db: NotNegative = Field(
        6.0,
        description="How much stronger a frame must be than another on the air to be received all the same.",
    )
    dynamic_range_db: Positive = Field(
        15.0,
        description="How far below the strongest path the first one may be and still be found.",
    )
    bias: Annotated[Spline | BiasTable | None, _named(BIAS)] = Field(
        None,
        description="Bias of ranges over power: a spline over lifted power, a table over dBm, or the name of a "
        "published curve.",
    )
    sigma: Annotated[SigmaSpline | None, _named(SIGMA)] = Field(
        None,
        description="Standard deviation of ranges over lifted power: a spline, or the name of a published curve.",
    )
    multipath: Multipath | None = Field(None, description="Reflections; none where it is left out.")
    fading: Fading | None = Field(
        None,
        description="Power that comes and goes with the place; none where it is left out.",
    )
    outages: Outages | None = Field(
        None,
        description="Whiles in which pairs do not hear each other; none where it is left out.",
    )

    @property
    def independent_multipath(self) -> tuple[float, float]:
        """Return probability and mean in metres of detours that are drawn for each exchange alone; zeros for none."""
        if isinstance(self.multipath, IndependentMultipath):
            return self.multipath.probability, self.multipath.mean_excess_m
        return 0.0, 0.0

    @property
    def tx_noise_s(self) -> float:
        """Return the standard deviation of transmissions about their stamps, in seconds."""
        return self.tx_noise_ps * PS

    @property
    def rx_noise_s(self) -> float:
        """Return the standard deviation of receive stamps that does not depend on power, in seconds."""
        return self.rx_noise_ps * PS
