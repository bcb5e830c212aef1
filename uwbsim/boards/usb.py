"""The USB of a virtual board: packets that come in, and transfers that go out one at a time.

The firmware sends with a call that gives up while the transfer before is still on the bus, and nobody looks: what is
printed too soon after something else is lost (firmware wire format, 1.1).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

import simpy

US: Final = 1_000
PACKET_BYTES: Final = 64
PACKET_GAP: Final = 55 * US
INBOUND: Final = 100 * US
LONGEST_QUEUE: Final = 8
FULL: Final = b"USB Buffer full! Message rejected to prevent overflow."


class UsbLink:
    """One board's USB from power-up to power-off. `arrived` is triggered when a packet comes; `lost` counts transfers
    that found the bus busy."""

    def __init__(self, env: simpy.Environment, send: Callable[[bytes], None]) -> None:
        """Be plugged in; `send` takes the bytes of a transfer at its time."""
        self._env, self._send = env, send
        self._packets: list[bytes] = []
        self._busy_until = 0
        self._open = True
        self.arrived = env.event()
        self.lost = 0

    @property
    def waiting(self) -> bool:
        """Whether packets wait to be read."""
        return bool(self._packets)

    def close(self) -> None:
        """Be unplugged: what is under way comes nowhere."""
        self._open = False

    def write(self, data: bytes) -> None:
        """Take one write of the host, which USB carries in packets of 64 bytes."""
        for number, at in enumerate(range(0, len(data), PACKET_BYTES)):
            piece = data[at : at + PACKET_BYTES]
            # The firmware drops packets of one byte; "~" alone is one of them.
            if len(piece) > 1:
                self._after(INBOUND + number * PACKET_GAP, partial(self._arrive, piece))

    def read(self) -> bytes:
        """Return what has come, which empties the queue."""
        data = b"".join(self._packets)
        self._packets.clear()
        self.arrived = self._env.event()
        return data

    def say(self, data: bytes, delay: int = 0) -> None:
        """Send a transfer after a delay (ns)."""
        if delay:
            self._after(delay, partial(self._transfer, data))
        else:
            self._transfer(data)

    def _after(self, delay: int, work: Callable[[], None]) -> None:
        self._env.timeout(delay).callbacks.append(lambda _: work() if self._open else None)

    def _arrive(self, piece: bytes) -> None:
        if len(self._packets) >= LONGEST_QUEUE:
            self._transfer(FULL)
            return
        self._packets.append(piece)
        if not self.arrived.triggered:
            self.arrived.succeed()

    def _transfer(self, data: bytes) -> None:
        now = int(self._env.now)
        if not self._open:
            return
        if now < self._busy_until:
            self.lost += 1
            return
        self._busy_until = now + -(-len(data) // PACKET_BYTES) * PACKET_GAP
        self._send(data)
