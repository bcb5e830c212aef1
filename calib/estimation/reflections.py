"""How likely an error is where a range may be reflected: Gaussian core, tail of detours on the long side, outliers.

A detour is a least one plus an exponential one. With the least near zero that is an exponential tail, else a hump
beside the core, as a single wall makes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.densities import densities
from uwblink.arrays import Floats


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
    """Return the expectation step."""
    found = densities(error_m, shape.sigma_m, shape.least_m, shape.mean_m)
    inside = 1 - shape.outlier_share
    tail = inside * shape.tail_share
    core = (inside - tail) * found.direct
    tail = tail * found.reflected
    total = core + tail + shape.outlier_share * shape.outlier_density
    core /= total
    tail /= total
    return Expected(
        core=core, tail=tail, noise_m=found.noise_m(), noise_var=found.noise_var(), log_density=np.log(total)
    )
