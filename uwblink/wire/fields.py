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

from uwblink.errors import FrameError, raising

LONGEST_TEXT: Final = 199
"""Bytes of a text that the boards' buffer takes (firmware wire format, 1.2)."""

TAPS: Final = 1016
"""Taps of an impulse response (DW1000 User Manual 2.10, accumulator at 64 MHz PRF)."""

LONGEST_BROADCAST: Final = 92
"""Bytes of a frame of the radio, without header and checksum (firmware wire format, 1.3)."""


class Malformed(Exception):  # noqa: N818 - a signal inside the codec, not an error for users
    """These bytes are not this field."""


class NeedMore(Exception):  # noqa: N818 - a signal inside the codec, not an error for users
    """So far these bytes could be this field."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of field. `size` is None for text between bars, `parts` pieces of it, else how many raw bytes.

    `read` raises `Malformed`, `write` raises `FrameError`. `size(data, at)` returns the length at a place, or raises
    `NeedMore` or `Malformed`.
    """

    name: str
    read: Callable[[bytes], Any]
    write: Callable[[Any], bytes]
    size: Callable[[bytes, int], int] | None = None
    parts: int = 1


def _text(
    name: str,
    pattern: bytes,
    parse: Callable[[bytes], Any],
    show: Callable[[Any], bytes],
    fits: Callable[[Any], bool],
    expected: str,
    parts: int = 1,
) -> Kind:
    """Return a kind of field that is text: of a `pattern`, with values that fit, which are written as `show` does."""
    whole = re.compile(pattern, re.DOTALL)

    def read(text: bytes) -> Any:
        try:
            if whole.fullmatch(text) and fits(value := parse(text)):
                return value
        except UnicodeDecodeError as error:
            raise Malformed from error
        raise Malformed

    def write(value: Any) -> bytes:
        if not fits(value):
            raise FrameError(f"found {value!r:.60}, expected {expected}")
        return show(value)

    return Kind(name, read, write, None, parts)


def _integer(low: int, high: int) -> Kind:
    def fits(value: Any) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high

    expected = f"a whole number from {low} to {high}"
    return _text(f"integer {low}..{high}", b"0|-?[1-9][0-9]{0,9}+", int, b"%d".__mod__, fits, expected)


def _is_printable(value: Any) -> bool:
    return math.isfinite(value) and abs(value) < 1e10


def _read_first_path(text: bytes) -> int:
    whole, milli = text.split(b"|")
    return 1000 * int(whole) + int(milli)


def write_printed(value: float) -> bytes:
    """Print a number as the boards do: four decimals, cut toward zero, `-0.0000` included."""
    if not _is_printable(value):
        raise FrameError(f"found {value!r}, expected {NUMBER}")
    # What already has four decimals must not lose its last one to binary rounding.
    whole = math.floor(abs(value) * 1e4 + 1e-6)
    sign = b"-" if math.copysign(1, value) < 0 else b""
    return sign + b"%d.%04d" % divmod(whole, 10_000)


def _write_raw_float(value: float) -> bytes:
    wrong = f"found {value!r}, expected a number that fits four bytes"
    with raising(FrameError, wrong, OverflowError, struct.error):
        return struct.pack("<f", value)


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
BOOL: Final = _text("bool", b"[01]", b"1".__eq__, b"%d".__mod__, lambda value: isinstance(value, bool), "True or False")
TEXT: Final = _text(
    "text",
    b".*",
    bytes.decode,
    str.encode,
    lambda text: len(text.encode()) <= LONGEST_TEXT and not any(mark in text for mark in "|\r\0"),
    f"at most {LONGEST_TEXT} bytes of text without '|', a carriage return or a NUL",
)
NUMBER: Final = "a finite number below 1e10"
PRINTED: Final = _text(
    "printed number", rb"-?(?:0|[1-9][0-9]{0,9}+)\.[0-9]{4}", float, write_printed, _is_printable, NUMBER
)
PRINTED_OR_ZERO: Final = Kind(
    "printed number or 0",
    lambda text: None if text == b"0" else PRINTED.read(text),
    lambda value: b"0" if value is None else write_printed(value),
)
FIRST_PATH: Final = _text(
    "index of a first path, times 1000",
    rb"(?:0|[1-9][0-9]{0,3})\|(?:0|[1-9][0-9]{0,2})",
    _read_first_path,
    lambda milli: b"%d|%d" % divmod(milli, 1000),
    lambda milli: 0 <= milli < 1000 * (TAPS + 8),
    f"thousandths of an index up to {TAPS + 8}",
    parts=2,
)
MAGNITUDES: Final = _text(
    "taps",
    rb"(?:(?:0|[1-9][0-9]{0,4})(?:\||$))+",
    lambda text: tuple(map(int, text.split(b"|"))),
    lambda taps: b"|".join(b"%d" % tap for tap in taps),
    lambda taps: len(taps) == TAPS and min(taps) >= 0 and max(taps) < 100_000,
    f"{TAPS} whole numbers from 0 to 99999",
    parts=TAPS,
)
RAW_FLOAT: Final = Kind(
    "four-byte float", lambda data: struct.unpack("<f", data)[0], _write_raw_float, lambda _data, _at: 4
)
BROADCAST: Final = _bytes(LONGEST_BROADCAST)
BYTES: Final = _bytes(1000)  # more than any frame, so that the end of damage is found
