"""Reception of frames: time of arrival, receive stamp, detection, and the readings that boards print.

Simulated flights, served boards and passive listeners call `Medium.receive`. Comparisons of protocols need the
distribution of stamps instead of random values: they call `stamp_errors_s`, which `receive` also uses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT, TX_SHARE
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import Radio
from uwbsim.world.channel import Link
from uwbsim.world.clocks import SUBTICKS, SUBTICKS_PER_SECOND, Clocks, RangeEffect, range_effects
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
    """Errors of stamps by the antenna delays of tags, by the tags' indices in the scenario.

    `fixed` (tags, 2) are the errors of transmit and receive stamps at the reference temperature and voltage, in
    seconds; the delays of the tags in `variable` depend on both. A range increases by x if the tag's aggregate delay,
    transmit minus receive, decreases by 2 x/c: 0.44 of this delays transmissions relative to their stamps, and 0.56
    delays receive stamps.
    """

    fixed: Floats
    variable: dict[int, list[RangeEffect]]

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the antenna delays of a scenario's tags."""
        variable = {k: found for k, tag in enumerate(scenario.tags) if (found := range_effects(scenario, tag))}
        return cls(np.array([tag.delays_ns() for tag in scenario.tags]) * 1e-9, variable)

    def transmit_s(self, tag: Ints, time: Ints) -> Floats:
        """Return the errors of the transmit stamps of tags (n,) at true times (n,) in sub-ticks, in seconds."""
        return np.asarray(self.fixed[tag, 0] - TX_SHARE * self._variable_s(tag, time))

    def receive_s(self, tag: Ints, time: Ints) -> Floats:
        """Return the errors of the receive stamps of tags (n,) at true times (n,) in sub-ticks, in seconds."""
        return np.asarray(self.fixed[tag, 1] + (1 - TX_SHARE) * self._variable_s(tag, time))

    def _variable_s(self, tag: Ints, time: Ints) -> Floats:
        """Return the effect of temperature and voltage on a transmission and a reception together, (n,) seconds."""
        total = np.zeros(len(tag))
        for place, effects in self.variable.items():
            rows = np.flatnonzero(tag == place)
            time_s = time[rows] / SUBTICKS_PER_SECOND
            shift_m = np.sum([slope * (profile.at(time_s) - ref) for profile, slope, ref in effects], axis=0)
            total[rows] = 2 * shift_m / SPEED_OF_LIGHT
        return total


def stamp_errors_s(radio: Radio, link: Link) -> tuple[Floats, Floats]:
    """Return bias and standard deviation of the receive stamps of frames on n links, in seconds, (n,) each."""
    seen_dbm = reported_dbm(radio, link.power_dbm)
    std_s = reception_noise_s(radio, seen_dbm)
    bias_s = reception_bias_s(radio, seen_dbm, link.total_dbm)
    return bias_s, std_s if link.noise_s is None else np.hypot(std_s, link.noise_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """n frames on the air: indices of senders and receivers, and true sub-ticks of departure, (n,) each."""

    sender: Ints
    receiver: Ints
    departure: Ints


class Medium:
    """The links, the clocks and the antenna delays of a scenario.

    `tx_register` and `reply_constant` (tags,) are the programmed antenna delays, in ticks.
    """

    def __init__(self, scenario: Scenario, links: World | SampledWorld) -> None:
        """Draw the clocks."""
        self.scenario, self.links = scenario, links
        self.clocks, self.delays = Clocks.of(scenario), AntennaDelays.of(scenario)
        self.tx_register = np.array([tag.antenna_delay.tx for tag in scenario.tags], dtype=np.int64)
        self.reply_constant = np.array([tag.antenna_delay.reply for tag in scenario.tags], dtype=np.int64)

    def leave(self, sender: Ints, stamp: Ints, noise: Floats) -> Ints:
        """Return the true sub-ticks (n,) of departure of frames with transmit stamps in whole ticks (n,).

        A transmit stamp is the chip's counter at departure plus its register. `noise` is standard normal, (n,).
        """
        due = stamp * SUBTICKS
        # Temperature and voltage do not change within the antenna delay.
        now = self.clocks.when(sender, due) if self.delays.variable else due
        delay = self.delays.transmit_s(sender, now)
        early = noise * (self.scenario.radio.tx_noise_ps * 1e-12) * SUBTICKS_PER_SECOND - delay * SUBTICKS_PER_SECOND
        return self.clocks.when(sender, np.rint(early).astype(np.int64) + due)

    def receive(self, frames: Frames, noise: Floats, detour_m: Floats | float = 0.0) -> tuple[Ints, Link]:
        """Return the receive stamps of frames (n,), whole ticks of their clocks, not wrapped; and the links.

        `noise` is standard normal, (n,), `detour_m` a random additional path length.
        """
        link = self.links.link(frames.sender, frames.receiver, frames.departure)
        bias_s, std_s = stamp_errors_s(self.scenario.radio, link)
        flight_s = (link.distance_m + link.excess_m) / SPEED_OF_LIGHT
        detour = np.asarray(detour_m) / SPEED_OF_LIGHT * SUBTICKS_PER_SECOND
        flight = np.rint(flight_s * SUBTICKS_PER_SECOND + detour).astype(np.int64)
        arrives = frames.departure + flight
        delay = self.delays.receive_s(frames.receiver, arrives) * SUBTICKS_PER_SECOND
        shift = np.rint((bias_s + noise * std_s) * SUBTICKS_PER_SECOND + delay).astype(np.int64)
        reading = self.clocks.read(frames.receiver, arrives)
        return (reading + shift + SUBTICKS // 2) // SUBTICKS, link

    def heard(self, power_dbm: Floats, fading: Floats | float = 0.0) -> Bools:
        """Return which frames are above the sensitivity, with power noise; `fading` is standard normal."""
        radio = self.scenario.radio
        return np.asarray(power_dbm + fading * radio.power_noise_db >= radio.sensitivity_dbm)

    def readings(
        self, frames: Frames, power_dbm: Floats, power_noise: Floats, skew_noise: Floats
    ) -> tuple[Floats, Floats]:
        """Return first-path power in dBm and relative skew in ppm as receivers print them; noises are
        standard normal.
        """
        radio, clocks, time = self.scenario.radio, self.clocks, frames.departure
        skew = (clocks.rate(frames.receiver, time) - clocks.rate(frames.sender, time)) * 1e6
        offsets = np.array([tag.power_offset_db for tag in self.scenario.tags])
        read_dbm = power_dbm + offsets[frames.receiver]
        return printed_power_dbm(radio, read_dbm, power_noise), printed_skew_ppm(radio, skew, skew_noise, power_dbm)
