"""A fit held against its own residuals: by pair, by tag over time, by tag over power.

Each alternative is an offset that some ranges would have beside what was fitted. Its score test (Rao's) needs no second
fit: slopes of the log likelihood by the offset, less what the fitted parameters would take of it, summed over short
blocks of time and held against their own variance, persistence included. Offsets by pair can only be told from delays
as far as pairs close (quadruples of pairs over four tags); with three tags nothing of them is left to test.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import stdtr, stdtrit

from calib.estimation.alternatives import Family, segments
from calib.estimation.row_order import Runs
from calib.estimation.scores import Scores
from calib.estimator.time_blocks import Persistence, TimeBlocks, persistence
from calib.long_columns import let_go
from uwblink.arrays import Floats, Ints

ERROR_RATE: Final = 0.005
"""Share of sound fits that may be doubted, all alternatives together."""


DRAWN: Final = ("pair", "session")
"""Families whose offsets are draws with one variance: it is in the intervals, whether one of them stands out or not."""

SPANS: Final = 2
"""Spans of time within which errors are looked at for how long they last, where an alternative does not end."""

MATTERS: Final = 1.0
"""An offset matters that moves some delay by so many of its printed standard errors."""

SMALLEST_M: Final = 0.01
"""An offset of less is nobody's fault: it widens intervals, and is not named unless it matters clearly."""

CLEARLY: Final = 4.0
SMALLEST_NS: Final = 0.02
"""So many standard errors of a delay, and so much of it."""

FEWEST: Final = 30
SAME: Final = 0.95
"""Alternatives whose tests correlate by more than this cannot be told from each other."""

MOST_NAMED: Final = 3
SUGGESTED: Final = 2.5
"""So many standard errors of decibels, beside certainty that a tag's errors go with power."""

REACHED: Final = 1e-3
"""Share of an alternative's information that must be left beside the fitted parameters for it to be tested."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """An alternative that the residuals ask for: its kind, whose it may be, the offset, and what it does to delays.

    `effect_ns` (tags,) is by how much the delays would change, `deviation` how many standard errors the offset is from
    none, `p_value` how likely so much is by chance in any of the tests. An offset of one session may as well be the
    opposite one of all others: `otherwise_ns` (tags,) is what that does, `sessions` are that session and the others.
    """

    kind: str
    names: tuple[str, ...]
    offset_m: float
    deviation: float
    effect_ns: Floats
    p_value: float
    otherwise_ns: Floats | None = None
    sessions: tuple[str, str] = ("", "")

    @property
    def effects_ns(self) -> tuple[Floats, ...]:
        """What the offset may do to the delays, by whichever side of a difference is off."""
        return (self.effect_ns,) if self.otherwise_ns is None else (self.effect_ns, self.otherwise_ns)

    @property
    def spread_ns2(self) -> Floats:
        """The covariance (tags, tags) that delays have when nothing says which side of a difference is off."""
        return np.asarray(np.mean([np.outer(effect, effect) for effect in self.effects_ns], axis=0))

    @property
    def largest_ns(self) -> float:
        """By how much a delay would change at most."""
        return float(np.max(np.abs(self.effects_ns), initial=0.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """What the residuals say: findings, the gravest first, and covariance (tags, tags) to add to that of the delays.

    `pairs` are the slopes of offsets by pair, from which some of it follows.
    """

    findings: list[Finding]
    widening_ns2: Floats
    pairs: Tested | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Tested:
    """A family's kind and names, and its efficient slopes: sums (k,), their covariance (k, k), information (k, k), and
    effects (tags, k) in ns/m.

    `by_time` (k,) are sums of the slopes that the covariance is made of, over so many `blocks`; `whole` is the
    largest information that an alternative would have, were nothing else fitted.
    """

    kind: str
    names: list[str]
    total: Floats
    covariance: Floats
    by_time: Floats
    information: Floats
    whole: float
    effects: Floats
    lasting: Persistence
    blocks: int
    sessions: tuple[str, ...] = ("",)


def examine(
    scores: Scores,
    own: Floats,
    inverse: Floats,
    delays: Floats,
    number: Ints,
    blocks: TimeBlocks,
    *,
    tested: Iterable[Family],
    shape_m: Floats,
) -> Judgement:
    """Hold a fit against alternatives.

    `own` (blocks, D) are the slopes by the fitted parameters summed over short blocks of time, which `number` (n,)
    numbers; `inverse` (D, D) is that of information and penalty, `delays` (tags, m) turns the parameters of the design
    into delays in ns. `shape_m` (n,) is by how much ranges would be off, were the shape that the fit takes for the tail
    of reflections another one. Rows are in the order in which the design keeps them.
    """
    effect = -delays @ (scores.linked(shape_m, *everywhere(scores)) @ inverse)[0, : delays.shape[1]]
    widening = np.outer(effect, effect)
    # One family at a time: each has columns of its own.
    results = []
    for family in tested:
        results.append(_test(family, scores, own, inverse, delays, number, blocks))
        del family
    several = sum(len(result.names) for result in results)
    found = [finding for result in results for finding in findings(result, several)]
    widening += sum(widening_of_pairs(result) for result in results if result.kind in DRAWN)
    found = _told_once(found)
    found += list(_of_gain(found, results))
    return Judgement(
        findings=sorted(found, key=lambda finding: -abs(finding.deviation)),
        widening_ns2=widening,
        pairs=next((result for result in results if result.kind == "pair"), None),
    )


def _told_once(found: list[Finding]) -> list[Finding]:
    """Leave out what a tag does for a while where a difference between sessions says the same more surely."""
    between = {name: abs(one.deviation) for one in found if one.kind == "session" for name in one.names}
    return [
        one
        for one in found
        if one.kind != "time" or not any(between.get(name, 0.0) > abs(one.deviation) for name in one.names)
    ]


def everywhere(scores: Scores) -> tuple[Runs, list[tuple[Ints, float]], int]:
    """Return runs, ends and count of one group that all ranges belong to."""
    runs = scores.design.runs()
    return runs, [(np.zeros_like(runs.block), 1.0)], 1


def _of_gain(found: list[Finding], results: list[Tested]) -> Iterator[Finding]:
    """Yield wrong decibels of tags whose errors go with power in another way, where they suggest such.

    How errors go with power says that a tag is not as the others, decibels what that does to its delay.
    """
    result = next((result for result in results if result.kind == "decibels"), None)
    names = result.names if result else []
    certain = {name for finding in found if finding.kind == "decibels" for name in finding.names}
    for finding in found:
        name = finding.names[0]
        if result is None or finding.kind != "power" or name not in names or name in certain:
            continue
        k = names.index(name)
        known = max(float(result.information[k, k]), 1e-300)
        offset = float(result.total[k]) / known
        if known > REACHED * result.whole and abs(offset) > SUGGESTED * np.sqrt(result.covariance[k, k]) / known:
            yield replace(
                finding, kind="decibels", names=(name,), offset_m=-offset, effect_ns=result.effects[:, k] * offset
            )


def _test(
    family: Family, scores: Scores, own: Floats, inverse: Floats, delays: Floats, number: Ints, blocks: TimeBlocks
) -> Tested:
    """Return a family's efficient slopes; `own` (blocks, D) are those by the fitted parameters."""
    size, count, runs = len(family.names), len(own), family.runs
    plain, square, own_known = np.zeros((count, size)), np.zeros((size, size)), np.zeros((count, size))
    # Ends that have a weight in common share its sums; of several weights each belongs to one end.
    weights = family.weight if isinstance(family.weight, tuple) else (family.weight,)
    ends = [family.ends] if len(weights) == 1 else [(end,) for end in family.ends]
    known = np.empty((len(weights), len(weights), len(runs.block)))
    for which, rows in scores.spans(runs):
        some = [weight[rows] if isinstance(weight, np.ndarray) else weight for weight in weights]
        fisher, starts = scores.known(rows), runs.starts[which] - rows.start
        for k, m in np.ndindex(len(weights), len(weights)):
            known[k, m, which] = np.add.reduceat(fisher * some[k] * some[m], starts)
        lengths, when = runs.lengths[which], number[rows] * size
        for k, weight in enumerate(some if len(weights) > 1 else ()):
            own_known[:, k] += np.bincount(number[rows], fisher * weight**2, count)
        for weight, own_ends in zip(some, ends, strict=True):
            slope = scores.score[rows] * weight
            for place, sign in own_ends:
                where = when + np.repeat(place[which], lengths)
                plain += sign * np.bincount(where, slope, minlength=count * size).reshape(count, size)
        scores.let_go()
        let_go(number, *(weight if isinstance(weight, np.ndarray) else None for weight in weights))
    for k, m in np.ndindex(len(weights), len(weights)):
        for place, sign in ends[k]:
            for other, its in ends[m]:
                both = np.bincount(place * size + other, known[k, m], minlength=size * size).reshape(size, size)
                square += sign * its * both
    link = sum(
        (scores.linked(weight, runs, own_ends, size) for weight, own_ends in zip(weights, ends, strict=True)),
        np.zeros((size, scores.size)),
    )
    taken = link @ inverse
    efficient = plain - own @ taken.T
    information = square - taken @ link.T
    whole = max(float(np.diag(square).max()), 1e-300)
    free = np.linalg.matrix_rank(information, tol=REACHED * whole, hermitian=True)
    # What an alternative does must not pass for errors that last: those are judged within spans of time.
    total = efficient.sum(axis=0)
    # Nor may what all ranges share, which a block shows by as much as it knows of it.
    scatter = efficient - own_known * (total / np.maximum(own_known.sum(axis=0), 1e-300))
    lasting = persistence(scatter, blocks, int(free), spans_of(family, blocks))
    return Tested(
        kind=family.kind,
        names=family.names,
        total=total,
        covariance=lasting.factor * (scatter.T @ scatter),
        by_time=total,
        information=information,
        whole=whole,
        effects=-delays @ taken[:, : delays.shape[1]].T,
        lasting=lasting,
        blocks=count,
        sessions=family.sessions,
    )


def spans_of(family: Family, blocks: TimeBlocks) -> int:
    """Return within how many spans of time to look at how long errors last, where a family may hold some of them."""
    return segments(blocks.seconds) if family.kind == "time" else SPANS


def widening_of_pairs(result: Tested) -> Floats:
    """Return what offsets that scatter more than their slopes allow add to the delays' covariance.

    Offsets of pairs, or of tags and pairs in sessions, are taken for draws with one variance, which is estimated by the
    method of moments (DerSimonian and Laird 1986): the weighted square of all slopes exceeds its expectation by the
    variance times a trace.
    """
    values, vectors = np.linalg.eigh(result.information)
    keep = values > REACHED * result.whole
    freedom = int(np.count_nonzero(keep))
    if not freedom:
        return np.zeros((len(result.effects),) * 2)
    base = vectors[:, keep]
    inverse = np.linalg.pinv(base.T @ result.covariance @ base, rcond=1e-9, hermitian=True)
    # The inverse of a covariance of few blocks is too large on average (of Wishart's distribution).
    inverse *= max(1 - (freedom + 1) / result.blocks, 0.1)
    slope = base.T @ result.total
    reach = base.T @ result.information
    trace = float(np.trace(reach.T @ inverse @ reach))
    variance = max(float(slope @ inverse @ slope) - freedom, 0.0) / max(trace, 1e-300)
    return np.asarray(variance * result.effects @ result.effects.T)


def findings(result: Tested, several: int) -> Iterator[Finding]:
    """Yield the alternatives that stand out, one after the other, each beside those already found."""
    freedom = max(result.lasting.freedom, 3.0)
    limit = float(stdtrit(freedom, 1 - ERROR_RATE / several / 2))
    total, covariance, information = result.total.copy(), result.covariance.copy(), result.information.copy()
    for _ in range(MOST_NAMED):
        std = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        known = np.diag(information) > REACHED * result.whole
        deviation = np.where(known, total / std, 0.0)
        top = int(np.argmax(np.abs(deviation)))
        if abs(deviation[top]) < limit:
            return
        # Residuals are fitted less true: an offset that they ask for is one that the ranges have too little.
        offset = float(total[top] / information[top, top])
        alike = np.abs(covariance[top] / (std[top] * std)) > SAME
        close = alike & known & (np.abs(deviation) > SAME * abs(deviation[top]))
        names = tuple(dict.fromkeys(result.names[k] for k in np.flatnonzero(close)))
        finding = Finding(
            kind=result.kind,
            names=names,
            offset_m=-offset,
            deviation=float(deviation[top]),
            effect_ns=result.effects[:, top] * offset,
            p_value=min(several * 2 * float(stdtr(freedom, -abs(float(deviation[top])))), 1.0),
        )
        yield _of_session(finding, result, top, offset) if len(result.sessions) > 1 else finding
        # With this offset fitted too, the others keep what it does not explain.
        taken = information[:, top] / information[top, top]
        step = np.eye(len(total))
        step[:, top] -= taken
        total, covariance, information = step @ total, step @ covariance @ step.T, step @ information @ step.T


def _of_session(finding: Finding, result: Tested, top: int, offset: float) -> Finding:
    """Return a finding with which session it is, and what it does to delays if all others are off instead."""
    count = len(result.sessions)
    own = top % count
    others = [k for k in range(top - own, top - own + count) if k != top]
    rest = result.sessions[1 - own] if count == 2 else "the other recordings"
    return replace(
        finding,
        otherwise_ns=-result.effects[:, others].sum(axis=1) * offset,
        sessions=(result.sessions[own], rest),
    )


def told(finding: Finding) -> str:
    """Return a finding as a sentence."""
    whose = " or ".join(finding.names)
    size = f"{100 * abs(finding.offset_m):.1f} cm"
    worst = f"delays by up to {1e3 * finding.largest_ns:.0f} ps"
    own, others = finding.sessions
    way = "long" if finding.offset_m > 0 else "short"
    sentences = {
        "pair": f"{whose}: ranges read {size} too {way} for the other pairs, which moves {worst}; record it anew",
        "time": f"{whose}: ranges are {size} too {way} for a part of the recording, which moves {worst}; touched?",
        "session": f"{whose}: ranges in {own} are {size} {way}er than in {others} (p = {finding.p_value:.1g}), which "
        f"moves {worst}; was an antenna changed, or something moved, in between? Fit the recordings apart to see",
        "power": f"{whose}: errors change with power by {size} as no other tag's do, which moves {worst}",
        "decibels": f"{whose}: errors are as if its powers were wrong by some decibels, {size} in its ranges, which "
        f"moves {worst}; does it stand at another gain, or have another antenna?",
        "skew": f"{whose}: ranges read {size} too {way} as initiator and as much the other way as target, which moves "
        f"{worst}: clock skew is not corrected, or with the wrong sign",
        "scale": f"ranges grow with the distance by {size} too {way} over the recorded distances, which moves {worst}; "
        "see to the unit and the lever arms of the true distances",
        "late": f"ranges change by {size} with the speed at which true distances change (root mean square): motion "
        "capture and ranges are not of the same time; see to the clocks (`calib doctor` says by how much)",
    }
    if finding.kind == "shared":
        # Where two causes leave the same trace, both are named.
        return "; or ".join(sentences[name] for name in finding.names if name in sentences)
    return sentences[finding.kind]
