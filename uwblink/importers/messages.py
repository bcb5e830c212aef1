"""Long tables, in which an exchange has several rows, as rows of exchanges.

Either each row is a message with the stamps of its sender and its receiver, or one of these stamps, or each row has
some of the columns of an exchange, as where both devices report. Rows belong together by pair and sequence number, or
by pair and time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.importers.belonging import MESSAGES, PARTS, STAMPS, Together, numbers
from uwblink.importers.table_rows import RECEIVED, SENT, Rows, take
from uwblink.importers.unusable import Unusable
from uwblink.twr import STAMPS as STAMP_NAMES

_OF_MESSAGE: Final = {"fpp": "fpp", "rxp": "rxp", "skew": "skew"}
_AS_THEY_ARE: Final = ("gt_range_m", "range_m")

USED: Final = ("sequence", "message", "tx", "rx", "stamp", "event", *_OF_MESSAGE, *_AS_THEY_ARE)
"""Columns of messages and of single stamps that exchanges are made of."""


@dataclass(slots=True)
class Numbered:
    """Which numbers messages have in their column, as rows come."""

    some: int = 0
    zeros: int = 0
    largest: float = -np.inf

    def seen(self, parts: Iterable[Rows]) -> Iterator[Rows]:
        """Yield rows and count them."""
        for rows in parts:
            found = rows.cells.get("message", np.empty(0))
            found = found[np.isfinite(found)]
            self.some += len(found)
            self.zeros += int(np.count_nonzero(found == 0))
            self.largest = float(found.max(initial=self.largest))
            yield rows

    @property
    def less(self) -> int:
        """What to add to the numbers: 1 where they are 0, 1 and 2, and 0 is no rare damage."""
        return int(self.largest <= 2 and 4 * self.zeros > self.some)


@dataclass(slots=True)
class Votes:
    """How many messages are second ones, third ones, and third ones by the initiator."""

    second: int = 0
    third: int = 0
    third_by_initiator: int = 0

    def add(self, messages: Messages) -> None:
        """Count some messages."""
        third = messages.place == 3
        self.second += int(np.count_nonzero(messages.place == 2))
        self.third += int(np.count_nonzero(third))
        self.third_by_initiator += int(np.count_nonzero(third & (messages.sender == messages.initiator)))

    def told(self) -> str:
        """Return the protocol that most messages tell."""
        if not 2 * self.third > self.second:
            return "ss"
        return "ds-alt" if 2 * self.third_by_initiator > self.third else "ds"


@dataclass(frozen=True, slots=True)
class Messages:
    """Messages by exchange; the number of each (n,), by a column or by their order."""

    together: Together
    place: Ints

    @property
    def sender(self) -> Ints:
        """Who sent each message, (n,)."""
        return self.together.rows.ids["from_id"]

    @property
    def initiator(self) -> Ints:
        """Who sent the first message of each message's exchange, (n,)."""
        return self._of_first("from_id")

    def exchanges(self, protocol: str, unusable: Unusable) -> Rows:
        """Return the exchanges by a protocol; notes the rows that belong to no whole one."""
        rows, group, start = self.together.rows, self.together.group, self.together.start
        expected = (1, 2) if protocol == "ss" else (1, 2, 3)
        good = (self.sender == self._expected(protocol)) & (self.place >= 1) & (self.place <= len(expected))
        exchanges = take(rows, start)
        exchanges.cells = {name: column for name, column in exchanges.cells.items() if name in _AS_THEY_ARE}
        for number in expected:
            exchanges.cells |= self._cells(number, good & (self.place == number))
        whole = np.bincount(group, weights=good, minlength=len(start)) == len(expected)
        unusable.add("message", rows.origin[start[~whole]], "messages 1, 2 (and 3) of one exchange")
        return take(exchanges, np.flatnonzero(whole))

    def _expected(self, protocol: str) -> Ints:
        """Return who should have sent each message, (n,)."""
        of_target = (self.place == 2) | ((self.place == 3) & (protocol != "ds-alt"))
        return np.where(of_target, self._of_first("to_id"), self.initiator)

    def _cells(self, number: int, mine: Bools) -> dict[str, Floats]:
        """Return what the messages of one number say, by exchange."""
        names = {f"tx{number}": "tx", f"rx{number}": "rx"}
        if number < 3:
            names |= {f"{ours}{number}": theirs for theirs, ours in _OF_MESSAGE.items()}
        cells = self.together.rows.cells
        return {ours: self.together.put(cells[theirs], mine) for ours, theirs in names.items() if theirs in cells}

    def _of_first(self, name: str) -> Ints:
        return self.together.rows.ids[name][self.together.start][self.together.group]


def messages_of(rows: Rows, numbered: Numbered) -> Messages:
    """Return rows that are messages by their exchange.

    Messages are 1, 2 and 3, by a column (or 0, 1 and 2 there) or by their order. The first one's sender is the
    initiator; who sends the third tells "ds" from "ds-alt".
    """
    together = MESSAGES.together(rows)
    message = together.rows.cells.get("message")
    if message is not None:
        return Messages(together, numbers(message, 9) + numbered.less)
    return Messages(together, np.arange(len(rows)) - together.start[together.group] + 1)


def from_single_stamps(rows: Rows, unusable: Unusable) -> Rows:
    """Return rows that are messages, of rows that each have one stamp; notes those whose message lacks one or has two.

    Rows belong together by sender, receiver, number of the message, and sequence number or time.
    """
    together = STAMPS.together(rows)
    rows, group, start = together.rows, together.group, together.start
    messages, whole = take(rows, start), np.ones(len(start), dtype=bool)
    messages.cells = {name: c for name, c in together.largest().items() if name not in ("stamp", "event")}
    for name, kind in (("tx", SENT), ("rx", RECEIVED)):
        mine = rows.cells["event"] == kind
        whole &= np.bincount(group, weights=mine, minlength=len(start)) == 1
        messages.cells[name] = together.put(rows.cells["stamp"], mine)
    unusable.add("event", rows.origin[start[~whole]], "one tx and one rx of a message")
    return take(messages, np.flatnonzero(whole))


def from_parts(rows: Rows, unusable: Unusable) -> Rows:
    """Return exchanges of rows that each have some of the columns; notes those in which one has two values."""
    together = PARTS.together(rows)
    rows, group, start = together.rows, together.group, together.start
    # The initiator is whoever the row with its first stamp names first.
    leads = np.isfinite(rows.cells["tx1"]) if "tx1" in rows.cells else np.zeros(len(rows), dtype=bool)
    lead = start.copy()
    lead[group[leads]] = np.flatnonzero(leads)
    exchanges = take(rows, lead)
    exchanges.cells = together.largest()
    twice = np.zeros(len(start), dtype=bool)
    for name in STAMP_NAMES:
        if name in rows.cells:
            twice |= np.bincount(group, weights=np.isfinite(rows.cells[name]), minlength=len(start)) > 1
    unusable.add("sequence", rows.origin[start[twice]], "one value of each column an exchange")
    return take(exchanges, np.flatnonzero(~twice))
