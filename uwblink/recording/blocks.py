"""Exchanges and poses of a recording some rows at a time, for those who need not have all of them in memory at once."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.errors import RecordingError
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.schema import Poses
from uwblink.recording.store import Store
from uwblink.ticks import TICK_S
from uwblink.twr import COLUMNS, Exchanges

ROWS_AT_ONCE: Final = 131_072
"""A little more than DuckDB keeps together."""

POSES_AT_ONCE: Final = 500_000

MARGIN_NS: Final = 1_000_000_000
"""Poses are looked for so far before and after a stretch of time, and farther where a body has none there."""


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
        yield read_exchanges(store, bits, f"WHERE rowid >= {start} AND rowid < {start + rows} ORDER BY rowid")


class PoseWindows:
    """The poses of a recording by stretches of time; `spans` are first and last time, and number, of each body's."""

    def __init__(self, store: Store) -> None:
        """Read from an open file; raises `RecordingError` for a body without a name, or without any time."""
        self._store = store
        # Numbers instead of words: words of millions of rows take longer than everything else.
        rows = store.rows("SELECT hash(body), body, min(time_ns), max(time_ns), count(*) FROM poses GROUP BY body")
        if any(None in row for row in rows):
            raise RecordingError(f"{store.path}: table poses: a body without a name, or none of whose poses has a time")
        rows.sort()
        self._codes = np.array([row[0] for row in rows], dtype=np.uint64)
        self._names = np.array([str(row[1]) for row in rows], dtype=np.str_)
        self.spans = {str(body): (int(first), int(last), int(count)) for _, body, first, last, count in rows}

    def beside(self, exchanges: Exchanges) -> Iterator[tuple[Exchanges, Poses]]:
        """Yield exchanges in parts, in their order, each with the poses between which its ranges are.

        There are as many parts as it takes that none has more than about half a million poses around it.
        """
        if not len(exchanges):
            return
        # A range belongs to the middle of its first two messages, which is after its time, by half a wrap at most.
        later = int(2**exchanges.bits * TICK_S * 0.5e9) + 1
        expected = self._expected(int(exchanges.time_ns.min()), int(exchanges.time_ns.max()))
        parts = min(int(expected / POSES_AT_ONCE) + 1, len(exchanges))
        for begin, end in pairwise((np.arange(parts + 1) * len(exchanges) // parts).tolist()):
            part = exchanges[begin:end]
            yield part, self.around(int(part.time_ns.min()), int(part.time_ns.max()) + later)

    def _expected(self, start_ns: int, end_ns: int) -> float:
        """Return about how many poses there are in a stretch of time, if those of a body lie evenly."""
        shared = ((min(last, end_ns) - max(first, start_ns), last - first, n) for first, last, n in self.spans.values())
        return sum(count * max(inside, 0) / whole for inside, whole, count in shared if whole)

    def around(self, start_ns: int, end_ns: int) -> Poses:
        """Return the poses from `start_ns` to `end_ns`, and those next to them on either side, in order of time.

        In between positions are what they are between all poses: of a body that has any on both sides of a time the
        nearest are there, of one that does not move its only one, and of one that has none at these times none.
        """
        here = [body for body, span in self.spans.items() if span[2] == 1 or _meet(span, start_ns, end_ns)]
        margin = MARGIN_NS
        while True:
            found = self._between(start_ns - margin, end_ns + margin, here)
            if all(self._reached(found, body, start_ns, end_ns) for body in here):
                return found
            margin *= 8

    def _reached(self, found: Poses, body: str, start_ns: int, end_ns: int) -> bool:
        """Return whether poses of a body lie on both sides of a stretch of time, as far as it has any there."""
        first, last, count = self.spans[body]
        time = found.time_ns[found.body == body]
        if count == 1 or len(time) < 2:
            return len(time) == count
        return bool(time[0] <= max(start_ns, first) and time[-1] >= min(end_ns, last))

    def _between(self, start_ns: int, end_ns: int, bodies: list[str]) -> Poses:
        """Return the poses of some bodies from one time to another, and of those that have only one that one."""
        still = [span[0] for span in self.spans.values() if span[2] == 1]
        alone = "".join(f" OR time_ns = {time}" for time in still)
        query = f"SELECT *, hash(body) AS code FROM poses WHERE time_ns BETWEEN {start_ns} AND {end_ns}{alone}"  # noqa: S608 - numbers
        r = self._store.read(f"SELECT * EXCLUDE (body) FROM ({query}) ORDER BY time_ns")  # noqa: S608 - as above
        name = self._names[np.searchsorted(self._codes, filled(r["code"]).view(np.uint64))]
        mine = np.isin(name, bodies)
        return Poses(
            time_ns=filled(r["time_ns"])[mine],
            body=name[mine],
            position_m=np.column_stack([filled(r[c]) for c in ("x", "y", "z")])[mine],
            quaternion=np.column_stack([filled(r[c]) for c in ("qx", "qy", "qz", "qw")])[mine],
        )


def _meet(span: tuple[int, int, int], start_ns: int, end_ns: int) -> bool:
    first, last, _ = span
    return start_ns <= last and end_ns >= first


def filled(column: NDArray[Any]) -> NDArray[Any]:
    """Return a column in which nulls are NaN in floats and zero in integers."""
    kind = np.float64 if column.dtype.kind == "f" else np.int64
    if isinstance(column, np.ma.MaskedArray):
        column = column.filled(np.nan if column.dtype.kind == "f" else 0)
    return np.asarray(column, dtype=kind)
