"""Anchors that do not stand where the recording says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import special

from calib.doctor.base import RecordingView, chosen
from calib.doctor.checks import Seen, narrower
from calib.doctor.levels import DOF, Levels, levels, variance_of_sum
from calib.doctor.pairs import standing_still
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.distances import antennas_m

ELSEWHERE: Final = "anchor stands elsewhere"
TOLERANCE_M: Final = 0.05
"""What a place by tape or markers is off by, with the antenna beside the marker."""

LARGEST_M: Final = 50.0
FEWEST: Final = 200
ROUNDS: Final = 20
LONGEST_STEP_M: Final = 1.0
ASTRAY_M: Final = 0.3
"""Spread of an anchor's ranges beyond which its place is wrong by more than power and noise explain."""

STILL_M: Final = 0.02
SAME_PLACE_M: Final = 0.3
"""A place nearer to another anchor's is that anchor's."""

SURE: Final = 0.1
"""Part of a displacement that is not known: powers, that other distances have, are not taken off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Displaced:
    """By how much an anchor stands elsewhere (3,), its ranges' spreads in metres, p-value and gain; see `Seen`.

    `instead` are the bodies that the recording has at the place, or below or above it.
    """

    body: str
    away_m: Floats
    before_m: float
    after_m: float
    p_value: float
    gain: float
    instead: tuple[str, ...]


def anchors(view: RecordingView) -> Iterator[Seen]:
    """Anchors whose ranges ask for another place."""
    for one in displaced(view):
        x, y, z = one.away_m
        there = f"; there the recording has {' and '.join(one.instead)}: are numbers exchanged?" if one.instead else ""
        yield Seen(
            ELSEWHERE,
            f"ranges with {one.body} fit a place {np.linalg.norm(one.away_m):.2f} m away ({x:+.2f} {y:+.2f} {z:+.2f} m"
            f"): their spread is {100 * one.after_m:.1f} cm there instead of {100 * one.before_m:.1f} cm{there}",
            one.p_value,
            {"body": one.body},
            one.gain,
        )


def displaced(view: RecordingView) -> list[Displaced]:
    """Return the anchors that may stand elsewhere."""
    # Where nothing moves, each pair has a level that is its own.
    known = levels(view) if view.posed and standing_still(view) is None else None
    if known is None:
        return []
    places = {body: place_m(view, body) for body in standing(view)}
    found = [_displaced(view, known, body, places) for body in places]
    return [one for one in found if one is not None and one.p_value < 1]


def standing(view: RecordingView) -> list[str]:
    """Return the bodies that carry tags and do not move."""
    bodies = sorted({tag.body for tag in view.tags} & set(np.unique(view.poses.body).tolist()))
    spans = {body: np.ptp(view.poses.position_m[view.poses.body == body], axis=0).max() for body in bodies}
    return [body for body in bodies if spans[body] < STILL_M]


def place_m(view: RecordingView, body: str) -> Floats:
    """Return where a body stands (3,)."""
    return np.asarray(np.median(view.poses.position_m[view.poses.body == body], axis=0))


def _displaced(view: RecordingView, known: Levels, body: str, places: dict[str, Floats]) -> Displaced | None:
    tags = [tag.tag for tag in view.tags if tag.body == body]
    e = view.exchanges[known.rows]
    mine = np.isin(e.initiator, tags) != np.isin(e.target, tags)
    if np.count_nonzero(mine) < FEWEST:
        return None
    some, pair = e[mine], known.pair[mine]
    own = np.where(np.isin(some.initiator, tags), some.initiator, some.target)
    other = np.where(np.isin(some.initiator, tags), some.target, some.initiator)
    here, there = (antennas_m(view.poses, view.tags, ids, some.time_ns) for ids in (own, other))
    apart = here - there
    # Where anchors are metres off, what power does is not known, and small beside that.
    left = known.rest[mine]
    if robust_spread(left) > ASTRAY_M:
        left = view.error_m[known.rows][mine]
    measured = left + np.linalg.norm(apart, axis=1)
    good = np.isfinite(measured)
    if np.count_nonzero(good) < FEWEST:
        return None
    apart, measured, time_s = apart[good], measured[good], known.time_s[mine][good]
    ends = np.unique(pair[good], return_inverse=True)[1]
    starts = [place - places[body] for place in places.values()]
    tried = [place for start in starts if (place := _fitted(apart, measured, ends, start)) is not None]
    if not tried:
        return None
    away = min(tried, key=lambda d: robust_spread(_linear(apart + d, measured, ends)[1]))
    before, after = (robust_spread(_linear(apart + d, measured, ends)[1]) for d in (np.zeros(3), away))
    gain = _undone(view, known.rows[_within(mine, good)], apart, away)
    if gain <= 0 or after > before:
        return None
    p_value = _beyond_tolerance(*_linear(apart + away, measured, ends), away, time_s, after)
    # A robot that moves in a plane does not see heights, so that places above and below each other are alike.
    at = [name for name, place in places.items() if name != body and _near(place - places[body], away)]
    return Displaced(
        body=body,
        away_m=away,
        before_m=before,
        after_m=after,
        p_value=min(1.0, p_value * len(places)),
        gain=gain,
        instead=tuple(at),
    )


def _within(rows: Bools, good: Bools) -> Ints:
    return np.flatnonzero(rows)[good]


def _near(first: Floats, second: Floats) -> bool:
    return float(np.hypot(*(first - second)[:2])) < SAME_PLACE_M + SURE * float(np.linalg.norm(second))


def _fitted(apart: Floats, measured: Floats, ends: Ints, start: Floats) -> Floats | None:
    """Return the displacement (3,) that ranges ask for, from a start, by Huber's weights."""
    away = start
    for _ in range(ROUNDS):
        line, rest = _linear(apart + away, measured, ends)
        reach = 2 * max(robust_spread(rest), 1e-4)
        weight = np.minimum(1, reach / np.maximum(np.abs(rest), 1e-9))
        square = (line * weight[:, None]).T @ line
        if np.linalg.eigvalsh(square)[0] < 1e-3 * len(rest) / 100:
            square = square + 1e-3 * len(rest) * np.eye(3)
        step = np.linalg.solve(square, line.T @ (weight * rest))
        away = away + step * min(1.0, LONGEST_STEP_M / max(float(np.linalg.norm(step)), 1e-9))
        if np.linalg.norm(away) > LARGEST_M:
            return None
    return np.asarray(away)


def _undone(view: RecordingView, rows: Ints, apart: Floats, away: Floats) -> float:
    """Return what ranges gain (see `Seen`) with the anchor at another place."""
    some = chosen(view, np.isin(np.arange(len(view.raw_m)), rows))
    order = np.argsort(np.argsort(rows))
    shift = np.linalg.norm(apart + away, axis=1) - np.linalg.norm(apart, axis=1)
    back = np.empty(len(rows))
    back[order] = shift
    return narrower(some, some.error_m, some.error_m - back)[1]


def _beyond_tolerance(line: Floats, rest: Floats, away: Floats, time_s: Floats, spread: float) -> float:
    """Return the p-value of a displacement (3,) beyond the tolerance, by Wald's F."""
    size = float(np.linalg.norm(away))
    if size <= TOLERANCE_M:
        return 1.0
    lasting = variance_of_sum(np.clip(rest, -3 * spread, 3 * spread), time_s)
    over = away * (1 - TOLERANCE_M / size)
    square = line.T @ line + 1e-9 * np.eye(3)
    return float(special.fdtrc(3, DOF, float(over @ square @ over) / lasting / 3))


def _linear(apart: Floats, measured: Floats, ends: Ints) -> tuple[Floats, Floats]:
    """Return directions (n, 3) and what is left of ranges (n,), each less its pair's median."""
    length = np.linalg.norm(apart, axis=1)
    line, rest = apart / np.maximum(length, 1e-9)[:, None], measured - length
    for k in range(int(ends.max()) + 1):
        rows = ends == k
        rest[rows] -= np.median(rest[rows])
        line[rows] -= line[rows].mean(axis=0)
    return line, rest
