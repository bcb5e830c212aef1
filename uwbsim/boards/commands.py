"""The parser of virtual boards for their USB buffer, and the executors of commands, in a table.

The parser follows observed behaviour (firmware wire format, section 1.6): any `C` starts a command, numbers are read as
by C's `atoi`, extra fields are ignored, a missing one gives an error line, and a command that is incomplete when the
buffer is read hangs the board.

A new command is one message class and one executor:

```python
@message(b"C10")
class GetTemperature(Message):
    factor: int = wire(INT)

@message(b"R10")
class Temperature(Message):
    celsius: int = wire(INT)

register_message(GetTemperature)
register_message(Temperature)
register_command(GetTemperature, lambda board, factor: Temperature(23 * factor))
```

After that every virtual board answers it, in process and served, and `Board.request(GetTemperature(1))` returns the
answer. Fields are passed to the executor in the order of their declaration.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Container
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from uwblink.wire.fields import (
    BOOL,
    BROADCAST,
    BYTES,
    ID,
    INT,
    LONGEST_BROADCAST,
    RAW_FLOAT,
    STAMP,
    TEXT,
    Kind,
    write_printed,
)
from uwblink.wire.messages import (
    COMMANDS,
    Bootloader,
    Broadcast,
    BroadcastSent,
    DoTests,
    EnteringBootloader,
    GetId,
    GetMaxFrame,
    IdleSet,
    IdReport,
    MaxFrameReport,
    Message,
    PassiveSet,
    RangeCommand,
    Reset,
    ResetDone,
    ResponseDelaySet,
    SetIdle,
    SetPassive,
    SetResponseDelay,
)
from uwbsim.boards.frames import NS_PER_MS, NS_PER_US, Attempt
from uwbsim.boards.ranging import TO_AIR, initiate
from uwbsim.errors import UwbsimError

if TYPE_CHECKING:
    from uwbsim.boards.virtual_board import VirtualBoard


def printed_float(value: float) -> bytes:
    """Return a four-byte float as the boards print it.

    They print its whole part as a 32-bit integer, and four decimals. A Cortex-M4 converts values beyond the integers to
    the nearest integer, and NaN to 0, with a fraction of 0.
    """
    largest = 2**31 - 1
    if math.isnan(value) or abs(value) <= largest:
        return b"0.0000" if math.isnan(value) else write_printed(value)
    return b"%d.0000" % (largest if value > 0 else -largest - 1)


def atoi(text: bytes) -> int:
    """Return the number at the start of a text, 0 without one, as C's function does; it saturates at 32 bits."""
    found = re.match(rb"\s*([+-]?)0*(\d+)", text)
    # Eleven digits are beyond the largest number already.
    return max(-(2**31), min(int(found[1] + found[2][:11]), 2**31 - 1)) if found else 0


_UNTIL_BAR: Final[dict[Kind, Callable[[bytes], Any]]] = {
    INT: atoi,
    ID: atoi,
    STAMP: atoi,
    BOOL: lambda text: atoi(text) != 0,
    TEXT: bytes,
}
"""How boards read fields that are text."""


class Command(NamedTuple):
    """A command as the board reads it: its message class, and the values of its fields in order."""

    kind: type[Message]
    values: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class BufferReading:
    """The result of reading the buffer: commands, error lines, remaining bytes, and whether the board is alive."""

    commands: tuple[Command, ...]
    error_lines: tuple[bytes, ...]
    rest: bytes
    alive: bool


class _Incomplete(Exception):  # noqa: N818 - a signal of the parser, not an error for users
    """A command ends too early: the lines that the board prints, and whether it is alive afterwards."""

    def __init__(self, missing_fields: int, *, alive: bool) -> None:
        no_end = b"Failed to detect USB command terminator char! Trying my best"
        self.lines = (*[b"No next key character found."] * missing_fields, no_end)
        self.alive = alive


def read_commands(buffer: bytes, known: Container[bytes] = COMMANDS) -> BufferReading:
    """Parse all commands of a buffer, of which the board executes only the last. `known` are the keys it knows."""
    commands: list[Command] = []
    while (at := buffer.find(b"C")) >= 0:
        try:
            command, end = _command(buffer, at, known)
        except _Incomplete as problem:
            # The next step of the firmware depends on link addresses; observed boards went on with an empty buffer.
            return BufferReading(tuple(commands), problem.lines, b"", problem.alive)
        commands.append(command)
        buffer = buffer[end:]
    return BufferReading(tuple(commands), (), buffer, alive=True)


def _command(buffer: bytes, at: int, known: Container[bytes]) -> tuple[Command, int]:
    key = b"C%02d" % atoi(buffer[at + 1 : at + 3])
    if key not in known or key not in COMMANDS:
        raise _Incomplete(0, alive=False)  # an index out of bounds in the firmware; the board hangs at best
    kind, values, at = COMMANDS[key], list[Any](), at + 3
    for field in kind.FIELDS.values():
        bar = buffer.find(b"|", at)
        if bar < 0:
            raise _Incomplete(len(kind.FIELDS) - len(values), alive=True)
        value, at = _value(field, buffer, bar + 1)
        values.append(value)
    end = buffer.find(b"\r", at)
    if end < 0:
        raise _Incomplete(0, alive=False)
    return Command(kind, tuple(values)), end + 1


def _value(field: Kind, buffer: bytes, at: int) -> tuple[Any, int]:
    if field in _UNTIL_BAR:
        ends = [end for end in (buffer.find(b"|", at), buffer.find(b"\r", at)) if end >= 0]
        end = min(ends, default=len(buffer))
        return _UNTIL_BAR[field](buffer[at:end]), end
    start = at if field == RAW_FLOAT else at + 2
    end = at + 4 if field == RAW_FLOAT else start + int.from_bytes(buffer[at:start], "little")
    if end > len(buffer):
        raise _Incomplete(0, alive=False)
    return struct.unpack("<f", buffer[start:end])[0] if field == RAW_FLOAT else buffer[start:end], end


ANSWER: Final = 195 * NS_PER_US
"""From the read of the USB buffer with a command to its answer on the bus."""

Executor = Callable[..., "Message | bytes | Attempt"]
"""Called with the board and the command's values; returns the reply, or an `Attempt` that does everything itself.

A command that is not done is retried a millisecond later, six times in all.
"""


def register_command(kind: type[Message], execute: Executor) -> None:
    """Register the executor of a command that `uwblink` knows; raises `UwbsimError` for one that boards cannot read.

    A second registration replaces the first.
    """
    if COMMANDS.get(kind.KEY) is not kind:
        raise UwbsimError(f"{kind.__name__}: not a registered command of uwblink; register the message first")
    readable = (*_UNTIL_BAR, BYTES, BROADCAST, RAW_FLOAT)
    for name, field in kind.FIELDS.items():
        if field not in readable:
            known = ", ".join(k.name for k in readable)
            raise UwbsimError(
                f"{kind.__name__}.{name}: boards cannot read {field.name} from the host; they read {known}"
            )
    EXECUTORS[kind.KEY] = execute


def _reset(board: VirtualBoard) -> Message:
    if not board.radio.sending:
        board.radio.listen()
    return ResetDone()


def _do_tests(_board: VirtualBoard, number: int, text: bytes, flag: bool, real: float, data: bytes) -> bytes:
    parts = (b"R03", b"0", b"%d" % number, text, b"%d" % flag, printed_float(real))
    return b"|".join(parts) + b"|" + len(data).to_bytes(2, "little") + data + b"\r\n"


def _set_passive(board: VirtualBoard, on: bool) -> Message:
    board.passive = on
    return PassiveSet()


def _set_delay(board: VirtualBoard, delay_uus: int) -> Message:
    board.delay_uus = delay_uus % 65_536
    return ResponseDelaySet()


def _bootloader(board: VirtualBoard) -> Attempt:
    yield from board.answer(EnteringBootloader())
    boots_after = 103 * NS_PER_MS
    board.sleep(boots_after).callbacks.append(lambda _: board.power_off())
    yield board.sleep(2 * boots_after)
    return True


def _broadcast(board: VirtualBoard, data: bytes) -> Attempt:
    if len(data) > LONGEST_BROADCAST:
        board.send(b"ERROR: Requested to send message over UWB that is too long.", ANSWER)
        yield board.sleep(NS_PER_MS)
        return False
    board.radio.off()
    yield board.sleep(TO_AIR - board.bench.air.before_marker)
    board.radio.send(None, Broadcast(data), board.bench.air.first_stamp(board.id))
    yield board.sleep(930 * NS_PER_US)
    board.send(BroadcastSent())
    return True


EXECUTORS: Final[dict[bytes, Executor]] = {
    SetIdle.KEY: lambda board: IdleSet(),
    GetId.KEY: lambda board: IdReport(board.id),
    Reset.KEY: _reset,
    DoTests.KEY: _do_tests,
    SetPassive.KEY: _set_passive,
    RangeCommand.KEY: lambda board, target, *requests: initiate(board, RangeCommand(target % 256, *requests)),
    Broadcast.KEY: _broadcast,
    GetMaxFrame.KEY: lambda board: MaxFrameReport(100),
    SetResponseDelay.KEY: _set_delay,
    Bootloader.KEY: _bootloader,
}
"""Executors of commands by key; `register_command` adds to it."""
