"""Serial ports: which there are, opening one, and moving bytes. The only file that knows pyserial.

A port is a device (`/dev/ttyACM0`), a link to one, or any pyserial URL (`socket://`, `rfc2217://`).
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import selectors
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import serial
from serial.tools import list_ports

from uwblink.errors import PortBusyError, PortError, PortLostError, PortMissingError, PortPermissionError

VENDOR_ID: Final = 0x0483
PRODUCT_ID: Final = 0x5740
"""The boards' USB identity, "STM32 Virtual ComPort" (firmware wire format, 1.1)."""

BAUD: Final = 19_200
"""Ignored by the boards, but a serial port wants one."""

READ_BYTES: Final = 65_536
POLL_S: Final = 0.002
"""How often ports without a descriptor are asked."""


class Transport(Protocol):
    """What the driver needs of a port; `uwbsim` has one whose time is virtual."""

    name: str

    def read(self, timeout_s: float) -> bytes:
        """Return what came, at once if there is any, empty when the time is over."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes in one write."""
        ...

    def now_s(self) -> float:
        """Return a time that never goes back, in seconds."""
        ...

    def close(self) -> None:
        """Give the port back."""
        ...


class Ports(Protocol):
    """What a recorder needs of ports together; `uwbsim.VirtualPorts` are ones whose time is virtual."""

    def open(self, name: str) -> Transport:
        """Open a port and watch it; raises one of the `PortError`s."""
        ...

    def close(self, port: Transport) -> None:
        """Close a port that was opened here."""
        ...

    def wait(self, timeout_s: float) -> Sequence[Transport]:
        """Return ports at which bytes may be waiting, none when the time is over."""
        ...

    def now_s(self) -> float:
        """Return a time that never goes back, in seconds; that of the ports."""
        ...

    def host_ns(self) -> int:
        """Return the same time as nanoseconds since the Unix epoch."""
        ...

    def moved(self, name: str, number: str | None) -> str | None:
        """Return what a port is called now whose device has the USB serial number `number`, None while it is away."""
        ...


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial device of this computer that has the boards' USB identity."""

    device: str
    description: str
    serial_number: str | None


def boards_ports() -> list[PortInfo]:
    """Return the serial devices with the boards' USB identity, without opening any."""
    return [
        PortInfo(p.device, p.description or "", p.serial_number)
        for p in sorted(list_ports.comports())
        if (p.vid, p.pid) == (VENDOR_ID, PRODUCT_ID)
    ]


def serial_number(device: str) -> str | None:
    """Return the USB serial number behind a device, None where it has none."""
    real = os.path.realpath(device)
    return next((p.serial_number for p in list_ports.comports() if p.device in (device, real)), None)


class SerialPort:
    """An open serial port, locked against a second process."""

    def __init__(self, name: str) -> None:
        """Open a port; raises one of the `PortError`s, which say what to do."""
        self.name = name
        self._serial = _opened(name)
        try:
            self.fileno: int | None = self._serial.fileno()
        except (OSError, AttributeError, NotImplementedError):
            self.fileno = None  # rfc2217 has no descriptor to wait on
        if self.fileno is not None:
            os.set_blocking(self.fileno, False)

    def read(self, timeout_s: float) -> bytes:
        """Return what came, at once if there is any, empty when the time is over; raises `PortLostError`."""
        if self.fileno is None:
            return self._read_pyserial(timeout_s)
        ready, _, _ = select.select([self.fileno], [], [], max(timeout_s, 0.0))
        return self.read_ready() if ready else b""

    def read_ready(self) -> bytes:
        """Return what is there, after the descriptor was found readable; raises `PortLostError`."""
        if self.fileno is None:
            return self._read_pyserial(0)
        try:
            data = os.read(self.fileno, READ_BYTES)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise self._lost(error) from error
        if not data:  # readable and yet empty: the other end has hung up
            raise self._lost(OSError(errno.ENODEV, "unplugged"))
        return data

    def write(self, data: bytes) -> None:
        """Send bytes in one write; raises `PortLostError`."""
        try:
            if self.fileno is None:
                self._serial.write(data)
                return
            sent = os.write(self.fileno, data)
            while sent < len(data):  # a full buffer: what is left must still follow
                select.select([], [self.fileno], [], 1.0)
                sent += os.write(self.fileno, data[sent:])
        except (OSError, serial.SerialException) as error:
            raise self._lost(error) from error

    def now_s(self) -> float:
        """Return the monotonic clock in seconds."""
        return time.monotonic()

    def close(self) -> None:
        """Close the port; harmless when it is lost."""
        with contextlib.suppress(OSError, serial.SerialException, TypeError):
            self._serial.close()

    def _read_pyserial(self, timeout_s: float) -> bytes:
        try:
            self._serial.timeout = timeout_s
            first: bytes = self._serial.read(1)
            return first + self._serial.read(self._serial.in_waiting) if first else first
        except (OSError, serial.SerialException) as error:
            raise self._lost(error) from error

    def _lost(self, error: Exception) -> PortLostError:
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
        return PortLostError(f"{self.name}: the port is gone ({reason}); plug the board in again")


def _since_boot_ns() -> int:
    """Return a clock that nobody sets, and that goes on while the computer is suspended, where the system has one."""
    boot = getattr(time, "CLOCK_BOOTTIME", None)
    return time.monotonic_ns() if boot is None else time.clock_gettime_ns(boot)


class SerialPorts:
    """The serial ports of this computer."""

    def __init__(self) -> None:
        """Watch none yet."""
        self._selector = selectors.SelectSelector()
        self._pyserial: list[SerialPort] = []
        # No change of the wall clock moves the times of a recording.
        self._epoch_ns = time.time_ns() - _since_boot_ns()

    def open(self, name: str) -> SerialPort:
        """Open a port and watch it; raises one of the `PortError`s."""
        port = SerialPort(name)
        if port.fileno is None:
            self._pyserial.append(port)
        else:
            self._selector.register(port.fileno, selectors.EVENT_READ, port)
        return port

    def close(self, port: Transport) -> None:
        """Close a port that was opened here."""
        if isinstance(port, SerialPort) and port.fileno is not None:
            self._selector.unregister(port.fileno)
        self._pyserial = [p for p in self._pyserial if p is not port]
        port.close()

    def wait(self, timeout_s: float) -> Sequence[SerialPort]:
        """Return ports at which bytes may be waiting; those without a descriptor must be asked again and again."""
        if self._pyserial:
            timeout_s = min(timeout_s, POLL_S)
        return [key.data for key, _ in self._selector.select(max(timeout_s, 0.0))] + self._pyserial

    def now_s(self) -> float:
        """Return the monotonic clock in seconds."""
        return time.monotonic()

    def host_ns(self) -> int:
        """Return host time in nanoseconds since the Unix epoch."""
        return self._epoch_ns + _since_boot_ns()

    def moved(self, name: str, number: str | None) -> str | None:
        """Return what a port is called now: the old name, or another of the board with this USB serial number."""
        if "://" in name or os.path.exists(name):
            return name
        return next((p.device for p in boards_ports() if number and p.serial_number == number), None)


def _opened(name: str) -> Any:
    try:
        port = serial.serial_for_url(name, do_not_open=True, timeout=0, baudrate=BAUD)
        if "://" not in name:
            port.exclusive = True
        port.open()
    except ValueError as error:
        raise PortError(f"{name}: not a port ({error})") from error
    except (OSError, serial.SerialException) as error:
        raise _explained(name, error) from error
    with contextlib.suppress(OSError, serial.SerialException, NotImplementedError):
        port.reset_input_buffer()
    return port


def _explained(name: str, error: Exception) -> PortError:
    code = getattr(error, "errno", None)
    text = str(error)
    if code == errno.ENOENT or "No such file" in text:
        return PortMissingError(f"{name}: no such port; `uwblink ports` lists the boards that are plugged in")
    if code in (errno.EACCES, errno.EPERM) or "Permission denied" in text:
        return PortPermissionError(
            f"{name}: permission denied; join the group {_group(name)} (sudo usermod -aG {_group(name)} $USER) "
            "and log in again"
        )
    if code in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "exclusively lock" in text:
        return PortBusyError(f"{name}: another process has this port open; close it first")
    if os.path.isdir(name):
        return PortError(f"{name.rstrip('/')}: is a folder; name the ports in it, as with {name.rstrip('/')}/*")
    if code == errno.ENOTTY or "Inappropriate ioctl" in text or "configure port" in text:
        return PortError(f"{name}: not a serial port")
    return PortError(f"{name}: cannot be opened ({text})")


def _group(name: str) -> str:
    """The group that owns a device, "dialout" where that cannot be found out."""
    try:
        import grp

        return grp.getgrgid(os.stat(name).st_gid).gr_name
    except (OSError, KeyError, ImportError):
        return "dialout"
