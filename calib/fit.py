"""The fit: antenna delays and the bias curve together, then the curve of standard deviation.

A constant in the curve and a shift common to all delays are the same thing (docs/theory.md), so the fit
must choose: the curve's average over the populated range of lifted power is zero. Delays then do not
depend on how often a flight happened to see each power, only on the range. Curve and delays together put the
centre of the core of the calibrated errors at zero: the core is told from the tail of reflections by its shape
(`calib.mixture`), so the tail does not pull it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import uwblink
from calib.calibration import Calibration
from calib.dataset import Ranges
from calib.delays import check_determined, design, robust_fit
from calib.errors import UnanswerableError
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


def fit(
    ranges: Ranges,
    *,
    loss: str = "cauchy",
    scale_ns: float | None = None,
    lift: str = "mean-of-lifted",
    alpha_dbm: float = ALPHA_DBM,
) -> FitResult:
    """Fit a calibration to ranges with known truth.

    `scale_ns` is the scale of the robust loss in time of flight; estimated from the data by default.
    Raises `UnanswerableError` when there are too few ranges, their power does not vary, or the pairs
    do not determine the delays.
    """
    tags = ranges.tags()
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
    matrix = design(ranges, tags)
    check_determined(matrix, tags)
    error = ranges.raw_m - ranges.truth_m
    scale_m = None if scale_ns is None else scale_ns * 1e-9 * SPEED_OF_LIGHT
    robust = "cauchy" if loss == MIXTURE else loss
    alone = robust_fit(matrix, -error, robust, scale_m)
    knots = knots_for(lifted, BIAS_SEGMENTS)
    splines = basis(lifted, knots)
    centre = splines.mean(axis=0)
    both = np.hstack([matrix, centre - splines])
    penalty = _penalty(len(tags), splines.shape[1], len(ranges))
    start = np.concatenate([alone.parameters, np.zeros(splines.shape[1])])
    joint = robust_fit(both, -error, robust, scale_m, penalty=penalty, start=start)
    bins = equal_bins(lifted)
    parameters, covariance, steps, success = joint.parameters, joint.covariance, joint.steps, joint.success
    if loss == MIXTURE:
        likely = refine(both, error, parameters, penalty, bins)
        parameters, covariance, success = likely.parameters, likely.covariance, likely.success
        steps += likely.steps
    delays, shape = np.split(parameters, [len(tags)])
    # Errors are raw + delays - curve; the curve so far has zero mean over the data.
    core = error + both @ parameters
    makeup = take_apart(core, bins, int(bins.max()) + 1)
    sigma = sigma_curve(lifted, bins, makeup.sigma_m)
    centre_m = makeup.location_m
    inliers = np.abs(core - centre_m) < INLIER_SIGMAS * sigma(lifted)
    # The integral of a B-spline is its coefficients times a quarter of each one's span.
    average = float(shape @ (knots[DEGREE + 1 :] - knots[: -DEGREE - 1])) / (DEGREE + 1) / (high - low)
    constant = -average
    shift_ns = (centre @ shape - average - centre_m) / SPEED_OF_LIGHT * 1e9
    bias = Curve(
        tuple(knots.tolist()),
        tuple((shape + constant).tolist()),
        DEGREE,
        (low, high),
    )
    calibration = Calibration(
        delays_ns=dict(zip(tags, (delays + shift_ns).tolist(), strict=True)),
        delays_std_ns=dict(zip(tags, np.sqrt(np.diag(covariance)[: len(tags)]).tolist(), strict=True)),
        loss=loss,
        scale_ns=joint.scale / SPEED_OF_LIGHT * 1e9,
        lift=lift,
        alpha_dbm=alpha_dbm,
        speed_of_light=SPEED_OF_LIGHT,
        bias_curve=bias,
        sigma_curve=sigma,
        provenance=_provenance(ranges, inliers),
    )
    return FitResult(
        calibration,
        calibration.apply(ranges).full_m - ranges.truth_m,
        inliers,
        success,
        f"{'converged' if success else 'stopped'} after {steps} steps",
    )


def _penalty(tags: int, coefficients: int, count: int) -> Floats:
    """Smoothness of the curve; its constant, which the delays carry, is held at zero."""
    penalty = np.zeros((tags + coefficients,) * 2)
    smooth = SMOOTHNESS * roughness(coefficients) + 1e-9 * np.eye(coefficients)
    penalty[tags:, tags:] = count / coefficients * smooth
    return penalty


def _provenance(ranges: Ranges, inliers: NDArray[np.bool_]) -> dict[str, Any]:
    return {
        "writer": f"uwbcal {uwblink.__version__}",
        "recordings": ranges.source.split(", "),
        "exchanges": len(ranges),
        "inliers": int(np.count_nonzero(inliers)),
        "excluded": ranges.excluded,
        "gauge": "average of the bias curve over its range is zero; the delays carry the constant",
    }
