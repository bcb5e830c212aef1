"""Everything that a recording holds, in memory: loaded at once, cut, and written again."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Ints
from uwblink.display import as_html, first_few, printable
from uwblink.errors import ArgumentError
from uwblink.recording.file import Recording
from uwblink.recording.schema import Arrangement, CirRow, Fault, FrameRow, KnownDistance, Poses, Tag
from uwblink.recording.summary import counted
from uwblink.twr import Exchanges

Pairs = Iterable[tuple[int, int]]
LONGEST_S: Final = 2**62 * 1e-9
ROWS_AT_A_TIME: Final = 500_000
"""Exchanges that are written at once: DuckDB holds what it has not committed in memory."""


def _no_poses() -> Poses:
    return Poses.from_arrays([], "", (0.0, 0.0, 0.0))


@dataclass(frozen=True, kw_only=True)
class Contents:
    """What a recording holds; only the exchanges are needed to make one.

    `overheard`, `imu`, `height`, `powers`, `temperature` and `corrected` have the columns of the tables of these names,
    or none; `meta` is what is known of the whole.

    >>> from uwblink import Contents, Exchanges, Tag
    >>> x = Exchanges.from_arrays([1, 2], [2, 3], tx1=[0, 9], rx1=[5, 3], tx2=[1005, 1003], rx2=[3000, 3009])
    >>> mine = Contents(exchanges=x, tags=[Tag(1, "a", (0, 0, 0)), Tag(2, "b", (0, 0, 0)), Tag(3, "b", (0, 0, 0))])
    >>> len(mine.select(tags=[1, 2]).exchanges), len(mine.select(pairs=[(2, 3)]).exchanges)
    (1, 1)
    """

    exchanges: Exchanges
    tags: list[Tag] = field(default_factory=list)
    poses: Poses = field(default_factory=_no_poses)
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
        """Return what lies from `start_s` until before `stop_s`, in seconds since the first exchange, of some tags.

        `tags` keeps exchanges between these tags; `pairs` those of (initiator, target). Poses stay as far as the span
        needs them, tags stay all. Readings, bytes and faults are cut in time only. `meta` says what was selected.
        Raises `ArgumentError`.
        """
        first_ns, end_ns = self._bounds(start_s, stop_s)
        chosen = _Choice(first_ns, end_ns, _ids("tags", tags), _pairs(pairs))
        x, heard = self.exchanges, self.overheard
        kept = {"start_s": start_s, "stop_s": stop_s, "tags": tags and sorted(tags), "pairs": chosen.pairs}
        return replace(
            self,
            exchanges=x[chosen.rows(x.time_ns, x.initiator, x.target)],
            poses=_around(self.poses, first_ns, end_ns),
            overheard=_overheard(heard, chosen),
            powers=_overheard(self.powers, chosen),
            corrected=_overheard(self.corrected, chosen),
            imu=_between(self.imu, first_ns, end_ns),
            height=_between(self.height, first_ns, end_ns),
            temperature=_between(self.temperature, first_ns, end_ns),
            cirs=[row for row in self.cirs if chosen.has(row.time_ns, row.initiator, row.target)],
            frames=[row for row in self.frames if first_ns <= row.time_ns < end_ns],
            faults=[row for row in self.faults if first_ns <= row.time_ns < end_ns],
            arrangements=[row for row in self.arrangements if row.start_ns < end_ns and first_ns <= row.end_ns],
            meta={**self.meta, "selected": {key: value for key, value in kept.items() if value is not None}},
        )

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write a recording; raises what `Recording.create` raises."""
        meta = {"timestamp_bits": self.exchanges.bits, **self.meta}
        with Recording.create(path, meta=meta, force=force) as recording:
            recording.append_tags(self.tags)
            recording.append_poses(self.poses)
            for start in range(0, len(self.exchanges), ROWS_AT_A_TIME):
                recording.append_exchanges(self.exchanges[start : start + ROWS_AT_A_TIME])
            for table in _COLUMNS:
                recording.append_columns(table, getattr(self, table))
            recording.append_cirs(self.cirs)
            recording.append_frames(self.frames)
            recording.append_faults(self.faults)
            recording.append_arrangements(self.arrangements)
            recording.append_distances(self.known_distances)

    def __repr__(self) -> str:
        """Return a headline, what else there is, and the first exchanges."""
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
        numbers = {"exchanges": len(self.exchanges), "poses": len(self.poses)}
        columns = {name: getattr(self, name) for name in _COLUMNS}
        numbers |= {name: len(found["time_ns"]) if found else 0 for name, found in columns.items()}
        return numbers | {name: len(getattr(self, name)) for name in _LISTS}

    def counts(self) -> dict[str, int]:
        """Return how many rows there are by table: the exchanges, and of the others those that have any."""
        return {name: n for name, n in self._numbers().items() if n or name == "exchanges"}

    def _bounds(self, start_s: float | None, stop_s: float | None) -> tuple[int, int]:
        for name, value in (("start_s", start_s), ("stop_s", stop_s)):
            if value is not None and not abs(value) < LONGEST_S:
                raise ArgumentError(f"{name}: found {value!r}, expected seconds since the first exchange")
        if start_s is not None and stop_s is not None and stop_s < start_s:
            raise ArgumentError(f"stop_s: found {stop_s:g}, expected no less than start_s, {start_s:g}")
        origin = int(self.exchanges.time_ns.min()) if len(self.exchanges) else 0
        far = 2**62
        first = -far if start_s is None else origin + round(start_s * 1e9)
        return first, far if stop_s is None else origin + round(stop_s * 1e9)


_LISTS: Final = ("cirs", "frames", "faults", "arrangements", "known_distances")
"""The tables that are held as lists of rows."""

_COLUMNS: Final = ("overheard", "imu", "height", "powers", "temperature", "corrected")
"""The tables that are held as columns by name."""


def load(path: str | os.PathLike[str]) -> Contents:
    """Read everything that a recording holds; raises what `Recording.open` raises.

    Bytes and impulse responses are read, too: 2 kB a response. `Recording.open` reads table by table.

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


@dataclass(frozen=True, slots=True)
class _Choice:
    """A span of time, and of whom: None for all."""

    first_ns: int
    end_ns: int
    tags: list[int] | None
    pairs: list[tuple[int, int]] | None

    def rows(self, time_ns: Ints, initiator: Ints, target: Ints) -> Bools:
        good: Bools = (time_ns >= self.first_ns) & (time_ns < self.end_ns)
        if self.tags is not None:
            good &= np.isin(initiator, self.tags) & np.isin(target, self.tags)
        if self.pairs is not None:
            hits = [(initiator == i) & (target == j) for i, j in self.pairs]
            good &= np.any(hits, axis=0) if hits else False
        return good

    def has(self, time_ns: int, initiator: int, target: int) -> bool:
        return bool(self.rows(np.array([time_ns]), np.array([initiator]), np.array([target]))[0])


def _overheard(heard: Mapping[str, NDArray[Any]], chosen: _Choice) -> Mapping[str, NDArray[Any]]:
    if not heard:
        return heard
    rows = chosen.rows(heard["time_ns"], heard["initiator"], heard["target"])
    return {name: column[rows] for name, column in heard.items()}


def _between(columns: Mapping[str, NDArray[Any]], first_ns: int, end_ns: int) -> Mapping[str, NDArray[Any]]:
    if not columns:
        return columns
    rows = (columns["time_ns"] >= first_ns) & (columns["time_ns"] < end_ns)
    return {name: column[rows] for name, column in columns.items()}


def _around(poses: Poses, first_ns: int, end_ns: int) -> Poses:
    """Return each body's poses in a span of time, and the ones next to it, between which it is interpolated."""
    keep = np.zeros(len(poses), dtype=bool)
    for body in np.unique(poses.body):
        rows = np.flatnonzero(poses.body == body)
        before = int(np.searchsorted(poses.time_ns[rows], first_ns, side="right")) - 1
        after = int(np.searchsorted(poses.time_ns[rows], end_ns, side="left")) + 1
        # A body with one pose does not move, whenever that was.
        keep[rows[max(before, 0) : after] if len(rows) > 1 else rows] = True
    return poses[keep]


def _ids(name: str, ids: Collection[int] | None) -> list[int] | None:
    if ids is None:
        return None
    if isinstance(ids, str | bytes) or not all(isinstance(i, int | np.integer) for i in ids):
        raise ArgumentError(f"{name}: found {ids!r:.60}, expected ids of tags, as [1, 2]")
    return sorted(int(i) for i in ids)


def _pairs(pairs: Pairs | None) -> list[tuple[int, int]] | None:
    if pairs is None:
        return None
    listed = [tuple(pair) if isinstance(pair, list | tuple | np.ndarray) else () for pair in pairs]
    if not all(len(pair) == 2 and all(isinstance(i, int | np.integer) for i in pair) for pair in listed):
        raise ArgumentError(f"pairs: found {listed!r:.60}, expected pairs of initiator and target, as [(1, 2)]")
    return [(int(i), int(j)) for i, j in listed]
