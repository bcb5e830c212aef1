"""The one model of a range's error: direct with normal noise, reflected by a detour besides, or an outlier.

With noise sigma, a share of reflections, a least detour and an exponential one of one of two kinds beyond it, and
outliers that are anywhere in a room. Four of its numbers differ between ranges (location, noise, share, detour), three
are common (least detour, outliers, share of the second kind); the likelihood has a slope by each of the seven.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.range_errors.densities import LONG_FACTOR, LongDetours, densities
from uwblink.arrays import Floats

OUTLIERS_OVER_M = 10.0
"""Smallest span of outliers, that of a room: with a smaller span they would be taken for long detours."""


@dataclass(frozen=True, slots=True)
class ErrorSlopes:
    """Log densities of errors (n,), and their slopes (n,) by each parameter's logarithm or log odds.

    `residual` is the slope by the error itself, 1/m; `reflected` is the probability that a range was reflected,
    `inlier` that it is no outlier.
    """

    log_density: Floats
    by: dict[str, Floats]
    reflected: Floats
    inlier: Floats


def error_slopes(residual: Floats, parameters: dict[str, Floats], *, span_m: float) -> ErrorSlopes:
    """Return the log density of errors (n,) in metres and its slopes.

    `parameters` are "noise" (log sigma), "odds" (log odds of a reflection), "detour" (log of the first kind's
    mean), "least" (log of the least detour), "outliers" and "long" (log odds), arrays (n,) or (1,).
    Outliers have the density 1/`span_m`.
    """
    sigma = np.exp(parameters["noise"])
    share = _share(parameters["odds"])
    detour = np.exp(parameters["detour"])
    least, wild, long_share = np.exp(parameters["least"]), _share(parameters["outliers"]), _share(parameters["long"])
    long = LongDetours(share=float(long_share[0]), factor=LONG_FACTOR)
    found = densities(residual, sigma, float(least[0]), long.mean * detour, long)
    inside = 1 - float(wild[0])
    core, tail = inside * (1 - share) * found.direct, inside * share
    total = core + tail * found.reflected + float(wild[0]) / span_m
    core, tail = core / total, tail / total
    tails = [tail * kind.density for kind in found.kinds]
    reflected = tails[0] + tails[1]
    z, inverse = residual / sigma, 1 / sigma
    noise, mean, tail_noise = core * (z * z - 1), np.zeros_like(z), np.zeros_like(z)
    beyond = residual - least
    for part, kind in zip(tails, found.kinds, strict=True):
        own = kind.noise_m * inverse
        tail_noise += part * own
        noise += part * (own * own + kind.noise_var - 1)
        mean += part * ((beyond - kind.noise_m) / kind.detour_m - 1)
    both = core + reflected
    return ErrorSlopes(
        log_density=np.log(total),
        by={
            "residual": -(core * z + tail_noise) * inverse,
            "noise": noise,
            "odds": reflected - share * both,
            "detour": mean,
            "least": tail_noise * inverse * least,
            "outliers": inside - both,
            "long": tails[1] - long_share * reflected,
        },
        reflected=reflected,
        inlier=both,
    )


def _share(log_odds: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-log_odds)))
