"""Determine the meaning of numbers in a table: units of lengths and powers, format and protocol of stamps.

Stamps have any unit and are wrapped, signed or unwrapped; they become ticks of one counter. A range is plausible
between -2 m (antenna delays) and 2 km, and within 50 m of the measured distance, if there is one. For single-sided
ranging the limits are extended by the error of clocks 50 ppm apart over the reply. The effect of missing antenna delays
is subtracted first: 154 m if none were programmed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Columns, Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import DISTANCE_UNITS, FLIGHT_UNITS, IDS, POSITIONS, POWERS, ColumnMap
from uwblink.importers.devices import CHIPS
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.antenna_delays import REGISTER_MAX, AntennaDelay, delay_of
from uwblink.ticks import ANTENNA_DELAY_TICKS, METRES_PER_TICK, SPEED_OF_LIGHT, TICK_S
from uwblink.twr import STAMPS, Exchanges, intervals, raw_range

MIN_ROWS: Final = 20
"""Minimum number of rows: fewer rows can agree with any assumption by chance."""

SAMPLE_ROWS: Final = 2000
"""Number of rows for trials of readings."""

ACCEPTED_SHARE: Final = 0.5
"""Share of plausible ranges from which a reading is accepted without trying others."""

FITTING_SHARE: Final = 0.9
"""Share of plausible ranges from which another reading fits."""


def clocks(protocol: str) -> tuple[tuple[str, ...], ...]:
    """Return the stamps of an exchange by clock, those of the initiator first."""
    numbered = list(enumerate(PROTOCOLS[protocol].messages, 1))
    return tuple(
        tuple(f"{'tx' if message.sender == side else 'rx'}{number}" for number, message in numbered)
        for side in ("initiator", "target")
    )


def stamps_of(protocol: str) -> tuple[str, ...]:
    """Return the names of the stamps of an exchange of a protocol."""
    return STAMPS[: 2 * len(PROTOCOLS[protocol].messages)]


def to_ticks(
    cells: Mapping[str, NDArray[Any]], by_clock: Iterable[tuple[str, ...]], ticks_per_unit: float, bits: int
) -> dict[str, Ints]:
    """Return stamps in any unit as ticks of a counter of `bits` bits; values of missing stamps are arbitrary.

    Stamps in other units were scaled and written as floats, with an error that grows with the length of the record;
    differences of stamps of one clock are accurate. So the first stamp of each clock is rounded, and the differences of
    the others from it are rounded separately.
    """

    def whole(values: NDArray[Any]) -> Ints:
        if ticks_per_unit == 1.0 and values.dtype == np.int64:
            return values
        return np.rint(np.clip(np.nan_to_num(values * ticks_per_unit), -(2.0**62), 2.0**62)).astype(np.int64)

    found: dict[str, Ints] = {}
    for first, *others in by_clock:
        start = whole(cells[first])
        since = {name: whole(cells[name] - cells[first]) for name in others}
        found |= {first: start} | {name: start + ticks for name, ticks in since.items()}
    return {name: ticks & np.int64((1 << bits) - 1) for name, ticks in found.items()}


def counter_format(
    ticks: Iterable[NDArray[Any]], bits: int | None = None, counter: str | None = None
) -> tuple[int, str]:
    """Return the width of a counter in bits and its format ("wrapped", "signed", "unwrapped"), unless they are given.

    The width is 32 bits, or else 40 bits, if 99 % of the stamps fit, wrapped or signed; the other stamps are faults. If
    none fits, stamps are unwrapped.
    """
    stamps = np.concatenate([column[np.isfinite(column)] for column in ticks])
    enough = len(stamps) >= MIN_ROWS
    for width, kind in ((32, "wrapped"), (32, "signed"), (40, "wrapped"), (40, "signed")):
        low = -(2.0 ** (width - 1)) if kind == "signed" else 0.0
        asked = enough and bits in (None, width) and counter in (None, kind)
        if asked and np.mean((stamps >= low) & (stamps < low + 2.0**width)) >= 0.99:
            return width, kind
    return bits or 32, counter or ("unwrapped" if enough else "wrapped")


@dataclass(frozen=True, slots=True)
class Reading:
    """An interpretation of stamps: protocol, width of the counter, exchanged columns, and missing antenna delays."""

    protocol: str
    bits: int
    swapped: tuple[tuple[str, str], ...] = ()
    undelayed: bool = False
    """Whether no antenna delays were programmed, regardless of the map."""

    def difference(self, other: Reading) -> str:
        """Return the differences from another reading, as entries of a map."""
        found = [f'protocol = "{self.protocol}"'] if self.protocol != other.protocol else []
        found += [f"bits = {self.bits}"] if self.bits != other.bits else []
        found += [f"the columns of {one} and {two} exchanged" for one, two in self.swapped]
        found += ["[antenna_delays] tx = 0 and rx = 0"] if self.undelayed else []
        return " and ".join(found)


@dataclass(frozen=True, slots=True)
class Trial:
    """Result of a reading: the share of plausible ranges, and limits of the middle 90 % of ranges and of errors."""

    reading: Reading
    plausible: float
    range_m: tuple[float, float]
    error_m: tuple[float, float]

    def __str__(self) -> str:
        """Return the limits of ranges."""
        return f"{self.range_m[0]:.4g} to {self.range_m[1]:.4g} m"


def try_reading(rows: Columns, column_map: ColumnMap, reading: Reading) -> Trial:
    """Return the result of a reading on a sample of rows, compared with true distances if there are any."""
    columns = dict(rows)
    for one, two in reading.swapped:
        columns[one], columns[two] = columns[two], columns[one]
    exchanges = exchanges_of(column_map, columns, reading)
    # Half of the missing delays of both devices, for transmission and reception.
    longer_m = 2 * ANTENNA_DELAY_TICKS * METRES_PER_TICK if reading.undelayed else _longer_m(column_map, rows)
    raw = raw_range(exchanges) - longer_m
    ranges = np.where(np.isfinite(raw), raw, np.nan)  # they are infinite if the last two messages have the same time
    true = exchanges.truth_m
    spans, half = intervals(exchanges), 2.0 ** (reading.bits - 1)
    single = PROTOCOLS[reading.protocol].third_sender is None
    allowance = 50e-6 * spans.dt32 * TICK_S * SPEED_OF_LIGHT / 2 if single else 0.0
    with np.errstate(invalid="ignore"):
        good = (ranges > -2.0 - allowance) & (ranges < 2000.0 + allowance)
        good &= (spans.dt41 < half) & (spans.dt32 < half)
        if not single:
            good &= (spans.dt53 < half) & (spans.dt64 < half) & (spans.dt53 > 0)
        good &= ~np.isfinite(true) | (np.abs(ranges - true) < 50.0 + allowance)
        # With exchanged columns of stamps, a third message of the initiator looks like one of the target with a clock
        # rate that depends on the range: dt64 - dt53 = -(dt41 - dt32).
        there_and_back, apart = spans.dt41 - spans.dt32, spans.dt64 - spans.dt53
        with_third, without = (
            np.subtract(*np.percentile(x, [75, 25])) for x in (there_and_back + apart, there_and_back)
        )
        good &= not (with_third < 0.05 * without and PROTOCOLS[reading.protocol].third_sender == "target")
    limits = [
        np.percentile(some, [5, 95]) if len(some := values[np.isfinite(values)]) else (np.nan, np.nan)
        for values in (ranges, ranges - np.nan_to_num(true))
    ]
    return Trial(reading, float(np.mean(good)), *((float(low), float(high)) for low, high in limits))


def _longer_m(column_map: ColumnMap, rows: Columns) -> Floats:
    """Return the lengths (n,) that missing antenna delays add to ranges, by the map."""
    ends = np.array([rows[name] for name in IDS])
    tags, which = np.unique(ends, return_inverse=True)
    programmed = [delay_of(column_map.antenna_delays, int(tag)) or AntennaDelay() for tag in tags]
    lacking = np.array([2 * ANTENNA_DELAY_TICKS - one.tx - one.rx for one in programmed], np.float64)
    return np.asarray(lacking[which.reshape(ends.shape)].sum(axis=0) / 2 * METRES_PER_TICK)


def settle_reading(path: Path, column_map: ColumnMap, rows: Columns, reading: Reading) -> tuple[Reading, str]:
    """Return the reading of stamps, and a note: the reading of the map, or another one if only that gives plausible
    ranges.

    Raises `ImportTableError` if this contradicts the map.
    """
    first = try_reading(rows, column_map, reading)
    if first.plausible >= ACCEPTED_SHARE or len(rows["origin"]) < MIN_ROWS:
        return reading, ""
    for others in _others(rows, reading):
        trials = [try_reading(rows, column_map, other) for other in others]
        if fitting := [trial for trial in trials if trial.plausible >= FITTING_SHARE]:
            break
    else:
        return reading, (
            f"the ranges are not plausible ({first}), and neither are they with another protocol, width or order of "
            f"the columns; check the map"
        )
    # Order: the larger share of plausible ranges, then the smaller spread.
    best = min(fitting, key=lambda trial: (-round(trial.plausible, 2), trial.error_m[1] - trial.error_m[0]))
    found, difference = best.reading, best.reading.difference(reading)
    contradicted = (
        found.swapped
        or (column_map.protocol and found.protocol != reading.protocol)
        or (column_map.bits and found.bits != reading.bits)
        or (column_map.antenna_delays and found.undelayed)
    )
    if contradicted:
        raise ImportTableError(
            f'{path}: by protocol "{reading.protocol}" its ranges are {first}; with {difference} they are {best}: '
            "state that in the map"
        )
    return found, f'read with {difference}: by protocol "{reading.protocol}" the ranges would be {first}'


def _others(rows: Columns, reading: Reading) -> Iterator[list[Reading]]:
    """Yield alternative readings, simple ones first: another protocol or width, exchanged columns, or both."""
    names = [row.name for row in PROTOCOLS.known() if set(stamps_of(row.name)) <= set(rows)]
    names = [name for name in names if name != "ss-cfo" and (name != "ds-sym" or reading.protocol == name)]
    plain = [Reading(name, bits) for name in names for bits in (reading.bits, 72 - reading.bits)]
    used = stamps_of(reading.protocol)
    # Without true distances, ranges of devices without antenna delays are as plausible as those with them.
    yield [replace(reading, undelayed=True)] if np.isfinite(truth_m(rows)).any() else []
    yield [other for other in plain if other != reading and stamps_of(other.protocol) == used]
    swaps = [*((pair,) for pair in combinations(used, 2)), (("tx1", "rx1"), ("tx2", "rx2"))]
    yield [Reading(reading.protocol, reading.bits, swap) for swap in swaps]
    yield [other for other in plain if stamps_of(other.protocol) != used]
    yield [Reading(other.protocol, other.bits, swap) for other in plain for swap in swaps]


ROW_PERIOD_NS: Final = 1_000_000
"""Time between the rows of a table without times."""


def exchanges_of(column_map: ColumnMap, rows: Columns, reading: Reading | None, before: int = 0) -> Exchanges:
    """Return rows as exchanges with the reported ranges, NaN where there are none; `before` counts earlier rows.

    Without a reading the rows are ranges without stamps: single-sided exchanges whose stamps are 0. The total received
    power is used if there is no first-path power.
    """
    power = "fpp" if "fpp1" in rows or "fpp2" in rows else "rxp"
    count = len(rows["origin"])
    stamps: dict[str, Any] = dict.fromkeys(STAMPS, np.zeros(count, dtype=np.int64))
    protocol, bits = (reading.protocol, reading.bits) if reading else ("ss", 32)
    if reading:
        stamps |= to_ticks(rows, clocks(protocol), column_map.factor("tx1"), bits)
    return Exchanges(
        time_ns=rows.get("time_ns", np.arange(before, before + count) * ROW_PERIOD_NS),
        initiator=rows["from_id"], target=rows["to_id"], reporter=rows["from_id"], protocol=np.full(count, protocol),
        range_m=optional(rows, "range_m"), fpp1_dbm=optional(rows, power + "1"), fpp2_dbm=optional(rows, power + "2"),
        skew1_ppm=optional(rows, "skew1"), skew2_ppm=optional(rows, "skew2"), truth_m=truth_m(rows), bits=bits,
        **stamps,
    )  # fmt: skip


def truth_m(rows: Columns) -> Floats:
    """Return measured distances (n,), or else distances between the antenna positions; NaN if unknown."""
    if "gt_range_m" in rows or not all(name in rows for name in POSITIONS):
        return optional(rows, "gt_range_m")
    ends = np.array([rows[name] for name in POSITIONS])
    return np.asarray(np.sqrt(((ends[3:] - ends[:3]) ** 2).sum(axis=0)))


def optional(rows: Columns, name: str) -> Floats:
    """Return a column (n,), or NaN if there is no such column."""
    return rows[name] if name in rows else np.full(len(rows["origin"]), np.nan)


Errors = Callable[[float], Floats]
"""Returns ranges minus distances (n,) with some lengths multiplied by a factor, in the given unit of the ranges.

In this unit noise does not depend on the factor; otherwise ranges of boards at rest would seem to be in feet.
"""


def other_unit(errors: Mapping[str, Errors], ranges: str) -> str:
    """Return which lengths are evidently in which other unit, such as "ranges are in mm"; "" if all are in metres.

    `errors` are by the name of the multiplied lengths; lengths named `ranges` may be times of flight. The residuals of
    the errors from a constant (antenna delays) are compared: a unit is found if they are smaller by more than the
    square root of its factor. Residuals of distances that are unrelated to the ranges shrink to the spread of the
    ranges, by at most the square root of two.
    """
    best, found = 0.0, ""
    for name, of in errors.items():
        plain = _remaining(of(1.0))
        for unit, factor in (DISTANCE_UNITS | (FLIGHT_UNITS if name == ranges else {})).items():
            gain = np.log(plain / max(_remaining(of(factor)), METRES_PER_TICK)) if plain > 0 else 0.0
            if factor < 1.0 and gain > max(best, -np.log(factor) / 2):
                best, found = gain, f"{name} are in {unit}"
    return found


def _remaining(errors_m: Floats) -> float:
    """Return the median absolute residual of errors from a constant within antenna delays; NaN for few values."""
    finite = errors_m[np.isfinite(errors_m)]
    if len(finite) < MIN_ROWS:
        return float("nan")
    longest = REGISTER_MAX * METRES_PER_TICK  # the registers of both ends at their maximum
    return float(np.median(np.abs(finite - np.clip(np.median(finite), -longest, longest))))


def sentinels(ranges: Floats) -> dict[float, float]:
    """Return the share of each number that probably marks a missing range, such as 0, -1 or 65535.

    Such a number is zero, negative, or five times larger than all others, and occurs at least twice and in 0.1 % of the
    numbers (n,), which are in the unit of the table; or it is the largest number of 16 or 32 bits, or -1 as the only
    negative number.
    """
    finite = ranges[np.isfinite(ranges)]
    values, counts = np.unique(finite, return_counts=True)
    known = [2.0**16 - 1, 2.0**32 - 1] + ([-1.0] if np.count_nonzero(values < 0) == 1 else [])
    often = (counts >= max(2, 0.001 * len(finite))) | np.isin(np.round(values, 3), known)
    if len(finite) < MIN_ROWS or len(values) < 3:
        return {}
    others = finite[~np.isin(finite, values[often])]
    farthest = float(np.max(others, initial=0.0)) if len(others) else float(np.median(finite))
    odd = often & ((values <= 0.0) | (values > 5 * farthest))
    return {float(v): float(n) / len(finite) for v, n in zip(values[odd], counts[odd], strict=True)}


def reason_against_metres(ranges: Floats) -> str:
    """Return the reason why numbers (n,) cannot be ranges in metres; empty text if they can."""
    finite = ranges[np.isfinite(ranges)]
    middle = float(np.median(np.abs(finite))) if len(finite) >= MIN_ROWS else 0.0
    if middle > 300.0:  # DW1000 devices reach 290 m in the open by their data sheet
        return f"the median range is {middle:.6g}, in metres longer than the reach of the devices"
    if 0.0 < middle < 1e-6:  # times in seconds: light travels 300 m in a microsecond
        return f"the median is {middle:.3g}, impossible in metres"
    # With noise of centimetres, ranges are not all integers, unless one number repeats.
    if len(np.unique(finite)) > MIN_ROWS // 4 and np.array_equal(finite, np.rint(finite)) and middle:
        return "all ranges are whole numbers, unlike ranges in metres"
    return ""


def reason_against_dbm(powers: Floats, limits: tuple[float, float] = CHIPS["other"].power_dbm) -> str:
    """Return the reason why numbers (n,) cannot be received powers in dBm within a chip's limits; empty text if they
    can.
    """
    finite = powers[np.isfinite(powers) & (powers != 0)]  # boards print 0 for an unknown power
    middle, (low, high) = float(np.median(finite)) if len(finite) else limits[0], limits
    return "" if low <= middle <= high else f"the median power is {middle:+.4g}, expected {low:g} to {high:g} dBm"


def check_units(column_map: ColumnMap, path: Path, rows: Columns, raw_m: Floats | None) -> None:
    """Raise `ImportTableError` if a sample of rows shows that lengths or powers are in another unit.

    Implausible numbers are refused unless the map states their unit; lengths that contradict each other are always
    refused. `raw_m` are the ranges by the stamps (n,), if there are any.
    """
    ranges, true = optional(rows, "range_m"), truth_m(rows)
    reasons, limits = dict[str, tuple[str, str]](), CHIPS[column_map.chip or "other"].power_dbm
    for name in POWERS:
        remedy = 'units.power in the map: "-dBm" if they lack their sign'
        if column_map.unit_of(name) is None:
            reasons[name] = reason_against_dbm(optional(rows, name)), remedy
        elif column_map.chip and (why := reason_against_dbm(optional(rows, name), limits)):
            reasons[name] = why, f"another unit, chip or prf than {column_map.chip!r} and {column_map.prf} in the map"
    for name in ("range_m", "gt_range_m") if raw_m is None else ():
        factor = column_map.factor(name)
        for value, share in sentinels(np.round(optional(rows, name) / factor, 6)).items():
            why = f"{share:.1%} of its numbers are {value:.10g}, which is not a distance"
            reasons[name] = why, f"missing = [{value:.10g}] in the map"
    for name in ("range_m", "difference_m"):
        if column_map.unit_of(name) is None and name not in reasons:
            reasons[name] = reason_against_metres(optional(rows, name)), f"units.distance or units.{name} in the map"
    for name, (why, remedy) in reasons.items():
        if why:
            raise ImportTableError(f"{path}: column {column_map.header(name)!r}: {why}; state {remedy}")
    errors: dict[str, Errors] = (
        {"ranges": lambda f: ranges - true / f, "true distances": lambda f: ranges - f * true}
        if raw_m is None
        else {"ranges": lambda f: raw_m - f * ranges, "true distances": lambda f: raw_m - f * true}
    )
    if found := other_unit(errors, "ranges"):
        lengths, unit = found.split(" are in ")
        column, other = ("range_m", "true distances") if lengths == "ranges" else ("gt_range_m", "ranges")
        raise ImportTableError(
            f"{path}: {found} according to the {other if raw_m is None else 'stamps'}, and in "
            f"{column_map.unit_of(column) or 'm'} according to the map; write units.{column} = {unit!r} in the map, "
            f"or units.distance for both"
        )
