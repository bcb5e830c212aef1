"""Ways to send ranges on: JSON in UDP datagrams for PlotJuggler, and a WebSocket that Foxglove opens.

Addresses are "HOST:PORT", "[::1]:PORT", or a port of this computer alone.
"""

from __future__ import annotations

import json
import socket
from typing import Any

from uwblink.closing import Closing
from uwblink.errors import ArgumentError, PortError
from uwblink.exporters.mcap import RANGE, SCHEMAS, stamped
from uwblink.streaming.gate import LOOPBACK, Gate, hidden_address
from uwblink.streaming.sources import StreamedRange


def host_and_port(text: str, parameter: str) -> tuple[str, int]:
    """Return host and port; raises `ArgumentError` for what names none."""
    host, _, port = str(text).rpartition(":")
    if not port.isascii() or not port.isdecimal() or not 0 <= int(port) <= 65535:
        raise ArgumentError(f"found {text!r:.60}, expected HOST:PORT or a port from 0 to 65535", parameter=parameter)
    return host.strip("[]") or LOOPBACK, int(port)


class UdpSender(Closing):
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

    def close(self) -> None:
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


class FoxgloveServer(Closing):
    """Serves ranges to as many viewers as come. A context manager: leaving it ends the server.

    Viewers are programs, Foxglove's own pages, and pages of the computer that serves; other web sites are refused.

    Needs the extra `uwbcal[foxglove]`. Sending never waits for a viewer.
    """

    def __init__(self, address: str = "8765") -> None:
        """Serve at "HOST:PORT", or at a port of this computer alone; 0 takes a free one.

        Raises `ArgumentError`, and `PortError` where it cannot be served or the extra is not installed.
        """
        host, port = host_and_port(address, "foxglove")
        try:
            import foxglove
        except ImportError as error:
            raise PortError(
                "serving Foxglove needs foxglove-sdk; pip install 'uwbcal[foxglove]'", parameter="foxglove"
            ) from error
        # For a slow viewer the oldest of 1024 messages are dropped.
        self._context, behind = foxglove.Context(), hidden_address()
        try:
            self._server = foxglove.start_server(
                name="uwblink", host=behind, port=0, context=self._context, message_backlog_size=1024
            )
        except (RuntimeError, OSError, ValueError) as error:
            raise PortError(f"foxglove {address}: cannot be served ({str(error).splitlines()[0]})") from error
        try:
            self._gate = Gate(host, port, (behind, self._server.port))
        except OSError as error:
            self._server.stop()
            raise PortError(f"foxglove {address}: cannot be served there ({error.strerror or error})") from error
        layout = json.dumps(SCHEMAS[RANGE]).encode()
        self._schema = foxglove.Schema(name=RANGE, encoding="jsonschema", data=layout)
        self._channels: dict[tuple[int, int], foxglove.Channel] = {}
        self.url = f"ws://{f'[{host}]' if ':' in host else host}:{self._gate.server_address[1]}"

    def close(self) -> None:
        """End the server."""
        self._gate.close()
        self._server.stop()

    def send(self, found: StreamedRange) -> None:
        """Give a range to the viewers that want its topic, `/ranges/INITIATOR_TARGET`."""
        row = found.to_dict()
        data = json.dumps(stamped(row.pop("time_ns"), row)).encode()
        self._channel(found.initiator, found.target).log(data, log_time=max(found.time_ns, 0))

    def _channel(self, initiator: int, target: int) -> Any:
        if (initiator, target) not in self._channels:
            import foxglove

            self._channels[initiator, target] = foxglove.Channel(
                f"/ranges/{initiator}_{target}", message_encoding="json", schema=self._schema, context=self._context
            )
        return self._channels[initiator, target]
