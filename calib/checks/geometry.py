"""Checks of poses, lever arms and positions of anchors: each suspected fault is undone, and the spreads are
compared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
from scipy import optimize, sparse, special
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from calib.checks.fitted import distance_speeds, noise_to_signal
from calib.checks.recording_view import QuickFit, RecordingView
from calib.estimator.known_distances import ASTRAY_M
from calib.estimator.score_tests import Tested
from calib.findings import BUDGET, Candidate, positive, stretches
from calib.information import LOOSEST
from calib.spread import less_medians, medians, robust_spread
from uwblink.arrays import Bools, Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.recording.distances import antennas_m, distances_m, find_offset, sights
from uwblink.recording.schema import Poses, Tag
from uwblink.twr import names_in

CLOCKS_S: Final = 0.03
"""Host times of ranges are as late as USB makes them, and poses as a camera's exposure and network."""


def pose_clock(view: RecordingView) -> Iterator[Candidate]:
    """Find poses whose clock is off by up to a few seconds, and true distances of another time."""
    fit, posed = view.quick_fit, len(view.poses) > 0
    late_s, p_value = 0.0, 0.0 if posed else 1.0
    # If true distances are late, by less than the time of a turn, errors are proportional to the speeds of distances.
    if fit:
        speeds, p_value = distance_speeds(fit.model), 1.0
        if speeds.any():
            late_s, p_value, _ = fit.offset(speeds, tolerance=0.0 if posed else CLOCKS_S)
    if not posed:
        way = "later" if late_s < 0 else "earlier"
        evidence = (
            f"errors follow the speeds of distances, as if each true distance were the one {abs(late_s):.2f} s {way}"
        )
        yield Candidate("time offset of true distances", evidence, p_value, words={"shift": f"{-late_s:+.2f}"})
    if not posed or p_value > BUDGET:
        return
    # The offset is found by a search, because motion over a second is not linear.
    try:
        offset_ns = find_offset(view.exchanges, view.poses, view.tags, within_s=3.0)
    except ImportTableError:
        return
    shift_s, e = offset_ns * 1e-9, view.ranges
    if abs(shift_s) > CLOCKS_S:
        moved = distances_m(view.poses, view.tags, e.initiator, e.target, e.valid_ns - offset_ns)
        evidence = f"with the poses {shift_s:+.3f} s later"
        yield _with_spreads(view, Candidate("pose time offset", evidence, words={"shift": f"{shift_s:.3f}"}), moved)


SCALE: Final = 0.005
"""Relative error of sound true distances. Calibrations of motion capture and tapes have up to 0.3 % (a judgement)."""


def scale(view: RecordingView) -> Iterator[Candidate]:
    """Find true distances whose scale is wrong: the errors of all pairs grow in proportion to distance.

    Errors over power do that, too. Without powers they are unknown, and the check is left out.
    """
    fit = view.quick_fit
    if fit is None or fit.model.curve is None or view.standing_m is not None:
        return
    truth_m, error_m = fit.model.ranges.truth_m, view.ranges.error_m
    course = truth_m - np.median(truth_m)
    slope, p_value, rest = fit.offset(course, tolerance=SCALE)
    if p_value < BUDGET:
        # With noise of readings, a part of the errors over power is not in the curve, and depends on distance as powers
        # do.
        curve, far = (less_medians(own, fit.model.pairs.number) for own in (fit.error - fit.residual, truth_m))
        growth = noise_to_signal(fit.model) * abs(float(curve @ far) / float(far @ far))
        if slope > 0:
            # Another part is that of detours, because far ranges are reflected more often.
            detours_m = np.where(fit.reflected > 0.5, np.maximum(fit.residual, 0.0), 0.0)
            growth += max(float(np.polyfit(course, detours_m, 1)[0]), 0.0)
        slope, p_value, rest = fit.offset(course, tolerance=SCALE + growth)
    if robust_spread(rest.residual, 0.0) > ASTRAY_M:
        return
    fault, way = "scale of true distances", "long"
    if slope > 0:
        # Reflections with short detours are not seen singly, and lengthen far ranges, too.
        fault, way = "scale of true distances or reflections", "short, or far ranges reflected"
    yield Candidate(
        fault,
        f"ranges change as if true distances were {100 * abs(slope):.1f} % too {way}",
        p_value,
        # Errors over power may hide the decrease in the plain errors, by which other faults are compared.
        gain=max(
            _common_decrease_m(fit.residual, rest.residual),
            _common_decrease_m(*map(view.less_pairs, (error_m, error_m - slope * view.ranges.truth_m))),
        ),
    )


def frozen_poses(view: RecordingView) -> Iterator[Candidate]:
    """Find times at which motion capture lost a moving body and repeated its last pose."""
    if not view.posed:
        return
    e, poses = view.ranges, view.poses[np.lexsort((view.poses.time_ns, view.poses.body))]
    columns = np.column_stack([poses.position_m, poses.quaternion])
    repeated = (columns[1:] == columns[:-1]).all(axis=1) & (poses.body[1:] == poses.body[:-1])
    # Without repeated poses there is a gap, in which the places of antennas are not known.
    fresh = poses[~np.append(False, repeated)]
    ends, error_m = np.stack([e.initiator, e.target], axis=1), view.less_pairs(view.ranges.error_m)
    lost = np.stack([np.isnan(antennas_m(fresh, view.tags, ids, e.valid_ns)[:, 0]) for ids in ends.T], axis=1)
    lost &= np.isfinite(error_m)[:, None]
    rows = np.flatnonzero(lost.any(axis=1))
    rows = rows[np.argsort(e.time_ns[rows], kind="stable")]
    cuts, rest = stretches(len(rows), fewest=10), np.isfinite(error_m) & ~lost.any(axis=1)
    if not cuts or not rest.any():
        return
    usual_m = max(robust_spread(error_m[rest], 0.0), 1e-6)
    spread_m = np.array([max(robust_spread(error_m[rows[cut]], 0.0), 1e-6) for cut in cuts])
    mine = {body: [tag.tag for tag in view.tags if tag.body == body] for body in names_in(poses.body)}
    of = {body: error_m[(lost & np.isin(ends, own)).any(axis=1)] for body, own in mine.items()}
    bodies = [body for body, errors in of.items() if len(errors) and robust_spread(errors, 0.0) > 2 * usual_m]
    yield Candidate(
        "frozen poses",
        f"the poses of {', '.join(bodies)} repeat during {len(rows)} ranges, whose errors spread by "
        f"{100 * float(np.median(spread_m)):.0f} cm instead of {100 * usual_m:.1f} cm",
        # A body that stands still repeats its poses, too; its errors spread as at other times.
        positive(np.log(spread_m) - np.log(2 * usual_m)),
        gain=_common_decrease_m(error_m[rows], np.full(len(rows), usual_m)),
    )


def _trials(view: RecordingView) -> Iterator[tuple[Candidate, Poses, list[Tag]]]:
    """Yield suspected faults of geometry, each with the poses and tags that undo it."""
    for body in sorted({tag.body for tag in view.tags}):
        arms = {tag.tag: np.array(tag.lever_arm_m) for tag in view.tags if tag.body == body}
        longest = max(np.linalg.norm(arm) for arm in arms.values())
        # Robots with these boards are smaller than a metre: mm, cm or inches.
        units = [("lever arm unit", length) for length in (0.001, 0.01, 0.0254) if longest > 1.0]
        for fault, length in [("lever arm sign", -1.0)] * bool(longest > 0) + units:
            seen = Candidate(fault, f"of body {body}: times {length:g}", words={"body": body, "length": length})
            yield seen, view.poses, _with_arms(view.tags, {tag: length * arm for tag, arm in arms.items()})
    if len(view.poses):
        attitude = view.poses.quaternion
        for fault, mended in (("wxyz", attitude[:, [1, 2, 3, 0]]), ("inverse", attitude * [-1, -1, -1, 1])):
            turned = replace(view.poses, quaternion=mended)
            yield Candidate(f"{fault} quaternion", "of the poses: undone"), turned, view.tags


def _displacements(view: RecordingView) -> Iterator[tuple[Candidate, Poses, list[Tag]]]:
    """Yield moving bodies and tags on them at the positions that fit their ranges best, each with the changed poses and
    tags.

    A displacement below twice `TOLERANCE_M` may be a delay that depends on direction.
    """
    if (fit := view.quick_fit) is None:
        return
    e, standing = view.ranges[fit.rows], places_m(view)
    away_m, ways = sights(view.poses, view.tags, e.initiator, e.target, e.valid_ns)
    arms = {f"tag {tag.tag}": tag for tag in view.tags if tag.body not in standing}
    ends = {name: np.stack([e.initiator == tag.tag, e.target == tag.tag], axis=1) for name, tag in arms.items()}
    sides = {name: -away_m[:, None] * np.where(own[..., None], ways, 0.0).sum(axis=1) for name, own in ends.items()}
    for name, side in (sides | _vectors_to_bodies(view, fit, {tag.body for tag in arms.values()})).items():
        rows = side.any(axis=1)
        if np.count_nonzero(rows) < 200:
            continue
        shift = _place(side[rows], fit.error[rows], fit.model.pairs.number[rows], [np.zeros(3)])
        if (size := float(np.linalg.norm(shift))) > 2 * TOLERANCE_M:
            own = {arms[name].tag: np.round(arms[name].lever_arm_m + shift, 3)} if name in arms else {}
            tags = _with_arms(view.tags, own)
            yield (
                Candidate(
                    "wrong lever arm" if own else "body stands elsewhere",
                    f"with {name} {size:.2f} m away ({', '.join(f'{one:+.2f}' for one in shift)} m)",
                    words={"name": name, "line": "".join(_line(view, tag) for tag in tags if tag.tag in own)},
                ),
                replace(
                    view.poses,
                    position_m=view.poses.position_m + np.where(view.poses.body[:, None] == name, shift, 0.0),
                ),
                tags,
            )


def _turns(view: RecordingView) -> Iterator[tuple[Candidate, Poses, list[Tag]]]:
    """Attitudes turned in the world, and lever arms turned in a body, as ranges fit best, each with poses and tags.

    Turns that move no antenna by more than twice `TOLERANCE_M` may be antennas whose delays depend on the direction.
    """
    if (fit := view.quick_fit) is None:
        return
    every = slice(None, None, max(len(fit.rows) // 1000, 1))
    e, pair = view.ranges[fit.rows[every]], fit.model.pairs.number[every]
    ends, arms = np.stack([e.initiator, e.target], axis=1), {tag.tag: np.array(tag.lever_arm_m) for tag in view.tags}
    arm = np.array([[arms[tag] for tag in both] for both in ends.tolist()])
    # Antennas without lever arms, and with lever arms of a metre along the axes of their bodies.
    told = [_with_arms(view.tags, dict.fromkeys(arms, tip)) for tip in np.eye(4, 3, -1)]
    place, *tips = (np.stack([antennas_m(view.poses, tags, ids, e.valid_ns) for ids in ends.T], 1) for tags in told)
    axes = np.stack(tips, axis=-1) - place[..., None]
    # Rotations that turn axes into each other: searches for any turn begin at the best.
    turns = [*Rotation.create_group("O").as_rotvec()]
    given_m = _antennas(np.zeros(3), place, axes, arm)
    measured_m = _apart_m(given_m) + fit.error[every]
    for body in ("", *sorted({tag.body for tag in view.tags} - places_m(view).keys())):
        mine = [tag.tag for tag in view.tags if tag.body == body]
        antennas = partial(_antennas, place=place, axes=axes, arm=arm, own=np.isin(ends, mine) if body else None)

        def away_m(x: Floats, antennas: Callable[[Floats], Floats] = antennas) -> Floats:
            return _apart_m(antennas(x))

        x = _best(away_m, measured_m, pair, turns)
        turn, tags, attitude = Rotation.from_rotvec(x), view.tags, view.poses.quaternion
        if np.linalg.norm(antennas(x) - given_m, axis=2).max() <= 2 * TOLERANCE_M:
            continue
        if body:
            tags = _with_arms(tags, {tag: turn.apply(arms[tag]) for tag in mine})
            lines = "".join(_line(view, tag) for tag in tags if tag.tag in mine)
            remedy = f"measure the lever arms in the frame of the poses of {body}; the ranges give{lines}"
        else:
            attitude, known = attitude.copy(), np.linalg.norm(attitude, axis=1) > 0
            attitude[known] = (turn * Rotation.from_quat(attitude[known])).as_quat()
            factor = turn.as_quat().round(3).tolist()
            remedy = f"turn them into the frame of the positions: multiply each from the left by x y z w = {factor}"
        what, angle = f"the lever arms of {body}" if body else "all attitudes", np.degrees(turn.magnitude())
        axis = ((x / turn.magnitude()).round(1) + 0.0).tolist()
        evidence = f"with {what} turned by {angle:.0f} degrees about {axis}"
        seen = Candidate("attitudes in another frame", evidence, words={"remedy": remedy})
        yield seen, replace(view.poses, quaternion=attitude), tags


def _apart_m(antennas_m: Floats) -> Floats:
    """Return the distances (n,) between two antennas (n, 2, 3)."""
    return np.asarray(np.linalg.norm(antennas_m[:, 0] - antennas_m[:, 1], axis=1))


def _antennas(x: Floats, place: Floats, axes: Floats, arm: Floats, own: Bools | None = None) -> Floats:
    """Return antennas (n, 2, 3) where lever arms `arm` (n, 2, 3) are turned by a rotation vector (3,).

    Bodies at `place` (n, 2, 3) have `axes` (n, 2, 3, 3). Lever arms that are `own` (n, 2) are turned in their body, all
    of them in the world where `own` is None.
    """
    turn = Rotation.from_rotvec(x).as_matrix()
    inside = arm if own is None else np.where(own[..., None], arm @ turn.T, arm)
    away = np.einsum("neij,nej->nei", axes, inside)
    return np.asarray(place + (away @ turn.T if own is None else away))


def _with_arms(tags: list[Tag], arms: dict[int, Floats]) -> list[Tag]:
    """Return all tags, some with other lever arms (3,)."""
    return [replace(tag, lever_arm_m=tuple(np.round(arms.get(tag.tag, tag.lever_arm_m), 4).tolist())) for tag in tags]


def geometry(view: RecordingView) -> Iterator[Candidate]:
    """Find the fault of geometry that explains the ranges best, by trying all suspected ones.

    A fault with fitted unknowns must explain a twentieth more than one without, which may be a case of it.
    """
    weighted = ((_trials, 1.0), (_displacements, 0.95), (_turns, 0.95)) if view.posed else ()
    trials, e = [(weight, *one) for suspected, weight in weighted for one in suspected(view)], view.ranges
    found = []
    for weight, seen, poses, tags in trials:
        true_m = distances_m(poses, tags, e.initiator, e.target, e.valid_ns)
        tested = _with_spreads(view, seen, true_m, tried=len(trials))
        found.append(replace(tested, gain=weight * tested.gain))
    if sure := [one for one in found if one.p_value < BUDGET]:
        yield max(sure, key=lambda one: one.gain)


def _with_spreads(view: RecordingView, seen: Candidate, truth_m: Floats, *, tried: int = 1) -> Candidate:
    """Return a suspected fault with the change of the spread of ranges for the true distances (n,) without it.

    The statistic is the logarithm of the ratio of spreads before and after, by stretches of time. A fault that changes
    the spread by less than a twentieth is not reported: curves that were not removed have such an effect.
    """
    before, after = (view.less_pairs(view.ranges.raw_m - true) for true in (view.ranges.truth_m, truth_m))
    known = np.isfinite(before) & np.isfinite(after)
    rows = np.flatnonzero(known & (np.abs(view.ranges.truth_m - truth_m) > 1e-3))
    rows = rows[np.argsort(view.ranges.time_ns[rows], kind="stable")]
    # A tag that ranges with two others has at least 80 ranges in a quick fit: eight stretches of ten.
    cuts = [rows[cut] for cut in stretches(len(rows), fewest=10)]
    if not cuts:
        return replace(seen, p_value=1.0)
    old, new = ([max(robust_spread(errors[cut], 0.0), 1e-6) for cut in cuts] for errors in (before, after))
    old_cm, new_cm = (100 * robust_spread(errors[np.isfinite(errors)], 0.0) for errors in (before, after))
    return replace(
        seen,
        evidence=f"{seen.evidence}, the spread of the ranges is {new_cm:.1f} cm instead of {old_cm:.1f} cm",
        p_value=positive(np.log(0.95) + np.log(old) - np.log(new), tried=tried),
        gain=_common_decrease_m(before[rows], after[rows]),
    )


def _common_decrease_m(before_m: Floats, after_m: Floats) -> float:
    """Return the common decrease of errors (n,) in metres; errors above 10 m count as 10 m."""
    return float(np.nansum(np.minimum(np.abs(before_m), 10.0) - np.minimum(np.abs(after_m), 10.0)))


TOLERANCE_M: Final = 0.05
"""Standard deviation of a position by tape or markers, with the antenna beside the marker: the size of a board."""

PAIR_M: Final = 0.04
"""Standard deviation of a pair's error by lever arms from a ruler and phase centres of antennas: 2 cm at either end."""


def anchors(view: RecordingView) -> Iterator[Candidate]:
    """Find exchanged tags; then anchors at other positions, with the displacement `away_m` (3,) in the candidate."""
    # If nothing moves, each pair has its own level.
    if view.standing_m is not None or view.quick_fit is None:
        return
    moved, seen = _exchanged(view, view.quick_fit)
    remedy = "exchange these ids in the source of the true distances"
    if moved and view.posed:
        by_number = {tag.tag: tag for tag in view.tags}
        view = _with_truth(
            view, tags=[replace(by_number[moved.get(number, number)], tag=number) for number in by_number]
        )
        lines = "".join(_line(view, tag) for tag in view.tags if tag.tag in moved)
        remedy = (
            f"replace these tables in the file of uwblink poses --tags, and add the poses again with `force`:{lines}"
        )
    yield replace(seen, words={"remedy": remedy})
    if view.posed and view.quick_fit is not None:
        yield from _displaced(view, view.quick_fit)
    elif len(view.poses):
        # True distances of a table are used as they are; its poses are the positions of tags at the times of ranges.
        by_poses = anchors(_with_truth(view, posed=True))
        yield from (replace(one, evidence=f"by the poses, {one.evidence}") for one in by_poses)


def _with_truth(view: RecordingView, **changes: Any) -> RecordingView:
    """Return a view with other poses or tags, and true distances by them."""
    changed, e = replace(view, **changes), view.ranges
    truth_m = distances_m(changed.poses, changed.tags, e.initiator, e.target, e.valid_ns)
    return replace(changed, ranges=replace(view.ranges, truth_m=truth_m))


def _line(view: RecordingView, tag: Tag, away_m: Floats | float = 0.0) -> str:
    """Return a tag as a line of a map: an anchor at its body's position, displaced by `away_m` (3,)."""
    if tag.body not in places_m(view):
        return f"\n[[tags]]\nid = {tag.tag}\nbody = {tag.body!r}\nlever_arm_m = {list(tag.lever_arm_m)}"
    (place,) = antennas_m(view.poses, [tag], np.array([tag.tag]), view.poses.time_ns[view.poses.body == tag.body][:1])
    return f"\n[[anchors]]\nid = {tag.tag}\nposition_m = {(place + away_m).round(3).tolist()}"


def _exchanged(view: RecordingView, fit: QuickFit) -> tuple[dict[int, int], Candidate]:
    """Return the tag at whose position each exchanged tag is, and the candidate.

    If tag a is at the place of b, its ranges to c are the distances from b to c, which are interpolated from the true
    distances of b and c. The log likelihood is the sum of the logarithms of the pairs' spreads, with a separate scale
    for each; an assignment of tags to places finds the likeliest exchange of any number of tags. In each cycle of the
    exchange one tag must pass a separate test among all tags at all places.
    """
    ranges, pairs, numbers = fit.model.ranges, fit.model.pairs, np.unique(fit.ends)
    count, right, ends = len(numbers), np.arange(len(numbers)), np.searchsorted(numbers, pairs.ends).tolist()
    rows = {both: np.flatnonzero(pairs.number == k) for k, (a, b) in enumerate(ends) for both in ((a, b), (b, a))}

    def truth_m(own: Ints, other: Ints) -> Floats:
        return np.interp(ranges.time_ns[own], ranges.time_ns[other], ranges.truth_m[other])

    def undone(at: Ints) -> Candidate:
        mended, moved = view.ranges.truth_m.copy(), at != right
        for (a, c), own in rows.items():
            mended[fit.rows[own]] = truth_m(own, rows.get((at[a], at[c]), own))
        texts = [
            f"{a} is at the given position of {b}" for a, b in zip(numbers[moved], numbers[at[moved]], strict=True)
        ]
        return _with_spreads(
            view, Candidate("swapped tag ids", f"tag {', '.join(texts)}: undone"), mended, tried=count**2
        )

    known, spread, worse = sums = np.zeros((3, count, count))
    for (a, c), own in rows.items():
        usual = np.log(robust_spread(fit.error[own]) + 1e-6)
        for b in right:
            if (b, c) in rows:
                there = np.log(robust_spread(ranges.raw_m[own] - truth_m(own, rows[b, c])) + 1e-6)
                sums[:, a, b] += len(own) * np.array([1.0, there, there - usual])
    # The spread at the own place is below `ASTRAY_M`; an exchange that reduces spreads by less than a twentieth is not
    # reported.
    possible = (known > 0.25 * known.diagonal()[:, None]) & (spread < known * np.log(ASTRAY_M))
    cost = np.where(possible, worse - known * np.log(0.95), np.inf)
    np.fill_diagonal(cost, 0.0)
    at = optimize.linear_sum_assignment(cost)[1]
    p_values = np.array([undone(np.where(right == a, at, right)).p_value if at[a] != a else 1.0 for a in right])
    cycle = connected_components(sparse.csr_matrix((np.ones(count), (right, at))))[1]
    at = np.where([p_values[cycle == k].min() < BUDGET for k in cycle], at, right)
    moved = {int(numbers[a]): int(numbers[at[a]]) for a in np.flatnonzero(at != right)}
    return moved, replace(undone(at), p_value=float(p_values[at != right].min(initial=1.0)))


def places_m(view: RecordingView) -> dict[str, Floats]:
    """Return the positions (3,) of the bodies that carry tags and do not move, within the noise of motion capture."""
    bodies = sorted({tag.body for tag in view.tags} & set(np.unique(view.poses.body).tolist()))
    points = {body: view.poses.position_m[view.poses.body == body] for body in bodies}
    return {body: np.median(some, axis=0) for body, some in points.items() if np.ptp(some, axis=0).max() < 0.02}


def _displaced(view: RecordingView, fit: QuickFit) -> Iterator[Candidate]:
    """Yield anchors whose ranges fit other places, with a joint test by the slopes of all distances there.

    If slopes at the given place may be zero, no other place is searched for. Otherwise a search is needed: distances
    are linear over centimetres, but not over metres. At the other place slopes are from the error model, because
    reflections bias a robust loss in directions that ranges hardly determine, such as the height if robots stay at one
    height.
    """
    places = places_m(view)
    sides, poses, away = _vectors_to_bodies(view, fit, places), view.poses, dict[str, Floats]()
    if not sides:
        return
    for body, own in _by_body(fit.test(_decrease_by_motion(sides)), sides).items():
        mine = sides[body].any(axis=1)
        # If anchors are metres off, the effect of power is unknown, and small in comparison.
        far = robust_spread(fit.residual[mine]) > ASTRAY_M
        # One of twenty right places is searched, which costs time only; the slopes at the other place are tested.
        if far or own.joint_p_value(own.total) <= 0.05:
            error_m = (fit.error if far else fit.residual)[mine]
            starts = [place - places[body] for place in places.values()]
            away[body] = _place(sides[body][mine], error_m, fit.model.pairs.number[mine], starts)
            there_m = np.where(poses.body[:, None] == body, poses.position_m + away[body], poses.position_m)
            poses = replace(poses, position_m=there_m)
    if not away or (moved := (changed := _with_truth(view, poses=poses)).quick_fit) is None:
        return
    # Information of ranges on the other places, which they fit.
    tested = moved.test_constants(_decrease_by_motion(_vectors_to_bodies(changed, moved, places)))
    at_other = _by_body(_after_offsets_of_pairs(tested, len(moved.model.pairs.names)), sides)
    before_m, after_m = (one.less_pairs(one.ranges.error_m)[fit.rows] for one in (view, changed))
    for body, there in away.items():
        own, mine = at_other[body], sides[body].any(axis=1)
        # The last step is from the fit whose slopes are tested.
        shift = there - _step(own)
        size, gain = float(np.linalg.norm(shift)), _common_decrease_m(before_m[mine], after_m[mine])
        before, after = (robust_spread(errors[mine]) for errors in (before_m, after_m))
        # The spread of all ranges, and half of it more.
        if size <= TOLERANCE_M or gain <= 0 or after >= 1.5 * robust_spread(after_m):
            continue
        axes, loose = _axes(own, shift)
        # Robots that move in a plane cannot distinguish places above each other; a displacement is known to a tenth.
        others = " and ".join(
            name
            for name, place in places.items()
            if name != body and np.hypot(*(place - places[body] - shift)[:2]) < 0.3 + 0.1 * size
        )
        yield Candidate(
            "anchor stands elsewhere",
            f"ranges with {body} fit a position {size:.2f} m away {axes}: their spread is {100 * after:.1f} cm there "
            f"instead of {100 * before:.1f} cm"
            + (f"; they hardly separate {loose} from delays" if loose else "")
            + (f"; {others} is given at that position: check whether the ids are exchanged" if others else ""),
            min(1.0, own.joint_p_value(own.information @ shift * (1 - TOLERANCE_M / size)) * len(sides)),
            {
                "body": body,
                "away_m": shift,
                "lines": "".join(_line(view, tag, shift) for tag in view.tags if tag.body == body),
            },
            gain,
        )


def _vectors_to_bodies(view: RecordingView, fit: QuickFit, bodies: Iterable[str]) -> dict[str, Floats]:
    """Return the vectors (n, 3) to bodies from the antennas at the other ends of ranges, zero for ranges of others.

    Bodies with fewer than 200 ranges are left out: in 32 stretches of time each slope would be a sum over few ranges,
    and far from normal.
    """
    e, found = view.ranges[fit.rows], dict[str, Floats]()
    here, there = (antennas_m(view.poses, view.tags, ids, e.valid_ns) for ids in (e.initiator, e.target))
    for body in bodies:
        tags = [tag.tag for tag in view.tags if tag.body == body]
        sign = np.isin(e.initiator, tags).astype(float) - np.isin(e.target, tags)
        found |= {body: sign[:, None] * (here - there)} if np.count_nonzero(sign) >= 200 else {}
    return found


def _decrease_by_motion(sides: dict[str, Floats]) -> Floats:
    """Return the decrease of ranges (n, 3 * bodies) by motion of bodies along the axes; `sides` (n, 3) point to the
    bodies.
    """
    return np.hstack([side / np.maximum(np.linalg.norm(side, axis=1), 1e-9)[:, None] for side in sides.values()])


def _by_body(tested: Tested, bodies: Iterable[str]) -> dict[str, Tested]:
    """Return the slopes by displacements of each body, with the displacements of the others fitted."""
    axes = np.arange(len(tested.total)) // 3
    return {
        body: tested.with_fitted(np.flatnonzero(axes != k).tolist()).combined(np.eye(len(axes))[axes == k])
        for k, body in enumerate(bodies)
    }


def _after_offsets_of_pairs(tested: Tested, pairs: int) -> Tested:
    """Return the slopes after the first `pairs` ones, which are offsets of pairs with a standard deviation
    of `PAIR_M`.
    """
    own = tested.information[:pairs, :pairs]
    taken = -np.linalg.solve(own + np.eye(pairs) / PAIR_M**2, tested.information[:pairs, pairs:])
    step = np.hstack([taken.T, np.eye(len(tested.total) - pairs)])
    found, left = tested.combined(step), step @ tested.information
    # Slopes also contain the part of the offsets of pairs that was not subtracted.
    offsets = PAIR_M * left[:, :pairs]
    return replace(found, information=left[:, pairs:], covariance=found.covariance + offsets @ offsets.T)


def beside_places(view: RecordingView, fit: QuickFit, pairs: Sequence[int]) -> tuple[Tested, list[Candidate]]:
    """Return the slopes by offsets of all pairs with places of anchors fitted, and by these places with offsets of
    `pairs` fitted.

    Places that ranges contradict for any offsets of these pairs are one candidate: anchors that range with each other
    determine their relative positions, but hardly which of them is displaced.
    """
    count, places = len(fit.model.pairs.names), places_m(view)
    sides = _vectors_to_bodies(view, fit, places) if view.posed and view.standing_m is None else {}
    tested = fit.test_constants(_decrease_by_motion(sides) if sides else None)
    offsets = tested.with_fitted(range(count, len(tested.total))).combined(np.eye(count, len(tested.total)))
    if not sides:
        return offsets, []
    together = _after_offsets_of_pairs(tested.with_fitted(pairs), count)
    each, away, lines = _by_body(together, sides), list[str](), list[str]()
    # The anchors that are displaced for any positions of the others, or otherwise all.
    alone = [body for body, own in each.items() if own.joint_p_value(own.total) < BUDGET] or [*sides]
    for body in alone:
        shift = -_step(each[body])
        away.append(f"{body} {_axes(each[body], shift)[0]}")
        lines += [_line(view, tag, shift) for tag in view.tags if tag.body == body]
    seen = Candidate(
        "places that do not close",
        f"ranges contradict the positions of {', '.join(sides)} together; the best displacements are {'; '.join(away)}",
        together.joint_p_value(together.total),
        {"lines": "".join(lines)},
    )
    return offsets, [seen]


def _step(own: Tested) -> Floats:
    """Return the displacement (3,) by slopes; the prior of a place has a standard deviation of half a metre.

    A misread tape or a moved tripod has such an effect. Without information there is no displacement.
    """
    return np.asarray(np.linalg.solve(own.information + np.eye(3) / (LOOSEST * 0.5) ** 2, own.total))


def _axes(own: Tested, shift: Floats) -> tuple[str, str]:
    """Return a displacement (3,) with intervals of 95 %, and the axes that ranges hardly separate from delays, in
    words.
    """
    inverse = np.linalg.pinv(own.information, rcond=1e-12, hermitian=True)
    times = special.stdtrit(min(own.lasting.freedom, own.blocks - 3.0), 0.975)
    wide = times * np.sqrt(np.diag(inverse @ own.covariance @ inverse))
    axes = [f"{name} {one:+.2f} ± {of:.2f}" for name, one, of in zip("xyz", shift, wide, strict=True)]
    loose = " and ".join(name for name, of in zip("xyz", wide, strict=True) if of > LOOSEST)
    return f"({', '.join(axes)} m, 95 %)", loose


def _place(apart: Floats, error: Floats, pair: Ints, starts: Sequence[Floats]) -> Floats:
    """Return the displacement (3,) that ranges ask for, as `_best` finds it."""
    every = slice(None, None, max(len(apart) // 2000, 1))
    measured_m = np.linalg.norm(apart[every], axis=1) + error[every]
    return _best(lambda x: np.linalg.norm(apart[every] + x, axis=1), measured_m, pair[every], starts)


def _best(away_m: Callable[[Floats], Floats], measured_m: Floats, pair: Ints, starts: Sequence[Floats]) -> Floats:
    """Return the unknowns (3,) of distances `away_m` (n,) by robust least squares, beside a constant of each pair.

    The better of searches from zero and from the best of several starts (3,). A prior with the weight of a thousandth
    of a range determines the other directions: robots that move in a plane do not determine the height.
    """
    pair = np.unique(pair, return_inverse=True)[1]

    def residuals(x: Floats) -> Floats:
        rest = measured_m - away_m(x[:3]) - x[3:][pair]
        return np.append(rest, 1e-3 * len(rest) ** 0.5 * x[:3])

    spread_m = [robust_spread(less_medians(measured_m - away_m(start), pair), 0.0) for start in starts]
    found = []
    for start in (np.zeros(3), starts[int(np.argmin(spread_m))]):
        constants = medians(measured_m - away_m(start), pair)
        found.append(optimize.least_squares(residuals, np.append(start, constants), loss="soft_l1", f_scale=0.1))
    return np.asarray(min(found, key=lambda one: one.cost).x[:3])
