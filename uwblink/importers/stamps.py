"""Stamps of strangers as ticks of one counter: any unit, wrapped, signed or unwrapped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.protocols.table import PROTOCOLS
from uwblink.twr import STAMPS

NEVER: Final = np.iinfo(np.int64).min
"""In place of a whole number that is missing."""

MANY: Final = 0.01
"""Share of rows beyond a counter's width from which on they are how the counter is written, not faults."""

ENOUGH_ROWS: Final = 20
STAMP_UNIT_TICKS: Final = 1.0
"""Ticks in the unit of stamps that are ticks; these are whole numbers, and each is taken as it is."""


def whole(values: Floats) -> Ints:
    """Return numbers rounded to whole ones, `NEVER` where there is none."""
    with np.errstate(invalid="ignore"):
        good = np.abs(values) < 2.0**62
    if good.all():
        return np.rint(values).astype(np.int64)
    return np.where(good, np.rint(np.where(good, values, 0.0)), NEVER).astype(np.int64)


def clocks(protocol: str) -> tuple[tuple[str, ...], ...]:
    """Return the stamps of an exchange by the clock that they are taken with, the initiator's first."""
    third = PROTOCOLS[protocol].third_sender
    if third is None:
        return ("tx1", "rx2"), ("rx1", "tx2")
    return (
        ("tx1", "rx2", "tx3" if third == "initiator" else "rx3"),
        ("rx1", "tx2", "rx3" if third == "initiator" else "tx3"),
    )


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
    if ticks_per_unit == STAMP_UNIT_TICKS:
        for name in (name for names in by_clock for name in names):
            ticks = whole(cells[name])
            found[name] = np.where(ticks == NEVER, NEVER, ticks & mask)
        return found
    for first, *others in by_clock:
        start = cells[first]
        ticks = whole(start * ticks_per_unit)
        found[first] = np.where(ticks == NEVER, NEVER, ticks & mask)
        for name in others:
            between = whole((cells[name] - start) * ticks_per_unit)
            missing = (ticks == NEVER) | (between == NEVER)
            found[name] = np.where(missing, NEVER, (ticks + between) & mask)
    return found


_WIDTHS: Final = ((32, "wrapped"), (32, "signed"), (40, "wrapped"), (40, "signed"))
"""Widths and ways to write a counter, in the order in which they are tried."""


@dataclass(slots=True)
class Counted:
    """How many stamps there are, and how many of them each width and way to write a counter can have shown."""

    stamps: int = 0
    fitting: dict[tuple[int, str], int] = field(default_factory=lambda: dict.fromkeys(_WIDTHS, 0))

    def add(self, ticks: Mapping[str, Floats]) -> None:
        """Count some rows, columns by name in ticks."""
        for column in ticks.values():
            self.stamps += int(np.count_nonzero(np.isfinite(column)))
            for width, counter in _WIDTHS:
                low = -(2.0 ** (width - 1)) if counter == "signed" else 0.0
                self.fitting[width, counter] += int(np.count_nonzero((column >= low) & (column < low + 2.0**width)))

    def told(self, bits: int | None, counter: str | None) -> tuple[int, str]:
        """Return a counter's bits and how it is written, as far as they are not given.

        Numbers that fit 32 bits are taken for 32, larger ones for 40, and those that fit neither for unwrapped;
        negative ones for signed where they fit. Less than `MANY` of the rows do not count: they are faults.
        """
        if self.stamps < ENOUGH_ROWS:
            return bits or 32, counter or "wrapped"
        for width, kind in _WIDTHS:
            beside = self.stamps - self.fitting[width, kind]
            if bits in (None, width) and counter in (None, kind) and beside <= MANY * self.stamps:
                return width, kind
        return bits or 32, counter or "unwrapped"


def how_counted(ticks: Mapping[str, Floats], bits: int | None, counter: str | None) -> tuple[int, str]:
    """Return a counter's bits and how it is written, as far as they are not given; see `Counted.told`."""
    counted = Counted()
    counted.add(ticks)
    return counted.told(bits, counter)


def beyond(ticks: Floats, bits: int, counter: str) -> Bools:
    """Return which stamps in ticks (n,) a counter cannot have shown."""
    if counter == "unwrapped":
        return np.zeros(len(ticks), dtype=bool)
    low = -(2.0 ** (bits - 1)) if counter == "signed" else 0.0
    with np.errstate(invalid="ignore"):
        return np.asarray((ticks < low) | (ticks >= low + 2.0**bits))


def stamps_of(protocol: str) -> tuple[str, ...]:
    """Return the names of the stamps that an exchange of a protocol has."""
    return STAMPS[: 2 * len(PROTOCOLS[protocol].messages)]
