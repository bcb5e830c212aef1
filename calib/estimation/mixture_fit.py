"""Delays and curve by maximum likelihood under the mixture of core, tail and outliers of `error_mixture`.

Where a robust loss only bounds what the tail of reflections does, the mixture knows that the tail is on one side, and
takes from each range the detour that it expects in it. Expectation-maximisation around a robust fit: the parts are
estimated from the residuals, the parameters from the residuals less the expected detours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.estimation.error_mixture import ErrorMixture, e_step, fit_error_mixture
from calib.estimation.robust import summed_squares
from uwblink.arrays import Floats, Ints

ROUNDS: Final = 20
STEPS_A_ROUND: Final = 2
STILL_M: Final = 1e-6


@dataclass(frozen=True, slots=True)
class MixtureFit:
    """The likeliest parameters (m,), their covariance (m, m), the make-up of the residuals, and how it ended."""

    parameters: Floats
    covariance: Floats
    mixture: ErrorMixture
    steps: int
    success: bool


def refine(
    matrix: Floats, error: Floats, start: Floats, ridge: Floats, bins: Ints, blocks: Ints | None = None
) -> MixtureFit:
    """Improve parameters x of residuals `error + matrix @ x` (n,), metres, from a robust `start`.

    `ridge` (m, m) is the inverse covariance of what is known of x beforehand, in 1/m^2; `bins` (n,) number the bins of
    power, `blocks` (n,) the spans of time within which errors may persist. The covariance is the inverse of the sum of
    squared scores (Berndt, Hall, Hall, Hausman 1974), widened to a sandwich by the scores summed over blocks.
    """
    x, count = start.copy(), int(bins.max()) + 1
    density = 1 / (float(np.ptp(error)) + 1e-9)
    steps, moved = 0, np.inf
    reach = np.abs(matrix).max(axis=0)
    mixture = fit_error_mixture(error + matrix @ x, bins, count)
    for _ in range(ROUNDS):
        begin, precision = x, 1 / mixture.sigma_m[bins] ** 2
        # Fisher's scoring: the information of a range is its precision times a share that all have in common, so one
        # matrix serves all steps of a round.
        information = _weighted_square(matrix, precision)
        for _ in range(STEPS_A_ROUND):
            score = _score(error + matrix @ x, bins, mixture, density)
            share = float(np.sum(score**2) / np.sum(precision))
            x = x + np.linalg.lstsq(share * information + ridge, -(matrix.T @ score) - ridge @ x, rcond=1e-13)[0]
            steps += 1
        moved = float(np.max(reach * np.abs(x - begin)))
        mixture = fit_error_mixture(error + matrix @ x, bins, count, mixture)
        if moved < STILL_M:
            break
    score = _score(error + matrix @ x, bins, mixture, density)
    bread = np.linalg.pinv(summed_squares(matrix, score, None) + ridge, rcond=1e-12)
    covariance = bread @ (summed_squares(matrix, score, blocks) + ridge) @ bread
    return MixtureFit(x, np.asarray(covariance), mixture, steps, moved < 100 * STILL_M)


def _score(residual: Floats, bins: Ints, mixture: ErrorMixture, density: float) -> Floats:
    """Slope of the log likelihood of each residual: the noise expected in it, by its share in the core and the tail."""
    sigma = mixture.sigma_m[bins]
    centred = residual - mixture.location_m
    found = e_step(centred, sigma, mixture, density)
    return np.asarray((found.core * centred + found.tail * found.noise) / sigma**2)


def _weighted_square(matrix: Floats, weight: Floats) -> Floats:
    return summed_squares(matrix, np.sqrt(weight), None)
