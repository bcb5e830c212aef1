"""The air between virtual boards, and the radio of each: who listens, what arrives, what collides.

The rules are those of the event loop of `uwbsim run`: of two frames that overlap at a receiver the first is received
where it is stronger by `capture_db`, and a board that waits for an answer takes the first frame that comes.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, Final

import simpy

from uwbsim.boards.frames import Frame, Payload, Radios, Received
from uwbsim.scenario.airtime import PREAMBLE_SYMBOL_S, after_marker_s, before_marker_s
from uwbsim.world.true_time import SUBTICKS_PER_SECOND

US: Final = 1_000
MS: Final = 1_000_000
NS_PER_S: Final = 1_000_000_000
PREAMBLE_TIMEOUT: Final = 6_521 * US
"""How long a board waits for a preamble (firmware wire format, 3.1)."""

KEPT: Final = 20 * MS
"""For how long a frame that is over may still matter to one that is not."""

Wait = Generator[simpy.Event, Any, "Received | None"]


class BoardAir:
    """The medium. Frames are announced when it is decided to send them, and arrive when they end."""

    def __init__(self, env: simpy.Environment, radios: Radios) -> None:
        """Begin with nothing on the air and no board."""
        self.env, self.physics = env, radios
        self.radios: dict[int, Radio] = {}
        self._frames: list[Frame] = []
        radio = radios.scenario.radio
        self.before_marker = _ns(before_marker_s(radio.preamble_symbols))
        self.late_enough = _ns(radio.preamble_symbols / 2 * PREAMBLE_SYMBOL_S)
        self._capture_db, self._sensitivity_dbm = radio.capture_db, radio.sensitivity_dbm

    def subticks(self, later: int = 0) -> int:
        """Return the true time `later` nanoseconds from now, in sub-ticks."""
        return (int(self.env.now) + later) * SUBTICKS_PER_SECOND // NS_PER_S

    def announce(self, frame: Frame) -> None:
        """Put a frame on the air at its time."""
        marker = frame.departure * NS_PER_S // SUBTICKS_PER_SECOND
        frame.start = marker - self.before_marker
        frame.end = marker + _ns(after_marker_s(frame.payload.length))
        oldest = int(self.env.now) - KEPT
        self._frames = [f for f in self._frames if f.end > oldest and not f.cancelled]
        self._frames.append(frame)
        over = self.env.timeout(max(frame.end - int(self.env.now), 0))
        over.callbacks.append(lambda _: self._arrive(frame))

    def arriving(self, board: int, since: int) -> int | None:
        """Return when the frame ends that a board which listens since `since` is receiving now, None without one."""
        now, place = int(self.env.now), self.physics.place[board]
        ends = [
            f.end
            for f in self._frames
            if f.start <= now < f.end and f.receptions.heard[place] and self._in_time(f, since) and f.sender != board
        ]
        return min(ends, default=None)

    def _in_time(self, frame: Frame, since: int) -> bool:
        """Whether a receiver that is on since `since` still finds enough of a frame's preamble."""
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
        """Whether another frame spoils one at the board with this place."""
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
    """The radio of a board. `since` is when (ns) its receiver was switched on, None while it is off."""

    def __init__(self, air: BoardAir, board: int, interrupt: Callable[[Received | None], None]) -> None:
        """Be off; `interrupt` gets what arrives while nobody waits for it, None for a damaged frame."""
        self._air, self._board, self._interrupt = air, board, interrupt
        self.since: int | None = None
        self.masked = False
        self._pending: Frame | None = None
        self._waiting: simpy.Event | None = None
        air.radios[board] = self

    @property
    def sending(self) -> bool:
        """Whether a frame is on its way out, or waits for its time."""
        return self._pending is not None and self._pending.end > self._air.env.now and not self._pending.cancelled

    def listen(self) -> None:
        """Switch the receiver on, at once or when what is being sent has left."""
        now = int(self._air.env.now)
        self.since = self._pending.end if self._pending is not None and self.sending else now

    def off(self) -> None:
        """Switch everything off; a frame that waits for its time is never sent."""
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
        """Return the stamp of a frame that is sent now: its marker leaves when its preamble is over."""
        return self._air.physics.next_stamp(self._board, self._air.subticks(self._air.before_marker))

    def over(self, frame: Frame) -> simpy.Event:
        """Return the event of a frame's end."""
        return self._air.env.timeout(max(frame.end - int(self._air.env.now), 0))

    def wait(self, timeout: int | None = PREAMBLE_TIMEOUT) -> Wait:
        """Wait for a frame; None when it comes damaged, or when no preamble comes in time (None: wait for ever)."""
        env = self._air.env
        if self.since is None:
            self.listen()
        since = int(env.now) if self.since is None else self.since
        came = self._waiting = env.event()
        if timeout is None:
            yield came
        else:
            yield came | env.timeout(since + timeout - int(env.now))
            while not came.triggered and (end := self._air.arriving(self._board, since)) is not None:
                yield came | env.timeout(end + 1 - int(env.now))
        self._waiting, self.since = None, None
        received: Received | None = came.value if came.triggered else None
        return received

    def take(self, received: Received | None) -> None:
        """Have received a frame, None if it was damaged: whoever waits gets it, otherwise it interrupts."""
        waiting, self._waiting = self._waiting, None
        self.since = None
        if waiting is not None:
            waiting.succeed(received)
        elif not self.masked:
            self._interrupt(received)


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)
