"""Sources of ranges: paths of recordings, open recordings, simulations in memory, data frames."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from calib.data.arrivals import arrivals_of
from calib.data.features import features_of
from calib.data.ranges import (
    FAINTEST_DBM,
    IN_MEMORY,
    LOUDEST_DBM,
    Ranges,
    concatenate,
    contents_of_frame,
    measured_powers,
    without_static,
)
from calib.errors import BadInputError, TemperatureWarning, UnanswerableError
from uwblink.arrays import Floats, Ints, is_frame
from uwblink.display import printable
from uwblink.errors import restating, warn
from uwblink.recording.antenna_delays import AntennaDelays, delays_in_meta
from uwblink.recording.contents import Contents
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses, Tag
from uwblink.recording.summary import single_reports
from uwblink.twr import Exchanges, without_stamps


@runtime_checkable
class Source(Protocol):
    """An object with exchanges, poses of bodies, and tags, such as the result of a simulation.

    Optional attributes: `planted`, parameters of a simulation, for display only; `meta`, with programmed antenna delays
    and perhaps `planted`; `faults`; `overheard`, `temperature` and `differences`, columns of the recording's tables;
    `cirs`, impulse responses.
    """

    @property
    def exchanges(self) -> Exchanges:
        """The exchanges, in order of time."""

    @property
    def poses(self) -> Poses:
        """Poses of the bodies; may be empty if the exchanges have true distances."""

    @property
    def tags(self) -> Sequence[Tag]:
        """The tags with their bodies and lever arms."""


Data = str | os.PathLike[str] | Recording | Source | Exchanges | Ranges
"""One recording: its path, an open `Recording`, a `Source`, exchanges with true distances, or `Ranges`."""


READERS: Final[dict[str, Callable[[Recording], Any]]] = {
    "exchanges": Recording.exchanges,
    "poses": Recording.poses,
    "tags": Recording.tags,
    "meta": Recording.meta,
    "faults": Recording.faults,
    **{
        table: partial(Recording.columns, table=table)
        for table in ("overheard", "imu", "height", "temperature", "differences")
    },
    "arrangements": Recording.arrangements,
    "known_distances": Recording.known_distances,
}
"""Functions that read the parts of a recording, by the name of the part."""


class RecordedSource:
    """An open recording as a `Source`, with all parts in `READERS` as attributes."""

    def __init__(self, recording: Recording) -> None:
        """Take a recording, which must stay open."""
        self.recording = recording

    def __getattr__(self, name: str) -> Any:
        """Read a part when it is first used."""
        if name not in READERS:
            raise AttributeError(name)
        self.__dict__[name] = READERS[name](self.recording)
        return self.__dict__[name]


@contextmanager
def opened(data: Data) -> Iterator[tuple[str, Source]]:
    """Yield a name and a `Source`, which is valid inside the `with` block.

    Raises the errors of `Recording.open`, and `BadInputError` for an object of another type.
    """
    with held_open(data) as held:
        if isinstance(held, Recording):
            yield held.path.name, RecordedSource(held)
        elif isinstance(held, Exchanges):
            yield IN_MEMORY, Contents(exchanges=held)
        elif is_frame(held):
            yield "data frame", contents_of_frame(held)
        elif isinstance(held, Ranges):
            raise BadInputError("Ranges contain no positions of bodies; give the recording instead", parameter="data")
        elif isinstance(held, Source):
            yield str(getattr(held, "name", IN_MEMORY)), held
        else:
            raise _no_recording(held)


def _no_recording(data: object) -> BadInputError:
    return BadInputError(
        f"found {type(data).__name__}, expected a path, a Recording, Exchanges, Ranges, a data frame, or an object "
        "with exchanges, poses and tags",
        parameter="data",
    )


def load_ranges(
    data: Data | Iterable[Data], *, trim_static: bool = False, need_power: bool = True, use: str = "exchanges"
) -> Ranges:
    """Return the usable ranges of one or several recordings with their true distances.

    `data` is the path of a recording, an open `Recording`, `Exchanges` with their true distances, `Ranges`, a data
    frame (`Ranges.from_dataframe`), any object with `exchanges`, `poses` and `tags` (a simulation in memory), or
    several of these. `trim_static` leaves out spans of two seconds in which the distance of a pair changes by at most
    two centimetres. Ranges without any power are left out unless `need_power` is False. Differences of arrival at tags
    that overheard the exchanges are in `arrivals`; with `use` "receptions", differences of arrival without stamps are
    rows. Raises the errors of `Recording.open`, `BadInputError` if a recording is given twice, and `UnanswerableError`
    if no range is usable.

    >>> import calib
    >>> own = calib.Ranges.from_arrays([3.1, 4.2], initiator=1, target=2, fpp1_dbm=-85.0, truth_m=[3.0, 4.0])
    >>> calib.load_ranges(own)
    <Ranges of memory: 2 of tags 1, 2>
    """
    parts = load_each(data, trim_static=trim_static, need_power=need_power, use=use)
    return parts[0] if len(parts) == 1 else concatenate(parts)


def load_each(
    data: Data | Iterable[Data], *, trim_static: bool = False, need_power: bool = True, use: str = "exchanges"
) -> list[Ranges]:
    """Return the ranges of each recording; arguments and errors are those of `load_ranges`.

    Raises `BadInputError` if two recordings have the same exchanges, which would make intervals too small.
    """
    given = each(data)
    parts = [
        one.usable(need_power=need_power)
        if isinstance(one, Ranges)
        else load_flight(one, need_power=need_power, use=use).ranges
        for one in given
    ]
    # Parts of one recording are `Ranges` with the same fingerprint of the recording, but with other rows.
    contents = [
        ((part.source, fingerprint_of(part.time_ns, part.raw_m)),) if isinstance(one, Ranges) else part.recordings
        for one, part in zip(given, parts, strict=True)
    ]
    refuse_repeated(recording for several in contents for recording in several)
    return [without_static(part) for part in parts] if trim_static else parts


def fingerprint_of(*columns: Floats | Ints) -> str:
    """Return a fingerprint of a recording from columns that differ between recordings: times and ranges."""
    return sha256(b"".join(column.tobytes() for column in columns)).hexdigest()[:32]


def refuse_repeated(recordings: Iterable[tuple[str, str]]) -> None:
    """Raise `BadInputError` if two recordings, given by name and fingerprint, hold the same exchanges.

    Counted twice, exchanges make intervals too narrow by the root of 2.
    """
    seen: dict[str, str] = {}
    for name, fingerprint in recordings:
        if fingerprint in seen:
            raise BadInputError(f"{name}: contains the same exchanges as {seen[fingerprint]}; give each recording once")
        seen[fingerprint] = name


def each(data: Data | Iterable[Data]) -> list[Data]:
    """Return one or several recordings as a list; raises `BadInputError` if there is none, and for other types."""
    one: Any = data
    if isinstance(data, str | os.PathLike | Recording | Ranges | Exchanges | Source) or is_frame(data):
        return [one]
    # Iterating over a mapping would take its keys for paths.
    if not isinstance(data, Iterable) or isinstance(data, Mapping):
        raise _no_recording(data)
    found = list(data)
    if not found:
        raise BadInputError("no recording was given", parameter="data")
    return found


def held_open(data: Data) -> AbstractContextManager[Data]:
    """Return a context manager that gives an open recording for a path, and other data unchanged.

    An open recording can be read several times. Raises the errors of `Recording.open`.
    """
    if isinstance(data, str | os.PathLike):
        return Recording.open(data, memory_mb=256)
    return nullcontext(data)


def antenna_delays_in(meta: Mapping[str, Any], source: str) -> AntennaDelays:
    """Return the programmed antenna delays in `meta`; raises `BadInputError` if their form is wrong."""
    with restating(BadInputError, ValueError, where=f"{source}: "):
        return delays_in_meta(meta)


def planted_of(source: Source, name: str) -> Mapping[str, Any] | None:
    """Return the planted parameters of a simulation, None without any.

    Raises `BadInputError`, whose text starts with `name`, for planted delays and curves of a wrong form.
    """
    planted = getattr(source, "planted", None) or getattr(source, "meta", {}).get("planted")
    if not isinstance(planted, Mapping):
        return None
    for key, (read, form) in FORMS.items():
        try:
            if planted.get(key) is not None:
                read(planted[key])
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
            found = printable(repr(planted[key]))[:60]
            raise BadInputError(f"{name}: planted: {key}: found {found}, expected {form}") from None
    return planted


def _why_no_power(exchanges: Exchanges) -> str:
    """Return a text on powers outside the possible ones; "" if all powers are 0 or NaN, as of boards without powers."""
    given = np.concatenate([exchanges.fpp1_dbm, exchanges.fpp2_dbm])
    given = given[np.isfinite(given) & (given != 0)]
    if not len(given):
        return ""
    return (
        f"the median of its powers is {np.median(given):+.4g} dBm, but received powers lie between "
        f"{FAINTEST_DBM:.0f} and "
        f"{LOUDEST_DBM:.0f} dBm; check their unit and sign"
    )


def _why_no_truth(source: Source) -> str:
    """Return why poses give no exchange a true distance: no tags, no poses of a body, other times; "" without poses."""
    poses, tags, time_ns = source.poses, source.tags, source.exchanges.time_ns
    if not len(poses) or not len(time_ns):
        return ""
    if not tags:
        return "it has no tags with bodies and lever arms; add them with 'uwblink poses --tags'"
    missing = sorted({t.body for t in tags} - set(np.unique(poses.body).tolist()))
    if missing:
        return f"no poses of body {missing[0]}"
    start = int(poses.time_ns[0])
    spans = [((int(t.min()) - start) * 1e-9, (int(t.max()) - start) * 1e-9) for t in (poses.time_ns, time_ns)]
    return (
        f"its poses cover {spans[0][0]:.1f} to {spans[0][1]:.1f} s after the first pose, its exchanges "
        f"{spans[1][0]:.1f} to {spans[1][1]:.1f} s; shift the poses with 'uwblink poses --offset'"
    )


def _delays(found: Any) -> None:
    _numbers([*found.values()])
    if not all(str(tag).isdecimal() for tag in found):
        raise ValueError("a key is no tag")


def _curve(found: Any) -> None:
    BSpline(_numbers(found["knots"]), _numbers(found["coefficients"]), found["degree"])


def _numbers(values: ArrayLike) -> Floats:
    """Return a list of numbers as an array (n,); raises `ValueError` for NaN and for values beyond 1e9."""
    found = np.array(values, dtype=np.float64)
    if found.ndim != 1 or not (np.abs(found) <= 1e9).all():
        raise ValueError("not a list of usable numbers")
    return found


CURVE: Final = (_curve, "knots, coefficients and degree of a B-spline")
FORMS: Final = {"delays_ns": (_delays, "numbers by tag"), "bias_curve": CURVE, "sigma_curve": CURVE}
"""Values that a simulation may have planted, with their checks and descriptions."""


@dataclass(frozen=True, slots=True)
class Flight:
    """Ranges with poses and tags, and columns of tables of sensors by the table's name."""

    ranges: Ranges
    poses: Poses
    tags: list[Tag]
    sensors: Mapping[str, Mapping[str, NDArray[Any]]] = field(default_factory=dict)

    def moving_bodies(self) -> list[str]:
        """Return the bodies whose position changes by more than 0.1 m along an axis."""
        tracks = {name: self.poses.position_m[self.poses.body == name] for name in np.unique(self.poses.body).tolist()}
        return [name for name, track in tracks.items() if np.ptp(track, axis=0).max() > 0.1]


def require_times(ranges: Ranges) -> None:
    """Raise `UnanswerableError` if all ranges have the same time, as in tables without times."""
    if len(ranges) > 1 and not np.ptp(ranges.time_ns):
        raise UnanswerableError(
            f"{ranges.source}: all of its {len(ranges)} ranges have the same time, so tracking is impossible; import "
            "them with a column time_s"
        )


def require_arrivals(ranges: Ranges) -> None:
    """Raise `UnanswerableError` if there are no differences of arrival, with or without stamps."""
    if (ranges.arrivals is None or not len(ranges.arrivals)) and not ranges.differences.any():
        raise UnanswerableError(
            f"{ranges.source}: no listener overheard an exchange between tags with known distances; record with "
            "passive tags, or use exchanges",
            parameter="use",
        )


def ranges_of(source: Source, name: str, *, truth: bool = True) -> tuple[Exchanges, Ranges]:
    """Return the exchanges of a source, and a range for each, with all that the source knows of it.

    If both ends reported an exchange, one report is used. With `truth` False, true distances and poses are not used:
    distances and directions are NaN. Raises `BadInputError` if planted values or antenna delays have a wrong form, and
    if ranges are corrected already: those without stamps hold what `calib apply` wrote.
    """
    exchanges, warm = single_reports(source.exchanges).exchanges, getattr(source, "temperature", None)
    meta = getattr(source, "meta", None) or {}
    if "calibration" in meta and without_stamps(exchanges).any():
        raise BadInputError(
            f"{name}: its ranges without stamps are already corrected; use the recording from which they were made"
        )
    found = Ranges.from_exchanges(
        exchanges,
        None if truth else np.full(len(exchanges), np.nan),
        poses=source.poses if truth else None,
        tags=source.tags,
        planted=planted_of(source, name),
        source=name,
        antenna_delays=antenna_delays_in(meta, name),
        temperature=warm,
    )
    celsius = found.temperature_c[np.isfinite(found.temperature_c)]
    if len(found) and warm and len(warm["tag"]) and not len(celsius):
        text = f"{name}: no temperatures of ranging tags within 30 s of their ranges: they are not used"
        warn(text, TemperatureWarning)
    # Boards in rooms are colder than 45 °C. If all readings are above 45, they are probably in °F (45 °F are 7 °C).
    if len(celsius) and celsius.min() > 45:
        read = f"{name}: temperatures are {celsius.min():.0f} to {celsius.max():.0f} °C"
        text = f"{read}; if they are degrees Fahrenheit, import them again as (F - 32) / 1.8"
        warn(text, TemperatureWarning)
    bare = getattr(source, "differences", None) or {"difference_m": np.zeros(0)}
    fingerprint = fingerprint_of(exchanges.time_ns, exchanges.range_m, bare["difference_m"])
    return exchanges, replace(found, features=features_of(exchanges, source), recordings=((name, fingerprint),))


def load_flight(
    data: Data,
    *,
    need_power: bool = True,
    need_truth: bool = True,
    use: str = "exchanges",
    sensors: Sequence[str] = (),
) -> Flight:
    """Return the usable ranges of a recording with its poses and tags.

    If both ends reported an exchange, one report is used. With `need_truth` False, ranges and differences of arrival
    without true distances are kept. With `use` "receptions", differences without stamps are rows. `sensors` are names
    of tables to read as well.

    Raises the errors of `opened`, `BadInputError` if planted values or antenna delays have a wrong form, and
    `UnanswerableError` if no range is usable.
    """
    with opened(data) as (name, source):
        exchanges, found = ranges_of(source, name)
        heard = getattr(source, "overheard", None)
        if heard and len(heard["time_ns"]):
            arrivals = arrivals_of(exchanges, found.raw_m, heard, source.poses, source.tags, need_truth=need_truth)
            powered = np.isfinite(measured_powers(arrivals.poll_dbm) + measured_powers(arrivals.response_dbm))
            found = replace(found, arrivals=arrivals[powered | (not need_power)])
        bare = getattr(source, "differences", None)
        if bare and len(bare["time_ns"]):
            found = _with_differences(found, bare, source, need_power=need_power, use=use)
        reasons = _why_no_truth(source), _why_no_power(exchanges)
        usable = found.usable(*reasons, need_power=need_power, need_truth=need_truth)
        tables = {table: dict(getattr(source, table, None) or {}) for table in sensors}
        return Flight(usable, source.poses, list(source.tags), tables)


def _with_differences(
    found: Ranges, bare: Mapping[str, NDArray[Any]], source: Source, *, need_power: bool, use: str
) -> Ranges:
    """Return ranges; with `use` "receptions" followed by the rows of a table `differences`.

    Raises `UnanswerableError` if the differences would need powers, and if there is nothing else and they are not used.
    """
    if use == "receptions":
        if need_power:
            raise UnanswerableError(
                f"{found.source}: differences of arrival without stamps have no powers, so a curve over power cannot "
                f"correct them: use a calibration fitted with `delays_only`"
            )
        apart = Ranges.from_differences(bare, poses=source.poses, tags=list(source.tags), source=found.source)
        return Ranges.concatenate([found, apart])
    if not len(found):
        raise UnanswerableError(
            f"{found.source}: holds {len(bare['time_ns'])} differences of arrival and no exchanges: only `calib fit` "
            "and `calib localize` (not with `model` team) use them, with `use` receptions"
        )
    return found


def sensor_rows(
    table: Mapping[str, NDArray[Any]], body: str, names: Sequence[str], began_ns: int
) -> tuple[Floats, Floats]:
    """Return times in seconds (n,) since `began_ns`, and columns (n, names) of a body's rows in a table of sensors.

    Rows are in order of time; of several rows with the same time, the first one is used.
    """
    if not table:
        return np.zeros(0), np.zeros((0, len(names)))
    mine = np.flatnonzero(table["body"] == body)
    time_ns, first = np.unique(table["time_ns"][mine], return_index=True)
    columns = np.column_stack([np.asarray(table[name][mine[first]], dtype=np.float64) for name in names])
    return np.asarray((time_ns - began_ns) * 1e-9), columns
