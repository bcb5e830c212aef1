"""Checks of delays and pairs: does one more offset explain residuals, of a pair, or of a tag from some time on?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from scipy import sparse, special

from calib.checks.fitted import of_pairs, shares_of_pairs
from calib.checks.geometry import anchors, places_m
from calib.checks.recording_view import Offsets, QuickFit, RecordingView, quick_fit
from calib.errors import CalibError
from calib.estimator.known_distances import FEWEST_RANGES, fit_known_distances
from calib.estimator.score_tests import findings
from calib.findings import BUDGET, Candidate, exceeds
from calib.pairs import pairs_of
from calib.settings import FitSettings
from calib.spread import robust_spread
from uwblink.arrays import Floats
from uwblink.ticks import SPEED_OF_LIGHT

DELAY_M: Final = 0.02
"""What temperature does to the delay of a sound board: 2.15 mm a degree (DW1000 user manual), ten degrees."""

PAIR_M: Final = 0.04
"""What lever arms by a ruler and phase centres of antennas do to a pair: 2 cm at either end."""


def closures(view: RecordingView) -> Iterator[Candidate]:
    """Pairs with an offset that the delays of their tags do not explain; those that explain it as well are named.

    Slopes at no offset say too little of a large one, which the error model takes for reflections of all ranges of a
    pair. So offsets are found by a few fits, each of which begins with those before; a pair that is mostly reflected
    moves by the median of what it is off.
    """
    rows = np.flatnonzero(np.isfinite(view.error_m))
    if len(rows) < FEWEST_RANGES:
        return
    ranges = view.ranges[rows]
    pairs = pairs_of(ranges.initiator, ranges.target)
    offset_m = np.zeros(len(pairs.ends))
    for _ in range(5):
        moved = replace(ranges, truth_m=ranges.truth_m + offset_m[pairs.number])
        try:
            found = fit_known_distances(moved, FitSettings())
        except CalibError:
            return
        # The pairs of the fit among all.
        at = np.flatnonzero((pairs.ends[:, None] == found.model.pairs.ends).all(axis=2).any(axis=1))
        beside, before = found.slopes.test(of_pairs(found)), offset_m
        spread_m = robust_spread(beside.total / np.maximum(np.diag(beside.information), 1e-300), 0.0)
        tested = replace(beside, total=beside.total - beside.information @ before[at])
        offset_m, names = np.zeros(len(before)), list(tested.family.names)
        for one in findings(tested, len(names), BUDGET):
            offset_m[at[names.index(one.names[0])]] = one.offset_m
        for k in np.flatnonzero(shares_of_pairs(found)[0] > 0.5).tolist():
            offset_m[at[k]] = before[at[k]] + np.median(found.residuals[found.model.pairs.number == k])
        if np.max(np.abs(offset_m - before)) < 0.01:
            break
    # Where reflections make all pairs differ, one of them has to stand out among these.
    tolerance = max(PAIR_M, float(special.ndtri(1 - BUDGET / (2 * len(offset_m)))) * spread_m)
    if view.standing_m is not None:
        # Biases by power of two pairs may differ by so much (published curves), where the pairs share no power.
        tolerance += 0.2
    for one in findings(tested, len(offset_m), BUDGET, tolerance):
        yield Candidate(
            "pairs that do not close",
            f"ranges of {' or '.join(one.names)} are {100 * abs(one.offset_m):.1f} cm too "
            f"{'long' if one.offset_m > 0 else 'short'} for the delays of their tags, by closed loops of the other "
            "pairs",
            one.p_value,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """Ranges of a tag (None: of a pair, or of all tags) grow by `size_m` in one of the courses."""

    tag: int | None
    course: int
    size_m: float
    p_value: float

    def __str__(self) -> str:
        """Return what it is in the tag's delay, and that it is the tag's."""
        return f"({2e9 * abs(self.size_m) / SPEED_OF_LIGHT:.2f} ns in its delay), all its pairs alike, others"


def changed_delays(view: RecordingView) -> Iterator[Candidate]:
    """Tags whose delay changes during a recording, at one of many times or steadily."""
    fit = view.quick_fit
    if fit is None or fit.time_s[-1] < 10.0:
        return
    # No change is looked for within four of the stretches of time of scores at either end: sums over fewer are far from
    # normal where reflections last, and their variance is not known. Times are so close that a step between two loses
    # 1 % of its size; they are fewer for many pairs, for the sake of memory.
    cuts = fit.time_s[-1] * np.linspace(1 / 8, 7 / 8, min(47, 1500 // len(fit.ends)))
    courses = np.column_stack([fit.time_s[:, None] >= cuts, fit.time_s / fit.time_s[-1]])
    time_ns = fit.model.ranges.time_ns
    for one in changes_of_tags(fit, courses):
        fault, what, when = "delay drifts", "drift", "over the recording"
        if one.course < len(cuts):
            when_s = (time_ns[np.argmax(courses[:, one.course] > 0)] - time_ns[0]) * 1e-9
            fault, what, when = "delay changed mid-flight", "shift", f"{when_s:.0f} s after the start"
        evidence = f"ranges of tag {one.tag} {what} by {100 * one.size_m:+.1f} cm {when} {one} do not"
        yield Candidate(fault, evidence, one.p_value, {"tag": one.tag})


def changes_of_tags(fit: QuickFit, courses: Floats) -> Iterator[Change]:
    """Yield changes of single tags, unless another change that is found says that it was no delay.

    Such are one of a pair, or of all tags, and one back: a body in the way goes again. An antenna, or a voltage, is one
    tag's, so that other pairs change by 40 % of it at most.
    """
    named, found = set[int | None]({None}), _changes(fit, courses)
    for one in found:
        against = [two for two in found if two.tag is None or (two.tag == one.tag and two.size_m * one.size_m < 0)]
        alone = all(abs(two.size_m) <= 0.4 * abs(one.size_m) for two in against)
        # No antenna and no voltage does more than 5 ns.
        if one.tag not in named and alone and abs(one.size_m) < 0.75:
            named.add(one.tag)
            yield one


def _changes(fit: QuickFit, courses: Floats) -> list[Change]:
    """Return changes in one of the courses (n, k), each beside those before it: of all tags, of one, or of a pair."""
    pairs, width, tags = len(fit.ends), courses.shape[1], np.unique(fit.ends).tolist()
    groups: list[tuple[int | None, Floats]] = [(None, np.ones(pairs))]
    for tag in tags:
        mine = (fit.ends == tag).any(axis=1)
        # A tag with one pair needs others, for the pair to be its own matter.
        if min(mine.sum(), pairs - mine.sum()) > 0 and (mine.sum() > 1 or pairs - mine.sum() > 2):
            groups.append((tag, mine.astype(float)))
    groups += [(None, row) for row in np.eye(pairs)]
    among, found = np.kron(np.array([group for _, group in groups]), np.eye(width)), list[Change]()
    while len(found) < 3:
        offsets = Offsets.of(fit.test(_by_pair(fit, courses)), among)
        gain = (np.maximum(np.abs(offsets.size) - DELAY_M, 0.0) ** 2 * offsets.known).reshape(len(groups), width)
        # By how much variances exceed those of slopes that are a likelihood's, for most changes.
        excess = float(np.median((offsets.std**2 * offsets.known)[offsets.known > 0]))
        likely = [k for k in np.argsort(-gain.max(axis=1))[:4].tolist() if gain[k].max() > 4 * excess]
        trials = (_change(fit, groups[k], courses, int(np.argmax(gain[k])), len(tags) * width) for k in likely)
        best = next(((change, rest) for change, rest in trials if change.p_value < BUDGET), None)
        if best is None:
            break
        found.append(best[0])
        fit = best[1]
    return found


def _change(
    fit: QuickFit, group: tuple[int | None, Floats], courses: Floats, course: int, tried: int
) -> tuple[Change, QuickFit]:
    """Return the change of a group (a tag, its pairs) in a course, and a fit without it.

    What the change itself leaves in residuals is no noise: its standard error is that without it.
    """
    (tag, pairs), size, rest = group, 0.0, fit
    whose, by_pair = pairs[fit.pair] * courses[:, course], _by_pair(fit, courses[:, [course]])
    for _ in range(3):
        size += float(Offsets.of(rest.test(by_pair), pairs[None]).size[0])
        rest = fit.less(whose * size)
    tested = rest.test(by_pair)
    left, alone = Offsets.of(tested, pairs[None]), np.diag(tested.covariance) * pairs
    # Errors of different pairs hardly go together, so that each tells of their variance (Welch and Satterthwaite).
    std = max(float(left.std[0]), float(np.sqrt(alone.sum())) / max(float(left.known[0]), 1e-300))
    dof = left.dof * alone.sum() ** 2 / max(float(np.sum(alone**2)), 1e-300)
    p_value = exceeds(size, std, dof, tolerance=DELAY_M, tried=tried)
    return Change(tag=tag, course=course, size_m=size, p_value=p_value), rest


def _by_pair(fit: QuickFit, courses: Floats) -> sparse.csr_matrix:
    """Return courses (n, k) as those of each pair (n, pairs * k)."""
    rows, course = np.nonzero(courses)
    columns = fit.pair[rows] * courses.shape[1] + course
    shape = len(courses), len(fit.ends) * courses.shape[1]
    return sparse.csr_matrix((courses[rows, course].astype(float), (rows, columns)), shape=shape)


def compared(views: Sequence[RecordingView], level: float) -> Iterator[Candidate]:
    """What differs between recordings, each compared with the one before it; `level` is that of a check."""
    displaced = [{one.words["body"]: one for one in anchors(view) if one.p_value < level} for view in views]
    for (first, second), both in zip(pairwise(views), pairwise(displaced), strict=True):
        given, bodies = [places_m(view) for view in (first, second)], set().union(*both)
        for body in sorted(bodies.intersection(*given)):
            found = [of.get(body) for of in both]
            here, there = (
                places[body] + (one.words["away_m"] if one else 0.0) for places, one in zip(given, found, strict=True)
            )
            away = there - here
            if np.linalg.norm(away) > 0.08:
                yield Candidate(
                    "anchor moved between recordings",
                    f"{body} stands {np.linalg.norm(away):.2f} m elsewhere ({away[0]:+.2f} {away[1]:+.2f} "
                    f"{away[2]:+.2f} m) in {second.name} than in {first.name}, by its ranges and the places that the "
                    "recordings give it",
                    min(one.p_value for one in found if one),
                    {"body": body},
                )
        but = [tag.tag for tag in (*first.tags, *second.tags) if tag.body in bodies]
        ends = [(view.exchanges.initiator, view.exchanges.target) for view in (first, second)]
        others = [~(np.isin(a, but) | np.isin(b, but)) for a, b in ends]
        fit = quick_fit([view.chosen(rows) for view, rows in zip((first, second), others, strict=True)])
        for one in changes_of_tags(fit, (fit.model.ranges.session == 1)[:, None]) if fit else ():
            yield Candidate(
                "delay changed between recordings",
                f"ranges of tag {one.tag} are {100 * one.size_m:+.1f} cm longer in {second.name} than in {first.name} "
                f"{one} are not",
                one.p_value,
                {"tag": one.tag},
            )
