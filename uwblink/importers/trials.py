"""Whether stamps make ranges: the protocol, the counter's width and the columns tried in other ways, and what fits.

A range is plausible from two metres below zero (antenna delays) to two kilometres above, widened for single-sided
ranging by what clocks 50 ppm apart add in its reply; where a distance was measured, within 50 m of it. All that is said
of ranges less what antenna delays of devices add that were not programmed with any: 154 m.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.importers.stamps import ENOUGH_ROWS, NEVER, clocks, stamps_of, to_ticks
from uwblink.protocols.table import PROTOCOLS
from uwblink.ticks import ANTENNA_DELAY_TICKS, METRES_PER_TICK, SPEED_OF_LIGHT, TICK_S
from uwblink.twr import Exchanges, intervals, raw_range

SAMPLE: Final = 2000
GOOD_ENOUGH: Final = 0.5
CLEARLY: Final = 0.9
LOWEST_M, HIGHEST_M = -2.0, 2000.0
FROM_TRUTH_M: Final = 50.0
UNDELAYED_M: Final = 2 * ANTENNA_DELAY_TICKS * METRES_PER_TICK
"""How much longer ranges are where nothing was programmed: half of what is lacking at both ends, in both directions."""

CLOCKS_APART: Final = 50e-6


@dataclass(frozen=True, slots=True)
class Reading:
    """A way to read stamps: by a protocol, of a counter's width, with some columns exchanged for others."""

    protocol: str
    bits: int
    swapped: tuple[tuple[str, str], ...] = ()
    undelayed: bool = False
    """Whether no antenna delays were programmed, whatever the map says or leaves open."""

    def difference(self, other: Reading) -> str:
        """Say how this differs from another way."""
        said = [f'protocol = "{self.protocol}"'] if self.protocol != other.protocol else []
        said += [f"bits = {self.bits}"] if self.bits != other.bits else []
        said += [f"the columns of {one} and {two} exchanged" for one, two in self.swapped]
        said += ["[antenna_delays] tx = 0 and rx = 0"] if self.undelayed else []
        return " and ".join(said)


@dataclass(frozen=True, slots=True)
class Trial:
    """What a reading gives: the share of plausible ranges, the middle 90 % of the ranges, how much pairs scatter."""

    reading: Reading
    plausible: float
    low_m: float
    high_m: float
    scatter_m: float


@dataclass(frozen=True, slots=True)
class Sample:
    """Stamps of some rows to try readings on, in their own unit, and their pairs.

    Measured distances, and the skew of the second message, are NaN where there is none. `longer_m` is by how much
    ranges are longer for want of antenna delays in the devices, (n,), by what the map says of these.
    """

    cells: Mapping[str, Floats]
    pair: Ints
    truth_m: Floats
    skew2_ppm: Floats
    longer_m: Floats
    ticks_per_unit: float

    def attempt(self, reading: Reading) -> Trial:
        """Return what a reading gives on these rows."""
        columns = dict(self.cells)
        for one, two in reading.swapped:
            columns[one], columns[two] = columns[two], columns[one]
        names = stamps_of(reading.protocol)
        ticks = to_ticks(columns, clocks(reading.protocol), self.ticks_per_unit, reading.bits)
        count = len(self.pair)
        stamps = {name: np.where(ticks[name] == NEVER, 0, ticks[name]) for name in names}
        none = np.zeros(count, dtype=np.int64)
        stamps |= {name: none for name in ("tx3", "rx3") if name not in stamps}
        unknown = np.full(count, np.nan)
        levels = ("range_m", "fpp1_dbm", "fpp2_dbm", "skew1_ppm", "truth_m")
        exchanges = Exchanges(
            time_ns=none, initiator=none, target=none + 1, reporter=none, bits=reading.bits,
            protocol=np.full(count, reading.protocol), skew2_ppm=self.skew2_ppm, **stamps,
            **dict.fromkeys(levels, unknown),
        )  # fmt: skip
        raw = raw_range(exchanges) - (UNDELAYED_M if reading.undelayed else self.longer_m)
        ranges = np.where(np.isfinite(raw), raw, np.nan)  # no time between the last two messages makes them infinite
        good = self._plausible(ranges, exchanges)
        low, high = np.nanpercentile(ranges, [5, 95]) if np.isfinite(ranges).any() else (np.nan, np.nan)
        return Trial(reading, float(np.mean(good)), float(low), float(high), self._scatter_m(ranges))

    def _plausible(self, ranges: Floats, exchanges: Exchanges) -> Bools:
        spans = intervals(exchanges)
        half = 2.0 ** (exchanges.bits - 1)
        single = PROTOCOLS[str(exchanges.protocol[0])].third_sender is None
        allowance = CLOCKS_APART * spans.dt32 * TICK_S * SPEED_OF_LIGHT / 2 if single else np.zeros(len(ranges))
        with np.errstate(invalid="ignore"):
            good = (ranges > LOWEST_M - allowance) & (ranges < HIGHEST_M + allowance)
            good &= (spans.dt41 < half) & (spans.dt32 < half)
            if not single:
                good &= (spans.dt53 < half) & (spans.dt64 < half) & (spans.dt53 > 0)
            known = np.isfinite(self.truth_m)
            good &= ~known | (np.abs(ranges - self.truth_m) < FROM_TRUTH_M + allowance)
        return np.asarray(good)

    def _scatter_m(self, ranges: Floats) -> float:
        rest = ranges - np.where(np.isfinite(self.truth_m), self.truth_m, 0)
        if not np.isfinite(rest).all():
            return float("inf")
        spreads = [np.ptp(np.percentile(rest[self.pair == p], [25, 75])) for p in np.unique(self.pair)]
        return float(np.median(spreads))


def try_others(sample: Sample, reading: Reading) -> tuple[Trial, Trial | None]:
    """Return what a reading gives, and the other reading that clearly fits where it does not; None where none does."""
    first = sample.attempt(reading)
    if first.plausible >= GOOD_ENOUGH or len(sample.pair) < ENOUGH_ROWS:
        return first, None
    for readings in _others(sample, reading):
        fitting = [trial for trial in map(sample.attempt, readings) if trial.plausible >= CLEARLY]
        if fitting:
            return first, min(fitting, key=lambda trial: (-round(trial.plausible, 2), trial.scatter_m))
    return first, None


def _others(sample: Sample, reading: Reading) -> Iterator[list[Reading]]:
    """Yield other readings, simple ones first: another protocol or width, two columns exchanged, both."""
    names = [row.name for row in PROTOCOLS.known() if set(stamps_of(row.name)) <= set(sample.cells)]
    names = [name for name in names if name != "ss-cfo" and (name != "ds-sym" or reading.protocol == name)]
    plain = [Reading(name, bits) for name in names for bits in (reading.bits, 72 - reading.bits)]
    used = stamps_of(reading.protocol)
    # Without true distances, ranges of devices without antenna delays are as plausible as those with them.
    yield [replace(reading, undelayed=True)] if np.isfinite(sample.truth_m).any() else []
    yield [other for other in plain if other != reading and stamps_of(other.protocol) == used]
    pairs = list(combinations(used, 2))
    swaps = [(pair,) for pair in pairs] + [(("tx1", "rx1"), ("tx2", "rx2"))]
    yield [Reading(reading.protocol, reading.bits, swap) for swap in swaps]
    yield [other for other in plain if stamps_of(other.protocol) != used]
    yield [Reading(other.protocol, other.bits, swap) for other in plain for swap in swaps]
