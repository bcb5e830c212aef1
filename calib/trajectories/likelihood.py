"""What the errors of ranges are made of, for a search over trajectories: the mixture of `calib.estimation`, held."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from calib.estimation.mixture_slopes import Errors
from calib.estimation.pair_mixture import PairMixture, fit_pair_mixture
from calib.estimation.problem import CELLS, Problem
from calib.estimation.reflections import Shape
from calib.trajectories.range_losses import Reflecting
from uwblink.arrays import Floats

OUTLIERS_OVER_M: Final = 10.0


def mixture_of(problem: Problem, error_m: Floats, start: Floats, ridge: Floats) -> PairMixture:
    """Fit what errors (n,) of ranges against given distances are made of, with delays and curve from `start` (m,)."""
    pairs = problem.pairs
    errors = Errors.of(error_m, problem.design, pairs.number * CELLS + problem.cell, len(pairs.ends))
    return fit_pair_mixture(replace(errors, density=1 / OUTLIERS_OVER_M), start, ridge)


def loss_of(mixture: PairMixture) -> Reflecting:
    """Return the mixture as a loss of residuals, with everything but the residuals as it was found."""
    place = mixture.scores.places_given()
    sigma = np.exp(mixture.of("pair_noise")[:, None] + mixture.of("cell_noise")).ravel()
    share = 1 / (1 + np.exp(-mixture.of("pair_share")[:, None] - mixture.of("cell_share"))).ravel()
    return Reflecting(
        Shape(
            sigma_m=sigma[place],
            tail_share=share[place],
            mean_m=(mixture.mean_m * np.exp(mixture.of("pair_mean"))).repeat(CELLS)[place],
            least_m=float(np.exp(mixture.of("least")[0])),
            outlier_share=float(1 / (1 + np.exp(-mixture.of("outliers")[0]))),
            outlier_density=1 / OUTLIERS_OVER_M,
            long=mixture.long,
        )
    )
