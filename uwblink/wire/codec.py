"""The codec: messages to bytes and back, and reports of exchanges to columns, without any I/O.

The input are bytes in pieces of any size; the output are messages, known text lines and counted skips, and every byte
is in one of them. A message starts at the beginning, after a decoded message or text, or after a line end. After
damage a message with fields is also decoded in the middle of a line, because the line end before it may be damaged;
one without fields (`R00`) is not, because the payload of a damaged broadcast could contain it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np

from uwblink.errors import FrameError
from uwblink.ticks import REPORT_BITS, TICK_S, elapsed
from uwblink.twr import STAMPS, Exchanges
from uwblink.wire.fields import LONGEST_TEXT, Kind, Malformed, NeedMore
from uwblink.wire.messages import (
    COMMANDS,
    TEXTS,
    Message,
    Overheard,
    OverheardNothing,
    RangeReport,
    Skipped,
    TextLine,
)

Event = Message | TextLine | Skipped

LONGEST_LINE: Final = 8192
"""A CIR with five digits a tap has about 6100 bytes; nothing is longer."""


def encode(message: Message) -> bytes:
    """Return a command or report as the bytes on the wire; raises `FrameError` naming the field."""
    parts = [message.KEY]
    for name, kind in message.FIELDS.items():
        try:
            parts.append(kind.write(getattr(message, name)))
        except FrameError as error:
            raise FrameError(f"{message.KEY.decode()} {name}: {error}") from error
    if isinstance(message, OverheardNothing):
        parts += [b"0"] * message.ZEROS
    return b"|".join(parts) + _terminator(message.KEY)


def _terminator(key: bytes) -> bytes:
    return b"\r" if key in COMMANDS else b"\r\n"


class Decoder:
    """Decodes one direction of one port. `messages` and `skipped_bytes` are counts of the output."""

    def __init__(self, table: Mapping[bytes, type[Message]]) -> None:
        """Decode the messages of `COMMANDS` or of `REPORTS`."""
        self._table = table
        self._terminator = _terminator(next(iter(table)))
        self._texts = TEXTS if self._terminator == b"\r\n" else ()
        self._starts = (*self._texts, *table)
        self._first_byte = re.compile(b"[%s]" % b"".join({re.escape(start[:1]) for start in self._starts}))
        self._longest_start = max(map(len, self._starts))
        self._buffer = b""
        self._before = self._terminator  # the last bytes before the buffer; after something understood, a line end
        self.messages = 0
        self.skipped_bytes = 0

    def feed(self, data: bytes) -> list[Event]:
        """Add bytes and return the events that they complete; never raises an exception."""
        self._buffer += data
        return self._drain(final=False)

    @property
    def begun(self) -> bytes:
        """The key of an incomplete message, empty without one."""
        return self._buffer[:3] if self._clean(b"") else b""

    def finish(self) -> list[Event]:
        """Return the remaining events after the last byte."""
        return self._drain(final=True)

    def _drain(self, *, final: bool) -> list[Event]:
        """Return the events of the buffer, and keep the bytes that need more bytes for a decision.

        Positions are tried in order. The event at a position depends on the bytes before it and on as many after it as
        the decision needs, so events do not depend on how the bytes were divided into pieces.
        """
        events: list[Event] = []
        buffer, start, at = self._buffer, 0, 0  # buffer[start:at] is no message
        while at < len(buffer):
            try:
                event, end = self._understand(buffer, at, clean=self._clean(buffer[max(start, at - 2) : at]))
            except (NeedMore, Malformed) as undecided:
                if isinstance(undecided, NeedMore) and not final:
                    break
                found = self._first_byte.search(buffer, at + 1)
                at = found.start() if found else len(buffer)
                continue
            events += [*self._skip(buffer[start:at]), event]
            self.messages += 1
            self._before = self._terminator
            start = at = end
        events += self._skip(buffer[start:at])
        self._buffer = buffer[at:]
        return events

    def _skip(self, data: bytes) -> list[Event]:
        if not data:
            return []
        self.skipped_bytes += len(data)
        self._before = (self._before + data)[-len(self._terminator) :]
        return [Skipped(data)]

    def _clean(self, skipped: bytes) -> bool:
        """Whether a line ends with the last of these skipped bytes, which may contain a part of the line end."""
        return (self._before + skipped).endswith(self._terminator)

    def _understand(self, buffer: bytes, at: int, *, clean: bool) -> tuple[Event, int]:
        """Return the message or text at a position and its end; raises `NeedMore` or `Malformed`."""
        kind = self._table.get(buffer[at : at + 3])
        if kind is not None and (clean or buffer[at + 3 : at + 4] == b"|"):
            return self._message(kind, buffer, at)
        for text in self._texts:
            if buffer.startswith(text, at):
                return TextLine(text.decode()), at + len(text)
        rest = buffer[at : at + self._longest_start]
        if any(start.startswith(rest) for start in self._starts):
            raise NeedMore
        raise Malformed

    def _message(self, kind: type[Message], buffer: bytes, at: int) -> tuple[Message, int]:
        if any(field.size for field in kind.FIELDS.values()):
            return self._counted(kind, buffer, at)
        end = buffer.find(self._terminator, at + 3, at + LONGEST_LINE)
        if end < 0:
            raise Malformed if len(buffer) - at >= LONGEST_LINE else NeedMore
        return _from_parts(kind, buffer[at + 3 : end].split(b"|")), end + len(self._terminator)

    def _counted(self, kind: type[Message], buffer: bytes, at: int) -> tuple[Message, int]:
        """Read a message whose fields hold arbitrary bytes, one field after the other."""
        values, at = [], at + 3
        for number, field in enumerate(kind.FIELDS.values(), start=1):
            at = _expect(buffer, at, b"|")
            end = self._field_end(field, buffer, at, b"|" if number < len(kind.FIELDS) else self._terminator)
            values.append(field.read(buffer[at:end]))
            at = end
        return kind(*values), _expect(buffer, at, self._terminator)

    def _field_end(self, field: Kind, buffer: bytes, at: int, until: bytes) -> int:
        if field.size:
            end = at + field.size(buffer, at)
            if end > len(buffer):
                raise NeedMore
            return end
        end = buffer.find(until, at, at + LONGEST_TEXT + 1 + len(until))
        if end < 0:
            raise Malformed if len(buffer) - at > LONGEST_TEXT + len(until) else NeedMore
        return end


def _expect(buffer: bytes, at: int, what: bytes) -> int:
    found = buffer[at : at + len(what)]
    if found == what:
        return at + len(what)
    raise NeedMore if what.startswith(found) else Malformed


def _from_parts(kind: type[Message], parts: list[bytes]) -> Message:
    """Build a message from its fields; `parts[0]` is the text between key and first bar."""
    if parts[0]:
        raise Malformed
    if kind is Overheard and len(parts) == 3 + OverheardNothing.ZEROS:
        if parts[3:] != [b"0"] * OverheardNothing.ZEROS:
            raise Malformed
        kind, parts = OverheardNothing, parts[:3]
    values, at = list[Any](), 1
    for field in kind.FIELDS.values():
        values.append(field.read(b"|".join(parts[at : at + field.parts])))
        at += field.parts
    if at != len(parts):
        raise Malformed
    return kind(*values)


def exchanges_of(heard: Iterable[tuple[int, int, Event]]) -> Exchanges:
    """Return the reports of exchanges among messages as columns; a row is (time_ns of the message, board, message).

    The time of an exchange is that of its poll: the report's, less what passed between the initiator's first and
    last stamps. Printing and USB make it late by 0.6 ms.
    """
    rows = [(time_ns, board, event) for time_ns, board, event in heard if isinstance(event, RangeReport)]
    time_ns, board = np.array([row[:2] for row in rows], dtype=np.int64).reshape(-1, 2).T
    column = {name: np.array([getattr(report, name) for *_, report in rows]) for name in RangeReport.FIELDS}
    stamps = {name: column[name].astype(np.int64) for name in STAMPS}
    mine = np.array([report.KEY == RangeReport.KEY for *_, report in rows], dtype=bool)
    other = column["neighbour"].astype(np.int64)
    double = stamps["rx3"] != 0
    last = np.where(double, stamps["rx3"], stamps["rx2"])
    took_ns = np.rint(elapsed(last, stamps["tx1"]) * (TICK_S * 1e9)).astype(np.int64)
    return Exchanges(
        time_ns=time_ns - took_ns,
        initiator=np.where(mine, board, other),
        target=np.where(mine, other, board),
        protocol=np.where(double, "ds", "ss"),
        reporter=board,
        range_m=column["range_m"],
        fpp1_dbm=column["fpp1_dbm"],
        fpp2_dbm=column["fpp2_dbm"],
        skew1_ppm=column["skew1_ppm"],
        skew2_ppm=column["skew2_ppm"],
        truth_m=np.full(len(rows), np.nan),
        bits=REPORT_BITS,
        **stamps,
    )
