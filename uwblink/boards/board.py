"""A board at a serial port: the conversation with it, without I/O, and a class for scripts and notebooks.

```python
from uwblink.boards.board import Board

with Board.open("/dev/ttyACM0") as board:
    report = board.range(20)
    print(board.id, report.range_m)
```

One command is outstanding at a time; it ends with its reply, with a line of text by which the firmware reports a
failure, or with a time-out. After a time-out the board may still answer, and a late reply must not be taken for the
reply of the next command. Therefore a fence (C00, answered by R00) is sent first, and replies before R00 are late
(firmware wire format, 1.8).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, Self, TypeVar

from uwblink.boards.ports import Closing, SerialPort, Transport
from uwblink.errors import BoardError, NoAnswerError, RangingFailedError, RefusedError, restating
from uwblink.protocols.table import ON_BOARDS
from uwblink.wire.codec import Decoder, Event, encode
from uwblink.wire.messages import (
    COMMANDS,
    REPORTS,
    Bootloader,
    Broadcast,
    Cir,
    DoTests,
    GetId,
    IdleSet,
    IdReport,
    Message,
    RangeCommand,
    RangeReport,
    SetIdle,
    SetPassive,
    SetResponseDelay,
    Skipped,
    TestsDone,
    TextLine,
)

FENCE: Final = SetIdle()
"""A command whose answer comes after all late answers."""

ANSWER_S: Final = 0.15
"""Longest wait for a reply: six failing tries take 50 ms, the rest is for USB and the host."""

PATIENT_S: Final = 1.0
"""Longest wait for the answer to a fence, after which the board is considered dead."""

QUIET_AFTER_CIR_S: Final = 0.030
"""Time without commands to an initiator after the report of an exchange with impulse response: it prints for 22 to 28
ms (firmware wire format, 1.4)."""

QUIET_TARGET_S: Final = 0.040
"""The same for the target, which prints its response before its report, if reports of targets are on."""


@dataclass(frozen=True, slots=True)
class CommandOutcome:
    """The end of a command: the reply, or an error with the reason why there is none."""

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
    """The conversation with the board at one port, without I/O: it converts bytes and times into bytes, events and
    outcomes.
    """

    def __init__(self, name: str, answer_s: float = ANSWER_S) -> None:
        """Start a conversation; `name` is the name of the port, for error messages."""
        self.name = name
        self.decoder = Decoder(REPORTS)
        self.doubtful = False
        """Whether a late reply is possible, so that a fence must be sent before the next command."""
        self._answer_s = answer_s
        self._pending: _Pending | None = None
        self._quiet_until_s = 0.0

    @property
    def busy(self) -> bool:
        """Whether a command is outstanding."""
        return self._pending is not None

    def ready_s(self, now_s: float) -> float:
        """Return the time to wait until the board may get the next command."""
        return max(self._quiet_until_s - now_s, 0.0)

    def deadline_s(self) -> float | None:
        """Return the time at which the outstanding command times out, None without one."""
        return self._pending.until_s if self._pending else None

    def send(self, command: Message, now_s: float) -> bytes:
        """Return the bytes to write, in one write; raises `RefusedError` for commands that the board must not get."""
        if self._pending:
            raise RefusedError(f"{self.name}: {self._pending.command.KEY.decode()} is still waiting for its answer")
        data = checked(command)
        answer_s = max(PATIENT_S, self._answer_s) if command is FENCE and self.doubtful else self._answer_s
        self._pending = _Pending(command, now_s + answer_s, answer_s)
        return data

    def receive(self, data: bytes, now_s: float) -> tuple[list[Event], CommandOutcome | None]:
        """Add received bytes, or none; returns all their events, and the outcome of the command if it ended."""
        events, outcome = self.decoder.feed(data), None
        # The pieces of an impulse response arrive a millisecond apart, and a target's report 3 ms after it.
        if data and (self.decoder.begun == Cir.KEY or any(isinstance(event, Cir) for event in events)):
            self._quiet_until_s = max(self._quiet_until_s, now_s + 0.005)
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
            text += "; check that this is a ranging board and that it has power; a board that hangs must be unplugged"
        return CommandOutcome(pending.command, None, NoAnswerError(text))

    def _ended_by(self, pending: _Pending, event: Event, now_s: float) -> CommandOutcome | None:
        command = pending.command
        if isinstance(event, Skipped):
            return None
        if isinstance(event, TextLine):
            pending.lines.append(event.text.strip())
            # Only these two kinds of command can fail; text after another command belongs to an earlier one.
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
                self._quiet_until_s = now_s + QUIET_AFTER_CIR_S
        self._pending = None
        if isinstance(event, IdleSet):
            self.doubtful = False
        return CommandOutcome(command, event, None)


def checked(command: Message) -> bytes:
    """Return the bytes of a command; raises `RefusedError` for invalid values, which boards do not check."""
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
    with restating(RefusedError, ValueError):
        data = encode(command)
    if len(data) > 64:
        raise RefusedError(f"{kind} of {len(data)} bytes: {why}")
    return data


Reply = TypeVar("Reply", bound=Message)


class Board(Closing):
    """One board, for use in one thread at a time.

    `Board.open("/dev/ttyACM0")` opens a board on a serial port. An example with two simulated boards, 10 and 20:

    >>> import uwblink, uwbsim
    >>> ports = uwbsim.VirtualPorts(uwbsim.load("two_boards_on_a_bench/bench"))
    >>> with uwblink.Board(ports.port(10)) as board:
    ...     report = board.range(20)
    >>> board.id, report.neighbour, abs(report.range_m - 3.0) < 0.2
    (10, 20, True)
    """

    def __init__(
        self, transport: Transport, *, answer_s: float = ANSWER_S, connection: Connection | None = None
    ) -> None:
        """Use an open transport, and its `connection` if it has one; `open` takes the name of a port."""
        self._transport = transport
        self._connection = connection or Connection(transport.name, answer_s)
        self._reports: deque[Event] = deque(maxlen=10_000)
        self._id: int | None = None

    @classmethod
    def open(cls, port: str) -> Self:
        """Open a serial port or pyserial URL; raises a `PortError`. Nothing is written to it."""
        return cls(SerialPort(port))

    def close(self) -> None:
        """Close the port."""
        self._transport.close()

    @property
    def name(self) -> str:
        """The port's name."""
        return self._transport.name

    @property
    def id(self) -> int:
        """The board's id, read once."""
        if self._id is None:
            self._id = self._ask(GetId(), IdReport).board
        return self._id

    def request(self, command: Message) -> Message:
        """Send a command and return its reply.

        If a board does not answer, the command is repeated after up to a second. Raises `RefusedError` (nothing was
        sent), `NoAnswerError`, `RangingFailedError` with the board's own line, or `PortLostError`. Other reports are
        kept for `reports`.
        """
        self._pass(0.0)
        while (wait_s := self._connection.ready_s(self._transport.now_s())) > 0:
            self._pass(wait_s)  # an incoming impulse response delays commands
        if self._connection.doubtful:
            self._exchange(FENCE)
        try:
            return self._exchange(command)
        except NoAnswerError as error:
            try:
                self._exchange(FENCE)  # with a long time-out: firmware that waits for a frame answers late
            except NoAnswerError as still:
                raise NoAnswerError(f"{error}; then {str(still).removeprefix(f'{self.name}: ')}") from still
            if isinstance(command, Broadcast | Bootloader):
                raise  # it may have been executed, and must not be executed twice
        return self._exchange(command)

    def range(
        self, target: int, *, protocol: str = "ds", target_reports: bool = False, get_cir: bool = False
    ) -> RangeReport:
        """Range with another board; `protocol` is "ss" or "ds". Raises what `request` raises.

        With both `target_reports` and `get_cir` it waits until the target has printed its impulse response, because a
        command would damage what a board prints.
        """
        if protocol not in ON_BOARDS:
            raise RefusedError(f"protocol {protocol!r}: the boards know {' and '.join(ON_BOARDS)}")
        if self._id is not None and target == self._id:
            raise RefusedError(f"{self.name}: target {target} is the board's own id; name another one")
        report = self._ask(RangeCommand(target, target_reports, protocol == "ds", get_cir), RangeReport)
        if target_reports and get_cir:
            self._pass(QUIET_TARGET_S)
        return report

    def cir(self, target: int, *, protocol: str = "ds") -> tuple[RangeReport, Cir]:
        """Range with another board and return its report and the channel impulse response of the last frame."""
        report = self.range(target, protocol=protocol, get_cir=True)
        for event in self.reports(0.2):
            if isinstance(event, Cir):
                return report, event
        raise NoAnswerError(f"{self.name}: no channel impulse response within 200 ms of the range")

    def set_passive(self, on: bool) -> None:
        """Listen to the exchanges of others, or stop listening; the setting is lost at a power cycle."""
        self.request(SetPassive(on))

    def set_response_delay(self, delay_uus: int) -> None:
        """Set the delay of double-sided exchanges for which this board is the target, 280 to 6500 (512/499.2 us)."""
        self.request(SetResponseDelay(delay_uus))

    def send(self, data: bytes) -> None:
        """Broadcast up to 57 bytes to every board in range; delivery is not confirmed."""
        self.request(Broadcast(data))

    def test(self) -> TestsDone:
        """Test that the board echoes one field of each kind; raises `BoardError` if the echo is wrong."""
        sent = DoTests(12345, "uwblink", True, 1.25, b"\x00|\r\n\xff")
        echo = self._ask(sent, TestsDone)
        wrong = [n for n in DoTests.FIELDS if getattr(echo, n) != getattr(sent, n)]
        if wrong:
            raise BoardError(f"{self.name}: the echo differs in {', '.join(wrong)}: {echo}")
        if echo.error:
            raise BoardError(f"{self.name}: the id of its radio differs from its own (error {echo.error})")
        return echo

    def reports(self, timeout_s: float) -> Iterator[Event]:
        """Yield messages and lines of text other than replies, until none arrives for `timeout_s`."""
        while True:
            while self._reports:
                yield self._reports.popleft()
            self._pass(timeout_s, until_report=True)
            if not self._reports:
                return

    def _ask(self, command: Message, kind: type[Reply]) -> Reply:
        reply = self.request(command)
        if not isinstance(reply, kind):
            raise BoardError(f"{self.name}: found {reply}, expected {kind.__name__}")
        return reply

    def _exchange(self, command: Message) -> Message:
        transport, connection = self._transport, self._connection
        transport.write(connection.send(command, transport.now_s()))
        while True:
            data = transport.read(max((connection.deadline_s() or 0.0) - transport.now_s(), 0.0))
            events, outcome = connection.receive(data, transport.now_s())
            self._keep(events, outcome.reply if outcome else None)
            if outcome and outcome.error:
                raise outcome.error
            if outcome and outcome.reply:
                return outcome.reply

    def _keep(self, events: list[Event], reply: Message | None) -> None:
        self._reports.extend(e for e in events if e is not reply and not isinstance(e, Skipped))

    def _pass(self, seconds: float, *, until_report: bool = False) -> None:
        """Wait, and keep reports that arrive; with 0 seconds, read the bytes that have arrived."""
        until_s = self._transport.now_s() + seconds
        while True:
            data = self._transport.read(max(until_s - self._transport.now_s(), 0.0))
            events, _ = self._connection.receive(data, self._transport.now_s())
            self._keep(events, None)
            if self._transport.now_s() >= until_s or (until_report and self._reports):
                return
