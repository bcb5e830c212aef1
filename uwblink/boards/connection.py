"""The driver's side of a conversation with a board, without any I/O.

One command is outstanding at a time; it ends with its reply, with a line of text by which the firmware reports a
failure, or by time. After a time-out the board may still answer, and a late reply must not pass for that of the next
command: a fence (C00, answered by R00) is sent first, and what comes before R00 is late (firmware wire format, 1.8).
"""

from __future__ import annotations

from dataclasses import dataclass, field
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

FENCE: Final = SetIdle()
"""A command after whose answer no late answers can come."""

ANSWER_S: Final = 0.15
"""Longest wait for a reply: six failing tries take 50 ms, and the rest is USB and the host."""

PATIENT_S: Final = 1.0
"""Longest wait for the answer to a fence, after which the board is considered dead."""

QUIET_AFTER_CIR_S: Final = 0.030
"""How long an initiator is left alone after the report of an exchange whose impulse response was asked for: it prints
for 22 to 28 ms (firmware wire format, 1.4)."""

QUIET_TARGET_S: Final = 0.040
"""The same for the target, which prints its own before its report, if it was asked to report."""


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
    lines: list[str] = field(default_factory=list)
    heard: bytes = b""


class Connection:
    """The conversation with the board at one port. Bytes and times go in, bytes, events and outcomes come out."""

    def __init__(self, name: str, answer_s: float = ANSWER_S) -> None:
        """`name` is the name of the port, for error messages."""
        self.name = name
        self.decoder = Decoder(REPORTS)
        self.doubtful = False
        """Whether a late reply may still come, so that a fence must be sent before the next command."""
        self._answer_s = answer_s
        self._pending: _Pending | None = None
        self._quiet_until_s = 0.0

    @property
    def busy(self) -> bool:
        """Whether a command is outstanding."""
        return self._pending is not None

    def ready_s(self, now_s: float) -> float:
        """Return how long to wait until the board may be asked again."""
        return max(self._quiet_until_s - now_s, 0.0)

    def keep_quiet(self, until_s: float) -> None:
        """Send no command before a time, because the board is printing an impulse response."""
        self._quiet_until_s = max(self._quiet_until_s, until_s)

    def deadline_s(self) -> float | None:
        """Return the time at which the outstanding command times out, None without one."""
        return self._pending.until_s if self._pending else None

    def send(self, command: Message, now_s: float) -> bytes:
        """Return the bytes to write, in one write; raises `RefusedError` for what the board must not get."""
        if self._pending:
            raise RefusedError(f"{self.name}: {self._pending.command.KEY.decode()} is still waiting for its answer")
        data = checked(command)
        answer_s = max(PATIENT_S, self._answer_s) if command is FENCE and self.doubtful else self._answer_s
        self._pending = _Pending(command, now_s + answer_s, answer_s)
        return data

    def receive(self, data: bytes, now_s: float) -> tuple[list[Event], CommandOutcome | None]:
        """Take in bytes, or none; returns everything they hold, and the outcome of the command if it ended."""
        events, outcome = self.decoder.feed(data), None
        # The pieces of an impulse response come a millisecond apart, and a target's report 3 ms after it.
        if data and (self.decoder.begun == Cir.KEY or any(isinstance(event, Cir) for event in events)):
            self.keep_quiet(now_s + 0.005)
        if self._pending:
            self._pending.heard = (self._pending.heard + data)[-60:]
        for event in events:
            if self._pending is not None:
                outcome = self._ended_by(self._pending, event, now_s)
        if self._pending and now_s >= self._pending.until_s:
            outcome = self._expired(self._pending)
        return events, outcome

    def _expired(self, pending: _Pending) -> CommandOutcome:
        self._pending, self.doubtful = None, True
        heard = repr(pending.heard)[1:] if pending.heard else "nothing"
        sent = encode(pending.command)
        text = f"{self.name}: no answer to {sent!r} within {pending.answer_s * 1e3:.0f} ms; heard {heard}"
        if not pending.heard and pending.answer_s >= PATIENT_S:
            text += "; is this a ranging board, and has it power? A board that hangs must be unplugged"
        return CommandOutcome(pending.command, None, NoAnswerError(text))

    def _ended_by(self, pending: _Pending, event: Event, now_s: float) -> CommandOutcome | None:
        command = pending.command
        if isinstance(event, Skipped):
            return None
        if isinstance(event, TextLine):
            pending.lines.append(event.text.strip())
            # Only these two kinds of command can fail; the text of another one is left over from before.
            failed = event.text.startswith(("COMMANDED TASK FAILED", "TWR FAIL"))
            if not failed or not isinstance(command, RangeCommand | Broadcast):
                return None
            self._pending = None
            what = f"ranging with {command.target}" if isinstance(command, RangeCommand) else "the broadcast"
            lines = "; ".join(dict.fromkeys(pending.lines))
            return CommandOutcome(
                command, None, RangingFailedError(f"{self.name}: {what} failed; the board says: {lines}")
            )
        if b"R" + command.KEY[1:] != event.KEY:
            return None
        if isinstance(event, RangeReport) and isinstance(command, RangeCommand):
            if event.neighbour != command.target or (command.double_sided and event.tx3 == 0):
                return None  # a late report of another command
            if command.get_cir:
                self.keep_quiet(now_s + QUIET_AFTER_CIR_S)
        self._pending = None
        if isinstance(event, IdleSet):
            self.doubtful = False
        return CommandOutcome(command, event, None)


def checked(command: Message) -> bytes:
    """Return the bytes of a command; raises `RefusedError` for values that boards do not check."""
    kind = type(command).__name__
    if COMMANDS.get(command.KEY) is not type(command):
        raise RefusedError(f"{kind} is not a command")
    # Limits of the firmware (wire format, 3.6 and 1.6).
    if isinstance(command, SetResponseDelay) and not 280 <= command.delay_uus <= 6500:
        raise RefusedError(
            f"response delay {command.delay_uus}: allowed are 280 to 6500 (UWB microseconds); outside, every "
            "double-sided exchange with this target fails"
        )
    if isinstance(command, DoTests) and not abs(command.number) <= 9999.0:
        raise RefusedError(
            f"number {command.number!r}: allowed are -9999 to 9999; printing a longer one overwrites the board's memory"
        )
    # A USB packet carries 64 bytes: 57 of a broadcast. The boards' frames would carry 92.
    why = (
        "a command must fit one USB packet of 64 bytes, because a board that finds part of one in its buffer crashes "
        "and must be unplugged"
    )
    if isinstance(command, Broadcast) and len(command.data) > 57:
        raise RefusedError(f"a broadcast of {len(command.data)} bytes: at most 57 fit; {why}")
    try:
        data = encode(command)
    except ValueError as error:
        raise RefusedError(str(error)) from error
    if len(data) > 64:
        raise RefusedError(f"{kind} of {len(data)} bytes: {why}")
    return data
