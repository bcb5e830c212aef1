"""How the boards' firmware reads its USB buffer: which bytes it takes for which command, and what it does with junk.

Written from the observed behaviour (firmware wire format, section 1.6): any `C` starts a command, numbers are read
like C's `atoi`, extra fields are ignored, a missing one is complained about, and a command whose end has not come
when the buffer is read kills the board.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

NO_KEY: Final = b"No next key character found."
NO_END: Final = b"Failed to detect USB command terminator char! Trying my best"

_NUMBER: Final = re.compile(rb"\s*([+-]?\d+)")


def atoi(text: bytes) -> int:
    """Return the number at the start of a text, 0 where there is none, as C's function does, in 32 bits."""
    found = _NUMBER.match(text)
    value = int(found[1]) if found else 0
    return (value + 2**31) % 2**32 - 2**31


def _number(text: bytes) -> int:
    return atoi(text)


def _flag(text: bytes) -> bool:
    return atoi(text) != 0


def _string(text: bytes) -> bytes:
    return text


_UNTIL_BAR: Final[dict[str, Callable[[bytes], Any]]] = {"int": _number, "bool": _flag, "str": _string}

FIELDS: Final[tuple[tuple[str, ...], ...]] = (
    (),
    (),
    (),
    ("int", "str", "bool", "float", "bytes"),
    ("bool",),
    ("int", "bool", "int", "bool"),
    ("bytes",),
    (),
    ("int",),
    (),
)
"""The kinds of the fields of C00 to C09."""


@dataclass(frozen=True, slots=True)
class Command:
    """A command as the board understood it."""

    number: int
    values: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Reading:
    """What a look at the buffer gave: commands, complaints, the bytes that stay, and whether the board survives."""

    commands: tuple[Command, ...]
    complaints: tuple[bytes, ...]
    rest: bytes
    alive: bool


class _Missing(Exception):  # noqa: N818 - a signal of the parser, not an error for users
    def __init__(self, fields: int) -> None:
        self.fields = fields


class _Unended(Exception):  # noqa: N818 - a signal of the parser, not an error for users
    pass


def read(buffer: bytes) -> Reading:
    """Take every command out of a buffer; the board executes only the last of them."""
    commands: list[Command] = []
    while (at := buffer.find(b"C")) >= 0:
        try:
            command, end = _command(buffer, at)
        except _Missing as missing:
            # What the firmware does next depends on link addresses; the boards seen survived with an empty buffer.
            return Reading(tuple(commands), (NO_KEY,) * missing.fields + (NO_END,), b"", alive=True)
        except _Unended:
            return Reading(tuple(commands), (NO_END,), b"", alive=False)
        commands.append(command)
        buffer = buffer[end:]
    return Reading(tuple(commands), (), buffer, alive=True)


def _command(buffer: bytes, at: int) -> tuple[Command, int]:
    number = atoi(buffer[at + 1 : at + 3])
    if not 0 <= number < len(FIELDS):
        raise _Unended  # an index out of bounds in the firmware; a dead board is the mildest of its ends
    values, at = [], at + 3
    kinds = FIELDS[number]
    for k, kind in enumerate(kinds):
        bar = buffer.find(b"|", at)
        if bar < 0:
            raise _Missing(len(kinds) - k)
        value, at = _value(kind, buffer, bar + 1)
        values.append(value)
    end = buffer.find(b"\r", at)
    if end < 0:
        raise _Unended
    return Command(number, tuple(values)), end + 1


def _value(kind: str, buffer: bytes, at: int) -> tuple[Any, int]:
    if kind == "float":
        raw = buffer[at : at + 4]
        if len(raw) < 4:
            raise _Unended
        return struct.unpack("<f", raw)[0], at + 4
    if kind == "bytes":
        length = int.from_bytes(buffer[at : at + 2], "little")
        if at + 2 + length > len(buffer):
            raise _Unended
        return buffer[at + 2 : at + 2 + length], at + 2 + length
    ends = [end for end in (buffer.find(b"|", at), buffer.find(b"\r", at)) if end >= 0]
    end = min(ends, default=len(buffer))
    return _UNTIL_BAR[kind](buffer[at:end]), end
