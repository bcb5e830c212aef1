"""Where streams are sent: "HOST:PORT", "[::1]:PORT", or a port of this computer alone."""

from __future__ import annotations

from typing import Final

from uwblink.errors import ArgumentError

LOOPBACK: Final = "127.0.0.1"


def host_and_port(text: str, parameter: str) -> tuple[str, int]:
    """Return host and port; raises `ArgumentError` for what names none."""
    host, _, port = str(text).rpartition(":")
    if not port.isascii() or not port.isdecimal() or not 0 <= int(port) <= 65535:
        raise ArgumentError(f"found {text!r:.60}, expected HOST:PORT or a port from 0 to 65535", parameter=parameter)
    return host.strip("[]") or LOOPBACK, int(port)
