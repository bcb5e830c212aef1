"""Single distances that were measured otherwise (a tape, a laser): when they hold, and of which antennas."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.errors import BadInputError
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.schema import Arrangement, KnownDistance

EVERY_S: Final = 0.4
"""A distance is one number for as long as it holds: it is said so often, each time with so much larger an error."""

SPAN: Final = re.compile(r"^\s*(\d+(?:\.\d*)?)\s*\.\.\s*(\d+(?:\.\d*)?)\s*$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Tapes:
    """Distances as instants at which they hold (k,): tags, seconds (NaN: always), metres, standard errors.

    The instants of one distance have its `number` and say together what it says; `told` names each distance, and
    `left_out` says of each that cannot be used why.
    """

    first: Ints
    second: Ints
    time_s: Floats
    distance_m: Floats
    std_m: Floats
    number: Ints
    told: tuple[KnownDistance, ...] = ()
    left_out: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Return the number of instants."""
        return len(self.number)

    def within(self, begin_s: float, end_s: float) -> Tapes:
        """Return those inside a span of time, and those that always hold."""
        return self._of(np.isnan(self.time_s) | ((self.time_s >= begin_s) & (self.time_s <= end_s)))

    def _of(self, rows: Bools) -> Tapes:
        names = ("first", "second", "time_s", "distance_m", "std_m", "number")
        return Tapes(**{name: getattr(self, name)[rows] for name in names}, told=self.told, left_out=self.left_out)


def no_tapes() -> Tapes:
    """Return no distances."""
    return _joined([], (), ())


def tapes_of(
    stated: Iterable[KnownDistance],
    arrangements: Iterable[Arrangement],
    bodies: Mapping[int, str],
    still: Collection[str],
    began_ns: int,
    last_s: float,
) -> Tapes:
    """Return when distances hold: between bodies that stand always, else while their arrangement lasts.

    `bodies` says which body each tag is on, `still` which of them stand. An arrangement is one of the recording's, or
    a span of seconds since the first range ("2..8"); a distance of none holds in all. Raises `BadInputError` for a tag
    or an arrangement that is not there, and for a number that is no distance.
    """
    spans: dict[str, tuple[float, float]] = {
        one.name: ((one.start_ns - began_ns) * 1e-9, (one.end_ns - began_ns) * 1e-9) for one in arrangements
    }
    parts: list[list[Floats]] = []
    told, left_out = list[KnownDistance](), list[str]()
    for one in stated:
        _check(one, bodies)
        when = _instants(one, spans, last_s)
        if {bodies[one.first], bodies[one.second]} <= set(still):
            when = np.array([np.nan])
        if not len(when):
            left_out.append(
                f"the distance of tags {one.first} and {one.second} is not used: nothing says when its bodies stood "
                "still; mark that arrangement, or say its seconds"
            )
            continue
        count = len(when)
        columns = (one.first, one.second, one.distance_m, one.sigma_m * np.sqrt(count), len(told))
        parts.append([when, *(np.full(count, float(value)) for value in columns)])
        told.append(one)
    return _joined(parts, tuple(told), tuple(left_out))


def _joined(parts: list[list[Floats]], told: tuple[KnownDistance, ...], left_out: tuple[str, ...]) -> Tapes:
    columns = [np.concatenate([part[k] for part in parts]) if parts else np.zeros(0) for k in range(6)]
    when, first, second, distance, std, number = columns
    return Tapes(
        first=first.astype(np.int64),
        second=second.astype(np.int64),
        time_s=when,
        distance_m=distance,
        std_m=std,
        number=number.astype(np.int64),
        told=told,
        left_out=left_out,
    )


def _check(one: KnownDistance, bodies: Mapping[int, str]) -> None:
    for tag in (one.first, one.second):
        if tag not in bodies:
            there = ", ".join(map(str, sorted(bodies)))
            raise BadInputError(f"found tag {tag}, the tags that range are {there}", parameter="distances")
    if bodies[one.first] == bodies[one.second]:
        raise BadInputError(
            f"tags {one.first} and {one.second} are on one body, whose lever arms say how far apart they are",
            parameter="distances",
        )
    for value, what in ((one.distance_m, "distance"), (one.sigma_m, "standard error")):
        if not (np.isfinite(value) and value > 0):
            raise BadInputError(
                f"found {value!r} as the {what} of tags {one.first} and {one.second}, expected metres above 0",
                parameter="distances",
            )


def _instants(one: KnownDistance, spans: Mapping[str, tuple[float, float]], last_s: float) -> Floats:
    """Return the seconds at which a distance between moving bodies is said to hold."""
    found = [_between(begin, end, last_s) for begin, end in _spans(one.arrangement, spans)]
    return np.concatenate([np.zeros(0), *found])


def _spans(name: str, spans: Mapping[str, tuple[float, float]]) -> Iterator[tuple[float, float]]:
    if not name:
        yield from spans.values()
        return
    seconds = SPAN.match(name)
    if name not in spans and seconds is None:
        there = ", ".join(spans) or "none"
        raise BadInputError(
            f"found the arrangement {name!r:.40}, the recording has {there}; or give seconds, as in 2..8",
            parameter="distances",
        )
    yield spans[name] if seconds is None or name in spans else (float(seconds[1]), float(seconds[2]))


def _between(begin_s: float, end_s: float, last_s: float) -> Floats:
    begin, end = max(begin_s, 0.0), min(end_s, last_s)
    if not begin <= end:
        return np.zeros(0)
    count = max(int((end - begin) / EVERY_S), 1)
    return np.asarray(begin + (np.arange(count) + 0.5) * (end - begin) / count)
