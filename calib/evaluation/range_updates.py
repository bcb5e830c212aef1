"""What a range tells a filter, for many filters at once: by a gate, or by what its error may be made of.

Filters differ in what they take for the noise of a range. All of them update along the line of sight; what differs is
what is expected of the noise in an innovation, its mean and variance, from which mean and covariance of the state
follow exactly (Gaussian noise and state, moments of the posterior). A filter that is lost begins anew where ranges
alone say (`multilaterate`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from calib.calibration.model import Calibration
from calib.data.ranges import Ranges
from calib.errors import UnanswerableError
from calib.range_errors.densities import ONE_KIND, ROOT_2PI, LongDetours, densities
from uwblink.arrays import Bools, Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeErrors:
    """What the errors of a range are made of: reflected with `share`, by a least detour and an exponential one.

    Metres and shares of 1. `outlier` are of any size, about `outlier_m`. Of several ranges, `share` and `detour_m` are
    columns (n,). `detour_m` is the mean of both kinds of exponential detour, `long` says how they divide.
    """

    share: Floats | float
    least_m: float
    detour_m: Floats | float
    outlier: float
    outlier_m: float
    long: LongDetours = ONE_KIND

    def times(self, count: int) -> RangeErrors:
        """Return those of so many ranges, all alike."""
        return replace(self, share=np.full(count, self.share), detour_m=np.full(count, self.detour_m))

    def at(self, rows: Any) -> RangeErrors:
        """Return those of some of several ranges, or of one by its number."""
        return replace(self, share=np.asarray(self.share)[rows], detour_m=np.asarray(self.detour_m)[rows])


def range_errors(calibration: Calibration, ranges: Ranges) -> tuple[Floats, RangeErrors]:
    """Return the noise (n,) of corrected ranges, and what their errors are made of besides.

    Outliers are at least a thousandth, of about 3 m: a filter reckons with what a calibration has not seen. Raises
    `UnanswerableError` for a calibration that does not say.
    """
    model = calibration.errors
    if model is None:
        raise UnanswerableError("the calibration does not say what errors are made of; fit anew from a recording")
    lifted = calibration.lifted(ranges)
    shapes = model.shapes(lifted, ranges.initiator, ranges.target)
    errors = RangeErrors(
        share=shapes.tail_share,
        least_m=model.least_m,
        detour_m=shapes.detour_m,
        outlier=max(model.outlier_share, 1e-3),
        outlier_m=max(model.outlier_m, 3.0),
        long=model.long,
    )
    return np.hypot(shapes.noise_m, calibration.bias_curve.beyond(lifted)), errors


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """What filters make of a range: mean and variance of the noise in an innovation, and whether they believe it.

    `log_density` is how likely the innovation was, in 1/m, `nis` its square over its variance as plain noise.
    """

    noise_m: Floats
    variance_m2: Floats
    believed: Bools
    log_density: Floats
    nis: Floats


def gated(innovation_m: Floats, variance_m2: Floats, gate: float) -> Heard:
    """Take an innovation for noise where its square over its variance is below the gate, else learn nothing."""
    believed = innovation_m**2 < gate * variance_m2
    return Heard(
        noise_m=np.where(believed, innovation_m, 0.0),
        variance_m2=np.where(believed, 0.0, variance_m2),
        believed=believed,
        log_density=-0.5 * (innovation_m**2 / variance_m2 + np.log(2 * np.pi * variance_m2)),
        nis=innovation_m**2 / variance_m2,
    )


def weighed(innovation_m: Floats, variance_m2: Floats, errors: RangeErrors) -> Heard:
    """Weigh noise, reflection and outlier by how likely each made an innovation of such noise.

    The noise in a reflected range is normal, cut off above (`calib.range_errors.densities`, docs/theory.md). An
    outlier says nothing.
    """
    found = densities(innovation_m, np.sqrt(variance_m2), errors.least_m, errors.detour_m, errors.long)
    inside = 1 - errors.outlier
    core = found.direct * (inside * (1 - errors.share))
    tail = found.reflected * (inside * errors.share)
    wide = np.hypot(errors.outlier_m, found.sigma_m)
    wild = errors.outlier * np.exp(-0.5 * (innovation_m / wide) ** 2) / (wide * ROOT_2PI) + 1e-300
    total = core + tail + wild
    core, tail, wild = core / total, tail / total, wild / total
    of_tail, spread = found.noise_m(), variance_m2 * found.noise_var()
    mean = core * innovation_m + tail * of_tail
    square = core * innovation_m**2 + tail * (of_tail**2 + spread) + wild * variance_m2
    return Heard(
        noise_m=mean,
        variance_m2=np.maximum(square - mean**2, 0.0),
        believed=wild < 0.5,
        log_density=np.log(total),
        nis=innovation_m**2 / variance_m2,
    )


@dataclass(frozen=True, slots=True)
class Fix:
    """A position (3,) and its covariance (3, 3), in metres."""

    place_m: Floats
    covariance_m2: Floats


def multilaterate(range_m: Floats, anchor_m: Floats, spread_m: float, height_m: float | None = None) -> Fix:
    """Return the position that ranges (n,) to anchors (n, 3) agree on, by a Cauchy loss, from nine starts.

    Errors beyond 15 cm count for less: reflections are longer. `spread_m` is by how much each range may be off besides
    its noise: by its lever arm, or because the body moves. A `height_m` above the world's zero counts as a measurement
    with a standard deviation of 30 cm.
    """
    scale = float(np.hypot(0.15, spread_m))

    def misfit(place: Floats) -> Floats:
        errors = (np.linalg.norm(place - anchor_m, axis=1) - range_m) / scale
        return errors if height_m is None else np.append(errors, (place[2] - height_m) / 0.3)

    middle, reach = anchor_m.mean(axis=0), np.maximum(np.ptp(anchor_m, axis=0), 1.0)
    starts = [middle, *(middle + 0.4 * reach * np.array(signs) for signs in product((-1, 1), repeat=3))]
    found = min((least_squares(misfit, start, loss="cauchy") for start in starts), key=lambda one: float(one.cost))
    slopes = np.asarray(found.jac, dtype=np.float64)
    return Fix(np.asarray(found.x), np.asarray(np.linalg.inv(slopes.T @ slopes + 1e-3 * np.eye(3))))
