"""Exchanges and poses of a recording some rows at a time, for those who need not have all of them in memory at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.errors import RecordingError
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.schema import Poses
from uwblink.recording.store import Store
from uwblink.recording.tracks import POSE, Track, Tracks
from uwblink.ticks import TICK_S
from uwblink.twr import COLUMNS, Exchanges

ROWS_AT_ONCE: Final = 131_072
"""A little more than DuckDB keeps together."""

POSES_AT_ONCE: Final = 500_000

MARGIN_NS: Final = 1_000_000_000
"""Poses are looked for so far before and after a stretch of time, and farther where a body has none there."""

LEAP_NS: Final = 60_000_000_000
MOST_LEAPS: Final = 50
"""Times that are farther apart stand in stretches of their own; more of them in a block are how it was recorded."""


def read_exchanges(store: Store, bits: int, where: str = "") -> Exchanges:
    """Return exchanges in the order in which they were written; raises `RecordingError`."""
    plain = ", ".join(name for name in COLUMNS if name != "protocol")
    # Those of other distributions are looked for only where the ones in use do not suffice.
    for known in ((row.name for row in PROTOCOLS.known()), PROTOCOLS):
        names = sorted(known)
        listed = ", ".join(f"'{name}'" for name in names)
        query = f"SELECT {plain}, list_position([{listed}], protocol)::TINYINT AS protocol FROM exchanges {where}"  # noqa: S608 - names are checked words
        rows = store.read(query)
        code = rows.pop("protocol")
        if not np.ma.is_masked(code):
            break
    else:
        raise RecordingError(f"{store.path}: exchanges of an unknown protocol; known are {', '.join(names)}")
    columns = {name: filled(rows[name]) for name in rows}
    protocol = np.array(names)[np.asarray(code, dtype=np.int64) - 1]
    return Exchanges(protocol=protocol, bits=bits, **columns)


def exchange_blocks(store: Store, bits: int, rows: int) -> Iterator[Exchanges]:
    """Yield exchanges in the order in which they were written, so many `rows` of the table at once."""
    (last,) = store.read("SELECT max(rowid) AS last FROM exchanges")["last"]
    for start in range(0, 0 if last is np.ma.masked else int(last) + 1, rows):
        yield read_exchanges(store, bits, f"WHERE rowid >= {start} AND rowid < {start + rows}")


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Poses in the order in which they were written: times (n,), columns of `POSE` (n,), and whose, as a code (n,).

    `codes` are those of the bodies that are asked for.
    """

    time_ns: Ints
    columns: dict[str, Floats]
    code: NDArray[np.uint64]
    codes: dict[str, int]

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.time_ns)

    def times(self, body: str) -> Ints:
        """Return the times of a body's poses."""
        return np.asarray(self.time_ns[self.code == self.codes[body]])

    def tracks(self) -> Tracks:
        """Return the tracks of the bodies that have poses."""
        rows = {body: np.flatnonzero(self.code == code) for body, code in self.codes.items()}
        return {
            body: Track(self.time_ns[own], [self.columns[name][own] for name in POSE])
            for body, own in rows.items()
            if len(own)
        }

    def poses(self) -> Poses:
        """Return all poses in order of time."""
        time_ns, names = self.time_ns, np.array([*self.codes], dtype=np.str_)
        order: Ints | slice = slice(None)
        if np.any(time_ns[1:] < time_ns[:-1]):
            order = np.argsort(time_ns, kind="stable")
        codes = np.array([*self.codes.values()], dtype=np.uint64)
        ascending = np.argsort(codes)
        return Poses(
            time_ns=time_ns[order],
            body=names[ascending][np.searchsorted(codes[ascending], self.code[order])],
            position_m=np.column_stack([self.columns[name][order] for name in POSE[:3]]),
            quaternion=np.column_stack([self.columns[name][order] for name in POSE[3:]]),
        )


class PoseWindows:
    """The poses of a recording by stretches of time; `spans` are first and last time, and number, of each body's."""

    def __init__(self, store: Store) -> None:
        """Read from an open file; raises `RecordingError` for a body without a name, or without any time."""
        self._store = store
        # Numbers instead of words: words of millions of rows take longer than everything else.
        rows = store.rows("SELECT hash(body), body, min(time_ns), max(time_ns), count(*) FROM poses GROUP BY body")
        if any(None in row for row in rows):
            raise RecordingError(f"{store.path}: table poses: a body without a name, or none of whose poses has a time")
        self._codes = {str(row[1]): int(row[0]) for row in rows}
        self.spans = {str(body): (int(first), int(last), int(count)) for _, body, first, last, count in rows}

    def beside(self, exchanges: Exchanges) -> Iterator[tuple[Exchanges, Poses]]:
        """Yield exchanges in parts, in their order, each with the poses between which its ranges are.

        There are as many parts as it takes that none has more than about half a million poses around it.
        """
        for part, window in self._windows(exchanges):
            yield part, window.poses()

    def tracks_beside(self, exchanges: Exchanges) -> Iterator[tuple[Exchanges, Tracks]]:
        """Yield the same parts, with these poses as those of each body, for distances."""
        for part, window in self._windows(exchanges):
            yield part, window.tracks()

    def _windows(self, exchanges: Exchanges) -> Iterator[tuple[Exchanges, Window]]:
        if not len(exchanges):
            return
        # A range belongs to the middle of its first two messages, which is after its time, by half a wrap at most.
        later = int(2**exchanges.bits * TICK_S * 0.5e9) + 1
        for begin, end in pairwise([0, *_leaps(exchanges.time_ns), len(exchanges)]):
            some = exchanges if end - begin == len(exchanges) else exchanges[begin:end]
            for part in self._parts(some):
                yield part, self.window(int(part.time_ns.min()), int(part.time_ns.max()) + later)

    def _parts(self, exchanges: Exchanges) -> Iterator[Exchanges]:
        """Yield exchanges in as many parts as it takes that none has many poses around it."""
        expected = self._expected(int(exchanges.time_ns.min()), int(exchanges.time_ns.max()))
        parts = min(int(expected / POSES_AT_ONCE) + 1, len(exchanges))
        for begin, end in pairwise((np.arange(parts + 1) * len(exchanges) // parts).tolist()):
            yield exchanges[begin:end]

    def _expected(self, start_ns: int, end_ns: int) -> float:
        """Return about how many poses there are in a stretch of time, if those of a body lie evenly."""
        shared = ((min(last, end_ns) - max(first, start_ns), last - first, n) for first, last, n in self.spans.values())
        return sum(count * max(inside, 0) / whole for inside, whole, count in shared if whole)

    def around(self, start_ns: int, end_ns: int) -> Poses:
        """Return the poses from `start_ns` to `end_ns`, and those next to them on either side, in order of time.

        In between positions are what they are between all poses: of a body that has any on both sides of a time the
        nearest are there, of one that does not move its only one, and of one that has none at these times none.
        """
        return self.window(start_ns, end_ns).poses()

    def window(self, start_ns: int, end_ns: int) -> Window:
        """Return the same poses as they were written."""
        here = [body for body, span in self.spans.items() if span[2] == 1 or _meet(span, start_ns, end_ns)]
        margin = MARGIN_NS
        while True:
            found = self._between(start_ns - margin, end_ns + margin, here)
            if all(self._reached(found, body, start_ns, end_ns) for body in here):
                return found
            margin *= 8

    def _reached(self, found: Window, body: str, start_ns: int, end_ns: int) -> bool:
        """Return whether poses of a body lie on both sides of a stretch of time, as far as it has any there."""
        first, last, count = self.spans[body]
        time = found.times(body)
        if count == 1 or len(time) < 2:
            return len(time) == count
        return bool(time.min() <= max(start_ns, first) and time.max() >= min(end_ns, last))

    def _between(self, start_ns: int, end_ns: int, bodies: list[str]) -> Window:
        """Return the poses of some bodies from one time to another, and of those that have only one that one."""
        still = [span[0] for span in self.spans.values() if span[2] == 1]
        alone = "".join(f" OR time_ns = {time}" for time in still)
        # Numbers instead of words: words of millions of rows take longer than everything else. Without an order asked
        # for rows come as they were written, mostly in order of time; sorting here takes twice the time.
        wanted = f"time_ns, {', '.join(POSE)}, hash(body) AS code"
        query = f"SELECT {wanted} FROM poses WHERE time_ns BETWEEN {start_ns} AND {end_ns}{alone}"  # noqa: S608 - numbers
        r = {name: filled(column) for name, column in self._store.read(query).items()}
        codes = {body: self._codes[body] for body in bodies}
        code = r["code"].view(np.uint64)
        if len(bodies) < len(self._codes):
            mine = np.isin(code, np.array([*codes.values()], dtype=np.uint64))
            r, code = {name: column[mine] for name, column in r.items()}, code[mine]
        return Window(time_ns=r["time_ns"], columns={name: r[name] for name in POSE}, code=code, codes=codes)


def _leaps(time_ns: Ints) -> list[int]:
    """Return where times (n,) leap, as where a clock was set: one that stands elsewhere would have all poses between.

    Nowhere where they leap often, as in a recording of few exchanges.
    """
    found = np.flatnonzero(np.abs(np.diff(time_ns)) > LEAP_NS) + 1
    return found.tolist() if len(found) <= MOST_LEAPS else []


def _meet(span: tuple[int, int, int], start_ns: int, end_ns: int) -> bool:
    first, last, _ = span
    return start_ns <= last and end_ns >= first


def filled(column: NDArray[Any]) -> NDArray[Any]:
    """Return a column in which nulls are NaN in floats and zero in integers."""
    kind = np.float64 if column.dtype.kind == "f" else np.int64
    if isinstance(column, np.ma.MaskedArray):
        column = column.filled(np.nan if column.dtype.kind == "f" else 0)
    return np.asarray(column, dtype=kind)
