"""The fields of wire messages: how each kind is written and read, in either direction.

The two directions differ: the host sends a float as four raw bytes, the boards print it with four
decimals, cut toward zero (firmware wire format, sections 0.2 and 1.2).
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from uwblink.errors import FrameError

LONGEST_TEXT: Final = 199
"""Bytes of a text that the boards' buffer takes (firmware wire format, 1.2)."""

LONGEST_BROADCAST: Final = 92
"""Bytes of a frame of the radio, without header and checksum (firmware wire format, 1.3)."""


class Malformed(Exception):  # noqa: N818 - a signal inside the codec, not an error for users
    """These bytes are not this field."""


class NeedMore(Exception):  # noqa: N818 - a signal inside the codec, not an error for users
    """So far these bytes could be this field."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of field. `size` is None for text up to the next bar, else how many raw bytes.

    `size(data, at)` returns the length at a place, or raises `NeedMore` or `Malformed`.
    """

    name: str
    read: Callable[[bytes], Any]
    write: Callable[[Any], bytes]
    size: Callable[[bytes, int], int] | None = None


def _integer(low: int, high: int) -> Kind:
    def read(text: bytes) -> int:
        if not re.fullmatch(rb"0|-?[1-9][0-9]{0,9}", text) or not low <= int(text) <= high:
            raise Malformed
        return int(text)

    def write(value: int) -> bytes:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise FrameError(f"found {value!r}, expected a whole number from {low} to {high}")
        return b"%d" % value

    return Kind(f"integer {low}..{high}", read, write)


def _read_bool(text: bytes) -> bool:
    if text not in (b"0", b"1"):
        raise Malformed
    return text == b"1"


def _write_bool(value: bool) -> bytes:
    if not isinstance(value, bool):
        raise FrameError(f"found {value!r}, expected True or False")
    return b"1" if value else b"0"


def _read_text(text: bytes) -> str:
    try:
        found = text.decode()
    except UnicodeDecodeError as error:
        raise Malformed from error
    if len(text) > LONGEST_TEXT or "\r" in found or "\0" in found:
        raise Malformed
    return found


def _write_text(value: str) -> bytes:
    if any(mark in value for mark in "|\r\0"):
        raise FrameError(f"found {value[:40]!r}, text on the wire cannot hold '|', a carriage return or a NUL")
    data = value.encode()
    if len(data) > LONGEST_TEXT:
        raise FrameError(f"found {len(data)} bytes of text, at most {LONGEST_TEXT} fit")
    return data


def _read_printed(text: bytes) -> float:
    if not re.fullmatch(rb"-?(0|[1-9][0-9]{0,9})\.[0-9]{4}", text):
        raise Malformed
    return float(text)


def write_printed(value: float) -> bytes:
    """Print a number as the boards do: four decimals, cut toward zero, `-0.0000` included."""
    if not math.isfinite(value) or abs(value) >= 1e10:
        raise FrameError(f"found {value!r}, expected a finite number below 1e10")
    # What already has four decimals must not lose its last one to binary rounding.
    whole = math.floor(abs(value) * 1e4 + 1e-6)
    sign = b"-" if math.copysign(1, value) < 0 else b""
    return sign + b"%d.%04d" % divmod(whole, 10_000)


def _write_raw_float(value: float) -> bytes:
    try:
        return struct.pack("<f", value)
    except (OverflowError, struct.error) as error:
        raise FrameError(f"found {value!r}, expected a number that fits four bytes") from error


def _bytes(longest: int) -> Kind:
    def size(data: bytes, at: int) -> int:
        if len(data) < at + 2:
            raise NeedMore
        length = int.from_bytes(data[at : at + 2], "little")
        if length > longest:
            raise Malformed
        return 2 + length

    def write(value: bytes) -> bytes:
        if len(value) > longest:
            raise FrameError(f"found {len(value)} bytes, at most {longest} fit")
        return len(value).to_bytes(2, "little") + value

    return Kind(f"bytes up to {longest}", lambda data: data[2:], write, size)


ID: Final = _integer(0, 255)
STAMP: Final = _integer(0, 2**32 - 1)
INT: Final = _integer(-(2**31), 2**31 - 1)
BOOL: Final = Kind("bool", _read_bool, _write_bool)
TEXT: Final = Kind("text", _read_text, _write_text)
PRINTED: Final = Kind("printed number", _read_printed, write_printed)
PRINTED_OR_ZERO: Final = Kind(
    "printed number or 0",
    lambda text: None if text == b"0" else _read_printed(text),
    lambda value: b"0" if value is None else write_printed(value),
)
RAW_FLOAT: Final = Kind(
    "four-byte float", lambda data: struct.unpack("<f", data)[0], _write_raw_float, lambda _data, _at: 4
)
BROADCAST: Final = _bytes(LONGEST_BROADCAST)
BYTES: Final = _bytes(1000)  # more than any frame, so that the end of damage is found
