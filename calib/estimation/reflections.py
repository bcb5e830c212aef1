"""How likely an error is where a range may be reflected: Gaussian core, tail of detours on the long side, outliers.

A detour is a least one plus an exponential one, which is of one of two kinds. With the least near zero that is an
exponential tail, else a hump beside the core, as a single wall makes it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.densities import ONE_KIND, Kind, LongDetours, densities
from uwblink.arrays import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """What each range's error is made of, metres and shares of 1; arrays (n,) or numbers for all.

    A range is reflected with `tail_share`, by `least_m` and an exponential detour, whose mean over both kinds is
    `mean_m`; `outlier_share` are anywhere, with the density `outlier_density`.
    """

    sigma_m: Floats
    tail_share: Floats
    mean_m: Floats
    least_m: float
    outlier_share: float
    outlier_density: float
    long: LongDetours = ONE_KIND


@dataclass(frozen=True, slots=True, kw_only=True)
class Expected:
    """What errors (n,) lead to expect: shares of core and tail, the noise in reflected ranges, and the log density.

    `tails` are the shares of each of the `kinds` of detour, `tail` is their sum; `tail_noise_m` is the mean noise of
    reflected ranges times their share.
    """

    core: Floats
    tail: Floats
    tails: tuple[Floats, ...]
    kinds: tuple[Kind, ...]
    tail_noise_m: Floats
    log_density: Floats


def expected(error_m: Floats, shape: Shape) -> Expected:
    """Return the expectation step."""
    found = densities(error_m, shape.sigma_m, shape.least_m, shape.mean_m, shape.long)
    inside = 1 - shape.outlier_share
    tail = inside * shape.tail_share
    core = (inside - tail) * found.direct
    total = core + tail * found.reflected + shape.outlier_share * shape.outlier_density
    core /= total
    tail = tail / total
    tails = tuple(tail * kind.density for kind in found.kinds)
    noise = tails[0] * found.kinds[0].noise_m
    for share, kind in zip(tails[1:], found.kinds[1:], strict=True):
        noise += share * kind.noise_m
    return Expected(
        core=core,
        tail=tail * found.reflected,
        tails=tails,
        kinds=found.kinds,
        tail_noise_m=noise,
        log_density=np.log(total),
    )
