"""From a solution to the result of a survey: calibration, determined delays, reflections, places in a stated frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.calibration.error_model import ErrorModel
from calib.calibration.model import Calibration, Uncertainty, matrix_of
from calib.calibration.power_curves import ALPHA_DBM, DEGREE, Curve, flat_curve
from calib.errors import UnanswerableError
from calib.estimator.range_model import METRES_A_NS
from calib.estimator.to_calibration import BETWEEN_M, variance_of_delays
from calib.findings import Finding, for_provenance, warning
from calib.information import InformationColumn, Verdict, judge, reduced
from calib.settings import SurveySettings
from calib.spread import students_factor
from calib.surveys.network import Boards
from calib.surveys.recordings import LIFT, SurveyData
from calib.surveys.result import (
    ReflectedPair,
    SecondBest,
    SurveyedArrangement,
    SurveyedBoard,
    SurveyResult,
)
from calib.surveys.solution import PAIR_PRIOR_FREEDOM, Solution
from uwblink.arrays import Floats, Ints
from uwblink.recording.antenna_delays import known_delays
from uwblink.ticks import SPEED_OF_LIGHT


def interval_factor(freedom: float) -> float:
    """Return the factor of intervals, because the spread of errors is estimated with so many degrees of freedom.

    Its prior counts as a few degrees of freedom.
    """
    return students_factor(max(freedom + PAIR_PRIOR_FREEDOM, 1.0))


def verdict_on_delays(information: Floats, tags: Sequence[int]) -> Verdict:
    """Return the verdict on delays from their information (tags, tags), 1/ns^2."""
    # Devices of one design differ by half a nanosecond (published ones by 0.6 ns); a delay is determined if its
    # standard error is at most `LOOSEST` of this.
    return judge(information, [InformationColumn("delay", str(tag), 0.5) for tag in tags])


def result_of(
    data: SurveyData,
    found: Solution,
    second: SecondBest | None,
    findings: tuple[Finding, ...],
    taken: Calibration | None,
    asked: SurveySettings,
) -> SurveyResult:
    """Return the result of a survey; raises `UnanswerableError` where no delay is determined."""
    network = found.network
    verdict = verdict_on_delays(
        reduced(found.information(), np.isin(np.arange(len(found.x)), network.layout.indices(["delay"]))), network.tags
    )
    free = verdict.named("delay")
    if free and len(free) == len(network.tags) - len(network.fixed_ns):
        raise UnanswerableError(
            f"the arrangements determine no delay: {'; '.join(verdict.free)} can change without changing any range; "
            f"`calib plan survey` proposes arrangements or distances that determine them",
            undetermined=[[int(tag) for tag in free]],
        )
    reflected = tuple(_reflected_pairs(found))
    findings = (*data.limits, *findings, *_limits(found, second, verdict, reflected))
    arrangements = tuple(_arrangement(found, k) for k in range(len(network.arrangements)))
    more = {
        "surveyed": [one.to_dict() for one in arrangements],
        "reflected": [one.to_dict() for one in reflected],
        "second_best": None if second is None else round(second.worse, 2),
        **for_provenance(findings, asked.changed(), network.fixed_ns),
    }
    return SurveyResult(
        calibration=_with_errors(
            _calibration(data, found, verdict, taken, more),
            data.errors,
            max(found.case.pair_m, BETWEEN_M),
            network.means.ends,
        ),
        arrangements=arrangements,
        verdict=verdict,
        pair_error_m=found.case.pair_m,
        second_best=second,
        findings=findings,
        reflected=reflected,
    )


def _reflected_pairs(found: Solution) -> list[ReflectedPair]:
    """Return the pairs that are reflected with a probability of a tenth or more, the likeliest first."""
    means, longer = found.network.means, found.network.linear(found.x)[0].tolist()
    names = [found.network.arrangements[k].name for k in means.arrangement.tolist()]
    return [
        ReflectedPair(names[k], int(means.ends[k, 0]), int(means.ends[k, 1]), longer[k], float(found.chance[k]))
        for k in np.argsort(-found.chance, kind="stable").tolist()
        if found.chance[k] >= 0.1
    ]


def _limits(
    found: Solution, second: SecondBest | None, verdict: Verdict, reflected: Sequence[ReflectedPair]
) -> Iterator[Finding]:
    """Yield the limits of a survey."""
    for one in reflected:
        if one.likely:
            yield warning(
                "reflections of a pair",
                f"{one.arrangement}: the range of {one.first} and {one.second} is {100 * one.longer_m:+.0f} cm too "
                f"long compared with all others: probably reflected ({100 * one.chance:.0f} %), so it has little "
                f"weight",
            )
    perhaps = [one for one in reflected if not one.likely]
    if perhaps:
        named = (f"{one.first}-{one.second} in {one.arrangement} ({100 * one.chance:.0f} %)" for one in perhaps)
        text = f"may also be reflected: {', '.join(named)}; intervals are widened for this"
        yield warning("reflections of a pair", text)
    if not found.settled:
        yield warning("not converged", "the search stopped before it converged: delays and positions are not final")
    if verdict.free:
        delays = ", ".join(verdict.named("delay"))
        text = f"not determined: {'; '.join(verdict.free)}" + f"; left out: tags {delays}" * bool(delays)
        yield warning("delays that a survey leaves open", text)
    if found.network.curve is not None:
        yield warning(
            "common part of delays",
            "a constant of the curve and a common shift of all delays cannot be separated by ranges: the common part "
            "of the delays is only known as well as the curve at its reference power, differences of delays better",
        )
    if second is not None and second.ambiguous:
        yield warning(
            "two solutions of a survey",
            f"{second.arrangement}: another solution agrees with the ranges as well (worse by {second.worse:.1f}), "
            f"with other positions of boards {', '.join(map(str, second.tags))}",
        )


def _calibration(
    data: SurveyData, found: Solution, verdict: Verdict, taken: Calibration | None, more: dict[str, Any]
) -> Calibration:
    """Return the calibration: delays that are determined, the curve, their uncertainty and provenance."""
    network, known, freedom = found.network, verdict.determined, found.freedom
    tags = [tag for tag, good in zip(network.tags, known.tolist(), strict=True) if good]
    covariance = interval_factor(freedom) ** 2 * verdict.covariance[np.ix_(known, known)]
    std = dict(zip(tags, np.sqrt(np.diag(covariance)).tolist(), strict=True)) | dict.fromkeys(network.fixed_ns, 0.0)
    delays = dict(zip(network.tags, found.delays.tolist(), strict=True)) | network.fixed_ns
    noise = float(np.sqrt(np.average(network.means.noise_m**2, weights=network.means.count)))
    sigma = math.hypot(noise, found.case.pair_m)
    lifted = network.means.lifted[np.isfinite(network.means.lifted)]
    span = (float(lifted.min()), float(lifted.max())) if len(lifted) else (1.0, 1.0)
    curve, curve_covariance = flat_curve(0.0, span), np.zeros((DEGREE + 1,) * 2)
    gauge = "no curve; the delays contain the common constant"
    if taken is not None:
        curve, curve_covariance, span = taken.bias_curve, taken.curve_covariance_m2, taken.bias_curve.range
        gauge = "that of the calibration whose curve was used"
    elif network.curve is not None:
        where, knots = network.layout.where["curve"], network.curve.knots
        span = (float(knots[0]), float(knots[-1]))
        curve = Curve(tuple(knots.tolist()), tuple(found.x[where].tolist()), DEGREE, span)
        curve_covariance = found.covariance()[where, where] * interval_factor(freedom) ** 2
        gauge = f"the bias curve is zero at {ALPHA_DBM:g} dBm; the delays contain the common constant"
    provenance = {
        "recordings": list(data.sources),
        "exchanges": int(network.means.count.sum()),
        "pairs": len(network.means.range_m),
        "recipe": "survey",
        "geometry": {
            "arrangements": [
                {"name": boards.name, "known": boards.shape, "tags": list(boards.tags)}
                for boards in network.arrangements
            ],
            "known_distances": len(network.distances),
            "known_positions": len(network.known_places),
            "pair_error_m": found.case.pair_m,
            "freedom": freedom,
        },
        "fitted": f"delays of {len(tags)} tags from the geometry of boards that stood still",
        "converged": found.settled,
        "standard_errors": f"constant errors of pairs, {freedom:.0f} degrees of freedom",
        "undetermined": [[int(tag) for tag in verdict.named("delay")]] if verdict.free else [],
        "gauge": gauge,
    }
    of_sigma = np.full((DEGREE + 1,) * 2, (0.5 * sigma / math.sqrt(max(freedom, 1.0))) ** 2)
    return Calibration(
        delays_ns={tag: delays[tag] for tag in tags},
        delays_std_ns={tag: std[tag] for tag in tags},
        loss="gaussian",
        scale_ns=noise / METRES_A_NS,
        lift=LIFT,
        alpha_dbm=ALPHA_DBM,
        speed_of_light=SPEED_OF_LIGHT,
        bias_curve=curve,
        sigma_curve=flat_curve(sigma, span),
        provenance=provenance | more,
        uncertainty=Uncertainty(tuple(tags), *map(matrix_of, (covariance, curve_covariance, of_sigma))),
        antenna_delays=known_delays(data.antenna_delays, tags),
    )


def _with_errors(calibration: Calibration, errors: ErrorModel | None, between_m: float, ends: Ints) -> Calibration:
    """Return a calibration with an error model of ranges of other recordings.

    `errors` are those of ranges about the means of pairs, `between_m` is the standard deviation of the constant error
    of a pair, and `ends` (n, 2) are the surveyed pairs, whose corrections have uncertain delays and curve.
    """
    if errors is None:
        return calibration
    tags = list(calibration.delays_ns)
    corrected = ends[np.isin(ends, tags).all(axis=1)]
    # There may be no such pair.
    variance = variance_of_delays(corrected, tags, calibration.covariance_ns2(tags)).sum() / max(len(corrected), 1)
    splines = calibration.bias_curve.splines(np.array(errors.lifted))
    of_curve = np.sum(splines @ calibration.curve_covariance_m2 * splines, axis=1)
    return replace(calibration, errors=errors.between(between_m, np.sqrt(variance + of_curve)))


def widened_by(found: Solution, curve: Calibration) -> Solution:
    """Return a solution whose covariance includes the effect of errors of a given curve on delays and places."""
    here, means = found.linear, found.network.means
    splines = curve.bias_curve.splines(means.lifted)
    count = len(splines)
    gain = here.covariance @ (here.jacobian[:count].T @ (splines / here.std[:count, None]))
    return replace(found, more=found.more + gain @ curve.curve_covariance_m2 @ gain.T)


def in_frames(found: Solution) -> Solution:
    """Return a solution with every arrangement without known positions in the frame of its first boards."""
    network, x, held = found.network, found.x.copy(), list[int]()
    place = x[network.layout.where["place"]].reshape(-1, 3)
    for k, boards in enumerate(network.arrangements):
        members = network.members(k)
        if not network.known_places.keys() & set(members.tolist()):
            turn, own, _ = _frame(place[members], boards)
            place[members] = (place[members] - place[members[0]]) @ turn.T
            held += [3 * int(members[0]) + n for n in own]
    x[held] = 0.0
    return replace(found, network=replace(network, held=tuple(held)), x=x)


def _frame(points: Floats, boards: Boards) -> tuple[Floats, list[int], str]:
    """Return the axes (3, 3) of the frame of the first boards, the coordinates that define it, and a description.

    The first is the origin, x points to the second, y to the side of the next board beside this line.
    """
    away = points - points[0]
    x = away[1] / max(float(np.linalg.norm(away[1])), 1e-9)
    words = f"{boards.tags[0]} at the origin, x towards {boards.tags[1]}"
    if boards.dimensions == 1:
        return np.diag([np.sign(x[0]) or 1.0, 1.0, 1.0]), [0], words
    beside = away - np.outer(away @ x, x)
    reach = np.linalg.norm(beside, axis=1)
    third = int(np.argmax(reach > 0.2 * reach.max())) if reach.max() > 0 else 0
    y = beside[third] / max(float(reach[third]), 1e-9)
    turn = np.array([x, y, np.cross(x, y)])
    if boards.dimensions == 2:
        return turn, [0, 1, 4], f"{words}, y towards {boards.tags[third]}"
    words += f", {boards.tags[third]} in the plane of x and y, z right-handed"
    return turn, [0, 1, 2, 4, 5, 3 * third + 2], words


def _arrangement(found: Solution, number: int) -> SurveyedArrangement:
    """Return the places of boards in an arrangement, in the frame of known positions or of its first boards."""
    network, boards, members = found.network, found.network.arrangements[number], found.network.members(number)
    points, covariance = network.positions_m(found.x), found.covariance() * interval_factor(found.freedom) ** 2
    own = [slice(3 * member, 3 * member + 3) for member in members.tolist()]
    surveyed = tuple(
        SurveyedBoard(tag, (x, y, z), covariance[one, one], bool(np.trace(covariance[one, one]) < 1.0))
        for tag, one, (x, y, z) in zip(boards.tags, own, points[members].tolist(), strict=True)
    )
    known = network.known_places.keys() & set(members.tolist())
    frame = "that of the known positions" if known else _frame(points[members], boards)[2]
    return SurveyedArrangement(boards.name, boards.shape, surveyed, frame)
