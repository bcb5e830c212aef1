"""A board's port as the recorder sees it: plugged in or not, what is to be said there, and what is coming in."""

from __future__ import annotations

from collections import deque
from typing import Final

from uwblink.boards.connection import FENCE, CommandOutcome, Connection
from uwblink.boards.ports import Ports, Transport, serial_number
from uwblink.errors import PortError
from uwblink.wire.codec import LONGEST_LINE, Event
from uwblink.wire.messages import GetId, Message, SetPassive, Skipped

REOPEN_S: Final = 0.2
SILENT_PAUSE_S: Final = 1.0
DAMAGE_ENDS_S: Final = 0.05
SHOWN_BYTES: Final = 60


class Station:
    """One board. `port` is None while it is unplugged."""

    def __init__(self, board: int, name: str, ports: Ports, *, passive: bool) -> None:
        """Open the port; raises `PortError`. A `passive` board is told to listen, again whenever it comes back."""
        self.board, self.name = board, name
        self.serial_number = serial_number(name)
        self.port: Transport | None = None
        self.connection = Connection(name)
        self._ports, self._passive = ports, passive
        self._todo: deque[Message] = deque()
        self._retry_s = self._pause_until_s = 0.0
        self._damage, self._damaged_s = b"", 0.0
        self._plug(name)

    def ready(self, now_s: float) -> bool:
        """Whether the board may be asked to range now."""
        waits = self._todo or self.connection.busy or self.connection.ready_s(now_s)
        return self.port is not None and not waits and now_s >= self._pause_until_s

    def next_command(self, now_s: float) -> Message | None:
        """Return what the board is to be told besides the plan's turns, None if nothing is due."""
        if self.port is None or self.connection.busy or not self._todo or self.connection.ready_s(now_s) > 0:
            return None
        return self._todo.popleft()

    def read(self) -> bytes:
        """Return the bytes that have come; raises `PortLostError`."""
        return self.port.read(0.0) if self.port is not None else b""

    def rest_after(self, outcome: CommandOutcome, now_s: float) -> None:
        """Leave a board alone for a while that did not even answer a fence."""
        if isinstance(outcome.error, TimeoutError) and outcome.command is FENCE:
            self._pause_until_s = now_s + SILENT_PAUSE_S

    def damage(self, events: list[Event], now_s: float) -> str | None:
        """Gather bytes that are no message; returns what to say of them when a damaged line is over.

        One damaged line is skipped in many pieces, because it comes in many, and because a message could start in it.
        """
        text = None
        for event in events:
            if isinstance(event, Skipped):
                self._damage, self._damaged_s = self._damage + event.data, now_s
            elif self._damage:
                text = self._end_of_damage()
        over = self._damage.endswith(b"\r\n") or len(self._damage) > LONGEST_LINE
        if self._damage and (over or now_s - self._damaged_s > DAMAGE_ENDS_S):
            text = self._end_of_damage()
        return text

    def _end_of_damage(self) -> str:
        data, self._damage = self._damage, b""
        return f"{len(data)} bytes: {data[:SHOWN_BYTES]!r}"

    def unplug(self, now_s: float) -> None:
        """Close the port of a board that is gone."""
        if self.port is not None:
            self._ports.close(self.port)
        self.port, self._retry_s = None, now_s + REOPEN_S

    def plug_again(self, now_s: float) -> bool:
        """Try to take the board back, under another name if its device has one now; True when it is back."""
        if self.port is not None or now_s < self._retry_s:
            return False
        self._retry_s = now_s + REOPEN_S
        name = self._ports.moved(self.name, self.serial_number)
        if name is None:
            return False
        try:
            self._plug(name)
        except PortError:
            return False
        return True

    def _plug(self, name: str) -> None:
        """Open the port; the board's power may have been gone, so it must be told again what it was told before."""
        self.port, self.name = self._ports.open(name), name
        self.connection = Connection(name)
        self._todo.clear()
        if self._retry_s:
            self._todo.append(GetId())
        if self._passive:
            self._todo.append(SetPassive(True))
