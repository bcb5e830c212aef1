"""What is known of a flight beside its ranges, as samples in time: positions, heights, distances by tape."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from calib.errors import BadInputError
from calib.spread import medians, robust_spread
from uwblink.arrays import ColumnTable, Floats, Ints
from uwblink.recording.schema import Arrangement, KnownDistance

POINT_S = 0.4
"""Time between control points of a path: a multirotor does not change its acceleration faster.

A taped distance is one measurement. While it holds it counts once in this time, with a standard error that grows by the
square root of the number of instants.
"""

SAMPLE_S = POINT_S / 4
"""Time between known positions, heights (medians over it) and positions of an initial guess, and over which specific
forces are averaged: vibrations cancel, and the acceleration of a spline hardly changes."""

HEIGHT_STD_M = 0.1
"""Standard error of the mean of a window beside the sensor's constant offset, before residuals are known."""

TRUSTED = 3.0
"""Factor on the spread of a sensor's residuals: its errors last for some windows."""

HEIGHT_BOUNDS_M = (0.02, 1.0)
"""Bounds of the standard error of a height: how level floors are, and nearly half the height of a room."""

HUBER = 2.0
"""Readings beyond so many spreads count less (Huber 1964): the sensor looks at what stands below it."""


@dataclass(frozen=True, slots=True)
class Samples(ColumnTable):
    """Columns of one length (k,); `time_s`, in the place of `time_ns`, are the seconds at which they hold.

    NaN stands for always.
    """

    time_s: Floats

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_s)

    def between(self, begin_s: float, end_s: float) -> Self:
        """Return the samples inside a span of time, and those that always hold."""
        return self[np.isnan(self.time_s) | ((self.time_s >= begin_s) & (self.time_s <= end_s))]


@dataclass(frozen=True, slots=True)
class Places(Samples):
    """Known positions of moving bodies: number of the body (k,), metres (k, 3), standard errors (k,)."""

    body: Ints
    position_m: Floats
    std_m: Floats


@dataclass(frozen=True, slots=True)
class Heights(Samples):
    """Median heights of moving bodies: number of the body (k,), metres (k,), standard errors (k,)."""

    body: Ints
    height_m: Floats
    std_m: Floats

    def reweighted(self, residual_m: Floats) -> Heights:
        """Return the readings with standard errors from their residuals (k,)."""
        if not len(self):
            return self
        std_m = float(np.clip(TRUSTED * robust_spread(residual_m, 0.0), *HEIGHT_BOUNDS_M))
        weight = np.minimum(1.0, HUBER * std_m / TRUSTED / np.maximum(np.abs(residual_m), 1e-9))
        return replace(self, std_m=std_m / np.sqrt(weight))


def heights_of(table: Mapping[str, NDArray[Any]], moving: Sequence[str], began_ns: int, last_s: float) -> Heights:
    """Return the readings of moving bodies in a recording's table, as medians over windows."""
    if not table:
        return Heights(np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))
    time_s, height_m = (table["time_ns"] - began_ns) * 1e-9, np.asarray(table["height_m"], dtype=np.float64)
    number = np.select([table["body"] == body for body in moving], range(len(moving)), -1)
    rows = np.flatnonzero((number >= 0) & np.isfinite(height_m) & (time_s >= 0) & (time_s <= last_s))
    window = np.column_stack([number, np.floor(time_s / SAMPLE_S)])[rows]
    group = np.unique(window, axis=0, return_inverse=True)[1].ravel()
    time, body, height = (medians(column[rows], group) for column in (time_s, number, height_m))
    return Heights(time, body.astype(np.int64), height, np.full(len(time), HEIGHT_STD_M))


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
        if wrong := _unusable(one, bodies):
            raise BadInputError(wrong, parameter="distances")
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


def _unusable(one: KnownDistance, bodies: Mapping[int, str]) -> str:
    """Return why a distance cannot be used, "" if it can."""
    pair = f"tags {one.first} and {one.second}"
    for tag in (one.first, one.second):
        if tag not in bodies:
            return f"found tag {tag}, the tags that range are {', '.join(map(str, sorted(bodies)))}"
    if bodies[one.first] == bodies[one.second]:
        return f"{pair} are on one body, whose lever arms say how far apart they are"
    for value, what in ((one.distance_m, "distance"), (one.sigma_m, "standard error")):
        if not (np.isfinite(value) and value > 0):
            return f"found {value!r} as the {what} of {pair}, expected metres above 0"
    return ""


def _instants(one: KnownDistance, spans: Mapping[str, tuple[float, float]], last_s: float) -> list[float]:
    """Return the seconds at which a distance between moving bodies counts."""
    seconds = re.match(r"^\s*(\d+(?:\.\d*)?)\s*\.\.\s*(\d+(?:\.\d*)?)\s*$", one.arrangement)
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
    for start, end in chosen:
        begin_s, end_s = max(start, 0.0), min(end, last_s)
        if begin_s <= end_s:
            count = max(int((end_s - begin_s) / POINT_S), 1)
            found += np.linspace(begin_s, end_s, 2 * count + 1)[1::2].tolist()
    return found
