"""Checks of delays and pairs: does one more offset explain residuals, of a pair, or of a tag from some time on?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy import sparse, special

from calib.checks.geometry import anchors, places_m
from calib.checks.recording_view import Offsets, QuickFit, RecordingView, quick_fit
from calib.estimator.score_tests import findings
from calib.findings import BUDGET, Candidate, exceeds
from calib.spread import robust_spread
from uwblink.arrays import Floats
from uwblink.ticks import SPEED_OF_LIGHT

DELAY_M: Final = 0.02
"""What temperature does to the delay of a sound board: 2.15 mm a degree (DW1000 user manual), ten degrees."""

PAIR_M: Final = 0.04
"""What lever arms by a ruler and phase centres of antennas do to a pair: 2 cm at either end."""


def closures(view: RecordingView) -> Iterator[Candidate]:
    """Pairs with an offset that the delays of their tags do not explain; those that explain it as well are named.

    The constants of pairs in a quick fit are what delays and offsets of pairs add up to. So offsets are found as those
    of the score tests of a fit are, and of any size: what delays take of constants is linear.
    """
    # With ten ranges a pair's constant is known to 2 cm, half of the tolerance.
    fit = view.quick_fit or quick_fit([view], ranges_a_pair=10)
    if fit is None:
        return
    tested = fit.test_constants()
    total, information = tested.total, tested.information
    # What offsets that are found leave of the others.
    top = [
        fit.model.pairs.names.index(name)
        for one in findings(tested, len(fit.model.pairs.names), BUDGET, PAIR_M)
        for name in one.names[:1]
    ]
    rest = total - information[:, top] @ np.linalg.lstsq(information[np.ix_(top, top)], total[top], rcond=1e-9)[0]
    spread_m = robust_spread(rest / np.maximum(np.diag(information), 1e-300), 0.0)
    # Where reflections make all pairs differ, one of them has to stand out among these.
    # Biases by power of two pairs may differ by 0.2 m (published curves), where the pairs share no power.
    tolerance = max(PAIR_M, float(special.ndtri(1 - BUDGET / (2 * len(total)))) * spread_m) + (
        0.2 if view.standing_m is not None else 0.0
    )
    for one in findings(tested, len(total), BUDGET, tolerance):
        yield Candidate(
            "pairs that do not close",
            f"ranges of pair {' or pair '.join(one.names)} are {100 * abs(one.offset_m):.1f} cm too "
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
    # Of a shorter recording the 32 stretches of scores would last for less than errors do.
    if fit is None or fit.blocks.seconds < 10.0:
        return
    share = fit.blocks.number / fit.blocks.count
    # No change is looked for within four of the stretches of time of scores at either end: sums over fewer are far from
    # normal where reflections last, and their variance is not known. Times are so close that a step between two loses
    # 1 % of its size; they are fewer for many pairs, for the sake of memory.
    cuts = np.linspace(1 / 8, 7 / 8, min(47, 1500 // len(fit.model.pairs.ends)))
    courses = np.column_stack([share[:, None] >= cuts, share])
    for one in changes_of_tags(fit, courses):
        fault, what, when = "delay drifts", "drift", "over the recording"
        if one.course < len(cuts):
            when_s = np.ptp(fit.model.ranges.time_ns[: np.argmax(courses[:, one.course]) + 1]) * 1e-9
            fault, what, when = "delay changed mid-flight", "shift", f"{when_s:.0f} s after the start"
        evidence = f"ranges of tag {one.tag} {what} by {100 * one.size_m:+.1f} cm {when} {one} do not"
        yield Candidate(fault, evidence, one.p_value, {"tag": one.tag})


def changes_of_tags(fit: QuickFit, courses: Floats) -> Iterator[Change]:
    """Yield changes of single tags, unless another change that is found says that it was no delay.

    Such are one of a pair, or of all tags, at about that time, and one back: a body in the way goes again. An antenna,
    or a voltage, is one tag's, so that other pairs change by 40 % of it at most (a judgement).
    """
    named, found = set[int | None]({None}), _changes(fit, courses)
    # Of two courses that share less than half of their variance neither stands for the other.
    same = np.atleast_2d(np.corrcoef(courses.T)) ** 2 > 0.5
    for one in found:
        against = [
            two
            for two in found
            if (two.tag is None and same[one.course, two.course])
            or (two.tag == one.tag and two.size_m * one.size_m < 0)
        ]
        alone = all(abs(two.size_m) <= 0.4 * abs(one.size_m) for two in against)
        # No antenna and no voltage does more than 5 ns.
        if one.tag not in named and alone and abs(one.size_m) < 0.75:
            named.add(one.tag)
            yield one


def _changes(fit: QuickFit, courses: Floats) -> list[Change]:
    """Return changes in one of the courses (n, k), each beside those before it: of all tags, of one, or of a pair."""
    pairs, width, tags = len(fit.model.pairs.ends), courses.shape[1], np.unique(fit.model.pairs.ends).tolist()
    own = np.equal.outer(tags, fit.model.pairs.ends).any(axis=2).astype(float)
    several = own.sum(axis=1)
    # A tag with one pair needs others, for the pair to be its own matter.
    kept = np.flatnonzero((several < pairs) & ((several > 1) | (pairs - several > 2)))
    whose, found = [None, *(tags[k] for k in kept), *[None] * pairs], list[Change]()
    groups = np.vstack([np.ones(pairs), own[kept], np.eye(pairs)])
    while len(found) < 3:
        offsets = Offsets.of(fit.test(_by_pair(fit, courses)), groups, width)
        gain = (offsets.size**2 * offsets.known).reshape(width, len(groups)).T
        # By how much variances exceed those of slopes that are a likelihood's, for most changes.
        excess = float(np.median((offsets.std**2 * offsets.known)[offsets.known > 0]))
        # Of these standard errors; a finding needs five of its own, which may be smaller.
        likely = [k for k in np.argsort(-gain.max(axis=1))[:4].tolist() if gain[k].max() > 3**2 * excess]
        trials = (
            _change(fit, whose[k], groups[k], courses, int(np.argmax(gain[k])), len(tags) * width) for k in likely
        )
        best = next(((change, rest) for change, rest in trials if change.p_value < BUDGET), None)
        if best is None:
            break
        found, fit = [*found, best[0]], best[1]
    return found


def _change(
    fit: QuickFit, tag: int | None, pairs: Floats, courses: Floats, course: int, tried: int
) -> tuple[Change, QuickFit]:
    """Return the change of some pairs (k,), those of a tag or others, in a course, and a fit without it.

    Slopes at no offset say too little of a large one, so it is fitted.
    """
    size, rest = fit.without(pairs[fit.model.pairs.number] * courses[:, course])
    tested = rest.test(_by_pair(fit, courses[:, [course]]))
    left, alone = Offsets.of(tested, pairs[None]), np.diag(tested.covariance) * pairs
    # Errors of different pairs hardly go together, so that each tells of their variance (Welch and Satterthwaite).
    std = max(float(left.std[0]), float(np.sqrt(alone.sum())) / max(float(left.known[0]), 1e-300))
    dof = left.dof * alone.sum() ** 2 / max(float(np.sum(alone**2)), 1e-300)
    p_value = exceeds(size, std, dof, tolerance=DELAY_M, tried=tried)
    return Change(tag=tag, course=course, size_m=size, p_value=p_value), rest


def _by_pair(fit: QuickFit, courses: Floats) -> sparse.csr_matrix:
    """Return courses (n, k) as those of each pair (n, k * pairs)."""
    whose = sparse.csr_matrix(
        np.equal.outer(fit.model.pairs.number, np.arange(len(fit.model.pairs.ends))).astype(float)
    )
    return sparse.csr_matrix(sparse.hstack([whose.multiply(course[:, None]) for course in courses.T]))


def compared(views: Sequence[RecordingView], level: float) -> Iterator[Candidate]:
    """What differs between recordings, each compared with the one before it; `level` is that of a check."""
    displaced = [{one.words["body"]: one for one in anchors(view) if one.p_value < level} for view in views]
    for (first, second), both in zip(pairwise(views), pairwise(displaced), strict=True):
        given, bodies = [places_m(view) for view in (first, second)], set().union(*both)
        for body in sorted(bodies.intersection(*given)):
            found = [of.get(body) for of in both]
            # Where it stands in both, by its ranges.
            (away,) = np.diff(
                [
                    places[body] + (one.words["away_m"] if one else 0.0)
                    for places, one in zip(given, found, strict=True)
                ],
                axis=0,
            )
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
