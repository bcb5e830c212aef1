"""A recording as the columns that a twin is fitted to, and compared by."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Protocol, Self

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from uwblink.arrays import Floats, Ints
from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.distances import antennas_m
from uwblink.recording.file import Recording
from uwblink.recording.schema import Fault, Poses, Tag
from uwblink.twr import Exchanges, intervals, without_stamps
from uwbsim.errors import ScenarioError, UnanswerableError
from uwbsim.twins.calibration_file import KnownDevices
from uwbsim.units import NS

BLOCK: Final = 2000
FEWEST: Final = 100
"""Exchanges below which nothing of a distribution can be told."""


class Flown(Protocol):
    """What a flight must have: a `Contents`, a `Simulated` flight, or what is read of a recording."""

    @property
    def exchanges(self) -> Exchanges: ...  # noqa: D102 - the columns of a recording
    @property
    def tags(self) -> list[Tag]: ...  # noqa: D102
    @property
    def poses(self) -> Poses: ...  # noqa: D102
    @property
    def faults(self) -> list[Fault]: ...  # noqa: D102


RecordingSource = str | os.PathLike[str] | Flown
"""A recording: its file (.uwb), or what one holds, in memory."""


@dataclass(frozen=True, slots=True)
class Flew:
    """What a twin needs of a recording."""

    exchanges: Exchanges
    tags: list[Tag]
    poses: Poses
    faults: list[Fault]


def read_flight(source: RecordingSource) -> tuple[Flown, str]:
    """Return what a recording holds and what messages call it; raises what `Recording.open` raises."""
    if not isinstance(source, str | os.PathLike):
        if not all(hasattr(source, name) for name in ("exchanges", "tags", "poses", "faults")):
            raise ScenarioError(f"recording: found {source!r:.60}, expected a file (.uwb) or what one holds")
        return source, "recording"
    with Recording.open(Path(source)) as recording:
        return Flew(recording.exchanges(), recording.tags(), recording.poses(), recording.faults()), str(source)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """Exchanges of one protocol between tags whose places are known, as columns of length n in order of time.

    `time_s` counts from `origin_ns`; `ends` are places in `tags` of initiator and target, (2, n), `pair` the places of
    both in `pairs`, whichever began; `towards` are unit vectors to the other end in the frames of the two bodies,
    (2, n, 3). `residual_m` is calibrated range less distance; `ratio_ppm` by how much the initiator's clock is faster
    than the target's as dt64/dt53 says, NaN where the protocol has no such.
    """

    tags: tuple[Tag, ...]
    row: RangingProtocol
    exchanges: Exchanges
    origin_ns: int
    time_s: Floats
    ends: Ints
    pair: Ints
    pairs: tuple[tuple[int, int], ...]
    distance_m: Floats
    towards: Floats
    residual_m: Floats
    ratio_ppm: Floats
    left_out: int = 0

    def __len__(self) -> int:
        """Return the number of exchanges."""
        return len(self.time_s)

    def __getitem__(self, rows: Ints) -> Self:
        """Return the chosen exchanges, in their order; times go on counting from the same instant."""
        return replace(
            self,
            exchanges=self.exchanges[rows],
            time_s=self.time_s[rows],
            ends=self.ends[:, rows],
            pair=self.pair[rows],
            distance_m=self.distance_m[rows],
            towards=self.towards[:, rows],
            residual_m=self.residual_m[rows],
            ratio_ppm=self.ratio_ppm[rows],
        )

    def some(self, most: int) -> Ints:
        """Return rows of `most` exchanges, all where there are no more: blocks all over the flight.

        What comes soon after one another stays together, so that short lags stay.
        """
        if len(self) <= most:
            return np.arange(len(self))
        begins = np.linspace(0, len(self) - BLOCK, most // BLOCK).astype(np.int64)
        return np.unique(begins[:, None] + np.arange(BLOCK))

    @property
    def power_dbm(self) -> Floats:
        """First-path powers read at target and initiator, (2, n)."""
        return np.array([self.exchanges.fpp1_dbm, self.exchanges.fpp2_dbm])

    @classmethod
    def of(cls, flown: Flown, known: KnownDevices, where: str = "recording", *, fewest: int = FEWEST) -> Self:
        """Take the columns; raises `ScenarioError` where a recording cannot have a twin."""
        exchanges, row = _of_one_protocol(flown.exchanges, where)
        _check(flown, exchanges, where, fewest)
        tags = _those_that_range(flown.tags, exchanges, where)
        known.require([tag.tag for tag in tags])
        order = np.argsort(exchanges.time_ns, kind="stable")
        exchanges = exchanges[order]
        spots = [antennas_m(flown.poses, list(tags), ids, exchanges.time_ns) for ids in _ids(exchanges)]
        good = np.isfinite(spots[0] + spots[1]).all(axis=1) & _powered(exchanges) & ~without_stamps(exchanges)
        good &= exchanges.initiator != exchanges.target
        if np.count_nonzero(good) < fewest:
            raise UnanswerableError(
                f"{where}: {np.count_nonzero(good)} of {len(good)} exchanges have stamps, both powers and poses around "
                f"them, a twin needs {fewest} or more; record longer, and with motion capture all the time"
            )
        exchanges, spots = exchanges[good], [spot[good] for spot in spots]
        apart = spots[1] - spots[0]
        distance = np.linalg.norm(apart, axis=1)
        unit = apart / np.maximum(distance, 1e-9)[:, None]
        place = {tag.tag: k for k, tag in enumerate(tags)}
        ends = np.array([[place[int(tag)] for tag in ids.tolist()] for ids in _ids(exchanges)])
        names, pair = np.unique(np.sort(np.array(_ids(exchanges)), axis=0), axis=1, return_inverse=True)
        origin = int(exchanges.time_ns[0])
        turned = [
            _into_body(flown.poses, tags, end, exchanges.time_ns, way)
            for end, way in zip(ends, (unit, -unit), strict=True)
        ]
        return cls(
            tags=tags,
            row=row,
            exchanges=exchanges,
            origin_ns=origin,
            time_s=np.asarray((exchanges.time_ns - origin) * NS, dtype=np.float64),
            ends=ends,
            pair=pair.ravel(),
            pairs=tuple((int(a), int(b)) for a, b in names.T),
            distance_m=distance,
            towards=np.array(turned),
            residual_m=known.corrected_m(exchanges) - distance,
            ratio_ppm=_ratio_ppm(exchanges, row),
            left_out=len(flown.exchanges) - len(exchanges),
        )


def _ids(exchanges: Exchanges) -> tuple[Ints, Ints]:
    return exchanges.initiator.astype(np.int64), exchanges.target.astype(np.int64)


def _of_one_protocol(exchanges: Exchanges, where: str) -> tuple[Exchanges, RangingProtocol]:
    names, counts = np.unique(exchanges.protocol, return_counts=True)
    if not len(names):
        raise UnanswerableError(f"{where}: holds no exchanges; record or import some first")
    name = str(names[np.argmax(counts)])
    return exchanges[np.flatnonzero(exchanges.protocol == name)], PROTOCOLS[name]


def _check(flown: Flown, exchanges: Exchanges, where: str, fewest: int) -> None:
    if len(exchanges) < fewest:
        raise UnanswerableError(
            f"{where}: holds {len(exchanges)} exchanges, a twin needs {fewest} or more; record longer"
        )
    if not len(flown.poses):
        raise UnanswerableError(f"{where}: holds no poses; add motion capture with `uwblink poses`")
    if not np.any(_powered(exchanges)):
        raise UnanswerableError(f"{where}: no exchange has both first-path powers, and a twin is made from powers")


def _powered(exchanges: Exchanges) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    powers = np.array([exchanges.fpp1_dbm, exchanges.fpp2_dbm])
    return np.asarray(np.all(np.isfinite(powers) & (powers < 0), axis=0))


def _those_that_range(tags: Sequence[Tag], exchanges: Exchanges, where: str) -> tuple[Tag, ...]:
    ids = set(np.unique([exchanges.initiator, exchanges.target]).tolist())
    known = {tag.tag for tag in tags}
    if ids - known:
        lacking = ", ".join(map(str, sorted(ids - known)))
        raise UnanswerableError(
            f"{where}: does not say on which body tag {lacking} sits; give tags with 'uwblink poses --tags'"
        )
    return tuple(tag for tag in tags if tag.tag in ids)


def _into_body(poses: Poses, tags: Sequence[Tag], end: Ints, time_ns: Ints, way: Floats) -> Floats:
    """Return vectors (n, 3) of the world in the frames of the bodies that carry tags at places `end` (n,)."""
    turned = way.copy()
    for body in sorted({tag.body for tag in tags}):
        mine = [k for k, tag in enumerate(tags) if tag.body == body]
        rows = np.flatnonzero(np.isin(end, mine))
        if len(rows):
            turned[rows] = attitude(poses, body, time_ns[rows]).apply(way[rows], inverse=True)
    return turned


def attitude(poses: Poses, body: str, time_ns: Ints) -> Rotation:
    """Return the attitudes of a body at times (n,), held beyond its poses."""
    mine = np.flatnonzero(poses.body == body)
    times, first = np.unique(poses.time_ns[mine], return_index=True)
    turns = Rotation.from_quat(poses.quaternion[mine][first])
    if len(times) == 1:
        return turns[np.zeros(len(time_ns), dtype=np.int64)]
    at = np.clip(time_ns, times[0], times[-1]) - times[0]
    return Slerp((times - times[0]) * NS, turns)(at * NS)


def _ratio_ppm(exchanges: Exchanges, row: RangingProtocol) -> Floats:
    if len(row.messages) < 3 or row.third_sender != "target":
        return np.full(len(exchanges), np.nan)
    spans = intervals(exchanges)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((spans.dt64 / spans.dt53 - 1) * 1e6)
