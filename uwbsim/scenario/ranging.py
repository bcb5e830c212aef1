"""Ranging of a scenario: pairs, plan, rate and reply delays, and the durations of frames and exchanges."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Final, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from uwblink.arrays import Floats
from uwblink.protocols.table import PROTOCOLS, RangingProtocol
from uwbsim.scenario.base import NotNegative, Positive, Section, TagId, known_in, not_decreasing, require

PREAMBLE_SYMBOL_S: Final = 508 / 499.2e6
"""Of a preamble at a pulse repetition frequency of 64 MHz (DW1000 User Manual, section 10)."""

UUS_S: Final = 512 / 499.2e6
"""A UWB microsecond, which is also a symbol of a frame's header."""

TURNAROUND_S: Final = 1e-3
"""From the end of an exchange until its initiator sends the next poll: report over USB, next command, start-up.

Boards report 2.5 to 3.6 ms after the command of a double-sided exchange of 2.0 ms (firmware wire format, 1.5).
"""

RECEIVER_ON_S: Final = 40e-6
"""From the end of a frame until the receiver is on again (firmware wire format, 3.1)."""

PREAMBLE_TIMEOUT_S: Final = 6.521e-3
"""How long a board waits for a preamble (firmware wire format, 3.1)."""

POLL_BYTES: Final = 11
RESPONSE_BYTES: Final = 8
FINAL_BYTES: Final = 28
"""Lengths of the boards' frames with checksum (firmware wire format, 2.1)."""


def before_marker_s(preamble_symbols: int) -> float:
    """Return the time from the start of a frame to its ranging marker, which all stamps refer to.

    That is its preamble and a start-of-frame delimiter of 8 symbols.
    """
    return (preamble_symbols + 8) * PREAMBLE_SYMBOL_S


def after_marker_s(length_bytes: int) -> float:
    """Return the time from the ranging marker to the end of a frame at 6.8 Mb/s, with its Reed-Solomon parity."""
    bits = 8 * length_bytes
    return 21 * UUS_S + (bits + 48 * math.ceil(bits / 330)) * (64 / 499.2e6)


BROADCAST_BYTES: Final = 17
HEARD_BYTES: Final = 6
LONGEST_FRAME_BYTES: Final = 127
"""Of a broadcast with its number and its own stamp of 40 bits; of each tag that it heard, with its id and such a stamp;
and of the longest standard frame (User Manual, section 3.4): what it has no room for waits for the next one."""


def frame_s(length_bytes: int, preamble_symbols: int) -> float:
    """Return the whole duration of a frame in seconds."""
    return before_marker_s(preamble_symbols) + after_marker_s(length_bytes)


def message_bytes(protocol: RangingProtocol) -> tuple[int, ...]:
    """Return the lengths of a protocol's frames: poll, a response where there is one, final."""
    return (POLL_BYTES, *[RESPONSE_BYTES] * (len(protocol.messages) - 2), FINAL_BYTES)


def exchange_air_s(protocol: RangingProtocol, preamble_symbols: int) -> float:
    """Return how long one exchange occupies the air, all its frames together."""
    return sum(frame_s(length, preamble_symbols) for length in message_bytes(protocol))


def broadcast_s(tags: int, preamble_symbols: int) -> float:
    """Return the duration of a broadcast that reports what its sender heard of all other of so many tags."""
    length = BROADCAST_BYTES + HEARD_BYTES * (tags - 1)
    return frame_s(min(length, LONGEST_FRAME_BYTES), preamble_symbols)


def exchange_costs(
    protocol: RangingProtocol, preamble_symbols: int, scheduled_s: float, at_once_s: float
) -> dict[str, float]:
    """Return the durations of an exchange: `air_s`, `duration_s`, and `radio_on_s` of both radios together.

    `duration_s` is from the first preamble to the end of the last frame.
    """
    lengths, marker = message_bytes(protocol), 0.0
    end, radio = after_marker_s(lengths[0]), 2 * frame_s(lengths[0], preamble_symbols)
    for message, length in zip(protocol.messages[1:], lengths[1:], strict=True):
        marker += scheduled_s if message.timing == "scheduled" else at_once_s
        # The receiver listens from the end of the frame before, as soon as it is on again.
        listening = marker + after_marker_s(length) - end - RECEIVER_ON_S
        radio += frame_s(length, preamble_symbols) + max(listening, 0.0)
        end = marker + after_marker_s(length)
    return {
        "air_s": exchange_air_s(protocol, preamble_symbols),
        "duration_s": before_marker_s(preamble_symbols) + end,
        "radio_on_s": radio,
    }


# No `partial`: pydantic shows it with the whole table, and to list that loads plug-ins.
ProtocolName = Annotated[
    str,
    AfterValidator(lambda name: known_in(PROTOCOLS, name)),
    Field(json_schema_extra=lambda schema: schema.update(enum=sorted(PROTOCOLS))),
]


PlanName = Literal["round-robin", "tdma", "aloha", "common-list", "broadcast"]


class BoardReply(Section):
    """The reply latency measured on boards: two modes near 304 and 306 us, a tail to 386 us."""

    model: Literal["boards"] = Field("boards", description="Latencies as measured on boards.")
    median_s: ClassVar = 305e-6  # firmware wire format, 3.4

    def draw_s(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw latencies in seconds (count,) whose quantiles are those measured on boards (firmware wire format, 3.4).

        Two modes near 304.1 and 305.9 us, a shoulder, and a tenth delayed by the board's reading of its USB buffer.
        """
        kind = rng.random(count)
        microseconds = np.select(
            [kind < 0.41, kind < 0.86, kind < 0.91],
            [rng.normal(0.6, 0.3, count), rng.normal(2.4, 0.7, count), rng.normal(4.8, 0.7, count)],
            rng.uniform(6.5, 83.0, count),
        )
        return np.asarray((303.5 + np.maximum(microseconds, -0.1)) * 1e-6)


class FixedReply(Section):
    """A reply latency that is always the same."""

    model: Literal["fixed"] = Field(description="The same latency for all replies.")
    delay_us: Annotated[float, Field(ge=180, le=6000)] = Field(description="Time from the reception to the reply.")

    @property
    def median_s(self) -> float:
        """Return the latency in seconds."""
        return self.delay_us * 1e-6

    def draw_s(self, _rng: np.random.Generator, count: int) -> Floats:
        """Return the latency in seconds, (count,)."""
        return np.full(count, self.median_s)


class QuantileReply(Section):
    """Reply latencies by their quantiles, from 0 to 1 in equal steps, with all values in between equally likely."""

    model: Literal["quantiles"] = Field(description="Latencies with the given quantiles.")
    delays_us: Annotated[
        tuple[Annotated[float, Field(ge=180, le=6000)], ...], Field(min_length=2), AfterValidator(not_decreasing)
    ] = Field(description="Quantiles from 0 to 1 in equal steps, two or more, not decreasing.")

    @property
    def median_s(self) -> float:
        """Return the median latency in seconds."""
        return float(np.median(self.delays_us)) * 1e-6

    def draw_s(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw latencies in seconds, (count,)."""
        levels = np.linspace(0, 1, len(self.delays_us))
        return np.asarray(np.interp(rng.random(count), levels, self.delays_us) * 1e-6)


class PlanFile(Section):
    """A plan from a CSV file with the columns time_s, initiator, target; `slots` is filled in on reading.

    Slots after the end of the run are not flown, so that a long plan can be flown for a while.
    """

    file: str = Field(
        description="CSV file with the columns time_s, initiator, target; from the folder of the scenario.",
    )
    slots: tuple[tuple[float, int, int], ...] = Field(
        (),
        description="Its rows (time_s, initiator, target), filled in on reading.",
    )


class Ranging(Section):
    """The ranging plan: pairs, protocol, order and rate."""

    protocol: ProtocolName = Field(
        "ds",
        description="Ranging protocol.",
    )
    rate_hz: Positive = Field(
        description="Exchanges per second, all pairs together; frames of all tags with plan broadcast.",
    )
    pairs: Literal["between-bodies"] | tuple[tuple[TagId, TagId], ...] = Field(
        "between-bodies",
        description="Pairs, as [initiator, target]; or all pairs of tags on different bodies.",
    )
    plan: PlanName | PlanFile = Field(
        "round-robin",
        description="Order of exchanges: in turns, in slots of synchronized hosts (tdma), at random (aloha), by a list "
        "that all robots share (common-list), or by a file. With broadcast, each tag that is not passive sends one "
        "frame in its slot, and all others hear it: a frame of one tag and two of another make an exchange.",
    )
    sync_error_ms: NotNegative = Field(
        0.1,
        description="Standard deviation of the hosts' clocks, with plan tdma, or of each frame's time, with broadcast.",
    )
    list_timeout_ms: NotNegative = Field(
        10.0,
        description="Time for which a robot waits for an exchange that it cannot hear, with plan common-list.",
    )
    response_delay_uus: Annotated[int, Field(ge=280, le=6500)] = Field(
        1500,
        description="Delay of the scheduled message in UWB microseconds (1.0256 us): the boards' setting C08.",
    )
    reply: Annotated[BoardReply | FixedReply | QuantileReply, Field(discriminator="model")] = Field(
        BoardReply(),
        description="Latency of replies that are sent at once.",
    )
    get_cir: bool = Field(False, description="Whether initiators print their channel impulse responses.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        require(self.pairs, "pairs: found none, give at least one [initiator, target]")
        for one, other in self.pairs if self.pairs != "between-bodies" else ():
            require(one != other, f"pairs: tag {one} cannot range with itself")
        return self

    @property
    def scheduled_s(self) -> float:
        """Return the delay of the scheduled message in seconds."""
        return self.response_delay_uus * UUS_S

    def air_s(self, preamble_symbols: int, tags: int) -> float:
        """Return the air time of an exchange; of a broadcast by one of so many tags."""
        if self.plan == "broadcast":
            return broadcast_s(tags, preamble_symbols)
        return exchange_air_s(PROTOCOLS[self.protocol], preamble_symbols)

    def fastest_hz(self, preamble_symbols: int, tags: int = 2) -> float:
        """Return how many exchanges a second one after the other allow, or broadcasts by so many tags.

        A tag sends its broadcast as soon after the one before as it sends a reply.
        """
        if self.plan == "broadcast":
            return 1 / (self.air_s(preamble_symbols, tags) + self.reply.median_s)
        row = PROTOCOLS[self.protocol]
        cost = exchange_costs(row, preamble_symbols, self.scheduled_s, self.reply.median_s)
        return 1 / (cost["duration_s"] + TURNAROUND_S)
