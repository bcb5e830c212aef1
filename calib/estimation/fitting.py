"""The fit: antenna delays and the bias curve together, then the curve of standard deviation.

A constant in the curve and a shift common to all delays are the same thing (docs/theory.md), so the fit
must choose: the curve's average over the populated range of lifted power is zero. Delays then do not
depend on how often a flight happened to see each power, only on the range. Curve and delays together put the
centre of the core of the calibrated errors at zero: the core is told from the tail of reflections by its shape
(`calib.estimation.error_mixture`), so the tail does not pull it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

import uwblink
from calib.calibration.json_format import Matrix
from calib.calibration.model import Calibration, TagGroup, Uncertainty
from calib.calibration.power_curves import ALPHA_DBM, DEGREE, Curve
from calib.estimation.arguments import check_fit
from calib.estimation.error_mixture import fit_error_mixture
from calib.estimation.problem import Problem, build_problem
from calib.estimation.result import FitResult
from calib.estimation.sigma_curve import fit_sigma
from calib.estimation.solver import Solved, solve
from calib.estimation.warnings import warnings_of
from calib.ranges import Ranges
from calib.sources import Data, load_ranges
from uwblink.arrays import Bools, Floats
from uwblink.ticks import SPEED_OF_LIGHT

INLIER_SIGMAS: Final = 3.0


def fit(  # noqa: PLR0913 - keyword-only settings of one fit, each with its default
    data: Data | Iterable[Data],
    *,
    loss: str = "cauchy",
    scale_ns: float | None = None,
    lift: str = "mean-of-lifted",
    alpha_dbm: float = ALPHA_DBM,
    fixed_ns: Mapping[int, float] | None = None,
    groups: Mapping[str, tuple[int, ...]] | None = None,
    sequential: bool = False,
    minimum_norm: bool = False,
) -> FitResult:
    """Fit antenna delays and the curves of bias and standard deviation to ranges with known truth.

    `data` is what `load_ranges` takes: paths of recordings, simulations in memory, `Ranges`, one or several. `loss` is
    "cauchy", "huber", "soft_l1", "l2", one that `register_loss` added, or "mixture", the likelihood of core, tail and
    outliers.

    `scale_ns` is the scale of the robust loss in time of flight, estimated from the data by default; `fixed_ns` are
    delays that are known; `groups` name tags that share a curve (by default all do). `sequential` is the recipe of ICRA
    2023, section V: delays first, then the curve on what they leave. `minimum_norm` fits even where the pairs leave
    delays free, with the smallest ones that agree with the data. Raises `UnanswerableError` when there are too few
    ranges, their power does not vary, or the pairs do not determine the delays, and `BadInputError` for pinned tags or
    groups that are not in the data, and for a parameter that cannot be used.

    >>> import calib
    >>> result = calib.fit(calib.sample_flight())
    >>> delays = result.calibration.delays_ns
    >>> f"{delays[2] - delays[1]:.2f} ns, planted 0.40 ns"
    '0.40 ns, planted 0.40 ns'
    """
    fixed, groups = dict(fixed_ns or {}), dict(groups or {})
    check_fit(
        loss=loss,
        scale_ns=scale_ns,
        lift=lift,
        alpha_dbm=alpha_dbm,
        fixed_ns=fixed,
        groups=groups,
        sequential=sequential,
    )
    fixed = {int(tag): float(delay) for tag, delay in fixed.items()}
    groups = {name: tuple(map(int, tags)) for name, tags in groups.items()}
    ranges = load_ranges(data)
    problem = build_problem(
        ranges, lift=lift, alpha_dbm=alpha_dbm, fixed=fixed, groups=groups, minimum_norm=minimum_norm
    )
    found = solve(problem, loss, None if scale_ns is None else scale_ns * 1e-9 * SPEED_OF_LIGHT, sequential=sequential)
    calibration = _calibration(problem, found, loss, lift, alpha_dbm, fixed, groups)
    applied = calibration.apply(ranges)
    residuals = applied.corrected_m - ranges.truth_m
    inliers = np.abs(residuals) < INLIER_SIGMAS * applied.sigma_m
    warnings = warnings_of(ranges, applied, float(np.mean(inliers)), problem.free)
    provenance = _provenance(ranges, inliers, fixed, sequential, problem, warnings)
    return FitResult(
        calibration=replace(calibration, provenance=provenance),
        ranges=ranges,
        residuals_m=residuals,
        inliers=inliers,
        success=found.success,
        message=f"{'converged' if found.success else 'stopped'} after {found.steps} steps",
        warnings=warnings,
    )


def _calibration(
    problem: Problem,
    found: Solved,
    loss: str,
    lift: str,
    alpha_dbm: float,
    fixed: dict[int, float],
    groups: Mapping[str, tuple[int, ...]],
) -> Calibration:
    """Turn parameters into a calibration: find the core of the errors, centre it, and draw sigma."""
    core = problem.error + problem.design @ found.parameters
    mixture = fit_error_mixture(core, problem.bins.number, len(problem.bins.count))
    sigma = fit_sigma(problem, core - mixture.location_m, mixture)
    # The centre of the core goes into a constant of the curve if delays are pinned, else into the delays.
    constant = mixture.location_m if fixed else 0.0
    shift_ns = 0.0 if fixed else -mixture.location_m / SPEED_OF_LIGHT * 1e9
    delays = problem.directions @ found.parameters[: problem.rank] + shift_ns
    covariance = problem.directions @ found.covariance[: problem.rank, : problem.rank] @ problem.directions.T
    biases = _bias_curves(problem, found, constant)
    return Calibration(
        delays_ns=dict(zip(problem.tags, delays.tolist(), strict=True)) | fixed,
        delays_std_ns=dict(zip(problem.tags, _standard_errors(problem, covariance), strict=True))
        | dict.fromkeys(fixed, 0.0),
        loss=loss,
        scale_ns=found.scale / SPEED_OF_LIGHT * 1e9,
        lift=lift,
        alpha_dbm=alpha_dbm,
        speed_of_light=SPEED_OF_LIGHT,
        bias_curve=_average(list(biases.values())),
        sigma_curve=_average(list(sigma.curves.values())),
        uncertainty=Uncertainty(
            tuple(problem.tags), _rows(covariance), _rows(_bias_covariance(problem, found)), _rows(sigma.covariance)
        ),
        groups={name: TagGroup(tuple(tags), biases[name], sigma.curves[name]) for name, tags in groups.items()},
    )


def _bias_curves(problem: Problem, found: Solved, constant: float) -> dict[str, Curve]:
    knots = tuple(problem.knots.tolist())
    curves = {}
    for name, columns in problem.curves():
        shape = found.parameters[columns]
        curves[name] = Curve(knots, tuple((shape - problem.averages @ shape + constant).tolist()), DEGREE, problem.span)
    return curves


def _standard_errors(problem: Problem, covariance: Floats) -> list[float]:
    """Standard errors of the delays (tags,) in ns, infinite where the data leave one free."""
    free = {tag for group in problem.free for tag in group}
    std = np.sqrt(np.maximum(np.diag(covariance), 0)).tolist()
    return [math.inf if tag in free else value for tag, value in zip(problem.tags, std, strict=True)]


def _bias_covariance(problem: Problem, found: Solved) -> Floats:
    """Covariance of the coefficients of the plain curve, which is the groups' average, less its own average."""
    each = len(problem.averages)
    average = np.zeros((each, len(found.parameters)))
    for _, columns in problem.curves():
        average[:, columns] = np.eye(each) / len(problem.groups)
    centred = (np.eye(each) - np.outer(np.ones(each), problem.averages)) @ average
    return np.asarray(centred @ found.covariance @ centred.T)


def _average(curves: list[Curve]) -> Curve:
    """Return the mean of curves over the same knots."""
    mean = np.mean([curve.coefficients for curve in curves], axis=0)
    return Curve(curves[0].knots, tuple(mean.tolist()), curves[0].degree, curves[0].range)


def _rows(matrix: Floats) -> Matrix:
    return tuple(tuple(row) for row in matrix.tolist())


def _provenance(
    ranges: Ranges,
    inliers: Bools,
    fixed: dict[int, float],
    sequential: bool,
    problem: Problem,
    warnings: list[str],
) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if fixed:
        found["fixed_ns"] = {str(tag): delay for tag, delay in sorted(fixed.items())}
    if problem.free:
        found["undetermined"] = problem.free
    return found | {
        "writer": f"uwbcal {uwblink.__version__}",
        "recordings": ranges.source.split(", "),
        "exchanges": len(ranges),
        "inliers": int(np.count_nonzero(inliers)),
        "excluded": ranges.excluded,
        "recipe": "sequential" if sequential else "joint",
        "standard_errors": f"sandwich over {int(problem.blocks[-1]) + 1} blocks of time",
        "warnings": warnings,
        "gauge": "average of the bias curve over its range is zero; the delays carry the constant",
    }
