"""Long tables, in which an exchange has several rows, as rows of exchanges.

Either each row is a message with the stamps of its sender and its receiver, or one of these stamps, or each row has
some of the columns of an exchange, as where both devices report. Rows belong together by pair and sequence number, or
by pair and time.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.importers.table_rows import RECEIVED, SENT, Rows, take
from uwblink.importers.unusable import Unusable
from uwblink.twr import STAMPS

_OF_MESSAGE: Final = {"fpp": "fpp", "rxp": "rxp", "skew": "skew"}


def from_messages(rows: Rows, unusable: Unusable) -> tuple[Rows, str]:
    """Return exchanges of rows that are messages, and their protocol; notes the rows that belong to no whole exchange.

    Messages are 1, 2 and 3, by a column (or 0, 1 and 2 there) or by their order. The first one's sender is the
    initiator; who sends the third tells "ds" from "ds-alt".
    """
    order, group, place = _groups(rows)
    rows = take(rows, order)
    count = int(group[-1]) + 1 if len(group) else 0
    start = np.searchsorted(group, np.arange(count))
    initiator, target = rows.ids["from_id"][start], rows.ids["to_id"][start]
    sender = rows.ids["from_id"]
    third_by_initiator = (place == 3) & (sender == initiator[group])
    three = bool(2 * np.count_nonzero(place == 3) > np.count_nonzero(place == 2))
    alternative = bool(2 * np.count_nonzero(third_by_initiator) > np.count_nonzero(place == 3))
    protocol = "ss" if not three else "ds-alt" if alternative else "ds"
    expected = np.where(place == 2, target[group], initiator[group])
    expected = np.where((place == 3) & (not alternative), target[group], expected)
    good = (sender == expected) & (place >= 1) & (place <= (3 if three else 2))
    cells = {name: column[start] for name, column in rows.cells.items() if name in ("gt_range_m", "range_m")}
    for k in (1, 2, 3)[: 3 if three else 2]:
        mine = good & (place == k)
        cells |= {
            f"tx{k}": _put(rows.cells["tx"], group, mine, count),
            f"rx{k}": _put(rows.cells["rx"], group, mine, count),
        }
        if k < 3:
            named = {f"{ours}{k}": theirs for theirs, ours in _OF_MESSAGE.items() if theirs in rows.cells}
            cells |= {name: _put(rows.cells[theirs], group, mine, count) for name, theirs in named.items()}
    counts = np.bincount(group, weights=good, minlength=count)
    whole = counts == (3 if three else 2)
    unusable.add("message", rows.origin[start[~whole]], "messages 1, 2 (and 3) of one exchange")
    exchanges = take(rows, start)
    exchanges.cells, exchanges.ids = cells, {"from_id": initiator, "to_id": target}
    return take(exchanges, np.flatnonzero(whole)), protocol


def from_single_stamps(rows: Rows, unusable: Unusable) -> Rows:
    """Return rows that are messages, of rows that each have one stamp; notes those whose message lacks one or has two.

    Rows belong together by sender, receiver, number of the message, and sequence number or time.
    """
    order, group = _stamps_of_messages(rows)
    rows = take(rows, order)
    count = int(group[-1]) + 1 if len(group) else 0
    start = np.searchsorted(group, np.arange(count))
    found, whole = {}, np.ones(count, dtype=bool)
    for name, kind in (("tx", SENT), ("rx", RECEIVED)):
        mine = rows.cells["event"] == kind
        whole &= np.bincount(group, weights=mine, minlength=count) == 1
        found[name] = _put(rows.cells["stamp"], group, mine, count)
    others = {name: column for name, column in rows.cells.items() if name not in ("stamp", "event")}
    messages = take(rows, start)
    messages.cells = {name: np.fmax.reduceat(column, start) for name, column in others.items()} | found if count else {}
    unusable.add("event", rows.origin[start[~whole]], "one tx and one rx of a message")
    return take(messages, np.flatnonzero(whole))


def _stamps_of_messages(rows: Rows) -> tuple[Ints, Ints]:
    """Return the order in which the stamps of a message stand together, and their message, (n,) each."""
    time = rows.time_ns if rows.time_ns is not None else np.arange(len(rows), dtype=np.int64)
    keys = [rows.ids["from_id"], rows.ids["to_id"]]
    keys += [_key(rows.cells[name]) for name in ("sequence", "message") if name in rows.cells]
    order = np.lexsort((time, *reversed(keys)))
    begins: Bools = np.ones(len(rows), dtype=bool)
    begins[1:] = np.any([np.diff(key[order]) != 0 for key in keys], axis=0)
    if rows.time_ns is not None:
        begins[1:] |= np.diff(time[order].astype(np.float64)) > rows.column_map.within_s * 1e9
    return order, np.cumsum(begins) - 1


def _key(column: Floats) -> Ints:
    return np.nan_to_num(column, nan=-1).astype(np.int64)


def from_parts(rows: Rows, unusable: Unusable) -> Rows:
    """Return exchanges of rows that each have some of the columns; notes those in which one has two values."""
    order, group, _ = _groups(rows, numbered=False)
    rows = take(rows, order)
    count = int(group[-1]) + 1 if len(group) else 0
    start = np.searchsorted(group, np.arange(count))
    # The initiator is whoever the row with its first stamp names first.
    leads = np.isfinite(rows.cells["tx1"]) if "tx1" in rows.cells else np.zeros(len(rows), dtype=bool)
    lead = start.copy()
    lead[group[leads]] = np.flatnonzero(leads)
    exchanges = take(rows, lead)
    exchanges.cells = {name: np.fmax.reduceat(column, start) for name, column in rows.cells.items()} if count else {}
    twice = np.zeros(count, dtype=bool)
    for name in STAMPS:
        if name in rows.cells:
            twice |= np.bincount(group, weights=np.isfinite(rows.cells[name]), minlength=count) > 1
    unusable.add("sequence", rows.origin[start[twice]], "one value of each column an exchange")
    return take(exchanges, np.flatnonzero(~twice))


def _groups(rows: Rows, *, numbered: bool = True) -> tuple[Ints, Ints, Ints]:
    """Return the order in which rows of one exchange stand together, their exchange, and their message, (n,) each."""
    low, high = (f(rows.ids["from_id"], rows.ids["to_id"]) for f in (np.minimum, np.maximum))
    time = rows.time_ns if rows.time_ns is not None else np.arange(len(rows), dtype=np.int64)
    keys = [low, high]
    if "sequence" in rows.cells:
        keys.append(_key(rows.cells["sequence"]))
    order = np.lexsort((np.arange(len(rows)), time, *reversed(keys)))
    begins: Bools = np.ones(len(rows), dtype=bool)
    begins[1:] = np.any([np.diff(key[order]) != 0 for key in keys], axis=0)
    if rows.time_ns is not None:
        apart = np.diff(time[order].astype(np.float64)) > rows.column_map.within_s * 1e9
        begins[1:] |= apart
    message: Floats | None = rows.cells.get("message") if numbered else None
    if message is not None:
        begins[1:] |= ~(np.diff(message[order]) > 0)
    group = np.cumsum(begins) - 1
    first = np.flatnonzero(begins)
    place = np.arange(len(rows)) - first[group] + 1
    if message is not None:
        place = np.nan_to_num(message[order], nan=9).astype(np.int64) + _counted_from(message)
    return order, group, place


def _counted_from(message: Floats) -> int:
    """Return what to add to the numbers of messages: 1 where they are 0, 1 and 2, and 0 is no rare damage."""
    numbers = message[np.isfinite(message)]
    return int(len(numbers) > 0 and numbers.max() <= 2 and 4 * np.count_nonzero(numbers == 0) > len(numbers))


def _put(values: Floats, group: Ints, mine: Bools, count: int) -> Floats:
    found = np.full(count, np.nan)
    found[group[mine]] = values[mine]
    return found
