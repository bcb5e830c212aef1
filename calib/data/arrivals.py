"""Differences of arrival, measured by a listener that overhears an exchange.

A listener k receives the poll of initiator i and the response of target j. At the antenna of j, the time between poll
and response is the reply time dt32 by its stamps, minus its delay d_j. So the interval between both frames at k, by the
target's clock, is

    K_k (rx2 - rx1)_k = tof_ij + dt32 - d_j + tof_jk - tof_ik

where K_k is the rate of the target's clock over that of the listener. The delays of listener and initiator cancel. Each
row therefore determines the delay of one target alone, even if anchors range only with tags. No recording of
free-running clocks determines how a delay divides into transmission and reception: a shift of a tag's clock shifts both
alike (docs/theory.md).

`raw_m` uses the range of the same exchange in place of c tof_ij. With the errors e1_j of the poll at j, e2_i of the
response at i, and e1_k and e2_k of both at k, the error of the difference is (e1_j - e2_i)/2 + e2_k - e1_k. Its
variance is smaller than with a known distance, e1_j + e2_k - e1_k, and it is not correlated with the error of the
range, (e1_j + e2_i)/2.
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
"""Largest error of a difference of arrival. Errors above 100 ns come from wrong stamps: in addition to the programmed
delays, published ones are below 1 ns."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Arrivals(ColumnTable):
    """Differences of arrival as columns of length n, one for each exchange and listener that heard poll and response.

    `exchange` is the row of the exchange among the ranges. `raw_m` is the measured difference, the listener's distance
    to the target minus its distance to the initiator, from uncorrected stamps and the raw range of the exchange;
    `truth_m` is the true difference. `poll_dbm` and `response_dbm` are the first-path powers at the listener. `stretch`
    is the interval from poll to response, divided by the interval over which the clock rates are compared: positive if
    the target sends both frames of the latter, negative if the initiator does, 0 if the rate is from the carrier
    integrator.
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
        """Measured minus true differences (n,), in metres."""
        return self.raw_m - self.truth_m

    def _title(self) -> str:
        return f"{len(self)} differences of arrival at {len(np.unique(self.listener))} listeners"

    def of_exchanges(self, rows: Any, count: int) -> Arrivals:
        """Return the rows of the exchanges `rows` among `count`, with `exchange` numbered within this selection."""
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
    """Return the differences of arrival of exchanges with raw ranges `range_m` (n,) at all listeners.

    `overheard` has the columns of the recording's table. Rows without a clock rate and rows with errors above
    `LARGEST_ERROR_M` are left out; with `need_truth` also rows without a true difference.
    """
    row = exchange_of(exchanges, overheard)
    heard = {name: column[row >= 0] for name, column in overheard.items()}
    row = row[row >= 0]
    e, listener, time_ns = exchanges[row], heard["listener"], range_ns(exchanges)[row]
    away, across = (distances_m(poses, tags, ends, listener, time_ns) for ends in (e.target, e.initiator))
    between = elapsed(heard["rx2"], heard["rx1"], e.bits) * TICK_S
    reply = elapsed(e.tx2, e.rx1, e.bits) * TICK_S
    # between - reply + (rate - 1) between = rate between - reply. This form keeps picoseconds of times of milliseconds.
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
        # Without truth: a difference of two distances is at most the distance of both senders.
        beyond = np.abs(found.raw_m) - range_m[row]
        off = np.where(np.isfinite(found.truth_m) | need_truth, np.abs(found.error_m), beyond)
        return found[off < LARGEST_ERROR_M]


def _rates(e: Exchanges, heard: Mapping[str, NDArray[Any]], between_s: Any) -> tuple[Floats, Floats]:
    """Return the rate of the target's clock over the listener's (n,), and the `stretch` of `Arrivals` (n,).

    If the target sends the third message, the rate is from the interval of its two transmissions and their receptions
    at the listener; if the initiator sends it, from the interval of poll and third message as received by target and
    listener. With two messages it is from the listener's carrier integrator.
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
