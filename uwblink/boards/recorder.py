"""The recorder: plays a ranging plan on boards and writes everything that was said, by either side.

One loop waits for bytes from all ports and for the next turn of the plan; exchanges take turns, because two at once
would collide on the air. A board that is unplugged leaves the others running and is taken back when it returns.
"""

from __future__ import annotations

import os
import selectors
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from uwblink.boards.board import PROTOCOL_FLAGS, Board
from uwblink.boards.connection import FENCE, QUIET_AFTER_CIR_S, CommandOutcome, Dialogue
from uwblink.boards.ports import SerialPort, boards_ports, serial_number
from uwblink.boards.ranging_plan import RangingPlan
from uwblink.boards.writer import Sink
from uwblink.errors import BoardError, PlanError, PortError, PortLostError
from uwblink.recording.file import Recording, check_output
from uwblink.recording.schema import Fault, Tag
from uwblink.wire.messages import (
    Cir,
    GetId,
    IdReport,
    Message,
    Overheard,
    RangeCommand,
    RangeReport,
    SetPassive,
    Skipped,
    TargetRangeReport,
    TextLine,
)

LONGEST_WAIT_S: Final = 0.05
REOPEN_S: Final = 0.2
SILENT_PAUSE_S: Final = 1.0
MOST_FAULT_TEXT: Final = 200


@dataclass(slots=True)
class PairState:
    """How a pair has done so far."""

    tried: int = 0
    good: int = 0
    range_m: float = float("nan")
    fpp_dbm: float = float("nan")
    recent_s: deque[float] = field(default_factory=lambda: deque(maxlen=1000))


@dataclass(slots=True)
class Progress:
    """What a recorder has done so far, for whoever watches. Times in seconds since the start."""

    time_s: float = 0.0
    pairs: dict[tuple[int, int], PairState] = field(default_factory=dict)
    faults: dict[str, int] = field(default_factory=dict)
    last_fault: str = ""
    boards: dict[int, str] = field(default_factory=dict)
    overheard: int = 0
    cirs: int = 0

    @property
    def exchanges(self) -> int:
        """Exchanges that succeeded."""
        return sum(p.good for p in self.pairs.values())

    @property
    def tried(self) -> int:
        """Exchanges that were begun and ended."""
        return sum(p.tried for p in self.pairs.values())


@dataclass(slots=True)
class _Station:
    """A board's port, plugged in or not, and the conversation there."""

    name: str
    board: int
    serial_number: str | None
    dialogue: Dialogue
    port: SerialPort | None = None
    todo: deque[Message] = field(default_factory=deque)
    retry_s: float = 0.0
    pause_until_s: float = 0.0

    @property
    def idle(self) -> bool:
        return self.port is not None and not self.dialogue.busy and not self.todo


def record(
    ports: list[str],
    output: str | os.PathLike[str],
    plan: RangingPlan,
    *,
    duration_s: float = float("inf"),
    passive: bool = False,
    force: bool = False,
    stop: Callable[[], bool] = lambda: False,
    watch: Callable[[Progress], None] | None = None,
) -> Progress:
    """Record from boards until `stop` says so or the time is over; returns what was done.

    `ports` are names or pyserial URLs, `watch` is called a few times a second. `KeyboardInterrupt` ends a recording
    like `stop`, with everything in the file. Raises the errors of `Board.open`, `PlanError` (a tag of the plan is
    absent, two boards have one id), and `RecordingError` (cannot be written, disk full); the file stays readable.
    """
    path = Path(output)
    check_output(path, force=force)
    found = identify(ports)
    turns = plan.turns(sorted(found))
    meta = {
        "source": "boards",
        "ports": {str(board): name for board, name in sorted(found.items())},
        "plan": {
            "pairs": [list(pair) for pair in turns],
            "rate_hz": plan.rate_hz,
            "protocol": plan.protocol,
            "target_reports": plan.target_reports,
            "get_cir": plan.get_cir,
            "passive": passive,
        },
    }
    with Recording.create(path, meta=meta, force=force, live=True) as recording:
        seats = {tag.tag: tag for tag in plan.tags}
        recording.append_tags(seats.get(b, Tag(b, f"tag{b}", (0.0, 0.0, 0.0))) for b in sorted(found))
        recorder = Recorder(found, Sink(recording), plan, turns, passive=passive)
        try:
            recorder.run(duration_s, stop, watch)
        finally:
            recorder.close()
    return recorder.progress


def identify(ports: list[str]) -> dict[int, str]:
    """Return which board is at each port; raises `PlanError` when two have one id."""
    found: dict[int, str] = {}
    for name in ports:
        with Board.open(name) as board:
            number = board.id
        if number in found:
            raise PlanError(f"{found[number]} and {name} both say they are board {number}; ids must differ")
        found[number] = name
    return found


class Recorder:
    """The loop of `record`."""

    def __init__(
        self,
        boards: dict[int, str],
        sink: Sink,
        plan: RangingPlan,
        turns: tuple[tuple[int, int], ...],
        *,
        passive: bool,
    ) -> None:
        """Open the ports of boards; raises `PortError`."""
        self._sink, self._plan, self._turns, self._passive = sink, plan, turns, passive
        self._selector = selectors.SelectSelector()
        self._start_s, self._epoch_ns = time.monotonic(), time.time_ns()
        self._turn, self._next_s = 0, self._start_s
        self._active: tuple[_Station, tuple[int, int]] | None = None
        self.progress = Progress(pairs={pair: PairState() for pair in turns})
        self._stations = {b: _Station(n, b, serial_number(n), Dialogue(n)) for b, n in boards.items()}
        try:
            for station in self._stations.values():
                self._connect(station)
                if passive:
                    station.todo.append(SetPassive(True))
        except PortError:
            self.close()
            raise

    def run(self, duration_s: float, stop: Callable[[], bool], watch: Callable[[Progress], None] | None) -> None:
        """Play the plan until it is time to stop, then let the last exchange end."""
        end_s = self._start_s + duration_s
        shown_s = self._start_s
        try:
            while (now_s := time.monotonic()) < end_s and not stop():
                self._step(end_s)
                if watch and now_s - shown_s > 0.25:
                    shown_s = now_s
                    self.progress.time_s = now_s - self._start_s
                    watch(self.progress)
        except KeyboardInterrupt:
            pass
        self._turns = ()
        while self._active:
            self._step(time.monotonic() + LONGEST_WAIT_S)
        self.progress.time_s = time.monotonic() - self._start_s

    def close(self) -> None:
        """Stop the boards' listening, close the ports, and have everything written; raises `RecordingError`."""
        for station in self._stations.values():
            if station.port is not None:
                if self._passive:
                    with suppress(BoardError, PortError):
                        Board(station.port).set_passive(False)
                station.port.close()
        self._selector.close()
        self._sink.close()

    def _step(self, end_s: float) -> None:
        """Wait for what comes first, and deal with it."""
        self._sink.check()
        self._begin()
        for key, _ in self._selector.select(self._wait_s(end_s)):
            self._hear(key.data)
        now_s = time.monotonic()
        for station in self._stations.values():
            if station.port is not None and station.port.fileno is None:
                self._hear(station)
            outcome = station.dialogue.expire(now_s) if station.port is not None else None
            if outcome:
                self._ended(station, outcome)
            if station.port is None and now_s >= station.retry_s:
                self._reconnect(station)

    def _wait_s(self, end_s: float) -> float:
        now_s = time.monotonic()
        ends = [now_s + LONGEST_WAIT_S, end_s]
        if self._active is None and self._turns:
            ends.append(self._next_s)
        ends += [s.dialogue.deadline_s() or now_s + LONGEST_WAIT_S for s in self._stations.values()]
        if any(s.port is not None and s.port.fileno is None for s in self._stations.values()):
            ends.append(now_s + 0.002)
        return max(min(ends) - now_s, 0.0)

    def _begin(self) -> None:
        """Ask whoever has something to be asked: set-up first, then the next turn of the plan."""
        now_s = time.monotonic()
        for station in self._stations.values():
            if station.port is not None and station.todo and not station.dialogue.busy:
                self._say(station, station.todo.popleft(), now_s)
        if self._active or not self._turns or now_s < self._next_s:
            return
        for _ in range(len(self._turns)):
            pair = self._turns[self._turn % len(self._turns)]
            self._turn += 1
            station = self._stations[pair[0]]
            can = station.idle and now_s >= station.pause_until_s and not station.dialogue.ready_s(now_s)
            if can and self._stations[pair[1]].port is not None:
                break
        else:
            self._next_s = now_s + 0.005
            return
        if station.dialogue.doubtful:
            self._turn -= 1
            self._say(station, FENCE, now_s)
            return
        period_s = 1 / self._plan.rate_hz if self._plan.rate_hz else 0.0
        # A turn that comes late does not make the next ones come in a burst.
        self._next_s = max(self._next_s + period_s, now_s)
        self._active = station, pair
        plan = self._plan
        command = RangeCommand(pair[1], plan.target_reports, PROTOCOL_FLAGS[plan.protocol], plan.get_cir)
        self._say(station, command, now_s)

    def _say(self, station: _Station, command: Message, now_s: float) -> None:
        data = station.dialogue.send(command, now_s)
        self._sink.put(frames=(self._host_ns(), station.name, "out", data))
        try:
            if station.port is not None:
                station.port.write(data)
        except PortLostError as error:
            self._lost(station, error)

    def _hear(self, station: _Station) -> None:
        if station.port is None:
            return
        try:
            data = station.port.read_ready()
        except PortLostError as error:
            self._lost(station, error)
            return
        if not data:
            return
        time_ns = self._host_ns()
        self._sink.put(frames=(time_ns, station.name, "in", data))
        events, outcome = station.dialogue.receive(data, time.monotonic())
        for event in events:
            _KEEP.get(type(event), _ignore)(self, station, time_ns, event)
        if outcome:
            self._ended(station, outcome)

    def _keep_range(self, station: _Station, time_ns: int, report: RangeReport) -> None:
        self._sink.put(exchanges=(time_ns, station.board, report))

    def _keep_overheard(self, station: _Station, time_ns: int, heard: Overheard) -> None:
        self.progress.overheard += 1
        self._sink.put(overheard=(time_ns, station.board, heard))

    def _keep_cir(self, station: _Station, time_ns: int, cir: Cir) -> None:
        self.progress.cirs += 1
        self._sink.put(cirs=(time_ns, station.board, cir))

    def _keep_skipped(self, station: _Station, _time_ns: int, skipped: Skipped) -> None:
        self._fault(station, "garbage", f"{len(skipped.data)} bytes: {skipped.data[:60]!r}")

    def _keep_text(self, station: _Station, _time_ns: int, line: TextLine) -> None:
        if not line.text.startswith(("WARNING", "COMMANDED TASK FAILED", "TWR FAIL")):
            self._fault(station, "text", line.text.strip())

    def _ended(self, station: _Station, outcome: CommandOutcome) -> None:
        now_s = time.monotonic()
        if outcome.error:
            kind = "time-out" if isinstance(outcome.error, TimeoutError) else "failed exchange"
            self._fault(station, kind, str(outcome.error))
            if kind == "time-out":
                station.pause_until_s = now_s + (SILENT_PAUSE_S if outcome.command is FENCE else 0.0)
        if isinstance(outcome.reply, IdReport) and outcome.reply.board != station.board:
            self._fault(station, "wrong board", f"board {outcome.reply.board} where {station.board} was")
            self._drop(station, now_s)
        if self._active and self._active[0] is station and isinstance(outcome.command, RangeCommand):
            pair = self._active[1]
            self._active = None
            state = self.progress.pairs[pair]
            state.tried += 1
            if isinstance(outcome.reply, RangeReport):
                state.good += 1
                state.range_m, state.fpp_dbm = outcome.reply.range_m, outcome.reply.fpp1_dbm
                state.recent_s.append(now_s - self._start_s)
            if self._plan.get_cir:
                self._next_s = max(self._next_s, now_s + QUIET_AFTER_CIR_S)

    def _lost(self, station: _Station, error: PortLostError) -> None:
        self._fault(station, "unplugged", str(error))
        self._drop(station, time.monotonic())
        if self._active and self._active[0] is station:
            self.progress.pairs[self._active[1]].tried += 1
            self._active = None

    def _drop(self, station: _Station, now_s: float) -> None:
        port, station.port = station.port, None
        if port is not None:
            if port.fileno is not None:
                self._selector.unregister(port.fileno)
            port.close()
        station.retry_s = now_s + REOPEN_S

    def _connect(self, station: _Station) -> None:
        station.port = SerialPort(station.name)
        station.dialogue = Dialogue(station.name)
        if station.port.fileno is not None:
            self._selector.register(station.port.fileno, selectors.EVENT_READ, station)
        self.progress.boards[station.board] = station.name

    def _reconnect(self, station: _Station) -> None:
        """Try to take a board back; its power was gone, so it must be told again what it was told before."""
        station.retry_s = time.monotonic() + REOPEN_S
        if "://" not in station.name and not os.path.exists(station.name):
            back = [
                p.device for p in boards_ports() if station.serial_number and p.serial_number == station.serial_number
            ]
            if not back:
                return
            station.name = back[0]
        try:
            self._connect(station)
        except PortError:
            return
        self._fault(station, "replugged", f"{station.name}: board {station.board} is back")
        station.todo.clear()
        station.todo.append(GetId())
        if self._passive:
            station.todo.append(SetPassive(True))

    def _fault(self, station: _Station, kind: str, detail: str) -> None:
        faults = self.progress.faults
        faults[kind] = faults.get(kind, 0) + 1
        self.progress.last_fault = f"{kind}: {detail}"[:MOST_FAULT_TEXT]
        self._sink.put(faults=Fault(self._host_ns(), str(station.board), kind, detail[:MOST_FAULT_TEXT]))

    def _host_ns(self) -> int:
        """Host time in nanoseconds since the Unix epoch, which no change of the wall clock moves."""
        return self._epoch_ns + round((time.monotonic() - self._start_s) * 1e9)


def _ignore(_recorder: Recorder, _station: _Station, _time_ns: int, _event: Any) -> None:
    """Replies that belong to no table are in the bytes."""


_KEEP: Final[dict[type, Callable[[Recorder, _Station, int, Any], None]]] = {
    RangeReport: Recorder._keep_range,
    TargetRangeReport: Recorder._keep_range,
    Overheard: Recorder._keep_overheard,
    Cir: Recorder._keep_cir,
    Skipped: Recorder._keep_skipped,
    TextLine: Recorder._keep_text,
}
"""What becomes of each kind of event."""
