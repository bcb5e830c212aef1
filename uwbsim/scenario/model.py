"""The scenario: what a TOML file may say, validated. Units are in the key names, and leave here as SI properties.

`uwbsim.scenario.loading.load` turns every mistake into one `ScenarioError` line; the models here and in `radio` and
`motion` are the whole schema.
"""

from __future__ import annotations

from itertools import combinations
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from uwblink.arrays import Floats
from uwblink.protocols.table import PROTOCOLS
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.scenario.airtime import TURNAROUND_S, exchange_air_s, exchange_s
from uwbsim.scenario.base import NotNegative, Positive, Section, TagId, Vector
from uwbsim.scenario.devices import Devices, GroupDelay, Profile
from uwbsim.scenario.motion import Motion, RandomFlight, Static, Waypoints
from uwbsim.scenario.radio import GeometricMultipath, Obstacle, Radio, Room, Shadow, Spline, TwoStateMultipath
from uwbsim.units import MS, NS, PPM, US

ProtocolName = Annotated[str, Field(json_schema_extra=lambda schema: schema.update(enum=sorted(PROTOCOLS)))]
MEDIAN_REPLY_S: Final = 305e-6
"""Of boards that reply at once, the median measured (firmware wire format, 3.4)."""

PlanName = Literal["round-robin", "tdma", "aloha", "common-list"]

PATTERN_SIZES: Final = (0, 1, 4, 9, 16, 25)
"""How many spherical harmonics there are up to a degree."""

UUS_S: Final = 512 / 499.2e6
WAVELENGTH_M: Final = SPEED_OF_LIGHT / 3993.6e6


class RunSettings(Section):
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

    @property
    def delay_s(self) -> float:
        """Return the latency in seconds."""
        return self.delay_us * US


class QuantileReply(Section):
    """Reply latencies by their quantiles, from 0 to 1 in equal steps, with all values in between equally likely."""

    model: Literal["quantiles"]
    delays_us: Annotated[tuple[Annotated[float, Field(ge=180, le=6000)], ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if list(self.delays_us) != sorted(self.delays_us):
            raise ValueError("delays_us: must not decrease")
        return self

    def at_s(self, share: Floats) -> Floats:
        """Return the latencies in seconds that shares (n,) of all replies stay below."""
        levels = np.linspace(0, 1, len(self.delays_us))
        return np.asarray(np.interp(share, levels, self.delays_us) * US)


class PlanFile(Section):
    """A plan from a CSV file with the columns time_s, initiator, target; `slots` is filled in on reading.

    Slots after the end of the run are not flown, so that a long plan can be flown for a while.
    """

    file: str
    slots: tuple[tuple[float, int, int], ...] = ()


class Ranging(Section):
    """Who ranges with whom, how, and how often.

    `response_delay_uus` is the boards' C08 setting, in UWB microseconds (1.0256 us): the delay of
    the scheduled message. `pairs` are (initiator, target). `rate_hz` counts all exchanges together.
    """

    protocol: ProtocolName = "ds"
    rate_hz: Positive
    pairs: Literal["between-bodies"] | tuple[tuple[TagId, TagId], ...] = "between-bodies"
    plan: PlanName | PlanFile = "round-robin"
    sync_error_ms: NotNegative = 0.1
    list_timeout_ms: NotNegative = 10.0
    response_delay_uus: Annotated[int, Field(ge=280, le=6500)] = 1500
    reply: Annotated[BoardReply | FixedReply | QuantileReply, Field(discriminator="model")] = BoardReply()
    get_cir: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.protocol not in PROTOCOLS:
            raise ValueError(f"protocol: found {self.protocol!r}, allowed: {', '.join(PROTOCOLS)}")
        if self.pairs == ():
            raise ValueError("pairs: found none, give at least one [initiator, target]")
        for pair in self.pairs if self.pairs != "between-bodies" else ():
            if pair[0] == pair[1]:
                raise ValueError(f"pairs: tag {pair[0]} cannot range with itself")
        return self

    @property
    def sync_error_s(self) -> float:
        """Return the standard deviation of hosts' clocks in seconds."""
        return self.sync_error_ms * MS

    @property
    def list_timeout_s(self) -> float:
        """Return in seconds how long a robot waits for an exchange that it cannot hear."""
        return self.list_timeout_ms * MS

    @property
    def scheduled_s(self) -> float:
        """Return the delay of the scheduled message in seconds."""
        return self.response_delay_uus * UUS_S

    @property
    def at_once_s(self) -> float:
        """Return the median latency of a reply at once, in seconds."""
        if self.reply.model == "fixed":
            return self.reply.delay_s
        return float(self.reply.at_s(np.array(0.5))) if self.reply.model == "quantiles" else MEDIAN_REPLY_S

    def fastest_hz(self, preamble_symbols: int) -> float:
        """Return how many exchanges a second one after the other allow."""
        row = PROTOCOLS[self.protocol]
        return 1 / (exchange_s(row, preamble_symbols, self.scheduled_s, self.at_once_s) + TURNAROUND_S)

    def air_share(self, preamble_symbols: int) -> float:
        """Return the share of time for which the plan keeps the air busy."""
        return self.rate_hz * exchange_air_s(PROTOCOLS[self.protocol], preamble_symbols)


class Mocap(Section):
    """The motion capture that writes the poses of the recording.

    Its times are late by `latency_ms`; `gaps_per_min` times a minute it loses sight of each body for `gap_s`.
    """

    rate_hz: Positive = 100.0
    position_noise_m: NotNegative = 0.0
    attitude_noise_rad: NotNegative = 0.0
    latency_ms: float = 0.0
    gaps_per_min: NotNegative = 0.0
    gap_s: Positive = 0.5

    @property
    def latency_s(self) -> float:
        """Return in seconds how late its times are."""
        return self.latency_ms * MS


class Body(Section):
    """Something that carries tags, and may stand in the way of waves.

    `temperature_c` and `supply_v` are those of its tags that have none of their own.
    """

    name: Annotated[str, Field(min_length=1)]
    motion: Motion
    shadow: Shadow | None = None
    temperature_c: Profile | None = None
    supply_v: Profile | None = None


class Tag(Section):
    """A board: where it sits, its antenna delay and its clock.

    Give the aggregate `delay_ns` = transmit - receive, split 0.44 / 0.56, or both parts.
    The clock: `drift_ppm_per_sqrt_s` is the random walk of its rate (Allan deviation q sqrt(tau/3)),
    `white_ppm_sqrt_s` white noise of its rate (Allan deviation h/sqrt(tau)), `flicker_ppm` flicker noise of its rate
    (the same Allan deviation at every tau), `ramp_ppm_per_s` what a change of temperature adds; `warm_up_ppm` is how
    much faster it runs at first, by a transient that decays by e in every `warm_up_s`. A `passive` tag records
    the exchanges that it overhears. `tx_power_db` is how much stronger than others it sends, `power_offset_db` how much
    too high it reads powers. `pattern_db` is what its own antenna adds to `radio.antenna` by direction in its body's
    frame: coefficients of real spherical harmonics of degree 0, 1 and so on, whose root mean square over all directions
    is one (m from -l to l; 1, 4, 9, 16 or 25 of them).
    `temperature_c` and `supply_v` are its own, or those of its body; what they do to it is in `Devices`, and
    `range_mm_per_k`, `range_cm_per_v`, `skew_ppm_per_k` take the place of what is said there.
    """

    id: TagId
    body: str
    lever_arm_m: Vector = (0.0, 0.0, 0.0)
    delay_ns: float | None = None
    tx_delay_ns: float | None = None
    rx_delay_ns: float | None = None
    skew_ppm: Annotated[float, Field(ge=-100, le=100)] = 0.0
    drift_ppm_per_sqrt_s: NotNegative = 0.0
    white_ppm_sqrt_s: NotNegative = 0.0
    flicker_ppm: NotNegative = 0.0
    ramp_ppm_per_s: float = 0.0
    warm_up_ppm: float = 0.0
    warm_up_s: Positive = 60.0
    temperature_c: Profile | None = None
    supply_v: Profile | None = None
    range_mm_per_k: float | None = None
    range_cm_per_v: float | None = None
    skew_ppm_per_k: float | None = None
    group_delay: GroupDelay | None = None
    passive: bool = False
    tx_power_db: float = 0.0
    power_offset_db: float = 0.0
    pattern_db: tuple[float, ...] = ()
    clock_offset_s: NotNegative | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        parts = (self.tx_delay_ns is not None, self.rx_delay_ns is not None)
        if parts[0] != parts[1] or (parts[0] and self.delay_ns is not None):
            raise ValueError("delay_ns: give it alone, or both tx_delay_ns and rx_delay_ns instead")
        if len(self.pattern_db) not in PATTERN_SIZES:
            allowed = ", ".join(map(str, PATTERN_SIZES[1:]))
            raise ValueError(f"pattern_db: found {len(self.pattern_db)} coefficients, expected {allowed} or none")
        return self

    @property
    def antenna_delays_s(self) -> tuple[float, float]:
        """Return what the antenna adds to a transmit and to a receive stamp, in seconds."""
        transmit, receive = self.delays_ns()
        return transmit * NS, receive * NS

    @property
    def skew(self) -> float:
        """Return how much faster than true time the clock runs at first, as a fraction."""
        return self.skew_ppm * PPM

    @property
    def drift_per_sqrt_s(self) -> float:
        """Return the random walk of the clock's rate, as a fraction per root of a second."""
        return self.drift_ppm_per_sqrt_s * PPM

    @property
    def white_sqrt_s(self) -> float:
        """Return the white noise of the clock's rate, as a fraction times the root of a second."""
        return self.white_ppm_sqrt_s * PPM

    @property
    def flicker(self) -> float:
        """Return the Allan deviation of flicker noise of the clock's rate, as a fraction."""
        return self.flicker_ppm * PPM

    @property
    def ramp_per_s(self) -> float:
        """Return what a change of temperature adds to the clock's rate, as a fraction per second."""
        return self.ramp_ppm_per_s * PPM

    def delays_ns(self) -> tuple[float, float]:
        """Return what the antenna adds to a transmit and to a receive stamp, in nanoseconds."""
        if self.tx_delay_ns is not None and self.rx_delay_ns is not None:
            return self.tx_delay_ns, self.rx_delay_ns
        aggregate = self.delay_ns or 0.0
        return 0.44 * aggregate, -0.56 * aggregate


class Scenario(Section):
    """A whole scenario file."""

    run: RunSettings
    ranging: Ranging
    radio: Radio = Radio()
    mocap: Mocap = Mocap()
    devices: Devices = Devices()
    room: Room | None = None
    obstacles: tuple[Obstacle, ...] = ()
    min_separation_m: NotNegative = 0.0
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
        self._check_reflections(ids)
        self._check_geometric()
        self._check_places()
        self._check_plan(ids)
        fastest = self.ranging.fastest_hz(self.radio.preamble_symbols)
        if self.ranging.plan != "aloha" and self.ranging.rate_hz > fastest:
            raise ValueError(
                f"ranging.rate_hz: found {self.ranging.rate_hz:g}, at this response_delay_uus the air allows "
                f"at most {fastest:.0f}"
            )
        if not self.pairs():
            raise ValueError("ranging.pairs: no two tags sit on different bodies, so nobody ranges")
        return self

    def _check_reflections(self, ids: list[int]) -> None:
        """Pairs whose reflections are known must be pairs of tags."""
        model = self.radio.multipath
        for k, known in enumerate(model.pairs if isinstance(model, TwoStateMultipath) else ()):
            for tag_id in known.tags:
                if tag_id not in ids:
                    there = ", ".join(map(str, ids))
                    raise ValueError(f"radio.multipath.pairs[{k}].tags: found tag {tag_id}, the tags are {there}")

    def _check_geometric(self) -> None:
        """The geometric model takes reflections from materials, and needs a room to put things into."""
        model = self.radio.multipath
        if not isinstance(model, GeometricMultipath):
            return
        if self.room and self.room.reflection_loss_db is not None:
            raise ValueError(
                f"room.reflection_loss_db: found {self.room.reflection_loss_db:g}, but in the geometric model surfaces "
                "reflect as room.material does; leave it out"
            )
        if model.scatterers and self.room is None:
            raise ValueError(
                f"radio.multipath.scatterers: found {model.scatterers} and no room to put them into; give room, or 0"
            )

    def _check_places(self) -> None:
        """Bodies must be inside the room, and tags of one body further apart than a wavelength."""
        for k, body in enumerate(self.bodies):
            for key, point in _named_points(body):
                if self.room and any(
                    not lo <= v <= hi for lo, v, hi in zip(self.room.min_m, point, self.room.max_m, strict=True)
                ):
                    raise ValueError(
                        f"bodies[{k}].motion.{key}: found {list(point)}, outside the room "
                        f"{list(self.room.min_m)} to {list(self.room.max_m)}"
                    )
        for a, b in combinations(range(len(self.tags)), 2):
            one, two = self.tags[a], self.tags[b]
            apart = sum((x - y) ** 2 for x, y in zip(one.lever_arm_m, two.lever_arm_m, strict=True)) ** 0.5
            if one.body == two.body and apart < WAVELENGTH_M:
                raise ValueError(
                    f"tags[{b}].lever_arm_m: tags {one.id} and {two.id} of body {one.body!r} are {100 * apart:.1f} cm "
                    f"apart, closer than a wavelength ({100 * WAVELENGTH_M:.1f} cm)"
                )

    def _check_plan(self, ids: list[int]) -> None:
        if isinstance(self.ranging.plan, str):
            return
        for k, (time_s, initiator, target) in enumerate(self.ranging.plan.slots):
            for tag_id in (initiator, target):
                if tag_id not in ids:
                    known = ", ".join(map(str, ids))
                    raise ValueError(f"ranging.plan: slot {k + 1} names tag {tag_id}, the tags are {known}")
            if initiator == target:
                raise ValueError(f"ranging.plan: slot {k + 1} is of tag {initiator} with itself")
            if not time_s >= 0:
                raise ValueError(f"ranging.plan: slot {k + 1} is at {time_s:g} s, before the start")
        first = min(time_s for time_s, _, _ in self.ranging.plan.slots)
        if first > self.run.duration_s:
            raise ValueError(
                f"ranging.plan: its first slot is at {first:g} s, after the end of the run (run.duration_s = "
                f"{self.run.duration_s:g}); fly longer"
            )

    def pairs(self) -> list[tuple[int, int]]:
        """Return the (initiator, target) pairs in the order in which they range."""
        if self.ranging.pairs != "between-bodies":
            return list(self.ranging.pairs)
        return [(a.id, b.id) for a, b in combinations(self.tags, 2) if a.body != b.body]

    def planted(self) -> dict[str, Any]:
        """Return what a calibration of this scenario should find, JSON-ready."""
        delays = {str(t.id): t.delays_ns()[0] - t.delays_ns()[1] for t in self.tags}
        bias = self.radio.bias if isinstance(self.radio.bias, Spline) else None
        sigma = self.radio.sigma
        fields = {"knots", "coefficients", "degree"}
        return {
            "delays_ns": delays,
            "bias_curve": bias.model_dump(mode="json", include=fields) if bias else None,
            "sigma_curve": sigma.model_dump(mode="json", include=fields) if sigma else None,
            "alpha_dbm": -82.0,
        }


def _named_points(body: Body) -> list[tuple[str, Vector]]:
    """The points that a body's motion is known to reach, with their keys."""
    motion = body.motion
    if isinstance(motion, Static):
        return [("position_m", motion.position_m)]
    if isinstance(motion, RandomFlight):
        return [("box_min_m", motion.box_min_m), ("box_max_m", motion.box_max_m)]
    if isinstance(motion, Waypoints):
        return [(f"points_m[{k}]", point) for k, point in enumerate(motion.points_m)]
    return []
