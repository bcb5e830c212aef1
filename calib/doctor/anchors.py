"""Anchors that do not stand where the recording says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.doctor.base import Finding, RecordingView
from calib.doctor.levels import Levels, levels, variance_of_sum
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints
from uwblink.recording.distances import antennas_m

ELSEWHERE: Final = "anchor stands elsewhere"
SMALLEST_M: Final = 0.08
LARGEST_M: Final = 3.0
SURELY: Final = 8.0
BETTER: Final = 0.93
"""Ranges of an anchor must spread by less than this share of what they did."""

FEWEST: Final = 200
ROUNDS: Final = 8
STILL_M: Final = 0.02


@dataclass(frozen=True, slots=True)
class Displaced:
    """By how much an anchor stands elsewhere (3,), with standard errors, and its ranges' spreads; metres."""

    body: str
    away_m: Floats
    std_m: Floats
    before_m: float
    after_m: float


def anchors(view: RecordingView) -> Iterator[Finding]:
    """Anchors whose ranges ask for another place."""
    for one in displaced(view):
        x, y, z = one.away_m
        yield Finding(
            ELSEWHERE,
            f"ranges with {one.body} fit a place {np.linalg.norm(one.away_m):.2f} m away ({x:+.2f} {y:+.2f} {z:+.2f} m"
            f"): their spread is {100 * one.after_m:.1f} cm there instead of {100 * one.before_m:.1f} cm",
            f"measure the place of {one.body} again",
            0.85,
        )


def displaced(view: RecordingView) -> list[Displaced]:
    """Return the anchors that stand elsewhere."""
    if not len(view.poses) or np.isfinite(view.exchanges.truth_m).any():
        return []
    known = levels(view)
    if known is None:
        return []
    found = [_displaced(view, known, body) for body in standing(view)]
    return [one for one in found if one is not None]


def standing(view: RecordingView) -> list[str]:
    """Return the bodies that carry tags and do not move."""
    bodies = sorted({tag.body for tag in view.tags} & set(np.unique(view.poses.body).tolist()))
    spans = {body: np.ptp(view.poses.position_m[view.poses.body == body], axis=0).max() for body in bodies}
    return [body for body in bodies if spans[body] < STILL_M]


def _displaced(view: RecordingView, known: Levels, body: str) -> Displaced | None:
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
    measured = known.rest[mine] + np.linalg.norm(apart, axis=1)
    good = np.isfinite(measured)
    if np.count_nonzero(good) < FEWEST:
        return None
    apart, measured, pair, time_s = apart[good], measured[good], pair[good], known.time_s[mine][good]
    places = np.unique(pair, return_inverse=True)[1]
    away = np.zeros(3)
    for _ in range(ROUNDS):
        line, rest = _linear(apart + away, measured, places)
        reach = 2 * max(robust_spread(rest), 1e-4)
        weight = np.minimum(1, reach / np.maximum(np.abs(rest), 1e-9))
        square = (line * weight[:, None]).T @ line
        if np.linalg.eigvalsh(square)[0] < 1e-3 * len(rest) / 100:
            square = square + 1e-3 * len(rest) * np.eye(3)
        away = away + np.linalg.solve(square, line.T @ (weight * rest))
        if np.linalg.norm(away) > LARGEST_M:
            return None
    before, after = (robust_spread(_linear(apart + d, measured, places)[1]) for d in (np.zeros(3), away))
    line, rest = _linear(apart + away, measured, places)
    lasting = variance_of_sum(np.clip(rest, -3 * after, 3 * after), time_s)
    covariance = lasting * np.linalg.inv(line.T @ line + 1e-9 * np.eye(3))
    sure = float(np.sqrt(away @ np.linalg.solve(covariance, away)))
    size = float(np.linalg.norm(away))
    if size < SMALLEST_M or sure < SURELY or after > BETTER * before:
        return None
    return Displaced(body, away, np.sqrt(np.diag(covariance)), before, after)


def _linear(apart: Floats, measured: Floats, places: Ints) -> tuple[Floats, Floats]:
    """Return directions (n, 3) and what is left of ranges (n,), each less its pair's median."""
    length = np.linalg.norm(apart, axis=1)
    line, rest = apart / length[:, None], measured - length
    for k in range(int(places.max()) + 1):
        rows = places == k
        rest[rows] -= np.median(rest[rows])
        line[rows] -= line[rows].mean(axis=0)
    return line, rest
