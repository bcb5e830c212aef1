"""Checks of poses, lever arms and places of anchors: each suspected fault is undone, and the spreads compared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from heapq import nlargest
from itertools import combinations
from typing import Final

import numpy as np
from scipy import optimize, special

from calib.checks.fitted import late
from calib.checks.recording_view import QuickFit, RecordingView, quick_fit
from calib.estimator.known_distances import ASTRAY_M
from calib.estimator.score_tests import Tested
from calib.findings import BUDGET, Candidate, positive, stretches
from calib.information import LOOSEST
from calib.spread import TWO_SIDED_95, less_medians, medians, robust_spread
from uwblink.arrays import Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.recording.distances import antennas_m, distances_m, find_offset
from uwblink.recording.schema import Poses, Tag


def pose_clock(view: RecordingView) -> Iterator[Candidate]:
    """Poses whose clock is off by up to a few seconds."""
    fit = view.quick_fit
    # Where poses are late, by less than bodies take for a turn, ranges follow the speeds at which distances change.
    follow = [fit.offset(speeds)[1] for speeds in late(fit.model).values()] if fit else [0.0]
    if not len(view.poses) or min(follow, default=1.0) > BUDGET:
        return
    # By how much is a search: motion over a second is not linear.
    try:
        offset_ns = find_offset(view.exchanges, view.poses, view.tags, within_s=3.0)
    except ImportTableError:
        return
    shift_s, e = offset_ns * 1e-9, view.exchanges
    # Host times of ranges are as late as USB makes them, and poses as a camera's exposure and network.
    if abs(shift_s) > 0.03:
        moved = distances_m(view.poses, view.tags, e.initiator, e.target, e.time_ns - offset_ns)
        evidence = f"with the poses {shift_s:+.3f} s later"
        yield _undone(view, Candidate("pose time offset", evidence, words={"shift": f"{shift_s:.3f}"}), moved)


def _trials(view: RecordingView) -> Iterator[tuple[Candidate, Poses, list[Tag]]]:
    """Suspected faults of geometry, each with poses and tags as they would be without it."""
    for body in sorted({tag.body for tag in view.tags}):
        arms = {tag.tag: np.array(tag.lever_arm_m) for tag in view.tags if tag.body == body}
        longest = max(np.linalg.norm(arm) for arm in arms.values())
        # Robots that carry these boards are smaller than a metre: mm, cm or inches.
        units = [("lever arm unit", length) for length in (0.001, 0.01, 0.0254) if longest > 1.0]
        for fault, length in [("lever arm sign", -1.0)] * bool(longest > 0) + units:
            seen = Candidate(fault, f"of body {body}: times {length:g}", words={"body": body, "length": length})
            yield seen, view.poses, _with_arms(view.tags, {tag: length * arm for tag, arm in arms.items()})
        for a, b in combinations(arms, 2):
            seen = Candidate("swapped tag ids", f"of tags {a} and {b}: undone", words={"a": a, "b": b})
            yield seen, view.poses, _with_arms(view.tags, {a: arms[b], b: arms[a]})
    if len(view.poses):
        turned = replace(view.poses, quaternion=view.poses.quaternion[:, [1, 2, 3, 0]])
        yield Candidate("wxyz quaternion", "of the poses: undone"), turned, view.tags


def _with_arms(tags: list[Tag], arms: dict[int, Floats]) -> list[Tag]:
    """Return all tags, some with other lever arms (3,)."""
    return [replace(tag, lever_arm_m=tuple(arms.get(tag.tag, tag.lever_arm_m))) for tag in tags]


def geometry(view: RecordingView) -> Iterator[Candidate]:
    """Try every suspected fault of geometry; of those that explain the ranges, the one that does so best."""
    if view.posed:
        e, trials = view.exchanges, list(_trials(view))
        found = [
            _undone(view, seen, distances_m(poses, tags, e.initiator, e.target, e.time_ns), tried=len(trials))
            for seen, poses, tags in trials
        ]
        yield from nlargest(1, (one for one in found if one.p_value < 1), key=lambda one: one.gain)


def _undone(view: RecordingView, seen: Candidate, truth_m: Floats, *, tried: int = 1) -> Candidate:
    """Return a suspected fault with how the spread of ranges changes with the true distances (n,) without it.

    The statistic is the logarithm of how much wider they spread before, by stretches of time. Undoing a fault that
    narrows ranges by less than a twentieth is not worth a word: curves that are left in do that.
    """
    before, after = (view.less_pairs(view.ranges.raw_m - true) for true in (view.ranges.truth_m, truth_m))
    known = np.isfinite(before) & np.isfinite(after)
    rows = np.flatnonzero(known & (np.abs(view.ranges.truth_m - truth_m) > 1e-3))
    rows = rows[np.argsort(view.exchanges.time_ns[rows], kind="stable")]
    cuts = [rows[cut] for cut in stretches(len(rows))]
    if not cuts:
        return replace(seen, p_value=1.0)
    old, new = ([max(robust_spread(errors[cut], 0.0), 1e-6) for cut in cuts] for errors in (before, after))
    old_cm, new_cm = (100 * robust_spread(errors[np.isfinite(errors)], 0.0) for errors in (before, after))
    return replace(
        seen,
        evidence=f"{seen.evidence}, the ranges' spread is {new_cm:.1f} cm instead of {old_cm:.1f} cm",
        p_value=positive(np.log(0.95) + np.log(old) - np.log(new), tried=tried),
        gain=_gain(before[rows], after[rows]),
    )


def _gain(before_m: Floats, after_m: Floats) -> float:
    """Return by how much errors (n,) shrink together, metres; errors of 10 m are as bad as any larger ones."""
    return float(np.nansum(np.minimum(np.abs(before_m), 10.0) - np.minimum(np.abs(after_m), 10.0)))


TOLERANCE_M: Final = 0.05
"""What a place by tape or markers is off by, with the antenna beside the marker: the size of a board."""


def anchors(view: RecordingView) -> Iterator[Candidate]:
    """Anchors whose ranges ask for another place, which is `away_m` (3,) among the words."""
    # Where nothing moves, each pair has a level that is its own.
    if view.posed and view.standing_m is None and view.quick_fit is not None:
        places = places_m(view)
        for body in places:
            yield from _displaced(view, view.quick_fit, body, places)


def places_m(view: RecordingView) -> dict[str, Floats]:
    """Return the places (3,) of the bodies that carry tags and do not move, within what motion capture says of that."""
    bodies = sorted({tag.body for tag in view.tags} & set(np.unique(view.poses.body).tolist()))
    points = {body: view.poses.position_m[view.poses.body == body] for body in bodies}
    return {body: np.median(some, axis=0) for body, some in points.items() if np.ptp(some, axis=0).max() < 0.02}


def _displaced(view: RecordingView, fit: QuickFit, body: str, places: dict[str, Floats]) -> Iterator[Candidate]:
    """Yield an anchor whose ranges fit another place, tested by the slopes of its distances at that place.

    In a direction that ranges hardly determine, as the height where robots keep theirs, some place far away always fits
    reflections better than the given one. So the direction must be determined at the given place, as an information
    matrix is judged (`calib.information`), unless ranges are astray there. Where slopes at the given place may be zero
    no other is searched for: distances are linear in centimetres, not in metres, so that a search cannot be spared.
    """
    tags = [tag.tag for tag in view.tags if tag.body == body]
    first, second = (np.isin(ends[fit.rows], tags) for ends in (view.exchanges.initiator, view.exchanges.target))
    mine = first != second
    own = view.chosen(fit.rows[mine])
    here, there = (
        antennas_m(view.poses, view.tags, ids, own.exchanges.time_ns)
        for ids in (own.exchanges.initiator, own.exchanges.target)
    )
    apart = np.where(first[mine, None], here - there, there - here)
    pair = np.unique(fit.model.pairs.number[mine], return_inverse=True)[1]
    # With fewer, its slopes in 32 stretches of time would be of some ranges each, and far from normal.
    if len(apart) < 200 or not np.isfinite(apart).all():
        return
    here_m = np.linalg.norm(apart, axis=1)
    # Where anchors are metres off, what power does is not known, and small beside that.
    astray = robust_spread(fit.residual[mine]) > ASTRAY_M
    derivative = np.zeros((len(mine), 3))
    derivative[mine] = outward = apart / here_m[:, None]
    at_given = fit.test(derivative)
    if not astray and _p_of_place(at_given, at_given.total) > BUDGET:
        return
    measured = here_m + (own.error_m if astray else fit.residual[mine])

    def spread_at(away: Floats) -> float:
        return robust_spread(less_medians(measured - np.linalg.norm(apart + away, axis=1), pair))

    away = min((_place(apart, measured, pair, place - places[body]) for place in places.values()), key=spread_at)
    before, after, size = spread_at(np.zeros(3)), spread_at(away), float(np.linalg.norm(away))
    # The ranges of this anchor alone, at its other place: their noise is theirs, whatever else is wrong.
    there_m = np.linalg.norm(apart + away, axis=1)
    truth_m = own.ranges.truth_m + (there_m - here_m)
    moved = quick_fit([replace(own, ranges=replace(own.ranges, truth_m=truth_m))])
    gain = _gain(own.less_pairs(own.error_m), own.less_pairs(own.ranges.raw_m - truth_m))
    # The spread of other ranges, and half of it more.
    usual = 1.5 * robust_spread(fit.residual[~mine]) if not mine.all() else np.inf
    if size <= TOLERANCE_M or gain <= 0 or after >= min(before, usual) or moved is None:
        return
    at_other = moved.test(((apart + away) / there_m[:, None])[moved.rows])
    slope = at_other.information @ away * (1 - TOLERANCE_M / size)
    p_value = _p_of_place(at_other, slope)
    if not astray:
        # Ranges at the other place: at the given one they hardly determine anything, so far off are they.
        at_given = moved.test(outward[moved.rows])
        direction = np.linalg.lstsq(at_given.information, away / size, rcond=1e-12)[0]
        # Without ranges a place is known to half a metre: a tape misread, a tripod moved.
        if np.sqrt(direction @ at_given.covariance @ direction) > LOOSEST * 0.5:
            return
    # Places above and below each other are alike to robots that move in a plane; a displacement is known to a tenth.
    near = {name: float(np.hypot(*(place - places[body] - away)[:2])) for name, place in places.items()}
    others = " and ".join(name for name in places if name != body and near[name] < 0.3 + 0.1 * size)
    inverse = np.linalg.pinv(at_other.information, rcond=1e-12, hermitian=True)
    std = np.sqrt(np.diag(inverse @ at_other.covariance @ inverse))
    axes = [f"{name} {one:+.2f} ± {TWO_SIDED_95 * far:.2f}" for name, one, far in zip("xyz", away, std, strict=True)]
    yield Candidate(
        "anchor stands elsewhere",
        f"ranges with {body} fit a place {size:.2f} m away ({', '.join(axes)} m, 95 %): their "
        f"spread is {100 * after:.1f} cm there instead of {100 * before:.1f} cm"
        + (f"; there the recording has {others}: are numbers exchanged?" if others else ""),
        min(1.0, p_value * len(places)),
        {"body": body, "away_m": away, "place": [round(value, 2) for value in (places[body] + away).tolist()]},
        gain,
    )


def _p_of_place(tested: Tested, slope: Floats) -> float:
    """Return the p-value of slopes (3,) by a place, whose mean is zero if the place is right (Hotelling)."""
    square = float(slope @ np.linalg.lstsq(tested.covariance, slope, rcond=1e-12)[0])
    return float(special.fdtrc(3, tested.blocks - 3.0, square / 3))


def _place(apart: Floats, measured: Floats, pair: Ints, start: Floats) -> Floats:
    """Return the displacement (3,) that ranges ask for, beside a constant of each pair, by robust least squares.

    A thousandth of a range holds the place where ranges do not: robots that move in a plane do not see its height.
    """
    every = slice(None, None, max(len(apart) // 2000, 1))
    apart, measured, pair = apart[every], measured[every], pair[every]

    def residuals(x: Floats) -> Floats:
        rest = measured - np.linalg.norm(apart + x[:3], axis=1) - x[3:][pair]
        return np.append(rest, 1e-3 * len(rest) ** 0.5 * x[:3])

    constants = medians(measured - np.linalg.norm(apart + start, axis=1), pair)
    found = optimize.least_squares(residuals, np.append(start, constants), loss="soft_l1", f_scale=0.1)
    return np.asarray(found.x[:3])
