"""Frames between virtual boards: payloads, transmission, reception and collisions.

Clocks, radios and firmware arithmetic are those of a batch simulation, for one frame at a time, whose time is not known
before a command arrives. The medium has the rules of the event loop of `uwbsim run`: of two frames that overlap at a
receiver the first is received if it is stronger by `capture_db`, and a board that waits for an answer takes the first
frame that arrives.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import simpy

from uwblink.wire.messages import Broadcast, RangeCommand
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.ranging import (
    FINAL_BYTES,
    POLL_BYTES,
    PREAMBLE_SYMBOL_S,
    RESPONSE_BYTES,
    after_marker_s,
    before_marker_s,
)
from uwbsim.simulation.timestamps import next_grid, reply_counter, scheduled_counter
from uwbsim.world.clocks import NS_PER_S, SUBTICKS, SUBTICKS_PER_SECOND
from uwbsim.world.impulse_response import PathsHeard
from uwbsim.world.reception import Frames, Medium
from uwbsim.world.world import SampledWorld, World


@dataclass(frozen=True, slots=True)
class ResponsePayload:
    """Signal 2 of a double-sided exchange."""


@dataclass(frozen=True, slots=True)
class FinalPayload:
    """The last signal of either board: stamps of its sender as printed, power and skew of the first signal received."""

    stamps: tuple[int, int, int]
    power_dbm: float
    skew_ppm: float


Payload = RangeCommand | ResponsePayload | FinalPayload | Broadcast
"""What a frame carries. Signal 1 has the command that its sender executes, a broadcast its bytes."""

FRAME_BYTES: Final = {RangeCommand: POLL_BYTES, ResponsePayload: RESPONSE_BYTES, FinalPayload: FINAL_BYTES}
"""Lengths of frames in bytes."""


@dataclass(slots=True, kw_only=True)
class Frame:
    """A frame on the air, or scheduled.

    `stamp` is the sender's transmit stamp (ticks, not wrapped), `departure` the true time (sub-ticks) of its marker,
    `start` and `end` the times between which it is on the air (ns). `receiver` is None for a broadcast. `received` is
    the reception at each board, whether or not its receiver is on. `excess_m` is the detour between the two boards of
    an exchange. A frame that is `cancelled` before its start is never sent.
    """

    sender: int
    receiver: int | None
    payload: Payload
    stamp: int
    departure: int
    excess_m: float
    start: int
    end: int
    received: dict[int, Received] = field(default_factory=dict)
    cancelled: bool = False


@dataclass(slots=True)
class Received:
    """A frame as one board receives it: its stamp (ticks, not wrapped), printed power and skew.

    `antenna_dbm` is the power at the antenna; `heard` is whether it is above the sensitivity and not lost.
    """

    frame: Frame
    stamp: int
    power_dbm: float
    skew_ppm: float
    antenna_dbm: float
    heard: bool


NS_PER_US: Final = 1_000
NS_PER_MS: Final = 1_000_000
Steps = Generator[simpy.Event, Any, None]
"""What a board does in time: yields the SimPy events that it waits for."""

Attempt = Generator[simpy.Event, Any, bool]
"""An execution of a command that takes time; returns whether the command is done."""

Wait = Generator[simpy.Event, Any, Received | None]


class BoardAir:
    """The medium: frames are announced when they are scheduled, and arrive at the radios when they end.

    `lost_share` of all receptions fail besides the weak ones.
    """

    def __init__(self, env: simpy.Environment, scenario: Scenario, lost_share: float = 0.0) -> None:
        """Create world, clocks and random stream from the scenario."""
        self.env, self.scenario, self.lost_share = env, scenario, lost_share
        self.world = World(scenario)
        self.medium = Medium(scenario, SampledWorld(self.world))
        self.place = {tag.id: k for k, tag in enumerate(scenario.tags)}
        self.radios: dict[int, BoardRadio] = {}
        self._rng = stream(scenario.run.seed, "boards")
        self._frames: list[Frame] = []
        self.before_marker = _ns(before_marker_s(scenario.radio.preamble_symbols))
        self._late_enough = _ns(scenario.radio.preamble_symbols / 2 * PREAMBLE_SYMBOL_S)

    def first_stamp(self, board: int) -> int:
        """Return the stamp of a frame that a board sends now: its marker leaves at the end of its preamble."""
        marker = (int(self.env.now) + self.before_marker) * SUBTICKS_PER_SECOND // NS_PER_S
        reading = int(self.medium.clocks.read(np.array([self.place[board]]), np.array([marker]))[0])
        return next_grid(-(-reading // SUBTICKS)) + self._tx_register(board)

    def reply_stamp(self, board: int, received: int) -> int:
        """Return the transmit stamp of an immediate reply to a frame received at a stamp, with a random latency."""
        counter = reply_counter(received, self.scenario.ranging.reply.draw_s(self._rng, 1))
        return int(counter[0]) + self._tx_register(board)

    def scheduled_stamps(self, board: int, reference: int, delay_uus: int) -> tuple[int, int]:
        """Return the transmit stamps of a frame scheduled a delay after the stamp `reference`.

        The chip's stamp, and the one that the firmware computes and sends, with a constant of its build.
        """
        due = scheduled_counter(reference, delay_uus)
        return due + self._tx_register(board), due + int(self.medium.reply_constant[self.place[board]])

    def _tx_register(self, board: int) -> int:
        return int(self.medium.tx_register[self.place[board]])

    def excess_m(self) -> float:
        """Draw the detour of an exchange's signals."""
        share, mean_m = self.scenario.radio.independent_multipath
        return float(self._rng.exponential(mean_m)) if share and self._rng.random() < share else 0.0

    def paths(self, received: Received, board: int) -> PathsHeard:
        """Return the paths of a frame to a board, as `World.paths` does."""
        frame = received.frame
        sender, receiver = np.array([[self.place[frame.sender]], [self.place[board]]])
        detour = np.array([frame.excess_m if frame.receiver == board else 0.0])
        (found,) = self.world.paths(sender, receiver, np.array([frame.departure]), detour)
        return found

    def send(self, sender: int, receiver: int | None, payload: Payload, stamp: int, excess_m: float = 0.0) -> Frame:
        """Schedule a frame with a transmit stamp of its sender's clock; return it with its reception at all boards."""
        rng, place, count = self._rng, self.place[sender], len(self.place)
        departure = int(self.medium.leave(np.array([place]), np.array([stamp]), rng.normal(size=1))[0])
        excess = np.array([excess_m if board == receiver else 0.0 for board in self.place])
        frames = Frames(sender=np.full(count, place), receiver=np.arange(count), departure=np.full(count, departure))
        noise = rng.normal(size=(4, count))
        arrives = rng.random(count) >= self.lost_share
        stamp_of, link = self.medium.receive(frames, noise[1], excess)
        readings = self.medium.readings(frames, link.power_dbm, noise[2], noise[3])
        heard = self.medium.heard(link.power_dbm, noise[0]) & arrives
        marker = departure * NS_PER_S // SUBTICKS_PER_SECOND
        length = 8 + len(payload.data) if isinstance(payload, Broadcast) else FRAME_BYTES[type(payload)]
        frame = Frame(
            sender=sender,
            receiver=receiver,
            payload=payload,
            stamp=stamp,
            departure=departure,
            excess_m=excess_m,
            start=marker - self.before_marker,
            end=marker + _ns(after_marker_s(length)),
        )
        columns = (column.tolist() for column in (stamp_of, *readings, link.power_dbm, heard))
        rows = zip(self.place, *columns, strict=True)
        frame.received = {board: Received(frame, *values) for board, *values in rows}
        # A frame that ended 20 ms ago collides with no frame and is waited for by no board.
        oldest = int(self.env.now) - 20 * NS_PER_MS
        self._frames = [f for f in self._frames if f.end > oldest and not f.cancelled]
        self._frames.append(frame)
        self.over(frame).callbacks.append(lambda _: self._arrive(frame))
        return frame

    def over(self, frame: Frame) -> simpy.Event:
        """Return the event of a frame's end."""
        return self.env.timeout(max(frame.end - int(self.env.now), 0))

    def arriving(self, board: int, since: int) -> int | None:
        """Return the end of the frame that a board, whose receiver is on since `since`, receives now; else None."""
        now = int(self.env.now)
        ends = [f.end for f in self._frames if f.start <= now < f.end and self._is_detected(f, board, since)]
        return min(ends, default=None)

    def _is_detected(self, frame: Frame, board: int, since: int | None) -> bool:
        """Return whether a board whose receiver is on since `since` receives a frame, damaged or not."""
        in_time = since is not None and since <= frame.start + self._late_enough
        return in_time and not frame.cancelled and board != frame.sender and frame.received[board].heard

    def _arrive(self, frame: Frame) -> None:
        for board, radio in self.radios.items():
            if self._is_detected(frame, board, radio.since):
                radio.take(None if self._collides(frame, board) else frame.received[board])

    def _collides(self, frame: Frame, board: int) -> bool:
        """Return whether a frame collides with another one at a board."""
        loses, signal = self.scenario.radio.loses, frame.received[board].antenna_dbm
        others = [other for other in self._frames if other is not frame and not other.cancelled]
        return any(
            other.end > frame.start
            and other.start < frame.end
            and loses(signal, frame.start, other.received[board].antenna_dbm, other.start)
            for other in others
        )


class BoardRadio:
    """The radio of a board. `since` is the time (ns) at which its receiver was switched on, None while it is off."""

    def __init__(self, air: BoardAir, board: int, interrupt: Callable[[Received | None], None]) -> None:
        """`interrupt` is called with frames that no task waits for, None for a damaged one."""
        self._air, self._board, self._interrupt = air, board, interrupt
        self.since: int | None = None
        self.masked = False
        self._pending: Frame | None = None
        self._waiting: simpy.Event | None = None
        air.radios[board] = self

    @property
    def sending(self) -> bool:
        """Whether a frame is being sent or scheduled."""
        return self._pending is not None and self._pending.end > self._air.env.now and not self._pending.cancelled

    def listen(self) -> int:
        """Switch the receiver on, at once or at the end of the frame that is being sent; return that time (ns)."""
        self.since = self._pending.end if self._pending is not None and self.sending else int(self._air.env.now)
        return self.since

    def off(self) -> None:
        """Switch receiver and transmitter off; a scheduled frame is never sent."""
        self.since = None
        if self._pending is not None and self._pending.end > self._air.env.now:
            self._pending.cancelled = True
        self._pending = None

    def send(self, receiver: int | None, payload: Payload, stamp: int, excess_m: float = 0.0) -> Frame:
        """Send a frame at a transmit stamp of the board's clock; the receiver is on again afterwards."""
        self._pending = self._air.send(self._board, receiver, payload, stamp, excess_m)
        self.listen()
        return self._pending

    def wait(self, timeout: int | None) -> Wait:
        """Wait for a frame and return it; None if it is damaged, or if no preamble is detected within the timeout.

        Without a timeout the wait has no end.
        """
        env = self._air.env
        since = self.listen() if self.since is None else self.since
        arrived = self._waiting = env.event()
        if timeout is None:
            yield arrived
        else:
            yield arrived | env.timeout(since + timeout - int(env.now))
            while not arrived.triggered and (end := self._air.arriving(self._board, since)) is not None:
                yield arrived | env.timeout(end + 1 - int(env.now))
        self._waiting, self.since = None, None
        received: Received | None = arrived.value if arrived.triggered else None
        return received

    def take(self, received: Received | None) -> None:
        """Pass a received frame, None if damaged, to the waiting task, or else to the interrupt."""
        waiting, self._waiting = self._waiting, None
        self.since = None
        if waiting is not None:
            waiting.succeed(received)
        elif not self.masked:
            self._interrupt(received)


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)
