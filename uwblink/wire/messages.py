"""Every command and report of the boards, one frozen dataclass each (firmware wire format, section 1).

A class's table `FIELDS` is its layout on the wire, in order. Stamps are ticks of the low 32 bits, powers
dBm, skews ppm (positive: the receiver's clock is the faster one), ranges metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

from uwblink.wire.fields import (
    BOOL,
    BROADCAST,
    BYTES,
    ID,
    INT,
    PRINTED,
    PRINTED_OR_ZERO,
    RAW_FLOAT,
    STAMP,
    TEXT,
    Kind,
)

Layout = Mapping[str, Kind]


@dataclass(frozen=True, slots=True)
class Message:
    """What every message has: a key of three bytes and a layout."""

    KEY: ClassVar[bytes] = b""
    FIELDS: ClassVar[Layout] = {}


@dataclass(frozen=True, slots=True)
class SetIdle(Message):
    """C00: does nothing but answer."""

    KEY: ClassVar = b"C00"


@dataclass(frozen=True, slots=True)
class GetId(Message):
    """C01: ask for the board's id."""

    KEY: ClassVar = b"C01"


@dataclass(frozen=True, slots=True)
class Reset(Message):
    """C02: reset the receiver."""

    KEY: ClassVar = b"C02"


@dataclass(frozen=True, slots=True)
class DoTests(Message):
    """C03: echo one field of each kind."""

    KEY: ClassVar = b"C03"
    FIELDS: ClassVar = {"integer": INT, "text": TEXT, "flag": BOOL, "number": RAW_FLOAT, "data": BYTES}
    integer: int
    text: str
    flag: bool
    number: float
    data: bytes


@dataclass(frozen=True, slots=True)
class SetPassive(Message):
    """C04: listen to the exchanges of others, or stop to."""

    KEY: ClassVar = b"C04"
    FIELDS: ClassVar = {"on": BOOL}
    on: bool


@dataclass(frozen=True, slots=True)
class RangeCommand(Message):
    """C05: range with a target, single-sided or double-sided."""

    KEY: ClassVar = b"C05"
    FIELDS: ClassVar = {"target": ID, "target_reports": BOOL, "double_sided": BOOL, "get_cir": BOOL}
    target: int
    target_reports: bool = False
    double_sided: bool = True
    get_cir: bool = False


@dataclass(frozen=True, slots=True)
class Broadcast(Message):
    """C06: send up to 92 bytes to every board in range."""

    KEY: ClassVar = b"C06"
    FIELDS: ClassVar = {"data": BROADCAST}
    data: bytes


@dataclass(frozen=True, slots=True)
class GetMaxFrame(Message):
    """C07: ask for the longest frame."""

    KEY: ClassVar = b"C07"


@dataclass(frozen=True, slots=True)
class SetResponseDelay(Message):
    """C08: set the double-sided response delay, in UWB microseconds (512/499.2 us)."""

    KEY: ClassVar = b"C08"
    FIELDS: ClassVar = {"delay_uus": INT}
    delay_uus: int


@dataclass(frozen=True, slots=True)
class Bootloader(Message):
    """C09: jump to the bootloader; the port disappears."""

    KEY: ClassVar = b"C09"


@dataclass(frozen=True, slots=True)
class IdleSet(Message):
    """R00: answer to C00."""

    KEY: ClassVar = b"R00"


@dataclass(frozen=True, slots=True)
class IdReport(Message):
    """R01: the board's id."""

    KEY: ClassVar = b"R01"
    FIELDS: ClassVar = {"board": ID}
    board: int


@dataclass(frozen=True, slots=True)
class ResetDone(Message):
    """R02: answer to C02."""

    KEY: ClassVar = b"R02"


@dataclass(frozen=True, slots=True)
class TestsDone(Message):
    """R03: the echo of C03; `error` is 1 when the chip's id disagrees with the board's."""

    KEY: ClassVar = b"R03"
    FIELDS: ClassVar = {
        "error": INT,
        "integer": INT,
        "text": TEXT,
        "flag": BOOL,
        "number": PRINTED,
        "data": BYTES,
    }
    error: int
    integer: int
    text: str
    flag: bool
    number: float
    data: bytes


@dataclass(frozen=True, slots=True)
class PassiveSet(Message):
    """R04: answer to C04."""

    KEY: ClassVar = b"R04"


_EXCHANGE: Final[Layout] = {
    "neighbour": ID,
    "range_m": PRINTED,
    **dict.fromkeys(("tx1", "rx1", "tx2", "rx2", "tx3", "rx3"), STAMP),
    **dict.fromkeys(("fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm"), PRINTED),
}


@dataclass(frozen=True, slots=True)
class RangeReport(Message):
    """R05: the initiator's report of an exchange; `neighbour` is the target.

    tx3 and rx3 are zero after a single-sided exchange.
    """

    KEY: ClassVar = b"R05"
    FIELDS: ClassVar = _EXCHANGE
    neighbour: int
    range_m: float
    tx1: int
    rx1: int
    tx2: int
    rx2: int
    tx3: int
    rx3: int
    fpp1_dbm: float
    fpp2_dbm: float
    skew1_ppm: float
    skew2_ppm: float


@dataclass(frozen=True, slots=True)
class TargetRangeReport(RangeReport):
    """S05: the target's report of the same; `neighbour` is the initiator."""

    KEY: ClassVar = b"S05"


@dataclass(frozen=True, slots=True)
class BroadcastSent(Message):
    """R06: answer to C06."""

    KEY: ClassVar = b"R06"


@dataclass(frozen=True, slots=True)
class MaxFrameReport(Message):
    """R07: the longest frame, in bytes."""

    KEY: ClassVar = b"R07"
    FIELDS: ClassVar = {"length": INT}
    length: int


@dataclass(frozen=True, slots=True)
class ResponseDelaySet(Message):
    """R08: answer to C08."""

    KEY: ClassVar = b"R08"


@dataclass(frozen=True, slots=True)
class EnteringBootloader(Message):
    """R09: answer to C09."""

    KEY: ClassVar = b"R09"


@dataclass(frozen=True, slots=True)
class Overheard(Message):
    """S01: an exchange heard by a passive listener.

    Plain stamps, powers and skews are the listener's own; those ending in `_n` came in the frames.
    Zero where there was nothing; `fpp3_dbm` and `skew3_ppm` are None after a single-sided exchange.
    """

    KEY: ClassVar = b"S01"
    FIELDS: ClassVar = {
        **dict.fromkeys(("initiator", "target"), ID),
        **dict.fromkeys(("rx1", "rx2", "rx3"), STAMP),
        **dict.fromkeys(("tx1_n", "rx1_n", "tx2_n", "rx2_n", "tx3_n", "rx3_n"), STAMP),
        **dict.fromkeys(("fpp1_dbm", "fpp2_dbm"), PRINTED),
        "fpp3_dbm": PRINTED_OR_ZERO,
        **dict.fromkeys(("skew1_ppm", "skew2_ppm"), PRINTED),
        "skew3_ppm": PRINTED_OR_ZERO,
        **dict.fromkeys(("fpp1_n_dbm", "fpp2_n_dbm", "skew1_n_ppm", "skew2_n_ppm"), PRINTED),
    }
    initiator: int
    target: int
    rx1: int
    rx2: int
    rx3: int
    tx1_n: int
    rx1_n: int
    tx2_n: int
    rx2_n: int
    tx3_n: int
    rx3_n: int
    fpp1_dbm: float
    fpp2_dbm: float
    fpp3_dbm: float | None
    skew1_ppm: float
    skew2_ppm: float
    skew3_ppm: float | None
    fpp1_n_dbm: float
    fpp2_n_dbm: float
    skew1_n_ppm: float
    skew2_n_ppm: float


@dataclass(frozen=True, slots=True)
class OverheardNothing(Message):
    """S01 with 26 fields, all zero after the ids: the listener missed the response."""

    KEY: ClassVar = b"S01"
    FIELDS: ClassVar = {"initiator": ID, "target": ID}
    ZEROS: ClassVar = 24
    initiator: int
    target: int


@dataclass(frozen=True, slots=True)
class BroadcastReceived(Message):
    """S06: bytes that another board sent to all; the sender is not known."""

    KEY: ClassVar = b"S06"
    FIELDS: ClassVar = {"data": BROADCAST}
    data: bytes


@dataclass(frozen=True, slots=True)
class Cir(Message):
    """S10: a channel impulse response.

    `first_path_milli` is the first path's index times 1000; `magnitudes` has 1016 taps, 1.0016 ns apart.
    """

    KEY: ClassVar = b"S10"
    TAPS: ClassVar = 1016
    FIELDS: ClassVar = {"initiator": ID, "target": ID}
    initiator: int
    target: int
    first_path_milli: int
    magnitudes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class TextLine:
    """A line of plain text that the firmware is known to print; the ending is as it was sent."""

    text: str


@dataclass(frozen=True, slots=True)
class Skipped:
    """Bytes that are no message, and why."""

    data: bytes
    reason: str


def _table(*classes: type[Message]) -> dict[bytes, type[Message]]:
    return {c.KEY: c for c in classes}


COMMANDS: Final = _table(
    SetIdle,
    GetId,
    Reset,
    DoTests,
    SetPassive,
    RangeCommand,
    Broadcast,
    GetMaxFrame,
    SetResponseDelay,
    Bootloader,
)
REPORTS: Final = _table(
    IdleSet,
    IdReport,
    ResetDone,
    TestsDone,
    PassiveSet,
    RangeReport,
    BroadcastSent,
    MaxFrameReport,
    ResponseDelaySet,
    EnteringBootloader,
    Overheard,
    TargetRangeReport,
    BroadcastReceived,
    Cir,
)

_WITH_CRLF: Final = (
    "COMMANDED TASK FAILED AFTER 5 ATTEMPTS.",
    "TWR FAIL: The target ID is the same as the initiator's ID.",
    "WARNING 0xB: TWR message is firing an interrupt when it shouldn't be.",
    "WARNING 0xC: TWR message is firing an interrupt when it shouldn't be.",
)
_BARE: Final = (
    "Unrecognized UWB message type received.",
    "ERROR: Requested to send message over UWB that is too long.",
    "No next key character found.",
    "Failed to detect USB command terminator char! Trying my best",
    "USB Buffer full! Message rejected to prevent overflow.",
    "UWB tag initialized and configured. \n",
)
TEXTS: Final = tuple(t.encode() for t in (*(line + "\r\n" for line in _WITH_CRLF), *_BARE))
"""The lines of text of the firmware, byte for byte; some end without a line end."""
