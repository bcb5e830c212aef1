"""The recorder: executes a ranging plan on boards and passes all traffic to its listeners.

One loop waits for bytes from all ports and for the next turn of the plan; exchanges take turns, because two at once
would collide on the air. If a board is unplugged, the others continue; it is used again after it returns.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Final

from uwblink.boards.board import FENCE, QUIET_AFTER_CIR_S, QUIET_TARGET_S, Board, CommandOutcome, Connection
from uwblink.boards.listeners import Heard, Listener, Pair, PairState, Progress, ReportCheck, Turn
from uwblink.boards.ports import Closing, Ports, Transport, serial_number
from uwblink.boards.ranging_plan import RangingPlan
from uwblink.errors import BoardError, PortError, PortLostError
from uwblink.recording.schema import Fault
from uwblink.wire.codec import LONGEST_LINE, Event
from uwblink.wire.messages import GetId, IdReport, Message, RangeCommand, RangeReport, SetPassive, Skipped, TextLine

LONGEST_WAIT_S: Final = 0.05
"""Longest time between two checks of the stop condition."""


class Station:
    """State of a board's port; `port` is None while it is unplugged."""

    def __init__(self, board: int, name: str, ports: Ports, *, passive: bool) -> None:
        """Open the port; raises `PortError`. A `passive` board gets the command to listen, also after it returns."""
        self.board, self.name = board, name
        self.serial_number = serial_number(name)
        self._ports, self._passive = ports, passive
        self.port: Transport | None = None
        self._todo: deque[Message] = deque()
        self._retry_s = self.pause_until_s = 0.0
        self._damage = b""
        self._plug(name)

    def next_command(self, now_s: float, ranging: RangeCommand | None = None) -> Message | None:
        """Return the command that is due, None if the board cannot take one now. A fence is first if a late answer is
        possible, then set-up commands, then exchanges.
        """
        idle = self.port is not None and not self.connection.busy and self.connection.ready_s(now_s) <= 0
        if not idle or now_s < self.pause_until_s:
            return None
        if self.connection.doubtful:
            return FENCE
        return self._todo.popleft() if self._todo else ranging

    def gather_damage(self, event: Event) -> str | None:
        """Gather bytes that are not messages; returns their description at the end of a damaged line.

        The decoder skips a damaged line in several pieces. The line ends with a message, a line end, or too many bytes.
        """
        skipped = isinstance(event, Skipped)
        self._damage += event.data if isinstance(event, Skipped) else b""
        if not self._damage or (skipped and not self._damage.endswith(b"\r\n") and len(self._damage) <= LONGEST_LINE):
            return None
        text, self._damage = f"{len(self._damage)} bytes: {self._damage[:60]!r}", b""
        return text

    def unplug(self, now_s: float) -> None:
        """Close the port of a board that is gone."""
        if self.port is not None:
            self.port.close()
        self.port, self._retry_s = None, now_s + 0.2

    def plug_again(self, now_s: float) -> bool:
        """Try to reopen the port, also under a new name of its device; returns whether it is open."""
        if self.port is not None or now_s < self._retry_s:
            return False
        self._retry_s = now_s + 0.2  # the system needs time to find a new device
        name = self._ports.moved(self.name, self.serial_number)
        with suppress(PortError):
            if name is not None:
                self._plug(name)
        return self.port is not None

    def _plug(self, name: str) -> None:
        """Open the port and repeat the set-up commands, because the board may have lost power."""
        self.port = self._ports.open(name)
        self.name, self.connection = name, Connection(name)
        again: list[Message] = [GetId()] if self._retry_s else []
        self._todo = deque([*again, SetPassive(True)] if self._passive else again)


class Recorder(Closing):
    """The loop of a recording: `boards` maps ids to ports, `turns` are the pairs in order."""

    def __init__(
        self,
        boards: dict[int, str],
        plan: RangingPlan,
        turns: Iterable[Pair],
        listeners: Iterable[Listener],
        *,
        passive: bool = False,
        ports: Ports,
    ) -> None:
        """Open the ports of boards; raises `PortError`."""
        self._ports = ports
        self._plan, self._turns, self._passive = plan, tuple(turns), passive
        self._start_s = self._ports.now_s()
        self._turn, self._next_s, self._quiet_until_s = 0, self._start_s, 0.0
        self._active: tuple[Station, Pair] | None = None
        self._check = ReportCheck()
        self.progress = Progress(start_ns=self._ports.host_ns(), pairs={pair: PairState() for pair in self._turns})
        self._listeners = [self.progress, *listeners]
        self._stations: dict[int, Station] = {}
        try:
            for board, name in boards.items():
                self._stations[board] = Station(board, name, self._ports, passive=passive)
        except PortError:
            self.close()
            raise

    def run(
        self,
        duration_s: float = float("inf"),
        stop: Callable[[], bool] = lambda: False,
        watch: Callable[[Progress], None] | None = None,
    ) -> None:
        """Execute the plan until it is time to stop, then wait for the end of the last exchange."""
        watched_s = self._start_s
        with suppress(KeyboardInterrupt):
            for now_s in self.steps(duration_s, stop):
                if watch and now_s - watched_s > 0.25:
                    watched_s = now_s
                    self.progress.time_s = now_s - self._start_s
                    watch(self.progress)
        self.finish()

    def steps(self, duration_s: float = float("inf"), stop: Callable[[], bool] = lambda: False) -> Iterator[float]:
        """Execute the plan until it is time to stop; yields the ports' time, in seconds, after each step."""
        end_s = self._start_s + duration_s
        while (now_s := self._ports.now_s()) < end_s and not stop():
            self._step(end_s)
            yield now_s

    def finish(self) -> None:
        """Wait for the end of the last exchange, and begin no other."""
        self._turns = ()
        while self._active:
            self._step(self._ports.now_s() + LONGEST_WAIT_S)
        self.progress.time_s = self._ports.now_s() - self._start_s

    def close(self) -> None:
        """Stop the boards' listening and close the ports."""
        for station in self._stations.values():
            if station.port is None:
                continue
            if self._passive:
                with suppress(BoardError, PortError):
                    Board(station.port, connection=station.connection).set_passive(False)
            with suppress(PortError):
                station.port.close()

    def _step(self, end_s: float) -> None:
        """Wait for the next event and handle it."""
        for listener in self._listeners:
            listener.check()
        self._begin()
        opened = [station.port for station in self._stations.values() if station.port is not None]
        ready = self._ports.wait(opened, self._wait_s(end_s))
        for station in self._stations.values():
            if station.plug_again(self._ports.now_s()):
                self._fault(station, "replugged", f"{station.name}: board {station.board} is back")
            if station.port is not None:
                self._receive(station, station.port, waiting=station.port in ready)

    def _wait_s(self, end_s: float) -> float:
        now_s = self._ports.now_s()
        ends = [now_s + LONGEST_WAIT_S, end_s]
        if self._active is None and self._turns:
            ends.append(max(self._next_s, self._quiet_until_s))
        ends += [s.connection.deadline_s() or now_s + LONGEST_WAIT_S for s in self._stations.values()]
        return max(min(ends) - now_s, 0.0)

    def _begin(self) -> None:
        """Send due commands: fences and set-up commands first, then the next turn of the plan."""
        now_s, plan = self._ports.now_s(), self._plan
        if now_s < self._quiet_until_s:
            return
        for station in self._stations.values():
            if command := station.next_command(now_s):
                self._send(station, command)
        if self._active or not self._turns or now_s < self._next_s:
            return
        for _ in self._turns:  # pairs with a busy or missing board are skipped
            pair = self._turns[self._turn % len(self._turns)]
            self._turn += 1
            station = self._stations[pair[0]]
            wanted = RangeCommand(pair[1], plan.target_reports, plan.protocol == "ds", plan.get_cir)
            if self._stations[pair[1]].port is not None and station.next_command(now_s, wanted):
                # After a late turn, missed turns are not made up.
                self._next_s = max(self._next_s + (1 / plan.rate_hz if plan.rate_hz else 0.0), now_s)
                self._active = station, pair
                self._send(station, wanted)
                return
        self._next_s = now_s + 0.005

    def _send(self, station: Station, command: Message) -> None:
        data = station.connection.send(command, self._ports.now_s())
        self._notify_of_bytes(station, "out", data)
        try:
            if station.port is not None:
                station.port.write(data)
        except PortLostError as error:
            self._report_lost(station, error)

    def _receive(self, station: Station, port: Transport, *, waiting: bool) -> None:
        """Read waiting bytes, and end the board's command if they complete it or it timed out."""
        try:
            data = port.read(0.0) if waiting else b""
        except PortLostError as error:
            self._report_lost(station, error)
            return
        time_ns = self._notify_of_bytes(station, "in", data) if data else self._ports.host_ns()
        events, outcome = station.connection.receive(data, self._ports.now_s())
        for event in events:
            self._notify(station, time_ns, event)
        if outcome:
            self._finish_command(station, outcome, time_ns)

    def _notify_of_bytes(self, station: Station, direction: str, data: bytes) -> int:
        time_ns = self._ports.host_ns()
        for listener in self._listeners:
            listener.on_bytes(time_ns, station.name, direction, data)
        return time_ns

    def _notify(self, station: Station, time_ns: int, event: Event) -> None:
        if damage := station.gather_damage(event):
            self._fault(station, "garbage", damage)
        if isinstance(event, Skipped):
            return
        # Lines of failed exchanges are expected; all others are faults.
        expected = ("WARNING", "COMMANDED TASK FAILED", "TWR FAIL")
        if isinstance(event, TextLine) and not event.text.startswith(expected):
            self._fault(station, "text", event.text.strip())
        if isinstance(event, RangeReport) and (differences := self._check.add(station.board, event)):
            self._fault(station, "reports differ", differences)
        heard = Heard(time_ns, station.board, event)
        for listener in self._listeners:
            listener.on_message(heard)

    def _finish_command(self, station: Station, outcome: CommandOutcome, time_ns: int) -> None:
        now_s = self._ports.now_s()
        if outcome.error:
            kind = "time-out" if isinstance(outcome.error, TimeoutError) else "failed exchange"
            ranged = outcome.command if isinstance(outcome.command, RangeCommand) else None
            self._fault(station, kind, str(outcome.error), ranged)
            if kind == "time-out" and outcome.command is FENCE:
                station.pause_until_s = now_s + 1.0
        if isinstance(outcome.reply, IdReport) and outcome.reply.board != station.board:
            self._fault(station, "wrong board", f"board {outcome.reply.board} where {station.board} was")
            station.unplug(now_s)
        if self._active and self._active[0] is station and isinstance(outcome.command, RangeCommand):
            if self._plan.get_cir:
                # The two boards of the exchange, and passive ones, print their impulse responses.
                both = self._plan.target_reports or self._passive
                self._quiet_until_s = now_s + (QUIET_TARGET_S if both else QUIET_AFTER_CIR_S)
            report = outcome.reply if isinstance(outcome.reply, RangeReport) else None
            self._end_turn(Turn(time_ns, self._active[1], report))

    def _end_turn(self, turn: Turn) -> None:
        self._active = None
        for listener in self._listeners:
            listener.on_turn(turn)

    def _report_lost(self, station: Station, error: PortLostError) -> None:
        self._fault(station, "unplugged", str(error))
        station.unplug(self._ports.now_s())
        if self._active and self._active[0] is station:
            self._end_turn(Turn(self._ports.host_ns(), self._active[1], None))

    def _fault(self, station: Station, kind: str, detail: str, failed: RangeCommand | None = None) -> None:
        ends = (station.board, failed.target) if failed else (None, None)
        fault = Fault(self._ports.host_ns(), str(station.board), kind, detail[:200], *ends)
        for listener in self._listeners:
            listener.on_fault(fault)
