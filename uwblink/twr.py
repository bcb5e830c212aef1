"""Two-way ranging: exchange columns, and the protocols as rows of one table.

Stamps are those of Shalaby et al., ICRA 2023, Fig. 2: t1..t6 = tx1, rx1, tx2, rx2, tx3, rx3, so
dt41 = rx2 - tx1, dt32 = tx2 - rx1, dt53 = tx3 - tx2, dt64 = rx3 - rx2. tx1, rx2 and the initiator's
stamp of the third message are in the initiator's clock, the others in the target's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import METRES_PER_TICK, REPORT_BITS, SPEED_OF_LIGHT, TICK_S, elapsed

Role = Literal["initiator", "target"]

STAMPS: Final = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")


@dataclass(frozen=True, slots=True)
class Exchanges:
    """Ranging exchanges as columns of length n.

    `protocol` holds keys of `PROTOCOLS`. Stamps are ticks modulo 2**`bits`, zero where the protocol
    has no third message. `fpp1_dbm` is measured at the target on message 1, `fpp2_dbm` at the
    initiator on message 2; skews are positive when the receiver's clock is the faster one.
    `truth_m` is a measured distance that came with the exchange, NaN where there is none.
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

    def __len__(self) -> int:
        """Return the number of exchanges."""
        return len(self.time_ns)

    def __getitem__(self, rows: slice | Bools | Ints) -> Exchanges:
        """Return the chosen rows, in their order."""
        return replace(self, **{name: getattr(self, name)[rows] for name in COLUMNS})


COLUMNS: Final = tuple(f.name for f in fields(Exchanges) if f.name != "bits")


@dataclass(frozen=True, slots=True)
class Intervals:
    """Durations of an exchange in ticks of the clock that measured them, float64, shape (n,).

    `turn` is the time between receiving one message and sending the next, `wait` the time between
    sending one and receiving the next: first of the initiator (1), then of the target (2). `carrier_ppm` is how much
    faster than the target's the initiator's clock runs by its carrier integrator, on the response; NaN if unknown.
    """

    dt41: Floats
    dt32: Floats
    dt53: Floats
    dt64: Floats
    carrier_ppm: Floats


def intervals(exchanges: Exchanges) -> Intervals:
    """Return dt41, dt32, and the two readings of the third leg, dt53 (sent) and dt64 (received).

    Where the target sends the third message dt53 = tx3 - tx2 and dt64 = rx3 - rx2. Where the
    initiator sends it, dt53 = tx3 - rx2 is the initiator's reply and dt64 = rx3 - tx2 the target's
    round trip.
    """
    e, bits = exchanges, exchanges.bits
    target_sends = np.isin(e.protocol, THIRD_FROM_TARGET)
    before_tx3 = np.where(target_sends, e.tx2, e.rx2)
    before_rx3 = np.where(target_sends, e.rx2, e.tx2)
    return Intervals(
        dt41=elapsed(e.rx2, e.tx1, bits).astype(np.float64),
        dt32=elapsed(e.tx2, e.rx1, bits).astype(np.float64),
        dt53=elapsed(e.tx3, before_tx3, bits).astype(np.float64),
        dt64=elapsed(e.rx3, before_rx3, bits).astype(np.float64),
        carrier_ppm=e.skew2_ppm,
    )


def _single_sided(t: Intervals) -> Floats:
    """ICRA 2023, eq. (1)."""
    return (t.dt41 - t.dt32) / 2


def _carrier_corrected(t: Intervals) -> Floats:
    """ICRA 2023, eq. (1), with the reply rescaled by the clocks' ratio as the carrier integrator has it."""
    # Taken apart, so that what is left of two long times is not rounded twice.
    return (t.dt41 - t.dt32 - t.carrier_ppm * 1e-6 * t.dt32) / 2


def _double_sided(t: Intervals) -> Floats:
    """ICRA 2023, eq. (2): the target's reply is rescaled by K = dt64/dt53."""
    return (t.dt41 - _clock_ratio(t) * t.dt32) / 2


def _clock_ratio(t: Intervals) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return t.dt64 / t.dt53


def _alternative(t: Intervals) -> Floats:
    """Neirynck, Luk, McLaughlin, WPNC 2016: (R1 R2 - D1 D2) / (R1 + R2 + D1 + D2)."""
    # R1 R2 - D1 D2 cancels twenty digits: with R = D + e it is D1 e2 + D2 e1 + e1 e2, which does
    # not cancel (e1 and e2 are near twice the flight time plus what the skew adds).
    e1 = t.dt41 - t.dt32
    e2 = t.dt64 - t.dt53
    numerator = t.dt32 * e2 + t.dt53 * e1 + e1 * e2
    with np.errstate(divide="ignore", invalid="ignore"):
        return numerator / (t.dt41 + t.dt64 + t.dt32 + t.dt53)


def _ones(t: Intervals) -> tuple[Floats, Floats]:
    half = np.full_like(t.dt41, 0.5)
    return half, half


def _carrier_delays(t: Intervals) -> tuple[Floats, Floats]:
    return np.full_like(t.dt41, 0.5), (1 + t.carrier_ppm * 1e-6) / 2


def _double_sided_delays(t: Intervals) -> tuple[Floats, Floats]:
    return np.full_like(t.dt41, 0.5), _clock_ratio(t) / 2


def _alternative_delays(t: Intervals) -> tuple[Floats, Floats]:
    with np.errstate(divide="ignore", invalid="ignore"):
        total = t.dt41 + t.dt64 + t.dt32 + t.dt53
        return (t.dt64 + t.dt32) / total, (t.dt41 + t.dt53) / total


@dataclass(frozen=True, slots=True)
class ProtocolMessage:
    """One message of a protocol: who sends it, after which stamp, and on whose timing.

    `timing` is `"at once"` (as soon as the software gets there) or `"scheduled"` (a delayed
    transmission on the chip's 512-tick grid, a set number of UWB microseconds after the stamp).
    """

    sender: Role
    after: str
    timing: Literal["at once", "scheduled"]


@dataclass(frozen=True, slots=True)
class RangingProtocol:
    """A ranging protocol: its messages and its formulas, from which everything else follows.

    `flight_ticks` maps intervals to the time of flight in ticks of the initiator's clock;
    `delay_weights` to the pair (d t_f/d d_i, d t_f/d d_j) by which a tag's aggregate antenna delay
    d = d_t - d_r enters the calibrated time of flight.
    """

    name: str
    title: str
    messages: tuple[ProtocolMessage, ...]
    flight_ticks: Callable[[Intervals], Floats]
    delay_weights: Callable[[Intervals], tuple[Floats, Floats]]


_POLL = ProtocolMessage("initiator", "", "at once")

PROTOCOLS: Final[dict[str, RangingProtocol]] = {
    row.name: row
    for row in (
        RangingProtocol(
            "ss",
            "SS-TWR",
            (_POLL, ProtocolMessage("target", "rx1", "scheduled")),
            _single_sided,
            _ones,
        ),
        RangingProtocol(
            "ss-cfo",
            "SS-TWR, corrected with the carrier integrator",
            (_POLL, ProtocolMessage("target", "rx1", "scheduled")),
            _carrier_corrected,
            _carrier_delays,
        ),
        RangingProtocol(
            "ds",
            "DS-TWR, third message from the target",
            (_POLL, ProtocolMessage("target", "rx1", "at once"), ProtocolMessage("target", "tx2", "scheduled")),
            _double_sided,
            _double_sided_delays,
        ),
        RangingProtocol(
            "ds-alt",
            "DS-TWR, third message from the initiator",
            (_POLL, ProtocolMessage("target", "rx1", "at once"), ProtocolMessage("initiator", "rx2", "scheduled")),
            _alternative,
            _alternative_delays,
        ),
        RangingProtocol(
            "ds-sym",
            "DS-TWR, third message from the initiator, equal replies",
            (_POLL, ProtocolMessage("target", "rx1", "scheduled"), ProtocolMessage("initiator", "rx2", "scheduled")),
            _alternative,
            _alternative_delays,
        ),
    )
}

ON_BOARDS: Final = ("ss", "ds")
"""The protocols that the boards' firmware executes."""

SINGLE_SIDED: Final = tuple(name for name, row in PROTOCOLS.items() if len(row.messages) == 2)

THIRD_FROM_TARGET: Final = tuple(
    name for name, row in PROTOCOLS.items() if len(row.messages) == 3 and row.messages[2].sender == "target"
)


def time_of_flight(exchanges: Exchanges) -> Floats:
    """Raw time of flight in seconds, shape (n,): each row by the formula of its protocol.

    NaN or infinite where the stamps of a double-sided row are degenerate (dt53 = 0).
    """
    spans = intervals(exchanges)
    flight = np.full(len(exchanges), np.nan)
    for name, rows in _rows_by_protocol(exchanges):
        flight[rows] = PROTOCOLS[name].flight_ticks(_pick(spans, rows)) * TICK_S
    return flight


def raw_range(exchanges: Exchanges) -> Floats:
    """Uncalibrated range in metres, shape (n,), at full resolution (no rounding as on the board)."""
    return time_of_flight(exchanges) * SPEED_OF_LIGHT


def delay_weights(exchanges: Exchanges) -> tuple[Floats, Floats]:
    """Weights of the two antenna delays: t_f calibrated = t_f raw + w_i d_i + w_j d_j.

    (1/2, 1/2) for SS-TWR and (1/2, K/2) for the paper's DS-TWR (ICRA 2023, section IV).
    """
    spans = intervals(exchanges)
    initiator = np.full(len(exchanges), np.nan)
    target = np.full(len(exchanges), np.nan)
    for name, rows in _rows_by_protocol(exchanges):
        initiator[rows], target[rows] = PROTOCOLS[name].delay_weights(_pick(spans, rows))
    return initiator, target


def board_range(exchanges: Exchanges) -> Floats:
    """Range in metres as the firmware prints it: SS in whole ticks, four decimals, truncated."""
    ticks = time_of_flight(exchanges) / TICK_S
    whole = np.where(exchanges.protocol == "ss", np.trunc(np.round(ticks, 6)), ticks)
    return truncate4((whole * METRES_PER_TICK).astype(np.float32).astype(np.float64))


def truncate4(values: Floats) -> Floats:
    """Four decimals, cut toward zero, as the boards print numbers (firmware wire format, 0.2)."""
    # Half a unit of float64 noise is added back, so that a value which already has four decimals
    # (-87.6187) is not cut to the one below (-87.6186).
    scaled = values * 1e4
    return np.trunc(scaled + np.copysign(1e-6, scaled)) / 1e4


def _rows_by_protocol(exchanges: Exchanges) -> list[tuple[str, Bools]]:
    found = [(name, exchanges.protocol == name) for name in PROTOCOLS]
    return [(name, rows) for name, rows in found if rows.any()]


def _pick(spans: Intervals, rows: Bools) -> Intervals:
    if rows.all():
        return spans
    return Intervals(*(getattr(spans, field.name)[rows] for field in fields(Intervals)))
