"""Checks of poses, lever arms and places of anchors: each suspected fault is undone, and the spreads compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
from scipy import special

from calib.checks.levels import DOF, Levels, levels, variance_of_sum
from calib.checks.pairs import standing_still
from calib.checks.recording_view import RecordingView, chosen, less_pairs, spread_m
from calib.findings import Candidate, positive, stretches
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.recording.distances import antennas_m, distances_m, find_offset
from uwblink.recording.schema import Poses, Tag

LARGEST_OFFSET_S: Final = 3.0
SMALLEST_OFFSET_S: Final = 0.03
"""Host times of ranges are as late as USB makes them, and poses as a camera's exposure and network."""

LONGEST_ARM_M: Final = 1.0
"""Robots that carry these boards are smaller; longer arms may be in another unit."""


def pose_clock(view: RecordingView) -> Iterator[Candidate]:
    """Poses whose clock is off by up to a few seconds."""
    if not len(view.poses):
        return
    try:
        found = find_offset(view.exchanges, view.poses, view.tags, within_s=LARGEST_OFFSET_S)
    except ImportTableError:
        return
    shift_s = found.offset_ns * 1e-9
    e = view.exchanges
    moved = distances_m(view.poses, view.tags, e.initiator, e.target, e.time_ns - found.offset_ns)
    if abs(shift_s) > SMALLEST_OFFSET_S:
        p_value, gain = narrower(view, view.error_m, view.raw_m - moved)
        told = (
            f"with the poses {shift_s:+.3f} s later the ranges' spread is {100 * spread_m(view, moved):.1f} cm instead "
            f"of {100 * spread_m(view):.1f} cm"
        )
        yield Candidate("pose time offset", told, p_value, {"shift": f"{shift_s:.3f}"}, gain)


def _trials(view: RecordingView) -> Iterator[tuple[Candidate, Poses, list[Tag]]]:
    """Suspected faults of geometry, each with poses and tags as they would be without it."""
    bodies = sorted({tag.body for tag in view.tags})
    for body in bodies:
        mine = [tag for tag in view.tags if tag.body == body]
        if any(any(tag.lever_arm_m) for tag in mine):
            yield (
                Candidate("lever arm sign", f"of body {body}", words={"body": body}),
                view.poses,
                _scaled(view, mine, -1.0),
            )
        if any(np.linalg.norm(tag.lever_arm_m) > LONGEST_ARM_M for tag in mine):
            for unit, length in (("mm", 0.001), ("cm", 0.01), ("in", 0.0254)):
                seen = Candidate("lever arm unit", f"of body {body} in {unit}", words={"body": body, "length": length})
                yield seen, view.poses, _scaled(view, mine, length)
        for a, b in combinations(mine, 2):
            arms = {a.tag: b.lever_arm_m, b.tag: a.lever_arm_m}
            swapped = [replace(t, lever_arm_m=arms.get(t.tag, t.lever_arm_m)) for t in view.tags]
            seen = Candidate("swapped tag ids", f"of tags {a.tag} and {b.tag}", words={"a": a.tag, "b": b.tag})
            yield seen, view.poses, swapped
    q = view.poses.quaternion
    if len(q):
        yield (
            Candidate("wxyz quaternion", "of the poses"),
            replace(view.poses, quaternion=q[:, [1, 2, 3, 0]]),
            view.tags,
        )


def _scaled(view: RecordingView, mine: list[Tag], factor: float) -> list[Tag]:
    """Return all tags, with the lever arms of some times a factor."""
    arms = [(t, factor if t in mine else 1.0) for t in view.tags]
    return [replace(t, lever_arm_m=(f * t.lever_arm_m[0], f * t.lever_arm_m[1], f * t.lever_arm_m[2])) for t, f in arms]


def geometry(view: RecordingView) -> Iterator[Candidate]:
    """Try every suspected fault of geometry; of those that explain the ranges, the one that does so best."""
    if not view.posed:
        return
    e = view.exchanges
    before = spread_m(view)
    best: Candidate | None = None
    trials = list(_trials(view))
    for seen, poses, tags in trials:
        truth = distances_m(poses, tags, e.initiator, e.target, e.time_ns)
        p_value, gain = narrower(view, view.error_m, view.raw_m - truth, tried=len(trials))
        if p_value < 1 and (best is None or gain > best.gain):
            told = (
                f"{seen.evidence}: undone, the ranges' spread is {100 * spread_m(view, truth):.1f} cm instead of "
                f"{100 * before:.1f} cm"
            )
            best = replace(seen, evidence=told, p_value=p_value, gain=gain)
    if best:
        yield best


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
    """By how much an anchor stands elsewhere (3,), its ranges' spreads in metres, p-value and gain; see `Candidate`.

    `instead` are the bodies that the recording has at the place, or below or above it.
    """

    body: str
    away_m: Floats
    before_m: float
    after_m: float
    p_value: float
    gain: float
    instead: tuple[str, ...]


def anchors(view: RecordingView) -> Iterator[Candidate]:
    """Anchors whose ranges ask for another place."""
    for one in displaced(view):
        x, y, z = one.away_m
        there = f"; there the recording has {' and '.join(one.instead)}: are numbers exchanged?" if one.instead else ""
        yield Candidate(
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
    """Return what ranges gain (see `Candidate`) with the anchor at another place."""
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


def narrower(view: RecordingView, before_m: Floats, after_m: Floats, *, tried: float = 1) -> tuple[float, float]:
    """Return p-value and gain of errors `after_m` (n,) instead of `before_m`, each less its pair's own median.

    The statistic is the logarithm of how much wider they spread before, by stretches of time, less `MATERIAL`.
    """
    a, b = less_pairs(view, before_m), less_pairs(view, after_m)
    rows = np.flatnonzero(np.isfinite(a) & np.isfinite(b) & (np.abs(before_m - after_m) > 1e-3))
    rows = rows[np.argsort(view.exchanges.time_ns[rows], kind="stable")]
    a, b = a[rows], b[rows]
    cuts = stretches(len(rows))
    if not cuts:
        return 1.0, 0.0
    wider = np.array([np.log(max(robust_spread(a[s], 0.0), 1e-6) / max(robust_spread(b[s], 0.0), 1e-6)) for s in cuts])
    gain = float(np.sum(np.minimum(np.abs(a), FAR_M) - np.minimum(np.abs(b), FAR_M)))
    return positive(wider + np.log(MATERIAL), tried=tried), gain


MATERIAL: Final = 0.95
"""Undoing a fault that narrows ranges by less than a twentieth is not worth a word: curves that are left in do that."""

FAR_M: Final = 10.0
"""Errors beyond count no further in a gain."""
