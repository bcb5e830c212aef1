"""The fit: antenna delays and the bias curve together, then the curve of standard deviation.

A constant in the curve and a shift common to all delays are the same thing (docs/theory.md), so the fit
must choose: the curve's average over the populated range of lifted power is zero. Delays then do not
depend on how often a flight happened to see each power, only on the range. Curve and delays together put the
centre of the core of the calibrated errors at zero: the core is told from the tail of reflections by its shape
(`calib.mixture`), so the tail does not pull it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import uwblink
from calib.calibration import Calibration
from calib.dataset import Ranges
from calib.delays import Solution, check_determined, design, robust_fit
from calib.errors import BadInputError, UnanswerableError
from calib.mixture import take_apart
from calib.mixture_fit import refine
from calib.power import (
    ALPHA_DBM,
    BIAS_SEGMENTS,
    DEGREE,
    Curve,
    basis,
    equal_bins,
    knots_for,
    lifted_power,
    populated,
    roughness,
    sigma_curve,
)
from uwblink.ticks import SPEED_OF_LIGHT

Floats = NDArray[np.float64]

FEWEST: Final = 100
SMOOTHNESS: Final = 1e-4
INLIER_SIGMAS: Final = 3.0
MIXTURE: Final = "mixture"
"""The loss that is no loss of residuals: the likelihood of `calib.mixture_fit`, begun from a Cauchy fit."""


@dataclass(frozen=True, slots=True)
class FitResult:
    """A calibration and how it came about; residuals are full-corrected errors (n,), metres."""

    calibration: Calibration
    residuals_m: Floats
    inliers: NDArray[np.bool_]
    success: bool
    message: str


@dataclass(frozen=True, slots=True)
class _Problem:
    """A fit as linear algebra: residuals `error + design @ x` (n,), x = delays of `tags`, then spline coefficients.

    The splines are less their average over the range, so that a constant is left to the delays. What pinned tags add
    is in `error` already.
    """

    tags: list[int]
    error: Floats
    design: Floats
    lifted: Floats
    knots: Floats
    averages: Floats
    penalty: Floats


def fit(
    ranges: Ranges,
    *,
    loss: str = "cauchy",
    scale_ns: float | None = None,
    lift: str = "mean-of-lifted",
    alpha_dbm: float = ALPHA_DBM,
    fixed_ns: Mapping[int, float] | None = None,
) -> FitResult:
    """Fit a calibration to ranges with known truth.

    `scale_ns` is the scale of the robust loss in time of flight, estimated from the data by default; `fixed_ns` are
    delays that are known. Raises `UnanswerableError` when there are too few ranges, their power does not vary, or the
    pairs do not determine the delays, and `BadInputError` for a pinned tag that is not in the data.
    """
    fixed = dict(fixed_ns or {})
    problem = _problem(ranges, lift, alpha_dbm, fixed)
    found = _solve(problem, loss, None if scale_ns is None else scale_ns * 1e-9 * SPEED_OF_LIGHT)
    delays, shape = np.split(found.parameters, [len(problem.tags)])
    core, bins = problem.error + problem.design @ found.parameters, equal_bins(problem.lifted)
    makeup = take_apart(core, bins, int(bins.max()) + 1)
    sigma = sigma_curve(problem.lifted, bins, makeup.sigma_m)
    constant, shift_ns = _gauge(makeup.location_m, pinned=bool(fixed))
    coefficients = shape - problem.averages @ shape + constant
    inliers = np.abs(core - makeup.location_m) < INLIER_SIGMAS * sigma(problem.lifted)
    std_ns = np.sqrt(np.diag(found.covariance)[: len(problem.tags)])
    calibration = Calibration(
        delays_ns=dict(zip(problem.tags, (delays + shift_ns).tolist(), strict=True)) | fixed,
        delays_std_ns=dict(zip(problem.tags, std_ns.tolist(), strict=True)) | dict.fromkeys(fixed, 0.0),
        loss=loss,
        scale_ns=found.scale / SPEED_OF_LIGHT * 1e9,
        lift=lift,
        alpha_dbm=alpha_dbm,
        speed_of_light=SPEED_OF_LIGHT,
        bias_curve=Curve(
            tuple(problem.knots.tolist()), tuple(coefficients.tolist()), DEGREE, populated(problem.lifted)
        ),
        sigma_curve=sigma,
        provenance=_provenance(ranges, inliers, fixed),
    )
    return FitResult(
        calibration,
        calibration.apply(ranges).full_m - ranges.truth_m,
        inliers,
        found.success,
        f"{'converged' if found.success else 'stopped'} after {found.steps} steps",
    )


def _problem(ranges: Ranges, lift: str, alpha_dbm: float, fixed: dict[int, float]) -> _Problem:
    if len(ranges) < FEWEST:
        raise UnanswerableError(
            f"{ranges.source}: {len(ranges)} usable exchanges are too few, at least {FEWEST} are needed"
        )
    lifted = lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, lift, alpha_dbm)
    low, high = populated(lifted)
    if not high - low > 1e-6:
        raise UnanswerableError(
            f"{ranges.source}: the first-path power never changes, so no curve over power can be fitted"
        )
    everyone = ranges.tags()
    unknown = sorted(set(fixed) - set(everyone))
    if unknown:
        raise BadInputError(f"--fix: found tag {unknown[0]}, the tags are {', '.join(map(str, everyone))}")
    tags = [tag for tag in everyone if tag not in fixed]
    if not tags:
        raise BadInputError("--fix: every tag is pinned, so no delay is left to fit")
    matrix = design(ranges, everyone)
    free = np.array([tag not in fixed for tag in everyone])
    check_determined(matrix[:, free], tags, ranges.initiator, ranges.target)
    known = matrix[:, ~free] @ np.array([fixed[tag] for tag in everyone if tag in fixed])
    knots = knots_for(lifted, BIAS_SEGMENTS)
    splines = basis(lifted, knots)
    # The integral of a B-spline is its coefficients times a quarter of each one's span.
    averages = (knots[DEGREE + 1 :] - knots[: -DEGREE - 1]) / (DEGREE + 1) / (high - low)
    return _Problem(
        tags,
        ranges.raw_m - ranges.truth_m + known,
        np.hstack([matrix[:, free], averages - splines]),
        lifted,
        knots,
        averages,
        _penalty(len(tags), splines.shape[1], len(ranges)),
    )


def _solve(problem: _Problem, loss: str, scale_m: float | None) -> Solution:
    """Delays alone first, for a start that the curve cannot lead astray; then both; then the mixture, if asked for."""
    robust = "cauchy" if loss == MIXTURE else loss
    count = len(problem.tags)
    alone = robust_fit(problem.design[:, :count], -problem.error, robust, scale_m)
    start = np.concatenate([alone.parameters, np.zeros(problem.design.shape[1] - count)])
    joint = robust_fit(problem.design, -problem.error, robust, scale_m, penalty=problem.penalty, start=start)
    if loss != MIXTURE:
        return joint
    likely = refine(problem.design, problem.error, joint.parameters, problem.penalty, equal_bins(problem.lifted))
    return replace(
        joint,
        parameters=likely.parameters,
        covariance=likely.covariance,
        steps=joint.steps + likely.steps,
        success=likely.success,
    )


def _gauge(location_m: float, *, pinned: bool) -> tuple[float, float]:
    """Where the centre of the core goes: into a constant of the curve (m) if delays are pinned, else into them (ns)."""
    if pinned:
        return location_m, 0.0
    return 0.0, -location_m / SPEED_OF_LIGHT * 1e9


def _penalty(tags: int, coefficients: int, count: int) -> Floats:
    """Smoothness of the curve; its constant, which the delays carry, is held at zero."""
    penalty = np.zeros((tags + coefficients,) * 2)
    smooth = SMOOTHNESS * roughness(coefficients) + 1e-9 * np.eye(coefficients)
    penalty[tags:, tags:] = count / coefficients * smooth
    return penalty


def _provenance(ranges: Ranges, inliers: NDArray[np.bool_], fixed: dict[int, float]) -> dict[str, Any]:
    pinned = {"fixed_ns": {str(tag): delay for tag, delay in sorted(fixed.items())}} if fixed else {}
    return pinned | {
        "writer": f"uwbcal {uwblink.__version__}",
        "recordings": ranges.source.split(", "),
        "exchanges": len(ranges),
        "inliers": int(np.count_nonzero(inliers)),
        "excluded": ranges.excluded,
        "gauge": "average of the bias curve over its range is zero; the delays carry the constant",
    }
