"""What a fit has to say against itself: residuals that its intervals do not promise, values that hardware lacks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.power_curves import DEGREE, Curve, basis
from calib.estimation.alternatives import families
from calib.estimation.misfit import (
    CLEARLY,
    MATTERS,
    SMALLEST_M,
    SMALLEST_NS,
    Finding,
    Judgement,
    everywhere,
    examine,
    told,
)
from calib.estimation.places import OfPlaces, of_places
from calib.estimation.problem import Problem
from calib.estimation.solver import Solved
from calib.estimator.time_blocks import FEWEST_STRETCHES
from calib.long_columns import computed, let_go, spans
from uwblink.arrays import Floats
from uwblink.ticks import SPEED_OF_LIGHT

READINGS: Final = ("readings",)
"""The finding that powers are read with noise."""

FAR_M: Final = 0.12
"""Detours of less may as well be an error that wanders."""

DECIBEL: Final = float(10**0.1)
SHAPE: Final = 0.1
"""Noise by which a range is off that is surely reflected, if detours are not of the shape that a fit takes them for.

Detours of gamma's shape, or of two lengths, put delays off by as much (docs/accuracy.md).
"""

SCALE: Final = 0.01
"""An error of distances by distance that a recording may have and not show."""

CONFOUNDED_M: Final = 0.006
OFTEN_REFLECTED: Final = 0.45
FOUR: Final = 4
MOSTLY_REFLECTED: Final = 0.8
"""A pair with such a share of reflected ranges may as well be off by a constant."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Doubts:
    """The covariance (tags, tags) of the stated delays in ns^2 with what doubts add, and the doubts as sentences.

    `of_places_ns2` (tags, tags) is what of it errors add that belong to places.
    """

    covariance_ns2: Floats
    sentences: list[str]
    of_places_ns2: Floats


def doubts(problem: Problem, found: Solved) -> Doubts:
    """Hold a fit against its residuals, and widen the delays' covariance by what does not fit."""
    louder = of_a_decibel(problem, found)
    beside_curve = found.scores.design.shape[1] == problem.design.shape[1]
    tested, kept = families(problem, louder, beside_curve=beside_curve), found.scores.design.kept
    judged = examine(
        found.scores,
        found.by_block,
        found.inverse,
        found.delays,
        kept(problem.blocks.number),
        problem.blocks,
        tested=tested,
        shape_m=kept(_of_another_shape(problem, found)),
    )
    places = OfPlaces(widening_ns2=np.zeros((len(problem.tags),) * 2))
    if beside_curve:
        # Delays that were fitted without their curve leave its errors, which ranges of two bodies have in common.
        places = of_places(problem, found.scores, judged.pairs, kept(problem.blocks.number))
    covariance, sentences = weighed(problem, found, judged, places)
    sentences += [*reflected(problem, found), *short(found), *_confounded(problem, found)]
    return Doubts(covariance_ns2=covariance, sentences=sentences, of_places_ns2=places.widening_ns2)


def weighed(problem: Problem, found: Solved, judged: Judgement, places: OfPlaces) -> tuple[Floats, list[str]]:
    """Return the delays' covariance (tags, tags) with what findings add, and those that matter as sentences."""
    plain = problem.directions @ found.covariance[: problem.rank, : problem.rank] @ problem.directions.T
    before = plain + judged.widening_ns2
    said = places.told(before)
    covariance = plain + judged.widening_ns2 + places.widening_ns2
    narrower = [finding for finding in judged.findings if _of_arithmetic(finding, before, certain=bool(said))]
    if any("late" in finding.names for finding in narrower):
        # Ranges of two bodies are wrong together then, too: the narrower cause is named. Walls may follow the distance.
        said = []
    matter, plain = [], covariance
    for finding in judged.findings:
        moved = _moved(finding, plain)
        if moved > MATTERS:
            covariance = covariance + finding.spread_ns2
        large = abs(finding.offset_m) > SMALLEST_M
        if finding.names == READINGS:
            # The curve is right for the powers that are read.
            continue
        given = any(finding is one for one in narrower)
        if given or (moved > MATTERS and (large or (moved > CLEARLY and finding.largest_ns > SMALLEST_NS))):
            matter.append(finding)
    # A tag that was moved stands out in more than one span of time: once is enough.
    once = {(finding.kind, finding.names): finding for finding in reversed(matter)}
    return covariance, [*said, *(told(one) for one in matter if once[one.kind, one.names] is one)]


def _of_arithmetic(finding: Finding, before_ns2: Floats, *, certain: bool) -> bool:
    """Return whether a finding that all ranges share is a cause by itself, with places `certain` or not.

    True distances of another time than ranges move ranges, and hardly delays.
    """
    if finding.kind != "shared" or finding.names == READINGS:
        return False
    large = abs(finding.offset_m) > SMALLEST_M
    return certain or (large and ("late" in finding.names or _moved(finding, before_ns2) > MATTERS))


def _moved(finding: Finding, covariance: Floats) -> float:
    """Return by how many of its standard errors a finding moves some delay."""
    std = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    moved = float(np.max(np.abs(finding.effects_ns) / std, initial=0.0))
    if not len(std):
        # Without a delay in the fit the curve takes what an offset does.
        return abs(finding.offset_m) > SMALLEST_M
    if finding.kind == "time":
        # A delay that was another one for a while is wrong by as much, then or at other times. The printed interval has
        # grown with it already: what does not return looks like an error that lasts.
        moved = 2e9 * abs(finding.offset_m) / SPEED_OF_LIGHT / float(np.median(std))
    return moved


def of_a_decibel(problem: Problem, found: Solved) -> Floats:
    """Return by how much ranges (n,) would read otherwise, had their powers been a decibel higher."""
    if not problem.unknowns.curve:
        return np.broadcast_to(0.0, len(problem.error))
    mean = np.mean([found.parameters[columns] for _, columns in problem.curves()], axis=0)
    curve = Curve(tuple(problem.knots.tolist()), tuple(mean.tolist()), DEGREE, problem.span)
    lifted = problem.lifted
    louder = computed(len(lifted), lambda rows: curve(DECIBEL * lifted[rows]) - curve(lifted[rows]))
    let_go(lifted)
    return louder


def _of_another_shape(problem: Problem, solved: Solved) -> Floats:
    """Return by how much ranges (n,) of a pair would be off, were its reflections of another shape than the fit's."""
    mixture = solved.mixture
    if mixture is None:
        return np.broadcast_to(0.0, len(problem.error))
    share = mixture.tail_share * mixture.noise * float(np.exp(np.mean(mixture.of("cell_noise"))))
    by_pair, number = SHAPE * share, problem.pairs.number
    found = computed(len(number), lambda rows: by_pair[number[rows]])
    let_go(number)
    return found


def reflected(problem: Problem, found: Solved) -> list[str]:
    """Name the pairs of which hardly a range is direct, and tags most of whose are not, where that was fitted."""
    if found.mixture is None:
        return []
    share, ends = found.mixture.tail_share, problem.pairs.ends
    tags = np.unique(ends)
    sentences = []
    far = found.mixture.tail_mean_m > FAR_M
    for number in np.flatnonzero((share > MOSTLY_REFLECTED) & far).tolist():
        a, b = ends[number].tolist()
        others = [tag for tag in tags.tolist() if tag not in (a, b)]
        # Over four tags, a pair's offset and that of the two others leave the same trace.
        either = f" or pair {others[0]}-{others[1]}" if len(tags) == FOUR else ""
        sentences.append(
            f"pair {a}-{b}{either}: {100 * share[number]:.0f} % of its ranges are reflected, or off by "
            f"{100 * found.mixture.tail_mean_m[number]:.0f} cm; record it anew, delays rest on the other pairs"
        )
    for tag in tags.tolist():
        own = np.any(ends == tag, axis=1)
        mean = float(np.where(far, share, 0.0)[own].mean())
        if mean > OFTEN_REFLECTED and not sentences:
            sentences.append(
                f"tag {tag}: {100 * mean:.0f} % of its ranges are reflected; what stands near its antenna?"
            )
    return sentences


def _confounded(problem: Problem, found: Solved) -> list[str]:
    """Say where a small error that grows with the distance would pass for a curve over power.

    The curve is fitted beside such an error, of which `SCALE` is known beforehand, and what that takes of its certainty
    is held against the band that is printed.
    """
    columns = slice(problem.rank, problem.design.shape[1])
    if not problem.unknowns.curve:
        return []
    if problem.design.shape[1] != found.scores.design.shape[1] or not np.ptp(problem.ranges.truth_m) > 0:
        return []
    problem.let_go()
    found.scores.let_go()
    truth_m = problem.ranges.truth_m
    middle = np.median(truth_m)
    far = found.scores.design.kept(computed(len(truth_m), lambda rows: truth_m[rows] - middle))
    let_go(truth_m)
    link = found.scores.linked(far, *everywhere(found.scores))[0]
    taken = link @ found.inverse
    own = sum(float(found.scores.known(rows) @ far[rows] ** 2) for rows in spans(len(far)))
    known = (own - float(taken @ link)) / found.lasting.factor
    slope = 1 / np.sqrt(SCALE**-2 + max(known, 0.0))
    rows = basis(np.quantile(problem.lifted, np.linspace(0.02, 0.98, 25)), problem.knots)
    rows = np.tile(rows - rows.mean(axis=0), len(problem.groups)) / len(problem.groups)
    more = float(np.sqrt(np.mean((rows @ taken[columns] * slope) ** 2)))
    variance = float(np.mean(np.einsum("ij,jk,ik->i", rows, found.covariance[columns, columns], rows)))
    band = float(np.sqrt(max(variance, 0.0)))
    if more < max(CONFOUNDED_M, 2 * band):
        return []
    return [
        f"power and distance are confounded: true distances {100 * SCALE:.0f} % off would pass for {1e3 * more:.0f} mm "
        f"of the curve, whose band says {1e3 * band:.0f} mm; turn the antennas while recording, or fit with "
        "`delays_only`"
    ]


def short(found: Solved) -> list[str]:
    """Say where errors last so long that a recording holds few independent stretches of time."""
    lasting = found.lasting
    if lasting.stretches >= FEWEST_STRETCHES:
        return []
    return [
        f"errors last for {lasting.stretch_s:.1f} s, so the recording holds only {lasting.stretches:.0f} independent "
        f"stretches of time; intervals are widened for it, and a guess below {FEWEST_STRETCHES:.0f}: record for longer"
    ]
