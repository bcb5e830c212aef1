"""Conversion of stamps into ticks of one counter, and tests whether they make plausible ranges with a protocol.

Stamps have any unit and are wrapped, signed or unwrapped. A range is plausible between -2 m (antenna delays) and 2 km,
extended for single-sided ranging by the error of clocks 50 ppm apart over the reply, and within 50 m of the measured
distance, if there is one. The effect of missing antenna delays is subtracted before: 154 m if none were programmed.
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

MISSING: Final = np.iinfo(np.int64).min
"""Stands for a missing integer."""

MIN_ROWS: Final = 20
"""Fewer rows can agree with any assumption by chance."""

SAMPLE_ROWS: Final = 2000
"""Number of rows on which readings are tried."""

ACCEPTED_SHARE: Final = 0.5
"""From this share of plausible ranges on, a reading is accepted without trying others."""

FITTING_SHARE: Final = 0.9
"""From this share of plausible ranges on, another reading fits."""


def whole(values: Floats) -> Ints:
    """Return numbers (n,) rounded to integers, `MISSING` for NaN and for those that do not fit."""
    with np.errstate(invalid="ignore"):
        good = np.abs(values) < 2.0**62
    return np.where(good, np.rint(np.where(good, values, 0.0)), MISSING).astype(np.int64)


def clocks(protocol: str) -> tuple[tuple[str, ...], ...]:
    """Return the stamps of an exchange by clock, those of the initiator first."""
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
    """Return stamps in any unit as ticks of a counter of `bits` bits; missing ones are `MISSING`.

    Stamps in other units were scaled and written as floats, with an error that grows with the length of the record;
    differences of stamps of one clock are accurate. So the first stamp of each clock is rounded, and the difference of
    each other one from it.
    """
    found: dict[str, Ints] = {}
    mask = np.int64((1 << bits) - 1)
    for names in by_clock:
        first = whole(cells[names[0]] * ticks_per_unit)
        for name in names:
            if ticks_per_unit == 1.0:
                ticks = whole(cells[name])
                found[name] = np.where(ticks == MISSING, MISSING, ticks & mask)
            else:
                since = whole((cells[name] - cells[names[0]]) * ticks_per_unit)
                missing = (first == MISSING) | (since == MISSING)
                found[name] = np.where(missing, MISSING, (first + since) & mask)
    return found


def counter_format(count: Callable[[float, float], int], bits: int | None, counter: str | None) -> tuple[int, str]:
    """Return the width of a counter in bits and its format ("wrapped", "signed", "unwrapped"), unless they are given.

    `count(low, high)` returns the number of stamps in ticks from `low` to below `high`. The first of 32 and 40 bits is
    chosen into which 99 % of the stamps fit, wrapped or signed; the others are faults. If none fits, stamps are
    unwrapped.
    """
    stamps = count(-np.inf, np.inf)
    for width, kind in ((32, "wrapped"), (32, "signed"), (40, "wrapped"), (40, "signed")):
        low = -(2.0 ** (width - 1)) if kind == "signed" else 0.0
        asked = stamps >= MIN_ROWS and bits in (None, width) and counter in (None, kind)
        if asked and stamps - count(low, low + 2.0**width) <= 0.01 * stamps:
            return width, kind
    return bits or 32, counter or ("unwrapped" if stamps >= MIN_ROWS else "wrapped")


def counter_format_of(ticks: Iterable[Floats], bits: int | None = None) -> tuple[int, str]:
    """Return width and format of the counter of stamps in ticks, (n,) each; see `counter_format`."""
    columns = [column[np.isfinite(column)] for column in ticks]

    def count(low: float, high: float) -> int:
        return sum(int(np.count_nonzero((column >= low) & (column < high))) for column in columns)

    return counter_format(count, bits, None)


@dataclass(frozen=True, slots=True)
class Reading:
    """A way to read stamps: protocol, width of the counter, exchanged columns, and missing antenna delays."""

    protocol: str
    bits: int
    swapped: tuple[tuple[str, str], ...] = ()
    undelayed: bool = False
    """Whether no antenna delays were programmed, regardless of the map."""

    def difference(self, other: Reading) -> str:
        """Return the differences from another reading, as a map would state them."""
        said = [f'protocol = "{self.protocol}"'] if self.protocol != other.protocol else []
        said += [f"bits = {self.bits}"] if self.bits != other.bits else []
        said += [f"the columns of {one} and {two} exchanged" for one, two in self.swapped]
        said += ["[antenna_delays] tx = 0 and rx = 0"] if self.undelayed else []
        return " and ".join(said)


@dataclass(frozen=True, slots=True)
class Trial:
    """Result of a reading: share of plausible ranges, limits of the middle 90 % of ranges, scatter within pairs."""

    reading: Reading
    plausible: float
    low_m: float
    high_m: float
    scatter_m: float


@dataclass(frozen=True, slots=True)
class Sample:
    """Rows on which readings are tried: stamps in their own unit, and pairs.

    Unknown true distances and skews of the second message are NaN. `longer_m` (n,) are the lengths that missing antenna
    delays add to the ranges, by the map.
    """

    cells: Mapping[str, Floats]
    pair: Ints
    truth_m: Floats
    skew2_ppm: Floats
    longer_m: Floats
    ticks_per_unit: float

    def try_reading(self, reading: Reading) -> Trial:
        """Return the result of a reading on these rows."""
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


def find_other_reading(sample: Sample, reading: Reading) -> tuple[Trial, Trial | None]:
    """Try a reading; if it does not fit, also return another reading that does, None if none does."""
    first = sample.try_reading(reading)
    if first.plausible >= ACCEPTED_SHARE or len(sample.pair) < MIN_ROWS:
        return first, None
    for readings in _others(sample, reading):
        fitting = [trial for trial in map(sample.try_reading, readings) if trial.plausible >= FITTING_SHARE]
        if fitting:
            return first, min(fitting, key=lambda trial: (-round(trial.plausible, 2), trial.scatter_m))
    return first, None


def _others(sample: Sample, reading: Reading) -> Iterator[list[Reading]]:
    """Yield alternative readings, simple ones first: another protocol or width, exchanged columns, or both."""
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
