"""Serial ports: their list, opening, reading and writing; and pseudo-terminals in their place.

A port is a device (`/dev/ttyACM0`), a link to one, or any pyserial URL (`socket://`, `rfc2217://`). This is the only
file that uses pyserial.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Final, Protocol, Self, TypeVar

import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from uwblink.errors import PortBusyError, PortError, PortLostError, PortMissingError, PortPermissionError, raising

try:
    import pty
    import tty
except ImportError:  # pragma: no cover - Windows has no pseudo-terminals
    pty = None  # type: ignore[assignment]


Key = TypeVar("Key")

POLL_S: Final = 0.002
"""Longest wait at a port without a descriptor before other ports are read; an exchange takes 4 ms."""


class Closing:
    """Base of classes with a method `close`: leaving a `with` block calls it."""

    __slots__ = ()

    def close(self) -> None:
        """Close; derived classes implement it."""

    def __enter__(self) -> Self:
        """Return the object itself."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Close."""
        self.close()


class Transport(Protocol):
    """Interface of a port for the driver; `uwbsim` has one with virtual time."""

    name: str

    def read(self, timeout_s: float) -> bytes:
        """Return received bytes as soon as any arrive; empty after the time-out."""

    def write(self, data: bytes) -> None:
        """Send bytes in one write."""

    def now_s(self) -> float:
        """Return a time that never goes back, in seconds."""

    def close(self) -> None:
        """Close the port."""


class Ports(Protocol):
    """Interface of all ports for a recorder; `uwbsim.VirtualPorts` has virtual time."""

    def open(self, name: str) -> Transport:
        """Open a port; raises one of the `PortError`s."""

    def wait(self, ports: Sequence[Any], timeout_s: float) -> Sequence[Transport]:
        """Return the open ports at which bytes may be waiting, none after the time-out."""

    def now_s(self) -> float:
        """Return the time of the ports in seconds, which never goes back."""

    def host_ns(self) -> int:
        """Return the same time as nanoseconds since the Unix epoch."""

    def moved(self, name: str, number: str | None) -> str | None:
        """Return the present name of a port by its USB serial number `number`, None while it is unplugged."""


def boards_ports() -> list[ListPortInfo]:
    """Return the serial devices with the boards' USB identity, without opening them."""
    # "STM32 Virtual ComPort" (firmware wire format, 1.1)
    return [port for port in sorted(list_ports.comports()) if (port.vid, port.pid) == (0x0483, 0x5740)]


def serial_number(device: str) -> str | None:
    """Return the USB serial number behind a device, None where it has none."""
    real = os.path.realpath(device)
    return next((p.serial_number for p in list_ports.comports() if p.device in (device, real)), None)


class SerialPort:
    """An open serial port, locked against a second process."""

    def __init__(self, name: str, baud_rate: int = 19_200) -> None:
        """Open a port; raises one of the `PortError`s, which state the remedy. Boards at USB ignore the rate."""
        self.name = name
        self._serial = _opened(name, baud_rate)
        try:
            self.fileno: int | None = self._serial.fileno()
        except (OSError, AttributeError, NotImplementedError):
            self.fileno = None  # rfc2217 has no descriptor to wait on
            self._serial.timeout = POLL_S

    def read(self, timeout_s: float) -> bytes:
        """Return received bytes as soon as there are any; raises `PortLostError`.

        Empty after the time-out, and after `POLL_S` if a port has no descriptor.
        """
        if self.fileno is not None and not select.select([self.fileno], [], [], max(timeout_s, 0.0))[0]:
            return b""
        with self._raising_loss():
            return bytes(self._serial.read(65_536))

    def write(self, data: bytes) -> None:
        """Send bytes in one write; raises `PortLostError`."""
        with self._raising_loss():
            self._serial.write(data)

    def now_s(self) -> float:
        """Return the monotonic clock in seconds."""
        return time.monotonic()

    def close(self) -> None:
        """Close the port, also if it is lost."""
        with contextlib.suppress(OSError, serial.SerialException, TypeError):
            self._serial.close()

    def _raising_loss(self) -> AbstractContextManager[None]:
        kinds = (OSError, serial.SerialException, TypeError)  # TypeError: another thread closed the port
        return raising(PortLostError, f"{self.name}: the port is gone", *kinds, remedy="; plug the board in again")


def _since_boot_ns() -> int:
    """Return the time of a clock that is never set and also runs while the computer is suspended, if the system has
    one.
    """
    boot = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic_ns() if boot is None else time.clock_gettime_ns(boot)


class SerialPorts:
    """The serial ports of this computer."""

    def __init__(self, baud_rate: int = 19_200) -> None:
        """Start the clock. Ports are opened at a rate."""
        self._baud_rate = baud_rate
        # Changes of the wall clock do not change the times of a recording.
        self._epoch_ns = time.time_ns() - _since_boot_ns()

    def open(self, name: str) -> SerialPort:
        """Open a port; raises one of the `PortError`s."""
        return SerialPort(name, self._baud_rate)

    def wait(self, ports: Sequence[Any], timeout_s: float) -> Sequence[SerialPort]:
        """Return ports at which bytes may be waiting; ports without a descriptor must be polled."""
        polled = [port for port in ports if port.fileno is None]
        watched = {port.fileno: port for port in ports if port.fileno is not None}
        timeout_s = min(timeout_s, POLL_S) if polled else timeout_s
        return [watched[fileno] for fileno in select.select(watched, [], [], max(timeout_s, 0.0))[0]] + polled

    def now_s(self) -> float:
        """Return the monotonic clock in seconds."""
        return time.monotonic()

    def host_ns(self) -> int:
        """Return host time in nanoseconds since the Unix epoch."""
        return self._epoch_ns + _since_boot_ns()

    def moved(self, name: str, number: str | None) -> str | None:
        """Return the present name of a port: the old name, or another one of the board with this USB serial number."""
        if "://" in name or os.path.exists(name):
            return name
        return next((p.device for p in boards_ports() if number and p.serial_number == number), None)


def _opened(name: str, baud_rate: int) -> Any:
    try:
        port = serial.serial_for_url(name, do_not_open=True, baudrate=baud_rate)
        port.timeout, port.write_timeout = 0, 1.0
        if "://" not in name:
            port.exclusive = True
        port.open()
    except ValueError as error:
        raise PortError(f"{name}: not a port ({error})") from error
    except (OSError, serial.SerialException) as error:
        raise _port_error(name, error) from error
    with contextlib.suppress(OSError, serial.SerialException, NotImplementedError):
        port.reset_input_buffer()
    return port


def _port_error(name: str, error: Exception) -> PortError:
    """Return the error of a port that cannot be opened."""
    code = errno.EISDIR if os.path.isdir(name) else getattr(error, "errno", None)
    if "configure port" in str(error):
        code = errno.ENOTTY
    try:
        group = Path(name).group()
    except (OSError, KeyError, NotImplementedError):
        group = "dialout"
    denied = f"permission denied; join the group {group} (sudo usermod -aG {group} $USER) and log in again"
    busy = "another process has this port open; close it first"
    reasons: dict[int | None, tuple[type[PortError], str]] = {
        errno.ENOENT: (PortMissingError, "no such port; `uwblink ports` lists the boards that are plugged in"),
        errno.EACCES: (PortPermissionError, denied),
        errno.EPERM: (PortPermissionError, denied),
        errno.EBUSY: (PortBusyError, busy),
        errno.EAGAIN: (PortBusyError, busy),
        errno.EISDIR: (PortError, f"is a folder; name the ports in it, as with {name.rstrip('/')}/*"),
        errno.ENOTTY: (PortError, "not a serial port"),
    }
    kind, reason = reasons.get(code, (PortError, f"cannot be opened ({error})"))
    return kind(f"{name.rstrip('/')}: {reason}")


def wait_until(due_s: float, stop: Callable[[], bool]) -> bool:
    """Wait until a time of the monotonic clock; returns False if `stop` returned true before."""
    while (wait_s := due_s - time.monotonic()) > 0:
        if stop():
            return False
        time.sleep(min(wait_s, 0.1))
    return not stop()


class Terminal:
    """A pseudo-terminal that replaces a serial port: it is opened raw, has a link with a stable name, and can be
    unplugged.

    The far end behaves like the boards' USB: bytes are lost if no client reads and the buffer is full, and an unplugged
    port has no name. `name` is the path that a client opens: the link if there is one, else the device.
    """

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
        """The name that a client opens."""
        if self._link:
            return str(self._link)
        return os.ttyname(self._ends[1]) if self._ends else "(unplugged)"

    def plug(self) -> None:
        """Open the port, which must not be open."""
        if self._link:
            _free(self._link)
        # The client's end is also kept open here: otherwise reads fail if no client has it open.
        near, far = pty.openpty()
        tty.setraw(far)
        os.set_blocking(near, False)
        self._ends = near, far
        if self._link:
            _point(self._link, os.ttyname(far))

    def unplug(self) -> None:
        """Close the port, like a pulled cable: clients get an error, and the link is removed."""
        if not self._ends:
            return
        if self._link:
            with contextlib.suppress(OSError):
                if os.readlink(self._link) == os.ttyname(self._ends[1]):  # else it is the link of a later server
                    self._link.unlink()
        for end in self._ends:
            os.close(end)
        self._ends = None

    def read(self) -> bytes:
        """Return bytes that the client has written, without waiting."""
        with contextlib.suppress(OSError):
            if self._ends:
                return os.read(self._ends[0], 65_536)
        return b""

    def write(self, data: bytes) -> None:
        """Send bytes in one piece; bytes that do not fit are lost and counted."""
        sent = 0
        with contextlib.suppress(OSError):
            sent = os.write(self._ends[0], data) if self._ends else 0
        self.lost_bytes += len(data) - sent


def open_terminals(links: Mapping[Key, Path | None]) -> dict[Key, Terminal]:
    """Open a pseudo-terminal for each key, with its link or without; raises `PortError`, and no link remains then.

    Links of a server that was killed are all removed first, because the system uses the names of terminals again: a
    link that remains could lead to a terminal that is opened here for another key.
    """
    for wanted in filter(None, links.values()):
        _free(wanted)
    opened: dict[Key, Terminal] = {}
    try:
        for key, link in links.items():
            opened[key] = Terminal(link)
    except BaseException:
        for terminal in opened.values():
            terminal.unplug()
        raise
    return opened


def _free(link: Path) -> None:
    """Remove the link of a server that was killed; raises `PortError` if it leads to a port."""
    if link.is_symlink():
        if link.exists():
            raise PortError(f"{link}: is a port in use by another server; choose another folder, or remove the link")
        with raising(PortError, f"{link}: cannot be removed"):
            link.unlink()


def _point(link: Path, device: str) -> None:
    with raising(PortError, f"{link}: cannot be made a link to {device}"):
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(device)
