"""Temperature and supply voltage of tags over time, and what they do to antenna delays and to the rates of clocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.random_streams import stream
from uwbsim.scenario.devices import Constant, Devices, Profile, Ramp, Table, WarmUp
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.tags import Tag
from uwbsim.units import CM, MM, NS_PER_S, PPM
from uwbsim.world.true_time import SUBTICKS_PER_SECOND

TX_SHARE: Final = 0.44
"""What of an aggregate delay belongs to transmissions; the rest belongs to receptions (as in `Tag.delays_ns`)."""


def profile_at(profile: Profile, time_s: Floats) -> Floats:
    """Return a profile's values at times (n,)."""
    return np.asarray(_VALUES[type(profile)](profile, np.asarray(time_s, dtype=np.float64)))


def _ramp(p: Ramp, time_s: Floats) -> Floats:
    return np.asarray(p.start + (p.end - p.start) * np.clip((time_s - p.begin_s) / p.duration_s, 0, 1))


def _warm_up(p: WarmUp, time_s: Floats) -> Floats:
    return np.asarray(p.end + (p.start - p.end) * np.exp(-np.maximum(time_s - p.begin_s, 0) / p.time_constant_s))


_VALUES: Final[dict[type, Callable[..., Floats]]] = {
    Constant: lambda p, time_s: np.full(time_s.shape, p.value),
    Ramp: _ramp,
    WarmUp: _warm_up,
    Table: lambda p, time_s: np.interp(time_s, p.times_s, p.values),
}


def temperature_of(scenario: Scenario, tag: Tag) -> Profile | None:
    """Return the temperature of a tag, or of its body; None where it is not known."""
    return tag.temperature_c or next(b.temperature_c for b in scenario.bodies if b.name == tag.body)


def supply_of(scenario: Scenario, tag: Tag) -> Profile | None:
    """Return the supply voltage of a tag, or of its body; None where it is not known."""
    return tag.supply_v or next(b.supply_v for b in scenario.bodies if b.name == tag.body)


def own(tag: Tag, devices: Devices, name: str) -> float:
    """Return what a tag has of a property of all devices: its own, or theirs."""
    mine = getattr(tag, name)
    return float(getattr(devices, name) if mine is None else mine)


def lengthening_m(scenario: Scenario, tag: Tag, time_s: Floats) -> Floats | None:
    """Return by how much a tag lengthens ranges at times (n,) for its temperature and voltage; None for never."""
    devices = scenario.devices
    total: Floats | None = None
    for profile, slope, reference in (
        (temperature_of(scenario, tag), own(tag, devices, "range_mm_per_k") * MM, devices.reference_c),
        (supply_of(scenario, tag), own(tag, devices, "range_cm_per_v") * CM, devices.reference_v),
    ):
        if profile is not None and slope:
            part = slope * (profile_at(profile, time_s) - reference)
            total = part if total is None else total + part
    return total


def thermal_rate(scenario: Scenario, tag: Tag, time_s: Floats) -> Floats:
    """Return what temperature and warm-up add to the rate of a tag's clock at times (n,), as a fraction."""
    rate = tag.warm_up_ppm * PPM * np.exp(-time_s / tag.warm_up_s)
    profile, slope = temperature_of(scenario, tag), own(tag, scenario.devices, "skew_ppm_per_k")
    if profile is not None and slope:
        rate = rate + slope * PPM * (profile_at(profile, time_s) - scenario.devices.reference_c)
    return np.asarray(rate)


def readings(scenario: Scenario) -> dict[str, NDArray[Any]]:
    """Return what tags read of their temperature and voltage over the run: columns of the recording's `temperature`.

    NaN where a tag has only one of the two; empty where no tag has either.
    """
    devices, duration_s = scenario.devices, scenario.run.duration_s
    time_s = np.arange(int(duration_s * devices.readings_hz) + 1) / devices.readings_hz
    noises = devices.reading_noise_k, devices.reading_noise_v
    parts: list[dict[str, NDArray[Any]]] = []
    for tag in scenario.tags:
        profiles = temperature_of(scenario, tag), supply_of(scenario, tag)
        if any(profile is not None for profile in profiles):
            drawn = stream(scenario.run.seed, "temperature readings", tag.id).normal(size=(2, len(time_s)))
            read = [
                np.full(len(time_s), np.nan) if profile is None else profile_at(profile, time_s) + noise * scatter
                for profile, noise, scatter in zip(profiles, noises, drawn, strict=True)
            ]
            time_ns = np.rint(time_s * NS_PER_S).astype(np.int64)
            ids = np.full(len(time_s), tag.id, dtype=np.int64)
            parts.append({"time_ns": time_ns, "tag": ids, "temperature_c": read[0], "supply_v": read[1]})
    if not parts:
        return {}
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(columns["time_ns"], kind="stable")
    return {name: column[order] for name, column in columns.items()}


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
        return cls(scenario, np.array([tag.antenna_delays_s for tag in scenario.tags]), tuple(moving))

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
