"""Differences of arrival: what a listener that overhears an exchange knows of it.

A listener k hears the poll of i and the response of j. At the target's antenna these are its reply time dt32 less its
delay d_j apart. So by the target's clock they arrive at k

    K_k (rx2 - rx1)_k = tof_ij + dt32 - d_j + tof_jk - tof_ik

apart, where K_k is the rate of the target's clock over the listener's. The listener's own delay cancels, and so does
the initiator's: each row determines the delay of one target alone, also where anchors range with tags only. How a delay
divides into transmission and reception is in no recording of free-running clocks: a shift of a tag's clock shifts its
transmissions and receptions alike (docs/theory.md).
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

    `exchange` is the row of the exchange among the ranges, `error_m` the measured difference less the one expected from
    distances, reply time and clock rate: minus the target's delay, and the errors of three receptions, in metres: of
    the poll at the target and the response at the listener, less that of the poll at the listener. `poll_dbm` and
    `response_dbm` are the listener's first-path powers.
    """

    time_ns: Ints
    exchange: Ints
    listener: Ints
    error_m: Floats
    poll_dbm: Floats
    response_dbm: Floats

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
    truth_m: Floats,
    overheard: Mapping[str, NDArray[Any]],
    poses: Poses,
    tags: Sequence[Tag],
) -> Arrivals:
    """Return what listeners know of exchanges with true distances `truth_m` (n,).

    `overheard` has the columns of the recording's table. Rows without distances, without the rate of the target's
    clock, or with impossible stamps are left out.
    """
    row = exchange_of(exchanges, overheard)
    heard = {name: column[row >= 0] for name, column in overheard.items()}
    row = row[row >= 0]
    e, listener, time_ns = exchanges[row], heard["listener"], range_ns(exchanges)[row]
    away, across = (distances_m(poses, tags, ends, listener, time_ns) for ends in (e.target, e.initiator))
    between = elapsed(heard["rx2"], heard["rx1"], e.bits) * TICK_S
    reply = elapsed(e.tx2, e.rx1, e.bits) * TICK_S
    # Less the reply first: two times of milliseconds, of which picoseconds matter.
    late = between - reply + (_rates(e, heard) - 1) * between
    error = SPEED_OF_LIGHT * late - (truth_m[row] + away - across)
    good = np.isfinite(error) & (np.abs(error) < LARGEST_ERROR_M)
    found = Arrivals(
        time_ns=time_ns,
        exchange=row,
        listener=listener.astype(np.int64),
        error_m=error,
        poll_dbm=heard["fpp1_dbm"],
        response_dbm=heard["fpp2_dbm"],
    )
    return found[good]


def _rates(e: Exchanges, heard: Mapping[str, NDArray[Any]]) -> Floats:
    """Return how fast the target's clock runs by the listener's (n,).

    Where the target sends twice, from both transmissions; where the initiator does, from both receptions at the target
    and at the listener; with two messages from the listener's carrier integrator.
    """
    third = {name: PROTOCOLS[name].third_sender for name in np.unique(e.protocol).tolist()}
    by_target, by_initiator = (np.array([third[p] == who for p in e.protocol.tolist()], bool) for who in _ROLES)
    own = np.where(by_target, elapsed(e.tx3, e.tx2, e.bits), elapsed(e.rx3, e.rx1, e.bits))
    at_listener = elapsed(heard["rx3"], np.where(by_target, heard["rx2"], heard["rx1"]), e.bits)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_stamps = own / at_listener
    return np.where(by_target | by_initiator, by_stamps, 1 / (1 + heard["skew2_ppm"] * 1e-6))


_ROLES: Final = ("target", "initiator")
