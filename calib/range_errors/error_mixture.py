"""What range errors are made of: a Gaussian core, a tail of reflections on the long side, and outliers.

An error is noise with probability 1 - t - s; noise plus an exponential detour with probability t; and anything
within reach with probability s. Expectation-maximisation (Dempster, Laird, Rubin 1977) on counts over a grid of
errors and bins of power, so its cost does not grow with the number of ranges.

It has one kind of detour, where the likelihood by pair has two (`calib.range_errors.densities.LongDetours`): without a
least detour the shorter of two kinds takes ranges from the core, whose standard deviation is then 3 % too small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np

from calib.range_errors.densities import densities
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints

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
    of_mixture = (mixture.tail_share, mixture.tail_mean_m, mixture.outlier_share)
    return _expected(error_m, sigma_m, *of_mixture, mixture.outlier_share * outlier_density)


def _expected(
    error_m: Floats, sigma_m: Floats, tail_share: Any, tail_mean_m: Any, outlier_share: Any, strayed: Any
) -> Responsibilities:
    """Return the expectation step, of one mixture or of each along the first axis; `strayed` is outliers' density."""
    found = densities(error_m, sigma_m, 0.0, tail_mean_m)
    core = (1 - tail_share - outlier_share) * found.direct
    tail = tail_share * found.reflected
    total, noise = core + tail + strayed, found.noise_m()
    spread = sigma_m**2 * found.noise_var()
    return Responsibilities(core / total, tail / total, strayed / total, noise, noise**2 + spread, total)


def fit_error_mixture(error_m: Floats, bins: Ints, count: int, near: ErrorMixture | None = None) -> ErrorMixture:
    """Return the mixture behind errors (n,) whose bins (n,) number 0 to `count` - 1; at least 3 errors a bin.

    `near` is a mixture that is near the truth already, if there is one.
    """
    return _maximise([_counted(error_m, bins, count)], near)[0]


def fit_error_mixtures(groups: Sequence[Floats]) -> list[ErrorMixture]:
    """Return the mixture behind each group of errors (n,), of one bin: all at once, in a fifth of the time."""
    return _maximise([_counted(one, np.zeros(len(one), dtype=np.int64), 1) for one in groups]) if groups else []


@dataclass(frozen=True, slots=True)
class _Counts:
    """Errors of some fits counted: `counts` (fits, bins, cells) about `middle` (fits, 1, cells), `beyond` (fits,) all.

    `spread` (fits,) is what cells and steps are measured in, `density` (fits,) that of outliers.
    """

    middle: Floats
    counts: Floats
    beyond: Floats
    spread: Floats
    density: Floats

    def some(self, which: Any) -> _Counts:
        """Return those of some fits."""
        return _Counts(*(getattr(self, field.name)[which] for field in fields(self)))

    def total(self) -> Floats:
        """Return how many errors each fit has."""
        return _sum(self.counts) + self.beyond


@dataclass(frozen=True, slots=True)
class _Mixtures:
    """Mixtures of some fits: `sigma_m` (fits, bins), all others (fits,)."""

    location_m: Floats
    sigma_m: Floats
    tail_share: Floats
    tail_mean_m: Floats
    outlier_share: Floats

    def some(self, which: Any) -> _Mixtures:
        """Return those of some fits."""
        return _Mixtures(*(getattr(self, field.name)[which] for field in fields(self)))

    def one(self, k: int) -> ErrorMixture:
        """Return that of a fit."""
        shares = (float(v[k]) for v in (self.tail_share, self.tail_mean_m, self.outlier_share))
        return ErrorMixture(float(self.location_m[k]), self.sigma_m[k], *shares)


def _counted(error_m: Floats, bins: Ints, count: int) -> _Counts:
    """Return the errors of one fit counted on a grid about their median."""
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
    counts = flat.reshape(1, count, len(middle))
    span = max(float(edges[-1]), float(error_m.max())) - min(float(edges[0]), float(error_m.min()))
    return _Counts(middle[None, None, :], counts, *(np.array([v], dtype=float) for v in (beyond, spread, 1 / span)))


def _maximise(grids: Sequence[_Counts], near: ErrorMixture | None = None) -> list[ErrorMixture]:
    """Iterate to the likeliest mixture behind the counts of each fit, of all that have not settled at once."""
    left = _Counts(*(np.concatenate([getattr(grid, field.name) for grid in grids]) for field in fields(_Counts)))
    now = _start(left) if near is None else _begun(near)
    found: dict[int, ErrorMixture] = {}
    number = np.arange(len(grids))
    for _ in range(ITERATIONS):
        now, still = _stepped(now, left)
        if still.any():
            found |= {int(number[k]): now.one(int(k)) for k in np.flatnonzero(still)}
            number, now, left = number[~still], now.some(~still), left.some(~still)
        if not len(number):
            break
    found |= {int(n): now.one(k) for k, n in enumerate(number)}
    return [found[k] for k in range(len(grids))]


def _start(left: _Counts) -> _Mixtures:
    """Return where to begin: at the mean of what was counted, with a tenth of it reflected."""
    mean = _sum(left.counts.sum(axis=1) * left.middle[:, 0]) / _sum(left.counts)
    fits, bins, cells = left.counts.shape
    same = np.ones(fits)
    location = np.minimum(mean, left.middle[:, 0, cells // 4])
    return _Mixtures(location, np.repeat(left.spread[:, None], bins, axis=1), 0.1 * same, 4 * left.spread, 0.001 * same)


def _begun(near: ErrorMixture) -> _Mixtures:
    return _Mixtures(
        np.array([near.location_m]),
        near.sigma_m[None, :],
        np.array([near.tail_share]),
        np.array([near.tail_mean_m]),
        np.array([near.outlier_share]),
    )


def _stepped(now: _Mixtures, left: _Counts) -> tuple[_Mixtures, Bools]:
    """Return likelier mixtures, and which have settled; errors `beyond` the counts are outliers for certain."""
    sigma = now.sigma_m[:, :, None]
    e = left.middle - _of_cells(now.location_m)
    of_mixture = (now.tail_share, now.tail_mean_m, now.outlier_share, now.outlier_share * left.density)
    x = _expected(e, sigma, *map(_of_cells, of_mixture))
    core, tail = left.counts * x.core, left.counts * x.tail
    # The rest after the detour is taken off is the noise, whose mean says where the core is.
    precision = 1 / sigma**2
    moved = _sum((core * e + tail * x.noise) * precision) / _sum((core + tail) * precision)
    m = _of_cells(moved)
    square = np.sum(core * (e - m) ** 2 + tail * (x.noise_square - 2 * m * x.noise + m**2), axis=2)
    mass = np.maximum(np.sum(core + tail, axis=2), 1e-9)
    cell = left.spread[:, None] / CELLS_A_SIGMA
    width = np.sqrt(np.maximum(square / mass - cell**2 / 12, (0.1 * cell) ** 2))
    tail_sum, total = _sum(tail), left.total()
    updated = _Mixtures(
        now.location_m + moved,
        width,
        tail_sum / total,
        np.maximum(
            _sum(tail * (e - x.noise)) / np.maximum(tail_sum, 1e-9),
            SHORTEST_TAIL * np.sort(width, axis=1)[:, width.shape[1] // 2],
        ),
        np.maximum((_sum(left.counts * x.outlier) + left.beyond) / total, 1e-6),
    )
    close = np.all(np.abs(width - now.sigma_m) < 2 * SETTLED * left.spread[:, None], axis=1)
    return updated, np.asarray((np.abs(moved) < SETTLED * left.spread) & close)


def _of_cells(values: Floats) -> Floats:
    """Return values of fits (fits,) so that they go with cells (fits, bins, cells)."""
    return values[:, None, None]


def _sum(values: Floats) -> Floats:
    """Return the sums (fits,) over all that fits have."""
    return np.asarray(values.reshape(len(values), -1).sum(axis=1))
