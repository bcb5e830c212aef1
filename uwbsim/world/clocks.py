"""True time and what the tags' clocks make of it.

True time is an integer count of sub-ticks, 1024 to a device tick (15.3 fs, 4.6 um of flight). 63 bits of
them last 39 hours, and a stamp at hour 30 is as exact as one at second 1: the large count is never
rounded, only the small deviation of a clock from true time is a float.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.ticks import COUNTER_BITS, TICKS_PER_SECOND
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.world.clock_noise import ClockNoise
from uwbsim.world.temperature import thermal_rate
from uwbsim.world.true_time import SUBTICKS, SUBTICKS_PER_SECOND

LONGEST_RUN_S: Final = 36 * 3600.0
WALK_STEP_S: Final = 0.1

RATE_SPAN_S: Final = 130e-6
"""How long the boards' preambles are: 128 symbols of 1.02 us."""


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
        """Build the clocks of a scenario; offsets not given and random walks come from its seed."""
        seed, duration = scenario.run.seed, scenario.run.duration_s
        steps = int(duration / WALK_STEP_S) + 20
        offsets, rates = [], []
        for tag in scenario.tags:
            rng = stream(seed, "clock", tag.id)
            drawn = rng.integers(0, 1 << COUNTER_BITS)
            if tag.clock_offset_s is not None:
                drawn = np.int64(round(tag.clock_offset_s * TICKS_PER_SECOND))
            offsets.append(drawn * SUBTICKS + rng.integers(0, SUBTICKS))
            sigma = tag.drift_per_sqrt_s * np.sqrt(WALK_STEP_S)
            walk = np.concatenate([[0.0], np.cumsum(rng.normal(0, 1, steps) * sigma)])
            ramp = tag.ramp_per_s * WALK_STEP_S * np.arange(steps + 1)
            middle_s = np.asarray(WALK_STEP_S * (np.arange(steps + 1) + 0.5), dtype=np.float64)
            rates.append(walk + ramp + thermal_rate(scenario, tag, middle_s))
        rate = np.array(rates)
        step = WALK_STEP_S * SUBTICKS_PER_SECOND
        phase = np.cumsum(rate[:, :-1] * step, axis=1)
        walk = np.concatenate([np.zeros((len(rate), 1)), phase], axis=1)
        skew = np.array([tag.skew for tag in scenario.tags])
        noise = ClockNoise.of(seed, scenario.tags, duration)
        return cls(np.array(offsets, dtype=np.int64), skew, rate, walk, noise)

    def read(self, tag: Ints, time: Ints) -> Ints:
        """Return what the clocks of tags (n,) read at true times (n,), in sub-ticks, not wrapped."""
        return time + self.offset[tag] + self._deviation(tag, time)

    def when(self, tag: Ints, reading: Ints) -> Ints:
        """Return the true times (n,) at which clocks show `reading`: the inverse of `read`."""
        bare = reading - self.offset[tag]
        time = bare
        # Each pass shrinks the error by the skew, so three take 0.1 s of deviation below a sub-tick.
        for _ in range(4):
            time = bare - self._deviation(tag, time)
        return time

    def rate(self, tag: Ints, time: Ints) -> Floats:
        """Return how much faster than true time the clocks run, as a fraction, shape (n,).

        Noise has no rate at an instant; its share is the mean over the `RATE_SPAN_S` before, as of a preamble that the
        carrier integrator follows.
        """
        return np.asarray(self._smooth_rate(tag, time) + self._noise_rate(tag, time, RATE_SPAN_S))

    def exchange_rate(self, tag: Ints, time: Ints) -> Floats:
        """Return the rate without the noise that averages out within a tenth of a second, shape (n,)."""
        return np.asarray(self._smooth_rate(tag, time) + self._noise_rate(tag, time, WALK_STEP_S))

    def _smooth_rate(self, tag: Ints, time: Ints) -> Floats:
        return np.asarray(self.skew[tag] + self.walk_rate[tag, self._step(time)[0]])

    def _noise_rate(self, tag: Ints, time: Ints, span_s: float) -> Floats | float:
        if self.noise is None:
            return 0.0
        span = round(span_s * SUBTICKS_PER_SECOND)
        return (self.noise.phase(tag, time) - self.noise.phase(tag, time - span)) / span

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
