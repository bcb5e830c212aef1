"""Which rows of a long table belong together: those with the same keys, not far apart in time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.importers.table_rows import Rows, joined, take
from uwblink.twr import LARGEST_ID

MOST: Final = 2.0**62
"""What is beyond is no number of anything."""


@dataclass(frozen=True, slots=True)
class Together:
    """Sorted rows, the group of each (n,), and where groups begin (groups,)."""

    rows: Rows
    group: Ints
    start: Ints

    def put(self, values: Floats, mine: Bools) -> Floats:
        """Return the values of some rows by group (groups,), NaN where a group has no such row."""
        found = np.full(len(self.start), np.nan)
        found[self.group[mine]] = values[mine]
        return found

    def largest(self) -> dict[str, Floats]:
        """Return the largest number of each column in each group (groups,), NaN where there is none."""
        cells = self.rows.cells
        return {n: np.fmax.reduceat(c, self.start) if len(self.start) else c for n, c in cells.items()}


@dataclass(frozen=True, slots=True)
class Belonging:
    """Rows of a group have the same `keys`, and lie next to each other in time; `numbered` messages only go up."""

    keys: Callable[[Rows], list[Ints]]
    numbered: bool = False

    def in_order(self, rows: Rows) -> Rows:
        """Return rows (which name two devices) in the order of their keys, their time, and as they came."""
        time = [] if rows.time_ns is None else [rows.time_ns]
        return take(rows, np.lexsort((*time, *reversed(self.keys(rows)))))

    def together(self, rows: Rows) -> Together:
        """Return rows (which name two devices) in order, by group."""
        rows = self.in_order(rows)
        begins = self.begins(rows)
        return Together(rows, np.cumsum(begins) - 1, np.flatnonzero(begins))

    def begins(self, rows: Rows) -> Bools:
        """Return which of sorted rows are the first of a group, (n,)."""
        begins: Bools = np.ones(len(rows), dtype=bool)
        begins[1:] = np.any([np.diff(key) != 0 for key in self.keys(rows)], axis=0)
        if rows.time_ns is not None:
            begins[1:] |= np.diff(rows.time_ns.astype(np.float64)) > rows.column_map.within_s * 1e9
        if self.numbered and "message" in rows.cells:
            begins[1:] |= ~(np.diff(rows.cells["message"]) > 0)
        return begins

    def whole_groups(self, blocks: Iterable[Rows]) -> Iterator[Rows]:
        """Yield the rows of sorted blocks in their order, in blocks that end where a group does."""
        held: list[Rows] = []
        for block in filter(len, blocks):
            before = take(held[-1], np.array([-1])) if held else None
            begins = self.begins(joined([before, block]))[1:] if before else self.begins(block)
            edges = np.flatnonzero(begins)
            cut = int(edges[-1]) if len(edges) else 0
            if cut:
                yield joined([*held, take(block, np.arange(cut))])
                held = []
            elif len(edges) and held:
                yield joined(held)
                held = []
            held.append(take(block, np.arange(cut, len(block))) if cut else block)
        if held:
            yield joined(held)


def _by_pair(rows: Rows) -> list[Ints]:
    low, high = (f(rows.ids["from_id"], rows.ids["to_id"]) for f in (np.minimum, np.maximum))
    return [low * (LARGEST_ID + 1) + high, *_numbers(rows, "sequence")]


def _by_sender(rows: Rows) -> list[Ints]:
    ends = rows.ids["from_id"] * (LARGEST_ID + 1) + rows.ids["to_id"]
    return [ends, *_numbers(rows, "sequence", "message")]


def _numbers(rows: Rows, *names: str) -> list[Ints]:
    return [numbers(rows.cells[n], -1) for n in names if n in rows.cells]


def numbers(column: Floats, missing: int) -> Ints:
    """Return numbers of messages or of exchanges as whole ones (n,); none is so large that it could not be one."""
    return np.clip(np.nan_to_num(column, nan=missing), -MOST, MOST).astype(np.int64)


MESSAGES: Final = Belonging(_by_pair, numbered=True)
"""Messages of an exchange."""
STAMPS: Final = Belonging(_by_sender)
"""Stamps of a message."""
PARTS: Final = Belonging(_by_pair)
"""Parts of an exchange."""
