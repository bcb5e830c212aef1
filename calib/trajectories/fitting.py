"""A fit without known distances: delays and curve together with the trajectories of the bodies."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

import uwblink
from calib.calibration.model import Calibration
from calib.calibration.power_curves import ALPHA_DBM
from calib.calibration.power_curves import lift as lift_power
from calib.checks.limits import limits
from calib.checks.plausibility import implausible, one_way, refuse_refuted
from calib.checks.power_levels import unlike_powers
from calib.checks.warnings import warnings_of
from calib.data.sources import Data
from calib.errors import BadInputError, UnanswerableError
from calib.estimation.building import build_problem
from calib.estimation.problem import Problem
from calib.estimation.stating import calibration_of
from calib.estimation.unknowns import Unknowns
from calib.fitting.result import FitResult
from calib.settings import FitSettings, check_choice
from calib.trajectories.beginning import beginning
from calib.trajectories.climbing import Climbed, climb
from calib.trajectories.given import Usable, scene_from
from calib.trajectories.judging import Judged, judged
from calib.trajectories.scene import Scene
from calib.trajectories.taken_curve import curve_source, less_curve, with_curve
from uwblink.recording.schema import KnownDistance

ATTITUDES: Final = ("poses", "imu", "none")
ANCHORS: Final = ("given", "sought")
HEIGHTS: Final = ("used", "ignored")
SIGMAS: Final = 3.0
FOLLOWING: Final = 0.3
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
    known = curve_source(curve_from, "delays_only" if delays_only else "groups" if groups else "")
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
        problem, scene = problem_of(scene, asked)
        begun = beginning(scene, lambda share: done(FOLLOWING * share))
        climbed = climb(begun.scene, problem, begun.state, lambda share: done(FOLLOWING + (1 - FOLLOWING) * share))
        problem = _with_distances(problem, climbed)
        found = judged(climbed, problem, asked.reference, asked.known)
        result = _result(climbed, problem, found, asked, begun.rival)
    done(1.0)
    if not minimum_norm:
        _refuse_undetermined(found, problem, scene)
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

    @property
    def reference(self) -> float:
        """Return the power at which curves are zero, lifted."""
        return float(lift_power(np.array(self.reference_dbm), self.alpha_dbm))


def problem_of(scene: Scene, asked: Asked) -> tuple[Problem, Scene]:
    """Return the columns of delays and curves, without any distance in them, and the scene of their ranges."""
    # In the place of distances, which nobody knows, the number of the row: it says which rows are left.
    numbered = replace(scene.ranges, truth_m=np.arange(len(scene.ranges), dtype=np.float64))
    problem = build_problem(
        numbered,
        lift=asked.lift,
        alpha_dbm=asked.alpha_dbm,
        fixed=asked.fixed,
        groups=asked.groups,
        minimum_norm=False,
        unknowns=Unknowns(curve=asked.curve),
    )
    rows = problem.ranges.truth_m
    bare = replace(problem.ranges, truth_m=np.zeros(len(rows)))
    problem = replace(problem, ranges=bare, error=problem.error + rows)
    if asked.known is not None:
        problem = less_curve(problem, asked.known)
    return problem, scene.only(rows.astype(np.int64))


def _with_distances(problem: Problem, climbed: Climbed) -> Problem:
    """Return the columns of delays and curves with the distances that were found."""
    ranges = replace(problem.ranges, truth_m=climbed.rows.distances(climbed.state))
    return replace(problem, ranges=ranges, error=problem.error - ranges.truth_m)


def _result(climbed: Climbed, problem: Problem, found: Judged, asked: Asked, rival: str) -> FitResult:
    ranges, solved, covariance = problem.ranges, found.solved, found.covariance_ns2
    calibration = calibration_of(
        problem, solved, covariance, climbed.told, asked.lift, asked.alpha_dbm, asked.fixed, asked.groups
    )
    if asked.known is not None:
        calibration = with_curve(calibration, asked.known)
    std = calibration.delays_std_ns | dict.fromkeys(found.free_tags, math.inf)
    calibration = replace(calibration, delays_std_ns=std)
    applied = replace(calibration, errors=None).apply(ranges)
    residuals = applied.corrected_m - ranges.truth_m
    refuse_refuted(calibration.delays_ns, residuals, ranges)
    inliers = np.abs(residuals) < SIGMAS * applied.sigma_m
    warnings = [
        *found.open_ends(),
        *_of_search(climbed, rival),
        *climbed.scene.tapes.left_out,
        *limits(ranges, problem, residuals, asked.fixed),
        *found.doubts,
        *one_way(ranges),
        *implausible(calibration.delays_ns, residuals),
        *unlike_powers(ranges, calibration),
        *warnings_of(ranges, float(np.mean(inliers)), [], problem.blocks.seconds),
    ]
    provenance = _provenance(climbed, problem, found, asked) | {
        "inliers": int(np.count_nonzero(inliers)),
        "warnings": warnings,
    }
    return FitResult(
        calibration=replace(calibration, provenance=provenance),
        ranges=ranges,
        residuals_m=residuals,
        inliers=inliers,
        success=climbed.settled,
        message=f"{'converged' if climbed.settled else 'stopped'} after {climbed.steps} steps",
        warnings=warnings,
    )


def _of_search(climbed: Climbed, rival: str) -> Iterator[str]:
    if not climbed.settled:
        yield f"the fit stopped after {climbed.steps} steps before it settled: delays are not final"
    if rival:
        yield rival


def _refuse_undetermined(found: Judged, problem: Problem, scene: Scene) -> None:
    free = found.free_tags
    if not free or len(free) < len(problem.tags):
        return
    raise UnanswerableError(
        f"{scene.source}: {found.open_ends()[0]}; let positions be known for some seconds (`poses_until_s`), give the "
        "places of anchors, or pin a delay with `fixed_ns` (`minimum_norm` fits regardless, and says so)",
        undetermined=[free],
    )


def _provenance(climbed: Climbed, problem: Problem, found: Judged, asked: Asked) -> dict[str, Any]:
    scene, ranges, known = climbed.scene, problem.ranges, climbed.scene.places.time_s
    more: dict[str, Any] = {}
    if found.free_tags:
        more |= {"undetermined": [found.free_tags], "left_open": found.open_ends()[0]}
    if asked.fixed:
        more["fixed_ns"] = {str(tag): delay for tag, delay in sorted(asked.fixed.items())}
    return more | {
        "writer": f"uwbcal {uwblink.__version__}",
        "recordings": [scene.source],
        "exchanges": len(ranges),
        "excluded": ranges.excluded,
        "recipe": "trajectories",
        "truth": "ranges",
        "fitted": problem.unknowns.told(len(problem.tags)),
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
        "distance_std_m": float(np.sqrt(np.mean(found.distance_std_m**2))),
        "absorbed": found.absorbed,
        "used": climbed.used,
        "jerk_m_s3": climbed.jerk_m_s3,
        "converged": climbed.settled,
        "reference_power_dbm": asked.reference_dbm,
        "standard_errors": f"sandwich over {found.solved.lasting.stretches:.0f} independent stretches of time",
        "gauge": f"the bias curve{' was taken, and' if asked.known else ''} is zero at {asked.reference_dbm:g} dBm; "
        "the delays carry the constant",
    }
