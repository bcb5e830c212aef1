"""What a virtual board does with each command: one executor each, in a table that can grow.

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

From then on every virtual board answers it, in process and served, and `Board.request(GetTemperature(1))` returns the
answer. Fields are handed to the executor in the order in which they are declared.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, Final

import simpy

from uwblink.wire.fields import LONGEST_BROADCAST
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
from uwbsim.boards.board_air import MS, US
from uwbsim.boards.command_parser import READABLE
from uwbsim.boards.frames import DataPayload
from uwbsim.boards.printing import printed_float
from uwbsim.boards.ranging import TO_AIR, initiate
from uwbsim.errors import UwbsimError

if TYPE_CHECKING:
    from uwbsim.boards.virtual_board import VirtualBoard

BOOTLOADER_AFTER: Final = 103 * MS
ANSWER: Final = 195 * US
"""From the poll of the USB buffer that found a command to its answer on the bus."""

TO_SENT: Final = 930 * US
"""From the start of a broadcast's frame to its answer on the bus."""

TOO_LONG: Final = b"ERROR: Requested to send message over UWB that is too long."

Attempt = Generator[simpy.Event, Any, bool]
"""What takes time: yields SimPy events of the bench, in nanoseconds, and returns whether the command is done."""

Executor = Callable[..., "Message | bytes | Attempt"]
"""Called with the board and the command's values; returns the reply, or does everything itself as an `Attempt`.

A command that is not done is tried again a millisecond later, six times in all.
"""


def register_command(kind: type[Message], execute: Executor) -> None:
    """Have virtual boards carry out a command that `uwblink` knows; raises `UwbsimError` for one that they cannot read.

    A second registration replaces the first.
    """
    if COMMANDS.get(kind.KEY) is not kind:
        raise UwbsimError(f"{kind.__name__}: not a command that uwblink knows; register the message there first")
    for name, field in kind.FIELDS.items():
        if field not in READABLE:
            known = ", ".join(k.name for k in READABLE)
            raise UwbsimError(f"{kind.__name__}.{name}: boards read no {field.name} from the host; they read {known}")
    EXECUTORS[kind.KEY] = execute


def _set_idle(_board: VirtualBoard) -> Message:
    return IdleSet()


def _get_id(board: VirtualBoard) -> Message:
    return IdReport(board.id)


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


def _max_frame(_board: VirtualBoard) -> Message:
    return MaxFrameReport(100)


def _set_delay(board: VirtualBoard, delay_uus: int) -> Message:
    board.delay_uus = delay_uus % 65_536
    return ResponseDelaySet()


def _bootloader(board: VirtualBoard) -> Attempt:
    yield from board.answer(EnteringBootloader())
    board.sleep(BOOTLOADER_AFTER).callbacks.append(lambda _: board.power_off())
    yield board.sleep(2 * BOOTLOADER_AFTER)
    return True


def _broadcast(board: VirtualBoard, data: bytes) -> Attempt:
    if len(data) > LONGEST_BROADCAST:
        board.say(TOO_LONG, ANSWER)
        yield board.sleep(MS)
        return False
    board.radio.off()
    yield board.sleep(TO_AIR - board.bench.air.before_marker)
    board.radio.send(None, DataPayload(data), board.radio.first_stamp())
    yield board.sleep(TO_SENT)
    board.say(BroadcastSent())
    return True


def _range(board: VirtualBoard, target: int, target_reports: bool, double_sided: bool, get_cir: bool) -> Attempt:
    return initiate(board, target % 256, target_reports, double_sided, get_cir)


EXECUTORS: Final[dict[bytes, Executor]] = {}
"""What each command does, by its key; `register_command` adds to it."""

for _kind, _execute in (
    (SetIdle, _set_idle),
    (GetId, _get_id),
    (Reset, _reset),
    (DoTests, _do_tests),
    (SetPassive, _set_passive),
    (RangeCommand, _range),
    (Broadcast, _broadcast),
    (GetMaxFrame, _max_frame),
    (SetResponseDelay, _set_delay),
    (Bootloader, _bootloader),
):
    register_command(_kind, _execute)
