"""What range errors are made of: a Gaussian core, a tail of reflections on the long side, and outliers.

An error is noise with probability 1 - t - s; noise plus an exponential detour with probability t; and anything
within reach with probability s. Expectation-maximisation (Dempster, Laird, Rubin 1977) on counts over a grid of
errors and bins of power, so its cost does not grow with the number of ranges.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.densities import densities
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints

CELLS_A_SIGMA: Final = 5
REACH_BELOW: Final = 8.0
REACH_ABOVE: Final = 24.0
"""How far the grid reaches around the median, in robust spreads; what lies beyond are outliers."""

SHORTEST_TAIL: Final = 2.0
"""A mean detour below this many sigmas cannot be told from noise."""

ROWS_AT_ONCE: Final = 131_072
"""Errors that are counted together, so that what leads to counts stays small."""

ITERATIONS: Final = 400
SETTLED: Final = 1e-4


@dataclass(frozen=True, slots=True)
class ErrorMixture:
    """The parts of a set of errors: metres, and shares of 1.

    `location_m` is the centre of the core, `sigma_m` (bins,) its standard deviation in each bin,
    `tail_mean_m` the mean detour of the `tail_share`, `outlier_share` what fits neither.
    """

    location_m: float
    sigma_m: Floats
    tail_share: float
    tail_mean_m: float
    outlier_share: float


@dataclass(frozen=True, slots=True)
class Responsibilities:
    """What an error of known size leads to expect, each shaped as the error.

    Shares of the core, the tail and the outliers; mean and mean square of the noise if in the tail.
    """

    core: Floats
    tail: Floats
    outlier: Floats
    noise: Floats
    noise_square: Floats
    density: Floats


def e_step(error_m: Floats, sigma_m: Floats, mixture: ErrorMixture, outlier_density: float) -> Responsibilities:
    """Return the expectation step at errors measured from the core's centre."""
    found = densities(error_m, sigma_m, 0.0, mixture.tail_mean_m)
    core = (1 - mixture.tail_share - mixture.outlier_share) * found.direct
    tail = mixture.tail_share * found.reflected
    outlier = np.full_like(core, mixture.outlier_share * outlier_density)
    total, noise = core + tail + outlier, found.noise_m()
    spread = sigma_m**2 * found.noise_var()
    return Responsibilities(core / total, tail / total, outlier / total, noise, noise**2 + spread, total)


def fit_error_mixture(error_m: Floats, bins: Ints, count: int, near: ErrorMixture | None = None) -> ErrorMixture:
    """Return the mixture behind errors (n,) whose bins (n,) number 0 to `count` - 1; at least 3 errors a bin.

    `near` is a mixture that is near the truth already, if there is one.
    """
    median = float(np.median(error_m))
    spread = max(robust_spread(error_m), 1e-9)
    edges = np.arange(-REACH_BELOW, REACH_ABOVE, 1 / CELLS_A_SIGMA) * spread + median
    middle = (edges[1:] + edges[:-1]) / 2
    flat, beyond = np.zeros(count * len(middle)), 0
    for begin in range(0, len(error_m), ROWS_AT_ONCE):
        rows = slice(begin, begin + ROWS_AT_ONCE)
        cell = np.floor((error_m[rows] - edges[0]) * (CELLS_A_SIGMA / spread)).astype(np.int64)
        inside = (cell >= 0) & (cell < len(middle))
        flat += np.bincount(bins[rows][inside] * len(middle) + cell[inside], minlength=len(flat))
        beyond += int(np.count_nonzero(~inside))
    counts = flat.reshape(count, len(middle))
    span = max(float(edges[-1]), float(error_m.max())) - min(float(edges[0]), float(error_m.min()))
    return _maximise(middle, counts, float(beyond), spread, 1 / span, near)


def _maximise(
    middle: Floats, counts: Floats, beyond: float, spread: float, density: float, near: ErrorMixture | None
) -> ErrorMixture:
    """Iterate to the likeliest mixture behind counts (bins, cells); `beyond` errors are outliers for certain."""
    total = float(counts.sum()) + beyond
    start = float(np.sum(counts.sum(axis=0) * middle) / counts.sum())
    mixture = near or ErrorMixture(
        min(start, middle[len(middle) // 4]), np.full(len(counts), spread), 0.1, 4 * spread, 0.001
    )
    for _ in range(ITERATIONS):
        sigma = mixture.sigma_m[:, None]
        e = middle[None, :] - mixture.location_m
        x = e_step(e, sigma, mixture, density)
        core, tail = counts * x.core, counts * x.tail
        # The rest after the detour is taken off is the noise, whose mean says where the core is.
        precision = 1 / sigma**2
        moved = np.sum((core * e + tail * x.noise) * precision) / np.sum((core + tail) * precision)
        square = np.sum(core * (e - moved) ** 2 + tail * (x.noise_square - 2 * moved * x.noise + moved**2), axis=1)
        mass = np.maximum(np.sum(core + tail, axis=1), 1e-9)
        cell = spread / CELLS_A_SIGMA
        width = np.sqrt(np.maximum(square / mass - cell**2 / 12, (0.1 * cell) ** 2))
        tail_sum = float(tail.sum())
        tau = float(np.sum(tail * (e - x.noise))) / max(tail_sum, 1e-9)
        updated = ErrorMixture(
            mixture.location_m + float(moved),
            width,
            tail_sum / total,
            max(tau, SHORTEST_TAIL * float(np.sort(width)[len(width) // 2])),
            max((float(np.sum(counts * x.outlier)) + beyond) / total, 1e-6),
        )
        still = abs(float(moved)) < SETTLED * spread and np.all(np.abs(width - mixture.sigma_m) < 2 * SETTLED * spread)
        mixture = updated
        if still:
            break
    return mixture
