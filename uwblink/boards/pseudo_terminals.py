"""Pseudo-terminals that stand in for serial ports: opened raw, linked under stable names, plugged and unplugged.

The far end behaves like the boards' USB: what does not fit because nobody reads is lost, and while the port is
unplugged its name is gone.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from uwblink.errors import PortError

try:
    import pty
    import tty
except ImportError:  # pragma: no cover - Windows has no pseudo-terminals
    pty = None  # type: ignore[assignment]


class Terminal:
    """One pseudo-terminal. `name` is what a client opens: the link if there is one, else the device's path."""

    def __init__(self, link: Path | None = None) -> None:
        """Plug in; raises `PortError` where `link` cannot be made, or the system has no pseudo-terminals."""
        if pty is None:  # pragma: no cover - Windows
            raise PortError("this system has no pseudo-terminals; use Linux or macOS")
        self._link = link
        self._ends: tuple[int, int] | None = None
        self.lost_bytes = 0
        self.plug()

    @property
    def fileno(self) -> int | None:
        """The descriptor to wait on for the client's bytes, None while unplugged."""
        return self._ends[0] if self._ends else None

    @property
    def name(self) -> str:
        """What a client opens."""
        if self._link:
            return str(self._link)
        return os.ttyname(self._ends[1]) if self._ends else "(unplugged)"

    def plug(self) -> None:
        """Open the port, unless it is open."""
        if self._ends:
            return
        # The client's end stays open here too: otherwise a read fails whenever no client has it open.
        near, far = pty.openpty()
        tty.setraw(far)
        os.set_blocking(near, False)
        self._ends = near, far
        if self._link:
            _point(self._link, os.ttyname(far))

    def unplug(self) -> None:
        """Close the port, as pulling the cable does: clients get an error, the link is gone."""
        if not self._ends:
            return
        if self._link:
            with contextlib.suppress(OSError):
                self._link.unlink()
        for end in self._ends:
            os.close(end)
        self._ends = None

    def read(self) -> bytes:
        """Return what the client has written since, without waiting."""
        if not self._ends:
            return b""
        try:
            return os.read(self._ends[0], 65_536)
        except (BlockingIOError, OSError):
            return b""

    def write(self, data: bytes) -> None:
        """Send bytes in one piece; what does not fit is lost, and counted."""
        if not self._ends:
            self.lost_bytes += len(data)
            return
        try:
            sent = os.write(self._ends[0], data)
        except (BlockingIOError, OSError):
            sent = 0
        self.lost_bytes += len(data) - sent


def _point(link: Path, device: str) -> None:
    if link.is_symlink() and link.exists():
        raise PortError(f"{link}: is a port that somebody serves; choose another folder, or remove the link")
    try:
        link.parent.mkdir(parents=True, exist_ok=True)
        if link.is_symlink():  # left behind by a server that was killed
            link.unlink()
        link.symlink_to(device)
    except OSError as error:
        raise PortError(f"{link}: cannot be made a link to {device} ({error.strerror})") from error
