"""Where a table says that antennas were, as poses: one a time, and one alone for what never moves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np

from uwblink.importers.column_map import POSITIONS
from uwblink.importers.staging import Kept, Stage
from uwblink.importers.table_rows import Rows
from uwblink.recording.schema import Poses
from uwblink.twr import Exchanges

POSES_AT_ONCE: Final = 200_000

_COLUMNS: Final = ("time_ns", "tag", "place", "x", "y", "z")


class AntennaPlaces:
    """Places of antennas as rows come, put aside; `poses` says what they come to."""

    def __init__(self, stage: Stage) -> None:
        """Begin with none."""
        self._stage = stage
        kinds = zip(_COLUMNS, ("BIGINT",) * 3 + ("DOUBLE",) * 3, strict=True)
        nothing = ", ".join(f"CAST(0 AS {kind}) AS {name}" for name, kind in kinds)
        self._kept = stage.keep(f"SELECT {nothing} WHERE false", (), _COLUMNS)

    def add(self, rows: Rows, exchanges: Exchanges, before: int) -> None:
        """Note where both antennas of each row were, as far as that is known; `before` rows came already."""
        if not all(name in rows.cells for name in POSITIONS):
            return
        # Of two places at a time the first counts, those of initiators before those of targets.
        for end, ids, first in (("from", exchanges.initiator, 0), ("to", exchanges.target, 1 << 62)):
            at = [rows.cells[f"{end}_{axis}_m"] for axis in "xyz"]
            known = np.flatnonzero(np.isfinite(at).all(axis=0))
            columns = [exchanges.time_ns, ids, first + before + np.arange(len(rows)), *at]
            self._stage.add(self._kept, {n: c[known] for n, c in zip(_COLUMNS, columns, strict=True)})

    def poses(self, body: Callable[[int], str]) -> Iterator[Poses]:
        """Yield the poses in order of time, some at a time; `body` says what carries a tag."""
        one = ", ".join(f"arg_min({axis}, place) AS {axis}" for axis in "xyz")
        table = self._kept.table
        query = f"SELECT time_ns, tag, {one} FROM {table} GROUP BY time_ns, tag"  # noqa: S608 - names of ours
        single = self._stage.keep(query, (), ("time_ns", "tag", "x", "y", "z"))
        moves = " OR ".join(f"min({axis}) <> max({axis})" for axis in "xyz")
        query = (
            f"SELECT p.* FROM {single.table} p JOIN (SELECT tag, min(time_ns) AS first, {moves} AS moves "  # noqa: S608 - as above
            f"FROM {single.table} GROUP BY tag) t ON p.tag = t.tag AND (t.moves OR p.time_ns = t.first) "
            "ORDER BY p.time_ns, p.tag"
        )
        yield from _read(self._stage.keep(query, (), single.columns), body)


def _read(kept: Kept, body: Callable[[int], str]) -> Iterator[Poses]:
    for start in range(0, kept.count, POSES_AT_ONCE):
        found = {name: np.ma.getdata(c) for name, c in kept.between(start, start + POSES_AT_ONCE, kept.columns).items()}
        tags, which = np.unique(found["tag"], return_inverse=True)
        names = np.array([body(int(tag)) for tag in tags])
        level = np.tile([0.0, 0.0, 0.0, 1.0], (len(which), 1))
        yield Poses(found["time_ns"], names[which], np.column_stack([found[a] for a in "xyz"]), level)
