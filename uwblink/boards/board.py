"""A board at a serial port, for scripts and notebooks: commands, ranges, and reports.

```python
from uwblink.boards.board import Board

with Board.open("/dev/ttyACM0") as board:
    report = board.range(20)
    print(board.id, report.range_m)
```
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Self, TypeVar

from uwblink.boards.connection import ANSWER_S, FENCE, QUIET_TARGET_S, Connection
from uwblink.boards.ports import SerialPort, Transport
from uwblink.closing import Closing
from uwblink.errors import BoardError, NoAnswerError, RefusedError
from uwblink.protocols.table import ON_BOARDS
from uwblink.wire.codec import Event
from uwblink.wire.messages import (
    Bootloader,
    Broadcast,
    Cir,
    DoTests,
    GetId,
    IdReport,
    Message,
    RangeCommand,
    RangeReport,
    SetPassive,
    SetResponseDelay,
    Skipped,
    TestsDone,
)

Reply = TypeVar("Reply", bound=Message)


class Board(Closing):
    """One board, for use in one thread at a time.

    `Board.open("/dev/ttyACM0")` opens a board on a serial port. An example with two simulated boards:

    >>> import uwblink, uwbsim
    >>> ports = uwbsim.VirtualPorts(
    ...     uwbsim.load(
    ...         '''
    ...         run = { duration_s = 10.0 }
    ...         ranging = { rate_hz = 50 }
    ...         bodies = [
    ...             { name = "near", motion = { model = "static", position_m = [0.0, 0.0, 1.0] } },
    ...             { name = "far", motion = { model = "static", position_m = [3.0, 0.0, 1.0] } },
    ...         ]
    ...         tags = [{ id = 10, body = "near" }, { id = 20, body = "far" }]
    ...         '''
    ...     )
    ... )
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
        """Give the port back."""
        self._transport.close()

    @property
    def name(self) -> str:
        """The port's name."""
        return self._transport.name

    @property
    def id(self) -> int:
        """The board's id; the board is asked once."""
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
        """Yield messages and lines of text that are no replies, until none came for `timeout_s`."""
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
        """Wait, and keep reports that arrive; with 0 seconds, read what has arrived."""
        until_s = self._transport.now_s() + seconds
        while True:
            data = self._transport.read(max(until_s - self._transport.now_s(), 0.0))
            events, _ = self._connection.receive(data, self._transport.now_s())
            self._keep(events, None)
            if self._transport.now_s() >= until_s or (until_report and self._reports):
                return
