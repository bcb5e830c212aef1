"""How the boards' firmware reads its USB buffer: which bytes it takes for which command, and what it does with junk.

Written from the observed behaviour (firmware wire format, section 1.6): any `C` starts a command, numbers are read
like C's `atoi`, extra fields are ignored, a missing one is complained about, and a command whose end has not come
when the buffer is read kills the board.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Container
from dataclasses import dataclass
from typing import Any, Final

from uwblink.wire.fields import BOOL, BROADCAST, BYTES, ID, INT, RAW_FLOAT, STAMP, TEXT, Kind
from uwblink.wire.messages import COMMANDS, Message

NO_KEY: Final = b"No next key character found."
NO_END: Final = b"Failed to detect USB command terminator char! Trying my best"

_NUMBER: Final = re.compile(rb"\s*([+-]?)0*(\d+)")
LARGEST: Final = 2**31 - 1
MOST_DIGITS: Final = 11


def atoi(text: bytes) -> int:
    """Return the number at the start of a text, 0 where there is none, as C's function does; a larger one saturates."""
    found = _NUMBER.match(text)
    # Eleven digits are beyond the largest number already, and how many more there are does not matter.
    return max(-LARGEST - 1, min(int(found[1] + found[2][:MOST_DIGITS]), LARGEST)) if found else 0


def _flag(text: bytes) -> bool:
    return atoi(text) != 0


_UNTIL_BAR: Final[dict[Kind, Callable[[bytes], Any]]] = {INT: atoi, ID: atoi, STAMP: atoi, BOOL: _flag, TEXT: bytes}
_COUNTED: Final = (BYTES, BROADCAST)
READABLE: Final = (*_UNTIL_BAR, *_COUNTED, RAW_FLOAT)
"""The kinds of fields that a command can have."""


@dataclass(frozen=True, slots=True)
class Command:
    """A command as the board understood it: which, and the values of its fields in their order."""

    kind: type[Message]
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


def read(buffer: bytes, known: Container[bytes] = COMMANDS) -> Reading:
    """Take every command out of a buffer; the board executes only the last of them. `known` are the keys it knows."""
    commands: list[Command] = []
    while (at := buffer.find(b"C")) >= 0:
        try:
            command, end = _command(buffer, at, known)
        except _Missing as missing:
            # What the firmware does next depends on link addresses; the boards seen survived with an empty buffer.
            return Reading(tuple(commands), (NO_KEY,) * missing.fields + (NO_END,), b"", alive=True)
        except _Unended:
            return Reading(tuple(commands), (NO_END,), b"", alive=False)
        commands.append(command)
        buffer = buffer[end:]
    return Reading(tuple(commands), (), buffer, alive=True)


def _command(buffer: bytes, at: int, known: Container[bytes]) -> tuple[Command, int]:
    key = b"C%02d" % atoi(buffer[at + 1 : at + 3])
    if key not in known or key not in COMMANDS:
        raise _Unended  # an index out of bounds in the firmware; a dead board is the mildest of its ends
    kind, values, at = COMMANDS[key], [], at + 3
    for k, field in enumerate(kind.FIELDS.values()):
        bar = buffer.find(b"|", at)
        if bar < 0:
            raise _Missing(len(kind.FIELDS) - k)
        value, at = _value(field, buffer, bar + 1)
        values.append(value)
    end = buffer.find(b"\r", at)
    if end < 0:
        raise _Unended
    return Command(kind, tuple(values)), end + 1


def _value(field: Kind, buffer: bytes, at: int) -> tuple[Any, int]:
    if field == RAW_FLOAT:
        raw = buffer[at : at + 4]
        if len(raw) < 4:
            raise _Unended
        return struct.unpack("<f", raw)[0], at + 4
    if field in _COUNTED:
        length = int.from_bytes(buffer[at : at + 2], "little")
        if at + 2 + length > len(buffer):
            raise _Unended
        return buffer[at + 2 : at + 2 + length], at + 2 + length
    ends = [end for end in (buffer.find(b"|", at), buffer.find(b"\r", at)) if end >= 0]
    end = min(ends, default=len(buffer))
    return _UNTIL_BAR[field](buffer[at:end]), end
