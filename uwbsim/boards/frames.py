"""Frames between virtual boards: payloads, transmission, reception and collisions.

Clocks, radios and firmware arithmetic are those of a batch simulation, for one frame at a time, whose time is not known
before a command arrives. The medium has the rules of the event loop of `uwbsim run`: of two frames that overlap at a
receiver the first is received if it is stronger by `capture_db`, and a board that waits for an answer takes the first
frame that arrives.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import simpy

from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import ANTENNA_DELAY_TICKS, DELAYED_TX_GRID, TICK_S, UUS_TICKS
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.ranging import (
    FINAL_BYTES,
    POLL_BYTES,
    PREAMBLE_SYMBOL_S,
    PREAMBLE_TIMEOUT_S,
    RESPONSE_BYTES,
    after_marker_s,
    before_marker_s,
)
from uwbsim.simulation.timestamps import draw_reply_s, next_grid
from uwbsim.world.clocks import NS_PER_S, SUBTICKS, SUBTICKS_PER_SECOND
from uwbsim.world.impulse_response import PathsHeard
from uwbsim.world.reception import Frames, Medium
from uwbsim.world.world import SampledWorld, World


@dataclass(frozen=True, slots=True)
class PollPayload:
    """Signal 1: the kind of exchange and the reports that the initiator requests."""

    target_reports: bool
    double_sided: bool
    get_cir: bool
    length = POLL_BYTES


@dataclass(frozen=True, slots=True)
class ResponsePayload:
    """Signal 2 of a double-sided exchange."""

    length = RESPONSE_BYTES


@dataclass(frozen=True, slots=True)
class FinalPayload:
    """The last signal of either board: stamps of its sender as printed, power and skew of the first signal received."""

    stamps: tuple[int, int, int]
    power_dbm: float
    skew_ppm: float
    length = FINAL_BYTES


@dataclass(frozen=True, slots=True)
class DataPayload:
    """A broadcast."""

    data: bytes

    @property
    def length(self) -> int:
        """Return the length of the frame in bytes: 8 and its payload (firmware wire format, 2.1)."""
        return 8 + len(self.data)


Payload = PollPayload | ResponsePayload | FinalPayload | DataPayload


@dataclass(frozen=True, slots=True, kw_only=True)
class Receptions:
    """Reception of a frame at all boards, (tags,), whether or not their receivers are on.

    Power at the antenna, whether it is above the sensitivity and not lost, stamp (ticks, not wrapped), printed power
    and skew.
    """

    power_dbm: Floats
    heard: Bools
    stamp: Ints
    printed_dbm: Floats
    skew_ppm: Floats


@dataclass(slots=True, kw_only=True)
class Frame:
    """A frame on the air, or scheduled.

    `stamp` is the sender's transmit stamp (ticks, not wrapped), `departure` the true time (sub-ticks) of its marker,
    `start` and `end` the times between which it is on the air (ns). `receiver` is None for a broadcast. `excess_m` is
    the detour between the two boards of an exchange. A frame that is `cancelled` before its start is never sent.
    """

    sender: int
    receiver: int | None
    payload: Payload
    stamp: int
    departure: int
    receptions: Receptions
    excess_m: float
    start: int = 0
    end: int = 0
    cancelled: bool = False


@dataclass(frozen=True, slots=True)
class Received:
    """A frame as one board received it: its stamp (ticks, not wrapped), printed power and skew."""

    frame: Frame
    stamp: int
    power_dbm: float
    skew_ppm: float


class Radios:
    """The radios of a scenario's tags; `lost_share` of all receptions fail besides the weak ones."""

    def __init__(self, scenario: Scenario, lost_share: float = 0.0) -> None:
        """Create world, clocks and random stream from the scenario."""
        self.scenario = scenario
        self.world = World(scenario)
        self.medium = Medium(scenario, SampledWorld(self.world))
        self.lost_share = lost_share
        self.place = {tag.id: k for k, tag in enumerate(scenario.tags)}
        self._all = np.arange(len(scenario.tags))
        self._rng = stream(scenario.run.seed, "boards")

    def next_stamp(self, board: int, time: int) -> int:
        """Return the first transmit stamp that a board's clock allows at or after a true time (sub-ticks)."""
        reading = int(self.medium.clocks.read(self._one(board), np.array([time]))[0])
        return next_grid(-(-reading // SUBTICKS)) + self.tx_register(board)

    def reply_stamp(self, board: int, received: int) -> int:
        """Return the transmit stamp of an immediate reply to a frame received at a stamp, with a random latency."""
        latency = round(float(draw_reply_s(self.scenario, self._rng, 1)[0]) / TICK_S)
        return next_grid(received + latency - ANTENNA_DELAY_TICKS) + self.tx_register(board)

    def scheduled_stamps(self, board: int, reference: int, delay_uus: int) -> tuple[int, int]:
        """Return the transmit stamps of a frame scheduled a delay after the stamp `reference`.

        The chip's stamp, which ignores the low nine bits of the scheduled time; and the one that the firmware computes
        and sends, with a constant of its build.
        """
        due = (reference + delay_uus * UUS_TICKS) // DELAYED_TX_GRID * DELAYED_TX_GRID
        return due + self.tx_register(board), due + int(self.medium.reply_constant[self.place[board]])

    def tx_register(self, board: int) -> int:
        """Return the antenna delay programmed into a board's transmitter register, in ticks."""
        return int(self.medium.tx_register[self.place[board]])

    def excess_m(self) -> float:
        """Draw the detour of an exchange's signals."""
        share, mean_m = self.scenario.radio.independent_multipath
        return float(self._rng.exponential(mean_m)) if share and self._rng.random() < share else 0.0

    def frame(self, sender: int, receiver: int | None, payload: Payload, stamp: int, excess_m: float = 0.0) -> Frame:
        """Return a frame with a transmit stamp of its sender's clock, and its reception at all boards."""
        place = self.place[sender]
        departure = int(self.medium.leave(self._one(sender), np.array([stamp]), self._rng.normal(size=1))[0])
        excess = np.zeros(len(self._all))
        if receiver in self.place:
            excess[self.place[receiver]] = excess_m
        return Frame(
            sender=sender,
            receiver=receiver,
            payload=payload,
            stamp=stamp,
            departure=departure,
            receptions=self._receptions(place, departure, excess),
            excess_m=excess_m,
        )

    def received(self, frame: Frame, board: int) -> Received:
        """Return the reception of a frame at one board."""
        at, k = frame.receptions, self.place[board]
        return Received(frame, int(at.stamp[k]), float(at.printed_dbm[k]), float(at.skew_ppm[k]))

    def paths(self, frame: Frame, receiver: int) -> PathsHeard:
        """Return the paths of a frame to a board, as `World.paths` does."""
        detour = np.array([frame.excess_m if frame.receiver == receiver else 0.0])
        (found,) = self.world.paths(self._one(frame.sender), self._one(receiver), np.array([frame.departure]), detour)
        return found

    def _receptions(self, sender: int, departure: int, excess_m: Floats) -> Receptions:
        rng, count = self._rng, len(self._all)
        frames = Frames(sender=np.full(count, sender), receiver=self._all, departure=np.full(count, departure))
        noise = rng.normal(size=(4, count))
        arrives = rng.random(count) >= self.lost_share
        stamp, link = self.medium.receive(frames, noise[1], excess_m)
        power_dbm = link.power_dbm
        printed_dbm, skew_ppm = self.medium.readings(frames, power_dbm, noise[2], noise[3])
        heard = self.medium.heard(power_dbm, noise[0]) & arrives
        return Receptions(power_dbm=power_dbm, heard=heard, stamp=stamp, printed_dbm=printed_dbm, skew_ppm=skew_ppm)

    def _one(self, board: int) -> Ints:
        return np.array([self.place[board]])


NS_PER_US: Final = 1_000
NS_PER_MS: Final = 1_000_000
Wait = Generator[simpy.Event, Any, "Received | None"]


class BoardAir:
    """The medium. Frames are announced when they are scheduled, and arrive when they end."""

    def __init__(self, env: simpy.Environment, radios: Radios) -> None:
        """`radios` compute the reception of frames."""
        self.env, self.physics = env, radios
        self.radios: dict[int, Radio] = {}
        self._frames: list[Frame] = []
        radio = radios.scenario.radio
        self.before_marker = _ns(before_marker_s(radio.preamble_symbols))
        self.late_enough = _ns(radio.preamble_symbols / 2 * PREAMBLE_SYMBOL_S)
        self._capture_db, self._sensitivity_dbm = radio.capture_db, radio.sensitivity_dbm

    def announce(self, frame: Frame) -> None:
        """Schedule a frame at its departure."""
        marker = frame.departure * NS_PER_S // SUBTICKS_PER_SECOND
        frame.start = marker - self.before_marker
        frame.end = marker + _ns(after_marker_s(frame.payload.length))
        # A frame that ended 20 ms ago collides with no frame and is waited for by no board.
        oldest = int(self.env.now) - 20 * NS_PER_MS
        self._frames = [f for f in self._frames if f.end > oldest and not f.cancelled]
        self._frames.append(frame)
        over = self.env.timeout(max(frame.end - int(self.env.now), 0))
        over.callbacks.append(lambda _: self._arrive(frame))

    def arriving(self, board: int, since: int) -> int | None:
        """Return the end of the frame that a board, whose receiver is on since `since`, receives now; else None."""
        now, place = int(self.env.now), self.physics.place[board]
        ends = [
            f.end
            for f in self._frames
            if f.start <= now < f.end and f.receptions.heard[place] and self._in_time(f, since) and f.sender != board
        ]
        return min(ends, default=None)

    def _in_time(self, frame: Frame, since: int) -> bool:
        """Return whether a receiver that is on since `since` detects a frame's preamble."""
        return since <= frame.start + self.late_enough and not frame.cancelled

    def _arrive(self, frame: Frame) -> None:
        if frame.cancelled:
            return
        for board, radio in self.radios.items():
            since, place = radio.since, self.physics.place[board]
            if board == frame.sender or since is None or not self._in_time(frame, since):
                continue
            if frame.receptions.heard[place]:
                radio.take(None if self._collides(frame, place) else self.physics.received(frame, board))

    def _collides(self, frame: Frame, place: int) -> bool:
        """Return whether a frame collides with another one at the board with this index."""
        signal = float(frame.receptions.power_dbm[place])
        for other in self._frames:
            if other is frame or other.cancelled or other.end <= frame.start or other.start >= frame.end:
                continue
            power = float(other.receptions.power_dbm[place])
            if power < self._sensitivity_dbm:
                continue
            if signal < power + self._capture_db or frame.start > other.start:
                return True
        return False


class Radio:
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

    def listen(self) -> None:
        """Switch the receiver on, at once or at the end of the frame that is being sent."""
        now = int(self._air.env.now)
        self.since = self._pending.end if self._pending is not None and self.sending else now

    def off(self) -> None:
        """Switch receiver and transmitter off; a scheduled frame is never sent."""
        self.since = None
        if self._pending is not None and self._pending.end > self._air.env.now:
            self._pending.cancelled = True
        self._pending = None

    def send(self, receiver: int | None, payload: Payload, stamp: int, excess_m: float = 0.0) -> Frame:
        """Send a frame at a transmit stamp of the board's clock; the receiver is on again afterwards."""
        frame = self._air.physics.frame(self._board, receiver, payload, stamp, excess_m)
        self._air.announce(frame)
        self._pending = frame
        self.listen()
        return frame

    def first_stamp(self) -> int:
        """Return the stamp of a frame that is sent now: its marker leaves at the end of its preamble."""
        marker_ns = int(self._air.env.now) + self._air.before_marker
        return self._air.physics.next_stamp(self._board, marker_ns * SUBTICKS_PER_SECOND // NS_PER_S)

    def over(self, frame: Frame) -> simpy.Event:
        """Return the event of a frame's end."""
        return self._air.env.timeout(max(frame.end - int(self._air.env.now), 0))

    def wait(self, timeout: int | None = round(PREAMBLE_TIMEOUT_S * NS_PER_S)) -> Wait:
        """Wait for a frame and return it; None if it is damaged, or if no preamble is detected within the timeout.

        Without a timeout the wait has no end.
        """
        env = self._air.env
        if self.since is None:
            self.listen()
        since = int(env.now) if self.since is None else self.since
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
