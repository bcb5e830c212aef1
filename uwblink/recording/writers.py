"""What writes rows into a recording: a method a table."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwblink.errors import RecordingError
from uwblink.recording.schema import TABLES, Arrangement, CirRow, Fault, FrameRow, KnownDistance, Poses, Tag
from uwblink.recording.store import Store
from uwblink.twr import COLUMNS, Exchanges


class TableWriters:
    """Appends to the tables of an open recording; each method raises `RecordingError` where it cannot."""

    _store: Store
    path: Path

    def append_meta(self, meta: Mapping[str, Any]) -> None:
        """Add entries to `meta`, replacing those with the same key; values are stored as JSON."""
        for key, value in meta.items():
            try:
                text = json.dumps(value, sort_keys=True, allow_nan=False)
            except (TypeError, ValueError) as error:
                raise RecordingError(f"{self.path}: meta {key!r}: cannot be stored as JSON ({error})") from error
            self._store.execute("DELETE FROM meta WHERE key = ?", [key])
            self._store.execute("INSERT INTO meta VALUES (?, ?)", [key, text])

    def append_tags(self, tags: Iterable[Tag]) -> None:
        """Add tags with their bodies and lever arms."""
        for t in tags:
            self._store.insert_row("tags", [t.tag, t.body, *t.lever_arm_m])

    def append_exchanges(self, exchanges: Exchanges) -> None:
        """Add exchanges, in one transaction."""
        self._store.insert("exchanges", {name: getattr(exchanges, name) for name in COLUMNS})

    def append_poses(self, poses: Poses) -> None:
        """Add poses, in one transaction."""
        self._store.insert("poses", poses.to_dict())

    def append_faults(self, faults: Iterable[Fault]) -> None:
        """Add faults, in one transaction."""
        rows = list(faults)
        columns = {n: np.array([getattr(r, n) for r in rows]) for n in ("time_ns", "board", "kind", "detail")}
        columns |= {n: _optional([getattr(r, n) for r in rows]) for n in ("initiator", "target")}
        self._store.insert("faults", columns)

    def append_arrangements(self, arrangements: Iterable[Arrangement]) -> None:
        """Add stretches of time in which boards stood still."""
        for a in arrangements:
            known = " ".join([a.known, *map(str, a.order)])
            self._store.insert_row("arrangements", [a.start_ns, a.end_ns, a.name, known])

    def append_distances(self, distances: Iterable[KnownDistance]) -> None:
        """Add distances that were measured otherwise."""
        for d in distances:
            self._store.insert_row("distances", [d.first, d.second, d.distance_m, d.sigma_m, d.arrangement])

    def append_frames(self, rows: Iterable[FrameRow]) -> None:
        """Add raw bytes, in one transaction."""
        listed = list(rows)
        if listed:
            raw = np.empty(len(listed), dtype=object)
            raw[:] = [row.data for row in listed]
            columns = {n: np.array([getattr(row, n) for row in listed]) for n in ("time_ns", "board", "direction")}
            self._store.insert("frames", columns | {"bytes": raw})

    def append_overheard(self, rows: Iterable[Mapping[str, float]]) -> None:
        """Add passively heard exchanges, one mapping of the table's columns each; NaN where there was nothing."""
        listed = list(rows)
        if listed:
            self._store.insert("overheard", {n: np.array([row[n] for row in listed]) for n in TABLES["overheard"]})

    def append_columns(self, table: str, columns: Mapping[str, NDArray[Any]]) -> None:
        """Add rows to one of `TABLES` from columns with its names, in one transaction; none where there are none."""
        if columns:
            self._store.insert(table, columns)

    def append_cirs(self, rows: Iterable[CirRow]) -> None:
        """Add impulse responses, in one transaction."""
        listed = list(rows)
        if listed:
            *plain, last = TABLES["cirs"]
            taps = np.empty(len(listed), dtype=object)
            taps[:] = [list(row.magnitudes) for row in listed]
            columns = {name: np.array([getattr(row, name) for row in listed]) for name in plain}
            self._store.insert("cirs", columns | {last: taps})

    def transaction(self) -> AbstractContextManager[None]:
        """Have everything appended in the block written at once, or not at all; raises `RecordingError`."""
        return self._store.transaction()

    def replace_poses(self, poses: Poses, meta: Mapping[str, Any], tags: Iterable[Tag] | None = None) -> None:
        """Put poses, and tags where given, in place of those there are."""
        with self.transaction():
            self._store.execute("DELETE FROM poses")
            self.append_poses(poses)
            self.append_meta(meta)
            if tags is not None:
                self._store.execute("DELETE FROM tags")
                self.append_tags(tags)


def _optional(values: list[int | None]) -> NDArray[Any]:
    """Return whole numbers, masked where there is none."""
    return np.ma.array([0 if v is None else v for v in values], mask=[v is None for v in values], dtype=np.int64)
