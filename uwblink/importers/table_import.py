"""What a table comes to, written some rows at a time, or in memory for those who want it there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.importers.antenna_places import AntennaPlaces
from uwblink.importers.exchange_rows import exchanges_of, plain_ranges, powers_of
from uwblink.importers.staged_tables import StagedTables, Watch
from uwblink.importers.table_rows import RowSource
from uwblink.importers.trials import Reading
from uwblink.importers.unusable import Unusable
from uwblink.importers.usable import Usable
from uwblink.recording.contents import Contents
from uwblink.recording.file import Recording
from uwblink.recording.schema import Fault, Poses, Tag
from uwblink.twr import Exchanges

WRITING_MB: Final = 250
"""Of a recording that is written so much is kept in memory."""

Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True, kw_only=True)
class TableImport:
    """Rows of tables that can be used, and how they are to be read (None: as plain ranges).

    `kind` and `imported_from` (by default the names of the files) are what the recording says it comes from.
    """

    tables: StagedTables
    source: RowSource
    usable: Usable
    unusable: Unusable
    reading: Reading | None
    notes: list[str]
    total: int
    watch: Watch | None = None
    kind: str = "import csv"
    imported_from: str | None = None

    def write(self, path: str | os.PathLike[str], *, force: bool = False) -> tuple[dict[str, int], list[str]]:
        """Write a recording; returns how many rows its tables have, those without any left out, and the notes.

        Raises what `Recording.create` raises.
        """
        meta, faults = self._meta_and_faults()
        places, counts = AntennaPlaces(self.tables.stage), {"exchanges": 0, "poses": 0, "powers": 0, "faults": 0}
        with Recording.create(path, meta=meta, force=force, memory_mb=WRITING_MB) as recording:
            recording.append_tags(self._tags())
            for exchanges, powers in self._exchanges(places):
                with recording.transaction():
                    recording.append_exchanges(exchanges)
                    recording.append_columns("powers", powers)
                counts["exchanges"] += len(exchanges)
                counts["powers"] += len(exchanges) if powers else 0
            for poses in places.poses(self._body):
                recording.append_poses(poses)
                counts["poses"] += len(poses)
            for some in faults:
                recording.append_faults(some)
                counts["faults"] += len(some)
        return {name: n for name, n in counts.items() if n or name == "exchanges"}, meta["notes"]

    def contents(self) -> Contents:
        """Return the same in memory."""
        meta, faults = self._meta_and_faults()
        places = AntennaPlaces(self.tables.stage)
        blocks = list(self._exchanges(places))
        poses = list(places.poses(self._body))
        return Contents(
            exchanges=_as_one([exchanges for exchanges, _ in blocks]),
            tags=self._tags(),
            poses=_poses(poses),
            powers={n: np.concatenate([powers[n] for _, powers in blocks]) for n in blocks[0][1]},
            faults=list(chain.from_iterable(faults)),
            meta=meta,
        )

    def _exchanges(self, places: AntennaPlaces) -> Iterator[tuple[Exchanges, Columns]]:
        """Yield the exchanges in the order of their rows, and their total powers; notes where antennas were."""
        for rows, before in self.usable.of_blocks(self.source.blocks()):
            if self.watch:
                self.watch("writing", before / max(self.usable.count, 1))
            exchanges = exchanges_of(rows, self.reading, before) if self.reading else plain_ranges(rows, before)
            places.add(rows, exchanges, before)
            yield exchanges, powers_of(rows, exchanges)

    def _tags(self) -> list[Tag]:
        return [Tag(i, self._body(i), (0.0, 0.0, 0.0)) for i in self.usable.tags]

    def _body(self, tag: int) -> str:
        return self.tables.names.get(tag, f"tag{tag}")

    def _meta_and_faults(self) -> tuple[dict[str, Any], Iterator[list[Fault]]]:
        notes, faults = list(self.notes), self.tables.faults(self.unusable)
        count = len(self.unusable) + self.tables.too_long()
        if count:
            first = next(faults)
            notes.append(
                f"{count} of {self.total} rows cannot be used and are kept as faults; the first: {first[0].detail}"
            )
            faults = chain([first], faults)
        return self._meta(notes), faults

    def _meta(self, notes: list[str]) -> dict[str, Any]:
        delays, names = self.tables.column_map.antenna_delays, self.tables.names
        if self.reading and self.reading.undelayed:
            delays = {None: {"tx": 0, "rx": 0}}
        meta: dict[str, Any] = {
            "source": self.kind,
            "imported_from": self.imported_from or ", ".join(path.name for path in self.tables.paths),
            "timestamp_bits": self.reading.bits if self.reading else 32,
            "notes": notes,
        }
        if names:
            meta["tag_names"] = {str(number): name for number, name in sorted(names.items())}
        if delays:
            meta["configured_antenna_delay_ticks"] = delays[None]
            own = {str(tag): registers for tag, registers in delays.items() if tag is not None}
            if own:
                meta["configured_antenna_delay_ticks_by_tag"] = own
        return meta


def _as_one(parts: list[Exchanges]) -> Exchanges:
    if len(parts) == 1:
        return parts[0]
    columns: dict[str, Any] = {n: np.concatenate([getattr(p, n) for p in parts]) for n in parts[0].to_dict()}
    return Exchanges(bits=parts[0].bits, **columns)


def _poses(parts: list[Poses]) -> Poses:
    none = Poses(np.empty(0, np.int64), np.empty(0, np.str_), np.empty((0, 3)), np.empty((0, 4)))
    columns = zip(*((p.time_ns, p.body, p.position_m, p.quaternion) for p in [none, *parts]), strict=True)
    return Poses(*(np.concatenate(column) for column in columns))
