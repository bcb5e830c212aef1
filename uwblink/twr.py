"""Two-way ranging: exchanges as columns, and ranges by their stamps.

Stamps are those of Shalaby et al., ICRA 2023, Fig. 2: t1..t6 = tx1, rx1, tx2, rx2, tx3, rx3, so
dt41 = rx2 - tx1, dt32 = tx2 - rx1, dt53 = tx3 - tx2, dt64 = rx3 - rx2. tx1, rx2 and the initiator's
stamp of the third message are in the initiator's clock, the others in the target's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwblink import arrays
from uwblink.arrays import Bools, ColumnTable, Floats, Ints
from uwblink.display import first_few
from uwblink.errors import ArgumentError
from uwblink.protocols.table import PROTOCOLS, Intervals, RangingProtocol
from uwblink.ticks import COUNTER_BITS, METRES_PER_TICK, REPORT_BITS, SPEED_OF_LIGHT, TICK_S, elapsed

STAMPS: Final = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Exchanges(ColumnTable):
    """Ranging exchanges as columns of length n.

    `protocol` holds keys of `PROTOCOLS`. Stamps are ticks modulo 2**`bits`, zero where the protocol
    has no third message. `fpp1_dbm` is measured at the target on message 1, `fpp2_dbm` at the
    initiator on message 2; skews are positive when the receiver's clock is the faster one.
    `truth_m` is a distance that was measured independently, NaN if unknown.
    """

    time_ns: Ints
    initiator: Ints
    target: Ints
    protocol: NDArray[np.str_]
    reporter: Ints
    range_m: Floats
    tx1: Ints
    rx1: Ints
    tx2: Ints
    rx2: Ints
    tx3: Ints
    rx3: Ints
    fpp1_dbm: Floats
    fpp2_dbm: Floats
    skew1_ppm: Floats
    skew2_ppm: Floats
    truth_m: Floats
    bits: int = REPORT_BITS

    @classmethod
    def from_arrays(  # noqa: PLR0913 - one parameter for each column, most of them optional
        cls,
        initiator: ArrayLike,
        target: ArrayLike,
        *,
        tx1: ArrayLike | None = None,
        rx1: ArrayLike | None = None,
        tx2: ArrayLike | None = None,
        rx2: ArrayLike | None = None,
        tx3: ArrayLike | None = None,
        rx3: ArrayLike | None = None,
        protocol: ArrayLike | None = None,
        time_ns: ArrayLike = 0,
        reporter: ArrayLike | None = None,
        range_m: ArrayLike | None = None,
        fpp1_dbm: ArrayLike | None = None,
        fpp2_dbm: ArrayLike | None = None,
        skew1_ppm: ArrayLike | None = None,
        skew2_ppm: ArrayLike | None = None,
        truth_m: ArrayLike | None = None,
        bits: int = REPORT_BITS,
    ) -> Exchanges:
        """Return exchanges from columns, each a list, an array, a data-frame column, or one value for all rows.

        `tx1` gives the number of rows n; `range_m` does if there are ranges and no stamps, which are 0 then. Defaults:
        `protocol` is "ds" if `tx3` and `rx3` are given and "ss" otherwise, `time_ns` is 0, `reporter` the initiator,
        `range_m` the range by the protocol's formula, and powers, skews and `truth_m` are NaN. Stamps of a third
        message are 0 if the protocol has none. `bits` is 32 or 40. Raises `ArgumentError`, which names the column and
        the row.

        >>> from uwblink import Exchanges
        >>> x = Exchanges.from_arrays([1, 1], 2, tx1=[0, 9], rx1=[5, 3], tx2=[1005, 1003], rx2=[3000, 3009])
        >>> x.protocol.tolist(), x.range_m.round(3).tolist()
        (['ss', 'ss'], [4.69, 4.69])
        >>> len(Exchanges.from_arrays(1, 2, range_m=[3.1, 3.2], fpp2_dbm=[-82.0, -83.0]))
        2
        """
        given = {"tx1": tx1, "rx1": rx1, "tx2": tx2, "rx2": rx2, "tx3": tx3, "rx3": rx3}
        bare = all(values is None for values in given.values())
        if (first := range_m if tx1 is None else tx1) is None:
            raise ArgumentError("tx1: is missing; give the stamps, or range_m for a device without stamps")
        count = arrays.length("range_m" if tx1 is None else "tx1", first)
        if bits not in BITS:
            raise ArgumentError(f"bits: found {bits!r:.40}, allowed: {', '.join(map(str, BITS))}")
        ends = {"initiator": initiator, "target": target, "reporter": initiator if reporter is None else reporter}
        chosen: dict[str, Any] = {n: arrays.whole_numbers(n, v, count, 0, LARGEST_ID) for n, v in ends.items()}
        arrays.reject(
            "target", chosen["target"], chosen["target"] == chosen["initiator"], "another tag than the initiator"
        )
        if protocol is None and (tx3 is None) != (rx3 is None):
            raise ArgumentError(f"{'tx3' if tx3 is None else 'rx3'}: is missing; a third message has both stamps")
        default = "ss" if tx3 is None else "ds"
        names = arrays.words("protocol", default if protocol is None else protocol, count)
        messages = of_protocol(names, lambda row: len(row.messages))
        hint = f"; stamps of {BITS[-1]} bits need bits={BITS[-1]}" if bits < BITS[-1] else ""
        for name, values in given.items():
            needed = messages >= int(name[-1])
            if values is None and needed.any() and not bare:
                raise ArgumentError(f"{name}: is missing, but protocol {str(names[int(np.argmax(needed))])!r} needs it")
            found = arrays.whole_numbers(name, 0 if values is None else values, count, 0, (1 << bits) - 1, hint)
            chosen[name] = np.where(needed, found, 0)
        levels = {"fpp1_dbm": fpp1_dbm, "fpp2_dbm": fpp2_dbm, "skew1_ppm": skew1_ppm, "skew2_ppm": skew2_ppm}
        chosen |= {name: arrays.numbers(name, values, count) for name, values in levels.items()}
        exchanges = cls(
            time_ns=arrays.whole_numbers("time_ns", time_ns, count, -LATEST_NS, LATEST_NS),
            protocol=names,
            range_m=arrays.numbers("range_m", range_m, count),
            truth_m=arrays.numbers("truth_m", truth_m, count),
            bits=bits,
            **chosen,
        )
        return exchanges if range_m is not None else replace(exchanges, range_m=raw_range(exchanges))

    def _title(self) -> str:
        ends = np.unique(np.column_stack([self.initiator, self.target]), axis=0)
        return f"{len(self)} exchanges of {len(ends)} pairs, protocols {first_few(np.unique(self.protocol).tolist())}"

    def _shown(self) -> dict[str, NDArray[Any]]:
        first = ("initiator", "target", "protocol", "range_m", "truth_m", "fpp1_dbm", "fpp2_dbm", "time_ns")
        return {name: getattr(self, name) for name in dict.fromkeys((*first, *COLUMNS))}


COLUMNS: Final = tuple(f.name for f in fields(Exchanges) if f.name != "bits")
BITS: Final = (REPORT_BITS, COUNTER_BITS)
LARGEST_ID: Final = 65_535
"""Ids have 16 bits in recordings."""

LATEST_NS: Final = 2**62
"""In the year 2116; differences of two such times fit into 64 bits."""


def names_in(words: NDArray[np.str_]) -> list[str]:
    """Return the distinct words of a column (n,), sorted."""
    return [str(word) for word in np.unique(words)]


def intervals(exchanges: Exchanges) -> Intervals:
    """Return dt41, dt32, and the two readings of the third leg, dt53 (sent) and dt64 (received).

    Where the target sends the third message dt53 = tx3 - tx2 and dt64 = rx3 - rx2. Where the
    initiator sends it, dt53 = tx3 - rx2 is the initiator's reply and dt64 = rx3 - tx2 the target's
    round trip. Raises `ArgumentError` for exchanges of a protocol that is not in `PROTOCOLS`.
    """
    e, bits = exchanges, exchanges.bits
    target_sends = of_protocol(e.protocol, lambda row: row.third_sender == "target")
    before_tx3 = np.where(target_sends, e.tx2, e.rx2)
    before_rx3 = np.where(target_sends, e.rx2, e.tx2)
    return Intervals(
        dt41=elapsed(e.rx2, e.tx1, bits).astype(np.float64),
        dt32=elapsed(e.tx2, e.rx1, bits).astype(np.float64),
        dt53=elapsed(e.tx3, before_tx3, bits).astype(np.float64),
        dt64=elapsed(e.rx3, before_rx3, bits).astype(np.float64),
        carrier_ppm=e.skew2_ppm,
    )


def range_ns(exchanges: Exchanges) -> Ints:
    """Return the time (n,) in ns at which a changing distance equals the range.

    It is a share of the initiator's round trip after the poll. With flights t1, t2, t3 that change with the distance
    the formulas give, to first order: (t1 + t2)/2 for two messages; t1 where the target sends the third, because the
    ratio of the clocks holds the Doppler shift; t2 where the initiator does (docs/theory.md, "Predicting a protocol").
    """
    shares = {None: 0.5, "target": 0.0, "initiator": 1.0}
    share = of_protocol(exchanges.protocol, lambda row: shares[row.third_sender])
    return exchanges.time_ns + np.rint(intervals(exchanges).dt41 * share * (TICK_S * 1e9)).astype(np.int64)


def time_of_flight(exchanges: Exchanges) -> Floats:
    """Raw time of flight in seconds, shape (n,): each row by the formula of its protocol.

    NaN or infinite if the stamps of a double-sided row are degenerate (dt53 = 0). Rows without stamps (the first four
    are zero), as of devices that report ranges only, have the time of flight of the reported range.
    """
    spans = intervals(exchanges)
    flight = np.full(len(exchanges), np.nan)
    for row, rows in _rows_by_protocol(exchanges.protocol):
        flight[rows] = row.flight_ticks(_pick(spans, rows)) * TICK_S
    bare = without_stamps(exchanges)
    return np.where(bare, exchanges.range_m / SPEED_OF_LIGHT, flight) if bare.any() else flight


def without_stamps(exchanges: Exchanges) -> Bools:
    """Return which exchanges have a range and no stamps, (n,)."""
    e = exchanges
    return np.asarray((e.tx1 | e.rx1 | e.tx2 | e.rx2) == 0)


def raw_range(exchanges: Exchanges) -> Floats:
    """Uncalibrated range in metres, shape (n,), at full resolution (no rounding as on the board).

    >>> from uwblink import Exchanges, raw_range
    >>> raw_range(Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])).round(3).tolist()
    [4.69]
    """
    return time_of_flight(exchanges) * SPEED_OF_LIGHT


def delay_weights(exchanges: Exchanges) -> tuple[Floats, Floats]:
    """Weights of the two antenna delays: t_f calibrated = t_f raw + w_i d_i + w_j d_j.

    (1/2, 1/2) for SS-TWR and (1/2, K/2) for the paper's DS-TWR (ICRA 2023, section III).
    """
    spans = intervals(exchanges)
    initiator = np.full(len(exchanges), np.nan)
    target = np.full(len(exchanges), np.nan)
    for row, rows in _rows_by_protocol(exchanges.protocol):
        initiator[rows], target[rows] = row.delay_weights(_pick(spans, rows))
    return initiator, target


def board_range(exchanges: Exchanges) -> Floats:
    """Range in metres as the firmware prints it: SS in whole ticks, four decimals, truncated."""
    ticks = time_of_flight(exchanges) / TICK_S
    whole = np.where(exchanges.protocol == "ss", np.trunc(np.round(ticks, 6)), ticks)
    return truncate4((whole * METRES_PER_TICK).astype(np.float32).astype(np.float64))


def truncate4(values: Floats) -> Floats:
    """Four decimals, cut toward zero, as the boards print numbers (firmware wire format, 0.2)."""
    # Half a unit of float64 noise is added back, so that a value which already has four decimals
    # (-94.9998) is not cut to the next one (-94.9997).
    scaled = values * 1e4
    return np.trunc(scaled + np.copysign(1e-6, scaled)) / 1e4


def _rows_by_protocol(names: NDArray[np.str_]) -> list[tuple[RangingProtocol, Bools]]:
    """Return the protocols that occur and their rows; plug-ins are loaded only for unknown names."""
    found = []
    for name in names_in(names):
        if name not in PROTOCOLS:
            raise ArgumentError(f"protocol: found {name[:40]!r}, allowed: {', '.join(PROTOCOLS)}")
        found.append((PROTOCOLS[name], np.asarray(names == name)))
    return found


def of_protocol(names: NDArray[np.str_], value: Callable[[RangingProtocol], float]) -> Floats:
    """Return a property of the protocols with these names (n,); raises `ArgumentError` for an unknown one."""
    found = np.zeros(len(names))
    for row, rows in _rows_by_protocol(names):
        found[rows] = value(row)
    return found


def _pick(spans: Intervals, rows: Bools) -> Intervals:
    return Intervals(*(getattr(spans, field.name)[rows] for field in fields(Intervals)))
