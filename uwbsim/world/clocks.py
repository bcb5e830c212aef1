"""True time, the tags' clocks, the noise of their rates, and the effects of temperature and supply voltage.

True time is an integer count of sub-ticks, 1024 to a device tick (15.3 fs, 4.6 um of flight). 63 bits of them last 39
hours, and a stamp at hour 30 is as exact as one at second 1: the large count is never rounded, only the small deviation
of a clock from true time is a float.

White and flicker noise of a rate: the phase is a sum of triangular pulses, one on each interval of an octave of lengths
(a Haar series of the rate). With peaks of h sqrt(length)/2 it is a Brownian motion (Levy's construction), the phase of
white noise of the rate with the Allan deviation h/sqrt(tau). With peaks proportional to the length every octave adds
the same variance of the rate, which is flicker noise (Wornell, IEEE Trans. Inf. Theory 36, 1990). There the sum over
all octaves telescopes: steps of +r and -r have the Allan variance 2 r^2 at every tau, averaged over the random start of
the intervals.

The height of a pulse is a hash of its number, so the phase at an instant does not depend on which other instants are
evaluated, or in which order. Octaves above a grid are summed once, those below it for every instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from uwblink.arrays import Columns, Floats, Ints, in_time_order
from uwblink.ticks import COUNTER_BITS, TICKS_PER_SECOND
from uwbsim.random_streams import stream
from uwbsim.scenario.devices import Devices, Profile, ScenarioTag
from uwbsim.scenario.model import Scenario

NS_PER_S: Final = 1_000_000_000

SUBTICKS: Final = 1024
"""Sub-ticks of a device tick: rounding an instant to them adds no error to a stamp."""

SUBTICKS_PER_SECOND: Final = SUBTICKS * TICKS_PER_SECOND

SHORTEST_OCTAVE: Final = 30
"""The shortest pulses are 2^30 sub-ticks or 16 us long: a second difference over 1 ms misses 0.4 % of its variance."""

GRID_OCTAVE: Final = 42
"""Pulses longer than 2^42 sub-ticks, 67 ms, are summed once on a grid of this step."""

LONGEST_OCTAVE: Final = 59
"""The longest pulses are 2^59 sub-ticks, 8810 s: flicker ends below that frequency, white noise does not."""

WALK_STEP_S: Final = 0.1
"""Step of random walks and temperature: short compared with the tens of seconds over which rates change."""

RATE_SPAN_S: Final = 130e-6
"""Length of the boards' preambles: 128 symbols of 1.02 us."""

LONGEST_RUN_S: Final = 36 * 3600.0
"""Chosen below the 39 hours that 63 bits of sub-ticks last."""

Words = NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class ClockNoise:
    """The phases of all tags' clocks, in columns by a tag's place in the scenario; octaves in rows, from 2^30 on.

    `keys` seed the hash and `peaks` are the standard deviations of pulses in sub-ticks, (octaves, tags) each; `shift`
    is the start of the intervals, (tags,); `knots` the sum of long pulses at multiples of the grid's step from zero.
    """

    keys: Words
    peaks: Floats
    shift: Words
    knots: Floats

    @classmethod
    def of(cls, seed: int, tags: tuple[ScenarioTag, ...], duration_s: float) -> Self | None:
        """Return the noise of tags' clocks over a duration, None where none of them has any."""
        if not any(tag.white_ppm_sqrt_s or tag.flicker_ppm for tag in tags):
            return None
        drawn = [stream(seed, "clock noise", tag.id) for tag in tags]
        octaves = np.arange(SHORTEST_OCTAVE, LONGEST_OCTAVE + 1)
        keys = np.stack([rng.integers(0, 1 << 63, len(octaves), dtype=np.uint64) for rng in drawn], axis=1)
        # The shift is a whole number of steps, so that the grid begins at time zero, and below 2^62, so that no run
        # overflows.
        steps = np.array([rng.integers(0, 1 << (62 - GRID_OCTAVE), dtype=np.uint64) for rng in drawn])
        count = int(duration_s * SUBTICKS_PER_SECOND / 2**GRID_OCTAVE) + 64
        peaks = np.stack([_peaks(tag, octaves) for tag in tags], axis=1)
        knots = np.zeros((len(tags), count))
        noise = cls(keys, peaks, steps << np.uint64(GRID_OCTAVE), knots)
        time, long = np.arange(count, dtype=np.int64) << GRID_OCTAVE, slice(GRID_OCTAVE + 1 - SHORTEST_OCTAVE, None)
        for place, (tag, rng) in enumerate(zip(tags, drawn, strict=True)):
            coarse = noise._pulses(np.full(count, place), time, long) + noise._trend(place, tag, rng, time)
            knots[place] = coarse - coarse[0]
        return noise

    def phase(self, tag: Ints, time: Ints) -> Floats:
        """Return the phase noise of the clocks of tags (n,) at true times (n,), in sub-ticks; positive is ahead."""
        cell = np.clip(time >> GRID_OCTAVE, 0, self.knots.shape[1] - 2)
        into = (time - (cell << GRID_OCTAVE)) * 2.0**-GRID_OCTAVE
        low = self.knots[tag, cell]
        # The octaves below the grid, in pieces that fit into a core's cache.
        octaves, piece = slice(0, GRID_OCTAVE + 1 - SHORTEST_OCTAVE), 2048
        cuts = range(0, max(len(time), 1), piece)
        fine = [self._pulses(tag[k : k + piece], time[k : k + piece], octaves) for k in cuts]
        return np.asarray(low + into * (self.knots[tag, cell + 1] - low) + np.concatenate(fine))

    def _pulses(self, tag: Ints, time: Ints, octaves: slice) -> Floats:
        """Sum the triangular pulses of some octaves, (n,), from the shortest to the longest."""
        exponents = np.arange(SHORTEST_OCTAVE, LONGEST_OCTAVE + 1, dtype=np.uint64)[octaves]
        at = time.astype(np.uint64) + self.shift[tag]
        index = at >> exponents[:, None]
        into = (at - (index << exponents[:, None])).astype(np.float64) * np.exp2(-exponents.astype(np.float64))[:, None]
        height = _normal(index, self.keys[octaves][:, tag]) * self.peaks[octaves][:, tag]
        return np.asarray(np.sum(height * (1 - np.abs(2 * into - 1)), axis=0))

    def _trend(self, place: int, tag: ScenarioTag, rng: np.random.Generator, time: Ints) -> Floats:
        """Return the random walk of white noise over the longest intervals, linear between their ends."""
        at = (time.astype(np.uint64) + self.shift[place]).astype(np.float64) * 2.0**-LONGEST_OCTAVE
        step = (tag.white_ppm_sqrt_s * 1e-6) * np.sqrt(2.0**LONGEST_OCTAVE * SUBTICKS_PER_SECOND)
        walk = np.cumsum(rng.normal(0, 1, 1 << (64 - LONGEST_OCTAVE))) * step
        return np.asarray(np.interp(at, np.arange(len(walk)), walk))


def _peaks(tag: ScenarioTag, octaves: Ints) -> Floats:
    """Return the standard deviations of the pulses' heights by octave, in sub-ticks."""
    length_s = 2.0**octaves / SUBTICKS_PER_SECOND
    white = (tag.white_ppm_sqrt_s * 1e-6) * np.sqrt(length_s) / 2
    flicker = (tag.flicker_ppm * 1e-6) / np.sqrt(2) * length_s / 2
    return np.asarray(np.hypot(white, flicker) * SUBTICKS_PER_SECOND)


def _normal(index: Words, key: Words) -> Floats:
    """Return standard normal values for numbers and keys: a multiplicative hash selects from a table of quantiles."""
    word = (index + key) * np.uint64(0x9E3779B97F4A7C15)
    word = (word ^ (word >> np.uint64(32))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(29))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(_quantiles()[(word >> np.uint64(64 - 16)).astype(np.int64)])


@cache
def _quantiles() -> Floats:
    """Return 2^16 equally probable values of a standard normal variable, with variance one."""
    values = np.asarray(ndtri((np.arange(1 << 16) + 0.5) / (1 << 16)))
    return np.asarray(values / np.std(values))


@dataclass(frozen=True, slots=True)
class Clocks:
    """The clocks of all tags, indexed by the tag's place in the scenario.

    A clock reads t + offset + deviation(t); the deviation is skew times t plus the integral of the rate's random
    walk, temperature and warm-up, constant over steps of `WALK_STEP_S`, plus the phase of its white and flicker noise.
    (A rate that jumps at regular instants has the Allan variance q^2 tau/3 of a random walk for a shorter tau, too.)
    """

    offset: Ints
    skew: Floats
    walk_rate: Floats
    walk_subticks: Floats
    noise: ClockNoise | None = None

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Create the clocks of a scenario; random walks, and offsets that are not given, are drawn from its seed."""
        seed, duration = scenario.run.seed, scenario.run.duration_s
        steps, offsets, rates = int(duration / WALK_STEP_S) + 20, [], []
        for tag in scenario.tags:
            rng = stream(seed, "clock", tag.id)
            drawn = rng.integers(0, 1 << COUNTER_BITS)
            if tag.clock_offset_s is not None:
                drawn = np.int64(round(tag.clock_offset_s * TICKS_PER_SECOND))
            offsets.append(drawn * SUBTICKS + rng.integers(0, SUBTICKS))
            sigma = (tag.drift_ppm_per_sqrt_s * 1e-6) * np.sqrt(WALK_STEP_S)
            walk = np.concatenate([[0.0], np.cumsum(rng.normal(0, 1, steps) * sigma)])
            ramp = (tag.ramp_ppm_per_s * 1e-6) * WALK_STEP_S * np.arange(steps + 1)
            middle_s = np.asarray(WALK_STEP_S * (np.arange(steps + 1) + 0.5), dtype=np.float64)
            rates.append(walk + ramp + thermal_rate(scenario, tag, middle_s))
        rate = np.array(rates)
        step = WALK_STEP_S * SUBTICKS_PER_SECOND
        phase = np.cumsum(rate[:, :-1] * step, axis=1)
        walk = np.concatenate([np.zeros((len(rate), 1)), phase], axis=1)
        skew = np.array([tag.skew_ppm * 1e-6 for tag in scenario.tags])
        noise = ClockNoise.of(seed, scenario.tags, duration)
        return cls(np.array(offsets, dtype=np.int64), skew, rate, walk, noise)

    def read(self, tag: Ints, time: Ints) -> Ints:
        """Return the readings of the clocks of tags (n,) at true times (n,), in sub-ticks, not wrapped."""
        return time + self.offset[tag] + self._deviation(tag, time)

    def when(self, tag: Ints, reading: Ints) -> Ints:
        """Return the true times (n,) of clock readings: the inverse of `read`."""
        time = bare = reading - self.offset[tag]
        # Each pass multiplies the error by the skew, so three passes reduce 0.1 s of deviation below a sub-tick.
        for _ in range(4):
            time = bare - self._deviation(tag, time)
        return time

    def rate(self, tag: Ints, time: Ints, span_s: float = RATE_SPAN_S) -> Floats:
        """Return the deviations of the clocks' rates from true time, as fractions, (n,).

        White noise has no rate at an instant: its contribution is the mean over the previous `span_s`, by default the
        length of a preamble, over which the carrier integrator averages.
        """
        rate = self.skew[tag] + self.walk_rate[tag, self._step(time)[0]]
        if self.noise is None:
            return np.asarray(rate)
        span = round(span_s * SUBTICKS_PER_SECOND)
        return np.asarray(rate + (self.noise.phase(tag, time) - self.noise.phase(tag, time - span)) / span)

    def _step(self, time: Ints) -> tuple[Ints, Floats]:
        step = int(WALK_STEP_S * SUBTICKS_PER_SECOND)
        index = np.clip(time // step, 0, self.walk_rate.shape[1] - 2)
        return index, (time - index * step).astype(np.float64)

    def _deviation(self, tag: Ints, time: Ints) -> Ints:
        index, into = self._step(time)
        walked = self.walk_subticks[tag, index] + self.walk_rate[tag, index] * into
        if self.noise is not None:
            walked = walked + self.noise.phase(tag, time)
        return np.rint(self.skew[tag] * time + walked).astype(np.int64)


def profile_of(scenario: Scenario, tag: ScenarioTag, key: str) -> Profile | None:
    """Return the `temperature_c` or `supply_v` of a tag, or of its body; None where it is not known."""
    found: Profile | None = getattr(tag, key)
    return found or next(getattr(body, key) for body in scenario.bodies if body.name == tag.body)


def slope_of(tag: ScenarioTag, devices: Devices, name: str) -> float:
    """Return a sensitivity to temperature or voltage: the tag's own, or that of all devices."""
    value = getattr(tag, name)
    return float(getattr(devices, name) if value is None else value)


RangeEffect = tuple[Profile, float, float]
"""A quantity over time on which ranges depend, their slope in metres per unit, and its reference."""


def range_effects(scenario: Scenario, tag: ScenarioTag) -> list[RangeEffect]:
    """Return the effects of a tag's temperature and voltage on ranges; none without a profile or a slope."""
    d = scenario.devices
    effects = (
        (profile_of(scenario, tag, "temperature_c"), slope_of(tag, d, "range_mm_per_k") * 1e-3, d.reference_c),
        (profile_of(scenario, tag, "supply_v"), slope_of(tag, d, "range_cm_per_v") * 1e-2, d.reference_v),
    )
    return [(profile, slope, reference) for profile, slope, reference in effects if profile and slope]


def thermal_rate(scenario: Scenario, tag: ScenarioTag, time_s: Floats) -> Floats:
    """Return the change of the rate of a tag's clock by temperature and warm-up at times (n,), as a fraction."""
    rate = tag.warm_up_ppm * 1e-6 * np.exp(-time_s / tag.warm_up_s)
    profile, slope = profile_of(scenario, tag, "temperature_c"), slope_of(tag, scenario.devices, "skew_ppm_per_k")
    if profile is not None and slope:
        rate = rate + slope * 1e-6 * (profile.at(time_s) - scenario.devices.reference_c)
    return np.asarray(rate)


def readings(scenario: Scenario) -> Columns:
    """Return the tags' readings of temperature and voltage over the run: columns of the recording's `temperature`.

    NaN where a tag has only one of the two; no columns where no tag has either.
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
                np.full(len(time_s), np.nan) if profile is None else profile.at(time_s) + noise * scatter
                for profile, noise, scatter in zip(profiles, noises, drawn, strict=True)
            ]
            time_ns = np.rint(time_s * NS_PER_S).astype(np.int64)
            ids = np.full(len(time_s), tag.id, dtype=np.int64)
            parts.append({"time_ns": time_ns, "tag": ids, "temperature_c": read[0], "supply_v": read[1]})
    return in_time_order(parts)
