"""Checks of poses, lever arms and places of anchors: each suspected fault is undone, and the spreads compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
from scipy import optimize, sparse, special

from calib.checks.pairs import standing_still
from calib.checks.quick_fit import QuickFit, quick_fit
from calib.checks.recording_view import RecordingView, chosen, less_pairs, spread_m
from calib.estimator.score_tests import Family
from calib.findings import Candidate, positive, stretches
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints
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

RANGES_OF_A_PLACE: Final = 200
"""Ranges from which three coordinates are told, and how errors of them last."""

ASTRAY_M: Final = 0.3
"""Spread of an anchor's ranges beyond which its place is wrong by more than power and noise explain."""

ANCHOR_STANDS_M: Final = 0.02
"""What motion capture says of the place of a body that does not move."""

SAME_PLACE_M: Final = 0.3
"""A place nearer to another anchor's is that anchor's."""

EXPLAINED: Final = 1.5
"""Times the spread of other ranges that are left where another place explains an anchor's ranges."""

HELD: Final = 1e-3
"""Share of a range that holds a place where ranges do not: robots that move in a plane do not see its height."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Displaced:
    """An anchor that stands elsewhere, by `away_m` (3,), its ranges' spreads in metres, p-value and gain.

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
    if not view.posed or standing_still(view) is not None or view.quick_fit is None:
        return []
    places = {body: place_m(view, body) for body in standing(view)}
    found = [_displaced(view, view.quick_fit, body, places) for body in places]
    return [one for one in found if one is not None and one.p_value < 1]


def standing(view: RecordingView) -> list[str]:
    """Return the bodies that carry tags and do not move."""
    bodies = sorted({tag.body for tag in view.tags} & set(np.unique(view.poses.body).tolist()))
    spans = {body: np.ptp(view.poses.position_m[view.poses.body == body], axis=0).max() for body in bodies}
    return [body for body in bodies if spans[body] < ANCHOR_STANDS_M]


def place_m(view: RecordingView, body: str) -> Floats:
    """Return where a body stands (3,)."""
    return np.asarray(np.median(view.poses.position_m[view.poses.body == body], axis=0))


def _displaced(view: RecordingView, fit: QuickFit, body: str, places: dict[str, Floats]) -> Displaced | None:
    """Return where ranges fit an anchor best, tested by the slopes of its distances at that place."""
    tags = [tag.tag for tag in view.tags if tag.body == body]
    e = view.exchanges[fit.rows]
    mine = np.isin(e.initiator, tags) != np.isin(e.target, tags)
    e, time_ns = e[mine], e.time_ns[mine]
    own = np.isin(e.initiator, tags)
    ids = np.where(own, e.initiator, e.target), np.where(own, e.target, e.initiator)
    here, there = (antennas_m(view.poses, view.tags, ends, time_ns) for ends in ids)
    apart, pair = here - there, np.unique(fit.pair[mine], return_inverse=True)[1]
    if len(apart) < RANGES_OF_A_PLACE or not np.isfinite(apart).all():
        return None
    # Where anchors are metres off, what power does is not known, and small beside that.
    loud = robust_spread(fit.residual[mine]) > ASTRAY_M
    measured = np.linalg.norm(apart, axis=1) + (view.error_m[fit.rows] if loud else fit.residual)[mine]
    tried = [_place(apart, measured, pair, place - places[body]) for place in places.values()]
    spreads = [robust_spread(_left(apart + away, measured, pair)) for away in tried]
    away, after = tried[int(np.argmin(spreads))], min(spreads)
    before, size = robust_spread(_left(apart, measured, pair)), float(np.linalg.norm(away))
    # The ranges of this anchor alone, at its other place: their noise is theirs, whatever else is wrong.
    rows, there_m = fit.rows[mine], np.linalg.norm(apart + away, axis=1)
    truth_m, direction = view.truth_m.copy(), np.zeros((len(view.truth_m), 3))
    truth_m[rows] += there_m - np.linalg.norm(apart, axis=1)
    direction[rows] = (apart + away) / there_m[:, None]
    only = np.isin(np.arange(len(truth_m)), rows)
    moved = quick_fit([chosen(replace(view, truth_m=truth_m), only)])
    gain = narrower(view, view.error_m, view.raw_m - truth_m)[1]
    explains = after < min(before, EXPLAINED * robust_spread(fit.residual[~mine])) if (~mine).any() else after < before
    if size <= TOLERANCE_M or gain <= 0 or not explains or moved is None:
        return None
    derivative = sparse.csr_matrix(direction[only][moved.rows])
    tested = moved.slopes.test(Family(kind="place", names="xyz", derivative=derivative))
    slope = tested.information @ away * (1 - TOLERANCE_M / size)
    square = float(slope @ np.linalg.lstsq(tested.covariance, slope, rcond=1e-12)[0])
    p_value = float(special.fdtrc(3, tested.blocks - 3.0, square / 3))
    # Places above and below each other are alike to robots that move in a plane; a displacement is known to a tenth.
    near = {name: float(np.hypot(*(place - places[body] - away)[:2])) for name, place in places.items()}
    return Displaced(
        body=body,
        away_m=away,
        before_m=before,
        after_m=after,
        p_value=min(1.0, p_value * len(places)),
        gain=gain,
        instead=tuple(name for name in places if name != body and near[name] < SAME_PLACE_M + 0.1 * size),
    )


def _place(apart: Floats, measured: Floats, pair: Ints, start: Floats) -> Floats:
    """Return the displacement (3,) that ranges ask for, beside a constant of each pair, by robust least squares."""
    every = slice(None, None, max(len(apart) // 2000, 1))
    apart, measured, pair = apart[every], measured[every], pair[every]
    count = int(pair.max()) + 1

    def residuals(x: Floats) -> Floats:
        rest = measured - np.linalg.norm(apart + x[:3], axis=1) - x[3:][pair]
        return np.append(rest, HELD * len(rest) ** 0.5 * x[:3])

    constants = medians(measured - np.linalg.norm(apart + start, axis=1), pair, count)
    found = optimize.least_squares(residuals, np.append(start, constants), loss="soft_l1", f_scale=0.1)
    return np.asarray(found.x[:3])


def _left(apart: Floats, measured: Floats, pair: Ints) -> Floats:
    """Return what is left of ranges (n,) at distances (n, 3), each less its pair's median."""
    rest = measured - np.linalg.norm(apart, axis=1)
    return np.asarray(rest - medians(rest, pair, int(pair.max()) + 1)[pair])


def medians(values: Floats, place: Ints, count: int) -> Floats:
    """Return the median of values (n,) at each place (count,), which all have some."""
    order = np.argsort(place, kind="stable")
    return np.array(
        [np.median(part) for part in np.split(values[order], np.searchsorted(place[order], range(1, count)))]
    )


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
