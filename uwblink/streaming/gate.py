"""A proxy in front of a WebSocket server, which refuses connections of other web sites.

Any page in a browser may connect to a WebSocket on this computer and read what comes; the browser only tells the server
whose page it is (`Origin`) and by which name it found the server (`Host`). A site may point a name of its own at this
computer (DNS rebinding), so names are checked, too. Foxglove's server checks neither.
"""

from __future__ import annotations

import contextlib
import ipaddress
import secrets
import select
import socket
import socketserver
import sys
import threading
from http.client import HTTPException, parse_headers
from typing import Final
from urllib.parse import urlsplit

LOOPBACK: Final = "127.0.0.1"
"""The address of this computer, where no other one can connect."""

VIEWERS: Final = "foxglove.dev"
"""The domain of Foxglove's own pages (https://app.foxglove.dev)."""


def hidden_address() -> str:
    """Return a random loopback address, which web sites cannot guess, on systems with more than one."""
    address = str(ipaddress.IPv4Address(LOOPBACK) + 1 + secrets.randbelow(2**24 - 3))
    with contextlib.suppress(OSError), socket.create_server((address, 0)):
        return address
    return LOOPBACK


def is_viewer(host: str, origin: str | None, own: str) -> bool:
    """Whether a request with these headers may be a viewer's; `own` is the name under which the gate is served."""
    try:
        name, site = urlsplit(f"//{host}").hostname or "", urlsplit(origin or "")
        page = site.hostname or ""
    except ValueError:
        return False
    if not (_is_address(name) or name == own.lower() or name.endswith(".local") or (name and "." not in name)):
        return False
    if origin is None:  # of a program that is no browser
        return True
    if site.scheme not in ("http", "https"):  # a viewer on the desktop; a page without an origin sends "null"
        return bool(site.scheme)
    own_page = page in (name, "localhost", LOOPBACK, "::1")
    return own_page or (site.scheme == "https" and (page == VIEWERS or page.endswith(f".{VIEWERS}")))


def _is_address(name: str) -> bool:
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False


class Gate(socketserver.ThreadingTCPServer):
    """Serves at `host` and `port`, 0 for a free one, and passes viewers on to `inner`; raises `OSError`."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, host: str, port: int, inner: tuple[str, int]) -> None:
        """Begin to serve, in a thread."""
        self.address_family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        self.host, self.inner = host, inner
        super().__init__(place, _Request)  # type: ignore[arg-type]
        threading.Thread(target=self.serve_forever, name="uwblink gate", daemon=True).start()

    def close(self) -> None:
        """End; connections end with the server behind."""
        self.shutdown()
        self.server_close()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore lost connections."""
        if not isinstance(sys.exception(), OSError | HTTPException):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


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
    """Carry bytes both ways until either end hangs up."""
    to = {one: other, other: one}
    while True:
        for ready in select.select([one, other], [], [])[0]:
            data = ready.recv(65_536)
            if not data:
                return
            to[ready].sendall(data)
