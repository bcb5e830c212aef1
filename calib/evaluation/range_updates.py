"""Updates of filters by a range, for many filters at once: by a gate, or by a mixture of errors.

Filters differ in the error of a range that they assume. All update along the line of sight: mean and covariance of the
state follow from the mean and variance of the noise in an innovation (moments of the posterior for Gaussian noise and
state). A diverged filter restarts from ranges alone (`multilaterate`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from calib.calibration.applying import noise_m
from calib.calibration.model import Calibration
from calib.data.ranges import Ranges
from calib.range_errors.densities import ONE_KIND, ROOT_2PI, LongDetours, densities
from uwblink.arrays import Bools, Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeErrors:
    """The error model of a range: reflected with probability `share`, by a least detour and an exponential one.

    Metres and shares of 1. Outliers have the share `outlier` and a size of about `outlier_m`. Of several ranges,
    `share` and `detour_m` are columns (n,), or (n, 2) of differences of arrival, which reflections of the one reception
    lengthen and of the other shorten. `detour_m` is the mean of both kinds of exponential detour, `long` their
    proportions, `location_m` the centre of the noise of a range.
    """

    share: Floats | float
    least_m: float
    detour_m: Floats | float
    outlier: float
    outlier_m: float
    long: LongDetours = ONE_KIND
    location_m: float = 0.0

    def at(self, rows: Any) -> RangeErrors:
        """Return the model of some of several ranges, or of one."""
        return replace(self, share=np.asarray(self.share)[rows], detour_m=np.asarray(self.detour_m)[rows])


def range_errors(calibration: Calibration, ranges: Ranges) -> tuple[Floats, RangeErrors]:
    """Return the noise (n,) of corrected ranges within a flight, and their errors.

    Outliers have a share of a thousandth at least, of about 3 m, because a filter meets errors that the calibration did
    not. Without an error model a tenth of the ranges is taken to be reflected, by 30 cm on average.
    """
    model, lifted = calibration.errors, calibration.lifted(ranges)
    if model is None:
        share, detour_m = np.repeat([[0.1], [0.3]], len(ranges), axis=1)
        unknown = RangeErrors(share=share, least_m=0.0, detour_m=detour_m, outlier=0.01, outlier_m=3.0)
        return noise_m(calibration, ranges), unknown
    shapes = model.shapes(lifted, ranges.initiator, ranges.target)
    errors = RangeErrors(
        share=shapes.tail_share,
        least_m=model.least_m,
        detour_m=shapes.detour_m,
        outlier=max(model.outlier_share, 1e-3),
        outlier_m=max(model.outlier_m, 3.0),
        long=model.long,
        location_m=model.location_m,
    )
    return np.hypot(model.within_m(shapes.noise_m), calibration.bias_curve.beyond(lifted)), errors


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeUpdate:
    """An update by a range: mean and variance of the noise in the innovation, and whether the range is accepted.

    `log_density` is that of the innovation, in 1/m; `nis` is its square over its variance with plain noise.
    """

    noise_m: Floats
    variance_m2: Floats
    believed: Bools
    log_density: Floats
    nis: Floats


def gated_update(innovation_m: Floats, variance_m2: Floats, gate: float) -> RangeUpdate:
    """Accept an innovation if its square over its variance is below the gate; otherwise the state does not change."""
    believed = innovation_m**2 < gate * variance_m2
    return RangeUpdate(
        noise_m=np.where(believed, innovation_m, 0.0),
        variance_m2=np.where(believed, 0.0, variance_m2),
        believed=believed,
        log_density=-0.5 * (innovation_m**2 / variance_m2 + np.log(2 * np.pi * variance_m2)),
        nis=innovation_m**2 / variance_m2,
    )


def mixture_update(innovation_m: Floats, variance_m2: Floats, errors: RangeErrors) -> RangeUpdate:
    """Weigh direct, reflected and outlying ranges by the likelihood of the innovation.

    The noise in a reflected range is a normal distribution, truncated above (`calib.range_errors.densities`,
    docs/theory.md); in a difference of arrival that reads short, truncated below. An outlier has no information.
    """
    sigma_m, inside = np.sqrt(variance_m2), 1 - errors.outlier
    shares, detours_m = np.atleast_1d(errors.share, errors.detour_m)
    direct = np.prod(1 - shares)
    wide = np.hypot(errors.outlier_m, sigma_m)
    wild = errors.outlier * np.exp(-0.5 * (innovation_m / wide) ** 2) / (wide * ROOT_2PI) + 1e-300
    core = np.exp(-0.5 * innovation_m**2 / variance_m2) / (sigma_m * ROOT_2PI) * (inside * direct)
    total, mean, square = core + wild, core * innovation_m, core * innovation_m**2 + wild * variance_m2
    for sign, share, detour_m in zip((1.0, -1.0), shares, detours_m, strict=False):
        if share:
            found = densities(sign * innovation_m, sigma_m, errors.least_m, detour_m, errors.long)
            tail = found.reflected * (inside * (1 - direct) * share / shares.sum())
            noise = sign * found.noise_m()
            total, mean = total + tail, mean + tail * noise
            square = square + tail * (noise**2 + variance_m2 * found.noise_var())
    mean, square, wild = mean / total, square / total, wild / total
    return RangeUpdate(
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


def multilaterate(
    range_m: Floats, anchor_m: Floats, spread_m: float, height_m: float | None = None, sign: Floats | float = 1.0
) -> Fix:
    """Return the position from ranges (n,) to anchors (n, 3), by a Cauchy loss from nine starts.

    Instead of a distance a measurement may be the sum of several, with signs (n, k) to anchors (n, k, 3). Errors beyond
    15 cm count less: reflections are longer. `spread_m` is a further error of each range: its lever arm, or motion of
    the body. A `height_m` above the world's zero counts as a measurement with a standard deviation of 30 cm.
    """
    scale = float(np.hypot(0.15, spread_m))

    def misfit(place: Floats) -> Floats:
        distance = np.linalg.norm(place - anchor_m, axis=-1) * sign
        errors = (distance.reshape(len(range_m), -1).sum(axis=1) - range_m) / scale
        return errors if height_m is None else np.append(errors, (place[2] - height_m) / 0.3)

    places = anchor_m.reshape(-1, 3)
    middle, reach = places.mean(axis=0), np.maximum(np.ptp(places, axis=0), 1.0)
    starts = [middle, *(middle + 0.4 * reach * np.array(signs) for signs in product((-1, 1), repeat=3))]
    found = min((least_squares(misfit, start, loss="cauchy") for start in starts), key=lambda one: float(one.cost))
    slopes = np.asarray(found.jac, dtype=np.float64)
    return Fix(np.asarray(found.x), np.asarray(np.linalg.inv(slopes.T @ slopes + 1e-3 * np.eye(3))))
