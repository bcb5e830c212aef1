"""Two-way ranging: exchange columns, and the protocols as rows of one table.

Stamps are those of Shalaby et al., ICRA 2023, Fig. 2: t1..t6 = tx1, rx1, tx2, rx2, tx3, rx3, so
dt41 = rx2 - tx1, dt32 = tx2 - rx1, dt53 = tx3 - tx2, dt64 = rx3 - rx2. tx1, rx2 and the initiator's
stamp of the third message are in the initiator's clock, the others in the target's.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from uwblink import formulas
from uwblink.arrays import Bools, Floats, Ints
from uwblink.errors import ArgumentError
from uwblink.formulas import Intervals
from uwblink.plugins import Registry
from uwblink.ticks import METRES_PER_TICK, REPORT_BITS, SPEED_OF_LIGHT, TICK_S, elapsed

Role = Literal["initiator", "target"]

STAMPS: Final = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")


@dataclass(frozen=True, slots=True, kw_only=True)
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

    `flight_ticks` maps `uwblink.formulas.Intervals` (n,) to the time of flight in ticks of the initiator's clock, (n,);
    `delay_weights` to the pair (d t_f/d d_i, d t_f/d d_j), (n,) each, by which a tag's aggregate antenna delay
    d = d_t - d_r enters the calibrated time of flight.
    """

    name: str
    title: str
    messages: tuple[ProtocolMessage, ...]
    flight_ticks: Callable[[Intervals], Floats]
    delay_weights: Callable[[Intervals], tuple[Floats, Floats]]

    @property
    def third_sender(self) -> Role | None:
        """Who sends the third message; None where there are only two."""
        return self.messages[2].sender if len(self.messages) > 2 else None


_POLL = ProtocolMessage("initiator", "", "at once")

_OWN: Final = (
    RangingProtocol(
        "ss",
        "SS-TWR",
        (_POLL, ProtocolMessage("target", "rx1", "scheduled")),
        formulas.single_sided,
        formulas.half_delays,
    ),
    RangingProtocol(
        "ss-cfo",
        "SS-TWR, corrected with the carrier integrator",
        (_POLL, ProtocolMessage("target", "rx1", "scheduled")),
        formulas.carrier_corrected,
        formulas.carrier_delays,
    ),
    RangingProtocol(
        "ds",
        "DS-TWR, third message from the target",
        (_POLL, ProtocolMessage("target", "rx1", "at once"), ProtocolMessage("target", "tx2", "scheduled")),
        formulas.double_sided,
        formulas.double_sided_delays,
    ),
    RangingProtocol(
        "ds-alt",
        "DS-TWR, third message from the initiator",
        (_POLL, ProtocolMessage("target", "rx1", "at once"), ProtocolMessage("initiator", "rx2", "scheduled")),
        formulas.alternative,
        formulas.alternative_delays,
    ),
    RangingProtocol(
        "ds-sym",
        "DS-TWR, third message from the initiator, equal replies",
        (_POLL, ProtocolMessage("target", "rx1", "scheduled"), ProtocolMessage("initiator", "rx2", "scheduled")),
        formulas.alternative,
        formulas.alternative_delays,
    ),
)

ON_BOARDS: Final = ("ss", "ds")
"""The protocols that the boards' firmware executes."""


def check_protocol(row: RangingProtocol) -> None:
    """Raise `ArgumentError` for a protocol that cannot be simulated, recorded and calibrated; says what is wrong.

    Its messages are two or three, of the order that the stamps of a recording have; and its formulas, tried on two
    exchanges without noise or skew, find the time of flight exactly, and take an antenna delay on either side out.
    """
    if not isinstance(row, RangingProtocol):
        raise ArgumentError(f"protocol: found {row!r:.60}, expected a RangingProtocol")
    if not isinstance(row.name, str) or not _NAME.fullmatch(row.name):
        raise ArgumentError(f"protocol: name: found {row.name!r:.60}, expected a word such as 'ds-alt'")
    if not isinstance(row.title, str) or not row.title:
        raise ArgumentError(f"protocol {row.name!r}: title: found {row.title!r:.60}, expected what pages call it")
    _check_messages(row)
    _check_formulas(row)


def _check_messages(row: RangingProtocol) -> None:
    where, messages = f"protocol {row.name!r}: messages", row.messages
    if not isinstance(messages, tuple) or not all(isinstance(m, ProtocolMessage) for m in messages):
        raise ArgumentError(f"{where}: found {messages!r:.60}, expected a tuple of ProtocolMessage")
    if not 2 <= len(messages) <= LONGEST_EXCHANGE:
        raise ArgumentError(
            f"{where}: found {len(messages)}, expected 2 or 3: an exchange is recorded with the six stamps of three "
            "messages, and one message alone measures no round trip"
        )
    for number, (message, allowed) in enumerate(zip(messages, _COURSE, strict=False), start=1):
        if (message.sender, message.after) not in allowed:
            choices = " or ".join(f"from the {sender} after {after or 'nothing'}" for sender, after in allowed)
            raise ArgumentError(
                f"{where}: {number} is from the {message.sender} after {message.after or 'nothing'}, expected {choices}"
            )
        if message.timing not in TIMINGS:
            raise ArgumentError(f"{where}: {number}: timing: found {message.timing!r}, allowed: {', '.join(TIMINGS)}")


def _check_formulas(row: RangingProtocol) -> None:
    where = f"protocol {row.name!r}"
    for name in ("flight_ticks", "delay_weights"):
        if not callable(getattr(row, name)):
            raise ArgumentError(f"{where}: {name}: found {getattr(row, name)!r:.60}, expected a function of Intervals")
    for delays in ((0.0, 0.0), (_TRIED_DELAY, 0.0), (0.0, _TRIED_DELAY)):
        spans = _tried(row.third_sender, delays)
        try:
            flight = np.asarray(row.flight_ticks(spans), dtype=np.float64)
            weights = np.asarray(row.delay_weights(spans), dtype=np.float64)
        except Exception as error:
            raise ArgumentError(f"{where}: its formulas fail on an exchange without noise: {error!r:.200}") from error
        if flight.shape != _TRIED_FLIGHT.shape or weights.shape != (2, *_TRIED_FLIGHT.shape):
            raise ArgumentError(
                f"{where}: its formulas return shapes {flight.shape} and {weights.shape} for two exchanges, "
                "expected (2,) and (2, 2)"
            )
        corrected = flight + weights[0] * delays[0] + weights[1] * delays[1]
        # 1e-2 ticks is 0.05 mm; what second order leaves of the delay tried, in the project's own rows, is 2e-5.
        if not np.allclose(corrected, _TRIED_FLIGHT, rtol=0, atol=1e-2):
            culprit = "delay_weights leave" if any(delays) else "flight_ticks finds"
            raise ArgumentError(
                f"{where}: {culprit} {corrected[0]:.6g} ticks where an exchange without noise took "
                f"{_TRIED_FLIGHT[0]:g}" + (f", with antenna delays of {delays[0]:g} and {delays[1]:g}" * any(delays))
            )


def _tried(third: Role | None, delays: tuple[float, float]) -> Intervals:
    """Return the intervals of two exchanges between equal clocks, with the aggregate delay of each side in them."""
    i, j = delays
    flight, reply, final = _TRIED_FLIGHT, np.array([2e7, 9.8e7]), np.array([9.8e7, 3e7])
    round_trip = 2 * flight + reply - i
    if third == "initiator":
        legs = final + i, 2 * flight + final - j
    else:
        legs = (final, final) if third else (np.zeros(2), np.zeros(2))
    return Intervals(round_trip, reply + j, *legs, np.zeros(2))


_TRIED_FLIGHT: Final = np.array([1000.0, 4000.0])
_TRIED_DELAY: Final = 64.0
_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9-]{0,40}")
LONGEST_EXCHANGE: Final = len(STAMPS) // 2
TIMINGS: Final = ("at once", "scheduled")
_COURSE: Final = (
    (("initiator", ""),),
    (("target", "rx1"),),
    (("target", "tx2"), ("initiator", "rx2")),
)
"""Who may send each message of an exchange, and after which stamp: that is what dt41 to dt64 are made of."""

PROTOCOLS: Final[Registry[RangingProtocol]] = Registry("protocol", "uwbcal.protocols", _OWN, check_protocol)
"""Protocols by name: the project's, those of `register_protocol`, and those of installed distributions."""


def register_protocol(row: RangingProtocol, *, replace: bool = False) -> None:
    """Add a protocol to `PROTOCOLS`: simulation, recording, calibration and comparison then know it by its name.

    `replace` puts it in place of one registered before. Raises `ArgumentError` for a name that is taken, for messages
    that a recording has no place for, and for formulas that are not exact without noise.
    """
    PROTOCOLS.register(row, replace=replace)


def single_sided() -> tuple[str, ...]:
    """Return the names of the protocols of two messages."""
    return tuple(row.name for row in PROTOCOLS.values() if row.third_sender is None)


def third_from_target() -> tuple[str, ...]:
    """Return the names of the protocols whose third message the target sends."""
    return tuple(row.name for row in PROTOCOLS.values() if row.third_sender == "target")


def intervals(exchanges: Exchanges) -> Intervals:
    """Return dt41, dt32, and the two readings of the third leg, dt53 (sent) and dt64 (received).

    Where the target sends the third message dt53 = tx3 - tx2 and dt64 = rx3 - rx2. Where the
    initiator sends it, dt53 = tx3 - rx2 is the initiator's reply and dt64 = rx3 - tx2 the target's
    round trip. Raises `ArgumentError` for exchanges of a protocol that is not in `PROTOCOLS`.
    """
    e, bits = exchanges, exchanges.bits
    target_sends = np.zeros(len(e), dtype=bool)
    for row, rows in _rows_by_protocol(e):
        target_sends[rows] = row.third_sender == "target"
    before_tx3 = np.where(target_sends, e.tx2, e.rx2)
    before_rx3 = np.where(target_sends, e.rx2, e.tx2)
    return Intervals(
        dt41=elapsed(e.rx2, e.tx1, bits).astype(np.float64),
        dt32=elapsed(e.tx2, e.rx1, bits).astype(np.float64),
        dt53=elapsed(e.tx3, before_tx3, bits).astype(np.float64),
        dt64=elapsed(e.rx3, before_rx3, bits).astype(np.float64),
        carrier_ppm=e.skew2_ppm,
    )


def time_of_flight(exchanges: Exchanges) -> Floats:
    """Raw time of flight in seconds, shape (n,): each row by the formula of its protocol.

    NaN or infinite where the stamps of a double-sided row are degenerate (dt53 = 0).
    """
    spans = intervals(exchanges)
    flight = np.full(len(exchanges), np.nan)
    for row, rows in _rows_by_protocol(exchanges):
        flight[rows] = row.flight_ticks(_pick(spans, rows)) * TICK_S
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
    for row, rows in _rows_by_protocol(exchanges):
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
    # (-87.6187) is not cut to the one below (-87.6186).
    scaled = values * 1e4
    return np.trunc(scaled + np.copysign(1e-6, scaled)) / 1e4


def _rows_by_protocol(exchanges: Exchanges) -> list[tuple[RangingProtocol, Bools]]:
    """Return each protocol that occurs, and its rows; looks for plug-ins only where the rows so far do not suffice."""
    found: list[tuple[RangingProtocol, Bools]] = []
    for rows in (PROTOCOLS.known, PROTOCOLS.values):
        masks = ((row, exchanges.protocol == row.name) for row in rows())
        found = [(row, mask) for row, mask in masks if mask.any()]
        if sum(int(np.count_nonzero(mask)) for _, mask in found) == len(exchanges):
            return found
    strange = sorted(set(np.unique(exchanges.protocol).tolist()) - set(PROTOCOLS))
    raise ArgumentError(f"protocol: found {strange[0]!r}, allowed: {', '.join(PROTOCOLS)}")


def _pick(spans: Intervals, rows: Bools) -> Intervals:
    if rows.all():
        return spans
    return Intervals(*(getattr(spans, field.name)[rows] for field in fields(Intervals)))
