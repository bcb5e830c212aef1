"""The driver's side of a conversation with a board, without any I/O.

One command is outstanding at a time; it ends with its reply, with a line of text by which the firmware reports a
failure, or by time. After a time-out the board may still answer, and a late reply must not pass for that of the next
command: a fence (C00, answered by R00) is sent first, and what comes before R00 is late (firmware wire format, 1.8).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from uwblink.errors import BoardError, NoAnswerError, RangingFailedError, RefusedError
from uwblink.wire.codec import Decoder, Event, encode
from uwblink.wire.messages import (
    COMMANDS,
    REPORTS,
    Broadcast,
    Cir,
    DoTests,
    IdleSet,
    Message,
    RangeCommand,
    RangeReport,
    SetIdle,
    SetResponseDelay,
    Skipped,
    TextLine,
)

ANSWER_S: Final = 0.15
"""Longest wait for a reply: six failing tries take 50 ms, and the rest is USB and the host."""

PATIENT_S: Final = 1.0
"""How long a board that has not answered is given to answer a fence, before it is called dead."""

QUIET_AFTER_CIR_S: Final = 0.030
"""For how long an initiator is left alone after the report of an exchange whose impulse response was asked for."""

QUIET_TARGET_S: Final = 0.040
"""The same for the target, which prints its own before its report, if it was asked to report."""

PACKET_BYTES: Final = 64
"""What one USB packet carries. A board that looks at its buffer between two packets of a command is dead."""

LARGEST_ECHOED: Final = 9999.0
"""A number printed with more than nine characters overflows the firmware's buffer (firmware wire format, 1.6)."""

SHORTEST_SETTABLE_DELAY_UUS: Final = 280
LONGEST_SETTABLE_DELAY_UUS: Final = 6500
FAILURES: Final = ("COMMANDED TASK FAILED", "TWR FAIL", "ERROR: Requested to send message")
GAP_IN_CIR_S: Final = 0.005
"""The pieces of an impulse response come a millisecond apart; one that stays away longer never comes."""

REPORT_AFTER_CIR_S: Final = 0.003
"""A target prints its report after its impulse response."""

HEARD_BYTES: Final = 60
DEAD: Final = "is this a ranging board, and has it power? A board that hangs must be unplugged"


@dataclass(frozen=True, slots=True)
class CommandOutcome:
    """How a command ended: the reply, or an error that says why there is none."""

    command: Message
    reply: Message | None
    error: BoardError | None


@dataclass(slots=True)
class _Pending:
    command: Message
    until_s: float
    answer_s: float
    lines: list[str]
    heard: bytes = b""


class Connection:
    """The conversation with the board at one port. Bytes and times go in, bytes, events and outcomes come out."""

    def __init__(self, name: str, answer_s: float = ANSWER_S) -> None:
        """Begin; `name` is the port's, for the texts of errors."""
        self.name = name
        self.decoder = Decoder(REPORTS)
        self._answer_s = answer_s
        self._pending: _Pending | None = None
        self._doubtful = False
        self._quiet_until_s = self._heard_s = 0.0
        self.late = 0
        """Replies that came after their time."""

    @property
    def busy(self) -> bool:
        """Whether a command is outstanding."""
        return self._pending is not None

    @property
    def doubtful(self) -> bool:
        """Whether a late reply may still come, so that a fence must be sent before the next command."""
        return self._doubtful

    def ready_s(self, now_s: float) -> float:
        """Return how long to wait until the board may be asked again."""
        if self.decoder.begun == Cir.KEY:  # somebody else asked for the impulse response that is coming in
            return max(self._quiet_until_s, self._heard_s + GAP_IN_CIR_S) - now_s
        return max(self._quiet_until_s - now_s, 0.0)

    def leave_alone(self, until_s: float) -> None:
        """Have the board not asked anything before a time, because it is printing an impulse response."""
        self._quiet_until_s = max(self._quiet_until_s, until_s)

    def deadline_s(self) -> float | None:
        """Return when the outstanding command runs out of time."""
        return self._pending.until_s if self._pending else None

    def send(self, command: Message, now_s: float) -> bytes:
        """Return the bytes to write, in one write; raises `RefusedError` for what the board must not get."""
        if self._pending:
            raise RefusedError(f"{self.name}: {self._pending.command.KEY.decode()} is still waiting for its answer")
        data = checked(command)
        answer_s = max(PATIENT_S, self._answer_s) if command is FENCE and self._doubtful else self._answer_s
        self._pending = _Pending(command, now_s + answer_s, answer_s, [])
        return data

    def receive(self, data: bytes, now_s: float) -> tuple[list[Event], CommandOutcome | None]:
        """Take in bytes; returns everything they hold, and the outcome of the command if it ended."""
        events = self.decoder.feed(data)
        self._heard_s = now_s if data else self._heard_s
        pending, outcome = self._pending, None
        if pending:
            pending.heard = (pending.heard + data)[-HEARD_BYTES:]
        for event in events:
            if isinstance(event, Cir):
                self._quiet_until_s = now_s + REPORT_AFTER_CIR_S
            if outcome is None and self._pending is not None:
                outcome = self._ended_by(self._pending, event, now_s)
            elif isinstance(event, RangeReport) and event.KEY == b"R05":
                self.late += 1
        return events, outcome

    def expire(self, now_s: float) -> CommandOutcome | None:
        """Return the outcome of a command whose time is over."""
        pending = self._pending
        if pending is None or now_s < pending.until_s:
            return None
        self._pending, self._doubtful = None, True
        heard = repr(pending.heard)[1:] if pending.heard else "nothing"
        sent = encode(pending.command)
        text = f"{self.name}: no answer to {sent!r} within {pending.answer_s * 1e3:.0f} ms; heard {heard}"
        if not pending.heard and pending.answer_s >= PATIENT_S:
            text += f"; {DEAD}"
        return CommandOutcome(pending.command, None, NoAnswerError(text))

    def settled(self) -> None:
        """Note that a fence was answered: nothing late can come any more."""
        self._doubtful = False

    def _ended_by(self, pending: _Pending, event: Event, now_s: float) -> CommandOutcome | None:
        if isinstance(event, Skipped):
            return None
        if isinstance(event, TextLine):
            pending.lines.append(event.text.strip())
            # Only these two kinds of command can fail; the text of another one is left over from before.
            fails = isinstance(pending.command, RangeCommand | Broadcast) and event.text.startswith(FAILURES[:2])
            return self._failed(pending) if fails else None
        if b"R" + pending.command.KEY[1:] != event.KEY:
            return None
        if isinstance(event, RangeReport) and not self._is_asked_for(pending.command, event):
            self.late += 1
            return None
        if isinstance(pending.command, RangeCommand) and pending.command.get_cir:
            self._quiet_until_s = now_s + QUIET_AFTER_CIR_S
        self._pending = None
        if isinstance(event, IdleSet):
            self._doubtful = False
        return CommandOutcome(pending.command, event, None)

    def _is_asked_for(self, command: Message, report: RangeReport) -> bool:
        if not isinstance(command, RangeCommand):
            return False
        return report.neighbour == command.target and (report.tx3 != 0 or not command.double_sided)

    def _failed(self, pending: _Pending) -> CommandOutcome:
        self._pending = None
        lines = "; ".join(dict.fromkeys(pending.lines))
        what = "ranging"
        if isinstance(pending.command, RangeCommand):
            what = f"ranging with {pending.command.target}"
        elif isinstance(pending.command, Broadcast):
            what = "the broadcast"
        return CommandOutcome(
            pending.command, None, RangingFailedError(f"{self.name}: {what} failed; the board says: {lines}")
        )


FENCE: Final = SetIdle()


def checked(command: Message) -> bytes:
    """Return a command's bytes, or raise `RefusedError`: boards do not check what they are told."""
    if COMMANDS.get(command.KEY) is not type(command):
        raise RefusedError(f"{type(command).__name__} is not a command")
    if (
        isinstance(command, SetResponseDelay)
        and not SHORTEST_SETTABLE_DELAY_UUS <= command.delay_uus <= LONGEST_SETTABLE_DELAY_UUS
    ):
        raise RefusedError(
            f"response delay {command.delay_uus}: allowed are {SHORTEST_SETTABLE_DELAY_UUS} to "
            f"{LONGEST_SETTABLE_DELAY_UUS} (UWB microseconds); outside, every double-sided exchange with this "
            "target fails"
        )
    if isinstance(command, DoTests) and not abs(command.number) <= LARGEST_ECHOED:
        raise RefusedError(
            f"number {command.number!r}: allowed are -{LARGEST_ECHOED:g} to {LARGEST_ECHOED:g}; printing a longer one "
            "overwrites the board's memory"
        )
    if isinstance(command, Broadcast) and len(command.data) > LONGEST_BROADCAST:
        raise RefusedError(f"a broadcast of {len(command.data)} bytes: at most {LONGEST_BROADCAST} fit; {ONE_PACKET}")
    try:
        data = encode(command)
    except ValueError as error:
        raise RefusedError(str(error)) from error
    if len(data) > PACKET_BYTES:
        raise RefusedError(f"{type(command).__name__} of {len(data)} bytes: {ONE_PACKET}")
    return data


ONE_PACKET: Final = (
    f"a command must fit one USB packet of {PACKET_BYTES} bytes, because a board that finds part of one in its buffer "
    "crashes and must be unplugged"
)


LONGEST_BROADCAST: Final = PACKET_BYTES - len(encode(Broadcast(b"")))
"""57 bytes. The boards' frames would carry 92, but no command brings them there safely."""
