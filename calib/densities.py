"""How likely errors of ranges are, direct and reflected, and what noise is in them: one place for all who weigh them.

A direct range has normal noise, a reflected one a detour besides: a least one, and an exponential one beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.tails import erfcx
from uwblink.arrays import Floats

ROOT_2: Final = float(np.sqrt(2))
ROOT_2PI: Final = float(np.sqrt(2 * np.pi))
FARTHEST: Final = 30.0
"""Sigmas beyond which the noise in a detour no longer depends on the error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Densities:
    """Densities of errors (n,), in 1/m, were they `direct` or `reflected`, and the noise in reflected ones.

    That noise is normal, cut off above: with v = (e - least)/sigma, `ratio` = sigma/detour and `u` = v - ratio its mean
    is sigma (ratio - h(u)), and its variance sigma^2 (1 - u h - h^2), where the `hazard` h is phi/Phi.
    """

    direct: Floats
    reflected: Floats
    sigma_m: Floats
    ratio: Floats
    u: Floats
    hazard: Floats

    def noise_m(self) -> Floats:
        """Return the mean of the noise in reflected ranges."""
        return np.asarray(self.sigma_m * (self.ratio - self.hazard))

    def noise_var(self) -> Floats:
        """Return the variance of the noise in reflected ranges, in sigmas squared."""
        return np.asarray(np.maximum(1 - self.hazard * (self.u + self.hazard), 0.0))


def densities(error_m: Floats, sigma_m: Floats, least_m: float, detour_m: Floats | float) -> Densities:
    """Return the densities of errors (n,) under noise `sigma_m`, a least detour and an exponential one of such a mean.

    That of reflected ones is exp(-v^2/2) erfcx(-u/sqrt 2) / (2 detour), which does not cancel; where it overflows, far
    beyond the noise, it is the exponential's own.
    """
    inverse = 1 / sigma_m
    z, v, ratio = error_m * inverse, (error_m - least_m) * inverse, sigma_m / detour_m
    u = v - ratio
    scaled = erfcx(np.minimum(u, FARTHEST) * (-1 / ROOT_2))
    reflected = np.exp(-0.5 * v * v) * scaled * (0.5 / detour_m)
    far = u > FARTHEST
    if np.any(far):
        reflected = np.where(far, np.exp(np.minimum(ratio * (0.5 * ratio - v), 50.0)) / detour_m, reflected)
    return Densities(
        direct=np.exp(-0.5 * z * z) * (inverse / ROOT_2PI),
        reflected=reflected,
        sigma_m=sigma_m,
        ratio=ratio,
        u=u,
        hazard=(2 / ROOT_2PI) / scaled,
    )
