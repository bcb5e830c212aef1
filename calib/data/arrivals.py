"""Differences of arrival, measured by a listener that overhears an exchange.

A listener k hears the poll of i and the response of j. At the target's antenna these are its reply time dt32 less its
delay d_j apart. So by the target's clock they arrive at k

    K_k (rx2 - rx1)_k = tof_ij + dt32 - d_j + tof_jk - tof_ik

apart, where K_k is the rate of the target's clock over the listener's. The listener's own delay cancels, and so does
the initiator's: each row determines the delay of one target alone, also where anchors range with tags only. How a delay
divides into transmission and reception is in no recording of free-running clocks: a shift of a tag's clock shifts its
transmissions and receptions alike (docs/theory.md).

The range of the same exchange takes the place of tof_ij. Of the errors e of receptions at j (poll), i (response) and
k, (e1_j - e2_i)/2 + e2_k - e1_k is left, which has less variance than with a known distance, e1_j + e2_k - e1_k, and
does not correlate with the error of the range, (e1_j + e2_i)/2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import ColumnTable, Floats, Ints
from uwblink.protocols.table import PROTOCOLS
from uwblink.receptions import exchange_of
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Poses, Tag
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S, elapsed
from uwblink.twr import Exchanges, range_ns

LARGEST_ERROR_M: Final = 30.0
"""Errors beyond 100 ns come from wrong stamps: published delays are below 1 ns, beside those that are programmed."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Arrivals(ColumnTable):
    """Differences of arrival as columns of length n, one for each exchange and listener that heard poll and response.

    `exchange` is the row of the exchange among the ranges. `raw_m` is by how much farther from the target than from the
    initiator the listener is, by stamps alone and with the raw range of the exchange; `truth_m` is the true difference.
    `poll_dbm` and `response_dbm` are the listener's first-path powers. `stretch` is the duration from poll to response
    over the one that gives the rate of the clocks, negative where the initiator sends at both ends of the latter, 0
    where the rate is the carrier integrator's.
    """

    time_ns: Ints
    exchange: Ints
    listener: Ints
    raw_m: Floats
    truth_m: Floats
    poll_dbm: Floats
    response_dbm: Floats
    stretch: Floats

    @property
    def error_m(self) -> Floats:
        """Measured less true differences (n,)."""
        return self.raw_m - self.truth_m

    def _title(self) -> str:
        return f"{len(self)} differences of arrival at {len(np.unique(self.listener))} listeners"

    def of_exchanges(self, rows: Any, count: int) -> Arrivals:
        """Return the rows of some exchanges, of which there were `count`, numbered as in this choice."""
        chosen = np.arange(count)[rows]
        place = np.full(count, -1)
        place[chosen] = np.arange(len(chosen))
        found = self[place[self.exchange] >= 0]
        return type(self)(**{**found.to_dict(), "exchange": place[found.exchange]})


def arrivals_of(
    exchanges: Exchanges,
    range_m: Floats,
    overheard: Mapping[str, NDArray[Any]],
    poses: Poses,
    tags: Sequence[Tag],
    *,
    need_truth: bool = True,
) -> Arrivals:
    """Return what listeners know of exchanges with raw ranges `range_m` (n,).

    `overheard` has the columns of the recording's table. Rows without the rate of the target's clock or with impossible
    stamps are left out, with `need_truth` those without true differences, too.
    """
    row = exchange_of(exchanges, overheard)
    heard = {name: column[row >= 0] for name, column in overheard.items()}
    row = row[row >= 0]
    e, listener, time_ns = exchanges[row], heard["listener"], range_ns(exchanges)[row]
    away, across = (distances_m(poses, tags, ends, listener, time_ns) for ends in (e.target, e.initiator))
    between = elapsed(heard["rx2"], heard["rx1"], e.bits) * TICK_S
    reply = elapsed(e.tx2, e.rx1, e.bits) * TICK_S
    # Less the reply first: two times of milliseconds, of which picoseconds matter.
    rate, stretch = _rates(e, heard, between)
    late = between - reply + (rate - 1) * between
    found = Arrivals(
        time_ns=time_ns,
        exchange=row,
        listener=listener.astype(np.int64),
        raw_m=SPEED_OF_LIGHT * late - range_m[row],
        truth_m=away - across,
        poll_dbm=heard["fpp1_dbm"],
        response_dbm=heard["fpp2_dbm"],
        stretch=stretch,
    )
    with np.errstate(invalid="ignore"):
        # No difference is longer than the way between both senders.
        beyond = np.abs(found.raw_m) - range_m[row]
        off = np.where(np.isfinite(found.truth_m) | need_truth, np.abs(found.error_m), beyond)
        return found[off < LARGEST_ERROR_M]


def _rates(e: Exchanges, heard: Mapping[str, NDArray[Any]], between_s: Any) -> tuple[Floats, Floats]:
    """Return how fast the target's clock runs by the listener's (n,), and the stretch of `Arrivals`.

    Where the target sends twice, from both transmissions; where the initiator does, from both receptions at the target
    and at the listener; with two messages from the listener's carrier integrator.
    """
    third = {name: PROTOCOLS[name].third_sender for name in np.unique(e.protocol).tolist()}
    by_target, by_initiator = (
        np.array([third[p] == who for p in e.protocol.tolist()], bool) for who in ("target", "initiator")
    )
    own = np.where(by_target, elapsed(e.tx3, e.tx2, e.bits), elapsed(e.rx3, e.rx1, e.bits))
    at_listener = elapsed(heard["rx3"], np.where(by_target, heard["rx2"], heard["rx1"]), e.bits)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_stamps, stretch = own / at_listener, between_s / TICK_S / at_listener
    rate = np.where(by_target | by_initiator, by_stamps, 1 / (1 + heard["skew2_ppm"] * 1e-6))
    return rate, np.where(by_target, stretch, np.where(by_initiator, -stretch, 0.0))
