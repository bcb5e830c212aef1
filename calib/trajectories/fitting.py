"""A fit without known distances: delays and curve together with the trajectories of the bodies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from calib.calibration.model import Calibration, given_calibration
from calib.checks.fitted import examine_fit
from calib.checks.limits import refuse_refuted
from calib.data.sources import Data
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.known_distances import FEWEST_RANGES, Fitted, KnownDistances, described, refuse_free
from calib.estimator.losses import MIXTURE
from calib.estimator.range_model import RangeModel
from calib.estimator.time_blocks import time_blocks
from calib.estimator.to_calibration import calibration_of
from calib.fitting.fitting import result_of
from calib.fitting.result import FitResult
from calib.settings import FitSettings, FlightSettings
from calib.trajectories.judging import curve_uncertainty, judge_delays
from calib.trajectories.scene import Scene, scene_from
from calib.trajectories.search import Search, search
from calib.trajectories.start import begin

SHARED = (
    "fixed_ns",
    "groups",
    "lift",
    "alpha_dbm",
    "reference_power_dbm",
    "delays_only",
    "minimum_norm",
    "between_m",
)
"""The settings of `fit` that a fit without known distances has, too."""

SHARE_OF_START = 0.3
"""Share of the work, for the progress bar, that is done when the search has its initial guess."""


def fit_from_ranges(
    data: Data,
    flight: FlightSettings | None = None,
    settings: FitSettings | None = None,
    *,
    progress: Callable[[float], None] | None = None,
    **changes: Any,
) -> FitResult:
    """Fit antenna delays and curves to the ranges of moving bodies whose trajectories are not known.

    `data` is one recording with the tags' bodies and lever arms. `flight` says what is known of the flight; `settings`
    are those of `fit`, of which `SHARED` apply; keyword arguments are named like the fields of either.

    The bodies' positions are taken from the recording's poses during the first `poses_until_s` seconds (all there are,
    by default). Elsewhere they are estimated from the ranges, together with delays and curve. `attitudes` come from the
    "poses", all along; from the "imu", which begins with the poses' attitude; or there are "none". Headings have errors
    of `heading_std_deg` that wander; 0 takes attitudes as exact. Bodies whose poses stay in one place are anchors;
    their positions (`anchors`) are "given", or "sought" (estimated). `distances` by tape are used beside those that
    the recording states: between anchors, or between moving bodies while they stood still, in an arrangement of the
    recording or a span of seconds since the first range ("2..8"). `heights` of the recording's sensors are "used" or
    "ignored". `curve_from` is a calibration, or its path, whose curve is kept, with its lift and reference power; its
    uncertainty is in the intervals of the delays.

    The result is what `fit` returns; the truth of its `ranges` is the estimated distances. `UnanswerableError` is
    raised where no delay is determined, unless `minimum_norm` asks for the delays nearest to zero; delays that are not
    determined have infinite standard errors. `progress` is called with the done fraction, 0 to 1. Raises
    `BadInputError` for a setting that cannot be used.

    >>> import calib
    >>> result = calib.fit_from_ranges(calib.sample_flight(), poses_until_s=5.0)
    >>> delays = result.calibration.delays_ns
    >>> f"{delays[2] - delays[1]:.1f} ns, planted 0.4 ns"
    '0.4 ns, planted 0.4 ns'
    """
    flight, settings, known = _settings(flight, settings, changes)
    report = progress or (lambda _: None)
    scene = scene_from(data, flight, need_power=not settings.delays_only)
    # One thread: the same bytes on any machine.
    with threadpool_limits(limits=1, user_api="blas"):
        model, scene = range_model(scene, settings, curve=not settings.delays_only and known is None)
        if not settings.minimum_norm:
            refuse_free(model)
        scene, state, rival = begin(scene, lambda share: report(SHARE_OF_START * share))
        error = model.ranges.raw_m if known is None else model.ranges.raw_m - known.bias_curve(model.lifted)
        top = search(scene, model, error, state, lambda share: report(SHARE_OF_START + (1 - SHARE_OF_START) * share))
        result = _result(_described(model, top, known), top, flight, settings, known, rival)
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
    for name in settings.changed():
        if name not in SHARED:
            raise BadInputError("goes with known distances only", parameter=name)
    known = given_calibration(flight.curve_from, "curve_from")
    if known is None:
        return flight, settings, None
    if other := "delays_only" if settings.delays_only else "groups" if settings.groups else "":
        raise BadInputError(f"gives the curve of all tags, and does not go with `{other}`", parameter="curve_from")
    if known.groups or known.power_at != "exchange":
        what = "curves of groups of tags" if known.groups else "a curve of each reception"
        raise BadInputError(f"has {what}, expected one curve of all exchanges", parameter="curve_from")
    reference = known.provenance.get("reference_power_dbm", known.alpha_dbm)
    kept = replace(settings, lift=known.lift, alpha_dbm=known.alpha_dbm, reference_power_dbm=reference)
    return flight, kept, known


def range_model(scene: Scene, settings: FitSettings, *, curve: bool, offsets: bool = True) -> tuple[RangeModel, Scene]:
    """Return the model of delays, curves and offsets, and the scene with the ranges that the model keeps."""
    if len(scene.ranges) < FEWEST_RANGES:
        raise UnanswerableError(
            f"{scene.source}: {len(scene.ranges)} usable exchanges are too few, at least {FEWEST_RANGES} are needed"
        )
    # The truth is not known. In its place stands the number of the row, which says what rows the model keeps.
    numbered = replace(scene.ranges, truth_m=np.arange(len(scene.ranges), dtype=np.float64))
    model = RangeModel.of(numbered, replace(settings, delays_only=not curve), offsets=offsets)
    return model, scene.only(model.ranges.truth_m.astype(np.int64))


def _reference_dbm(settings: FitSettings) -> float:
    return settings.alpha_dbm if settings.reference_power_dbm is None else settings.reference_power_dbm


def _described(model: RangeModel, top: Search, known: Calibration | None) -> KnownDistances:
    """Return the fit as one to the estimated distances, whose uncertainty is in its covariance."""
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
    # What the pairs leave free is known; the rest is judged later, with the uncertainty of trajectories.
    found = described(model, fitted, time_blocks(model.ranges.time_ns, model.ranges.session))
    if known is not None:
        more = curve_uncertainty(found, known)
        found = replace(found, covariances=found.covariances | {"delay": found.covariances["delay"] + more})
    return found


def _result(
    found: KnownDistances,
    top: Search,
    flight: FlightSettings,
    settings: FitSettings,
    known: Calibration | None,
    rival: str,
) -> FitResult:
    """Return the result of a fit; raises `UnanswerableError` where no delay is determined, without `minimum_norm`."""
    fixed, model, scene = dict(settings.fixed_ns), found.model, top.motion.scene
    refuse_refuted(dict(zip(model.tags, found.delays.tolist(), strict=False)), found.residuals, model.ranges)
    judgement = judge_delays(found, top)
    covariance, findings = examine_fit(found)
    covariance = judgement.variance_factor * covariance
    free, left_open = judgement.free_tags, ""
    if free and len(free) == len(judgement.tags) and not settings.minimum_norm:
        raise UnanswerableError(
            f"{scene.source}: {judgement.undetermined_text(covariance)}; let positions be known for some seconds "
            "(`poses_until_s`), give the places of anchors, or pin a delay with `fixed_ns` (`minimum_norm` fits "
            "regardless, and says so)",
            undetermined=[free],
        )
    undetermined = found.free
    # Delays that the pairs leave free are held at the smallest values, so that their covariance says nothing of them.
    if not {tag for group in found.free for tag in group}.issuperset(free):
        left_open, undetermined = judgement.undetermined_text(covariance), [free]
    calibration = calibration_of(found, covariance)
    if known is not None:
        calibration = _with_curve(calibration, known)
    provenance = _provenance(found, top, flight, settings) | {"distance_std_m": judgement.distance_std_m}
    provenance |= {"undetermined": undetermined} if undetermined else {}
    provenance |= {"left_open": left_open} if left_open else {}
    calibration = replace(
        calibration,
        delays_std_ns=calibration.delays_std_ns | dict.fromkeys(free, math.inf),
        provenance=provenance,
    )
    unsettled = f"the fit stopped after {top.steps} steps before it settled: delays are not final"
    notes = [left_open, "" if top.optimum.success else unsettled, rival, *scene.tapes.left_out]
    return result_of(
        found,
        calibration,
        model.ranges,
        findings,
        settings=settings,
        fixed=fixed,
        first=[note for note in notes if note],
        more=judgement.sentences,
    )


def _with_curve(calibration: Calibration, known: Calibration) -> Calibration:
    """Return a calibration with the curve of another one and the covariance of that curve."""
    uncertainty, size = calibration.uncertainty, len(known.bias_curve.coefficients)
    if uncertainty is not None:
        of_curve = known.uncertainty.bias_m2 if known.uncertainty else ((0.0,) * size,) * size
        uncertainty = replace(uncertainty, bias_m2=of_curve)
    return replace(calibration, bias_curve=known.bias_curve, uncertainty=uncertainty)


def _provenance(found: KnownDistances, top: Search, flight: FlightSettings, settings: FitSettings) -> dict[str, Any]:
    """Return the provenance that only fits of trajectories have."""
    scene, places_s, reference_dbm = top.motion.scene, top.motion.scene.places.time_s, _reference_dbm(settings)
    pinned = set(found.model.tags) <= set(settings.fixed_ns)
    return {
        "recordings": [scene.source],
        "recipe": "trajectories",
        "truth": "ranges",
        "fitted": "delays only" if found.model.curve is None else "curve only" if pinned else "delays and curve",
        "rests_on": {
            "known_s": float(np.ptp(places_s)) if len(places_s) else 0.0,
            "moving": list(scene.moving),
            "anchors_given": [body for body, place in scene.still.items() if place is not None],
            "anchors_sought": scene.sought,
            "attitudes": flight.attitudes if scene.attitudes else "none",
            "heading_std_deg": flight.heading_std_deg,
            "distances": len(scene.tapes.stated),
            "heights": sorted({scene.moving[body] for body in scene.heights.body.tolist()}),
        },
        "reference_power_dbm": reference_dbm,
        "gauge": f"the bias curve{' was kept, and' if flight.curve_from else ''} is zero at {reference_dbm:g} dBm; the "
        "delays carry the constant",
    }
