"""From bytes to columns: reports of exchanges, many at a time.

Runs of well-formed reports are checked by one regular expression and converted together; everything else goes
through the message decoder, so that what is a message does not depend on the way it was read.
"""

from __future__ import annotations

import re
from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.ticks import REPORT_BITS, TICK_S, elapsed
from uwblink.twr import STAMPS, Exchanges
from uwblink.wire.codec import Decoder, Event
from uwblink.wire.messages import REPORTS, RangeReport


def _run_of_reports() -> re.Pattern[bytes]:
    board, stamp = rb"(?:25[0-5]|2[0-4][0-9]|1[0-9][0-9]|[1-9]?[0-9])", rb"(?:0|[1-9][0-9]{0,9}+)"
    number = rb"-?(?:0|[1-9][0-9]{0,9}+)\.[0-9]{4}"
    line = rb"[RS]05\|" + rb"\|".join([board, number, *[stamp] * 6, *[number] * 4]) + rb"\r\n"
    return re.compile(rb"(?:" + line + rb")++")


RUN: Final = _run_of_reports()
"""Well-formed reports one after the other; stamps may still have more than 32 bits."""

FIELDS: Final = tuple(RangeReport.FIELDS)


class ColumnDecoder:
    """Decodes what a board sends. Ranges are gathered for `exchanges`, everything else is in `events`."""

    def __init__(self, board: int) -> None:
        """Decode for the board with this id."""
        self.decoder = Decoder(REPORTS)
        self.events: list[tuple[int, Event]] = []
        self._board = board
        self._times: list[Ints] = []
        self._values: list[Floats] = []

    def feed(self, data: bytes, time_ns: int) -> None:
        """Take in bytes that came at a time; never raises on any bytes."""
        data = self.decoder.take_back() + data
        at = 0
        while at < len(data):
            run = RUN.match(data, at) if self.decoder.between_messages else None
            if run and self._take(run.group(), time_ns):
                at = run.end()
                continue
            end = data.find(b"\n", at) + 1 or len(data)
            self._events(self.decoder.feed(data[at:end]), time_ns)
            at = end

    def finish(self, time_ns: int) -> None:
        """Decode what is left when no more bytes will come."""
        self._events(self.decoder.finish(), time_ns)

    def exchanges(self) -> Exchanges:
        """Return the exchanges so far, in the order of their reports."""
        values = np.concatenate(self._values) if self._values else np.empty((0, 1 + len(FIELDS)))
        times = np.concatenate(self._times) if self._times else np.empty(0, dtype=np.int64)
        return _exchanges(times, np.full(len(times), self._board, dtype=np.int64), values)

    def _take(self, lines: bytes, time_ns: int) -> bool:
        """Convert a run of lines; False where a stamp has more than 32 bits, which the expression cannot see."""
        numbers = lines.replace(b"R05|", b"1|").replace(b"S05|", b"0|").replace(b"\r\n", b"|")
        values = np.fromstring(numbers[:-1].decode("ascii"), sep="|").reshape(-1, 1 + len(FIELDS))
        if values[:, 3:9].max() >= 1 << REPORT_BITS:
            return False
        self.decoder.messages += len(values)
        self._values.append(values)
        self._times.append(np.full(len(values), time_ns, dtype=np.int64))
        return True

    def _events(self, events: list[Event], time_ns: int) -> None:
        ranged = [e for e in events if isinstance(e, RangeReport)]
        if ranged:
            self._values.append(_values(ranged))
            self._times.append(np.full(len(ranged), time_ns, dtype=np.int64))
        self.events += [(time_ns, e) for e in events if not isinstance(e, RangeReport)]


def exchanges_of(rows: list[tuple[int, int, RangeReport]]) -> Exchanges:
    """Return reports as columns; each row is (time_ns of the report, board, report)."""
    time_ns, board, reports = zip(*rows, strict=True)
    return _exchanges(np.array(time_ns, dtype=np.int64), np.array(board, dtype=np.int64), _values(list(reports)))


def _values(reports: list[RangeReport]) -> Floats:
    return np.array([[r.KEY == b"R05", *(getattr(r, name) for name in FIELDS)] for r in reports], dtype=float)


def _exchanges(time_ns: Ints, board: Ints, values: Floats) -> Exchanges:
    """Name the columns of reports (n, 13): whose report it is, then the fields of R05.

    The time of an exchange is that of its poll: the report's, less what passed between the initiator's first and
    last stamps. Printing and USB make it late by 0.6 ms.
    """
    column = dict(zip(FIELDS, values[:, 1:].T, strict=True))
    stamps = {name: column[name].astype(np.int64) for name in STAMPS}
    mine, other = values[:, 0] == 1, column["neighbour"].astype(np.int64)
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
        truth_m=np.full(len(values), np.nan),
        bits=REPORT_BITS,
        **stamps,
    )
