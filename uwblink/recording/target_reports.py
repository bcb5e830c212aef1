"""Second reports of exchanges: if targets report too, a recording has each exchange twice.

Both boards report the same stamps, so that pair and a stamp of either clock identify two reports of one exchange. The
first report is used. Differences of the second one are faults, because both are of the same frames.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Bools, Ints
from uwblink.recording.tables import ROWS_AT_ONCE, Tables
from uwblink.twr import STAMPS, Exchanges, without_stamps

APART_NS: Final = 60_000_000
"""Largest time between reports of one exchange; stamps of others can be equal after the wrap, 67 ms."""

COMPARED: Final = (*STAMPS, "range_m", "fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm")
"""Columns that both reports have in common."""


@dataclass(frozen=True, slots=True)
class SingleReports:
    """Exchanges without second reports, in their order; `repeated` is the number of those.

    `differing` (k, 2) are the rows of reports that differ, the initiator's first, among the given exchanges.
    """

    exchanges: Exchanges
    repeated: int
    differing: Ints


def single_reports(exchanges: Exchanges) -> SingleReports:
    """Return each exchange once: the initiator's report if there is one, else the target's."""
    by_target = np.flatnonzero(from_targets(exchanges))
    if not len(by_target):
        return SingleReports(exchanges, 0, np.empty((0, 2), dtype=np.int64))
    by_initiator = np.flatnonzero(exchanges.reporter == exchanges.initiator)
    partner = np.full(len(by_target), -1, dtype=np.int64)
    for name in ("tx1", "tx2"):  # a stamp of each clock, in case that one is damaged
        alone = partner < 0
        partner[alone] = _partners(exchanges, name, by_target[alone], by_initiator)
    known = partner >= 0
    first, second = partner[known], by_target[known]
    differs = np.zeros(len(first), dtype=bool)
    for name in COMPARED:
        differs |= _unequal(getattr(exchanges, name), first, second)
    keep = np.ones(len(exchanges), dtype=bool)
    keep[second] = False
    return SingleReports(exchanges[keep], int(known.sum()), np.column_stack([first, second])[differs])


def repeated_rows(exchanges: Exchanges) -> Bools:
    """Return which exchanges (n,) repeat another row of the same pair and reporter in all stamps and readings.

    Ranges without stamps must also have nearly the same time.
    """
    e = exchanges
    columns = [e.initiator, e.target, e.reporter, *(getattr(e, name) for name in COMPARED)]
    keys = [np.nan_to_num(column, nan=-1e300) if column.dtype.kind == "f" else column for column in columns]
    order = np.lexsort((e.time_ns, *reversed(keys)))
    same = np.ones(max(len(e) - 1, 0), dtype=bool)
    for key in keys:
        same &= np.diff(key[order]) == 0
    same &= ~without_stamps(e)[order][1:] | (np.diff(e.time_ns[order]) < APART_NS)
    again = np.zeros(len(e), dtype=bool)
    again[order[1:][same]] = True
    return again


def from_targets(exchanges: Exchanges) -> Bools:
    """Return which exchanges (n,) were reported by the target; exchanges of a tag with itself are not."""
    return np.asarray((exchanges.reporter == exchanges.target) & (exchanges.initiator != exchanges.target))


def single_report_blocks(recording: Tables, rows: int = ROWS_AT_ONCE) -> Iterator[SingleReports]:
    """Yield the exchanges of a recording, each once, in blocks of about `rows`.

    A recording with reports of targets is one block, because the two reports of an exchange can be apart.
    """
    ends = recording.tally("exchanges", "initiator", "target", "reporter")
    twice = any(reporter == target != initiator for initiator, target, reporter in ends)
    return map(single_reports, [recording.exchanges()] if twice else recording.exchange_blocks(rows))


def differences(exchanges: Exchanges, first: int, second: int) -> list[str]:
    """Return the differences of two reports, one text for each column: "range_m 3.0122 and 3.0177"."""
    pairs = [(name, getattr(exchanges, name)) for name in COMPARED]
    rows = np.array([first]), np.array([second])
    return [f"{name} {column[first]} and {column[second]}" for name, column in pairs if _unequal(column, *rows)[0]]


def _unequal(column: Ints, first: Ints, second: Ints) -> Bools:
    a, b = column[first], column[second]
    return np.asarray((a != b) & ~((a != a) & (b != b)))


def _partners(e: Exchanges, name: str, wanted: Ints, among: Ints) -> Ints:
    """Return for each of the rows `wanted` the row of `among` with its pair and stamp, the nearest in time, else -1."""
    stamps = getattr(e, name)
    # Ids and the low 32 bits of the stamp as one number; the time resolves ambiguities of the stamp.
    key = ((e.initiator.astype(np.uint64) << 16 | e.target.astype(np.uint64)) << 32) | (stamps & 0xFFFFFFFF).astype(
        np.uint64
    )
    order = among[np.argsort(key[among], kind="stable")]
    low, high = (np.searchsorted(key[order], key[wanted], side=side) for side in ("left", "right"))
    best = np.full(len(wanted), -1, dtype=np.int64)
    nearest = np.full(len(wanted), APART_NS, dtype=np.int64)
    for step in range(int((high - low).max(initial=0))):
        rows = np.flatnonzero(low + step < high)
        candidate = order[low[rows] + step]
        apart = np.abs(e.time_ns[candidate] - e.time_ns[wanted[rows]])
        nearer = apart < nearest[rows]
        best[rows[nearer]], nearest[rows[nearer]] = candidate[nearer], apart[nearer]
    return best
