"""Dependence of delays on direction, temperature or age: selection of the model by the evidence of the data."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import sparse
from scipy.special import chdtri

from calib.calibration.model import Calibration
from calib.calibration.patterns import HARMONICS, Pattern, TemperatureSlope, harmonics
from calib.checks.fitted import errors_of_truth
from calib.checks.geometry import TOLERANCE_M
from calib.data.ranges import LEAST_TURN_RAD, Ranges, of_host_clock
from calib.errors import UnanswerableError
from calib.estimator.covariates import (
    COMMON,
    COVARIATES,
    OWN,
    OWN_WARMTH,
    PRIORS,
    WARMTH,
    Covariate,
)
from calib.estimator.inverse import positive_part
from calib.estimator.known_distances import RangeFit, fit_known_distances
from calib.estimator.optimize import Optimum
from calib.estimator.range_model import OFFSETS
from calib.estimator.score_tests import Derivative, Family, Tested
from calib.estimator.time_blocks import Persistence
from calib.findings import REMEDIES, Finding, warning
from calib.settings import FitSettings
from calib.spread import TWO_SIDED_95, robust_spread, students_factor
from uwblink.arrays import Floats, Ints
from uwblink.display import first_few

LOG_EVIDENCE = math.log(100.0)
"""Logarithm of the Bayes factor from which a pattern counts as found: "decisive" (Jeffreys 1961, appendix B)."""

TYPICAL_M, UNKNOWN = 0.05, 0.5
"""Standard deviation of factors of a pattern before anything is measured, and the share of it up to which data must
determine those of the first wave around. Judgements: published patterns are 3 to 12 cm."""

RANGES_AN_UNKNOWN = 10
"""Minimum number of ranges for each unknown of patterns: with two (MILUV's 317 ranges) the noise went to nothing."""

MISSING = {
    "pattern": (
        "no directions are known; a pattern needs poses with attitudes (`uwblink poses`)",
        "attitudes vary too little to separate a pattern of the antenna from errors that depend on places",
        "undetermined pattern over direction",
    ),
    "temperature": (
        "no temperatures are known; a slope needs temperature readings of tags within 30 s of ranges",
        "temperatures vary too little to estimate their effect on ranges",
        "undetermined slope over temperature",
    ),
}
"""What ranges lack that determine no dependence, by setting: values at all, and values that differ enough; and the name
of the latter among `REMEDIES`."""


def fit_with_covariates(
    ranges: Ranges, settings: FitSettings
) -> tuple[RangeFit, dict[str, dict[str, Any]], list[Finding]]:
    """Return the fit with the dependences that `settings` ask for, what to remember of them by setting, and findings.

    Raises `UnanswerableError` where one is asked for that the data do not determine, and what `fit_known_distances`
    raises.
    """
    found = fit_known_distances(ranges, replace(settings, pattern="none", temperature="none"))
    told, findings = dict[str, dict[str, Any]](), list[Finding]()
    # Without the pattern of a robot that turns slowly, a slope is too uncertain: it is asked for again beside one.
    for name in (*COVARIATES, "temperature"):
        asked, before = getattr(settings, name), told.get(name, {})
        settled = "kind" in before or (before and "pattern" not in told)
        unread = name == "temperature" and asked == "auto" and not np.isfinite(ranges.temperature_c).any()
        if asked == "none" or settings.excludes_patterns or settled or unread:
            continue
        found, kept, more = _with(name, asked, found, ranges)
        told |= {name: kept} if kept else {}
        findings += more
    return found, told, findings


def _with(name: str, asked: str, plain: RangeFit, ranges: Ranges) -> tuple[RangeFit, dict[str, Any], list[Finding]]:
    """Return a fit with the dependence `name` beside those of a `plain` fit, if there is evidence or it is `asked`."""
    model, nothing = plain.model, (plain, dict[str, Any](), list[Finding]())
    covariate = COVARIATES[name][0](model.ranges)
    kinds = {"shared": COMMON, "tag": OWN} if name == "pattern" else {"shared": WARMTH, "tag": OWN_WARMTH}
    changes: dict[str, dict[str, Any]] = {mode: {name: mode} for mode in kinds}
    tested = plain.slopes.tests([_family(plain, covariate, kind) for kind in kinds.values()]) if covariate.tags else []
    vague = _vague(name, covariate, tested[asked == "tag"]) if tested else []
    needed = 0
    if len(vague) < len(covariate.tags):
        needed = RANGES_AN_UNKNOWN * len(covariate.entries(COVARIATES[name][1]["tag"][-1], model.pairs)[0])
    if not needed or len(model.ranges) < needed:
        why = _why(name, covariate, model.ranges, needed)
        if asked != "auto":
            raise UnanswerableError(f"{ranges.source}: {why}", parameter=name)
        return plain, _not_fitted(name, covariate, why.rpartition(": ")[2].partition(";")[0]), []
    unclear = [warning(MISSING[name][2], f"tags {first_few(map(str, vague))}: {MISSING[name][1]}")] if vague else []
    if asked != "auto":
        return fit_known_distances(ranges, replace(model.settings, **changes[asked])), {"kind": asked}, unclear
    # A drift of many times the noise passes for reflections where it is not fitted.
    if name == "pattern" and max(map(log_evidence, tested)) < LOG_EVIDENCE:
        return nothing
    if len(covariate.tags) < 2 or (name == "pattern" and not covariate.apart_from_places(model.pairs)):
        del kinds["tag"]
    best, likeliest, slopes, beside = nothing, -math.inf, [], 0.0
    for mode, kind in kinds.items():
        found = fit_known_distances(ranges, replace(model.settings, **changes[mode]))
        one = found.slopes.test(_family(found, covariate, kind, fitted=True))
        if name == "temperature":
            one = _as_lasting(one, found.persistence)
        slopes.append(
            1e3 * np.array([one.total[0], TWO_SIDED_95 * one.covariance[0, 0] ** 0.5]) / one.information[0, 0]
        )
        evidence, marginal = log_evidence(one) + beside, _log_marginal(found.searches[0].optimum)
        if evidence >= LOG_EVIDENCE and marginal > likeliest:
            causes = _other_causes(found, covariate, kind) if name == "pattern" else []
            # Wrong true distances have one unknown or two, and the checks of the fit without a pattern find them.
            if causes is None:
                continue
            known = {"kind": mode, "log_evidence": round(evidence, 1)}
            best, likeliest = (found, known, causes), marginal
        # Slopes of tags are about a common one: what speaks against that speaks against them, too.
        beside = min(evidence, 0.0) * (name == "temperature")
    if best is nothing:
        return plain, _not_fitted(name, covariate, "{:+.2f} ± {:.2f} mm/K is not significant".format(*slopes[0])), []
    return best


def effects_of_supply(slopes: Sequence[TemperatureSlope], ranges: Ranges) -> Iterator[Finding]:
    """Yield a finding for each slope over temperature that a supply which changed with it may have moved by more than
    a standard error."""
    changes = dict(ranges.supply_v_per_k)
    for one in slopes:
        known = [changes[tag] for tag in one.tags if tag in changes]
        # A range grows by 5.35 cm/V with the supply of a tag (DW1000 user manual, section 8.3.1).
        moved = 0.0535 * float(np.mean(known)) if known else 0.0
        if abs(moved) > one.std_m_per_k:
            yield warning(
                "supply voltage",
                f"tags {first_few(map(str, one.tags))}: their supply voltage changes by {1e3 * np.mean(known):+.1f} "
                f"mV/K, which may cause {1e3 * moved:+.2f} mm/K of their slope over temperature (5.35 cm/V: DW1000 "
                "user manual)",
            )


def _as_lasting(tested: Tested, known: Persistence) -> Tested:
    """Return slopes whose errors last no less than those of delays, of which more series tell, and how surely.

    Alternatives that follow a pattern differ from block to block, and the errors in their sums last less.
    """
    longest = max(known, tested.lasting, key=lambda one: one.factor)
    factor = longest.factor / tested.lasting.factor * students_factor(known.freedom) ** 2
    return replace(tested, covariance=factor * tested.covariance, lasting=longest)


def _not_fitted(name: str, covariate: Covariate, why: str) -> dict[str, Any]:
    """Return what to remember of a slope over temperature that was not fitted although temperatures are known."""
    return {"why": why} if name == "temperature" and covariate.tags else {}


def _other_causes(fitted: RangeFit, covariate: Covariate, kind: str) -> list[Finding] | None:
    """Return findings about other causes that explain a fitted pattern; None if wrong true distances explain it.

    The causes are the scale or the time of true distances, offsets of each tag that go with the rank of power, and a
    wrong lever arm of one tag. A cause explains a pattern if there is no decisive evidence for the pattern beside it.
    """
    model, count = fitted.model, len(fitted.model.ranges)
    names, columns, values = covariate.entries(kind, model.pairs)
    indices = fitted.searches[0].optimum.layout.indices([kind])

    def beside(others: Ints, derivative: Floats) -> Tested:
        both = np.concatenate([columns, others + len(names)], axis=1), np.concatenate([-values, derivative], axis=1)
        size = len(names) + int(others.max(initial=-1)) + 1
        return fitted.slopes.test(Family(kind=kind, names=names, derivative=Derivative(*both, size), fitted=indices))

    def explain(tested: Tested, which: Ints) -> bool:
        left = tested.with_fitted((len(names) + which).tolist()).combined(np.eye(len(names), len(tested.total)))
        return log_evidence(left) < LOG_EVIDENCE

    found, shared = list[Finding](), np.array([*errors_of_truth(model).values()]).reshape(-1, count).T
    which = np.arange(shared.shape[1])
    if explain(beside(np.broadcast_to(which, shared.shape), shared), which):
        return None
    rank = np.linspace(-1, 1, count)[np.argsort(np.argsort(model.lifted, kind="stable"))]
    by_power = beside(model.pairs.among(model.tags), np.repeat(rank[:, None], 2, axis=1))
    if explain(by_power, np.arange(len(model.tags))):
        found.append(
            warning(
                "pattern or effect of power",
                "the pattern over direction may be an effect of power: errors of single tags that depend on power "
                "explain the data as well",
            )
        )
    # An error of a lever arm has the effect of harmonics of degree 1, the first three of each end.
    _, own, waves = covariate.entries(OWN, model.pairs)
    first = np.flatnonzero(np.arange(own.shape[1]) % HARMONICS < 3)
    by_arm = beside(own[:, first] // HARMONICS * 3 + own[:, first] % HARMONICS, -waves[:, first])
    for number, tag in enumerate(covariate.tags):
        which = 3 * number + np.arange(3)
        mine = len(names) + which
        size_m = np.linalg.pinv(by_arm.information[np.ix_(mine, mine)], hermitian=True) @ by_arm.total[mine]
        away_m = math.sqrt(3) * float(np.linalg.norm(size_m))
        if away_m > 2 * TOLERANCE_M and explain(by_arm, which):
            found.append(
                warning(
                    "pattern or wrong lever arm",
                    f"tag {tag}: its pattern over direction may be a lever arm that is wrong by {100 * away_m:.0f} cm",
                )
            )
    return found


def with_new_tag(calibration: Calibration, tag: int, ranges: Ranges) -> Calibration:
    """Return a calibration in which a tag has the dependences of others, chosen by its `ranges`.

    A tag that reads its temperature shares a slope that others share. On a body that turns it has the pattern which
    others share, if errors scatter less with it; else one that is unknown and as large as theirs, so that total sigmas
    contain it.
    """
    if np.isfinite(ranges.temperature_c[ranges.ends == tag]).all():
        slopes = [replace(o, tags=(*o.tags, tag)) if len(o.tags) > 1 else o for o in calibration.temperatures]
        calibration = replace(calibration, temperatures=tuple(slopes))
    patterns = calibration.patterns
    if tag not in ranges.turning or not patterns:
        return calibration
    variance = np.mean([np.square(one.coefficients_m) + np.diag(one.covariance_m2) for one in patterns])
    unknown = Pattern(
        tags=(tag,),
        coefficients_m=(0.0,) * HARMONICS,
        centre=tuple(np.nanmean(harmonics(ranges.toward[ranges.ends == tag]), axis=0).tolist()),
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


def _family(found: RangeFit, covariate: Covariate, kind: str, *, fitted: bool = False) -> Family:
    """Return the unknowns of a kind as alternatives to a fit, or as the ones that are `fitted`."""
    names, columns, values = covariate.entries(kind, found.model.pairs)
    indices = found.searches[0].optimum.layout.indices([kind] if fitted else [])
    return Family(kind=kind, names=names, derivative=Derivative(columns, -values, len(names)), fitted=indices)


def log_evidence(tested: Tested) -> float:
    """Return the logarithm of the Bayes factor for alternatives that are draws of one variance, against none.

    They are about the centre of their prior, and where that has bounds the likeliest variance counts.
    """
    prior, one_each = PRIORS[tested.family.kind], np.eye(len(tested.total))
    variances = 1 / np.geomspace(*(prior.bounds or (prior.weight,) * 2), 100)
    return float(np.max(log_likelihood(tested, one_each, variances, prior.centre)))


def log_likelihood(tested: Tested, steps: Floats, variances: Floats, centre: Floats | float = 0.0) -> Floats:
    """Return the log likelihood of alternatives (k,) that are sums `steps` (k, m) of draws, less that of none.

    It is that of each of some variances (v,), about a `centre`. Slopes with the information F have the covariance F, of
    which noise makes a part that errors which last multiply; with alternatives of covariance S they have F S F more.
    """
    information, lasting = tested.information, 1 - 1 / max(tested.lasting.factor, 1.0)
    # Rounding makes it indefinite where ranges are exact.
    covariance = positive_part(information + lasting * tested.covariance)
    covariance = covariance + 1e-9 * np.trace(covariance) * np.eye(len(covariance))
    root = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(root, information @ steps)
    known, vectors = np.linalg.eigh(whitened @ whitened.T)
    expected = information @ np.broadcast_to(centre, len(information))
    found, about = ((vectors.T @ np.linalg.solve(root, one)) ** 2 for one in (tested.total, tested.total - expected))
    grown = np.maximum(known, 0.0)[:, None] * variances
    return np.asarray(0.5 * np.sum(found[:, None] - about[:, None] / (1 + grown) - np.log1p(grown), axis=0))


def _vague(name: str, covariate: Covariate, tested: Tested) -> list[int]:
    """Return the tags of whose first wave around, or slope, ranges determine too little."""
    typical, first = (TYPICAL_M, 2) if name == "pattern" else (PRIORS[WARMTH].weight ** -0.5, 1)
    known = tested.information / tested.lasting.factor + np.eye(len(tested.total)) / typical**2
    left = np.linalg.inv(known)
    waves = [left[k : k + first, k : k + first] for k in range(0, len(left), len(covariate.centre))]
    loose = [bool(np.linalg.eigvalsh(own)[-1] > (UNKNOWN * typical) ** 2) for own in waves]
    each = loose if len(loose) == len(covariate.tags) else loose * len(covariate.tags)
    return [tag for tag, vague in zip(covariate.tags, each, strict=True) if vague]


def _why(name: str, covariate: Covariate, ranges: Ranges, needed: int) -> str:
    """Return in words why ranges determine no dependence, and what would; `needed` ranges where they are too few."""
    if needed:
        return f"too few ranges for a {name}; at least {needed} are needed"
    known = np.isfinite(ranges.toward if name == "pattern" else ranges.temperature_c)
    if not known.any():
        return MISSING[name][0]
    still = "" if covariate.tags else f"no body turns by more than {math.degrees(LEAST_TURN_RAD):.0f}° of "
    what = f"{MISSING[name][1]}; {REMEDIES[MISSING[name][2]]}"
    return f"{still}tags {first_few(map(str, covariate.tags or ranges.tags()))}: {what}"


def drift_of(found: RangeFit) -> dict[str, Any]:
    """Return how fast what a tag adds to ranges drifts, for the provenance of a fit; {} where nothing can be said.

    Delays are random walks of one variance a day (`m2_per_day`: the likeliest, with its 95 % interval by the likelihood
    ratio). It is `told` where no drift at all is improbable (p < 0.01), and `by_age` where it is likelier than offsets
    of sessions that do not grow with time by a factor of e^2.
    """
    ranges, layout = found.model.ranges, found.searches[0].optimum.layout
    count, tags, pairs = len(ranges.sessions), found.model.tags, found.model.pairs
    fitted = layout.indices(["offset of tag in session"])
    if not (len(fitted) and of_host_clock(int(ranges.time_ns.min()))):
        return {}
    offsets = Derivative(pairs.among(tags) * count + ranges.session[:, None], np.ones((1, 1)), len(tags) * count)
    tested = found.slopes.test(Family(kind="session", names=(), derivative=offsets, fitted=fitted))
    # What lasts within a session is in the offsets of its pairs, whose variance the information contains.
    tested = replace(tested, total=tested.total + tested.pulled, covariance=0.0 * tested.covariance)
    totals = [np.bincount(ranges.session, weights, count) for weights in (ranges.time_ns / 86_400e9, None)]
    # A session that is held out has no ranges; its date does not matter.
    days = np.maximum(totals[0] / np.maximum(totals[1], 1), ranges.time_ns.min() / 86_400e9)
    order = np.argsort(days)
    steps = np.zeros((count, count - 1))
    steps[order] = np.tri(count, count - 1, -1) * np.sqrt(np.diff(days[order]))
    variances = np.geomspace(*OFFSETS[1:], 400) ** 2
    # Rates are such that a thousand days make as much.
    rates = variances / 1000
    walk = log_likelihood(tested, np.asarray(np.kron(np.eye(len(tags)), steps)), rates)
    scatter = log_likelihood(tested, np.eye(len(tags) * count), variances)
    within = rates[walk > walk.max() - chdtri(1, 0.05) / 2]
    told = bool(walk.max() > chdtri(1, 0.02) / 2)
    return {
        "sessions": count,
        "days": round(float(np.ptp(days)), 3),
        "m2_per_day": [float(f"{one:.3g}") for one in (within[0] * told, rates[walk.argmax()], within[-1])],
        "told": told,
        "by_age": bool(walk.max() > scatter.max() + 2),
    }
