"""Where ranges come from: recordings, open ones, simulations in memory, or several of them.

Recordings are read some exchanges at a time, with only the poses around them in memory; a source in memory is one such
block. What comes out is what `Ranges.from_exchanges` makes of all exchanges and all poses, without unusable ranges.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.data.clocks import ClockSample, left_skew_of, skew_terms
from calib.data.ranges import (
    COLUMNS,
    FAINTEST_DBM,
    IN_MEMORY,
    LOUDEST_DBM,
    Ranges,
    bodies_of,
    columns_of,
    concatenate,
    require_some,
    usable_rows,
    without_static,
)
from calib.errors import BadInputError, UnanswerableError
from uwblink.arrays import Floats
from uwblink.display import printable
from uwblink.recording.antenna_delays import AntennaDelays, delays_in_meta
from uwblink.recording.distances import Tracks
from uwblink.recording.file import Recording
from uwblink.recording.schema import Arrangement, Fault, KnownDistance, Poses, Tag
from uwblink.recording.summary import single_report_blocks, single_reports
from uwblink.twr import Exchanges, names_in

EXCHANGES_AT_ONCE: Final = 131_072
"""Exchanges of a file that are read together: about 30 MB of columns."""


@runtime_checkable
class Source(Protocol):
    """What anything may hand over instead of a file: exchanges, poses of bodies, and the tags on them.

    A simulation's result has these attributes. Used where they exist: `planted`, what a simulation put in, which is
    shown and never used (or `meta` with that entry, and with the programmed antenna delays); `faults`; `overheard`,
    columns of the recording's table.
    """

    @property
    def exchanges(self) -> Exchanges:
        """The exchanges, in order of time."""

    @property
    def poses(self) -> Poses:
        """Poses of the bodies; none where the exchanges carry their true distances."""

    @property
    def tags(self) -> Sequence[Tag]:
        """The tags with their bodies and lever arms."""


Data = str | os.PathLike[str] | Recording | Source | Exchanges | Ranges
"""One recording: its path, an open one, a `Source`, exchanges with their distances, or ranges loaded before."""


def no_poses() -> Poses:
    """Return poses of no body."""
    return Poses(np.zeros(0, np.int64), np.zeros(0, np.str_), np.zeros((0, 3)), np.zeros((0, 4)))


class RecordedSource:
    """An open recording as a `Source`, which reads each table when it is asked for."""

    def __init__(self, recording: Recording) -> None:
        """Take a recording, which must stay open."""
        self.recording = recording

    @cached_property
    def exchanges(self) -> Exchanges:
        """Return the exchanges."""
        return self.recording.exchanges()

    @cached_property
    def poses(self) -> Poses:
        """Return the poses."""
        return self.recording.poses()

    @cached_property
    def tags(self) -> list[Tag]:
        """Return the tags."""
        return self.recording.tags()

    @cached_property
    def meta(self) -> Mapping[str, Any]:
        """Return the recording's metadata."""
        return self.recording.meta()

    @cached_property
    def planted(self) -> Mapping[str, Any] | None:
        """Return what a simulation planted, None in a real recording."""
        found = self.recording.meta().get("planted")
        return found if isinstance(found, dict) else None

    @cached_property
    def faults(self) -> list[Fault]:
        """Return what went wrong while recording."""
        return self.recording.faults()

    @cached_property
    def overheard(self) -> dict[str, NDArray[Any]]:
        """Return the columns of passively heard exchanges."""
        return self.recording.overheard()

    @cached_property
    def imu(self) -> dict[str, NDArray[Any]]:
        """Return the columns of inertial readings."""
        return self.recording.imu()

    @cached_property
    def arrangements(self) -> list[Arrangement]:
        """Return the stretches of time in which boards stood still."""
        return self.recording.arrangements()

    @cached_property
    def known_distances(self) -> list[KnownDistance]:
        """Return the distances that were measured otherwise."""
        return self.recording.known_distances()

    @cached_property
    def height(self) -> dict[str, NDArray[Any]]:
        """Return the columns of readings of height sensors."""
        return self.recording.heights()


@dataclass(frozen=True, slots=True)
class _Bare:
    """Exchanges that carry their true distances, and nothing beside them."""

    exchanges: Exchanges
    poses: Poses = field(default_factory=no_poses)
    tags: Sequence[Tag] = ()
    planted: Mapping[str, Any] | None = None


@contextmanager
def opened(data: Data) -> Iterator[tuple[str, Source]]:
    """Yield a name and a `Source`, which is good inside the block.

    Raises the errors of `Recording.open`, and `BadInputError` for what is no recording at all.
    """
    if isinstance(data, Recording):
        yield data.path.name, RecordedSource(data)
    elif isinstance(data, str | os.PathLike):
        with Recording.open(data) as recording:
            yield Path(data).name, RecordedSource(recording)
    elif isinstance(data, Exchanges):
        yield IN_MEMORY, _Bare(data)
    elif isinstance(data, Ranges):
        raise BadInputError("ranges do not say where bodies are; give the recording they come from", parameter="data")
    elif isinstance(data, Source):
        yield str(getattr(data, "name", IN_MEMORY)), data
    else:
        raise _no_recording(data)


def _no_recording(data: object) -> BadInputError:
    return BadInputError(
        f"found {type(data).__name__}, expected a path, a Recording, Exchanges, Ranges, or an object with exchanges, "
        "poses and tags",
        parameter="data",
    )


def load_ranges(data: Data | Iterable[Data], *, trim_static: bool = False, need_power: bool = True) -> Ranges:
    """Return the ranges of one or more recordings with their true distances, without those that cannot be used.

    `data` is the path of a recording, an open `Recording`, `Exchanges` with their true distances, `Ranges`, any object
    with `exchanges`, `poses` and `tags` (a simulation in memory), or several of those. `trim_static` leaves out spans
    of two seconds in which a pair's distance stays within two centimetres. Ranges without any power are left out unless
    `need_power` is False. Raises the errors of `Recording.open`, and `UnanswerableError` where nothing can be used.

    >>> import calib
    >>> own = calib.Ranges.from_arrays([3.1, 4.2], initiator=1, target=2, fpp1_dbm=-85.0, truth_m=[3.0, 4.0])
    >>> calib.load_ranges(own)
    <Ranges of memory: 2 of tags 1, 2>
    """
    parts = load_each(data, trim_static=trim_static, need_power=need_power)
    return parts[0] if len(parts) == 1 else concatenate(parts)


def load_each(data: Data | Iterable[Data], *, trim_static: bool = False, need_power: bool = True) -> list[Ranges]:
    """Return the ranges of each recording; raises what `load_ranges` raises.

    Raises `BadInputError` where two recordings hold the same exchanges: counted twice, they would seem to tell more.
    """
    given = each(data)
    parts = [_load(one, need_power) for one in given]
    seen: dict[str, str] = {}
    for part in (p for one, p in zip(given, parts, strict=True) if not isinstance(one, Ranges)):
        for name, found in part.recordings:
            if found in seen:
                raise BadInputError(f"{name}: has the same exchanges as {seen[found]}; give each recording once")
            seen[found] = name
    return [without_static(part) for part in parts] if trim_static else parts


def each(data: Data | Iterable[Data]) -> list[Data]:
    """Return one recording or several as a list; raises `BadInputError` where there is none."""
    if isinstance(data, str | os.PathLike | Recording | Ranges | Exchanges | Source):
        return [data]
    if not isinstance(data, Iterable):
        raise _no_recording(data)
    found = list(data)
    if not found:
        raise BadInputError("no recording was given", parameter="data")
    return found


def _load(data: Data, need_power: bool) -> Ranges:
    if isinstance(data, Ranges):
        return data.usable(need_power=need_power)
    with held_open(data) as held, opened(held) as (name, source):
        return _read(name, source, need_power=need_power)


def _read(name: str, source: Source, *, need_power: bool) -> Ranges:
    """Return the usable ranges of a source; of an exchange that both ends reported one report counts.

    Raises `BadInputError` for planted values or antenna delays that cannot be read, `UnanswerableError` where no range
    can be used.
    """
    planted, delays, tags = _planted(source, name), antenna_delays_of(source, name), source.tags
    columns: dict[str, list[Any]] = {column: [] for column in COLUMNS if column != "session"}
    excluded, count, times, measured_m = Counter[str](), 0, sha256(), list[Floats]()
    terms, clocks = list[tuple[Floats, Floats]](), ClockSample()
    for block, with_poses in _blocks(source):
        for part, poses in with_poses:
            some = Ranges(source="", excluded={}, planted=None, **columns_of(part, part.truth_m, poses, tags))
            usable, left_out = usable_rows(some, need_power=need_power)
            excluded.update(left_out)
            for column, rows in columns.items():
                # A copy where all rows are usable: the block itself must not stay in memory.
                rows.append(_words(usable.protocol) if column == "protocol" else np.array(getattr(usable, column)))
        count += len(block)
        times.update(np.ascontiguousarray(block.time_ns).data)
        measured_m.append(block.range_m)
        terms.append(skew_terms(block))
        clocks.add(block)
    if sum(excluded.values()) == count:
        require_some(name, count, excluded, _why_no_truth(source), _why_no_power(source.exchanges))
    for one in measured_m:
        times.update(np.ascontiguousarray(one).data)
    protocol = _joined_words(columns.pop("protocol"))
    joined: dict[str, Any] = {column: np.concatenate(columns.pop(column)) for column in list(columns)}
    return Ranges(
        source=name,
        excluded={reason: number for reason, number in excluded.items() if number},
        planted=dict(planted) if planted else None,
        left_skew=left_skew_of(terms),
        clocks_apart=clocks.farthest_pair(),
        bodies=bodies_of(tags),
        antenna_delays=delays,
        recordings=((name, times.hexdigest()[:32]),),
        protocol=protocol,
        **joined,
    )


Parts = Iterable[tuple[Exchanges, Poses | Tracks | None]]


def _blocks(source: Source) -> Iterator[tuple[Exchanges, Parts]]:
    """Yield the exchanges of a source block by block, each with its parts and the poses around each part."""
    if not isinstance(source, RecordedSource):
        exchanges = single_reports(source.exchanges).exchanges
        complete = len(exchanges) > 0 and bool(np.isfinite(exchanges.truth_m).all())
        yield exchanges, [(exchanges, None if complete else source.poses)]
        return
    windows = source.recording.pose_windows()
    for reports in single_report_blocks(source.recording, EXCHANGES_AT_ONCE):
        if len(block := reports.exchanges):
            complete = bool(np.isfinite(block.truth_m).all())
            yield block, [(block, None)] if complete else windows.tracks_beside(block)


def _words(protocol: NDArray[np.str_]) -> NDArray[np.str_]:
    """Return protocols of ranges (n,), without a copy for each where all are the same."""
    names = names_in(protocol)
    return np.broadcast_to(np.array(names[0]), len(protocol)) if len(names) == 1 else protocol


def _joined_words(parts: list[NDArray[np.str_]]) -> NDArray[np.str_]:
    parts = [part for part in parts if len(part)]
    if all(part.strides == (0,) for part in parts) and len({str(part[0]) for part in parts}) == 1:
        return np.broadcast_to(parts[0][0], sum(map(len, parts)))
    return np.concatenate(parts)


def held_open(data: Data) -> AbstractContextManager[Data]:
    """Return a context in which a file is open, for those who read it more than once; raises what opening it raises."""
    if isinstance(data, str | os.PathLike):
        return Recording.open(data, memory_mb=256)  # more does not read blocks any faster
    return nullcontext(data)


def antenna_delays_in(meta: Mapping[str, Any], source: str) -> AntennaDelays:
    """Return the programmed antenna delays that `meta` states; raises `BadInputError` where it cannot be understood."""
    try:
        return delays_in_meta(meta)
    except ValueError as error:
        raise BadInputError(f"{source}: {error}") from error


def antenna_delays_of(source: Source, name: str) -> AntennaDelays:
    """Return what was programmed into the tags of a source; raises what `antenna_delays_in` raises."""
    return antenna_delays_in(getattr(source, "meta", None) or {}, name)


def _planted(source: Source, name: str) -> Mapping[str, Any] | None:
    found = getattr(source, "planted", None) or getattr(source, "meta", {}).get("planted")
    if not isinstance(found, Mapping):
        return None
    check_planted(found, name)
    return found


def _why_no_power(exchanges: Exchanges) -> str:
    """Return a text on impossible powers, if there are any: no receiver gets more than a milliwatt."""
    given = np.concatenate([exchanges.fpp1_dbm, exchanges.fpp2_dbm])
    given = given[np.isfinite(given) & (given != 0)]
    if not len(given):
        return ""
    return (
        f"its powers are {np.median(given):+.4g} dBm, received ones lie between {FAINTEST_DBM:.0f} and "
        f"{LOUDEST_DBM:.0f} dBm; check their unit and sign"
    )


def _why_no_truth(source: Source) -> str:
    """Return how poses and exchanges lie in time, where no exchange has a true distance although there are poses."""
    poses, tags, time_ns = source.poses, source.tags, source.exchanges.time_ns
    if not len(poses) or not len(time_ns):
        return ""
    if not tags:
        return "it does not say which tag sits on which body; give tags with 'uwblink poses --tags'"
    missing = sorted({t.body for t in tags} - set(np.unique(poses.body).tolist()))
    if missing:
        return f"no poses of body {missing[0]}"
    start = int(poses.time_ns[0])
    spans = [((int(t.min()) - start) * 1e-9, (int(t.max()) - start) * 1e-9) for t in (poses.time_ns, time_ns)]
    return (
        f"its poses cover {spans[0][0]:.1f} to {spans[0][1]:.1f} s, its exchanges {spans[1][0]:.1f} to "
        f"{spans[1][1]:.1f} s after the first pose; shift the poses with 'uwblink poses --offset'"
    )


def check_planted(planted: Mapping[str, Any], where: str) -> None:
    """Raise `BadInputError`, beginning with `where`, for delays that are no numbers by tag and curves that are none."""
    delays = planted.get("delays_ns", {})
    if not isinstance(delays, Mapping) or not all(str(tag).isdecimal() for tag in delays):
        raise _wrong(where, "delays_ns", delays, "numbers by tag")
    if len(_numbers([*delays.values()])) != len(delays):
        raise _wrong(where, "delays_ns", delays, "numbers by tag")
    for name in ("bias_curve", "sigma_curve"):
        curve = planted.get(name)
        if curve and not _fits(curve):
            raise _wrong(where, name, curve, "knots, coefficients and degree of a B-spline")


def _fits(curve: Any) -> bool:
    if not isinstance(curve, Mapping):
        return False
    degree = curve.get("degree")
    knots, coefficients = _numbers(curve.get("knots")), _numbers(curve.get("coefficients"))
    if not isinstance(degree, int) or not 0 <= degree <= 5:
        return False
    sizes = len(coefficients) > degree and len(knots) == len(coefficients) + degree + 1
    return bool(sizes and (np.diff(knots) >= 0).all() and knots[degree] < knots[-1 - degree])


def _numbers(values: ArrayLike | None) -> Floats:
    """Return a list of numbers as an array, an empty one where one of them is none or beyond 1e9 ns, m or mW."""
    try:
        found = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)
    return found if found.ndim == 1 and (np.abs(found) <= 1e9).all() else np.empty(0)


def _wrong(where: str, key: str, found: object, expected: str) -> BadInputError:
    return BadInputError(f"{where}: planted: {key}: found {printable(repr(found))[:60]}, expected {expected}")


@dataclass(frozen=True, slots=True)
class Flight:
    """Ranges together with where bodies and tags were."""

    ranges: Ranges
    poses: Poses
    tags: list[Tag]

    def moving_bodies(self) -> list[str]:
        """Return the bodies whose position changes by more than a decimetre."""
        names = sorted(set(self.poses.body.tolist()))
        spans = {n: np.ptp(self.poses.position_m[self.poses.body == n], axis=0).max() for n in names}
        return [name for name in names if spans[name] > 0.1]


def require_times(ranges: Ranges) -> None:
    """Raise `UnanswerableError` if all ranges have the same time, as those without recorded times."""
    if len(ranges) > 1 and not np.ptp(ranges.time_ns):
        raise UnanswerableError(
            f"{ranges.source}: all of its {len(ranges)} ranges have the same time, so nothing can be tracked; import "
            "them with a column time_s"
        )


def load_flight(data: Data, *, need_power: bool = True) -> Flight:
    """Return a recording's ranges with its poses; raises what `load_ranges` raises."""
    with held_open(data) as held, opened(held) as (_, source):
        return Flight(load_ranges(held, need_power=need_power), source.poses, list(source.tags))
