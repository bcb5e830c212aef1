"""Checks of delays and pairs: score tests of a quick fit for an offset of a pair, or of a tag from some time on.

The quick fit is a robust fit of a curve over power, and of constants of pairs, or delays of tags. Its residuals are
tested for one more unknown (`calib.estimator.score_tests`). Errors that last widen the standard errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from scipy import special

from calib.checks.fitted import has_shares, of_pairs, shares_of_pairs, slopes_of
from calib.checks.geometry import anchors, places_m
from calib.checks.pairs import standing_still
from calib.checks.recording_view import QuickFit, RecordingView, quick_fit
from calib.data.ranges import Ranges
from calib.errors import CalibError
from calib.estimator.known_distances import FEWEST_RANGES, KnownDistances, Recipe, fit_known_distances
from calib.estimator.score_tests import Tested, findings
from calib.findings import BUDGET, Candidate, exceeds, positive, stretches
from calib.pairs import pairs_of
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT

MOVED: Final = "delay changed mid-flight"
DRIFTED: Final = "delay drifts"
OPEN: Final = "pairs that do not close"
ASTRAY: Final = "ranges that do not follow the distances"
MOVED_ANCHOR: Final = "anchor moved between recordings"
OTHER_DELAY: Final = "delay changed between recordings"

DELAY_M: Final = 0.02
"""What temperature does to the delay of a sound board: 2.15 mm a degree (DW1000 user manual), ten degrees."""

PAIR_M: Final = 0.04
"""What lever arms by a ruler and phase centres of antennas do to a pair: 2 cm at either end."""

CURVE_M: Final = 0.2
"""How far the biases by power of two pairs may differ (published curves span so much), if powers of pairs do not vary,
so that pairs do not share one curve."""

LARGEST_M: Final = 0.75
"""Of 5 ns: no antenna and no voltage does more."""

LOUD_M: Final = 0.3
"""Mean absolute error of a pair, about its median, that reflections may explain: half of the ranges by 60 cm."""

CUTS: Final = 47
"""Times at which a delay is tested for a change: so close that a step between two of them loses 1 % of its size."""

MARGIN: Final = 1 / 8
"""Part of a recording at either end in which no change is looked for: four of the stretches of time of its scores. Sums
over fewer are far from normal where reflections last, and their variance is not known."""

MOST_COLUMNS: Final = 2500
"""Shifts of pairs at several times that are tested together: their covariance takes 50 MB."""

SHORTEST_S: Final = 10.0
MIN_RANGES_A_SIDE: Final = 12
"""Ranges of a pair before and after a change, so that its mean change is known to half of their spread."""

OTHERS: Final = 0.4
"""Share of a tag's shift by which other pairs may shift: an antenna, or a voltage, is one tag's."""

ANCHOR_MOVED_M: Final = 0.08
"""By how much places that two recordings give an anchor may differ."""

CLIP: Final = 2.5
"""Spreads beyond which a residual counts no further: a reflection is not to move a mean."""

MOST_NAMED: Final = 3
"""Tags of a recording that are named: faults are few."""

MOST_REPEATED: Final = 5
SETTLED_M: Final = 0.01
"""Fits that find how far a pair is off, and the change of an offset below which they have."""

MOSTLY: Final = 0.5
"""Share of reflected ranges of a pair beyond which its ranges may as well be off by a constant."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shift:
    """The ranges of a tag from some time on (`late`, n) are longer by `size_m`; `pairs` says in words which show it."""

    tag: int
    size_m: float
    late: Bools
    p_value: float
    pairs: str


def closures(view: RecordingView) -> Iterator[Candidate]:
    """Pairs with an offset that the delays of their tags do not explain; those that explain it as well are named."""
    rows = np.flatnonzero(np.isfinite(view.error_m))
    if len(rows) < FEWEST_RANGES:
        return
    ranges = Ranges.from_exchanges(view.exchanges[rows], view.truth_m[rows])
    pairs = pairs_of(ranges.initiator, ranges.target)
    offset_m = np.zeros(len(pairs.ends))
    for _ in range(MOST_REPEATED):
        moved = replace(ranges, truth_m=ranges.truth_m + offset_m[pairs.number])
        try:
            found = fit_known_distances(moved, Recipe(fixed_ns={}, groups={}, minimum_norm=True))
        except CalibError:
            return
        at = np.flatnonzero((pairs.ends[:, None] == found.model.pairs.ends).all(axis=2).any(axis=1))
        beside = slopes_of(found).test(of_pairs(found))
        spread_m = robust_spread(beside.total / np.maximum(np.diag(beside.information), 1e-300), 0.0)
        tested = replace(beside, total=beside.total - beside.information @ offset_m[at])
        before, offset_m = offset_m, _offsets(found, tested, at, offset_m)
        if np.max(np.abs(offset_m - before)) < SETTLED_M:
            break
    # Where reflections make all pairs differ, one of them has to stand out among these.
    tolerance = max(PAIR_M, float(special.ndtri(1 - BUDGET / (2 * len(offset_m)))) * spread_m)
    if standing_still(view) is not None:
        tolerance += CURVE_M
    for one in findings(tested, len(offset_m), BUDGET, tolerance):
        yield Candidate(
            OPEN,
            f"ranges of {' or '.join(one.names)} are {100 * abs(one.offset_m):.1f} cm too "
            f"{'long' if one.offset_m > 0 else 'short'} for the delays of their tags, by closed loops of the other "
            "pairs",
            one.p_value,
        )


def _offsets(found: KnownDistances, tested: Tested, at: Ints, before_m: Floats) -> Floats:
    """Return the offsets of pairs that residuals ask for, in metres; pairs of the fit stand `at` places among all.

    Slopes at no offset say too little of a large one, which the error model takes for reflections of all ranges of a
    pair: such a pair moves by the median of what it is off.
    """
    offset_m = np.zeros_like(before_m)
    names = list(tested.family.names)
    for one in findings(tested, len(names), BUDGET):
        offset_m[at[names.index(one.names[0])]] = one.offset_m
    if has_shares(found):
        for k in np.flatnonzero(shares_of_pairs(found)[0] > MOSTLY).tolist():
            offset_m[at[k]] = before_m[at[k]] + np.median(found.residuals[found.model.pairs.number == k])
    return offset_m


def astray(view: RecordingView) -> Iterator[Candidate]:
    """Pairs whose ranges and true distances have little to do with each other."""
    fit, found = view.quick_fit, list[tuple[float, str]]()
    if fit is None:
        return
    for pair, name in enumerate(fit.names):
        rest = np.minimum(np.abs(fit.residual[fit.pair == pair]), 10 * LOUD_M)
        means = np.array([float(np.mean(rest[s])) for s in stretches(len(rest))])
        p_value = positive(means - LOUD_M, tried=len(fit.ends))
        if p_value < BUDGET:
            found.append((p_value, f"{name} by {np.mean(means):.2f} m"))
    if found:
        named = ", ".join(name for _, name in found[:6]) + (f" and {len(found) - 6} pairs more" if found[6:] else "")
        yield Candidate(ASTRAY, f"ranges of pairs {named} differ on average, each pair's median aside", min(found)[0])


def changed_delays(view: RecordingView) -> Iterator[Candidate]:
    """Tags whose delay changes during a recording: all of their pairs shift alike, others do not."""
    fit = view.quick_fit
    if fit is None or fit.time_s[-1] < SHORTEST_S:
        return
    cuts = fit.time_s[-1] * np.linspace(MARGIN, 1 - MARGIN, min(CUTS, MOST_COLUMNS // len(fit.ends)))
    reach, time_ns = CLIP * max(robust_spread(fit.residual), 1e-4), fit.model.ranges.time_ns
    for shift in shifts(fit, fit.time_s[:, None] >= cuts):
        mine = fit.of_tag(shift.tag)
        time_s, rest, late = fit.time_s[mine], np.clip(fit.residual[mine], -reach, reach), shift.late[mine]
        fault, when = MOVED, f"{(time_ns[np.argmax(shift.late)] - time_ns[0]) * 1e-9:.0f} s after the start"
        if np.corrcoef(rest, time_s)[0, 1] ** 2 > 1.15 * np.corrcoef(rest, late)[0, 1] ** 2:
            fault, when = DRIFTED, "over the recording"
        if fault == DRIFTED or _stays(time_s, rest, late):
            yield Candidate(
                fault,
                f"ranges of tag {shift.tag} {'drift' if fault == DRIFTED else 'shift'} by {100 * shift.size_m:+.1f} cm "
                f"{when} {shift.pairs}, others do not",
                shift.p_value,
                {"tag": shift.tag},
            )


def _stays(time_s: Floats, rest: Floats, late: Bools) -> bool:
    """Return whether both parts keep their level: a body in the way goes again."""
    middle = np.where(late, np.median(time_s[late]), np.median(time_s[~late]))
    levels = np.array(
        [[np.mean(rest[side & half]) for half in (time_s < middle, time_s >= middle)] for side in (~late, late)]
    )
    return bool(np.ptp(levels, axis=1).max() < 0.6 * abs(np.diff(levels.mean(axis=1))[0]))


def shifts(fit: QuickFit, late: Bools) -> Iterator[Shift]:
    """Yield shifts of tags at one of several times, each beside those before; ranges after are `late` (n, cuts)."""
    found = set[int]()
    while len(found) < MOST_NAMED:
        shift = next(_likely_shifts(fit, late), None)
        if shift is None or shift.tag in found:
            return
        yield shift
        found.add(shift.tag)
        fit = fit.less(np.where(fit.of_tag(shift.tag) & shift.late, shift.size_m, 0.0))


def _likely_shifts(fit: QuickFit, late: Bools) -> Iterator[Shift]:
    """Yield shifts of single tags, at the time that explains most, those first that explain more."""
    size, weight, _, _ = fit.offsets_of_pairs(late)
    # How many times the variance of each pair's mean is that of independent ranges, as errors last.
    _, known, std, _ = fit.offsets_of_pairs(fit.time_s[:, None] > np.median(fit.time_s))
    weight = weight / np.where(known > 0, np.maximum(std**2 * known, 1e-9), np.inf)
    tags = np.unique(fit.ends)
    mine = np.array([(fit.ends == tag).any(axis=1) for tag in tags], dtype=np.float64)
    whole = np.maximum(mine @ weight, 1e-12)
    mean = mine @ (weight * size) / whole
    explained = np.maximum(np.abs(mean) - DELAY_M, 0.0) ** 2 * whole
    for k in np.argsort(-explained.max(axis=1)).tolist():
        cut = int(np.argmax(explained[k]))
        if explained[k, cut] > 0:
            yield from _shift_of(fit, int(tags[k]), late[:, cut], size[:, cut], float(mean[k, cut]), mean.size)


def _shift_of(fit: QuickFit, tag: int, late: Bools, size: Floats, mean: float, tried: int) -> Iterator[Shift]:
    """Yield the shift of a tag where its pairs shift alike, by about `mean`, and others do not."""
    mine = (fit.ends == tag).any(axis=1)
    sides = np.array([np.bincount(fit.pair[side], minlength=len(mine)) for side in (~late, late)])
    known = sides.min(axis=0) >= MIN_RANGES_A_SIDE
    own, others = known & mine, known & ~mine
    # A tag with one pair needs others, for the pair to be its own matter.
    needed = 2 if mine.sum() > 1 or others.sum() < 3 else 1
    if own.sum() < needed or np.median(np.abs(size[own] - mean)) > abs(mean):
        return
    medians = [
        float(np.median(fit.residual[rows & late]) - np.median(fit.residual[rows & ~late]))
        for rows in (fit.pair == pair for pair in np.flatnonzero(own))
    ]
    shift = float(np.average(medians, weights=1 / (1 / sides[:, own]).sum(axis=0)))
    # What the shift itself leaves in residuals is no noise: standard errors are those without it.
    rest = fit.less(np.where(fit.of_tag(tag) & late, shift, 0.0))
    _, _, errors, dof = rest.offsets_of_pairs(late[:, None])
    std = errors[:, 0]
    weight = std**-2.0
    mean = float(np.average(size[own], weights=weight[own]))
    quiet = not others.any() or (
        abs(float(np.average(size[others], weights=weight[others]))) < OTHERS * abs(mean)
        and float(np.median(np.abs(size[others]))) < 0.6 * abs(mean)
    )
    apart = np.abs(size[own] - mean)
    alike = (apart < 0.5 * abs(mean)) | (apart < 3.5 * std[own])
    sure = (np.abs(size[own]) > 2 * std[own]) & (size[own] * mean > 0)
    if quiet and alike.all() and sure.sum() >= needed and abs(shift) < LARGEST_M:
        # Variances of pairs are known apart, to so many degrees of freedom (Welch and Satterthwaite).
        whole = float(weight[own].sum())
        dof *= whole**2 / float(np.sum(weight[own] ** 2))
        p_value = exceeds(mean, whole**-0.5, dof, tolerance=DELAY_M, tried=tried)
        delay_ns = 2e9 * abs(shift) / SPEED_OF_LIGHT
        pairs = f"({delay_ns:.2f} ns in its delay), {'all its pairs alike' if mine.sum() > 1 else 'its only pair'}"
        yield Shift(tag=tag, size_m=shift, late=late, p_value=p_value, pairs=pairs)


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
            if np.linalg.norm(away) > ANCHOR_MOVED_M:
                yield Candidate(
                    MOVED_ANCHOR,
                    f"{body} stands {np.linalg.norm(away):.2f} m elsewhere ({away[0]:+.2f} {away[1]:+.2f} "
                    f"{away[2]:+.2f} m) in {second.name} than in {first.name}, by its ranges and the places that the "
                    "recordings give it",
                    min(one.p_value for one in found if one),
                    {"body": body},
                )
        yield from _other_delays(first, second, [tag.tag for tag in (*first.tags, *second.tags) if tag.body in bodies])


def _other_delays(first: RecordingView, second: RecordingView, but: list[int]) -> Iterator[Candidate]:
    """Yield tags all of whose pairs read otherwise in the second recording, beside other pairs that do not."""
    fit = quick_fit([
        view.chosen(~(np.isin(view.exchanges.initiator, but) | np.isin(view.exchanges.target, but)))
        for view in (first, second)
    ])  # fmt: skip
    for shift in shifts(fit, (fit.model.ranges.session == 1)[:, None]) if fit else ():
        yield Candidate(
            OTHER_DELAY,
            f"ranges of tag {shift.tag} are {100 * shift.size_m:+.1f} cm longer in {second.name} than in {first.name} "
            f"{shift.pairs}, others are not",
            shift.p_value,
            {"tag": shift.tag},
        )
