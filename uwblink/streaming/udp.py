"""Ranges as JSON in UDP datagrams, as PlotJuggler's UDP server takes them: one datagram a range."""

from __future__ import annotations

import json
import socket
from types import TracebackType
from typing import Self

from uwblink.errors import ArgumentError, PortError
from uwblink.streaming.addresses import host_and_port
from uwblink.streaming.ranges import StreamedRange


class UdpSender:
    """Sends ranges to a host, whether anybody listens or not. A context manager: leaving it closes the socket.

    A datagram is `{"timestamp": seconds, "ranges": {"10_20": {...}}}`: a plotter has one series a pair and name.
    """

    def __init__(self, address: str) -> None:
        """Prepare to send to "HOST:PORT", or to a port of this computer; raises `ArgumentError` and `PortError`."""
        host, port = host_and_port(address, "udp")
        if not port:
            raise ArgumentError(f"found {address!r:.60}, expected a port from 1 to 65535", parameter="udp")
        try:
            family, kind, _, _, to = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket, self._to = socket.socket(family, kind), to
        except (OSError, UnicodeError) as error:
            raise PortError(f"udp {address}: no such host ({_reason(error)})") from error
        self._address = address

    def __enter__(self) -> Self:
        """Return the sender."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the socket."""
        self._socket.close()

    def send(self, found: StreamedRange) -> None:
        """Send a range; raises `PortError` where the network does not take it."""
        pair = f"{found.initiator}_{found.target}"
        row = {n: value for n, value in found.to_dict().items() if n not in ("time_ns", "initiator", "target")}
        data = json.dumps({"timestamp": found.time_ns * 1e-9, "ranges": {pair: row}}).encode()
        try:
            self._socket.sendto(data, self._to)
        except OSError as error:
            raise PortError(f"udp {self._address}: cannot be sent there ({_reason(error)})") from error


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)
