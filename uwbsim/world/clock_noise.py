"""White and flicker noise of clocks' rates at every averaging time, as a function of true time.

The phase is a sum of tents, one on each interval of an octave of lengths (a Haar series of the rate). With peaks of
h sqrt(length)/2 it is a Brownian motion (Levy's construction), the phase of white noise of the rate with the Allan
deviation h/sqrt(tau). With peaks proportional to the length every octave adds the same variance of the rate, which is
flicker noise (Wornell, IEEE Trans. Inf. Theory 36, 1990). There the sum over all octaves telescopes: steps of +r and -r
have the Allan variance 2 r^2 at every tau, averaged over where the intervals begin, which is drawn.

How high a tent is follows from a hash of its number, so the phase at an instant does not depend on what else is asked,
or in which order. Octaves above a grid are added up once; those below it for every instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwbsim.random_streams import stream
from uwbsim.scenario.tags import Tag
from uwbsim.world.true_time import SUBTICKS_PER_SECOND

SHORTEST: Final = 30
"""The shortest tents are 2^30 sub-ticks or 16 us long: a second difference over 1 ms misses 0.4 % of its variance."""

GRID: Final = 42
"""Tents longer than 2^42 sub-ticks, 67 ms, are added up once on a grid of this step."""

LONGEST: Final = 59
"""The longest tents are 2^59 sub-ticks, 8810 s: flicker ends below that frequency, white noise goes on."""

DRAWS_BITS: Final = 16
PIECE: Final = 16_384
FEW: Final = 64
"""Up to so many instants all octaves are added up at once: of single frames the calls cost more than the numbers."""

Words = NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class ClockNoise:
    """The phases of all tags' clocks, rows by a tag's place in the scenario; octaves in columns, lengths 2^30 and up.

    `keys` seed the hash and `peaks` are the tents' deviations in sub-ticks, (tags, octaves) each; `shift` is where the
    intervals begin, (tags,); `knots` the sum of the long ones at multiples of the grid's step from time zero.
    """

    keys: Words
    peaks: Floats
    shift: Words
    knots: Floats

    @classmethod
    def of(cls, seed: int, tags: tuple[Tag, ...], duration_s: float) -> Self | None:
        """Return the noise of tags' clocks over a while, None where none of them has any."""
        if not any(tag.white_ppm_sqrt_s or tag.flicker_ppm for tag in tags):
            return None
        drawn = [stream(seed, "clock noise", tag.id) for tag in tags]
        octaves = np.arange(SHORTEST, LONGEST + 1)
        keys = np.array([rng.integers(0, 1 << 63, len(octaves), dtype=np.uint64) for rng in drawn])
        # A whole number of steps, so that the grid begins at time zero; less than 2^62, so that no run overflows.
        steps = np.array([rng.integers(0, 1 << (62 - GRID), dtype=np.uint64) for rng in drawn])
        count = int(duration_s * SUBTICKS_PER_SECOND / 2**GRID) + 64
        peaks = np.array([_peaks(tag, octaves) for tag in tags])
        knots = np.zeros((len(tags), count))
        noise = cls(keys, peaks, steps << np.uint64(GRID), knots)
        time = np.arange(count, dtype=np.int64) << GRID
        for place, (tag, rng) in enumerate(zip(tags, drawn, strict=True)):
            which = np.full(count, place)
            coarse = noise._tents(which, time, slice(GRID + 1 - SHORTEST, None)) + noise._trend(place, tag, rng, time)
            knots[place] = coarse - coarse[0]
        return noise

    def phase(self, tag: Ints, time: Ints) -> Floats:
        """Return by how many sub-ticks the clocks of tags (n,) are ahead for their noise at true times (n,)."""
        cell = np.clip(time >> GRID, 0, self.knots.shape[1] - 2)
        into = (time - (cell << GRID)) * 2.0**-GRID
        low = self.knots[tag, cell]
        return np.asarray(low + into * (self.knots[tag, cell + 1] - low) + self._fine(tag, time))

    def _fine(self, tag: Ints, time: Ints) -> Floats:
        octaves = slice(0, GRID + 1 - SHORTEST)
        if len(time) <= FEW:
            return self._tents_at_once(tag, time, octaves)
        if len(time) <= PIECE:
            return self._tents(tag, time, octaves)
        cuts = range(0, len(time), PIECE)
        return np.concatenate([self._tents(tag[k : k + PIECE], time[k : k + PIECE], octaves) for k in cuts])

    def _tents(self, tag: Ints, time: Ints, octaves: slice) -> Floats:
        """Add up the tents of some octaves, (n,)."""
        exponents = np.arange(SHORTEST, LONGEST + 1, dtype=np.uint64)[octaves]
        at = time.astype(np.uint64) + self.shift[tag]
        total = np.zeros(len(time))
        for column, exponent in zip(range(*octaves.indices(self.keys.shape[1])), exponents, strict=True):
            index = at >> exponent
            into = (at - (index << exponent)).astype(np.float64) * 2.0 ** -float(exponent)
            height = _normal(index, self.keys[tag, column]) * self.peaks[tag, column]
            total += height * (1 - np.abs(2 * into - 1))
        return total

    def _tents_at_once(self, tag: Ints, time: Ints, octaves: slice) -> Floats:
        """Add up the tents of some octaves, (n,): the same sums in the same order, octaves in columns."""
        exponents = np.arange(SHORTEST, LONGEST + 1, dtype=np.uint64)[octaves]
        at = (time.astype(np.uint64) + self.shift[tag])[:, None]
        index = at >> exponents
        into = (at - (index << exponents)).astype(np.float64) * np.exp2(-exponents.astype(np.float64))
        height = _normal(index, self.keys[tag, octaves]) * self.peaks[tag, octaves]
        return np.asarray(np.add.accumulate(height * (1 - np.abs(2 * into - 1)), axis=1)[:, -1])

    def _trend(self, place: int, tag: Tag, rng: np.random.Generator, time: Ints) -> Floats:
        """Return the random walk of white noise from one of the longest intervals to the next, linear in between."""
        at = (time.astype(np.uint64) + self.shift[place]).astype(np.float64) * 2.0**-LONGEST
        step = tag.white_sqrt_s * np.sqrt(2.0**LONGEST * SUBTICKS_PER_SECOND)
        walk = np.cumsum(rng.normal(0, 1, 1 << (64 - LONGEST))) * step
        return np.asarray(np.interp(at, np.arange(len(walk)), walk))


def _peaks(tag: Tag, octaves: Ints) -> Floats:
    """Return the standard deviations of tents' heights by octave, in sub-ticks."""
    length_s = 2.0**octaves / SUBTICKS_PER_SECOND
    white = tag.white_sqrt_s * np.sqrt(length_s) / 2
    flicker = tag.flicker / np.sqrt(2) * length_s / 2
    return np.asarray(np.hypot(white, flicker) * SUBTICKS_PER_SECOND)


def _normal(index: Words, key: Words) -> Floats:
    """Return standard normal draws that belong to numbers and keys: a multiplicative hash into a table of quantiles."""
    word = (index + key) * np.uint64(0x9E3779B97F4A7C15)
    word = (word ^ (word >> np.uint64(32))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(29))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(_quantiles()[(word >> np.uint64(64 - DRAWS_BITS)).astype(np.int64)])


@lru_cache(maxsize=1)
def _quantiles() -> Floats:
    """Return equally probable values of a standard normal variable, with variance one."""
    from scipy.special import ndtri

    count = 1 << DRAWS_BITS
    values = np.asarray(ndtri((np.arange(count) + 0.5) / count))
    return np.asarray(values / np.std(values))
