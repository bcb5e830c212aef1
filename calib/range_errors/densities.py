"""The one model of a range's error: direct with normal noise, reflected by a detour besides, or an outlier.

A detour is a least one plus an exponential one of one of two kinds with different means; outliers are anywhere in a
room. Four of the numbers differ between ranges (location, noise, share, detour), three are common (least detour,
outliers, share of the second kind); the likelihood has a slope by each of the seven.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.special import erfcx, expit

from uwblink.arrays import Floats

ROOT_2PI: Final = float(np.sqrt(2 * np.pi))
LONG_FACTOR: Final = 4.0
"""Mean of the second kind of detour over that of the first, where it is fitted.

It is no parameter: where all detours are of one kind, its slope is zero at 1 for every range, so that nothing would say
how far to step. Where kinds differ by another factor, the least detour, the mean and the share make up for it.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class LongDetours:
    """The second kind of exponential detour: `share` of the reflections, `factor` times as long as the first kind.

    With a share of 0 or a factor of 1 there is one kind.
    """

    share: float = 0.0
    factor: float = 1.0

    @property
    def mean(self) -> float:
        """Return the mean detour of both kinds over that of the first."""
        return 1 - self.share + self.share * self.factor

    @property
    def square(self) -> float:
        """Return the mean square of the detours of both kinds over twice the square of their mean; 1 for one kind."""
        return (1 - self.share + self.share * self.factor**2) / self.mean**2

    @property
    def longest(self) -> float:
        """Return the mean of the longer kind over that of both."""
        return max(self.factor, 1.0) / self.mean if self.share else 1.0

    def kinds(self, detour_m: Floats | float) -> list[tuple[float, Any]]:
        """Return share and mean of each kind, where the mean detour of both is `detour_m`."""
        first = detour_m / self.mean
        if not self.share:
            return [(1.0, first)]
        return [(1 - self.share, first), (self.share, first * self.factor)]


ONE_KIND: Final = LongDetours()


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectionKind:
    """Reflected ranges of one kind: their `density` times the kind's share, 1/m, and the noise in them.

    That noise is normal, cut off above: with v = (e - least)/sigma, `ratio` = sigma/detour and u = v - ratio its mean
    is sigma (ratio - h(u)), and its variance sigma^2 (1 - u h - h^2), where the hazard h is phi/Phi.
    """

    density: Floats
    detour_m: Floats | float
    noise_m: Floats
    noise_var: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Densities:
    """Densities of errors (n,), in 1/m, were they `direct` or `reflected`, and the reflected ones of each kind."""

    direct: Floats
    reflected: Floats
    sigma_m: Floats
    kinds: tuple[ReflectionKind, ...]

    def noise_m(self) -> Floats:
        """Return the mean of the noise in reflected ranges."""
        first, *others = self.kinds
        return first.noise_m + sum(self._part(kind) * (kind.noise_m - first.noise_m) for kind in others)

    def noise_var(self) -> Floats:
        """Return the variance of the noise in reflected ranges, in sigmas squared."""
        first, *others = self.kinds
        found = first.noise_var
        for kind in others:
            part, apart = self._part(kind), (kind.noise_m - first.noise_m) / self.sigma_m
            found = found + part * (kind.noise_var - first.noise_var + (1 - part) * apart * apart)
        return found

    def _part(self, kind: ReflectionKind) -> Floats:
        """Return the probability that a reflected range is of a kind, 0 where both densities vanish."""
        return np.asarray(kind.density / (self.reflected + np.finfo(float).tiny))


def densities(
    error_m: Floats, sigma_m: Floats, least_m: float, detour_m: Floats | float, long: LongDetours = ONE_KIND
) -> Densities:
    """Return the densities of errors (n,) under noise `sigma_m`, a least detour and exponential ones of such a mean.

    That of a kind is exp(-v^2/2) erfcx(-u/sqrt 2) / (2 detour), which does not cancel; where it overflows, far beyond
    the noise, it is the exponential's own.
    """
    inverse = 1 / sigma_m
    z, v = error_m * inverse, (error_m - least_m) * inverse
    normal = np.exp(-0.5 * v * v)
    kinds = tuple(_kind(v, normal, sigma_m, share, mean_m) for share, mean_m in long.kinds(detour_m))
    reflected = kinds[0].density if len(kinds) == 1 else kinds[0].density + kinds[1].density
    return Densities(
        direct=np.exp(-0.5 * z * z) * (inverse / ROOT_2PI), reflected=reflected, sigma_m=sigma_m, kinds=kinds
    )


def _kind(v: Floats, normal: Floats, sigma_m: Floats, share: float, detour_m: Any) -> ReflectionKind:
    """Return reflected ranges of a kind at errors `v` (n,) beyond the least detour, in sigmas."""
    ratio = sigma_m / detour_m
    u = v - ratio
    # Thirty sigmas beyond the least detour erfcx overflows, and the noise in a detour no longer depends on the error.
    near = np.minimum(u, 30.0)
    scaled = erfcx(near * (-1 / math.sqrt(2.0)))
    density = normal * scaled * (0.5 * share / detour_m)
    if np.any(near < u):
        far = np.exp(np.minimum(ratio * (0.5 * ratio - v), 50.0)) * (share / detour_m)
        density = np.where(near < u, far, density)
    hazard = (2 / ROOT_2PI) / scaled
    return ReflectionKind(
        density=density,
        detour_m=detour_m,
        noise_m=np.asarray(sigma_m * (ratio - hazard)),
        noise_var=np.maximum(1 - hazard * (u + hazard), 0.0),
    )


OUTLIERS_OVER_M: Final = 10.0
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


def error_slopes(residual: Floats, parameters: dict[str, Floats]) -> ErrorSlopes:
    """Return the log density of errors (n,) in metres and its slopes.

    `parameters` are "noise" (log sigma), "odds" (log odds of a reflection), "detour" (log of the mean
    exponential one), "least" (log of the least detour), "outliers" and "long" (log odds), arrays (n,) or (1,).
    Outliers have the density 1/`OUTLIERS_OVER_M`. With "side" reflections lengthen only a share of the errors, of which
    these are the log odds, and shorten the others: those of differences of times of arrival.
    """
    sigma = np.exp(parameters["noise"])
    share = expit(parameters["odds"])
    detour = np.exp(parameters["detour"])
    least, outlying, long_share = np.exp(parameters["least"]), expit(parameters["outliers"]), expit(parameters["long"])
    late = float(expit(parameters["side"][0])) if "side" in parameters else 1.0
    long = LongDetours(share=float(long_share[0]), factor=LONG_FACTOR)
    sides = [(1.0, late), (-1.0, 1 - late)][: 1 + ("side" in parameters)]
    found = [densities(sign * residual, sigma, float(least[0]), detour, long) for sign, _ in sides]
    inside = 1 - float(outlying[0])
    core, tail = inside * (1 - share) * found[0].direct, inside * share
    likely = np.sum([own * one.reflected for one, (_, own) in zip(found, sides, strict=True)], axis=0)
    total = core + tail * likely + float(outlying[0]) / OUTLIERS_OVER_M
    core, tail = core / total, tail / total
    z, inverse = residual / sigma, 1 / sigma
    noise, towards, mean, tail_noise = core * (z * z - 1), core * z, np.zeros_like(z), np.zeros_like(z)
    tails = list[Floats]()
    for one, (sign, own_share) in zip(found, sides, strict=True):
        beyond, whole = sign * residual - least, own_share * tail
        for kind in one.kinds:
            part, own = whole * kind.density, kind.noise_m * inverse
            moved = part * own
            tail_noise += moved
            towards += sign * moved
            noise += part * (own * own + kind.noise_var - 1)
            mean += part * ((beyond - kind.noise_m) / kind.detour_m - 1)
            tails.append(part)
    reflected = np.asarray(sum(tails[1:], tails[0]))
    both = core + reflected
    by = {
        "residual": -towards * inverse,
        "noise": noise,
        "odds": reflected - share * both,
        "detour": mean,
        "least": tail_noise * inverse * least,
        "outliers": inside - both,
        "long": sum(tails[3::2], tails[1]) - long_share * reflected - (1 - 1 / long.mean) * (1 - long_share) * mean,
    }
    if "side" in parameters:
        by["side"] = tails[0] + tails[1] - late * reflected
    return ErrorSlopes(log_density=np.log(total), by=by, reflected=reflected, inlier=both)
