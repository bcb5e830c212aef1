"""Whether antennas delay by direction: what data determine of a pattern, and whether they are evidence of one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import sparse

from calib.calibration.model import Calibration
from calib.calibration.patterns import HARMONICS, Pattern, harmonics
from calib.data.ranges import LEAST_TURN_RAD, Ranges
from calib.errors import UnanswerableError
from calib.estimator.known_distances import KnownDistances, fit_known_distances
from calib.estimator.optimize import Optimum
from calib.estimator.pattern_unknowns import COMMON, OF_PAIR, OWN, SPREAD_M, Directions
from calib.estimator.score_tests import Derivative, Family, Tested
from calib.settings import FitSettings
from calib.spread import robust_spread
from uwblink.arrays import Floats
from uwblink.display import first_few

LOG_EVIDENCE = math.log(100.0)
"""Logarithm of the Bayes factor from which a pattern counts as found: "decisive" (Jeffreys 1961, appendix B)."""

TYPICAL_M, UNKNOWN = 0.05, 0.5
"""Standard deviation of factors of a pattern before anything is measured, and the share of it up to which data must
determine those of the first wave around. Judgements: published patterns are 3 to 12 cm."""

RANGES_AN_UNKNOWN = 10
"""Minimum number of ranges for each unknown of patterns: with two (MILUV's 317 ranges) the noise went to nothing."""

TURNED_TOO_LITTLE = (
    "attitudes vary too little to tell a pattern of the antenna from what belongs to places; record a flight in which "
    "the robot turns once around in several places"
)


def fit_with_pattern(ranges: Ranges, settings: FitSettings) -> tuple[KnownDistances, dict[str, Any], list[str]]:
    """Return the fit with the pattern that `settings` ask for, what to remember of it, and warnings.

    Raises `UnanswerableError` where a pattern is asked for that the data do not determine, and what
    `fit_known_distances` raises.
    """
    plain = fit_known_distances(ranges, replace(settings, pattern="none"))
    asked, nothing = settings.pattern, (plain, dict[str, Any](), list[str]())
    if asked == "none" or settings.excludes_patterns:
        return nothing
    directions = Directions.of(plain.model.ranges)
    kinds = {"shared": COMMON}
    if len(directions.tags) > 1 and directions.apart_from_places(plain.model.pairs):
        kinds["tag"] = OWN
    families = [_family(plain, directions, kind) for kind in (COMMON, OWN)] if directions.tags else []
    tested = plain.slopes.tests(families)
    vague = _vague(directions, tested[asked == "tag"]) if tested else []
    if len(vague) == len(directions.tags) or len(plain.model.ranges) < _needed(plain, directions):
        if asked == "auto":
            return nothing
        raise UnanswerableError(_why(plain, directions, vague), parameter="pattern")
    warnings = [f"tags {first_few(map(str, vague))}: {TURNED_TOO_LITTLE}"] if vague else []
    if asked != "auto":
        return fit_known_distances(ranges, settings), {"kind": asked}, warnings
    if max(map(log_evidence, tested)) < LOG_EVIDENCE:
        return nothing
    best, likeliest = nothing, -math.inf
    for mode, kind in kinds.items():
        found = fit_known_distances(ranges, replace(settings, pattern=mode))
        evidence = log_evidence(found.slopes.test(_family(found, directions, kind, fitted=True)))
        marginal = _log_marginal(found.searches[0].optimum)
        if evidence >= LOG_EVIDENCE and marginal > likeliest:
            explained = log_evidence(_beside_power(plain, directions, kind)) < LOG_EVIDENCE
            said = (
                "the pattern over direction may be one of power: errors of single tags that go with power explain as "
                "much; compare with a fit with `pattern` none and `groups` of tags"
            )
            known = {"kind": mode, "log_evidence": round(evidence, 1)}
            best, likeliest = (found, known, [said] * explained), marginal
    return best


def _beside_power(plain: KnownDistances, directions: Directions, kind: str) -> Tested:
    """Return the slopes of a pattern beside offsets of each tag that go with the rank of power."""
    names, columns, values = directions.entries(kind, plain.model.pairs)
    tags, pairs, count = plain.model.tags, plain.model.pairs, len(values)
    rank = np.linspace(-1, 1, count)[np.argsort(np.argsort(plain.model.lifted, kind="stable"))]
    ends = np.searchsorted(tags, pairs.ends)[pairs.number] + len(names)
    derivative = Derivative(
        np.concatenate([columns, ends], axis=1),
        np.concatenate([-values, rank[:, None], rank[:, None]], axis=1),
        len(names) + len(tags),
    )
    tested = plain.slopes.test(Family(kind=kind, names=names, derivative=derivative))
    return tested.beside(range(len(names), derivative.size)).turned(np.eye(len(names), derivative.size))


def with_new_tag(calibration: Calibration, tag: int, ranges: Ranges) -> Calibration:
    """Return a calibration in which a tag on a body that turns has a pattern, chosen by its `ranges`.

    That is one which others share, if errors scatter less with it; else one that is unknown and as large as theirs, so
    that total sigmas contain it.
    """
    patterns = calibration.patterns
    if tag not in ranges.turning or not patterns:
        return calibration
    ends = np.stack([ranges.initiator, ranges.target], axis=1)
    variance = np.mean([np.square(one.coefficients_m) + np.diag(one.covariance_m2) for one in patterns])
    unknown = Pattern(
        tags=(tag,),
        coefficients_m=(0.0,) * HARMONICS,
        centre=tuple(np.nanmean(harmonics(ranges.toward[ends == tag]), axis=0).tolist()),
        covariance_m2=tuple(map(tuple, (variance * np.eye(HARMONICS)).tolist())),
        rms_m=math.sqrt(np.mean([one.rms_m**2 for one in patterns])),
    )
    several = [(*patterns, unknown)] + [
        (*patterns[:k], replace(one, tags=(*one.tags, tag)), *patterns[k + 1 :])
        for k, one in enumerate(patterns)
        if len(one.tags) > 1
    ]
    found = [replace(calibration, patterns=own) for own in several]
    return min(found, key=lambda one: robust_spread(one.apply(ranges).corrected_m - ranges.truth_m))


def _log_marginal(optimum: Optimum) -> float:
    """Return the log likelihood with all unknowns integrated out (Laplace), less what fits to the same rows share."""
    priors, free = optimum.priors, optimum.layout.free()
    known = sparse.csc_matrix(optimum.information + priors.precision()).toarray()[np.ix_(free, free)]
    weights = sum(rank * math.log(weight) for rank, weight in zip(priors.ranks, priors.weights, strict=True))
    return optimum.value + 0.5 * weights - 0.5 * float(np.linalg.slogdet(known)[1])


def _family(found: KnownDistances, directions: Directions, kind: str, *, fitted: bool = False) -> Family:
    """Return the unknowns of a kind as alternatives to a fit, or as the ones that are `fitted`."""
    names, columns, values = directions.entries(kind, found.model.pairs)
    indices = found.searches[0].optimum.layout.indices([kind] if fitted else [])
    return Family(kind=kind, names=names, derivative=Derivative(columns, -values, len(names)), fitted=indices)


def log_evidence(tested: Tested) -> float:
    """Return the logarithm of the Bayes factor for alternatives that are draws of one variance, against none.

    The likeliest variance counts.
    """
    variances = np.geomspace(*SPREAD_M[1:], 100) ** 2
    return float(np.max(log_likelihood(tested, np.eye(len(tested.total)), variances)))


def log_likelihood(tested: Tested, steps: Floats, variances: Floats) -> Floats:
    """Return the log likelihood of alternatives (k,) that are sums `steps` (k, m) of draws, less that of none.

    It is that of each of some variances (v,). Slopes with the information F have the covariance F, of which noise makes
    a part that errors which last multiply; with alternatives of covariance S they have F S F more.
    """
    information, lasting = tested.information, 1 - 1 / max(tested.lasting.factor, 1.0)
    covariance = information + lasting * tested.covariance
    covariance = covariance + 1e-9 * np.trace(covariance) * np.eye(len(covariance))
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, information @ steps)
    known, vectors = np.linalg.eigh(whitened @ whitened.T)
    square = (vectors.T @ np.linalg.solve(root, tested.total)) ** 2
    grown = np.maximum(known, 0.0)[:, None] * variances
    return np.asarray(0.5 * np.sum(square[:, None] * grown / (1 + grown) - np.log1p(grown), axis=0))


def _vague(directions: Directions, tested: Tested) -> list[int]:
    """Return the tags of whose first wave around ranges determine too little."""
    known = tested.information / tested.lasting.factor + np.eye(len(tested.total)) / TYPICAL_M**2
    left = np.linalg.inv(known)
    waves = [left[k : k + 2, k : k + 2] for k in range(0, len(left), HARMONICS)]
    loose = [bool(np.linalg.eigvalsh(own)[-1] > (UNKNOWN * TYPICAL_M) ** 2) for own in waves]
    each = loose if len(loose) == len(directions.tags) else loose * len(directions.tags)
    return [tag for tag, vague in zip(directions.tags, each, strict=True) if vague]


def _needed(found: KnownDistances, directions: Directions) -> int:
    """Return how many ranges determine the pattern of antennas beside those of bodies."""
    return RANGES_AN_UNKNOWN * len(directions.entries(OF_PAIR, found.model.pairs)[0])


def _why(found: KnownDistances, directions: Directions, vague: Sequence[int]) -> str:
    """Return in words why ranges determine no pattern, and what would."""
    ranges = found.model.ranges
    if not np.isfinite(ranges.toward).all(axis=2).any():
        return f"{ranges.source}: no direction is known; a pattern needs poses with attitudes (`uwblink poses`)"
    if len(vague) < len(directions.tags):
        return f"{ranges.source}: too few ranges for a pattern, at least {_needed(found, directions)} are needed"
    still = f"no body turns by more than {math.degrees(LEAST_TURN_RAD):.0f}° of tags"
    whose = first_few(map(str, directions.tags or ranges.tags()))
    return f"{ranges.source}: {'tags' if directions.tags else still} {whose}: {TURNED_TOO_LITTLE}"
