"""The survey: delays, power curve and positions of boards that stood still, and known facts that the ranges contradict.

Each check (wrong known distances, wrong shapes, exchanged labels) compares hypotheses of a fault with the survey as
described, each with the reflections that fit it best: a few reflected pairs can look like a string that is not
straight. The statistic is the ratio of the likelihoods, integrated over the unknowns; by Markov's inequality it exceeds
1/p with a probability of at most p if there is no fault. The likeliest hypothesis is accepted first, because a wrong
tape makes other facts seem wrong, too.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy import special
from threadpoolctl import threadpool_limits

from calib.calibration.model import Calibration, given_curve
from calib.calibration.power_curves import ALPHA_DBM, Curve
from calib.data.ranges import Ranges
from calib.data.samples import ANCHOR_DELAYS_NS
from calib.data.sources import Data
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.range_model import strangers
from calib.findings import BUDGET, Finding, warning
from calib.settings import SurveySettings, refuse
from calib.surveys.knowledge import Knowledge, check_knowledge, load_knowledge
from calib.surveys.network import DIMENSIONS, Boards, CurvePrior, Network
from calib.surveys.outcome import in_frames, result_of, widened_by
from calib.surveys.recordings import LIFT, SurveyData, read_surveys
from calib.surveys.result import SurveyResult
from calib.surveys.solution import Solution, adjust, averaged, exchanged_boards, first_start, out_of_order, solve
from uwblink.arrays import Floats
from uwblink.recording.schema import SHAPES
from uwblink.ticks import SPEED_OF_LIGHT


def likeliest_fault(found: Solution) -> tuple[Finding, Solution] | None:
    """Return the likeliest fault that chance does not explain, and the solution without it."""
    tried = [
        (fault, text, without, math.exp(min(0.5 * (without.deviance - found.deviance), 0.0)))
        for fault, hypotheses in HYPOTHESES.items()
        for text, without in hypotheses(found)
    ]
    likely = [one for one in tried if one[3] < BUDGET]
    if not likely:
        return None
    fault, text, without, p_value = min(likely, key=lambda one: one[2].deviance)
    return warning(fault, text, p_value), without


def _distances(found: Solution) -> Iterator[tuple[str, Solution]]:
    """Yield the solution with each of the known distances wrong by about half a metre."""
    network = found.network
    for k, one in enumerate(network.distances):
        loose = list(network.distances)
        # A wrong tape is misread by decimetres.
        loose[k] = replace(one, sigma_m=math.hypot(one.sigma_m, 0.5))
        without = adjust(replace(network, distances=tuple(loose)), found.x, start_m=found.case.pair_m)
        left = network.linear(without.x)[0][len(network.means.range_m) :]
        where = f" in {one.arrangement}" if one.arrangement else ""
        off = 100 * float(np.mean(left[network.tapes[1][:, 2] == k]))
        yield (
            f"the known distance of {one.first} and {one.second}{where} differs from the ranges by {off:+.0f} cm",
            without,
        )


def _shapes(found: Solution) -> Iterator[tuple[str, Solution]]:
    """Yield the solution with each arrangement outside its stated line or plane."""
    network = found.network
    for k, boards in enumerate(network.arrangements):
        if boards.dimensions == 3 or len(boards.tags) < boards.dimensions + 2 or boards.freed:
            continue
        arrangements = list(network.arrangements)
        arrangements[k] = replace(boards, dimensions=boards.dimensions + 1, freed=True)
        freed = replace(network, arrangements=tuple(arrangements))
        members, beside = network.members(k), boards.dimensions
        place = freed.positions_m(first_start(freed, found.delays))[members]
        # If scaling puts all boards on the line, the derivative beside it would be zero: boards start 15 cm beside it.
        if np.ptp(place[:, beside]) < 0.15:
            place[:, beside] += np.where(np.arange(len(members)) % 2, 0.15, -0.15)
        marks = found.case.marks & (network.means.arrangement != k)
        without = adjust(freed, freed.with_positions(found.x, place, members), marks=marks, start_m=found.case.pair_m)
        away = freed.positions_m(without.x)[members, beside]
        odd = boards.tags[int(np.argmax(np.abs(away - np.median(away))))]
        text = (
            f"{boards.name}: the boards are not on a {'line' if beside == 1 else 'plane'}: board {odd} is farthest "
            f"from it, and the deviations spread over {100 * np.ptp(away):.0f} cm"
        )
        yield text, without


def _exchanged(found: Solution) -> Iterator[tuple[str, Solution]]:
    """Yield the solution with two tags exchanged in the known facts, if a known fact has a large residual or is
    reflected.
    """
    network, here, count = found.network, found.linear, len(found.network.means.range_m)
    rows = here.jacobian[count:]
    # Residuals of known facts vary less than the facts, by the variance of the fit.
    off = list(here.left[count:] / np.sqrt(np.maximum(1 - np.diag(rows @ here.covariance @ rows.T), 1e-6)))
    for point, (place, sigma) in network.known_places.items():
        own = np.arange(3 * point, 3 * point + 3)
        off += list((found.x[own] - place) / np.sqrt(np.maximum(sigma**2 - here.covariance[own, own], 1e-12)))
    # Labels are tested if a known fact is off by three standard deviations. By chance 0.3 % are, which only costs time,
    # because the test of labels has its own level.
    if not (np.abs(off).max(initial=0.0) > 3.0 or (off and found.case.marks.any())):
        return
    involved = {tag for one in network.distances for tag in (one.first, one.second)}
    for one, other in combinations(sorted(involved | {place.tag for place in network.positions}), 2):
        swap = {one: other, other: one}
        distances = tuple(
            replace(d, first=swap.get(d.first, d.first), second=swap.get(d.second, d.second)) for d in network.distances
        )
        positions = tuple(replace(p, tag=swap.get(p.tag, p.tag)) for p in network.positions)
        changed = replace(network, distances=distances, positions=positions)
        text = f"the known facts agree with the ranges if {one} and {other} are exchanged"
        yield text, adjust(changed, first_start(changed, found.delays))


HYPOTHESES = {
    "wrong known distance": _distances,
    "arrangement not as stated": _shapes,
    "exchanged labels": _exchanged,
}
"""The hypotheses by fault."""


def wrong_orders(found: Solution) -> Iterator[Finding]:
    """Yield the contradictions between the stated orders of boards on a line and the ranges.

    A common contradiction of several arrangements is one contradiction.
    """
    network, points = found.network, found.network.positions_m(found.x)
    spots, chances, covariance = {}, {}, found.covariance()
    for k in out_of_order(network, found.x):
        members = np.array([network.points[k, tag] for tag in network.arrangements[k].order])
        along = points[members, 0]
        spots[k] = along if np.corrcoef(np.arange(len(along)), along)[0, 1] > 0 else -along
        chances[k] = _chance_of_order(spots[k], covariance[np.ix_(3 * members, 3 * members)])
    pairs = {k: exchanged_boards(network.arrangements[k].order, along) for k, along in spots.items()}
    while pairs:
        common = Counter(pair for some in pairs.values() for pair in sorted(some))
        pair = max(common, key=common.__getitem__, default=None)
        same = [k for k, some in pairs.items() if pair in some] or list(pairs)[:1]
        both = set.intersection(*(pairs.pop(k) for k in same))
        stated = network.arrangements[same[0]].order
        seen = [stated[n] for n in np.argsort(spots[same[0]]).tolist()]
        where = ", ".join(network.arrangements[k].name for k in same)
        words = ", or ".join(f"{i} and {j}" for i, j in sorted(both))
        what = f"boards {words} are exchanged" if both else "boards stand in another order than stated"
        text = (
            f"{where}: {what}: the stated order is {'-'.join(map(str, stated))}, but by the ranges of "
            f"{network.arrangements[same[0]].name} it is {'-'.join(map(str, seen))}"
        )
        yield warning("exchanged labels", text, chances[same[0]])


def _chance_of_order(along_m: Floats, covariance_m2: Floats) -> float:
    """Return the probability that the two boards (n,) that are farthest out of order are in order, by their
    covariance (n, n).
    """
    back_m = np.triu(np.subtract.outer(along_m, along_m), 1)
    i, j = np.unravel_index(int(np.argmax(back_m)), back_m.shape)
    variance = covariance_m2[i, i] + covariance_m2[j, j] - 2 * covariance_m2[i, j]
    return float(special.ndtr(-back_m[i, j] / math.sqrt(max(variance, 1e-12))))


def survey(data: Data | Iterable[Data], settings: SurveySettings | None = None, **changes: Any) -> SurveyResult:
    """Estimate delays, the power curve and positions of boards that stood still, from their ranges only.

    `data` is the same as for `load_ranges`; true distances are not needed and not used. Arrangements are those that
    recordings mark (`uwblink record --arrangement`), those whose times `known` gives, or stretches in which nothing
    moves. `settings` and keyword arguments named like its fields (`SurveySettings`, which explains them) state known
    facts and what is fitted.

    The result holds only delays that the arrangements determine. Raises `UnanswerableError` if none is, with the
    reason, and if ranges contradict stated facts (boards that are not on a line, a moved board, exchanged labels, a
    wrong distance), unless `regardless`; `BadInputError` for arguments that cannot be used.

    >>> import calib
    >>> result = calib.survey(calib.sample_arrangements(), known="line")
    >>> delay, planted = result.calibration.delays_ns[2], 0.1
    >>> abs(delay - planted) < 3 * result.calibration.delays_std_ns[2]
    True
    """
    asked = replace(settings or SurveySettings(), **changes)
    knowledge, taken = _knowledge(asked.known), _checked_curve(asked.curve_from)
    # Small matrices: several threads are slower, and change the last digits.
    with threadpool_limits(limits=1, user_api="blas"):
        gathered = read_surveys(data, knowledge)
        if taken is not None:
            gathered = _less_curve(gathered, taken.bias_curve)
        network = network_of(gathered, knowledge, asked.fixed_ns, curve=not asked.delays_only and taken is None)
        found, second = solve(replace(network, pair_m=asked.pair_error_m))
        findings = list(gathered.findings)
        # After findings of 15 % of the means the search ends.
        most = len(findings) + max(1, int(0.15 * len(network.means.range_m)))
        while len(findings) < most and (fault := likeliest_fault(found)):
            finding, found = fault
            findings.append(finding)
        if len(findings) > len(gathered.findings):
            found, second = solve(found.network)
        findings += wrong_orders(found)
        if findings and not asked.regardless:
            text = "; ".join(map(str, findings))
            raise UnanswerableError(f"{text} (`regardless` writes a calibration nevertheless)")
        found = averaged(in_frames(found))
        if taken is not None:
            found = widened_by(found, taken)
        return result_of(gathered, found, second, tuple(findings), taken, asked)


def _knowledge(known: Knowledge | str | os.PathLike[str]) -> Knowledge:
    if not isinstance(known, Knowledge | str | os.PathLike):
        raise BadInputError(f"found {known!r:.40}, expected line, plane, a path or a Knowledge", parameter="known")
    given = Knowledge(shape=known) if isinstance(known, str) and known in SHAPES else known
    return given if isinstance(given, Knowledge) else load_knowledge(given)


def _checked_curve(curve_from: Calibration | str | os.PathLike[str] | None) -> Calibration | None:
    """Return the calibration whose curve is used.

    Raises `BadInputError` for a calibration with another lifting, or without one curve of all exchanges.
    """
    known = given_curve(curve_from)
    if known is not None:
        differs = known.lift != LIFT or known.alpha_dbm != ALPHA_DBM
        power = f"its power is {known.lift} above {known.alpha_dbm:g} dBm, expected {LIFT} above {ALPHA_DBM:g} dBm"
        flat = known.bias_curve.flat
        refuse([("curve_from", differs, power), ("curve_from", flat, "it has no curve over power")])
    return known


def _less_curve(gathered: SurveyData, curve: Curve) -> SurveyData:
    """Return the means minus a curve, with a finding about powers outside its fitted range."""
    means = gathered.means
    if not np.isfinite(means.lifted).all():
        raise UnanswerableError("some pairs have no power, so no curve can be applied (`curve_from`)")
    beyond = int(np.count_nonzero(~curve.inside(means.lifted)))
    text = f"{beyond} pairs have powers outside the fitted powers of the given curve"
    more = (warning("powers outside those of the curve", text),) if beyond else ()
    less = replace(means, range_m=means.range_m - curve(means.lifted))
    return replace(gathered, means=less, limits=(*gathered.limits, *more))


def network_of(gathered: SurveyData, knowledge: Knowledge, fixed_ns: Mapping[int, float], *, curve: bool) -> Network:
    """Return the network of means and known facts."""
    means, arrangements = gathered.means, list[Boards]()
    tags = [tuple(np.unique(means.ends[means.arrangement == k]).tolist()) for k in range(len(gathered.arrangements))]
    check_knowledge(knowledge, {one.name: set(own) for one, own in zip(gathered.arrangements, tags, strict=True)})
    everyone = tuple(np.unique(means.ends).tolist())
    refuse(strangers(fixed_ns, everyone))
    used = [k for k, own in enumerate(tags) if own]
    for k in used:
        one, order = gathered.arrangements[k], knowledge.order_of(gathered.arrangements[k])
        boards = Boards(one.name, DIMENSIONS[knowledge.shape_of(one)], tags[k], order)
        heights = {
            p.position_m[2] for p in knowledge.positions if p.arrangement in ("", one.name) and p.tag in boards.tags
        }
        refuse(
            ("known", wrong, f"{one.name}: {text}")
            for wrong, text in (
                (heights and boards.dimensions == 1, "known positions need a plane or space; on a line give distances"),
                (
                    len(heights) > 1 and boards.dimensions == 2,
                    "the plane is that of x and y, but its positions differ in z",
                ),
                (set(order) - set(tags[k]), "its order of boards has a tag without ranges there"),
                (len(set(order)) < len(order), "its order of boards has a tag twice"),
            )
        )
        arrangements.append(boards)
    return Network(
        means=replace(means, arrangement=np.searchsorted(used, means.arrangement)),
        arrangements=tuple(arrangements),
        tags=everyone,
        distances=(*gathered.distances, *knowledge.distances),
        positions=knowledge.positions,
        fixed_ns=dict(fixed_ns),
        curve=CurvePrior.at(means.lifted) if curve else None,
    )


def sample_arrangements(count: int = 6, *, seed: int = 1) -> Ranges:
    """Return ranges of four boards on a string in `count` orders (at most 6), each for 30 s with 20 ranges per second.

    Antenna delays are -0.3, 0.1, -0.1 and 0.2 ns; a pair has a constant error of 1 cm in an arrangement, a range noise
    of 3 cm. It contains no true distances. The same seed gives the same ranges.

    >>> import calib
    >>> calib.sample_arrangements(2)
    <Ranges of memory: 1200 of tags 1, 2, 3, 4>
    """
    # Tags from left to right; any two tags are neighbours in some order, and each is in the middle in some order.
    orders = ((1, 2, 3, 4), (2, 1, 4, 3), (3, 1, 4, 2), (2, 4, 1, 3), (4, 3, 2, 1), (1, 3, 4, 2))
    rng, held = np.random.default_rng(seed), 600
    pairs = np.array(list(combinations(orders[0], 2)))
    delays = np.array([0.0, *(ANCHOR_DELAYS_NS[tag] for tag in orders[0])])[pairs].sum(axis=1)
    pair = np.arange(held) % len(pairs)
    raw = []
    for order in orders[:count]:
        place = np.zeros(5)
        place[list(order)] = np.cumsum(rng.uniform(0.5, 1.5, 4))
        error = 0.01 * rng.normal(size=len(pairs))
        mean = np.abs(np.diff(place[pairs])[:, 0]) - 0.5e-9 * SPEED_OF_LIGHT * delays + error
        raw.append(mean[pair] + 0.03 * rng.normal(size=held))
    # There are ten seconds between two arrangements.
    time_s = [40.0 * k + np.arange(held) / 20.0 for k in range(len(raw))]
    tags = np.tile(pairs[pair], (len(raw), 1))
    return Ranges.from_arrays(
        np.concatenate(raw),
        initiator=tags[:, 0],
        target=tags[:, 1],
        fpp1_dbm=np.nan,
        time_ns=(np.concatenate(time_s) * 1e9).astype(np.int64),
    )
