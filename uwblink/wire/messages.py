"""Every command and report of the boards, one frozen dataclass each (firmware wire format, section 1).

A class declares its fields once, in their order on the wire, each with its kind; codec, virtual boards and the table
of messages follow. Stamps are ticks of the low 32 bits, powers dBm, skews ppm (positive: the receiver's clock is the
faster one), ranges metres. A message of a firmware of your own is a class more:

```python
@message(b"R10")
class Temperature(Message):
    celsius: int = wire(INT)

register_message(Temperature)
```
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, ClassVar, Final, TypeVar, dataclass_transform

from uwblink.errors import ArgumentError
from uwblink.wire.fields import (
    BOOL,
    BROADCAST,
    BYTES,
    FIRST_PATH,
    ID,
    INT,
    MAGNITUDES,
    PRINTED,
    PRINTED_OR_ZERO,
    RAW_FLOAT,
    STAMP,
    TAPS,
    TEXT,
    Kind,
)


@dataclass(frozen=True, slots=True)
class Message:
    """Base of messages: a key of three bytes and a layout."""

    KEY: ClassVar[bytes] = b""
    FIELDS: ClassVar[Mapping[str, Kind]] = {}


_Kind = TypeVar("_Kind", bound=Message)
_KEY: Final = re.compile(rb"[CRS][0-9]{2}")


def wire(kind: Kind, *, default: Any = MISSING) -> Any:
    """Declare a field of a message: how it is written and read."""
    return field(default=default, metadata={"kind": kind})


@dataclass_transform(frozen_default=True, field_specifiers=(wire,))
def message(key: bytes) -> Callable[[type[_Kind]], type[_Kind]]:
    """Make a class a message: a frozen dataclass. Its layout are the fields declared with `wire`, in their order.

    `key` is the letter of the direction (C: command to a board; R: its answer; S: sent unasked) and two digits. Raises
    `ArgumentError` for any other.
    """
    if not isinstance(key, bytes) or not _KEY.fullmatch(key):
        raise ArgumentError(f'message: key: found {key!r:.40}, expected a letter C, R or S and two digits, as b"R05"')

    def decorate(plain: type[_Kind]) -> type[_Kind]:
        made = dataclass(frozen=True, slots=True)(plain)
        made.KEY = key
        made.FIELDS = {f.name: f.metadata["kind"] for f in fields(made) if "kind" in f.metadata}
        return made

    return decorate


@message(b"C00")
class SetIdle(Message):
    """C00: no effect; the board answers."""


@message(b"C01")
class GetId(Message):
    """C01: ask for the board's id."""


@message(b"C02")
class Reset(Message):
    """C02: reset the receiver."""


@message(b"C03")
class DoTests(Message):
    """C03: echo one field of each kind."""

    integer: int = wire(INT)
    text: str = wire(TEXT)
    flag: bool = wire(BOOL)
    number: float = wire(RAW_FLOAT)
    data: bytes = wire(BYTES)


@message(b"C04")
class SetPassive(Message):
    """C04: listen to the exchanges of others, or stop listening."""

    on: bool = wire(BOOL)


@message(b"C05")
class RangeCommand(Message):
    """C05: range with a target, single-sided or double-sided."""

    target: int = wire(ID)
    target_reports: bool = wire(BOOL, default=False)
    double_sided: bool = wire(BOOL, default=True)
    get_cir: bool = wire(BOOL, default=False)


@message(b"C06")
class Broadcast(Message):
    """C06: send up to 92 bytes to every board in range."""

    data: bytes = wire(BROADCAST)


@message(b"C07")
class GetMaxFrame(Message):
    """C07: ask for the longest frame."""


@message(b"C08")
class SetResponseDelay(Message):
    """C08: set the double-sided response delay, in UWB microseconds (512/499.2 us)."""

    delay_uus: int = wire(INT)


@message(b"C09")
class Bootloader(Message):
    """C09: jump to the bootloader; the port disappears."""


@message(b"R00")
class IdleSet(Message):
    """R00: answer to C00."""


@message(b"R01")
class IdReport(Message):
    """R01: the board's id."""

    board: int = wire(ID)


@message(b"R02")
class ResetDone(Message):
    """R02: answer to C02."""


@message(b"R03")
class TestsDone(Message):
    """R03: the echo of C03; `error` is 1 when the chip's id disagrees with the board's."""

    error: int = wire(INT)
    integer: int = wire(INT)
    text: str = wire(TEXT)
    flag: bool = wire(BOOL)
    number: float = wire(PRINTED)
    data: bytes = wire(BYTES)


@message(b"R04")
class PassiveSet(Message):
    """R04: answer to C04."""


@message(b"R05")
class RangeReport(Message):
    """R05: the initiator's report of an exchange; `neighbour` is the target.

    tx3 and rx3 are zero after a single-sided exchange.
    """

    neighbour: int = wire(ID)
    range_m: float = wire(PRINTED)
    tx1: int = wire(STAMP)
    rx1: int = wire(STAMP)
    tx2: int = wire(STAMP)
    rx2: int = wire(STAMP)
    tx3: int = wire(STAMP)
    rx3: int = wire(STAMP)
    fpp1_dbm: float = wire(PRINTED)
    fpp2_dbm: float = wire(PRINTED)
    skew1_ppm: float = wire(PRINTED)
    skew2_ppm: float = wire(PRINTED)


@message(b"S05")
class TargetRangeReport(RangeReport):
    """S05: the target's report of the same; `neighbour` is the initiator."""


@message(b"R06")
class BroadcastSent(Message):
    """R06: answer to C06."""


@message(b"R07")
class MaxFrameReport(Message):
    """R07: the longest frame, in bytes."""

    length: int = wire(INT)


@message(b"R08")
class ResponseDelaySet(Message):
    """R08: answer to C08."""


@message(b"R09")
class EnteringBootloader(Message):
    """R09: answer to C09."""


@message(b"S01")
class Overheard(Message):
    """S01: an exchange heard by a passive listener.

    Plain stamps, powers and skews are the listener's own; those ending in `_n` came in the frames.
    Zero for missing values; `fpp3_dbm` and `skew3_ppm` are None after a single-sided exchange.
    """

    initiator: int = wire(ID)
    target: int = wire(ID)
    rx1: int = wire(STAMP)
    rx2: int = wire(STAMP)
    rx3: int = wire(STAMP)
    tx1_n: int = wire(STAMP)
    rx1_n: int = wire(STAMP)
    tx2_n: int = wire(STAMP)
    rx2_n: int = wire(STAMP)
    tx3_n: int = wire(STAMP)
    rx3_n: int = wire(STAMP)
    fpp1_dbm: float = wire(PRINTED)
    fpp2_dbm: float = wire(PRINTED)
    fpp3_dbm: float | None = wire(PRINTED_OR_ZERO)
    skew1_ppm: float = wire(PRINTED)
    skew2_ppm: float = wire(PRINTED)
    skew3_ppm: float | None = wire(PRINTED_OR_ZERO)
    fpp1_n_dbm: float = wire(PRINTED)
    fpp2_n_dbm: float = wire(PRINTED)
    skew1_n_ppm: float = wire(PRINTED)
    skew2_n_ppm: float = wire(PRINTED)


@message(b"S01")
class OverheardNothing(Message):
    """S01 with 26 fields, all zero after the ids: the listener missed the response."""

    ZEROS: ClassVar = 24
    initiator: int = wire(ID)
    target: int = wire(ID)


@message(b"S06")
class BroadcastReceived(Message):
    """S06: bytes that another board sent to all; the sender is not known."""

    data: bytes = wire(BROADCAST)


@message(b"S10")
class Cir(Message):
    """S10: a channel impulse response.

    `first_path_milli` is the first path's index times 1000; `magnitudes` has 1016 taps, 1.0016 ns apart.
    """

    TAPS: ClassVar = TAPS
    initiator: int = wire(ID)
    target: int = wire(ID)
    first_path_milli: int = wire(FIRST_PATH)
    magnitudes: tuple[int, ...] = wire(MAGNITUDES)

    def __repr__(self) -> str:
        """Return it without its taps."""
        place, most = self.first_path_milli / 1000, max(self.magnitudes, default=0)
        return (
            f"Cir({self.initiator} -> {self.target}, first path at {place}, {len(self.magnitudes)} taps up to {most})"
        )


@dataclass(frozen=True, slots=True)
class TextLine:
    """A known line of text of the firmware, with its line end as sent."""

    text: str


@dataclass(frozen=True, slots=True)
class Skipped:
    """Bytes that are no message."""

    data: bytes


COMMANDS: Final[dict[bytes, type[Message]]] = {
    kind.KEY: kind
    for kind in (
        SetIdle, GetId, Reset, DoTests, SetPassive, RangeCommand, Broadcast, GetMaxFrame, SetResponseDelay, Bootloader,
    )
}  # fmt: skip
REPORTS: Final[dict[bytes, type[Message]]] = {
    kind.KEY: kind
    for kind in (
        IdleSet, IdReport, ResetDone, TestsDone, PassiveSet, RangeReport, BroadcastSent, MaxFrameReport,
        ResponseDelaySet, EnteringBootloader, Overheard, TargetRangeReport, BroadcastReceived, Cir,
    )
}  # fmt: skip


def register_message(kind: type[Message]) -> None:
    """Add a message to `COMMANDS` or `REPORTS`, by its key: codecs made from now on write and read it.

    Raises `ArgumentError` for a class that is no message, a key that is taken, and fields without a kind.

    >>> from uwblink import register_message
    >>> from uwblink.wire.codec import encode
    >>> from uwblink.wire.fields import PRINTED
    >>> from uwblink.wire.messages import REPORTS, Message, message, wire
    >>> @message(b"R77")
    ... class Temperature(Message):
    ...     celsius: float = wire(PRINTED)
    >>> register_message(Temperature)
    >>> encode(Temperature(21.5))
    b'R77|21.5000\\r\\n'
    >>> del REPORTS[b"R77"]
    """
    if not isinstance(kind, type) or not issubclass(kind, Message) or not _KEY.fullmatch(kind.KEY):
        raise ArgumentError(f"message: found {kind!r:.60}, expected a class made with @message(key)")
    table = COMMANDS if kind.KEY.startswith(b"C") else REPORTS
    where = f"message {kind.__name__} ({kind.KEY.decode()})"
    if kind.KEY in table:
        raise ArgumentError(f"{where}: {kind.KEY.decode()} is {table[kind.KEY].__name__} already; choose another key")
    for declared in fields(kind):
        if not isinstance(kind.FIELDS.get(declared.name), Kind):
            raise ArgumentError(f"{where}: {declared.name}: has no kind; declare it as in `count: int = wire(INT)`")
    table[kind.KEY] = kind


TEXTS: Final = (
    b"COMMANDED TASK FAILED AFTER 5 ATTEMPTS.\r\n",
    b"TWR FAIL: The target ID is the same as the initiator's ID.\r\n",
    b"WARNING 0xB: TWR message is firing an interrupt when it shouldn't be.\r\n",
    b"WARNING 0xC: TWR message is firing an interrupt when it shouldn't be.\r\n",
    b"Unrecognized UWB message type received.",
    b"ERROR: Requested to send message over UWB that is too long.",
    b"No next key character found.",
    b"Failed to detect USB command terminator char! Trying my best",
    b"USB Buffer full! Message rejected to prevent overflow.",
    b"UWB tag initialized and configured. \n",
)
"""The lines of text of the firmware, byte for byte; some end without a line end."""
