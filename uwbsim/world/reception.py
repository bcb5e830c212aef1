"""How a frame is received: when it arrives, what its receiver stamps, hears and prints.

Flight loop, served boards and passive listeners call `Medium.receive`; the protocol workbench, which needs the
distribution and no draw of it, calls `arrive`, on which `receive` is built.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.scenario.devices import TX_SHARE
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import Radio
from uwbsim.world.channel import Link
from uwbsim.world.clocks import SUBTICKS, SUBTICKS_PER_SECOND, Clocks, lengthening_m
from uwbsim.world.radio import (
    printed_power_dbm,
    printed_skew_ppm,
    reception_bias_s,
    reception_noise_s,
    reported_dbm,
)
from uwbsim.world.world import SampledWorld, World


@dataclass(frozen=True, slots=True)
class AntennaDelays:
    """What antennas add to stamps, of tags by their places in the scenario.

    `fixed` (tags, 2) is what they add to transmit and to receive stamps at the references, in seconds; the tags in
    `moving` are longer or shorter with temperature and voltage. A range is longer by x where the tag's aggregate delay,
    transmit less receive, is shorter by 2 x/c: frames leave later than stamped by 0.44 of that and are stamped later
    than they come by 0.56 of it.
    """

    scenario: Scenario
    fixed: Floats
    moving: tuple[int, ...]

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the antenna delays of a scenario's tags."""
        now = np.zeros(1)
        moving = [k for k, tag in enumerate(scenario.tags) if lengthening_m(scenario, tag, now) is not None]
        return cls(scenario, np.array([tag.delays_ns() for tag in scenario.tags]) * 1e-9, tuple(moving))

    def transmit_s(self, tag: Ints, time: Ints) -> Floats:
        """Return what is added to the transmit stamps of tags (n,) at true times (n,) in sub-ticks, in seconds."""
        return np.asarray(self.fixed[tag, 0] - TX_SHARE * self._longer_s(tag, time))

    def receive_s(self, tag: Ints, time: Ints) -> Floats:
        """Return what is added to the receive stamps of tags (n,) at true times (n,) in sub-ticks, in seconds."""
        return np.asarray(self.fixed[tag, 1] + (1 - TX_SHARE) * self._longer_s(tag, time))

    def _longer_s(self, tag: Ints, time: Ints) -> Floats:
        """Return by how much the ways through the tags' antennas, transmission and reception together, are longer."""
        longer = np.zeros(len(tag))
        for place in self.moving:
            rows = np.flatnonzero(tag == place)
            if len(rows):
                found = lengthening_m(self.scenario, self.scenario.tags[place], time[rows] / SUBTICKS_PER_SECOND)
                longer[rows] = 0.0 if found is None else 2 * found / SPEED_OF_LIGHT
        return longer


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrival:
    """How n frames arrive apart from chance: seconds of flight, and bias and noise of their stamps, (n,) each."""

    flight_s: Floats
    bias_s: Floats
    std_s: Floats


def arrive(radio: Radio, link: Link) -> Arrival:
    """Return what a link does to the stamps of frames that take it."""
    seen_dbm = reported_dbm(radio, link.power_dbm)
    std_s = reception_noise_s(radio, seen_dbm)
    return Arrival(
        flight_s=(link.distance_m + link.excess_m) / SPEED_OF_LIGHT,
        bias_s=reception_bias_s(radio, seen_dbm, link.total_dbm),
        std_s=std_s if link.noise_s is None else np.hypot(std_s, link.noise_s),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """n frames on the air: places of their senders and receivers, and true sub-ticks at which they leave, (n,) each."""

    sender: Ints
    receiver: Ints
    departure: Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class Reception:
    """How n frames are received: stamps in whole ticks of the receivers' clocks, not wrapped, and the links taken."""

    stamp: Ints
    link: Link


@dataclass(frozen=True, slots=True)
class Medium:
    """Everything a frame goes through: the links and the clocks of a scenario, and what stamps of it have added.

    `tx_register` and `reply_constant` (tags,) are what is programmed, in ticks.
    """

    scenario: Scenario
    links: World | SampledWorld
    clocks: Clocks
    delays: AntennaDelays = field(init=False)
    tx_register: Ints = field(init=False)
    reply_constant: Ints = field(init=False)

    def __post_init__(self) -> None:
        """Work out what antennas add to stamps."""
        object.__setattr__(self, "delays", AntennaDelays.of(self.scenario))
        programmed = [tag.antenna_delay for tag in self.scenario.tags]
        object.__setattr__(self, "tx_register", np.array([one.tx for one in programmed], dtype=np.int64))
        object.__setattr__(self, "reply_constant", np.array([one.reply for one in programmed], dtype=np.int64))

    def leave(self, sender: Ints, stamp: Ints, noise: Floats) -> Ints:
        """Return the true sub-ticks (n,) at which frames leave that have transmit stamps of whole ticks (n,).

        These are the chip's, which has added its register to the time at which a frame leaves by its own counter.
        `noise` is standard normal, (n,).
        """
        due = stamp * SUBTICKS
        # When it is, for the temperature, is known well enough without the delay.
        now = self.clocks.when(sender, due) if self.delays.moving else due
        delay = self.delays.transmit_s(sender, now)
        early = noise * (self.scenario.radio.tx_noise_ps * 1e-12) * SUBTICKS_PER_SECOND - delay * SUBTICKS_PER_SECOND
        return self.clocks.when(sender, np.rint(early).astype(np.int64) + due)

    def receive(self, frames: Frames, noise: Floats, detour_m: Floats | float = 0.0) -> Reception:
        """Receive frames (n,); `noise` is standard normal, (n,), `detour_m` how much further they travel by chance."""
        link = self.links.link(frames.sender, frames.receiver, frames.departure)
        arrival = arrive(self.scenario.radio, link)
        detour = np.asarray(detour_m) / SPEED_OF_LIGHT * SUBTICKS_PER_SECOND
        flight = np.rint(arrival.flight_s * SUBTICKS_PER_SECOND + detour).astype(np.int64)
        late_s = arrival.bias_s + noise * arrival.std_s
        arrives = frames.departure + flight
        delay = self.delays.receive_s(frames.receiver, arrives) * SUBTICKS_PER_SECOND
        shift = np.rint(late_s * SUBTICKS_PER_SECOND + delay).astype(np.int64)
        reading = self.clocks.read(frames.receiver, arrives)
        return Reception(stamp=(reading + shift + SUBTICKS // 2) // SUBTICKS, link=link)

    def heard(self, power_dbm: Floats, fading: Floats | float = 0.0) -> Bools:
        """Return which frames are strong enough; `fading` is standard normal, and makes the edge soft."""
        radio = self.scenario.radio
        return np.asarray(power_dbm + fading * radio.power_noise_db >= radio.sensitivity_dbm)

    def readings(
        self, frames: Frames, power_dbm: Floats, power_noise: Floats, skew_noise: Floats
    ) -> tuple[Floats, Floats]:
        """Return first-path power in dBm and relative skew in ppm as receivers print them; noises standard normal."""
        radio, clocks, time = self.scenario.radio, self.clocks, frames.departure
        skew = (clocks.rate(frames.receiver, time) - clocks.rate(frames.sender, time)) * 1e6
        offsets = np.array([tag.power_offset_db for tag in self.scenario.tags])
        read_dbm = power_dbm + offsets[frames.receiver]
        return printed_power_dbm(radio, read_dbm, power_noise), printed_skew_ppm(radio, skew, skew_noise, power_dbm)
