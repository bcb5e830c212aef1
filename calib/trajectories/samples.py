"""What is known of a flight beside its ranges, as samples in time: positions, heights, distances by tape."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from calib.errors import BadInputError
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.schema import Arrangement, KnownDistance

TAPE_EVERY_S = 0.4
"""A taped distance is one measurement. While it holds it counts once in so many seconds, with a standard error that
grows by the square root of the number of instants."""

SPAN = re.compile(r"^\s*(\d+(?:\.\d*)?)\s*\.\.\s*(\d+(?:\.\d*)?)\s*$")

HEIGHT_WINDOW_S = 0.1
HEIGHT_STD_M = 0.1
"""Standard error of the mean of a window beside the sensor's constant offset, before residuals are known."""

HEIGHT_TRUST = 3.0
"""Factor on the spread of residuals: errors of a height sensor last for some windows."""

HEIGHT_BOUNDS_M = (0.02, 1.0)
HUBER = 2.0
"""Readings beyond so many spreads count less (Huber 1964): the sensor looks at what stands below it."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Columns of one length (k,); `time_s` are the seconds at which they hold, NaN for always."""

    time_s: Floats

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_s)

    def __getitem__(self, rows: Bools | Ints) -> Self:
        """Return the chosen samples."""
        columns = {one.name: getattr(self, one.name) for one in fields(self)}
        return replace(self, **{name: some[rows] for name, some in columns.items() if isinstance(some, np.ndarray)})

    def between(self, begin_s: float, end_s: float) -> Self:
        """Return the samples inside a span of time, and those that always hold."""
        return self[np.isnan(self.time_s) | ((self.time_s >= begin_s) & (self.time_s <= end_s))]


@dataclass(frozen=True, slots=True)
class Places(Samples):
    """Known positions of moving bodies: number of the body (k,), metres (k, 3), standard errors (k,)."""

    body: Ints
    position_m: Floats
    std_m: Floats

    def __add__(self, other: Places) -> Places:
        """Return both."""
        return Places(*(np.concatenate([getattr(self, one.name), getattr(other, one.name)]) for one in fields(self)))


@dataclass(frozen=True, slots=True)
class Heights(Samples):
    """Mean heights of moving bodies: number of the body (k,), metres (k,), standard errors (k,)."""

    body: Ints
    height_m: Floats
    std_m: Floats

    def reweighted(self, residual: Floats) -> Heights:
        """Return the readings with standard errors from their residuals (k,), in units of the present ones."""
        if not len(residual):
            return self
        residual_m = residual * self.std_m
        spread = float(np.clip(HEIGHT_TRUST * robust_spread(residual_m, 0.0), *HEIGHT_BOUNDS_M))
        weight = np.minimum(1.0, HUBER * spread / HEIGHT_TRUST / np.maximum(np.abs(residual_m), 1e-9))
        return replace(self, std_m=spread / np.sqrt(weight))


def no_heights() -> Heights:
    """Return no readings."""
    return Heights(np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))


def heights_of(table: Mapping[str, NDArray[Any]], moving: Sequence[str], began_ns: int, last_s: float) -> Heights:
    """Return the readings of moving bodies in a recording's table, as medians over windows."""
    if not table:
        return no_heights()
    found = []
    for number, body in enumerate(moving):
        rows = np.flatnonzero((table["body"] == body) & np.isfinite(table["height_m"]))
        time = np.asarray((table["time_ns"][rows] - began_ns) * 1e-9, dtype=np.float64)
        inside = (time >= 0) & (time <= last_s)
        order = np.argsort(time[inside], kind="stable")
        time, height = time[inside][order], np.asarray(table["height_m"][rows][inside][order], dtype=np.float64)
        starts = np.flatnonzero(np.diff(np.floor(time / HEIGHT_WINDOW_S), prepend=-np.inf))[1:]
        for times, heights in zip(np.split(time, starts), np.split(height, starts), strict=True):
            if len(times):
                found.append((float(np.mean(times)), number, float(np.median(heights)), HEIGHT_STD_M))
    time, body_number, height, std = np.array(found).reshape(-1, 4).T
    return Heights(time, body_number.astype(np.int64), height, std)


@dataclass(frozen=True, slots=True)
class Tapes(Samples):
    """Distances by tape at instants (k,): tags, metres, standard errors, and the number of the statement.

    All instants of one statement together carry its information. `stated` are the statements that are used,
    `left_out` says of each other one why it is not.
    """

    first: Ints
    second: Ints
    distance_m: Floats
    std_m: Floats
    number: Ints
    stated: tuple[KnownDistance, ...] = ()
    left_out: tuple[str, ...] = ()


def no_tapes() -> Tapes:
    """Return no distances."""
    return tapes_of((), (), {}, (), 0, 0.0)


def tapes_of(
    stated: Iterable[KnownDistance],
    arrangements: Iterable[Arrangement],
    bodies: Mapping[int, str],
    still: Collection[str],
    began_ns: int,
    last_s: float,
) -> Tapes:
    """Return when distances hold: always between bodies that stand, else while their arrangement lasts.

    `bodies` gives the body of each tag, `still` names the bodies that stand. An arrangement is one of the recording's,
    or a span of seconds since the first range ("2..8"); a distance without one holds in all arrangements. Raises
    `BadInputError` for an unknown tag or arrangement, and for a distance that is not a positive number.
    """
    spans = {one.name: ((one.start_ns - began_ns) * 1e-9, (one.end_ns - began_ns) * 1e-9) for one in arrangements}
    rows, used, left_out = list[tuple[float, ...]](), list[KnownDistance](), list[str]()
    for one in stated:
        _check_distance(one, bodies)
        times = _instants(one, spans, last_s)
        if {bodies[one.first], bodies[one.second]} <= set(still):
            times = [np.nan]
        if not times:
            left_out.append(
                f"the distance of tags {one.first} and {one.second} is not used: nothing says when its bodies stood "
                "still; mark that arrangement, or say its seconds"
            )
            continue
        std_m = one.sigma_m * np.sqrt(len(times))
        rows += [(time, one.first, one.second, one.distance_m, std_m, len(used)) for time in times]
        used.append(one)
    time_s, first, second, distance_m, std, number = np.array(rows, dtype=np.float64).reshape(-1, 6).T
    whole = [ids.astype(np.int64) for ids in (first, second, number)]
    return Tapes(time_s, whole[0], whole[1], distance_m, std, whole[2], tuple(used), tuple(left_out))


def _check_distance(one: KnownDistance, bodies: Mapping[int, str]) -> None:
    for tag in (one.first, one.second):
        if tag not in bodies:
            raise BadInputError(
                f"found tag {tag}, the tags that range are {', '.join(map(str, sorted(bodies)))}", parameter="distances"
            )
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


def _instants(one: KnownDistance, spans: Mapping[str, tuple[float, float]], last_s: float) -> list[float]:
    """Return the seconds at which a distance between moving bodies counts."""
    seconds = SPAN.match(one.arrangement)
    if not one.arrangement:
        chosen = list(spans.values())
    elif one.arrangement in spans:
        chosen = [spans[one.arrangement]]
    elif seconds:
        chosen = [(float(seconds[1]), float(seconds[2]))]
    else:
        raise BadInputError(
            f"found the arrangement {one.arrangement!r:.40}, the recording has {', '.join(spans) or 'none'}; or give "
            "seconds, as in 2..8",
            parameter="distances",
        )
    found = list[float]()
    for begin, end in chosen:
        begin_s, length_s = max(begin, 0.0), min(end, last_s) - max(begin, 0.0)
        if length_s >= 0:
            count = max(int(length_s / TAPE_EVERY_S), 1)
            found += (begin_s + (np.arange(count) + 0.5) * length_s / count).tolist()
    return found
