"""Checks of the residuals of a quick fit: ranges far off, skew of clocks, reflections, one more offset.

Offsets are those of a pair, or of a tag from some time on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from scipy import sparse, special

from calib.checks.geometry import PAIR_M, anchors, beside_places, places_m
from calib.checks.recording_view import QuickFit, RecordingView, quick_fit
from calib.data.clocks import PPM_TO_METRES, corrected
from calib.estimator.known_distances import ASTRAY_M
from calib.estimator.score_tests import REACHED, findings
from calib.findings import BUDGET, NAMED_DETOUR_M, Candidate, more_often, positive, stretches
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats
from uwblink.protocols.table import single_sided
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import intervals, without_stamps

ONE_WAY_M: Final = 0.05
"""Maximum difference of the ranges of a sound pair between its two initiators: the powers of both directions differ
slightly, and published curves have a slope of 2 cm per dB (rms over -98 to -78 dBm)."""

MANY_SHARE: Final = 0.15
"""Share of reflected ranges of a sound recording: among obstacles placed for it a MILUV flight has 12 %."""

LEAST_SHARE: Final = 0.02
"""With a smaller share of reflected ranges, the duration of reflections is not tested: it is a sixth of the share in a
MILUV flight, and noise can be taken for it."""

LASTING_S, AGAIN = 0.8, 0.35
"""Longer reflections are named if the probability of a reflection after a reflected range exceeds the mean by more than
this share of the remainder to 1. Within this time antennas turn by less than the width of their beams, also in sound
recordings: set with seeds below `benchmarks.flights.FIRST_REPORTED`."""

LEFT, WRONG_SIGN = "skew in single-sided ranges", "carrier readings with the wrong sign"
SLOPES: Final = {
    False: (
        (1.0, LEFT, 'correct the ranges with the carrier readings (protocol "ss-cfo"), or use double-sided ranging'),
        (
            -1.0,
            WRONG_SIGN,
            "the ranges contain skew, and the carrier readings have the wrong sign: change it on import",
        ),
    ),
    True: (
        (-2.0, WRONG_SIGN, "the correction doubles the skew: change the sign of the carrier readings on import"),
        (1.0, LEFT, "the carrier readings have no effect on the correction: check their unit"),
    ),
}
"""Meaning of the slopes of errors over the expected skew, for protocols without and with a correction of skew."""


def unrelated_ranges(view: RecordingView) -> Iterator[Candidate]:
    """Find pairs whose ranges do not agree with the true distances."""
    fit, found = view.quick_fit, list[tuple[float, str]]()
    if fit is None:
        return
    for pair, name in enumerate(fit.model.pairs.names):
        rest = np.minimum(np.abs(fit.residual[fit.model.pairs.number == pair]), 10 * ASTRAY_M)
        means = np.array([float(np.mean(rest[s])) for s in stretches(len(rest))])
        # The mean of logarithms is at most the logarithm of the mean (Jensen), and logarithms vary less between
        # stretches.
        found.append((positive(np.log(np.maximum(means, 1e-3) / ASTRAY_M)), f"{name} by {np.mean(rest):.2f} m"))
    found.sort()
    # A fault of an anchor or a tag affects several pairs: a joint test of all p-values (Simes 1986).
    p_value = min(len(found) * p_value / k for k, (p_value, _) in enumerate(found, 1))
    wrong = [name for own, name in found if own < BUDGET]
    more = f" and {len(wrong) - 6} pairs more" if wrong[6:] else ""
    yield Candidate(
        "ranges that do not follow the distances",
        f"after removing each pair's median, ranges differ from the true distances: on average pairs "
        f"{', '.join(wrong[:6])}{more}",
        p_value,
    )


def skew(view: RecordingView) -> Iterator[Candidate]:
    """Find errors that depend on the carrier readings: skew that was not corrected, or corrected with the wrong
    sign.
    """
    e = view.exchanges
    single = np.isin(e.protocol, single_sided()) & np.isfinite(view.ranges.error_m) & ~without_stamps(e)
    taken = {corrected(name) for name in np.unique(e.protocol[single]).tolist()}
    if len(taken) != 1:
        return
    known = single & np.isfinite(e.skew2_ppm) & (e.skew2_ppm != 0)
    # Delays are the same in both directions, and independent of skews, so pairs that range in one direction also count.
    fit = quick_fit([view.chosen(known)], constants="tag")
    if fit is None:
        yield from _by_direction(view.chosen(single))
        return
    some = e[known][fit.rows]
    # A target's reply lasts longer by the clock of a faster initiator, and so does the range.
    expected = PPM_TO_METRES * some.skew2_ppm * intervals(some).dt32 * TICK_S
    slope, p_value, _ = fit.offset(expected, tolerance=0.5)
    evidence = f"the slope of errors over c/2 times carrier skew times reply time is {slope:.2f}"
    for at, fault, remedy in SLOPES[taken.pop()]:
        # Halfway between the slopes of sound and of faulty ranges.
        if abs(slope - at) < 0.5:
            yield Candidate(fault, evidence, p_value, {"more": remedy})


def _by_direction(single: RecordingView) -> Iterator[Candidate]:
    """Find skew without carrier readings: ranges of a pair are longer in one direction, and shorter by as much in the
    other.
    """
    fit = quick_fit([single])
    if fit is None:
        return
    signs = np.where(single.exchanges.initiator < single.exchanges.target, 0.5, -0.5)[fit.rows]
    tested = fit.test(_by_pair(fit, signs[:, None]))
    beyond = np.abs(tested.total) - ONE_WAY_M * np.diag(tested.information)
    worst = int(np.argmax(beyond / np.sqrt(np.maximum(np.diag(tested.covariance), 1e-300))))
    own = np.eye(len(fit.model.pairs.ends))[worst]
    size, p_value, _ = fit.offset(signs, own, tolerance=ONE_WAY_M, tried=len(own))
    yield Candidate(
        LEFT,
        f"ranges of pair {fit.model.pairs.names[worst]} differ by {100 * abs(size):.0f} cm between the two "
        f"initiators, the most of all pairs",
        p_value,
        {
            "more": "record the carrier integrator, or use double-sided ranging; until then use the mean of both "
            "directions"
        },
    )


def reflections(view: RecordingView) -> Iterator[Candidate]:
    """Find pairs whose reflections last, and recordings or tags with a large share of reflected ranges."""
    fit = view.quick_fit or quick_fit([view], constants="tag", ranges_a_pair=1)
    if fit is None or len(fit.rows) < 150:
        return
    long = fit.reflected > 0.5
    lasting = [one for pair in range(len(fit.model.pairs.ends)) for one in _of_pair(fit, pair, long)]
    lasting = sorted((one for one in lasting if one.p_value < BUDGET), key=lambda one: -one.gain)
    if lasting:
        more = f"; and {len(lasting) - 4} pairs more" if lasting[4:] else ""
        named = "; ".join(one.evidence for one in lasting[:4]) + more
        yield Candidate("reflections that last", named, min(one.p_value for one in lasting))
        return
    far = long & (fit.residual > NAMED_DETOUR_M)
    p_value = positive(np.array([np.mean(far[s]) - MANY_SHARE for s in stretches(len(far))]))
    evidence, remedy = f"about {_in_words(fit, long)} on average", "move antennas away from bodies and walls"
    if view.quick_fit is None:
        remedy = "check for objects near these antennas; pairs have too few ranges for more details: record for longer"
        for tag in (tags := np.unique(fit.ends).tolist()):
            mine = (fit.ends == tag).any(axis=1)
            usual = min(float(np.mean(far[~mine] if not mine.all() else far)) + MANY_SHARE, 1.0)
            own = more_often(int(far[mine].sum()), int(mine.sum()), usual, tried=len(tags))
            if own < BUDGET:
                p_value, evidence = min(p_value, own), f"{evidence}; tag {tag}: {_in_words(fit, long, mine)}"
    yield Candidate("reflections", evidence, p_value, {"more": remedy})


def _in_words(fit: QuickFit, long: Bools, mine: Bools | slice = slice(None)) -> str:
    """Return a text with the share of long ranges among some, and their mean excess over the others."""
    return f"{100 * np.mean(long[mine]):.0f} % of the ranges, by {100 * _detour_m(fit, long, mine):.0f} cm"


def _detour_m(fit: QuickFit, long: Bools, mine: Bools | slice) -> float:
    rest, which = fit.residual[mine], long[mine]
    return float(np.mean(rest[which]) - np.median(rest[~which])) if which.any() and not which.all() else 0.0


def _of_pair(fit: QuickFit, pair: int, every: Bools) -> Iterator[Candidate]:
    """Yield a pair whose reflected ranges follow each other; its gain is their effect on its mean range."""
    mine = fit.model.pairs.number == pair
    long, share = every[mine], float(np.mean(every[mine]))
    if len(long) < 60 or not LEAST_SHARE < share < 1:
        return
    life_s = _life_s(fit.reflected[mine], 1e-9 * float(np.median(np.diff(fit.model.ranges.time_ns[mine]))))
    if life_s > LASTING_S:
        after = long[1:][long[:-1]]
        yield Candidate(
            "reflections that last",
            f"pair {fit.model.pairs.names[pair]}: {_in_words(fit, every, mine)}, for {life_s:.1f} s at a time",
            more_often(int(after.sum()), len(after), share + AGAIN * (1 - share), tried=len(fit.model.pairs.ends)),
            gain=share * _detour_m(fit, every, mine),
        )


def _life_s(reflected: Floats, step_s: float) -> float:
    """Return the mean duration of a reflection, from probabilities (n,) that ranges of a pair are reflected.

    The autocorrelation of a process of two states decreases exponentially with time, at the sum of both rates; noise
    reduces it by the same factor at all lags. Ranges are `step_s` apart.
    """
    apart = reflected - reflected.mean()
    near, far = (float(np.mean(apart[lag:] * apart[:-lag])) for lag in (1, 4))
    if near <= 0:
        return 0.0
    rate = np.log(near / max(far, 0.01 * near)) / (3 * step_s)
    # A change that lasts longer than a quarter of the recording cannot be distinguished from another level.
    return float(min(1 / max(rate * (1 - reflected.mean()), 1e-9), step_s * len(reflected) / 4))


def closures(view: RecordingView) -> Iterator[Candidate]:
    """Find pairs with an offset that the delays of their tags do not explain; equivalent pairs are named as well.

    The constants of pairs in a quick fit are sums of delays and offsets of pairs. So offsets of any size are found as
    in the score tests of a fit: the part that delays absorb is linear.
    """
    # With ten ranges a pair's constant is known to 2 cm, half of the tolerance.
    fit = view.quick_fit or quick_fit([view], ranges_a_pair=10)
    if fit is None:
        return
    tested, several = fit.test_constants(), len(fit.model.pairs.names)
    top = [fit.model.pairs.names.index(one.names[0]) for one in findings(tested, several, BUDGET, PAIR_M)]
    # The others, with the found offsets fitted.
    rest = tested.with_fitted(top).total / np.maximum(np.diag(tested.information), 1e-300)
    spread_m = robust_spread(rest, 0.0)
    # If reflections make all pairs differ, a faulty pair must be significant among these. Biases over power of two
    # pairs may differ by 0.2 m (published curves) if the pairs have no common powers.
    tolerance = max(PAIR_M, float(special.ndtri(1 - BUDGET / (2 * several))) * spread_m) + (
        0.2 if view.standing_m is not None else 0.0
    )
    found = list(findings(tested, several, BUDGET, tolerance))
    if not found:
        return
    # Anchors at wrong places cause offsets of pairs, too; with places fitted, none remain.
    offsets, places = beside_places(view, fit, top)
    sure = {name for one in findings(offsets, several, BUDGET, tolerance) for name in one.names}
    # Offsets of pairs determine whether there is a fault; the places' own p-value determines only its kind.
    elsewhere = [replace(seen, p_value=found[0].p_value) for seen in places if seen.p_value < BUDGET]
    yield from elsewhere
    for one in found:
        certain = not sure.isdisjoint(one.names)
        if certain or not elsewhere:
            yield Candidate(
                "pairs that do not close",
                f"ranges of pair {' or pair '.join(one.names)} are {100 * abs(one.offset_m):.1f} cm too "
                f"{'long' if one.offset_m > 0 else 'short'} compared with the delays of their tags, which other "
                f"pairs determine{'' if certain else '; or anchors are at other positions, which has the same effect'}",
                one.p_value,
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """Ranges of a tag (None: of a pair, or of all tags: `common`) grow by `size_m` in one of the courses."""

    tag: int | None
    common: bool
    course: int
    size_m: float
    p_value: float

    def __str__(self) -> str:
        """Return the change of the tag's delay, in words."""
        return f"({2e9 * abs(self.size_m) / SPEED_OF_LIGHT:.2f} ns of its delay) in all its pairs, those of others"


def changed_delays(view: RecordingView) -> Iterator[Candidate]:
    """Find tags whose delay changes during a recording, at once or steadily, and changes of all delays together."""
    fit = view.quick_fit
    # In a shorter recording the 32 stretches of scores would be shorter than the duration of errors.
    if fit is None or fit.blocks.seconds < 10.0:
        return
    share = fit.blocks.number / fit.blocks.count
    # No change is sought within four stretches of scores at either end: sums over fewer are far from normal if
    # reflections last, and their variance is unknown. Times are so close that a step between two loses 1 % of its size;
    # for many pairs there are fewer, to save memory.
    cuts = np.linspace(1 / 8, 7 / 8, min(47, 1500 // len(fit.model.pairs.ends)))
    # The last two are a steady drift, and boards that warm up, with a time constant of a fifth of the recording (a
    # judgement: between a step and a drift).
    courses = np.column_stack([share[:, None] >= cuts, share, 1 - np.exp(-5 * share)])
    by_readings = "fit the dependence on its measured temperature (setting `temperature`); or "
    found = _changes(fit, courses)
    for one in [*changes_of_tags(found, courses), *(one for one in found if one.common)]:
        fault, what, when = "delay drifts", "drift", "over the recording"
        if one.course < len(cuts):
            when_s = np.ptp(fit.model.ranges.time_ns[: np.argmax(courses[:, one.course]) + 1]) * 1e-9
            fault, what, when = "delay changed mid-flight", "shift", f"{when_s:.0f} s after the start"
        if one.common:
            evidence = f"ranges of all tags {what} by {100 * one.size_m:+.1f} cm {when}"
            yield Candidate("all delays change", evidence, one.p_value)
            continue
        yield Candidate(
            fault,
            f"ranges of tag {one.tag} {what} by {100 * one.size_m:+.1f} cm {when} {one} do not",
            one.p_value,
            {"tag": one.tag, "readings": by_readings * (one.tag in view.warming)},
        )


def changes_of_tags(found: Sequence[Change], courses: Floats) -> Iterator[Change]:
    """Yield changes of single tags among those that were found, unless another shows that the delay did not change.

    Such changes are one of a pair, or of all tags, at about the same time, and one back to the old value: an obstacle
    that leaves again. An antenna or a voltage belongs to one tag, so other pairs change by at most 40 % of it (a
    judgement).
    """
    named = set[int | None]({None})
    # Two courses that share less than half of their variance are different changes.
    with np.errstate(invalid="ignore"):  # a constant course is like no other
        same = np.atleast_2d(np.corrcoef(courses.T)) ** 2 > 0.5
    for one in found:
        against = [
            two
            for two in found
            if (two.tag is None and same[one.course, two.course])
            or (two.tag == one.tag and two.size_m * one.size_m < 0)
        ]
        alone = all(abs(two.size_m) <= 0.4 * abs(one.size_m) for two in against)
        # No antenna and no voltage changes a delay by more than 5 ns.
        if one.tag not in named and alone and abs(one.size_m) < 0.75:
            named.add(one.tag)
            yield one


def _changes(fit: QuickFit, courses: Floats) -> list[Change]:
    """Return changes with one of the courses (n, k), each with the previous ones fitted: of all tags, of one, or of a
    pair.
    """
    pairs, width, tags = len(fit.model.pairs.ends), courses.shape[1], np.unique(fit.model.pairs.ends).tolist()
    own = np.equal.outer(tags, fit.model.pairs.ends).any(axis=2).astype(float)
    several = own.sum(axis=1)
    # A tag with only one pair is included if there are other pairs; otherwise the pair explains its change.
    kept = np.flatnonzero((several < pairs) & ((several > 1) | (pairs - several > 2)))
    whose, found = [None, *(tags[k] for k in kept), *[None] * pairs], list[Change]()
    groups = np.vstack([np.ones(pairs), own[kept], np.eye(pairs)])
    while len(found) < 3:
        tested = fit.test(_by_pair(fit, courses))
        of_course = (width, pairs, width, pairs)
        known, variance = (
            np.einsum("gp,cpcq,gq->gc", groups, every.reshape(of_course), groups)
            for every in (tested.information, tested.covariance)
        )
        known = np.where(known > REACHED * tested.whole, known, np.inf)
        gain = (groups @ tested.total.reshape(width, pairs).T) ** 2 / known
        # The usual ratio of variances to those of the slopes of a likelihood.
        excess = float(np.median((variance / known)[np.isfinite(known)])) if np.isfinite(known).any() else np.inf
        # In these standard errors; a finding needs five of its own, which may be smaller.
        likely = [k for k in np.argsort(-gain.max(axis=1))[:4].tolist() if gain[k].max() > 3**2 * excess]
        for k in likely:
            course = int(np.argmax(gain[k]))
            # The effect of temperature on the delay of a sound board: 2.15 mm per degree (DW1000 user manual), ten
            # degrees.
            size, p_value, rest = fit.offset(courses[:, course], groups[k], tolerance=0.02, tried=len(tags) * width)
            if p_value < BUDGET:
                found.append(Change(tag=whose[k], common=not k, course=course, size_m=size, p_value=p_value))
                fit = rest
                break
        else:
            break
    return found


def _by_pair(fit: QuickFit, courses: Floats) -> sparse.csr_matrix:
    """Return courses (n, k) for each pair separately (n, k * pairs)."""
    return sparse.csr_matrix(sparse.hstack([fit.by_pair.multiply(course[:, None]) for course in courses.T]))


def between_recordings(views: Sequence[RecordingView], level: float) -> Iterator[Candidate]:
    """Find differences between consecutive recordings; `level` is the false-alarm level of a check."""
    displaced = [
        {one.words["body"]: one for one in anchors(view) if "body" in one.words and one.p_value < level}
        for view in views
    ]
    for (first, second), both in zip(pairwise(views), pairwise(displaced), strict=True):
        given, bodies = [places_m(view) for view in (first, second)], set().union(*both)
        for body in sorted(bodies.intersection(*given)):
            found = [of.get(body) for of in both]
            # Its positions in both recordings, by its ranges.
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
        course = (fit.model.ranges.session == 1)[:, None] if fit else np.empty((0, 1))
        for one in changes_of_tags(_changes(fit, course), course) if fit else ():
            yield Candidate(
                "delay changed between recordings",
                f"ranges of tag {one.tag} are {100 * one.size_m:+.1f} cm longer in {second.name} than in {first.name} "
                f"{one} are not",
                one.p_value,
                {"tag": one.tag},
            )
