"""The scenario: what a TOML file may say, validated. Units are in the key names and leave here.

`load` turns every mistake into one `ScenarioError` line; the models below are the whole schema.
"""

from __future__ import annotations

from itertools import combinations
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from uwblink.twr import PROTOCOLS

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = tuple[float, float, float]
TagId = Annotated[int, Field(ge=0, le=254)]
ProtocolName = Annotated[str, Field(json_schema_extra={"enum": sorted(PROTOCOLS)})]

# From the last stamp of an exchange until the board answers the next command: start-up of the
# poll, three frames, and the transfer over USB (firmware wire format, 1.5).
OVERHEAD_S = 0.0015
UUS_S = 512 / 499.2e6


class Section(BaseModel):
    """A table of the file: immutable, with no unknown keys, and finite numbers only."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Heading(Section):
    """Name, seed and length of the simulation."""

    name: str = "unnamed"
    seed: Annotated[int, Field(ge=0)] = 0
    duration_s: Positive


class BoardReply(Section):
    """The reply latency measured on boards: two modes near 304 and 306 us, a tail to 386 us."""

    model: Literal["boards"] = "boards"


class FixedReply(Section):
    """A reply latency that is always the same."""

    model: Literal["fixed"]
    delay_us: Annotated[float, Field(ge=180, le=6000)]


class Ranging(Section):
    """Who ranges with whom, how, and how often.

    `response_delay_uus` is the boards' C08 setting, in UWB microseconds (1.0256 us): the delay of
    the scheduled message. `pairs` are (initiator, target).
    """

    protocol: ProtocolName = "ds"
    rate_hz: Positive
    pairs: Literal["between-bodies"] | tuple[tuple[TagId, TagId], ...] = "between-bodies"
    response_delay_uus: Annotated[int, Field(ge=280, le=6500)] = 1500
    reply: Annotated[BoardReply | FixedReply, Field(discriminator="model")] = BoardReply()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.protocol not in PROTOCOLS:
            raise ValueError(f"protocol: found {self.protocol!r}, allowed: {', '.join(PROTOCOLS)}")
        if self.pairs == ():
            raise ValueError("pairs: found none, give at least one [initiator, target]")
        for pair in self.pairs if self.pairs != "between-bodies" else ():
            if pair[0] == pair[1]:
                raise ValueError(f"pairs: tag {pair[0]} cannot range with itself")
        fastest = 1 / (OVERHEAD_S + self.response_delay_uus * UUS_S)
        if self.rate_hz > fastest:
            raise ValueError(f"rate_hz: found {self.rate_hz:g}, at this response_delay_uus at most {fastest:.0f}")
        return self


class Spline(Section):
    """A B-spline over lifted first-path power 10^((fpp_dbm + 82)/10), held constant beyond its ends."""

    knots: tuple[float, ...]
    coefficients: tuple[float, ...]
    degree: Annotated[int, Field(ge=0, le=5)] = 3

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

    reply_ratio: NotNegative = 0.0


class Multipath(Section):
    """The positive tail: with `probability` an exchange travels an exponential excess distance."""

    probability: Annotated[float, Field(ge=0, le=1)]
    mean_excess_m: Positive


class Radio(Section):
    """Power, noise and bias of every radio; the defaults are those of measured boards."""

    first_path_at_1m_dbm: float = -80.0
    path_loss_exponent: NotNegative = 2.0
    antenna: Literal["isotropic", "dipole"] = "isotropic"
    shadowing_db: NotNegative = 0.0
    power_noise_db: NotNegative = 0.0
    sensitivity_dbm: float = -105.0
    tx_noise_ps: NotNegative = 0.0
    rx_noise_ps: NotNegative = 116.0
    skew_noise_ppm: NotNegative = 0.20
    skew_bias_ppm: float = -0.13
    quantize: bool = True
    bias: Spline | None = None
    sigma: SigmaSpline | None = None
    multipath: Multipath | None = None


class Mocap(Section):
    """The motion capture that writes the poses of the recording."""

    rate_hz: Positive = 100.0
    position_noise_m: NotNegative = 0.0
    attitude_noise_rad: NotNegative = 0.0


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
    """A spline through points at times."""

    model: Literal["waypoints"]
    times_s: tuple[float, ...]
    points_m: tuple[Vector, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.times_s) != len(self.points_m) or len(self.times_s) < 2:
            raise ValueError(
                f"points_m: found {len(self.points_m)} points at {len(self.times_s)} times, "
                "give two or more, and one time each"
            )
        if any(b <= a for a, b in zip(self.times_s, self.times_s[1:], strict=False)):
            raise ValueError("times_s: must increase")
        return self


class Static(Section):
    """A body that does not move, such as an anchor."""

    model: Literal["static"]
    position_m: Vector
    yaw_deg: float = 0.0


Motion = Annotated[RandomFlight | Waypoints | Static, Field(discriminator="model")]


class Body(Section):
    """Something that carries tags."""

    name: Annotated[str, Field(min_length=1)]
    motion: Motion


class Tag(Section):
    """A board: where it sits, its antenna delay and its clock.

    Give the aggregate `delay_ns` = transmit - receive, split 0.44 / 0.56, or both parts.
    `drift_ppm_per_sqrt_s` is the random walk of the clock's rate.
    """

    id: TagId
    body: str
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    delay_ns: float | None = None
    tx_delay_ns: float | None = None
    rx_delay_ns: float | None = None
    skew_ppm: Annotated[float, Field(ge=-100, le=100)] = 0.0
    drift_ppm_per_sqrt_s: NotNegative = 0.0
    clock_offset_s: NotNegative | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        parts = (self.tx_delay_ns is not None, self.rx_delay_ns is not None)
        if parts[0] != parts[1] or (parts[0] and self.delay_ns is not None):
            raise ValueError("delay_ns: give it alone, or both tx_delay_ns and rx_delay_ns instead")
        return self

    def delays_ns(self) -> tuple[float, float]:
        """Return what the antenna adds to a transmit and to a receive stamp."""
        if self.tx_delay_ns is not None and self.rx_delay_ns is not None:
            return self.tx_delay_ns, self.rx_delay_ns
        aggregate = self.delay_ns or 0.0
        return 0.44 * aggregate, -0.56 * aggregate


class Scenario(Section):
    """A whole scenario file."""

    scenario: Heading
    ranging: Ranging
    radio: Radio = Radio()
    mocap: Mocap = Mocap()
    bodies: Annotated[tuple[Body, ...], Field(min_length=1)]
    tags: Annotated[tuple[Tag, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [body.name for body in self.bodies]
        ids = [tag.id for tag in self.tags]
        for k, name in enumerate(names):
            if name in names[:k]:
                raise ValueError(f"bodies[{k}].name: found a second {name!r}, names must differ")
        for k, tag in enumerate(self.tags):
            if tag.id in ids[:k]:
                raise ValueError(f"tags[{k}].id: found a second {tag.id}, ids must differ")
            if tag.body not in names:
                raise ValueError(f"tags[{k}].body: found {tag.body!r}, the bodies are {', '.join(names)}")
        for pair in self.ranging.pairs if self.ranging.pairs != "between-bodies" else ():
            for tag_id in pair:
                if tag_id not in ids:
                    known = ", ".join(map(str, ids))
                    raise ValueError(f"ranging.pairs: found tag {tag_id}, the tags are {known}")
        if not self.pairs():
            raise ValueError("ranging.pairs: no two tags sit on different bodies, so nobody ranges")
        return self

    def pairs(self) -> list[tuple[int, int]]:
        """Return the (initiator, target) pairs in the order in which they range."""
        if self.ranging.pairs != "between-bodies":
            return list(self.ranging.pairs)
        return [(a.id, b.id) for a, b in combinations(self.tags, 2) if a.body != b.body]

    def planted(self) -> dict[str, Any]:
        """Return what a calibration of this scenario should find, JSON-ready."""
        delays = {str(t.id): t.delays_ns()[0] - t.delays_ns()[1] for t in self.tags}
        bias, sigma = self.radio.bias, self.radio.sigma
        fields = {"knots", "coefficients", "degree"}
        return {
            "delays_ns": delays,
            "bias_curve": bias.model_dump(mode="json", include=fields) if bias else None,
            "sigma_curve": sigma.model_dump(mode="json", include=fields) if sigma else None,
            "alpha_dbm": -82.0,
        }
