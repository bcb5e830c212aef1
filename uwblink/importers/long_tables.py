"""Tables in which an exchange has several rows, as exchanges: of any length, some rows at a time.

Rows that are too many to be in memory are put in order by what they belong together by, in a file, and read in blocks
that end where a group does. What all rows decide is taken from the first block, and looked at again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from uwblink.importers.belonging import MESSAGES, PARTS, STAMPS, Belonging
from uwblink.importers.messages import USED, Numbered, Votes, from_parts, from_single_stamps, messages_of
from uwblink.importers.split_rows import Order, SplitRows, collected, drawn, split
from uwblink.importers.staged_tables import StagedTables, Watch
from uwblink.importers.table_rows import HeldRows, Rows, RowSource, has_ends, take
from uwblink.importers.unusable import Unusable
from uwblink.importers.usable import with_ends

_NEEDED: Final = {"messages": ("tx", "rx"), "stamps": ("stamp", "event", "message")}

Ordered = HeldRows | SplitRows
"""Rows of which those that belong together follow each other, or that are in memory."""


def exchanges_of_long(
    tables: StagedTables, layout: str, unusable: Unusable, watch: Watch | None = None
) -> tuple[RowSource, str | None]:
    """Return rows of "messages", "stamps" or "parts" as exchanges, and the protocol as far as they tell it.

    Notes the rows that belong to no whole exchange. Raises `ImportTableError`.
    """
    for name in _NEEDED.get(layout, ()):
        if not tables.has(name):
            raise tables.missing(name)
    long = _LongTable(tables, unusable, watch)
    if layout == "parts":
        parts = long.made(from_parts, long.split(long.named(None), PARTS), PARTS)
        return collected(tables.stage, parts), None
    rows = long.named(USED)
    if layout == "messages":
        return long.exchanges(rows)
    messages = long.made(from_single_stamps, long.split(rows, STAMPS), STAMPS)
    return long.exchanges(messages, as_read=False)


@dataclass(frozen=True, slots=True)
class _LongTable:
    tables: StagedTables
    unusable: Unusable
    watch: Watch | None

    def named(self, names: Collection[str] | None) -> Iterator[Rows]:
        """Yield the rows that name two devices, with the cells of some columns (None: of all)."""
        for rows in self._told("sorting", self.tables.blocks(names), len(self.tables)):
            yield take(rows, np.flatnonzero(with_ends(rows, self.unusable)))

    def split(self, parts: Iterable[Rows], belonging: Belonging, *, as_read: bool = True) -> Ordered:
        """Return rows, those together that belong together; see `Order`."""
        return split(self.tables.stage, parts, Order(belonging, self.some, as_read))

    def some(self) -> Rows:
        """Return some of the rows that name two devices, with what they belong together by."""
        rows = self.tables.at(drawn(len(self.tables)), ("sequence", "message"))
        return take(rows, np.flatnonzero(has_ends(rows)))

    def made(self, make: Callable[[Rows, Unusable], Rows], ordered: Ordered, belonging: Belonging) -> Iterator[Rows]:
        """Yield what is made of groups of rows, which are forgotten then."""
        for rows in self._groups(ordered, belonging):
            yield make(rows, self.unusable)
        _forget(ordered)

    def exchanges(self, parts: Iterable[Rows], *, as_read: bool = True) -> tuple[RowSource, str]:
        """Return the exchanges of messages, and their protocol."""
        protocol, numbered = None, Numbered()
        messages = self.split(numbered.seen(parts), MESSAGES, as_read=as_read)
        while True:
            read = _Exchanges(numbered, protocol)
            found = collected(self.tables.stage, map(read.of, self._groups(messages, MESSAGES)))
            protocol = read.votes.told()
            if protocol == read.protocol:
                self.unusable.take(read.unusable)
                _forget(messages)
                return found, protocol

    def _groups(self, ordered: Ordered, belonging: Belonging) -> Iterator[Rows]:
        if isinstance(ordered, HeldRows):
            return iter([ordered.rows])
        return belonging.whole_groups(self._told("grouping", ordered.blocks(), len(ordered)))

    def _told(self, what: str, blocks: Iterable[Rows], total: int) -> Iterator[Rows]:
        done = 0
        for rows in blocks:
            if self.watch:
                self.watch(what, done / total)
            yield rows
            done += len(rows)


@dataclass(slots=True)
class _Exchanges:
    """Exchanges of blocks of messages by a protocol, or the one that those of the first block tell."""

    numbered: Numbered
    protocol: str | None
    votes: Votes = field(default_factory=Votes)
    unusable: Unusable = field(default_factory=Unusable)

    def of(self, rows: Rows) -> Rows:
        """Return the exchanges of some messages."""
        messages = messages_of(rows, self.numbered)
        self.votes.add(messages)
        self.protocol = self.protocol or self.votes.told()
        return messages.exchanges(self.protocol, self.unusable)


def _forget(ordered: Ordered) -> None:
    if isinstance(ordered, SplitRows):
        ordered.close()
