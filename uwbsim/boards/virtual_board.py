"""Virtual boards: command bytes in, report bytes out, with the tasks and the USB interface of the firmware.

All boards of a scenario share one medium and one SimPy clock in integer nanoseconds, which tests advance step by step
and `uwbsim.boards.server` with the wall clock. Formats, order and timing are those of the firmware wire format,
sections 1.3 to 1.6 and 3; processing times are fitted to the captured transcripts.

`VirtualPorts` are the boards as ports of the driver, in virtual time: without wall clock and pseudo-terminal,
deterministic. They are for tests of programs that use `uwblink.Board` or the ports of a recorder:

```python
ports = uwbsim.VirtualPorts(scenario)
print(uwblink.Board(ports.port(10)).range(20).range_m)
uwblink.record(ports.names.values(), "flight.uwb", uwblink.RangingPlan(), duration_s=60.0, using=ports)
```

The minute of the recording takes only the time of its computation.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import simpy

from uwblink.errors import PortLostError, PortMissingError
from uwblink.recording.schema import LARGEST_BOARD_ID, is_id
from uwblink.wire.codec import encode
from uwblink.wire.messages import Message
from uwbsim.boards.commands import ANSWER, EXECUTORS, Command, read_commands
from uwbsim.boards.frames import NS_PER_MS, NS_PER_US, Attempt, BoardAir, BoardRadio, Received, Steps
from uwbsim.boards.ranging import received_by
from uwbsim.errors import ParameterError, ScenarioError
from uwbsim.random_streams import stream
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import NO_BROADCASTS, Scenario
from uwbsim.world.clocks import NS_PER_S

PACKET_BYTES: Final = 64
"""Length of a packet of full-speed USB."""

PACKET_GAP: Final = 55 * NS_PER_US
"""Time of a packet on the bus, fitted to transcripts."""

FULL: Final = b"USB Buffer full! Message rejected to prevent overflow."


class UsbLink:
    """The USB interface of one board from power-up to power-off.

    `packets` wait to be read, and `arrived` is triggered when one comes. Transfers are lost while the bus is busy.
    Where it is not `open`, the board is unplugged, and transfers under way are lost.
    """

    def __init__(self, env: simpy.Environment, send: Callable[[bytes], None]) -> None:
        """`send` is called with the bytes of each transfer at its time."""
        self._env, self._send = env, send
        self.packets: list[bytes] = []
        self._busy_until = 0
        self.open = True
        self.arrived = env.event()

    def write(self, data: bytes) -> None:
        """Receive one write of the host, in packets of 64 bytes."""
        for number, at in enumerate(range(0, len(data), PACKET_BYTES)):
            piece = data[at : at + PACKET_BYTES]
            # The firmware drops packets of one byte; "~" alone is one of them.
            if len(piece) > 1:
                self._after(100 * NS_PER_US + number * PACKET_GAP, partial(self._arrive, piece))

    def read(self) -> bytes:
        """Return the received bytes and clear the queue."""
        data = b"".join(self.packets)
        self.packets.clear()
        self.arrived = self._env.event()
        return data

    def send(self, data: bytes, delay: int = 0) -> None:
        """Send a transfer after a delay (ns)."""
        if delay:
            self._after(delay, partial(self._transfer, data))
        else:
            self._transfer(data)

    def _after(self, delay: int, work: Callable[[], None]) -> None:
        self._env.timeout(delay).callbacks.append(lambda _: work() if self.open else None)

    def _arrive(self, piece: bytes) -> None:
        if len(self.packets) >= 8:
            self._transfer(FULL)
            return
        self.packets.append(piece)
        if not self.arrived.triggered:
            self.arrived.succeed()

    def _transfer(self, data: bytes) -> None:
        now = int(self._env.now)
        if not self.open or now < self._busy_until:
            return
        self._busy_until = now + -(-len(data) // PACKET_BYTES) * PACKET_GAP
        self._send(data)


Sender = Callable[[int, int, bytes], None]
"""Called with time (ns), board and the bytes of one USB transfer."""


class Bench:
    """The boards of a scenario on one medium; `send` is called with their output."""

    def __init__(self, scenario: Scenario, send: Sender, lost_share: float = 0.0) -> None:
        """Power all boards at time zero; `lost_share` of all receptions fail in addition to weak ones.

        Raises `ScenarioError` for a scenario of broadcasts, and for ids that the firmware does not have.
        """
        if scenario.ranging.plan == "broadcast":
            raise ScenarioError(NO_BROADCASTS)
        if too_large := [tag.id for tag in scenario.tags if not is_id(tag.id, LARGEST_BOARD_ID)]:
            raise ScenarioError(
                f"tags: found id {too_large[0]}; boards have ids 0 to {LARGEST_BOARD_ID} by their firmware, and only "
                "flights (`uwbsim run`) take others"
            )
        self.env = simpy.Environment(initial_time=0)
        self.scenario = scenario
        self.send = send
        self.air = BoardAir(self.env, scenario, lost_share)
        self.crashed: Callable[[VirtualBoard, Exception], object] | None = None
        """Called when a board's own program raises, after which the board hangs. If None, the exception is raised."""
        self.boards = {tag.id: VirtualBoard(self, tag.id) for tag in scenario.tags}

    def advance(self, time_ns: int) -> None:
        """Advance time to `time_ns`."""
        if time_ns > self.env.now:
            # Stepping, because `run(until=...)` leaves its own event in the queue, where `next_ns` would find it.
            reached = self.env.timeout(time_ns - int(self.env.now))
            while not reached.processed:
                self.env.step()

    def next_ns(self) -> float:
        """Return the time of the next event, infinity without one."""
        return float(self.env.peek())

    def advance_until(self, happened: Callable[[], object], timeout_s: float) -> None:
        """Advance time until something happened, or to the timeout."""
        end_ns = int(self.env.now) + math.ceil(timeout_s * NS_PER_S)
        while not happened() and self.next_ns() <= end_ns:
            self.advance(int(self.next_ns()) + 1)
        if not happened():
            self.advance(end_ns)


class VirtualBoard:
    """One board. `write` takes bytes from the host; the bench's `send` is called with the board's output.

    C04 sets `passive` and C08 `delay_uus`; unplugging closes `usb`, and a hard fault clears `alive`.
    """

    def __init__(self, bench: Bench, board: int) -> None:
        """Power the board on."""
        self.bench, self.id = bench, board
        self.rng = stream(bench.scenario.run.seed, "board", board)
        self._phase = int(self.rng.integers(0, NS_PER_MS))
        self._power_on()

    def _power_on(self) -> None:
        env = self.bench.env
        self.alive = True
        self.passive = False
        self.delay_uus = 1500  # UWB microseconds, until C08 sets it
        self.ranging = False
        self._buffer = b""
        self._command: Command | None = None
        self._tries = 0  # as on the boards, kept if another command replaces one that is retried
        self._released: simpy.Event | None = None
        self.usb = UsbLink(env, lambda data: self.bench.send(int(env.now), self.id, data))
        self.radio = BoardRadio(self.bench.air, self.id, self._interrupted)
        self.radio.listen()
        self._processes = [env.process(self._guarded(self._usb_task()))]

    def power_cycle(self) -> None:
        """Switch the power off and on, which resets all settings."""
        self.power_off()
        self._power_on()

    def power_off(self) -> None:
        """Switch the power off: the board neither sends nor receives."""
        self.usb.open = False
        self.hang()

    def hang(self) -> None:
        """Put the board into the firmware's hard-fault loop, which only a power cycle ends."""
        self.alive = False
        self.radio.off()
        for process in self._processes:
            if process.is_alive and process is not self.bench.env.active_process:
                process.interrupt()

    def write(self, data: bytes) -> None:
        """Receive one write of the host."""
        self.usb.write(data)

    def send(self, what: bytes | Message, delay: int = 0) -> None:
        """Print something after a delay (ns)."""
        self.usb.send(what if isinstance(what, bytes) else encode(what), delay)

    def answer(self, reply: Message | bytes) -> Attempt:
        """Print a reply after its processing time; the command is done."""
        self.send(reply, ANSWER)
        yield self.bench.env.timeout(ANSWER)
        return True

    def sleep(self, delay: int) -> simpy.Event:
        """Return the event of a delay (ns)."""
        return self.bench.env.timeout(delay)

    def until_next_poll(self) -> simpy.Event:
        """Return the event of the next read of the USB buffer, one a millisecond (firmware wire format, 1.3)."""
        now = int(self.bench.env.now)
        return self.bench.env.timeout(NS_PER_MS - (now - self._phase) % NS_PER_MS)

    def release(self) -> None:
        """Return the processor from an interrupt to the task that reads the USB buffer."""
        released, self._released = self._released, None
        if released is not None:
            released.succeed()

    def _interrupted(self, received: Received | None) -> None:
        """Handle a frame that no task waits for; the USB task is blocked while the handling takes time."""
        steps = received_by(self, received)
        if steps is None:
            return
        self.radio.masked = True
        self._released = self.bench.env.event()
        task = self.bench.env.process(self._guarded(self._interrupt_task(steps)))
        self._processes = [*(p for p in self._processes if p.is_alive), task]

    def _interrupt_task(self, steps: Steps) -> Steps:
        yield from steps
        self.release()
        if not self.ranging:
            self.radio.masked = False
            self.radio.listen()

    def _guarded(self, steps: Steps) -> Steps:
        """Run a task until it ends, the board hangs, or its own program fails, after which the board hangs."""
        try:
            yield from steps
        except simpy.Interrupt:
            pass
        except Exception as error:
            if self.bench.crashed is None:
                raise
            self.hang()
            self.bench.crashed(self, error)

    def _usb_task(self) -> Steps:
        """Read the USB buffer every millisecond, and execute its commands."""
        while True:
            if not self.usb.packets and self._command is None:
                yield self.usb.arrived
            yield self.until_next_poll()
            while self._released is not None:
                yield self._released
            yield from self._read_usb()
            if not self.alive:
                return
            if self._command is not None:
                yield from self._try(self._command)

    def _read_usb(self) -> Steps:
        if not self.usb.packets:
            return
        self._buffer += self.usb.read()
        longest = 8000
        if len(self._buffer) > longest:
            self.send(FULL)
            self._buffer = self._buffer[:longest]
        reading = read_commands(self._buffer, EXECUTORS)
        self._buffer = reading.rest
        for number, line in enumerate(reading.error_lines):
            if number:
                yield self.sleep(NS_PER_MS)
            self.send(line, 118 * NS_PER_US)
        if not reading.alive:
            self.hang()
        elif reading.commands:
            # Only the last command is executed; it replaces one that is retried, and continues its count of tries.
            self._command = reading.commands[-1]

    def _try(self, command: Command) -> Steps:
        done = self._tries > 5
        if done:
            self.send(b"COMMANDED TASK FAILED AFTER 5 ATTEMPTS.\r\n", ANSWER)
        else:
            answer = EXECUTORS[command.kind.KEY](self, *command.values)
            done = yield from self.answer(answer) if isinstance(answer, Message | bytes) else answer
        self._command, self._tries = (None, 0) if done else (self._command, self._tries + 1)


class VirtualPorts:
    """The ports of a scenario's boards. Time passes only while a caller reads or waits.

    `names` by tag are the arguments of `open`; `lost_share` of all frames are lost in addition to weak ones.

    >>> import uwblink, uwbsim
    >>> near, far = ({"model": "static", "position_m": [x, 0.0, 1.0]} for x in (0.0, 3.0))
    >>> ports = uwbsim.VirtualPorts(
    ...     uwbsim.load(
    ...         {
    ...             "run": {"duration_s": 10.0},
    ...             "ranging": {"rate_hz": 50.0},
    ...             "bodies": [{"name": "near", "motion": near}, {"name": "far", "motion": far}],
    ...             "tags": [{"id": 10, "body": "near"}, {"id": 20, "body": "far"}],
    ...         }
    ...     )
    ... )
    >>> with uwblink.Board(ports.port(10)) as board:
    ...     report = board.range(20)
    >>> report.neighbour, abs(report.range_m - 3.0) < 0.2
    (20, True)
    """

    def __init__(self, scenario: Scenario | Source, lost_share: float = 0.0, *, epoch_ns: int = 0) -> None:
        """Power all boards at virtual time zero, which is `epoch_ns` in the host times of a recording.

        `scenario` is an argument or a result of `uwbsim.load`; of all frames `lost_share` (0 to 1) are lost in addition
        to weak ones. Raises `ScenarioError` and `ParameterError`.
        """
        if not 0 <= lost_share <= 1:
            raise ParameterError(f"found {lost_share}, expected a share from 0 to 1", parameter="lost_share")
        scenario = as_scenario(scenario)
        self.bench = Bench(scenario, self._arrived, lost_share)
        self._epoch_ns = epoch_ns
        self._ports: dict[int, VirtualPort] = {}
        self.names = {tag.id: f"virtual board {tag.id}" for tag in scenario.tags}
        self.transfers: deque[tuple[int, int, bytes]] = deque(maxlen=20_000)
        """The last 20,000 transfers of boards, some MB: time (ns), board, bytes of one USB transfer."""

    def port(self, tag: int) -> VirtualPort:
        """Return the port of a board; raises `PortMissingError` where the scenario has no such tag."""
        if tag not in self.names:
            raise PortMissingError(f"no virtual board {tag}; the tags are {', '.join(map(str, self.names))}")
        return self._ports.setdefault(tag, VirtualPort(self, tag))

    def open(self, name: str) -> VirtualPort:
        """Return the port with one of `names`, empty; raises `PortMissingError` for another or an unplugged one."""
        tag = next((tag for tag, known in self.names.items() if known == name), None)
        if tag is None or not self.bench.boards[tag].usb.open:
            raise PortMissingError(f"{name}: no such port; there are {', '.join(self.names.values())}")
        port = self.port(tag)
        port.waiting.clear()
        return port

    def wait(self, ports: Sequence[VirtualPort], timeout_s: float) -> Sequence[VirtualPort]:
        """Advance time until bytes wait at one of some ports, or to the timeout; return the ports to read from."""

        def ready() -> list[VirtualPort]:
            return [p for p in ports if p.waiting or not self.bench.boards[p.tag].usb.open]

        self.bench.advance_until(ready, timeout_s)
        return ready()

    def now_ns(self) -> int:
        """Return the virtual time in nanoseconds."""
        return int(self.bench.env.now)

    def now_s(self) -> float:
        """Return the virtual time in seconds."""
        return self.now_ns() / NS_PER_S

    def host_ns(self) -> int:
        """Return the host time that belongs to the virtual time."""
        return self._epoch_ns + self.now_ns()

    def moved(self, name: str, number: str | None) -> str | None:
        """Return the name of a port that is plugged in, None for another one."""
        return name if any(known == name and self.bench.boards[t].usb.open for t, known in self.names.items()) else None

    def _arrived(self, time_ns: int, tag: int, data: bytes) -> None:
        self.transfers.append((time_ns, tag, data))
        self.port(tag).waiting += data


class VirtualPort:
    """One board's port, a `uwblink.boards.ports.Transport`."""

    def __init__(self, ports: VirtualPorts, tag: int) -> None:
        """Create the port of a board."""
        self._ports, self.tag = ports, tag
        self.name = ports.names[tag]
        self.waiting = bytearray()

    def read(self, timeout_s: float) -> bytes:
        """Advance time until bytes arrive, or to the timeout; raises `PortLostError` at an unplugged board."""
        self._ports.bench.advance_until(lambda: self.waiting, timeout_s)
        if not self.waiting:
            self._check()
        data = bytes(self.waiting)
        self.waiting.clear()
        return data

    def write(self, data: bytes) -> None:
        """Send bytes to the board; raises `PortLostError` at an unplugged one."""
        self._check()
        self._ports.bench.boards[self.tag].write(data)

    def now_s(self) -> float:
        """Return the virtual time in seconds."""
        return self._ports.now_s()

    def close(self) -> None:
        """Discard bytes that were not read."""
        self.waiting.clear()

    def _check(self) -> None:
        if not self._ports.bench.boards[self.tag].usb.open:
            raise PortLostError(f"{self.name}: the port is gone (unplugged); plug the board in again")
