"""The survey: delays, power curve and places of boards that stood still, from the ranges among them alone."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

import uwblink
from calib.calibration.json_format import Matrix
from calib.calibration.model import Calibration
from calib.calibration.parts import Uncertainty
from calib.calibration.power_curves import ALPHA_DBM, DEGREE, Curve, flat_curve
from calib.errors import BadInputError, UnanswerableError
from calib.information import Unknown, Verdict, judge, reduced
from calib.sources import Data
from calib.surveys.adjustment import Adjusted, adjust
from calib.surveys.doubts import worst
from calib.surveys.frames import framed
from calib.surveys.gathering import Gathered, gather
from calib.surveys.knowledge import Knowledge, check_knowledge, load_knowledge
from calib.surveys.minima import SecondBest, best
from calib.surveys.network import DIMENSIONS, Known, Network, Place
from calib.surveys.pair_means import LIFT
from calib.surveys.power import PowerModel, power_model
from calib.surveys.result import SurveyedArrangement, SurveyedBoard, SurveyResult
from calib.surveys.scales import DELAY_SCALE_NS, M_PER_NS
from calib.surveys.scales import widened as student
from uwblink.arrays import Floats
from uwblink.recording.schema import SHAPES, KnownDistance
from uwblink.ticks import SPEED_OF_LIGHT

MOST_DOUBTS: Final = 0.15


def survey(
    data: Data | Iterable[Data],
    *,
    known: Knowledge | str | os.PathLike[str] = "",
    fixed_ns: Mapping[int, float] | None = None,
    pair_error_m: float | None = None,
    delays_only: bool = False,
    regardless: bool = False,
) -> SurveyResult:
    """Return the delays, the power curve and the places of boards that stood still, from their ranges alone.

    `data` is what `load_ranges` takes; true distances are not needed and not looked at. Arrangements are those that
    recordings mark (`uwblink record --arrangement`), those whose times `known` gives, or stretches in which nothing
    moves. `known` is "line" or "plane" for all arrangements, the path of a TOML file (`load_knowledge`), or a
    `Knowledge`: shapes, distances and positions, which stay what they are within their sigmas. `fixed_ns` are delays
    that are known, `pair_error_m` is the constant error of a pair in an arrangement, estimated by default.
    `delays_only` looks for no curve over power.

    The result holds only delays that the arrangements determine. Raises `UnanswerableError` where none is, with the
    reason, and where ranges contradict what is said to be known (a line that is none, a board that was moved, exchanged
    labels, a wrong distance), unless `regardless`; `BadInputError` for arguments that cannot be used.

    >>> import calib
    >>> result = calib.survey(calib.sample_arrangements(), known="line")
    >>> delay, planted = result.calibration.delays_ns[2], 0.1
    >>> abs(delay - planted) < 3 * result.calibration.delays_std_ns[2]
    True
    """
    knowledge = _knowledge(known)
    fixed = _fixed(fixed_ns)
    if pair_error_m is not None and not (math.isfinite(pair_error_m) and pair_error_m > 0):
        raise BadInputError(f"found {pair_error_m}, expected a positive number of metres", parameter="pair_error_m")
    gathered = gather(data, knowledge)
    import_module("scipy.special")
    # Small matrices: several threads make them slower, and the last digits another.
    with threadpool_limits(limits=1, user_api="blas"):
        network, names = _network(gathered, knowledge, fixed, delays_only=delays_only)
        settled = _without_doubts(network, names, pair_error_m)
        findings = (*gathered.findings, *settled.findings)
        if findings and not regardless:
            raise UnanswerableError(f"{'; '.join(findings)} (`regardless` surveys all the same)")
        return _result(gathered, settled, findings)


@dataclass(frozen=True, slots=True)
class _Settled:
    """A solution that nothing contradicts any more, and what had to go for that."""

    found: Adjusted
    second: SecondBest | None
    findings: tuple[str, ...]
    left_out: tuple[str, ...]


def _knowledge(known: Knowledge | str | os.PathLike[str]) -> Knowledge:
    if isinstance(known, Knowledge):
        return known
    if isinstance(known, str) and known in SHAPES:
        return Knowledge(shape=known)
    if isinstance(known, str | os.PathLike):
        return load_knowledge(known)
    raise BadInputError(f"found {known!r:.40}, expected line, plane, a path or a Knowledge", parameter="known")


def _fixed(fixed_ns: Mapping[int, float] | None) -> dict[int, float]:
    for tag, delay in (fixed_ns or {}).items():
        if not math.isfinite(delay):
            raise BadInputError(f"tag {tag} has {delay}, expected a finite number of ns", parameter="fixed_ns")
    return {int(tag): float(delay) for tag, delay in (fixed_ns or {}).items()}


def _network(
    gathered: Gathered, knowledge: Knowledge, fixed_ns: dict[int, float], *, delays_only: bool
) -> tuple[Network, tuple[str, ...]]:
    """Return the network, and what to call each distance that is known."""
    means = gathered.means
    there = {
        one.name: {*means.first[rows].tolist(), *means.second[rows].tolist()}
        for k, one in enumerate(gathered.arrangements)
        for rows in [means.arrangement == k]
    }
    check_knowledge(knowledge, there)
    missing = sorted(set(fixed_ns) - set(means.tags()))
    if missing:
        raise BadInputError(f"tag {missing[0]} is not in the recordings", parameter="fixed_ns")
    used = [k for k, one in enumerate(gathered.arrangements) if there[one.name]]
    renumbered = np.searchsorted(used, means.arrangement)
    places = tuple(_place(gathered, knowledge, there, k) for k in used)
    distances = (*gathered.distances, *knowledge.distances)
    network = Network(
        means=replace(means, arrangement=renumbered),
        places=places,
        tags=tuple(means.tags()),
        known=_known(places, knowledge, distances),
        fixed_m={tag: delay * M_PER_NS for tag, delay in fixed_ns.items()},
        power=None if delays_only else power_model(means.lifted),
    )
    names = tuple(
        f"the known distance of {d.first} and {d.second}{' in ' + d.arrangement if d.arrangement else ''}"
        for d in distances
    )
    return network, names


def _place(gathered: Gathered, knowledge: Knowledge, there: dict[str, set[int]], k: int) -> Place:
    one = gathered.arrangements[k]
    shape = knowledge.shape_of(one)
    tags = tuple(sorted(there[one.name]))
    placed = [p for p in knowledge.positions if p.arrangement in ("", one.name) and p.tag in tags]
    if placed and shape == "line":
        raise BadInputError(
            f"{one.name}: positions are for a plane or for space; on a line give distances", parameter="known"
        )
    if placed and shape == "plane" and len({p.position_m[2] for p in placed}) > 1:
        raise BadInputError(f"{one.name}: a plane is that of x and y; its positions differ in z", parameter="known")
    return Place(one.name, DIMENSIONS[shape], tags)


def _known(places: tuple[Place, ...], knowledge: Knowledge, distances: tuple[KnownDistance, ...]) -> Known:
    """Return what is known as columns. What holds in several arrangements is one reading, not several."""
    point = {(k, tag): n for n, (k, tag) in enumerate((k, t) for k, p in enumerate(places) for t in p.tags)}
    ends, at = [], []
    for number, d in enumerate(distances):
        rows = [
            (point[k, d.first], point[k, d.second])
            for k, place in enumerate(places)
            if d.arrangement in ("", place.name) and {d.first, d.second} <= set(place.tags)
        ]
        ends += [(*row, d.distance_m, d.sigma_m * math.sqrt(len(rows)), number) for row in rows]
    for p in knowledge.positions:
        seats = [
            (k, point[k, p.tag])
            for k, place in enumerate(places)
            if p.arrangement in ("", place.name) and p.tag in place.tags
        ]
        for k, seat in seats:
            height = 0.0 if places[k].dimensions == 2 else p.position_m[2]
            at.append((seat, *p.position_m[:2], height, p.sigma_m * math.sqrt(len(seats))))
    lengths, corners = np.array(ends).reshape(-1, 5), np.array(at).reshape(-1, 5)
    return Known(
        ends=lengths[:, :2].astype(np.int64),
        distance_m=lengths[:, 2],
        distance_std_m=lengths[:, 3],
        distance_of=lengths[:, 4].astype(np.int64),
        at=corners[:, 0].astype(np.int64),
        position_m=corners[:, 1:4],
        position_std_m=corners[:, 4],
    )


def _without_doubts(network: Network, names: tuple[str, ...], pair_error_m: float | None) -> _Settled:
    """Return the best solution, less what contradicts the rest, one thing after the other."""
    found, second = best(network, pair_std_m=pair_error_m)
    findings: list[str] = []
    left_out: list[str] = []
    most = max(1, int(MOST_DOUBTS * len(network.means)))
    while len(left_out) + len(findings) < most and (doubt := worst(found, names, pair_error_m)):
        (left_out if doubt.kind == "pair" else findings).append(doubt.text)
        found = adjust(doubt.instead, doubt.start, pair_std_m=pair_error_m)
    if left_out or findings:
        found, second = best(found.network, pair_std_m=pair_error_m)
    return _Settled(found, second, tuple(findings), tuple(left_out))


def _result(gathered: Gathered, settled: _Settled, findings: tuple[str, ...]) -> SurveyResult:
    found = settled.found
    verdict = _verdict(found)
    free = verdict.named("delay")
    if len(free) == len(verdict.unknowns) - len(found.network.fixed_m):
        raise UnanswerableError(
            f"the arrangements determine no delay: {'; '.join(d.words for d in verdict.free)} can change without "
            "changing any range; `calib plan` says which arrangements or distances would tell",
            undetermined=[[int(tag) for tag in free]],
        )
    warnings = [*gathered.warnings, *findings, *settled.left_out, *_said(found, settled.second, verdict)]
    widened = student(found.freedom)
    calibration = _calibration(gathered, found, verdict, widened, warnings)
    return SurveyResult(
        calibration=calibration,
        arrangements=_arrangements(found, widened),
        verdict=verdict,
        pair_error_m=found.pair_std_m,
        second_best=settled.second,
        findings=findings,
        warnings=tuple(warnings),
    )


def _verdict(found: Adjusted) -> Verdict:
    """Return what is determined of the delays, in nanoseconds, whatever places and curve are."""
    columns = found.network.delay_columns
    information = reduced(found.information(), columns.tolist()) * M_PER_NS**2
    return judge(information, [Unknown("delay", str(tag), DELAY_SCALE_NS) for tag in found.network.tags])


def _said(found: Adjusted, second: SecondBest | None, verdict: Verdict) -> list[str]:
    said = []
    if not found.settled:
        said.append("the search stopped before it settled: delays and places are not final")
    if not verdict.determined.all():
        words = "; ".join(d.words for d in verdict.free)
        said.append(f"not determined, and left out: {words}")
    if found.network.power is not None:
        said.append(
            "a constant of the curve and one of all delays are the same to ranges: what the delays share is known only "
            "as well as the curve at its reference power; differences of delays are known better (`uncertainty`)"
        )
    if second is not None and second.ambiguous:
        who = ", ".join(map(str, second.tags))
        said.append(
            f"{second.arrangement}: another solution agrees as well with the ranges (worse by {second.worse:.1f}), in "
            f"which boards {who} are elsewhere"
        )
    return said


def _calibration(
    gathered: Gathered, found: Adjusted, verdict: Verdict, widened: float, warnings: list[str]
) -> Calibration:
    network = found.network
    known = verdict.determined
    tags = [tag for tag, good in zip(network.tags, known.tolist(), strict=True) if good]
    delays = dict(zip(network.tags, (found.x[network.delay_columns] / M_PER_NS).tolist(), strict=True))
    std = dict(zip(network.tags, (verdict.std * widened).tolist(), strict=True))
    pinned = dict.fromkeys(network.fixed_m, 0.0)
    covariance = verdict.covariance[np.ix_(known, known)] * widened**2
    noise = float(np.sqrt(np.average(network.means.noise_m**2, weights=network.means.count)))
    sigma = math.hypot(noise, found.pair_std_m)
    curve, curve_covariance, span = _curve(found, widened)
    variance = np.full((DEGREE + 1,) * 2, (0.5 * sigma / math.sqrt(max(found.freedom, 1.0))) ** 2)
    return Calibration(
        delays_ns={tag: delays[tag] for tag in tags},
        delays_std_ns={tag: std[tag] for tag in tags} | {t: s for t, s in pinned.items() if t in tags},
        loss="gaussian",
        scale_ns=noise / M_PER_NS,
        lift=LIFT,
        alpha_dbm=ALPHA_DBM,
        speed_of_light=SPEED_OF_LIGHT,
        bias_curve=curve,
        sigma_curve=flat_curve(sigma, span),
        provenance=_provenance(gathered, found, verdict, warnings, curve),
        uncertainty=Uncertainty(tuple(tags), _rows(covariance), _rows(curve_covariance), _rows(variance)),
    )


def _curve(found: Adjusted, widened: float) -> tuple[Curve, Floats, tuple[float, float]]:
    """Return the curve, the covariance of its coefficients, and the lifted powers between which it holds."""
    power: PowerModel | None = found.network.power
    lifted = found.network.means.lifted
    if power is None:
        known = lifted[np.isfinite(lifted)]
        span = (float(known.min()), float(known.max())) if len(known) else (1.0, 1.0)
        return flat_curve(0.0, span), np.zeros((DEGREE + 1,) * 2), span
    columns = found.network.curve_columns
    span = (float(power.knots[0]), float(power.knots[-1]))
    coefficients = tuple(found.x[columns].tolist())
    covariance = found.covariance()[np.ix_(columns, columns)] * widened**2
    return Curve(tuple(power.knots.tolist()), coefficients, DEGREE, span), covariance, span


def _rows(matrix: Floats) -> Matrix:
    return tuple(tuple(row) for row in matrix.tolist())


def _provenance(
    gathered: Gathered, found: Adjusted, verdict: Verdict, warnings: list[str], curve: Curve
) -> dict[str, Any]:
    network = found.network
    rests = {
        "arrangements": [
            {"name": p.name, "known": {1: "line", 2: "plane", 3: ""}[p.dimensions], "tags": list(p.tags)}
            for p in network.places
        ],
        "known_distances": len(set(network.known.distance_of.tolist())),
        "known_positions": len(network.known.at),
        "pair_error_m": found.pair_std_m,
        "freedom": found.freedom,
    }
    gauge = "no curve; the delays carry the constant"
    if not curve.flat:
        gauge = f"the bias curve is zero at {ALPHA_DBM:g} dBm; the delays carry the constant"
    more = {"fixed_ns": {str(t): d / M_PER_NS for t, d in sorted(network.fixed_m.items())}} if network.fixed_m else {}
    return more | {
        "writer": f"uwbcal {uwblink.__version__}",
        "recordings": list(gathered.sources),
        "exchanges": gathered.exchanges,
        "pairs": len(network.means),
        "recipe": "survey",
        "rests_on": rests,
        "fitted": f"delays of {int(verdict.determined.sum())} tags from the geometry of boards that stood still",
        "converged": found.settled,
        "standard_errors": f"constant errors of pairs, {found.freedom:.0f} degrees of freedom",
        "undetermined": [[int(tag) for tag in verdict.named("delay")]] if verdict.free else [],
        "warnings": warnings,
        "gauge": gauge,
    }


def _arrangements(found: Adjusted, widened: float) -> tuple[SurveyedArrangement, ...]:
    network = found.network
    covariance = found.covariance() * widened**2
    rows = []
    for k, place in enumerate(network.places):
        there = framed(network, found.x, covariance, k)
        spread = [there.covariance_m2[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] for n in range(len(place.tags))]
        boards = tuple(
            SurveyedBoard(tag, (float(p[0]), float(p[1]), float(p[2])), c, bool(np.trace(c) < 1.0))
            for tag, p, c in zip(place.tags, there.position_m, spread, strict=True)
        )
        rows.append(
            SurveyedArrangement(place.name, {1: "line", 2: "plane", 3: ""}[place.dimensions], boards, there.words)
        )
    return tuple(rows)
