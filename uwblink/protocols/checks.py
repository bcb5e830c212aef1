"""What a protocol's row must be: tried before anything is ranged with it."""

from __future__ import annotations

from typing import Final

import numpy as np

from uwblink.errors import ArgumentError
from uwblink.protocols.formulas import Intervals
from uwblink.protocols.rows import RangingProtocol

_TRIED_FLIGHT: Final = np.array([1000.0, 4000.0])
_TRIED_DELAY: Final = 64.0
LONGEST_EXCHANGE: Final = 3
TIMINGS: Final = ("at once", "scheduled")
_COURSE: Final = (
    (("initiator", ""),),
    (("target", "rx1"),),
    (("target", "tx2"), ("initiator", "rx2")),
)
"""Who may send each message of an exchange, and after which stamp: that is what dt41 to dt64 are made of."""


def check_messages(row: RangingProtocol) -> None:
    """Raise `ArgumentError` for messages that are not two or three, in the order that a recording has stamps for."""
    where, messages = f"protocol {row.name!r}: messages", row.messages
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


def check_formulas(row: RangingProtocol) -> None:
    """Raise `ArgumentError` for formulas that are not exact for exchanges without noise, or leave antenna delays in."""
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


def _tried(third: str | None, delays: tuple[float, float]) -> Intervals:
    """Return the intervals of two exchanges between equal clocks, with the aggregate delay of each side in them."""
    i, j = delays
    flight, reply, final = _TRIED_FLIGHT, np.array([2e7, 9.8e7]), np.array([9.8e7, 3e7])
    round_trip = 2 * flight + reply - i
    if third == "initiator":
        legs = final + i, 2 * flight + final - j
    else:
        legs = (final, final) if third else (np.zeros(2), np.zeros(2))
    return Intervals(round_trip, reply + j, *legs, np.zeros(2))
