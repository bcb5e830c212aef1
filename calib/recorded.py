"""Ranges of a recording, read some exchanges at a time: of poses only those around them are in memory.

What comes out is what `Ranges.from_exchanges` makes of all exchanges and all poses, without those that cannot be used.
"""

from __future__ import annotations

from collections import Counter
from hashlib import sha256
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.carriers import Asked
from calib.long_columns import ROWS_AT_ONCE, empty, let_go, put
from calib.planted import check_planted
from calib.range_columns import columns_of
from calib.ranges import COLUMNS, Ranges, antenna_delays_in, bodies_of, usable_rows
from calib.single_sided import Terms, left_in, skew_terms
from uwblink.recording.file import Recording
from uwblink.recording.target_reports import single_exchange_blocks
from uwblink.twr import Exchanges, names_in

FINGERPRINT: Final = 32
"""Digits of a hash that tells exchanges from all others."""

EXCHANGES_AT_ONCE: Final = 131_072


class _Columns:
    """Columns of ranges that grow by some at a time, to no more than so many."""

    def __init__(self, most: int) -> None:
        self._most, self.length = most, 0
        self._words: set[str] = set()
        kinds = dict.fromkeys(COLUMNS, np.float64) | dict.fromkeys(("time_ns", "initiator", "target"), np.int64)
        self._room = {name: empty(most, kind) for name, kind in kinds.items() if name not in ("protocol", "session")}
        self._protocol: NDArray[np.str_] | None = None

    def add(self, some: Ranges) -> None:
        rows = slice(self.length, self.length + len(some))
        for name, column in self._room.items():
            put(column, rows, getattr(some, name))
        self._add_words(some.protocol, rows)
        self.length += len(some)

    def _add_words(self, words: NDArray[np.str_], rows: slice) -> None:
        """Keep protocols; as long as all are one it is kept once."""
        before = set(self._words)
        self._words |= set(names_in(words))
        if len(self._words) < 2:
            return
        wanted = np.dtype(f"U{max(map(len, self._words))}")
        if self._protocol is None or self._protocol.dtype.itemsize < wanted.itemsize:
            room = empty(self._most, wanted)
            room[: rows.start] = next(iter(before), "") if self._protocol is None else self._protocol[: rows.start]
            self._protocol = room
        put(self._protocol, rows, words)

    def found(self) -> dict[str, Any]:
        """Return the columns."""
        found: dict[str, Any] = {name: column[: self.length] for name, column in self._room.items()}
        if self._protocol is None:
            one = np.array(next(iter(self._words), ""))
            return found | {"protocol": np.broadcast_to(one, self.length)}
        return found | {"protocol": self._protocol[: self.length]}


def read_ranges(recording: Recording, name: str, *, need_power: bool, rows: int = EXCHANGES_AT_ONCE) -> Ranges | None:
    """Return the ranges of a recording that can be used, reading so many `rows` at once.

    Of an exchange that both ends reported one report counts. None where none can be used, and why is a matter of all.
    """
    reading = _Reading(recording, need_power=need_power)
    for block in single_exchange_blocks(recording, rows):
        if len(block):
            reading.add(block)
    return reading.ranges(name)


class _Reading:
    """What becomes of exchanges as they are read."""

    def __init__(self, recording: Recording, *, need_power: bool) -> None:
        self._need_power, self._count, self._excluded = need_power, 0, Counter[str]()
        most = recording.count("exchanges")
        self._columns, self._range_m = _Columns(most), empty(most)
        self._times, self._terms, self._asked = sha256(), list[Terms](), Asked()
        self._tags, self._windows = recording.tags(), recording.pose_windows()
        meta = recording.meta()
        self._delays = antenna_delays_in(meta, recording.path.name)
        planted = meta.get("planted")
        self._planted = planted if isinstance(planted, dict) and planted else None

    def add(self, block: Exchanges) -> None:
        """Take some more exchanges."""
        complete = bool(np.isfinite(block.truth_m).all())
        for part, poses in [(block, None)] if complete else self._windows.tracks_beside(block):
            self._keep(columns_of(part, part.truth_m, poses, self._tags))
        self._times.update(np.ascontiguousarray(block.time_ns).data)
        put(self._range_m, slice(self._count, self._count + len(block)), block.range_m)
        self._count += len(block)
        self._terms.append(skew_terms(block))
        self._asked.add(block)

    def _keep(self, columns: dict[str, Any]) -> None:
        some = Ranges(source="", excluded={}, planted=None, **columns)
        usable = usable_rows(some, need_power=self._need_power)
        self._columns.add(some if usable.keep.all() else some[usable.keep])
        self._excluded.update(usable.excluded)

    def ranges(self, name: str) -> Ranges | None:
        """Return what can be used of all that was taken, None where nothing can; raises what `check_planted` raises."""
        if not self._columns.length:
            return None
        if self._planted is not None:
            check_planted(self._planted, name)
        found = self._times
        for begin in range(0, self._count, ROWS_AT_ONCE):
            found.update(np.ascontiguousarray(self._range_m[begin : min(begin + ROWS_AT_ONCE, self._count)]).data)
            let_go(self._range_m)
        return Ranges(
            source=name,
            excluded={reason: self._excluded[reason] for reason in self._excluded if self._excluded[reason]},
            planted=self._planted,
            left_skew=left_in(self._terms),
            clocks_apart=self._asked.apart(),
            bodies=bodies_of(self._tags),
            antenna_delays=self._delays,
            recordings=((name, found.hexdigest()[:FINGERPRINT]),),
            **self._columns.found(),
        )
