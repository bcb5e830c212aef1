"""Contents of a recording in memory: as a whole, for selecting and saving, or in pieces of time."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Floats
from uwblink.display import as_html, first_few, printable
from uwblink.errors import ArgumentError
from uwblink.recording.distances import distances_m
from uwblink.recording.file import Recording
from uwblink.recording.schema import Arrangement, CirRow, Fault, FrameRow, KnownDistance, Poses, Tag
from uwblink.recording.summary import counted
from uwblink.ticks import TICK_S
from uwblink.twr import LATEST_NS, Exchanges, middle_ns

Pairs = Iterable[tuple[int, int]]
Row = TypeVar("Row", CirRow, FrameRow, Fault)

READING_MB: Final = 300
"""Memory limit for files that are read in pieces; by default DuckDB would cache the whole file."""


@dataclass(frozen=True, kw_only=True)
class Contents:
    """The contents of a recording; all fields but the exchanges are optional.

    `overheard`, `imu`, `height`, `powers`, `temperature` and `corrected` have the columns of the tables of these names,
    or none; `meta` are the entries of the table `meta`.

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
    temperature: Mapping[str, NDArray[Any]] = field(default_factory=dict)
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
        pairs: Pairs | None = None,
    ) -> Contents:
        """Return the contents from `start_s` to before `stop_s`, in seconds since the first exchange, for some tags.

        `tags` selects exchanges between these tags, `pairs` those of (initiator, target). Poses are kept as far as the
        span needs them, tags completely. Readings, bytes and faults are selected by time only. `meta` describes the
        selection.
        Raises `ArgumentError`.
        """
        first_ns, end_ns = self._bounds(start_s, stop_s)
        of_tags, of_pairs = _ids(tags), _pairs(pairs)

        def chosen(columns: Mapping[str, NDArray[Any]]) -> Bools:
            """Return which rows are in the span, and where they are of two tags, of these tags and pairs."""
            good: Bools = (columns["time_ns"] >= first_ns) & (columns["time_ns"] < end_ns)
            if "initiator" in columns:
                ends = columns["initiator"], columns["target"]
                if of_tags is not None:
                    good &= np.isin(ends[0], of_tags) & np.isin(ends[1], of_tags)
                if of_pairs is not None:
                    hits = [(ends[0] == i) & (ends[1] == j) for i, j in of_pairs]
                    good &= np.any(hits, axis=0) if hits else False
            return good

        def rows(listed: list[Row], *names: str) -> list[Row]:
            columns = {name: np.array([getattr(row, name) for row in listed]) for name in ("time_ns", *names)}
            return [row for row, good in zip(listed, chosen(columns).tolist(), strict=True) if good]

        cut: dict[str, Any] = {}
        for table in _COLUMNS:
            if columns := getattr(self, table):
                good = chosen(columns)
                cut[table] = {name: column[good] for name, column in columns.items()}
        kept = {"start_s": start_s, "stop_s": stop_s, "tags": tags and sorted(tags), "pairs": of_pairs}
        return replace(
            self,
            exchanges=self.exchanges[chosen(self.exchanges.to_dict())],
            poses=_around(self.poses, first_ns, end_ns),
            cirs=rows(self.cirs, "initiator", "target"),
            frames=rows(self.frames),
            faults=rows(self.faults),
            arrangements=[row for row in self.arrangements if row.start_ns < end_ns and first_ns <= row.end_ns],
            meta={**self.meta, "selected": {key: value for key, value in kept.items() if value is not None}},
            **cut,
        )

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write a recording; raises what `Recording.create` raises."""
        meta = {"timestamp_bits": self.exchanges.bits, **self.meta}
        with Recording.create(path, meta=meta, force=force) as recording:
            recording.append_tags(self.tags)
            recording.append_poses(self.poses)
            # 500 000 at once: DuckDB holds what it has not committed in memory.
            for start in range(0, len(self.exchanges), 500_000):
                recording.append_exchanges(self.exchanges[start : start + 500_000])
            for table in (*_COLUMNS, *_LISTS):
                recording.append({"known_distances": "distances"}.get(table, table), getattr(self, table))

    def __repr__(self) -> str:
        """Return a headline, the numbers of other rows, and the first exchanges."""
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
        """Return the number of rows by table: exchanges, and other tables that have any."""
        return {name: n for name, n in self._numbers().items() if n or name == "exchanges"}

    def _bounds(self, start_s: float | None, stop_s: float | None) -> tuple[int, int]:
        for name, value in (("start_s", start_s), ("stop_s", stop_s)):
            if value is not None and not abs(value) < LATEST_NS * 1e-9:
                raise ArgumentError(f"{name}: found {value!r}, expected seconds since the first exchange")
        if start_s is not None and stop_s is not None and stop_s < start_s:
            raise ArgumentError(f"stop_s: found {stop_s:g}, expected no less than start_s, {start_s:g}")
        origin = int(self.exchanges.time_ns.min()) if len(self.exchanges) else 0
        first = -LATEST_NS if start_s is None else origin + round(start_s * 1e9)
        return first, LATEST_NS if stop_s is None else origin + round(stop_s * 1e9)


_LISTS: Final = ("cirs", "frames", "faults", "arrangements", "known_distances")
"""The tables that are held as lists of rows."""

_COLUMNS: Final = ("overheard", "imu", "height", "powers", "temperature", "corrected")
"""The tables that are held as columns by name."""


def load(path: str | os.PathLike[str]) -> Contents:
    """Read a whole recording; raises what `Recording.open` raises.

    This includes bytes and impulse responses, 2 kB each. `Recording.open` reads table by table.

    >>> import tempfile, pathlib, uwblink
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> x = uwblink.Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
    >>> uwblink.Contents(exchanges=x).save(folder / "mine.uwb")
    >>> uwblink.load(folder / "mine.uwb").exchanges.range_m.round(2).tolist()
    [4.69]
    """
    with Recording.open(Path(path)) as r:
        return Contents(
            exchanges=r.exchanges(), tags=r.tags(), poses=r.poses(), overheard=r.overheard(), imu=r.imu(),
            height=r.heights(), powers=r.powers(), temperature=r.temperatures(), corrected=r.corrected(),
            cirs=r.cirs(), frames=r.frames(), faults=r.faults(), arrangements=r.arrangements(),
            known_distances=r.known_distances(), meta=r.meta(),
        )  # fmt: skip


def _around(poses: Poses, first_ns: int, end_ns: int) -> Poses:
    """Return each body's poses in a span of time, and the adjacent ones, which interpolation needs."""
    keep = np.zeros(len(poses), dtype=bool)
    for body in np.unique(poses.body):
        rows = np.flatnonzero(poses.body == body)
        before = int(np.searchsorted(poses.time_ns[rows], first_ns, side="right")) - 1
        after = int(np.searchsorted(poses.time_ns[rows], end_ns, side="left")) + 1
        # A body with a single pose does not move.
        keep[rows[max(before, 0) : after] if len(rows) > 1 else rows] = True
    return poses[keep]


def _ids(ids: Collection[int] | None) -> list[int] | None:
    if ids is None:
        return None
    if isinstance(ids, str | bytes) or not all(isinstance(i, int | np.integer) for i in ids):
        raise ArgumentError(f"tags: found {ids!r:.60}, expected ids of tags, as [1, 2]")
    return sorted(int(i) for i in ids)


def _pairs(pairs: Pairs | None) -> list[tuple[int, int]] | None:
    if pairs is None:
        return None
    listed = [tuple(pair) if isinstance(pair, list | tuple | np.ndarray) else () for pair in pairs]
    if not all(len(pair) == 2 and all(isinstance(i, int | np.integer) for i in pair) for pair in listed):
        raise ArgumentError(f"pairs: found {listed!r:.60}, expected pairs of initiator and target, as [(1, 2)]")
    return [(int(i), int(j)) for i, j in listed]


def pieces(recording: Recording, rows: int = 50_000) -> Iterator[Contents]:
    """Yield consecutive pieces of time with about `rows` rows of each table.

    Bytes, impulse responses and total powers are left out, and `corrected` if its rows are not those of the exchanges.
    """
    fitting = recording.corrected_is_of_exchanges()
    edges = {-LATEST_NS, LATEST_NS}
    for table in ("exchanges", "poses", "imu", "height", "temperature", "corrected", "faults"):
        edges |= set(recording.times_apart(table, rows))
    for start_ns, end_ns in pairwise(sorted(edges)):
        yield Contents(
            exchanges=recording.exchanges_between(start_ns, end_ns),
            poses=recording.poses(start_ns, end_ns),
            imu=recording.imu(start_ns, end_ns),
            height=recording.heights(start_ns, end_ns),
            temperature=recording.temperatures(start_ns, end_ns),
            corrected=recording.corrected(start_ns, end_ns) if fitting else {},
            faults=recording.faults(start_ns, end_ns),
        )


def distances_by_poses_m(recording: Recording, blocks: Iterable[Exchanges]) -> Iterator[Floats]:
    """Yield the distances (n,) between the antennas of each block of exchanges by the poses; NaN without poses.

    They are distances at the middle between the first two messages, which is the time of a range.
    """
    tracks, tags = recording.pose_windows().tracks, recording.tags()
    for some in blocks:
        yield distances_m(tracks, tags, some.initiator, some.target, middle_ns(some))


def exchanges_with_poses(recording: Recording) -> Iterator[tuple[Exchanges, Poses]]:
    """Yield blocks of all exchanges in the order of their rows, and the poses around them.

    The poses suffice for distances at the times of exchanges and at the middle between their messages.
    """
    windows = recording.pose_windows()
    for block in filter(len, recording.exchange_blocks()):
        # A range belongs to the middle of its first two messages, which is after its time, by half a wrap at most.
        later = int(2**block.bits * TICK_S * 0.5e9) + 1
        yield block, windows.around(int(block.time_ns.min()), int(block.time_ns.max()) + later)
