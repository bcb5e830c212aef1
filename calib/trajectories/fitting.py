"""A fit without known distances: delays and curve together with the trajectories of the bodies."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from scipy import sparse
from threadpoolctl import threadpool_limits

from calib.calibration.document import Split, reading_provenance
from calib.calibration.model import Calibration, given_curve, matrix_of
from calib.checks.fitted import examine_fit
from calib.checks.limits import refuse_refuted
from calib.data.sources import Data
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.inverse import Matrix, inverse_of
from calib.estimator.known_distances import Fitted, RangeFit, model_of, with_covariances
from calib.estimator.losses import MIXTURE
from calib.estimator.range_model import BOARD_DELAY_STD_NS, DELAY_NS, METRES_A_NS, OFFSET_OF_PAIR, RangeModel
from calib.estimator.rows import sum_rows
from calib.estimator.time_blocks import time_blocks
from calib.estimator.to_calibration import calibration_of
from calib.estimator.unknowns import Layout
from calib.findings import FIT_LEVELS, Finding, exceeds, warning
from calib.fitting.fitting import fitted_quantities, gauge_of, result_of
from calib.fitting.result import FitResult
from calib.information import LOOSEST, InformationColumn, Verdict, judge
from calib.settings import FitSettings, FlightSettings, refuse
from calib.spread import TWO_SIDED_95
from calib.trajectories.motion import MOTION, TapeRows
from calib.trajectories.scene import Scene, scene_from
from calib.trajectories.search import Search, search
from calib.trajectories.start import begin
from uwblink.arrays import Floats, Ints

COMMON_SETTINGS = (
    "fixed_ns",
    "groups",
    "lift",
    "alpha_dbm",
    "reference_power_dbm",
    "delays_only",
    "between_m",
)
"""The settings of `fit` that a fit without known distances also has."""


def fit_from_ranges(
    data: Data,
    flight: FlightSettings | None = None,
    settings: FitSettings | None = None,
    *,
    progress: Callable[[float], None] | None = None,
    **changes: Any,
) -> FitResult:
    """Fit antenna delays and curves to the ranges of moving bodies whose trajectories are not known.

    `data` is one recording with the tags' bodies and lever arms. `flight` states what is known of the flight;
    `settings` are the settings of `fit`, of which `COMMON_SETTINGS` apply; keyword arguments have the names of fields
    of either.

    The bodies' positions are taken from the recording's poses during the first `poses_until_s` seconds (by default from
    all poses). At other times they are estimated from the ranges, together with delays and curve. `attitudes` come from
    the "poses" throughout; from the "imu", starting with the poses' attitude; or there are "none". Headings have slowly
    varying errors of `heading_std_deg`; 0 takes attitudes as exact. Bodies whose poses stay in one place are anchors;
    their positions (`anchors`) are "given", or "sought" (estimated). `distances` by tape are used in addition to those
    in the recording: between anchors, or between moving bodies while they stood still, in an arrangement of the
    recording or a span of seconds since the first range ("2..8"). `heights` of the recording's sensors are "used" or
    "ignored". `curve_from` is a calibration, or its path, whose curve is kept, with its lift and reference power;
    intervals of the delays include its uncertainty.

    The result is what `fit` returns; the truth of its `ranges` is the estimated distances. `UnanswerableError` is
    raised if no delay is determined, unless `minimum_norm` selects the delays nearest to zero; undetermined delays have
    infinite standard errors. `progress` is called with the completed fraction, 0 to 1. Raises `BadInputError` for a
    setting that cannot be used.

    >>> import calib
    >>> result = calib.fit_from_ranges(calib.sample_flight(450), poses_until_s=3.0)
    >>> delays = result.calibration.delays_ns
    >>> f"{delays[2] - delays[1]:.1f} ns, planted 0.4 ns"
    '0.4 ns, planted 0.4 ns'
    """
    flight, settings, known = _settings(flight, settings, changes)
    # Three tenths of the work are complete with the initial guess of the search.
    report, begun = progress or (lambda _: None), 0.3
    scene = scene_from(data, flight, need_power=not settings.delays_only)
    # One thread gives the same bytes on any machine.
    with threadpool_limits(limits=1, user_api="blas"):
        model, scene = range_model(scene, settings, curve=not settings.delays_only and known is None)
        scene, state, rival = begin(scene, lambda share: report(begun * share))
        error = model.ranges.raw_m if known is None else model.ranges.raw_m - known.bias_curve(model.lifted)
        top = search(scene, model, error, state, lambda share: report(begun + (1 - begun) * share))
        result = _result(_fit_to_estimated_distances(model, top, known), top, flight, settings, known, rival)
    report(1.0)
    return result


def _settings(
    flight: FlightSettings | None, settings: FitSettings | None, changes: Mapping[str, Any]
) -> tuple[FlightSettings, FitSettings, Calibration | None]:
    """Return the settings with changes, and the calibration whose curve is kept.

    Raises `BadInputError` for settings that exclude each other.
    """
    names = {one.name for one in fields(FlightSettings)}
    flight = replace(flight or FlightSettings(), **{name: changes[name] for name in changes if name in names})
    settings = replace(settings or FitSettings(), **{name: changes[name] for name in changes if name not in names})
    refuse((name, name not in COMMON_SETTINGS, "can only be used with known distances") for name in settings.changed())
    known = given_curve(flight.curve_from)
    if known is None:
        return flight, settings, None
    if other := "delays_only" if settings.delays_only else "groups" if settings.groups else "":
        raise BadInputError(f"gives the curve of all tags, and cannot be used with `{other}`", parameter="curve_from")
    with reading_provenance():
        reference = float(known.provenance.get("reference_power_dbm", known.alpha_dbm))
    kept = replace(settings, lift=known.lift, alpha_dbm=known.alpha_dbm, reference_power_dbm=reference)
    return flight, kept, known


def range_model(
    scene: Scene, settings: FitSettings, *, curve: bool, offsets: Sequence[str] = (OFFSET_OF_PAIR,)
) -> tuple[RangeModel, Scene]:
    """Return the model of delays, curves and offsets, and the scene with the ranges that the model keeps.

    Trajectories can absorb offsets between bodies; with these as unknowns delays were less certain, and not better.
    """
    model = model_of(scene.ranges, replace(settings, delays_only=not curve), offsets=offsets)
    return model, replace(scene, ranges=model.ranges)


def _fit_to_estimated_distances(model: RangeModel, top: Search, known: Calibration | None) -> RangeFit:
    """Return the result as a fit to the estimated distances; its covariance includes their uncertainty."""
    distances = top.geometry.distances(top.optimum.x)[0]
    model = replace(model, ranges=replace(model.ranges, truth_m=distances))
    fitted = Fitted(
        rows=top.rows,
        gauge=top.gauge,
        optimum=top.optimum,
        residuals=top.rows.residuals(top.optimum.x),
        loss=MIXTURE,
        scale_m=float(np.median(np.exp(top.rows.values(top.optimum.x)["noise"]))),
        steps=top.steps,
        beside=tuple(top.known.values()),
    )
    # Combinations that pairs do not determine are known; the others are judged later, with the uncertainty of
    # trajectories.
    found = with_covariances(model, fitted, time_blocks(model.ranges.time_ns, model.ranges.session))
    if known is not None:
        more = found.covariances["delay"] + _curve_uncertainty(found, known)
        found = replace(found, covariances=found.covariances | {"delay": more})
    return found


def _curve_uncertainty(found: RangeFit, known: Calibration) -> Floats:
    """Return the covariance (tags, tags) in ns^2 that the uncertainty of a kept curve adds to the delays."""
    splines = known.bias_curve.splines(found.model.lifted)
    # Derivatives of the unknowns by the coefficients: covariance times information.
    optimum, linked = found.slopes.optimum, found.slopes.link(sparse.csr_matrix(splines))
    reach = (optimum.covariance @ linked.T)[optimum.layout.where["delay"]]
    return np.asarray(reach @ known.curve_covariance_m2 @ reach.T)


def _result(
    found: RangeFit,
    top: Search,
    flight: FlightSettings,
    settings: FitSettings,
    known: Calibration | None,
    rival: str,
) -> FitResult:
    """Return the result of a fit; raises `UnanswerableError` where no delay is determined, without `minimum_norm`."""
    fixed, model, scene = dict(settings.fixed_ns), found.model, top.motion.scene
    refuse_refuted(dict(zip(model.tags, found.delays.tolist(), strict=False)), found.residuals, model.ranges)
    own, verdict = _judge_delays(found, top)
    # Splits that the pairs do not determine are fixed, so the covariance is zero along them.
    free = [int(tag) for tag in verdict.named("delay") if tag]
    covariance, findings = examine_fit(found, free, corrected=known is not None)
    covariance = variance_factor(scene) * covariance
    undetermined = _undetermined_text(free, [model.tags[k] for k in own], covariance[np.ix_(own, own)], model.free)
    if free and len(free) == len(own) and not flight.minimum_norm:
        raise UnanswerableError(
            f"{scene.source}: {undetermined}; use known positions for some seconds (`poses_until_s`), give positions "
            f"of anchors, or a known delay (`fixed_ns`); `minimum_norm` fits nevertheless, with a warning",
            undetermined=[free],
        )
    calibration = calibration_of(found, covariance)
    if known is not None:
        uncertainty = calibration.uncertainty and replace(
            calibration.uncertainty, bias_m2=matrix_of(known.curve_covariance_m2)
        )
        calibration = replace(calibration, bias_curve=known.bias_curve, uncertainty=uncertainty)
    provenance = _provenance(found, top, flight) | {"distance_std_m": _distance_std_m(top)}
    provenance |= {"undetermined": [free], "undetermined_text": undetermined} if free else {}
    calibration = replace(
        calibration,
        delays_std_ns=calibration.delays_std_ns | dict.fromkeys(free, math.inf),
        provenance=provenance,
    )
    unsettled = f"the fit stopped after {top.steps} steps before it converged: delays are not final"
    limits = [
        ("undetermined delays", undetermined),
        ("not converged", "" if top.optimum.success else unsettled),
        ("second solution", rival),
        *(("unused known distance", text) for text in scene.tapes.left_out),
    ]
    return result_of(
        found,
        calibration,
        model.ranges,
        findings,
        settings=settings,
        fixed=fixed,
        first=[warning(fault, text) for fault, text in limits if text],
        more=(*_of_motion(top), *_of_tapes(top)),
    )


def _provenance(found: RangeFit, top: Search, flight: FlightSettings) -> dict[str, Any]:
    """Return the provenance that only fits of trajectories have."""
    scene, places_s = top.motion.scene, top.motion.scene.places.time_s
    return {
        "recordings": [scene.source],
        "recipe": "trajectories",
        "truth": "ranges",
        "fitted": fitted_quantities(found),
        "geometry": {
            "known_s": float(np.ptp(places_s)) if len(places_s) else 0.0,
            "moving": list(scene.moving),
            "anchors_given": [body for body, place in scene.still.items() if place is not None],
            "anchors_sought": scene.sought,
            "attitudes": flight.attitudes if scene.attitudes else "none",
            "heading_std_deg": flight.heading_std_deg,
            "distances": len(scene.tapes.stated),
            "heights": sorted({scene.moving[body] for body in scene.heights.body.tolist()}),
        },
        "reference_power_dbm": found.model.reference_dbm,
        "gauge": "that of the calibration whose curve was used" if flight.curve_from else gauge_of(found),
    }


def variance_factor(scene: Scene) -> float:
    """Return the factor on covariances: above 1 if only lever arms determine the scale of distances."""
    given = sum(place is not None for place in scene.still.values())
    measured = len(scene.places) or len(scene.heights) or scene.inertial or len(scene.tapes)
    # If only geometry determines distances the problem is not linear: errors up to 4.2 linearised standard errors were
    # observed (docs/theory.md), so these are multiplied by three.
    return 1.0 if given >= 2 or measured else 9.0


def _judge_delays(found: RangeFit, top: Search) -> tuple[Ints, Verdict]:
    """Return the numbers of the delays that are not pinned (k,), and the verdict on them."""
    layout, optimum = top.optimum.layout, top.optimum
    unpinned = np.intersect1d(layout.indices(["delay"]), layout.free())
    own = unpinned - layout.where["delay"].start
    information = sum_rows([top.rows, *top.gauge], optimum.x).information + optimum.priors.precision()
    # Rounding errors of the covariance are not information on the directions that were held.
    held = DELAY_NS * found.model.held[own]
    covariance = variance_factor(top.motion.scene) * found.covariances["delay"][np.ix_(own, own)] + held @ held.T
    tags = [found.model.tags[k] for k in own]
    return own, verdict_on(covariance, information, layout, unpinned, tags)


def _distance_std_m(top: Search) -> float:
    """Return the root mean square standard error of the distances of 400 ranges."""
    some = np.unique(np.linspace(0, len(top.rows) - 1, 400).astype(np.int64))
    moved = top.geometry.derivatives(top.optimum.x, some)
    return float(np.sqrt(np.mean(np.einsum("kp,pk->k", moved, top.optimum.covariance @ moved.T))))


def _undetermined_text(
    free: Sequence[int], tags: Sequence[int], covariance_ns2: Floats, splits: Sequence[Split]
) -> str:
    """Return a sentence on the undetermined delays of `free` tags, "" for none.

    `covariance_ns2` is the covariance of `tags`, zero along undetermined `splits`: it describes sums of delays of two
    sides.
    """
    if not free:
        return ""
    across = [(a, b) for one, other in splits for a in one for b in other if a in free or b in free]
    if across:
        sums = np.array([np.isin(tags, pair) for pair in across]) * 0.5 * METRES_A_NS
        worst_m = TWO_SIDED_95 * float(np.sqrt(np.max(np.diag(sums @ covariance_ns2 @ sums.T))))
        return (
            f"the ranges do not determine the delays of tags {', '.join(map(str, free))}: ranges between two sides are "
            f"known to ± {100 * worst_m:.0f} cm (95 %) at worst"
        )
    if len(free) < len(tags):
        worst = np.sqrt(np.max(np.diag(covariance_ns2)[np.isin(tags, free)], initial=0.0))
        return (
            f"the ranges do not determine the delays of tags {', '.join(map(str, free))}: known to ± "
            f"{TWO_SIDED_95 * float(worst):.2f} ns (95 %) at worst"
        )
    count = len(tags)
    rows = np.full((1, count), 1 / max(count, 1)), np.eye(count)[1:] - np.eye(count)[:1]
    spread, differences = (
        TWO_SIDED_95 * float(np.sqrt(np.max(np.diag(row @ covariance_ns2 @ row.T), initial=0.0))) for row in rows
    )
    return (
        f"the ranges determine no delay: the common part is known to ± {spread:.2f} ns (95 %), and differences to ± "
        f"{differences:.2f} ns"
    )


def verdict_on(covariance: Floats, information: Matrix, layout: Layout, own: Ints, tags: Sequence[int]) -> Verdict:
    """Return the verdict on the delays of `tags`, the unknowns `own` (tags,), with a covariance (tags, tags).

    It is compared with the covariance that they would have if all distances were known: `information` (p, p) is that of
    ranges and priors, and the unknowns of motion are held.
    """
    if not tags:
        return judge(np.eye(1) * 1e6, [InformationColumn("delay", "")])
    others = np.setdiff1d(layout.free(), layout.indices(list(MOTION)))
    with_truth = np.diag(inverse_of(information, others)[:, own][own])
    # `LOOSEST` of 0.2 ns is 3 cm of range; from simulations (docs/accuracy.md): wider intervals did not hold. If a fit
    # with known distances is less certain than this, the limit is three times its standard error.
    guess = np.maximum(0.2, 3.0 / LOOSEST * np.sqrt(np.maximum(with_truth, 0.0)))
    known = np.linalg.pinv(covariance, rcond=1e-12, hermitian=True)
    known += np.eye(len(covariance)) / BOARD_DELAY_STD_NS**2
    unknowns = [InformationColumn("delay", str(tag), scale) for tag, scale in zip(tags, guess.tolist(), strict=True)]
    return judge((known + known.T) / 2, unknowns)


def _of_motion(top: Search) -> Iterator[Finding]:
    missed_m = top.missed_motion_m()
    if missed_m:
        yield warning(
            "motion faster than the trajectory",
            f"bodies move too fast for control points every {top.motion.places.step_s:.1f} s: trajectories and "
            f"distances have errors of about {100 * missed_m:.0f} cm",
        )


def _of_tapes(top: Search) -> Iterator[Finding]:
    """Yield a finding for each tape that the ranges contradict, by deleted residuals (Cook and Weisberg 1982).

    Smaller ones than three centimetres are no finding.
    """
    rows, x = top.known.get("tape"), top.optimum.x
    if not isinstance(rows, TapeRows):
        return
    left, tapes = rows.left(x), top.motion.scene.tapes
    for number, one in enumerate(tapes.stated):
        mine = np.flatnonzero(tapes.number == number)
        moved = rows.geometry.derivatives(x, mine).mean(axis=0)
        leverage = float(moved @ (top.optimum.covariance @ moved)) / one.sigma_m**2
        # A tape without ranges that test it has a leverage of 1, and is not tested.
        if leverage >= 0.999:
            continue
        free = 1 - leverage
        without = float(left[mine].mean()) / free
        std = one.sigma_m / math.sqrt(free)
        p_value = exceeds(without, std, np.inf, tried=len(tapes.stated))
        if p_value < FIT_LEVELS["distances"] and abs(without) >= 0.03:
            yield warning(
                "wrong known distance",
                f"the distance of tags {one.first} and {one.second}, {one.distance_m:.3f} m, is "
                f"{100 * abs(without):.0f} cm {'more' if without > 0 else 'less'} than by all other data "
                f"({abs(without) / std:.0f} standard errors)",
                p_value,
            )
