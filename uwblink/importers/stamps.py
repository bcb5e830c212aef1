"""Stamps of other devices as ticks of one counter, and whether they make ranges, by a protocol or by another one.

Stamps come in any unit, wrapped, signed or unwrapped. A range is plausible from two metres below zero (antenna delays)
to two kilometres above, widened for single-sided ranging by what clocks 50 ppm apart add in its reply; where a distance
was measured, within 50 m of it. What missing antenna delays add is subtracted before: 154 m where none were programmed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.protocols.table import PROTOCOLS
from uwblink.ticks import ANTENNA_DELAY_TICKS, METRES_PER_TICK, SPEED_OF_LIGHT, TICK_S
from uwblink.twr import STAMPS, Exchanges, intervals, raw_range

NEVER: Final = np.iinfo(np.int64).min
"""In place of a whole number that is missing."""

MIN_ROWS: Final = 20
"""Fewer rows may agree with anything."""

SAMPLE: Final = 2000
"""Rows on which other readings are tried."""

GOOD_ENOUGH: Final = 0.5
"""Share of plausible ranges from which on no other reading is looked for."""

CLEARLY: Final = 0.9
"""Share of plausible ranges from which on another reading fits."""


def whole(values: Floats) -> Ints:
    """Return numbers rounded to whole ones, `NEVER` where there is none."""
    with np.errstate(invalid="ignore"):
        good = np.abs(values) < 2.0**62
    return np.where(good, np.rint(np.where(good, values, 0.0)), NEVER).astype(np.int64)


def clocks(protocol: str) -> tuple[tuple[str, ...], ...]:
    """Return the stamps of an exchange by the clock that they are taken with, the initiator's first."""
    third = PROTOCOLS[protocol].third_sender
    if third is None:
        return ("tx1", "rx2"), ("rx1", "tx2")
    mine, other = ("tx3", "rx3") if third == "initiator" else ("rx3", "tx3")
    return ("tx1", "rx2", mine), ("rx1", "tx2", other)


def stamps_of(protocol: str) -> tuple[str, ...]:
    """Return the names of the stamps that an exchange of a protocol has."""
    return STAMPS[: 2 * len(PROTOCOLS[protocol].messages)]


def to_ticks(
    cells: Mapping[str, Floats], by_clock: Iterable[tuple[str, ...]], ticks_per_unit: float, bits: int
) -> dict[str, Ints]:
    """Return stamps in any unit as ticks of a counter of `bits` bits, `NEVER` where one is missing.

    Stamps that are no ticks were multiplied, added up and written as floats, so that a long record is off by a part of
    a tick that grows; what lies between two stamps of one clock is not. Hence the first stamp of each clock is rounded,
    and the others by their distance from it.
    """
    found: dict[str, Ints] = {}
    mask = np.int64((1 << bits) - 1)
    for names in by_clock:
        first = whole(cells[names[0]] * ticks_per_unit)
        for name in names:
            if ticks_per_unit == 1.0:
                ticks = whole(cells[name])
                found[name] = np.where(ticks == NEVER, NEVER, ticks & mask)
            else:
                since = whole((cells[name] - cells[names[0]]) * ticks_per_unit)
                missing = (first == NEVER) | (since == NEVER)
                found[name] = np.where(missing, NEVER, (first + since) & mask)
    return found


def how_counted(count: Callable[[float, float], int], bits: int | None, counter: str | None) -> tuple[int, str]:
    """Return the width of a counter in bits and how it is written, as far as they are not given.

    `count(low, high)` returns how many stamps in ticks are from `low` to below `high`. Numbers that fit 32 bits are
    taken for 32, larger ones for 40, and those that fit neither for unwrapped; negative ones for signed where they fit.
    Less than a hundredth of the stamps do not count: they are faults.
    """
    stamps = count(-np.inf, np.inf)
    for width, kind in ((32, "wrapped"), (32, "signed"), (40, "wrapped"), (40, "signed")):
        low = -(2.0 ** (width - 1)) if kind == "signed" else 0.0
        asked = stamps >= MIN_ROWS and bits in (None, width) and counter in (None, kind)
        if asked and stamps - count(low, low + 2.0**width) <= 0.01 * stamps:
            return width, kind
    return bits or 32, counter or ("unwrapped" if stamps >= MIN_ROWS else "wrapped")


def how_counted_in(ticks: Iterable[Floats], bits: int | None = None) -> tuple[int, str]:
    """Return the bits of the counter of stamps in ticks (n,) each, and how it is written; see `how_counted`."""
    columns = [column[np.isfinite(column)] for column in ticks]

    def count(low: float, high: float) -> int:
        return sum(int(np.count_nonzero((column >= low) & (column < high))) for column in columns)

    return how_counted(count, bits, None)


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
        ticks = to_ticks(columns, clocks(reading.protocol), self.ticks_per_unit, reading.bits)
        count = len(self.pair)
        none, unknown = np.zeros(count, dtype=np.int64), np.full(count, np.nan)
        stamps: dict[str, Any] = {name: np.maximum(ticks[name], 0) if name in ticks else none for name in STAMPS}
        exchanges = Exchanges(
            time_ns=none, initiator=none, target=none + 1, reporter=none, bits=reading.bits,
            protocol=np.full(count, reading.protocol), skew2_ppm=self.skew2_ppm, **stamps,
            **dict.fromkeys(("range_m", "fpp1_dbm", "fpp2_dbm", "skew1_ppm", "truth_m"), unknown),
        )  # fmt: skip
        # Half of what is lacking at both ends, in both directions, where nothing was programmed.
        undelayed_m = 2 * ANTENNA_DELAY_TICKS * METRES_PER_TICK
        raw = raw_range(exchanges) - (undelayed_m if reading.undelayed else self.longer_m)
        ranges = np.where(np.isfinite(raw), raw, np.nan)  # no time between the last two messages makes them infinite
        good = self._plausible(ranges, exchanges)
        low, high = np.nanpercentile(ranges, [5, 95]) if np.isfinite(ranges).any() else (np.nan, np.nan)
        return Trial(reading, float(np.mean(good)), float(low), float(high), self._scatter_m(ranges))

    def _plausible(self, ranges: Floats, exchanges: Exchanges) -> Bools:
        spans, half = intervals(exchanges), 2.0 ** (exchanges.bits - 1)
        single = PROTOCOLS[str(exchanges.protocol[0])].third_sender is None
        allowance = 50e-6 * spans.dt32 * TICK_S * SPEED_OF_LIGHT / 2 if single else np.zeros(len(ranges))
        with np.errstate(invalid="ignore"):
            good = (ranges > -2.0 - allowance) & (ranges < 2000.0 + allowance)
            good &= (spans.dt41 < half) & (spans.dt32 < half)
            if not single:
                good &= (spans.dt53 < half) & (spans.dt64 < half) & (spans.dt53 > 0)
            good &= ~np.isfinite(self.truth_m) | (np.abs(ranges - self.truth_m) < 50.0 + allowance)
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
    if first.plausible >= GOOD_ENOUGH or len(sample.pair) < MIN_ROWS:
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
    swaps = [*((pair,) for pair in combinations(used, 2)), (("tx1", "rx1"), ("tx2", "rx2"))]
    yield [Reading(reading.protocol, reading.bits, swap) for swap in swaps]
    yield [other for other in plain if stamps_of(other.protocol) != used]
    yield [Reading(other.protocol, other.bits, swap) for other in plain for swap in swaps]
