"""Find out how numbers of a table are to be read: units of lengths and powers, format and protocol of stamps.

Stamps have any unit and are wrapped, signed or unwrapped; they become ticks of one counter. A range is plausible
between -2 m (antenna delays) and 2 km, extended for single-sided ranging by the error of clocks 50 ppm apart over the
reply, and within 50 m of the measured distance, if there is one. The effect of missing antenna delays is subtracted
before: 154 m if none were programmed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import DISTANCE_UNITS, POSITIONS, POWERS, ColumnMap
from uwblink.importers.tables import Columns
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.antenna_delays import REGISTER_MAX
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
        found = [f'protocol = "{self.protocol}"'] if self.protocol != other.protocol else []
        found += [f"bits = {self.bits}"] if self.bits != other.bits else []
        found += [f"the columns of {one} and {two} exchanged" for one, two in self.swapped]
        found += ["[antenna_delays] tx = 0 and rx = 0"] if self.undelayed else []
        return " and ".join(found)


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
        # Half of both devices' missing delays, of transmission and reception.
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


Errors = Callable[[float], Floats]
"""Returns ranges less distances (n,) with some lengths multiplied by a factor, in the given unit of the ranges.

In this unit noise does not depend on the factor; otherwise ranges of boards at rest would seem to be in feet.
"""


def other_unit(errors: Mapping[str, Errors]) -> tuple[str, str] | None:
    """Return the name and unit of lengths that are evidently not in metres; None if all are in metres.

    `errors` are by the name of the lengths that are multiplied. The residuals of the errors from a constant (antenna
    delays) are compared: a unit is found if they are smaller by more than the square root of its factor. Residuals of
    distances that are unrelated to the ranges shrink to the spread of the ranges, by at most the square root of two.
    """
    best, found = 0.0, None
    for name, of in errors.items():
        plain = _remaining(of(1.0))
        for unit, factor in DISTANCE_UNITS.items():
            if factor == 1.0 or not plain > 0:
                continue
            gain = np.log(plain / max(_remaining(of(factor)), METRES_PER_TICK))
            if gain > max(best, -np.log(factor) / 2):
                best, found = gain, (name, unit)
    return found


def _remaining(errors_m: Floats) -> float:
    """Return the median absolute residual of errors from a constant within antenna delays; NaN of few values."""
    finite = errors_m[np.isfinite(errors_m)]
    if len(finite) < MIN_ROWS:
        return float("nan")
    longest = REGISTER_MAX * METRES_PER_TICK  # the registers of both ends at their maximum
    constant = np.clip(np.median(finite), -longest, longest)
    return float(np.median(np.abs(finite - constant)))


def reason_against_metres(ranges: Floats) -> str:
    """Return why numbers (n,) cannot be ranges in metres; empty text if they can."""
    finite = ranges[np.isfinite(ranges)]
    if len(finite) < MIN_ROWS:
        return ""
    middle = float(np.median(np.abs(finite)))
    if middle > 300.0:  # DW1000 devices reach 290 m in the open by their data sheet
        return f"the median range is {middle:.6g}, farther than devices reach in metres"
    # With noise of centimetres, ranges are not all integers, unless one number repeats.
    if len(np.unique(finite)) > MIN_ROWS // 4 and np.array_equal(finite, np.rint(finite)):
        return "all ranges are whole numbers, which measured metres are not"
    return ""


def reason_against_dbm(powers: Floats) -> str:
    """Return why numbers (n,) cannot be received powers in dBm; empty text if they can."""
    finite = powers[np.isfinite(powers) & (powers != 0)]  # boards print 0 for an unknown power
    middle = float(np.median(finite)) if len(finite) else -1.0
    # The legal limit of transmitted power is -41.3 dBm/MHz, -14 dBm in 500 MHz.
    return f"the median power is {middle:+.4g}, and received powers are below 0 dBm" if middle > 0 else ""


def truth_m(rows: Columns) -> Floats:
    """Return measured distances (n,), or else those between the antenna positions; NaN if unknown."""
    if "gt_range_m" in rows or not all(name in rows for name in POSITIONS):
        return optional(rows, "gt_range_m")
    ends = np.array([rows[name] for name in POSITIONS])
    return np.asarray(np.sqrt(((ends[3:] - ends[:3]) ** 2).sum(axis=0)))


def optional(rows: Columns, name: str) -> Floats:
    """Return a column (n,), or NaN if there is no such column."""
    return rows[name] if name in rows else np.full(len(rows["origin"]), np.nan)


def check_units(column_map: ColumnMap, path: Path, rows: Columns, raw_m: Floats | None) -> None:
    """Raise `ImportTableError` if a sample of rows shows that lengths or powers are in another unit.

    Implausible numbers are refused unless the map states their unit; lengths that contradict each other always are.
    `raw_m` are the ranges by the stamps (n,), if there are any.
    """
    for name in POWERS:
        if column_map.power_unit is None and (why := reason_against_dbm(optional(rows, name))):
            raise ImportTableError(
                f"{path}: column {column_map.header(name)!r}: {why}; state units.power in the map: "
                '"-dBm" if they lack their sign'
            )
    ranges, true = optional(rows, "range_m"), truth_m(rows)
    if column_map.distance_unit is None and (why := reason_against_metres(ranges)):
        raise ImportTableError(
            f"{path}: column {column_map.header('range_m')!r}: {why}; state units.distance in the map"
        )
    if raw_m is None:
        found = other_unit({"ranges": lambda f: ranges - true / f, "true distances": lambda f: ranges - f * true})
    else:
        found = other_unit({"ranges": lambda f: raw_m - f * ranges, "true distances": lambda f: raw_m - f * true})
    if found:
        beside = "the others" if raw_m is None else "its stamps"
        raise ImportTableError(
            f"{path}: {found[0]} are in {found[1]} by {beside}, and in {column_map.distance_unit or 'm'} by the map; "
            "units.distance is one unit for all ranges, true distances and positions"
        )
