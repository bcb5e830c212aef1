"""Send ranges on: JSON in UDP datagrams for PlotJuggler, and a WebSocket for Foxglove.

Addresses are "HOST:PORT", "[::1]:PORT", or a port of this computer alone.

Any page in a browser may connect to a WebSocket on this computer and read its messages; the browser only sends the name
of the page (`Origin`) and the name by which it found the server (`Host`). A site may let a name of its own point to
this computer (DNS rebinding), so names are checked, too. Foxglove's server checks neither, so a proxy (`Gate`) in front
of it refuses connections of other web sites.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import re
import secrets
import select
import socket
import socketserver
from functools import cache
from http.client import parse_headers
from typing import Any, Final
from urllib.parse import urlsplit

from uwblink.boards.live_page import BackgroundServer
from uwblink.boards.ports import Closing
from uwblink.errors import ArgumentError, PortError, raising
from uwblink.exporters.mcap import RANGE, SCHEMAS, stamped
from uwblink.streaming.sources import StreamedRange

LOOPBACK: Final = "127.0.0.1"
"""The address of this computer, where no other one can connect."""


def hidden_address() -> str:
    """Return a random loopback address, which web sites cannot guess, on systems with more than one."""
    address = str(ipaddress.IPv4Address(LOOPBACK) + 1 + secrets.randbelow(2**24 - 3))
    with contextlib.suppress(OSError), socket.create_server((address, 0)):
        return address
    return LOOPBACK


def is_viewer(host: str, origin: str | None, own: str) -> bool:
    """Return whether a request with these headers may be from a viewer; `own` is the name of this server."""
    try:
        name, site = urlsplit(f"//{host}").hostname or "", urlsplit(origin or "")
        page = site.hostname or ""
    except ValueError:
        return False
    # Addresses, names without a dot and in .local are of this network, so no site can let one of them point here.
    is_own = name == own.lower() or name.endswith(".local") or re.fullmatch(r"[0-9.]+|[^.]+|.*:.*", name) is not None
    is_page = site.scheme in ("http", "https")  # a viewer on the desktop has another scheme
    is_trusted = page in (name, "localhost", LOOPBACK, "::1") or (
        site.scheme == "https" and (page == "foxglove.dev" or page.endswith(".foxglove.dev"))
    )
    # Programs that are no browsers send no origin; pages without an origin send "null".
    return bool(name) and is_own and (origin is None or (is_trusted if is_page else bool(site.scheme)))


class Gate(BackgroundServer):
    """Serves at `host` and `port`, 0 for a free one, and passes viewers on to `inner`; raises `OSError`.

    Connections end with the server behind.
    """

    def __init__(self, host: str, port: int, inner: tuple[str, int]) -> None:
        """Begin to serve."""
        self.address_family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        self.host, self.inner = host, inner
        super().__init__(place, _Request)


class _Request(socketserver.StreamRequestHandler):
    rbufsize = 0  # what follows the request is for the server behind
    timeout = 10.0  # a connection without a request is closed then: each has a thread
    server: Gate

    def handle(self) -> None:
        line, head = self.rfile.readline(8192), parse_headers(self.rfile)
        if not is_viewer(head.get("Host", ""), head.get("Origin"), self.server.host):
            self.connection.sendall(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            return
        with socket.create_connection(self.server.inner) as inner:
            lines = (f"{name}: {value}\r\n".encode("latin-1") for name, value in head.items())
            inner.sendall(b"".join((line, *lines, b"\r\n")))
            self.connection.settimeout(None)
            _carry(self.connection, inner)


def _carry(one: socket.socket, other: socket.socket) -> None:
    """Forward bytes in both directions until one end closes."""
    to = {one: other, other: one}
    while True:
        for ready in select.select([one, other], [], [])[0]:
            data = ready.recv(65_536)
            if not data:
                return
            to[ready].sendall(data)


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
        with raising(PortError, f"udp {address}: no such host", OSError, UnicodeError):
            family, kind, _, _, to = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket, self._to = socket.socket(family, kind), to
        self._address = address

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def send(self, found: StreamedRange) -> None:
        """Send a range; raises `PortError` if the network refuses it."""
        pair = f"{found.initiator}_{found.target}"
        row = {n: value for n, value in found.to_dict().items() if n not in ("time_ns", "initiator", "target")}
        data = json.dumps({"timestamp": found.time_ns * 1e-9, "ranges": {pair: row}}).encode()
        with raising(PortError, f"udp {self._address}: cannot be sent there"):
            self._socket.sendto(data, self._to)


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
        with raising(PortError, "`foxglove`: needs foxglove-sdk; pip install 'uwbcal[foxglove]'", ImportError):
            import foxglove
        # For a slow viewer the oldest of 1024 messages are dropped.
        self._context, behind = foxglove.Context(), hidden_address()
        wrong = f"foxglove {address}: cannot be served there"
        with raising(PortError, wrong, RuntimeError, OSError, ValueError), contextlib.ExitStack() as failing:
            self._server = foxglove.start_server(
                name="uwblink", host=behind, port=0, context=self._context, message_backlog_size=1024
            )
            failing.callback(self._server.stop)
            self._gate = Gate(host, port, (behind, self._server.port))
            failing.pop_all()
        schema = foxglove.Schema(name=RANGE, encoding="jsonschema", data=json.dumps(SCHEMAS[RANGE]).encode())
        settings: dict[str, Any] = {"message_encoding": "json", "schema": schema, "context": self._context}
        self._channel = cache(lambda pair: foxglove.Channel(f"/ranges/{pair}", **settings))
        self.url = f"ws://{f'[{host}]' if ':' in host else host}:{self._gate.server_address[1]}"

    def close(self) -> None:
        """End the server."""
        self._gate.close()
        self._server.stop()

    def send(self, found: StreamedRange) -> None:
        """Send a range to the viewers of its topic, `/ranges/INITIATOR_TARGET`."""
        row = found.to_dict()
        data = json.dumps(stamped(row.pop("time_ns"), row)).encode()
        self._channel(f"{found.initiator}_{found.target}").log(data, log_time=max(found.time_ns, 0))
