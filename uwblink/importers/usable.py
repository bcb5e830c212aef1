"""Which rows of a table can be used: two passes over all of them at most, a block at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Floats, Ints
from uwblink.importers.column_map import IDS, STAMP_UNITS
from uwblink.importers.repeated import Repeated
from uwblink.importers.staging import Stage
from uwblink.importers.stamps import NEVER, Counted, beyond
from uwblink.importers.table_rows import Rows, RowSource, has_ends, take
from uwblink.importers.unusable import Unusable
from uwblink.twr import LARGEST_ID


@dataclass(frozen=True, slots=True)
class Usable:
    """The rows of a table that can be used: `flags` are bits, (n / 8,), `count` how many, `tags` their ids.

    `repeated` more are left out, which repeat an exchange.
    """

    flags: list[NDArray[np.uint8]]
    sizes: list[int]
    count: int
    tags: list[int]
    repeated: int = 0

    def of_blocks(self, blocks: Iterable[Rows]) -> Iterator[tuple[Rows, int]]:
        """Yield what can be used of the blocks of all rows, and how many such rows come before."""
        before = 0
        for block, packed, size in zip(blocks, self.flags, self.sizes, strict=True):
            good = np.unpackbits(packed, count=size).astype(bool)
            rows = block if good.all() else take(block, np.flatnonzero(good))
            yield rows, before
            before += len(rows)

    def places(self, chosen: Ints) -> Ints:
        """Return where some of the rows that can be used, in ascending order, are among all rows."""
        found, before, first = [], 0, 0
        for packed, size in zip(self.flags, self.sizes, strict=True):
            good = np.flatnonzero(np.unpackbits(packed, count=size))
            here = chosen[(chosen >= before) & (chosen < before + len(good))] - before
            found.append(first + good[here])
            before, first = before + len(good), first + size
        return np.concatenate(found) if found else np.empty(0, dtype=np.int64)


class _Collecting:
    """Rows that can be used, as blocks come; those that repeat an exchange are looked for where there is a stage."""

    def __init__(self, stage: Stage | None = None) -> None:
        self._repeated = Repeated(stage) if stage else None
        self.flags: list[NDArray[np.uint8]] = []
        self.sizes: list[int] = []
        self.count = 0
        self._seen = np.zeros(LARGEST_ID + 1, dtype=bool)

    def add(self, rows: Rows, good: Bools, stamps: Mapping[str, Floats] | None = None) -> None:
        if self._repeated and stamps is not None:
            self._repeated.add(rows, stamps, good, self.count)
        self.flags.append(np.packbits(good))
        self.sizes.append(len(good))
        self.count += int(np.count_nonzero(good))
        for name in IDS:
            self._seen[rows.ids[name][good]] = True

    def usable(self) -> Usable:
        twice = self._repeated.rows() if self._repeated else np.empty(0, dtype=np.int64)
        tags = np.flatnonzero(self._seen).tolist()
        if not len(twice):
            return Usable(self.flags, self.sizes, self.count, tags)
        flags, before = [], 0
        for packed, size in zip(self.flags, self.sizes, strict=True):
            good = np.unpackbits(packed, count=size)
            places = np.flatnonzero(good)
            good[places[twice[(twice >= before) & (twice < before + len(places))] - before]] = 0
            flags.append(np.packbits(good))
            before += len(places)
        return Usable(flags, self.sizes, self.count - len(twice), tags, len(twice))


def with_ends(rows: Rows, unusable: Unusable) -> Bools:
    """Return which rows name two different devices, (n,)."""
    for name in IDS:
        unusable.reject(rows, name, rows.ids[name] == NEVER, f"a whole number from 0 to {LARGEST_ID}")
    same = (rows.ids["from_id"] == rows.ids["to_id"]) & (rows.ids["to_id"] != NEVER)
    unusable.reject(rows, "to_id", same, "another tag than from_id")
    return has_ends(rows)


def usable_ranges(source: RowSource, unusable: Unusable) -> Usable:
    """Return the rows that hold a plain range."""
    found = _Collecting()
    for rows in source.blocks(["range_m"]):
        good = with_ends(rows, unusable) & _timed(rows, unusable)
        finite = np.isfinite(rows.cells["range_m"])
        unusable.reject(rows, "range_m", good & ~finite, "a finite number")
        found.add(rows, good & finite)
    return found.usable()


def usable_exchanges(
    source: RowSource, unusable: Unusable, stamps: tuple[str, ...], stage: Stage
) -> tuple[Usable, int, str]:
    """Return the rows that hold all stamps, each exchange once, the counter's bits, and how it is written."""
    column_map = source.column_map
    assumed: tuple[int, str] | None = None
    while True:
        found, counted, bad = _Collecting(stage), Counted(), Unusable()
        for rows in source.blocks(stamps):
            ticks = {name: _ticks(rows, name) for name in stamps}
            counted.add(ticks)
            # What the first rows say is what all say, or all are looked at again.
            assumed = assumed or counted.told(column_map.bits, column_map.counter)
            good = with_ends(rows, bad) & _timed(rows, bad)
            for name, column in ticks.items():
                good &= _stamped(rows, name, column, assumed, bad, good)
            found.add(rows, good, ticks)
        told = counted.told(column_map.bits, column_map.counter)
        if told == (assumed or told):
            unusable.take(bad)
            return found.usable(), *told
        assumed = told


def _ticks(rows: Rows, name: str) -> Floats:
    scale = rows.column_map.ticks_per_unit
    return rows.cells[name] if scale == 1.0 else rows.cells[name] * scale


def _timed(rows: Rows, unusable: Unusable) -> Bools:
    if rows.time_ns is None:
        return np.ones(len(rows), dtype=bool)
    unusable.reject(rows, "time_s", (rows.time_ns == NEVER) & has_ends(rows), "a time")
    return np.asarray(rows.time_ns != NEVER)


def _stamped(rows: Rows, name: str, ticks: Floats, counted: tuple[int, str], unusable: Unusable, good: Bools) -> Bools:
    """Return which rows have a stamp that can be one, (n,)."""
    bits, counter = counted
    largest = (1 << bits) - 1
    finite = np.isfinite(ticks)
    out = finite & beyond(ticks, bits, counter)
    parts = np.zeros(len(ticks), dtype=bool)
    whole = rows.column_map.ticks_per_unit == STAMP_UNITS["ticks"]
    if whole:
        parts = finite & (ticks != np.rint(ticks))
    unusable.reject(rows, name, good & ~finite, "a finite number")
    unit = "a whole number" if whole else "a stamp in ticks"
    low = 0 if counter == "wrapped" else -largest // 2
    unusable.reject(rows, name, good & (out | parts), f"{unit} from {low} to {largest}")
    return np.asarray(finite & ~out & ~parts)
