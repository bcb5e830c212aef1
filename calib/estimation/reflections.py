"""How likely an error is where a range may be reflected: Gaussian core, tail of detours on the long side, outliers.

A detour is a least one plus an exponential one. With the least near zero that is an exponential tail, else a hump
beside the core, as a single wall makes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Floats

ROOT_2: Final = float(np.sqrt(2))
ROOT_2PI: Final = float(np.sqrt(2 * np.pi))
FARTHEST: Final = 30.0
"""Sigmas beyond which the noise in a detour no longer depends on the error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """What each range's error is made of, metres and shares of 1; arrays (n,) or numbers for all.

    A range is reflected with `tail_share`, by `least_m` and an exponential detour of mean `mean_m`; `outlier_share` are
    anywhere, with the density `outlier_density`.
    """

    sigma_m: Floats
    tail_share: Floats
    mean_m: Floats
    least_m: float
    outlier_share: float
    outlier_density: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Expected:
    """What errors (n,) lead to expect: shares of core and tail, the noise in a reflected one, and the log density.

    `noise_m` and `noise_var` are mean and variance of the noise if reflected, `noise_var` in sigmas squared.
    """

    core: Floats
    tail: Floats
    noise_m: Floats
    noise_var: Floats
    log_density: Floats


def expected(error_m: Floats, shape: Shape) -> Expected:
    """Return the expectation step.

    The noise in an error with an exponential detour is normal, cut off above: with v = (e - least)/sigma and
    u = v - sigma/mean its mean is sigma (sigma/mean - phi(u)/Phi(u)). The tail's density is
    exp(-v^2/2) erfcx(-u/sqrt 2) / (2 mean), which neither overflows nor cancels for u < 5.
    """
    from scipy.special import erfcx

    sigma = shape.sigma_m
    z, v, ratio = error_m / sigma, (error_m - shape.least_m) / sigma, sigma / shape.mean_m
    u = v - ratio
    scaled = erfcx(np.minimum(u, FARTHEST) / -ROOT_2)
    hazard = (2 / ROOT_2PI) / scaled
    inside = 1 - shape.outlier_share
    core = np.exp(-0.5 * z * z) * (inside * (1 - shape.tail_share)) / (sigma * ROOT_2PI)
    near = 0.5 * np.exp(-0.5 * v * v) * scaled
    tail = np.where(u < 5, near, np.exp(np.minimum(ratio * (0.5 * ratio - v), 50.0)))
    tail *= inside * shape.tail_share / shape.mean_m
    total = core + tail + shape.outlier_share * shape.outlier_density
    core /= total
    tail /= total
    spread = np.maximum(1 - u * hazard - hazard * hazard, 0.0)
    return Expected(core=core, tail=tail, noise_m=sigma * (ratio - hazard), noise_var=spread, log_density=np.log(total))
