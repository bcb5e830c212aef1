"""Contents of a recording in memory: the whole recording, a selection, or pieces of time."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwblink import arrays
from uwblink.arrays import Bools, Floats, Ints
from uwblink.display import as_html, first_few, printable
from uwblink.errors import ArgumentError
from uwblink.recording.distances import distances_m, poses_around, tracks_of
from uwblink.recording.file import Recording
from uwblink.recording.schema import Arrangement, CirRow, Fault, FrameRow, KnownDistance, Poses, Tag
from uwblink.recording.summary import counted
from uwblink.ticks import TICK_S
from uwblink.twr import LARGEST_ID, LATEST_NS, Exchanges, range_ns

Row = TypeVar("Row", CirRow, FrameRow, Fault)

READING_MB: Final = 300
"""Memory limit for files that are read in pieces; by default DuckDB would cache the whole file."""


@dataclass(frozen=True, kw_only=True)
class Contents:
    """The contents of a recording; all fields but the exchanges are optional.

    `overheard`, `imu`, `height`, `powers`, `quality`, `temperature`, `receptions`, `differences` and `corrected` are
    columns by name, those of the tables with these names; `meta` are the entries of the table `meta`.

    >>> from uwblink import Contents, Exchanges, Tag
    >>> x = Exchanges.from_arrays([1, 2], [2, 3], tx1=[0, 9], rx1=[5, 3], tx2=[1005, 1003], rx2=[3000, 3009])
    >>> mine = Contents(exchanges=x, tags=[Tag(1, "a", (0, 0, 0)), Tag(2, "b", (0, 0, 0)), Tag(3, "b", (0, 0, 0))])
    >>> len(mine.select(tags=[1, 2]).exchanges), len(mine.select(pairs=[(2, 3)]).exchanges)
    (1, 1)
    """

    exchanges: Exchanges
    tags: list[Tag] = field(default_factory=list)
    poses: Poses = field(default_factory=lambda: Poses.from_arrays([], "", (0.0, 0.0, 0.0)))
    overheard: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    imu: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    height: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    powers: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    quality: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    temperature: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    receptions: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    differences: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    corrected: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    cirs: list[CirRow] = field(default_factory=list)
    frames: list[FrameRow] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)
    arrangements: list[Arrangement] = field(default_factory=list)
    known_distances: list[KnownDistance] = field(default_factory=list)
    meta: Mapping[str, Any] = field(default_factory=dict)

    def select(
        self,
        *,
        start_s: float | None = None,
        stop_s: float | None = None,
        tags: Collection[int] | None = None,
        pairs: Iterable[tuple[int, int]] | None = None,
    ) -> Contents:
        """Return the contents from `start_s` to before `stop_s`, in seconds since the first exchange, for some tags.

        `tags` selects exchanges between these tags, `pairs` those of (initiator, target). All tags are kept, and the
        poses that the span needs. Readings, bytes and faults are selected by time only. `meta` describes the selection.
        Raises `ArgumentError` for times and ids that are not possible.
        """
        first_ns, end_ns = self._bounds(start_s, stop_s)
        of_tags = None if tags is None else sorted(_ids("tags", [*tags]).tolist())
        of_pairs = None if pairs is None else _pairs([*pairs])
        kept = {"start_s": start_s, "stop_s": stop_s, "tags": of_tags, "pairs": of_pairs}

        def chosen(columns: Mapping[str, NDArray[Any]]) -> Bools:
            """Return a mask of rows in the span; if rows have two tags, only those of the selected tags and pairs."""
            good: Bools = (columns["time_ns"] >= first_ns) & (columns["time_ns"] < end_ns)
            if "initiator" in columns:
                ends = np.column_stack([columns["initiator"], columns["target"]])
                if of_tags is not None:
                    good &= np.isin(ends, of_tags).all(axis=1)
                if of_pairs is not None:
                    good &= np.isin(ends @ (1 << 16, 1), [i << 16 | j for i, j in of_pairs])
            return good

        def rows(listed: list[Row], *names: str) -> list[Row]:
            columns = {name: np.array([getattr(row, name) for row in listed]) for name in ("time_ns", *names)}
            return [row for row, good in zip(listed, chosen(columns).tolist(), strict=True) if good]

        cut: dict[str, Any] = {
            name: {word: column[chosen(columns)] for word, column in columns.items()}
            for name in _COLUMNS
            if (columns := getattr(self, name))
        }
        return Contents(
            exchanges=self.exchanges[chosen(self.exchanges.to_dict())],
            tags=self.tags,
            poses=poses_around(tracks_of(self.poses), first_ns, end_ns),
            cirs=rows(self.cirs, "initiator", "target"),
            frames=rows(self.frames),
            faults=rows(self.faults),
            arrangements=[row for row in self.arrangements if row.start_ns < end_ns and first_ns <= row.end_ns],
            known_distances=self.known_distances,
            meta={**self.meta, "selected": {key: value for key, value in kept.items() if value is not None}},
            **cut,
        )

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write a recording; raises the errors of `Recording.create`."""
        meta = {"timestamp_bits": self.exchanges.bits, **self.meta}
        with Recording.create(path, meta=meta, force=force) as recording:
            # In blocks, because DuckDB keeps rows in memory until they are committed.
            for start in range(0, len(self.exchanges), 500_000):
                recording.append("exchanges", self.exchanges[start : start + 500_000])
            for table in ("tags", "poses", *_COLUMNS, *_LISTS):
                recording.append({"known_distances": "distances"}.get(table, table), getattr(self, table))

    def __repr__(self) -> str:
        """Return a headline with the numbers of rows, and the first exchanges."""
        return f"{self._line()}\n{self.exchanges!r}"

    def _repr_html_(self) -> str:
        """Return the same for a notebook."""
        names, row = zip(*self._numbers().items(), strict=True)
        return as_html(self._line(), [list(names), [str(n) for n in row]]) + self.exchanges._repr_html_()

    def _line(self) -> str:
        also = counted({name: n for name, n in self._numbers().items() if n and name != "exchanges"})
        bodies = first_few(printable(body) for body in sorted({tag.body for tag in self.tags}))
        return f"{len(self.tags)} tags on {bodies}; {also}"

    def _numbers(self) -> dict[str, int]:
        columns = {name: len(getattr(self, name).get("time_ns", ())) for name in _COLUMNS}
        lists = {name: len(getattr(self, name)) for name in _LISTS}
        return {"exchanges": len(self.exchanges), "poses": len(self.poses)} | columns | lists

    def counts(self) -> dict[str, int]:
        """Return the number of rows by table: of exchanges, and of other tables that are not empty."""
        return {name: n for name, n in self._numbers().items() if n or name == "exchanges"}

    def _bounds(self, start_s: float | None, stop_s: float | None) -> tuple[int, int]:
        for name, value in (("start_s", start_s), ("stop_s", stop_s)):
            if value is not None and not abs(value) < LATEST_NS * 1e-9:
                raise ArgumentError(f"{name}: found {value!r}, expected seconds since the first exchange")
        if start_s is not None and stop_s is not None and stop_s < start_s:
            raise ArgumentError(f"stop_s: found {stop_s:g}, expected no less than start_s, {start_s:g}")
        times = self.exchanges.time_ns if len(self.exchanges) else self.differences.get("time_ns", ())
        origin = int(min(times, default=0))
        first = -LATEST_NS if start_s is None else origin + round(start_s * 1e9)
        return first, LATEST_NS if stop_s is None else origin + round(stop_s * 1e9)


_LISTS: Final = ("cirs", "frames", "faults", "arrangements", "known_distances")
"""Fields of `Contents` that are lists of rows."""

_COLUMNS: Final = tuple(one.name for one in fields(Contents) if one.default_factory is dict and one.name != "meta")
"""Fields of `Contents` that are columns by name."""


def load(path: str | os.PathLike[str]) -> Contents:
    """Read a whole recording; raises the errors of `Recording.open`.

    The result includes raw bytes, and impulse responses of 2 kB each. Use `Recording.open` to read single tables.

    >>> import tempfile, pathlib, uwblink
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> x = uwblink.Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
    >>> uwblink.Contents(exchanges=x).save(folder / "mine.uwb")
    >>> uwblink.load(folder / "mine.uwb").exchanges.range_m.round(2).tolist()
    [4.69]
    """
    with Recording.open(Path(path)) as r:
        return Contents(
            exchanges=r.exchanges(), tags=r.tags(), poses=r.poses(), cirs=r.cirs(), frames=r.frames(),
            faults=r.faults(), arrangements=r.arrangements(), known_distances=r.known_distances(), meta=r.meta(),
            **{name: r.columns(name) for name in _COLUMNS},
        )  # fmt: skip


def _ids(name: str, values: ArrayLike) -> Ints:
    return arrays.whole_numbers(name, values, len(np.atleast_1d(values)), 0, LARGEST_ID)


def _pairs(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    if pairs and np.shape(pairs) != (len(pairs), 2):
        raise ArgumentError(f"pairs: found {pairs!r:.60}, expected pairs of initiator and target, as [(1, 2)]")
    return list(zip(*(_ids("pairs", [pair[k] for pair in pairs]).tolist() for k in (0, 1)), strict=True))


def pieces(recording: Recording, rows: int = 50_000) -> Iterator[Contents]:
    """Yield consecutive pieces of time with at most about `rows` rows of each table.

    They have exchanges, poses, faults, IMU, heights and temperatures, and the rows of `corrected` if there is one for
    each exchange; other tables are left out.
    """
    columns = ("imu", "height", "temperature", *(["corrected"] if recording.corrected_is_of_exchanges() else []))
    edges = {-LATEST_NS, LATEST_NS}
    for table in ("exchanges", "poses", "faults", *columns):
        edges |= set(recording.dividing_times(table, rows)[1:-1])
    for start_ns, end_ns in pairwise(sorted(edges)):
        some: dict[str, Any] = {name: recording.columns(name, start_ns, end_ns) for name in columns}
        yield Contents(
            exchanges=recording.exchanges(start_ns, end_ns),
            poses=recording.poses(start_ns, end_ns),
            faults=recording.faults(start_ns, end_ns),
            **some,
        )


def distances_by_poses_m(recording: Recording, blocks: Iterable[Exchanges]) -> Iterator[Floats]:
    """Yield the distances (n,) between the antennas, from poses, for each block of exchanges; NaN without poses.

    They are distances at the times of the ranges (`uwblink.twr.range_ns`), in metres.
    """
    tracks, tags = tracks_of(recording.poses()), recording.tags()
    for some in blocks:
        yield distances_m(tracks, tags, some.initiator, some.target, range_ns(some))


def exchanges_with_poses(recording: Recording) -> Iterator[tuple[Exchanges, Poses]]:
    """Yield blocks of all exchanges in the order of their rows, and the poses around them.

    The poses suffice for distances at the times of exchanges and of their ranges.
    """
    tracks = tracks_of(recording.poses())
    for block in filter(len, recording.exchange_blocks()):
        # The time of a range is that of its poll, or later by at most half a wrap of the clock.
        later = int(2**block.bits * TICK_S * 0.5e9) + 1
        yield block, poses_around(tracks, int(block.time_ns.min()), int(block.time_ns.max()) + later)
