"""Delays and curve by maximum likelihood under the mixture of core, tail and stray (`calib.mixture`).

Where a robust loss only bounds what the tail of reflections does, the mixture knows that the tail is on one side, and
takes from each range the detour that it expects in it. Expectation-maximisation around a robust fit: the parts are
estimated from the residuals, the parameters from the residuals less the expected detours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.mixture import Expected, Makeup, expect, take_apart

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ROUNDS: Final = 12
STEPS_A_ROUND: Final = 4
STILL_M: Final = 1e-6


@dataclass(frozen=True, slots=True)
class MixtureFit:
    """The likeliest parameters (m,), their covariance (m, m), the make-up of the residuals, and how it ended."""

    parameters: Floats
    covariance: Floats
    makeup: Makeup
    steps: int
    success: bool


def refine(matrix: Floats, error: Floats, start: Floats, ridge: Floats, bins: Ints) -> MixtureFit:
    """Improve parameters x of residuals `error + matrix @ x` (n,), metres, from a robust `start`.

    `ridge` (m, m) is a penalty in the unit of counts, as for `robust_fit`; `bins` (n,) number the bins of power. The
    covariance is the inverse of the sum of squared scores (Berndt, Hall, Hall, Hausman 1974).
    """
    x, count = start.copy(), int(bins.max()) + 1
    span = float(np.ptp(error)) + 1e-9
    steps, moved = 0, np.inf
    reach = np.abs(matrix).max(axis=0)
    for _ in range(ROUNDS):
        makeup = take_apart(error + matrix @ x, bins, count)
        sigma = makeup.sigma_m[bins]
        scale = float(np.median(makeup.sigma_m)) ** 2
        begin = x
        for _ in range(STEPS_A_ROUND):
            residual = error + matrix @ x - makeup.location_m
            found = expect(residual, sigma, makeup, 1 / span)
            noise, weight = _noise(residual, found, sigma)
            # The penalty counts ranges; here they are weighed by their precision.
            normal = (matrix * weight[:, None]).T @ matrix + ridge / scale
            step = np.linalg.lstsq(normal, -(matrix.T @ (weight * noise)) - ridge @ x / scale, rcond=1e-13)[0]
            x = x + step
            steps += 1
        moved = float(np.max(reach * np.abs(x - begin)))
        if moved < STILL_M:
            break
    makeup = take_apart(error + matrix @ x, bins, count)
    residual = error + matrix @ x - makeup.location_m
    sigma = makeup.sigma_m[bins]
    noise, weight = _noise(residual, expect(residual, sigma, makeup, 1 / span), sigma)
    score = matrix * (weight * noise)[:, None]
    scale = float(np.median(makeup.sigma_m)) ** 2
    covariance = np.linalg.pinv(score.T @ score + ridge / scale, rcond=1e-12)
    return MixtureFit(x, np.asarray(covariance), makeup, steps, moved < 100 * STILL_M)


def _noise(residual: Floats, found: Expected, sigma: Floats) -> tuple[Floats, Floats]:
    """Return the noise expected in each residual, and its weight: the share that is not stray, over the variance."""
    share = np.maximum(found.core + found.tail, 1e-12)
    noise = (found.core * residual + found.tail * found.noise) / share
    return noise, share / sigma**2
