"""Checks of poses, lever arms and positions of anchors: each suspected fault is undone, and the spreads are
compared.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from scipy import optimize, sparse, special
from scipy.sparse.csgraph import connected_components

from calib.checks.fitted import distance_speeds
from calib.checks.recording_view import QuickFit, RecordingView
from calib.estimator.known_distances import ASTRAY_M
from calib.estimator.score_tests import Tested
from calib.findings import BUDGET, Candidate, positive, stretches
from calib.information import LOOSEST
from calib.spread import medians, robust_spread
from uwblink.arrays import Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.recording.distances import antennas_m, distances_m, find_offset, sights
from uwblink.recording.schema import Poses, Tag

CLOCKS_S: Final = 0.03
"""Host times of ranges are as late as USB makes them, and poses as a camera's exposure and network."""


def pose_clock(view: RecordingView) -> Iterator[Candidate]:
    """Find poses whose clock is off by up to a few seconds, and true distances of another time."""
    fit, posed = view.quick_fit, len(view.poses) > 0
    late_s, p_value = 0.0, 0.0 if posed else 1.0
    # Where true distances are late, by less than bodies take for a turn, ranges follow the speeds at which they change.
    if fit:
        speeds, p_value = distance_speeds(fit.model), 1.0
        if speeds.any():
            late_s, p_value, _ = fit.offset(speeds, tolerance=0.0 if posed else CLOCKS_S)
    if not posed:
        way = "later" if late_s < 0 else "earlier"
        evidence = f"ranges differ from the true distances as if these were those {abs(late_s):.2f} s {way}"
        yield Candidate("time offset of true distances", evidence, p_value, words={"shift": f"{-late_s:+.2f}"})
    if not posed or p_value > BUDGET:
        return
    # By how much is a search: motion over a second is not linear.
    try:
        offset_ns = find_offset(view.exchanges, view.poses, view.tags, within_s=3.0)
    except ImportTableError:
        return
    shift_s, e = offset_ns * 1e-9, view.exchanges
    if abs(shift_s) > CLOCKS_S:
        moved = distances_m(view.poses, view.tags, e.initiator, e.target, e.time_ns - offset_ns)
        evidence = f"with the poses {shift_s:+.3f} s later"
        yield _undone(view, Candidate("pose time offset", evidence, words={"shift": f"{shift_s:.3f}"}), moved)


def _trials(view: RecordingView) -> Iterator[tuple[Candidate, Poses, list[Tag]]]:
    """Yield suspected faults of geometry, each with the poses and tags that undo it."""
    for body in sorted({tag.body for tag in view.tags}):
        arms = {tag.tag: np.array(tag.lever_arm_m) for tag in view.tags if tag.body == body}
        longest = max(np.linalg.norm(arm) for arm in arms.values())
        # Robots that carry these boards are smaller than a metre: mm, cm or inches.
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
    """Bodies that move, and tags on them, where their ranges fit best, each with poses and tags as they would be then.

    What is nearer than twice `TOLERANCE_M` may be an antenna whose delay depends on the direction.
    """
    if (fit := view.quick_fit) is None:
        return
    e, standing = view.exchanges[fit.rows], places_m(view)
    away_m, ways = sights(view.poses, view.tags, e.initiator, e.target, e.time_ns)
    arms = {f"tag {tag.tag}": tag for tag in view.tags if tag.body not in standing}
    ends = {name: np.stack([e.initiator == tag.tag, e.target == tag.tag], axis=1) for name, tag in arms.items()}
    sides = {name: -away_m[:, None] * np.where(own[..., None], ways, 0.0).sum(axis=1) for name, own in ends.items()}
    for name, side in (sides | _sides(view, fit, {tag.body for tag in arms.values()})).items():
        rows, few = side.any(axis=1), np.count_nonzero(side.any(axis=1)) < 200
        shift = _place(side[rows], fit.error[rows], fit.model.pairs.number[rows], [np.zeros(3)])
        if (size := float(np.linalg.norm(shift))) > 2 * TOLERANCE_M and not few:
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


def _with_arms(tags: list[Tag], arms: dict[int, Floats]) -> list[Tag]:
    """Return all tags, some with other lever arms (3,)."""
    return [replace(tag, lever_arm_m=tuple(np.round(arms.get(tag.tag, tag.lever_arm_m), 4).tolist())) for tag in tags]


def geometry(view: RecordingView) -> Iterator[Candidate]:
    """Find the fault of geometry that explains the ranges best, by trying all suspected ones."""
    for suspected in (_trials, _displacements) if view.posed else ():
        e, trials = view.exchanges, list(suspected(view))
        found = [
            _undone(view, seen, distances_m(poses, tags, e.initiator, e.target, e.time_ns), tried=len(trials))
            for seen, poses, tags in trials
        ]
        # Where a simple fault explains the ranges, any place is fitted in vain.
        if sure := [one for one in found if one.p_value < BUDGET]:
            yield max(sure, key=lambda one: one.gain)
            return


def _undone(view: RecordingView, seen: Candidate, truth_m: Floats, *, tried: int = 1) -> Candidate:
    """Return a suspected fault with how the spread of ranges changes with the true distances (n,) without it.

    The statistic is the logarithm of how much wider they spread before, by stretches of time. Undoing a fault that
    narrows ranges by less than a twentieth is not worth a word: curves that are left in do that.
    """
    before, after = (view.less_pairs(view.ranges.raw_m - true) for true in (view.ranges.truth_m, truth_m))
    known = np.isfinite(before) & np.isfinite(after)
    rows = np.flatnonzero(known & (np.abs(view.ranges.truth_m - truth_m) > 1e-3))
    rows = rows[np.argsort(view.exchanges.time_ns[rows], kind="stable")]
    # A tag that ranges with two others has 80 ranges in a quick fit: eight stretches of ten.
    cuts = [rows[cut] for cut in stretches(len(rows), fewest=10)]
    if not cuts:
        return replace(seen, p_value=1.0)
    old, new = ([max(robust_spread(errors[cut], 0.0), 1e-6) for cut in cuts] for errors in (before, after))
    old_cm, new_cm = (100 * robust_spread(errors[np.isfinite(errors)], 0.0) for errors in (before, after))
    return replace(
        seen,
        evidence=f"{seen.evidence}, the spread of the ranges is {new_cm:.1f} cm instead of {old_cm:.1f} cm",
        p_value=positive(np.log(0.95) + np.log(old) - np.log(new), tried=tried),
        gain=_gain(before[rows], after[rows]),
    )


def _gain(before_m: Floats, after_m: Floats) -> float:
    """Return by how much errors (n,) shrink together, metres; errors of 10 m are as bad as any larger ones."""
    return float(np.nansum(np.minimum(np.abs(before_m), 10.0) - np.minimum(np.abs(after_m), 10.0)))


TOLERANCE_M: Final = 0.05
"""What a place by tape or markers is off by, with the antenna beside the marker: the size of a board."""

PAIR_M: Final = 0.04
"""What lever arms by a ruler and phase centres of antennas do to a pair: 2 cm at either end."""


def anchors(view: RecordingView) -> Iterator[Candidate]:
    """Find exchanged tags; then anchors at other positions, with the displacement `away_m` (3,) in the candidate."""
    # Where nothing moves, each pair has a level that is its own.
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
        # A table's own true distances are used, and its poses are what places tags when ranges are.
        by_poses = anchors(_with_truth(view, posed=True))
        yield from (replace(one, evidence=f"by the poses, {one.evidence}") for one in by_poses)


def _with_truth(view: RecordingView, **said: Any) -> RecordingView:
    """Return a view with other poses or tags, and true distances by them."""
    told, e = replace(view, **said), view.exchanges
    truth_m = distances_m(told.poses, told.tags, e.initiator, e.target, e.time_ns)
    return replace(told, ranges=replace(view.ranges, truth_m=truth_m))


def _line(view: RecordingView, tag: Tag, away_m: Floats | float = 0.0) -> str:
    """Return a tag as it stands in a map: an anchor where its body stands, displaced by `away_m` (3,)."""
    if tag.body not in places_m(view):
        return f"\n[[tags]]\nid = {tag.tag}\nbody = {tag.body!r}\nlever_arm_m = {list(tag.lever_arm_m)}"
    (place,) = antennas_m(view.poses, [tag], np.array([tag.tag]), view.poses.time_ns[view.poses.body == tag.body][:1])
    return f"\n[[anchors]]\nid = {tag.tag}\nposition_m = {(place + away_m).round(3).tolist()}"


def _exchanged(view: RecordingView, fit: QuickFit) -> tuple[dict[int, int], Candidate]:
    """Yield the finding of exchanged tags, with the exchange that undoes it.

    A tag a at the place of b ranges with c as far as b is from c, by the true distances of b and c, which are
    interpolated. The logarithms of the pairs' spreads are the likelihood, were each scale its own: an assignment of
    tags to places finds the likeliest exchange of any number of them. In each of its cycles one tag, of all at all
    places, must pass a test of its own.
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
        said = [f"{a} is at the given position of {b}" for a, b in zip(numbers[moved], numbers[at[moved]], strict=True)]
        return _undone(view, Candidate("swapped tag ids", f"tag {', '.join(said)}: undone"), mended, tried=count**2)

    known, spread, worse = sums = np.zeros((3, count, count))
    for (a, c), own in rows.items():
        usual = np.log(robust_spread(fit.error[own]) + 1e-6)
        for b in right:
            if (b, c) in rows:
                there = np.log(robust_spread(ranges.raw_m[own] - truth_m(own, rows[b, c])) + 1e-6)
                sums[:, a, b] += len(own) * np.array([1.0, there, there - usual])
    # At its own place a tag's ranges are not astray, and what narrows them by a twentieth is not worth a word.
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
    """Return the places (3,) of the bodies that carry tags and do not move, within what motion capture says of that."""
    bodies = sorted({tag.body for tag in view.tags} & set(np.unique(view.poses.body).tolist()))
    points = {body: view.poses.position_m[view.poses.body == body] for body in bodies}
    return {body: np.median(some, axis=0) for body, some in points.items() if np.ptp(some, axis=0).max() < 0.02}


def _displaced(view: RecordingView, fit: QuickFit) -> Iterator[Candidate]:
    """Yield anchors whose ranges fit other places, tested by the slopes of all distances there together.

    Where slopes at the given place may be zero no other is searched for: distances are linear in centimetres, not in
    metres, so that a search cannot be spared. Slopes at the other place are those of the error model, because
    reflections move a robust loss in directions that ranges hardly determine, as the height where robots keep theirs.
    """
    places = places_m(view)
    sides, poses, away = _sides(view, fit, places), view.poses, dict[str, Floats]()
    if not sides:
        return
    for body, own in _apart(fit.test(_outward(sides)), sides).items():
        mine = sides[body].any(axis=1)
        # Where anchors are metres off, what power does is not known, and small beside that.
        far = robust_spread(fit.residual[mine]) > ASTRAY_M
        # One of twenty right places costs time; the slopes at the other one are tested.
        if far or _p_of_place(own, own.total) <= 0.05:
            error_m = (fit.error if far else fit.residual)[mine]
            starts = [place - places[body] for place in places.values()]
            away[body] = _place(sides[body][mine], error_m, fit.model.pairs.number[mine], starts)
            there_m = np.where(poses.body[:, None] == body, poses.position_m + away[body], poses.position_m)
            poses = replace(poses, position_m=there_m)
    if not away or (moved := (told := _with_truth(view, poses=poses)).quick_fit) is None:
        return
    # What ranges know of the other places, as they fit these.
    tested = moved.test_constants(_outward(_sides(told, moved, places)))
    at_other = _apart(_beside_pairs(tested, len(moved.model.pairs.names)), sides)
    before_m, after_m = (one.less_pairs(one.error_m)[fit.rows] for one in (view, told))
    for body, there in away.items():
        own, mine = at_other[body], sides[body].any(axis=1)
        # The last step is that of the fit, whose slopes are tested.
        shift = there - _step(own)
        size, gain = float(np.linalg.norm(shift)), _gain(before_m[mine], after_m[mine])
        before, after = (robust_spread(errors[mine]) for errors in (before_m, after_m))
        # The spread of all ranges, and half of it more.
        if size <= TOLERANCE_M or gain <= 0 or after >= 1.5 * robust_spread(after_m):
            continue
        axes, loose = _axes(own, shift)
        # Places above each other are alike to robots that move in a plane; a displacement is known to a tenth.
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
            min(1.0, _p_of_place(own, own.information @ shift * (1 - TOLERANCE_M / size)) * len(sides)),
            {
                "body": body,
                "away_m": shift,
                "lines": "".join(_line(view, tag, shift) for tag in view.tags if tag.body == body),
            },
            gain,
        )


def _sides(view: RecordingView, fit: QuickFit, bodies: Iterable[str]) -> dict[str, Floats]:
    """Return the vectors (n, 3) to bodies from the antennas at the other ends of ranges, zero for ranges of others.

    Bodies with fewer than 200 ranges are left out: in 32 stretches of time slopes would be of some ranges each, and far
    from normal.
    """
    e, found = view.exchanges[fit.rows], dict[str, Floats]()
    here, there = (antennas_m(view.poses, view.tags, ids, e.time_ns) for ids in (e.initiator, e.target))
    for body in bodies:
        tags = [tag.tag for tag in view.tags if tag.body == body]
        sign = np.isin(e.initiator, tags).astype(float) - np.isin(e.target, tags)
        found |= {body: sign[:, None] * (here - there)} if np.count_nonzero(sign) >= 200 else {}
    return found


def _outward(sides: dict[str, Floats]) -> Floats:
    """Return by how much ranges (n, 3 * bodies) shrink as bodies move along the axes; `sides` (n, 3) lead to them."""
    return np.hstack([side / np.maximum(np.linalg.norm(side, axis=1), 1e-9)[:, None] for side in sides.values()])


def _apart(tested: Tested, bodies: Iterable[str]) -> dict[str, Tested]:
    """Return the slopes by displacements of each body, beside those of the others."""
    axes = np.arange(len(tested.total)) // 3
    return {
        body: tested.beside(np.flatnonzero(axes != k).tolist()).turned(np.eye(len(axes))[axes == k])
        for k, body in enumerate(bodies)
    }


def _beside_pairs(tested: Tested, pairs: int) -> Tested:
    """Return slopes by what comes after offsets of pairs, where each pair has an offset of its own, about `PAIR_M`."""
    own = tested.information[:pairs, :pairs]
    taken = -np.linalg.solve(own + np.eye(pairs) / PAIR_M**2, tested.information[:pairs, pairs:])
    step = np.hstack([taken.T, np.eye(len(tested.total) - pairs)])
    found, left = tested.turned(step), step @ tested.information
    # Offsets of pairs are in the slopes as well, as far as they are not taken off.
    offsets = PAIR_M * left[:, :pairs]
    return replace(found, information=left[:, pairs:], covariance=found.covariance + offsets @ offsets.T)


def _p_of_place(tested: Tested, slope: Floats) -> float:
    """Return the p-value of slopes (k,) by places, whose mean is zero if the places are right (Hotelling)."""
    solved, _, rank, _ = np.linalg.lstsq(tested.covariance, slope, rcond=1e-12)
    count = max(int(rank), 1)
    freedom = max(min(tested.lasting.freedom, tested.blocks) - count, 1.0)
    return float(special.fdtrc(count, freedom, float(slope @ solved) / count))


def beside_places(view: RecordingView, fit: QuickFit, pairs: Sequence[int]) -> tuple[Tested, list[Candidate]]:
    """Return the slopes by offsets of all pairs beside places of anchors, and these places beside offsets of `pairs`.

    Places that ranges contradict whatever the offsets of these pairs are one candidate, as anchors that range with each
    other tell how they stand together, and hardly which one is elsewhere.
    """
    count, places = len(fit.model.pairs.names), places_m(view)
    sides = _sides(view, fit, places) if view.posed and view.standing_m is None else {}
    tested = fit.test_constants(_outward(sides) if sides else None)
    offsets = tested.beside(range(count, len(tested.total))).turned(np.eye(count, len(tested.total)))
    if not sides:
        return offsets, []
    together = _beside_pairs(tested.beside(pairs), count)
    each, said, lines = _apart(together, sides), list[str](), list[str]()
    # Those that are off wherever the others stand, or else all.
    alone = [body for body, own in each.items() if _p_of_place(own, own.total) < BUDGET] or [*sides]
    for body in alone:
        shift = -_step(each[body])
        said.append(f"{body} {_axes(each[body], shift)[0]}")
        lines += [_line(view, tag, shift) for tag in view.tags if tag.body == body]
    seen = Candidate(
        "places that do not close",
        f"ranges contradict the positions of {', '.join(sides)} together; the best displacements are {'; '.join(said)}",
        _p_of_place(together, together.total),
        {"lines": "".join(lines)},
    )
    return offsets, [seen]


def _step(own: Tested) -> Floats:
    """Return the displacement (3,) that slopes ask for; without ranges a place is known to half a metre.

    So much a tape misread or a tripod moved does. Where slopes know nothing, there is no displacement.
    """
    return np.asarray(np.linalg.solve(own.information + np.eye(3) / (LOOSEST * 0.5) ** 2, own.total))


def _axes(own: Tested, shift: Floats) -> tuple[str, str]:
    """Return a displacement (3,) with intervals of 95 %, and the axes that ranges hardly tell from delays, in words."""
    inverse = np.linalg.pinv(own.information, rcond=1e-12, hermitian=True)
    times = special.stdtrit(min(own.lasting.freedom, own.blocks - 3.0), 0.975)
    wide = times * np.sqrt(np.diag(inverse @ own.covariance @ inverse))
    axes = [f"{name} {one:+.2f} ± {of:.2f}" for name, one, of in zip("xyz", shift, wide, strict=True)]
    loose = " and ".join(name for name, of in zip("xyz", wide, strict=True) if of > LOOSEST)
    return f"({', '.join(axes)} m, 95 %)", loose


def _place(apart: Floats, error: Floats, pair: Ints, starts: Sequence[Floats]) -> Floats:
    """Return the displacement (3,) that ranges ask for, beside a constant of each pair, by robust least squares.

    The best of searches from several starts (3,). A thousandth of a range holds the place where ranges do not: robots
    that move in a plane do not see its height.
    """
    every = slice(None, None, max(len(apart) // 2000, 1))
    apart, pair = apart[every], np.unique(pair[every], return_inverse=True)[1]
    measured = np.linalg.norm(apart, axis=1) + error[every]

    def residuals(x: Floats) -> Floats:
        rest = measured - np.linalg.norm(apart + x[:3], axis=1) - x[3:][pair]
        return np.append(rest, 1e-3 * len(rest) ** 0.5 * x[:3])

    found = []
    for start in starts:
        constants = medians(measured - np.linalg.norm(apart + start, axis=1), pair)
        found.append(optimize.least_squares(residuals, np.append(start, constants), loss="soft_l1", f_scale=0.1))
    return np.asarray(min(found, key=lambda one: one.cost).x[:3])
