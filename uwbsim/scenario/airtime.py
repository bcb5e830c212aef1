"""How long frames are on the air (DW1000 User Manual 2.10, section 10)."""

from __future__ import annotations

import math
from typing import Final

from uwblink.protocols.rows import RangingProtocol

PREAMBLE_SYMBOL_S: Final = 508 / 499.2e6
HEADER_SYMBOL_S: Final = 512 / 499.2e6
DATA_SYMBOL_S: Final = 64 / 499.2e6
SFD_SYMBOLS: Final = 8
HEADER_SYMBOLS: Final = 21

TURNAROUND_S: Final = 1e-3
"""From the end of an exchange until its initiator sends the next poll: report over USB, next command, start-up.

Boards report 2.5 to 3.6 ms after the command of a double-sided exchange of 2.0 ms (firmware wire format, 1.5).
"""

RECEIVER_ON_S: Final = 40e-6
"""From the end of a frame until the receiver is on again (firmware wire format, 3.1)."""

POLL_BYTES: Final = 11
RESPONSE_BYTES: Final = 8
FINAL_BYTES: Final = 28


def before_marker_s(preamble_symbols: int) -> float:
    """Return the time from the start of a frame to its ranging marker, which all stamps refer to."""
    return (preamble_symbols + SFD_SYMBOLS) * PREAMBLE_SYMBOL_S


def after_marker_s(length_bytes: int) -> float:
    """Return the time from the ranging marker to the end of a frame at 6.8 Mb/s, with its Reed-Solomon parity."""
    bits = 8 * length_bytes
    return HEADER_SYMBOLS * HEADER_SYMBOL_S + (bits + 48 * math.ceil(bits / 330)) * DATA_SYMBOL_S


def frame_s(length_bytes: int, preamble_symbols: int) -> float:
    """Return the whole duration of a frame in seconds."""
    return before_marker_s(preamble_symbols) + after_marker_s(length_bytes)


def message_bytes(protocol: RangingProtocol) -> tuple[int, ...]:
    """Return the lengths of a protocol's frames: poll, a response where there is one, final."""
    middle = [RESPONSE_BYTES] * (len(protocol.messages) - 2)
    return (POLL_BYTES, *middle, FINAL_BYTES)


def exchange_air_s(protocol: RangingProtocol, preamble_symbols: int) -> float:
    """Return how long one exchange occupies the air, all its frames together."""
    return sum(frame_s(length, preamble_symbols) for length in message_bytes(protocol))


def exchange_s(protocol: RangingProtocol, preamble_symbols: int, scheduled_s: float, at_once_s: float) -> float:
    """Return how long an exchange takes, from its first preamble to the end of its last frame."""
    replies = sum(scheduled_s if message.timing == "scheduled" else at_once_s for message in protocol.messages[1:])
    return before_marker_s(preamble_symbols) + replies + after_marker_s(message_bytes(protocol)[-1])
