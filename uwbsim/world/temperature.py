"""Temperature and supply voltage of tags over time, and what they do to antenna delays and to the rates of clocks."""

from __future__ import annotations

import numpy as np

from uwblink.arrays import Floats
from uwbsim.random_streams import stream
from uwbsim.scenario.devices import Devices, Profile, Ramp, Table, Tag, WarmUp
from uwbsim.scenario.model import Scenario
from uwbsim.tables import Columns, in_time_order


def profile_at(profile: Profile, time_s: Floats) -> Floats:
    """Return a profile's values at times (n,)."""
    time_s = np.asarray(time_s, dtype=np.float64)
    if isinstance(profile, Ramp):
        share = np.clip((time_s - profile.begin_s) / profile.duration_s, 0, 1)
        return np.asarray(profile.start + (profile.end - profile.start) * share)
    if isinstance(profile, WarmUp):
        left = np.exp(-np.maximum(time_s - profile.begin_s, 0) / profile.time_constant_s)
        return np.asarray(profile.end + (profile.start - profile.end) * left)
    if isinstance(profile, Table):
        return np.asarray(np.interp(time_s, profile.times_s, profile.values))
    return np.full(time_s.shape, profile.value)


def profile_of(scenario: Scenario, tag: Tag, key: str) -> Profile | None:
    """Return the `temperature_c` or `supply_v` of a tag, or of its body; None where it is not known."""
    found: Profile | None = getattr(tag, key)
    return found or next(getattr(body, key) for body in scenario.bodies if body.name == tag.body)


def own(tag: Tag, devices: Devices, name: str) -> float:
    """Return what a tag has of a property of all devices: its own, or theirs."""
    mine = getattr(tag, name)
    return float(getattr(devices, name) if mine is None else mine)


def lengthening_m(scenario: Scenario, tag: Tag, time_s: Floats) -> Floats | None:
    """Return by how much a tag lengthens ranges at times (n,) for its temperature and voltage; None for never."""
    devices = scenario.devices
    total: Floats | None = None
    for profile, slope, reference in (
        (profile_of(scenario, tag, "temperature_c"), own(tag, devices, "range_mm_per_k") * 1e-3, devices.reference_c),
        (profile_of(scenario, tag, "supply_v"), own(tag, devices, "range_cm_per_v") * 1e-2, devices.reference_v),
    ):
        if profile is not None and slope:
            part = slope * (profile_at(profile, time_s) - reference)
            total = part if total is None else total + part
    return total


def thermal_rate(scenario: Scenario, tag: Tag, time_s: Floats) -> Floats:
    """Return what temperature and warm-up add to the rate of a tag's clock at times (n,), as a fraction."""
    rate = tag.warm_up_ppm * 1e-6 * np.exp(-time_s / tag.warm_up_s)
    profile, slope = profile_of(scenario, tag, "temperature_c"), own(tag, scenario.devices, "skew_ppm_per_k")
    if profile is not None and slope:
        rate = rate + slope * 1e-6 * (profile_at(profile, time_s) - scenario.devices.reference_c)
    return np.asarray(rate)


def readings(scenario: Scenario) -> Columns:
    """Return what tags read of their temperature and voltage over the run: columns of the recording's `temperature`.

    NaN where a tag has only one of the two; empty where no tag has either.
    """
    devices, duration_s = scenario.devices, scenario.run.duration_s
    time_s = np.arange(int(duration_s * devices.readings_hz) + 1) / devices.readings_hz
    noises = devices.reading_noise_k, devices.reading_noise_v
    parts: list[Columns] = []
    for tag in scenario.tags:
        profiles = profile_of(scenario, tag, "temperature_c"), profile_of(scenario, tag, "supply_v")
        if any(profile is not None for profile in profiles):
            drawn = stream(scenario.run.seed, "temperature readings", tag.id).normal(size=(2, len(time_s)))
            read = [
                np.full(len(time_s), np.nan) if profile is None else profile_at(profile, time_s) + noise * scatter
                for profile, noise, scatter in zip(profiles, noises, drawn, strict=True)
            ]
            time_ns = np.rint(time_s * 1_000_000_000).astype(np.int64)
            ids = np.full(len(time_s), tag.id, dtype=np.int64)
            parts.append({"time_ns": time_ns, "tag": ids, "temperature_c": read[0], "supply_v": read[1]})
    return in_time_order(parts)
