"""Virtual boards: command bytes in, report bytes out, with the firmware's state machine and its quirks.

All boards of a scenario share one air and one SimPy clock in integer nanoseconds, which tests turn by hand and
`uwbsim.boards.server` along with the wall clock. Formats, order and timing are those of the firmware wire format,
sections 1.3 to 1.6 and 3; the times that depend on a processor are fitted to the captured transcripts.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Final

import simpy

from uwblink.wire.codec import encode
from uwblink.wire.messages import Cir, Message
from uwbsim.boards import command_parser as firmware
from uwbsim.boards.commands import ANSWER, EXECUTORS, Attempt
from uwbsim.boards.exchange import ExchangeResult, Radios, as_target
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.world.clocks import SUBTICKS_PER_SECOND
from uwbsim.world.impulse_response import Echo, impulse_response, in_transfers

US: Final = 1_000
MS: Final = 1_000_000
NS_PER_S: Final = 1_000_000_000

PACKET_BYTES: Final = 64
PACKET_GAP: Final = 55 * US
INBOUND: Final = 100 * US
POLL_PERIOD: Final = MS
LONGEST_QUEUE: Final = 8
LONGEST_BUFFER: Final = 8000

TO_POLL: Final = 330 * US
"""From that poll to the time stamp of the ranging poll: radio set-up and half a preamble."""

TO_REPORT: Final = 530 * US
"""From the last stamp of an exchange to the initiator's report: rest of the frame, read-out, printing."""

TARGET_LATER: Final = 330 * US
LISTENER_LATER: Final = 370 * US
LISTENER_AT_ONCE: Final = 60 * US
PREAMBLE_TIMEOUT: Final = 6_521 * US
LAST_RETRY: Final = 5
DEFAULT_DELAY_UUS: Final = 1500
SHORTEST_WORKING_DELAY_UUS: Final = 265
"""Below this many the delayed transmission would start in the past (firmware wire format, 3.6)."""
LONGEST_ACCEPTED_DELAY_UUS: Final = 32_767

FAILED: Final = b"COMMANDED TASK FAILED AFTER 5 ATTEMPTS.\r\n"
OWN_ID: Final = b"TWR FAIL: The target ID is the same as the initiator's ID.\r\n"
FULL: Final = b"USB Buffer full! Message rejected to prevent overflow."
WARNING_B: Final = b"WARNING 0xB: TWR message is firing an interrupt when it shouldn't be.\r\n"
WARNING_C: Final = b"WARNING 0xC: TWR message is firing an interrupt when it shouldn't be.\r\n"

WARNINGS: Final = {2: (WARNING_C,), 3: (WARNING_B, WARNING_C)}
"""What a bystander prints of the frames after the poll, by the number of messages."""

Steps = Generator[simpy.Event, Any, None]
Listener = Callable[[int, int, bytes], None]
"""Called with time (ns), board and the bytes of one USB transfer."""


class Bench:
    """The boards of a scenario, powered and in range of each other; `send` receives what they print."""

    def __init__(self, scenario: Scenario, send: Listener, lost_share: float = 0.0) -> None:
        """Power all boards at time zero."""
        self.env = simpy.Environment(initial_time=0)
        self.radios = Radios(scenario, lost_share)
        self.send = send
        self.boards = {tag.id: VirtualBoard(self, tag.id) for tag in scenario.tags}

    def advance(self, time_ns: int) -> None:
        """Let time pass until `time_ns`."""
        if time_ns > self.env.now:
            # Stepping, because `run(until=...)` leaves its own event in the queue, where `next_ns` would find it.
            reached = self.env.timeout(time_ns - int(self.env.now))
            while not reached.processed:
                self.env.step()

    def next_ns(self) -> float:
        """Return when something happens next, infinity when nothing is due."""
        return float(self.env.peek())

    def later(self, delay: int, board: VirtualBoard, data: bytes) -> None:
        """Have a board print something after a delay, unless it has lost its power by then."""
        life = board.life

        def emit(_: simpy.Event) -> None:
            if board.life == life and board.powered:
                self.send(int(self.env.now), board.id, data)

        self.env.timeout(delay).callbacks.append(emit)

    def subticks(self, delay: int = 0) -> int:
        """Return the true time `delay` nanoseconds from now, in sub-ticks."""
        return (int(self.env.now) + delay) * SUBTICKS_PER_SECOND // NS_PER_S


@dataclass(slots=True)
class _Task:
    """The command that the board is busy with; `tries` survives a change of command, as on the boards."""

    command: firmware.Command | None = None
    tries: int = 0


class VirtualBoard:
    """One board. `write` takes what the host sends; what the board prints goes to the bench's listener."""

    def __init__(self, bench: Bench, board: int) -> None:
        """Power the board on."""
        self.bench, self.id = bench, board
        self._chance = stream(bench.radios.scenario.run.seed, "board", board)
        self._phase = int(self._chance.integers(0, POLL_PERIOD))
        self.life = 0
        self._power_on()

    def _power_on(self) -> None:
        self.powered, self.alive = True, True
        self.passive = False
        self.delay_uus = DEFAULT_DELAY_UUS
        self.busy_until = 0
        self._buffer = b""
        self._packets: list[bytes] = []
        self._task = _Task()
        self._arrived = self.bench.env.event()
        self.bench.env.process(self._usb_task(self.life))

    def power_cycle(self) -> None:
        """Take the power away and give it back: everything that was set is forgotten."""
        self.power_off()
        self._power_on()

    def power_off(self) -> None:
        """Take the power away: the board neither prints nor hears."""
        self.life += 1
        self.powered = False

    def hang(self) -> None:
        """Send the board into the firmware's hard-fault loop, from which only a power cycle helps."""
        self.alive = False

    @property
    def on_air(self) -> bool:
        """Whether the radio listens for polls now."""
        return self.powered and self.alive and self.bench.env.now >= self.busy_until

    def write(self, data: bytes) -> None:
        """Take one write of the host, which USB carries in packets of 64 bytes."""
        pieces = [data[k : k + PACKET_BYTES] for k in range(0, len(data), PACKET_BYTES)]
        for number, piece in enumerate(pieces):
            # The firmware drops packets of one byte; "~" alone is one of them.
            if len(piece) > 1:
                self._arrive(INBOUND + number * PACKET_GAP, piece)

    def _arrive(self, delay: int, piece: bytes) -> None:
        life = self.life

        def receive(_: simpy.Event) -> None:
            if self.life != life or not self.alive:
                return
            if len(self._packets) >= LONGEST_QUEUE:
                self.say(FULL)
                return
            self._packets.append(piece)
            if not self._arrived.triggered:
                self._arrived.succeed()

        self.bench.env.timeout(delay).callbacks.append(receive)

    def say(self, data: bytes | Message, delay: int = 0) -> None:
        """Print something after a delay (ns)."""
        self.bench.later(delay, self, data if isinstance(data, bytes) else encode(data))

    def _until_next_poll(self) -> simpy.Event:
        now = int(self.bench.env.now)
        return self.bench.env.timeout(POLL_PERIOD - (now - self._phase) % POLL_PERIOD)

    def _usb_task(self, life: int) -> Steps:
        """The task that reads the USB buffer every millisecond and does what it says."""
        while True:
            if not self._packets and self._task.command is None:
                self._arrived = self.bench.env.event()
                yield self._arrived
            yield self._until_next_poll()
            if self.life != life or not self.alive:
                return
            yield from self._read_usb()
            if self.life != life or not self.alive:
                return
            if self._task.command is not None:
                yield from self._try()

    def _read_usb(self) -> Steps:
        if not self._packets:
            return
        self._buffer += b"".join(self._packets)
        self._packets.clear()
        if len(self._buffer) > LONGEST_BUFFER:
            self.say(FULL)
            self._buffer = self._buffer[:LONGEST_BUFFER]
        reading = firmware.read(self._buffer, EXECUTORS)
        self._buffer = reading.rest
        for number, complaint in enumerate(reading.complaints):
            if number:
                yield self.bench.env.timeout(MS)
            self.say(complaint, 118 * US)
        if not reading.alive:
            self.hang()
        if reading.commands:
            # Only the last one is executed, in place of whatever was being retried, and with its count of tries.
            self._task.command = reading.commands[-1]

    def _try(self) -> Steps:
        if self._task.tries > LAST_RETRY:
            self.say(FAILED, ANSWER)
            self._task = _Task()
            return
        command = self._task.command
        assert command is not None  # noqa: S101 - _usb_task calls only with a command
        life = self.life
        answer = EXECUTORS[command.kind.KEY](self, *command.values)
        done = yield from self.answer(answer) if isinstance(answer, Message | bytes) else answer
        if self.life != life:
            return
        if done:
            self._task = _Task()
        else:
            self._task.tries += 1

    def answer(self, reply: Message | bytes) -> Attempt:
        """Print a reply, which takes the time it takes; the command is done."""
        self.say(reply, ANSWER)
        yield self.bench.env.timeout(ANSWER)
        return True

    def send_to_all(self, message: Message) -> None:
        """Have every other board in range print a message that came by air."""
        for other in self._in_range(self._others(), self.bench.subticks()):
            other.say(message, 230 * US)

    def _in_range(self, others: list[VirtualBoard], time: int) -> list[VirtualBoard]:
        tags = set(self.bench.radios.hearers(self.id, [other.id for other in others], time))
        return [other for other in others if other.id in tags]

    def _others(self) -> list[VirtualBoard]:
        return [b for b in self.bench.boards.values() if b is not self and b.on_air]

    def range_with(self, target_id: int, target_reports: bool, double_sided: bool, get_cir: bool) -> Attempt:
        """Range with another board."""
        if target_id == self.id:
            return (yield from self.answer(OWN_ID))
        env, bench = self.bench.env, self.bench
        yield env.timeout(TO_POLL)
        start = bench.subticks()
        target = bench.boards.get(target_id)
        if target is None or not target.on_air:
            return (yield from self._give_up())
        met = bench.radios.exchange(
            self.id, target_id, start, double_sided=bool(double_sided), delay_uus=target.delay_uus
        )
        others = [b for b in self._others() if b is not target]
        if not met.heard[0]:
            return (yield from self._give_up())
        lasts = [(d - start) * NS_PER_S // SUBTICKS_PER_SECOND for d in met.departures]
        in_time = not double_sided or SHORTEST_WORKING_DELAY_UUS <= target.delay_uus <= LONGEST_ACCEPTED_DELAY_UUS
        fits = max(b - a for a, b in itertools.pairwise(lasts)) < PREAMBLE_TIMEOUT
        if not all(met.heard) or not in_time or not fits:
            sent = met.heard.index(False) + 1 if False in met.heard else len(lasts)
            sent = min(sent, len(lasts) if in_time else 2)
            target.busy_until = int(env.now) + lasts[sent - 1]
            for other in self._in_range(others, start):
                for delay, warning in list(zip(lasts[1:], WARNINGS[len(lasts)], strict=True))[: sent - 1]:
                    if not other.passive:
                        other.say(warning, delay + TO_POLL)
            yield env.timeout(lasts[min(sent, 2) - 1])
            return (yield from self._give_up())
        end = lasts[-1] + TO_REPORT
        target.busy_until = int(env.now) + end + (TARGET_LATER if target_reports else 0)
        self._bystanders(others, met, start, end, target_reports, get_cir)
        yield env.timeout(end)
        if target.powered and target_reports:
            later = target._print_cir(self.id, target_id, TARGET_LATER, met.report.rx1) if get_cir else TARGET_LATER
            target.busy_until = int(env.now) + later
            target.say(as_target(met.report, self.id), later)
        self.say(met.report)
        if get_cir:
            last = met.report.rx3 or met.report.rx2
            echoes = bench.radios.echoes(target_id, self.id, met.departures[-1])
            yield env.timeout(self._print_cir(self.id, target_id, ANSWER, last, echoes))
        return True

    def _give_up(self) -> Attempt:
        yield self.bench.env.timeout(PREAMBLE_TIMEOUT)
        return False

    def _bystanders(
        self, others: list[VirtualBoard], met: ExchangeResult, start: int, end: int, target_reports: bool, get_cir: bool
    ) -> None:
        """Have every other board in range print what it makes of the exchange; `end` is when R05 comes."""
        ends = [(d - start) * NS_PER_S // SUBTICKS_PER_SECOND + TO_POLL for d in met.departures[1:]]
        warnings = list(WARNINGS[len(met.departures)])
        if target_reports:
            ends, warnings = [*ends, end + TARGET_LATER], [*warnings, WARNING_C]
        in_range = self._in_range(others, start)
        for other in in_range:
            if not other.passive:
                for delay, warning in zip(ends, warnings, strict=True):
                    other.say(warning, delay)
        listeners = {other.id: other for other in in_range if other.passive}
        if not listeners:
            return
        heard = self.bench.radios.overhear(list(listeners), self.id, met, target_reports=target_reports)
        for tag, other in listeners.items():
            other.busy_until = int(self.bench.env.now) + end
            if tag in heard:
                delay = end + (LISTENER_LATER if target_reports else LISTENER_AT_ONCE)
                if get_cir:
                    delay = other._print_cir(self.id, met.report.neighbour, delay, None)
                other.say(heard[tag], delay)

    def _print_cir(
        self, initiator: int, target: int, delay: int, stamp: int | None, echoes: list[Echo] | None = None
    ) -> int:
        """Print a channel impulse response, a piece a millisecond; returns when it is over."""
        index, taps = impulse_response(self._chance, stamp, echoes)
        for piece in in_transfers(encode(Cir(initiator, target, index, taps))):
            self.say(piece, delay)
            delay += MS + int(self._chance.integers(0, 120 * US))
        return delay
