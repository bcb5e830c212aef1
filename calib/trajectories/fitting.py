"""A fit without known distances: delays and curve together with the trajectories of the bodies."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import uwblink
from calib.calibration.model import Calibration
from calib.calibration.power_curves import ALPHA_DBM
from calib.calibration.power_curves import lift as lift_power
from calib.checks.fitted import examine_fit
from calib.checks.limits import limits, warnings_of
from calib.checks.plausibility import implausible, one_way, refuse_refuted
from calib.checks.power_levels import unlike_powers
from calib.data.sources import Data
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.known_distances import FEWEST_RANGES, Fitted, KnownDistances, described
from calib.estimator.losses import MIXTURE
from calib.estimator.range_model import RangeModel
from calib.estimator.range_rows import Mixture
from calib.estimator.time_blocks import time_blocks
from calib.estimator.to_calibration import calibration_of
from calib.fitting.known_delays import imported
from calib.fitting.result import FitResult
from calib.settings import FitSettings, check_choice
from calib.trajectories.judging import Judged, curve_uncertainty, judged
from calib.trajectories.scene import Scene, Usable, scene_from
from calib.trajectories.search import Cauchy, Found, search
from calib.trajectories.start import begin
from uwblink.arrays import Floats
from uwblink.recording.schema import KnownDistance

ATTITUDES = ("poses", "imu", "none")
ANCHORS = ("given", "sought")
HEIGHTS = ("used", "ignored")
INLIER_SIGMAS = 3.0
FOLLOWED = 0.3
"""Share of the work that is done when trajectories have been followed, for a bar of progress."""


def fit_from_ranges(  # noqa: PLR0913 - keyword-only settings of one fit, each with its default
    data: Data,
    *,
    poses_until_s: float | None = None,
    attitudes: str = "poses",
    heading_std_deg: float = 3.0,
    anchors: str = "given",
    distances: Iterable[KnownDistance] = (),
    heights: str = "used",
    curve_from: Calibration | str | os.PathLike[str] | None = None,
    fixed_ns: Mapping[int, float] | None = None,
    groups: Mapping[str, tuple[int, ...]] | None = None,
    lift: str = "mean-of-lifted",
    alpha_dbm: float = ALPHA_DBM,
    reference_power_dbm: float | None = None,
    delays_only: bool = False,
    minimum_norm: bool = False,
    progress: Callable[[float], None] | None = None,
) -> FitResult:
    """Fit antenna delays and curves to the ranges of moving bodies whose trajectories are not known.

    `data` is one recording with the tags' bodies and lever arms. The bodies' positions are taken from its poses during
    the first `poses_until_s` seconds (all there are, by default) and found from the ranges elsewhere, together with
    delays and curve. `attitudes` come from the "poses", all along; from the "imu", from the poses' attitude at first;
    or there are "none". Headings may be wrong by `heading_std_deg`, and wander; 0 takes attitudes as they are.
    Bodies whose poses stay in one place are anchors: their places are "given", or "sought" with all else.

    `distances` were measured otherwise, beside those that the recording states: between anchors, or between moving
    bodies while they stood still, in an arrangement of the recording or a span of seconds since the first range
    ("2..8"). `heights` of the recording's sensors are "used" or "ignored". `curve_from` is a calibration, or its path,
    whose curve is taken as it is, with its lift and reference power; what is unsure of it is in the delays' intervals.

    The result is what `fit` returns; the truth of its `ranges` is the distances that were found. What the ranges do not
    determine is named: `UnanswerableError` is raised where no delay is determined, unless `minimum_norm` asks for those
    nearest to zero, and delays that are not determined have infinite standard errors. `progress` is called with the
    done fraction, 0 to 1. Raises `BadInputError` for a parameter that cannot be used.

    >>> import calib
    >>> result = calib.fit_from_ranges(calib.sample_flight(), poses_until_s=5.0)
    >>> delays = result.calibration.delays_ns
    >>> f"{delays[2] - delays[1]:.1f} ns, planted 0.4 ns"
    '0.4 ns, planted 0.4 ns'
    """
    fixed = {int(tag): float(delay) for tag, delay in (fixed_ns or {}).items()}
    groups = {name: tuple(map(int, tags)) for name, tags in (groups or {}).items()}
    known = _curve_source(curve_from, "delays_only" if delays_only else "groups" if groups else "")
    if known is not None:
        lift, alpha_dbm = known.lift, known.alpha_dbm
        reference_power_dbm = known.provenance.get("reference_power_dbm", alpha_dbm)
    FitSettings(lift=lift, alpha_dbm=alpha_dbm, fixed_ns=fixed, groups=groups, reference_power_dbm=reference_power_dbm)
    asked = Asked(
        usable=usable_of(poses_until_s, attitudes, heading_std_deg, anchors, tuple(distances), heights),
        lift=lift,
        alpha_dbm=alpha_dbm,
        fixed=fixed,
        groups=groups,
        reference_dbm=alpha_dbm if reference_power_dbm is None else reference_power_dbm,
        curve=not delays_only and known is None,
        known=known,
    )
    done = progress or (lambda _: None)
    scene = scene_from(data, asked.usable, need_power=not delays_only)
    # The same bytes on any machine; SciPy brings a linear algebra of its own, which must be there to be held.
    import_module("scipy.linalg")
    with threadpool_limits(limits=1, user_api="blas"):
        model, scene = asked.model(scene)
        scene, state, rival = begin(scene, lambda share: done(FOLLOWED * share))
        error = model.ranges.raw_m if known is None else model.ranges.raw_m - known.bias_curve(model.lifted)
        top = search(scene, model, error, state, lambda share: done(FOLLOWED + (1 - FOLLOWED) * share))
        found = _described(model, top, known)
        verdict = judged(found, top)
        result = _result(found, top, verdict, asked, rival)
    done(1.0)
    if not minimum_norm:
        _refuse_undetermined(verdict, model, scene)
    return result


def usable_of(
    poses_until_s: float | None,
    attitudes: str,
    heading_std_deg: float,
    anchors: str,
    distances: tuple[KnownDistance, ...],
    heights: str,
) -> Usable:
    """Return what of a recording may be used; raises `BadInputError` for what cannot be read."""
    check_choice("attitudes", attitudes, ATTITUDES)
    check_choice("anchors", anchors, ANCHORS)
    check_choice("heights", heights, HEIGHTS)
    for name, value in (("poses_until_s", poses_until_s), ("heading_std_deg", heading_std_deg)):
        if value is not None and not (np.isfinite(value) and value >= 0):
            raise BadInputError(f"found {value!r}, expected a number of 0 or more", parameter=name)
    return Usable(
        poses_until_s=poses_until_s,
        attitudes=attitudes,
        heading_std_deg=heading_std_deg,
        anchors=anchors,
        distances=distances,
        heights=heights,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What a fit was asked for."""

    usable: Usable
    lift: str
    alpha_dbm: float
    fixed: dict[int, float]
    groups: Mapping[str, tuple[int, ...]]
    reference_dbm: float
    curve: bool
    known: Calibration | None = None

    def model(self, scene: Scene, *, offsets: bool = True) -> tuple[RangeModel, Scene]:
        """Return unknowns and parts of delays, curves and offsets, and the scene of their ranges."""
        if len(scene.ranges) < FEWEST_RANGES:
            raise UnanswerableError(
                f"{scene.source}: {len(scene.ranges)} usable exchanges are too few, at least {FEWEST_RANGES} are needed"
            )
        # In the place of distances, which nobody knows, the number of the row: it says which rows are left.
        numbered = replace(scene.ranges, truth_m=np.arange(len(scene.ranges), dtype=np.float64))
        model = RangeModel.of(
            numbered,
            lift=self.lift,
            alpha_dbm=self.alpha_dbm,
            fixed_ns=self.fixed,
            groups=self.groups,
            curve=self.curve,
            reference=float(lift_power(np.array(self.reference_dbm), self.alpha_dbm)),
            offsets=offsets,
        )
        return model, scene.only(model.ranges.truth_m.astype(np.int64))


def _curve_source(curve_from: Calibration | str | os.PathLike[str] | None, other: str) -> Calibration | None:
    """Return the calibration whose curve is taken; raises `BadInputError` for one that has not one curve of all.

    `other` names a parameter of the fit that says otherwise what curves there are, or is empty.
    """
    known = imported(curve_from, "curve_from")
    if known is not None and other:
        raise BadInputError(f"gives the curve of all tags, and does not go with `{other}`", parameter="curve_from")
    if known is not None and (known.groups or known.power_at != "exchange"):
        what = "curves of groups of tags" if known.groups else "a curve of each reception"
        raise BadInputError(f"has {what}, expected one curve of all exchanges", parameter="curve_from")
    return known


def _described(model: RangeModel, top: Found, known: Calibration | None) -> KnownDistances:
    """Return what was found as a fit to the distances that were found, which knows how far they are uncertain."""
    distances = top.geometry.distances(top.optimum.x)[0]
    model = replace(model, ranges=replace(model.ranges, truth_m=distances))
    errors = top.rows.errors
    if isinstance(errors, Cauchy):
        scale = errors.scale_m
    else:
        scale = float(np.median(np.exp(top.rows.values(top.optimum.x)["noise"])))
    fitted = Fitted(
        rows=top.rows,
        gauge=top.gauge,
        optimum=top.optimum,
        residuals=top.rows.residuals(top.optimum.x),
        loss=MIXTURE if isinstance(errors, Mixture) else "cauchy",
        scale_m=scale,
        steps=top.steps,
        beside=tuple(top.known.values()),
    )
    # What the ranges determine is judged later, with what trajectories take of it.
    found = described(model, fitted, time_blocks(model.ranges.time_ns, model.ranges.session), [])
    if known is not None:
        more = curve_uncertainty(found, known)
        found = replace(found, covariances=found.covariances | {"delay": found.covariances["delay"] + more})
    return found


def _result(found: KnownDistances, top: Found, judgement: Judged, asked: Asked, rival: str) -> FitResult:
    ranges = found.model.ranges
    doubts = examine_fit(found)
    covariance = judgement.beyond_linear(doubts.covariance_ns2)
    calibration = calibration_of(
        found, covariance, lift=asked.lift, alpha_dbm=asked.alpha_dbm, fixed=asked.fixed, groups=asked.groups
    )
    if asked.known is not None:
        calibration = _with_curve(calibration, asked.known)
    std = calibration.delays_std_ns | dict.fromkeys(judgement.free_tags, math.inf)
    calibration = replace(calibration, delays_std_ns=std)
    applied = replace(calibration, errors=None).apply(ranges)
    residuals = applied.corrected_m - ranges.truth_m
    refuse_refuted(calibration.delays_ns, residuals, ranges)
    inliers = np.abs(residuals) < INLIER_SIGMAS * applied.sigma_m
    warnings = [
        *judgement.left_open(covariance),
        *_of_search(top, rival),
        *top.scene.tapes.left_out,
        *limits(found, ranges, residuals, asked.fixed),
        *judgement.sentences,
        *doubts.sentences,
        *one_way(ranges),
        *implausible(calibration.delays_ns, residuals),
        *unlike_powers(ranges, calibration),
        *warnings_of(ranges, float(np.mean(inliers)), [], found.blocks.seconds),
    ]
    provenance = _provenance(found, top, judgement, asked, covariance) | {
        "inliers": int(np.count_nonzero(inliers)),
        "warnings": warnings,
    }
    return FitResult(
        calibration=replace(calibration, provenance=provenance),
        ranges=ranges,
        residuals_m=residuals,
        inliers=inliers,
        success=top.success,
        message=f"{'converged' if top.success else 'stopped'} after {top.steps} steps",
        warnings=warnings,
    )


def _with_curve(calibration: Calibration, known: Calibration) -> Calibration:
    """Return a calibration with the curve of another, and what is known of it."""
    uncertainty = calibration.uncertainty
    if uncertainty is not None:
        size = len(known.bias_curve.coefficients)
        of_curve = known.uncertainty.bias_m2 if known.uncertainty else tuple((0.0,) * size for _ in range(size))
        uncertainty = replace(uncertainty, bias_m2=of_curve)
    return replace(calibration, bias_curve=known.bias_curve, uncertainty=uncertainty)


def _of_search(top: Found, rival: str) -> Iterator[str]:
    if not top.success:
        yield f"the fit stopped after {top.steps} steps before it settled: delays are not final"
    if rival:
        yield rival


def _refuse_undetermined(judgement: Judged, model: RangeModel, scene: Scene) -> None:
    free = judgement.free_tags
    if not free or len(free) < len([tag for tag in model.tags if tag in judgement.tags]):
        return
    raise UnanswerableError(
        f"{scene.source}: {judgement.said}; let positions be known for some seconds (`poses_until_s`), give the "
        "places of anchors, or pin a delay with `fixed_ns` (`minimum_norm` fits regardless, and says so)",
        undetermined=[free],
    )


def _provenance(
    found: KnownDistances, top: Found, judgement: Judged, asked: Asked, covariance: Floats
) -> dict[str, Any]:
    scene, ranges, known = top.scene, found.model.ranges, top.scene.places.time_s
    more: dict[str, Any] = {}
    if judgement.free_tags:
        more |= {"undetermined": [judgement.free_tags], "left_open": judgement.left_open(covariance)[0]}
    if asked.fixed:
        more["fixed_ns"] = {str(tag): delay for tag, delay in sorted(asked.fixed.items())}
    pinned = set(found.model.tags) <= set(asked.fixed)
    return more | {
        "writer": f"uwbcal {uwblink.__version__}",
        "recordings": [scene.source],
        "exchanges": len(ranges),
        "excluded": ranges.excluded,
        "recipe": "trajectories",
        "truth": "ranges",
        "fitted": "delays only" if found.model.curve is None else "curve only" if pinned else "delays and curve",
        "rests_on": {
            "known_s": float(np.ptp(known)) if len(known) else 0.0,
            "moving": list(scene.moving),
            "anchors_given": [body for body, place in scene.still.items() if place is not None],
            "anchors_sought": scene.sought,
            "attitudes": asked.usable.attitudes if scene.attitudes else "none",
            "heading_std_deg": asked.usable.heading_std_deg,
            "distances": len(scene.tapes.told),
            "heights": sorted({scene.moving[body] for body in scene.heights.body.tolist()}),
        },
        "distance_std_m": judgement.distance_std_m,
        "absorbed": judgement.absorbed,
        "used": top.used,
        "jerk_m_s3": top.jerk_m_s3,
        "converged": top.success,
        "reference_power_dbm": asked.reference_dbm,
        "standard_errors": f"sandwich over {found.lasting.lasting[0].stretches:.0f} independent stretches of time",
        "gauge": f"the bias curve{' was taken, and' if asked.known else ''} is zero at {asked.reference_dbm:g} dBm; "
        "the delays carry the constant",
    }
