"""Where the likelihood by pair is climbed from, and what is known beforehand, variances between pairs included."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.estimation.mixture_slopes import Errors, Layout
from calib.long_columns import computed
from calib.spread import robust_spread
from uwblink.arrays import Floats

SPREADS: Final[dict[str, tuple[float, float]]] = {"share": (1e-3, 4.0), "noise": (1e-4, 4.0), "mean": (1e-3, 0.5)}
"""Bounds of the variances between pairs: of log odds, log noise and log mean detour."""

CELL_VARIANCE: Final = 0.5

MEAN_VARIANCE: Final = 1.0

LEAST_VARIANCE: Final = 2.0
"""How far from their guesses the steps of share, the mean detour and the least detour may be, in logarithms squared."""

FIRST: Final = 4.0
SHORTEST: Final = 3.0
"""Mean of the first kind of detour at the start, and the least that it may have, in spreads of the residuals.

With a second kind to explain reflections, the first would otherwise explain a core that is not normal: in a fit without
a curve, whose errors follow power, it moves delays by 0.14 ns where the least mean is 1.8 spreads, and not from 2.5 on.
"""

LONG_ODDS: Final = float(np.log(1 / 3))
LONG_VARIANCE: Final = 1.0
"""Log odds of the second kind of detour, and their variance: two in three between 11 and 48 % of the reflections."""

OUTLIERS: Final = -6.0

OUTLIER_VARIANCE: Final = 9.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """What is known beforehand: precision (D, D) and centre (D,) of the parameters, and variances between pairs."""

    columns: int
    precision: Floats
    centre: Floats
    variances: dict[str, float]
    lasting: float = 1.0

    @property
    def weighed(self) -> Floats:
        """Return the precision (D, D) beside information that counts ranges for independent that are not."""
        return self._times(self.lasting)

    @property
    def pull(self) -> Floats:
        """Return the covariance (D, D) of what the prior pulls with, where it is right."""
        return self._times(self.lasting**2)

    def _times(self, factor: float) -> Floats:
        found = self.precision.copy()
        found[self.columns :, self.columns :] *= factor
        return found


def begin(errors: Errors, start: Floats, ridge: Floats) -> tuple[Layout, Floats, Prior]:
    """Return which parameters there are, first ones, from robust spreads of residuals, and what is known beforehand."""
    fitted = errors.design.times(start)
    residual = computed(len(fitted), lambda rows: errors.error[rows] + fitted[rows])
    spread = _spread(residual)
    layout = Layout(columns=errors.design.shape[1], pairs=errors.pairs, shortest_m=SHORTEST * spread)
    where = layout.slices()
    theta = np.zeros(where["pair_mean"].stop)
    theta[where["design"]] = start
    theta[where["mean"]] = np.log((FIRST - SHORTEST) * spread)
    theta[where["least"]] = np.log(0.5 * spread)
    theta[where["outliers"]] = OUTLIERS
    theta[where["long_share"]] = LONG_ODDS
    cells = errors.parts(errors.place % layout.cells, layout.cells, residual)
    theta[where["cell_noise"]] = np.log([0.9 * _spread(part) for part in cells])
    noise, odds = [], []
    for part in errors.parts(errors.place // layout.cells, layout.pairs, residual):
        noise.append(_spread(part, spread))
        beyond = np.mean(part > 2.5 * noise[-1]) - np.mean(part < -2.5 * noise[-1]) if len(part) else 0.1
        odds.append(np.clip(1.6 * beyond, 0.01, 0.6))
    theta[where["pair_share"]] = np.log(np.array(odds) / (1 - np.array(odds)))
    theta[where["pair_noise"]] = np.log(np.array(noise) / np.median(noise))
    precision, centre = np.zeros((len(theta),) * 2), np.zeros(len(theta))
    precision[where["design"], where["design"]] = ridge
    known = {"mean": MEAN_VARIANCE, "least": LEAST_VARIANCE, "outliers": OUTLIER_VARIANCE, "cell_share": CELL_VARIANCE}
    known["long_share"] = LONG_VARIANCE
    for name, variance in known.items():
        _set(precision, where[name], 1 / variance)
    common = slice(where["mean"].start, where["cell_noise"].start)
    centre[common] = theta[common]
    _set(precision, where["cell_noise"], 1e-6)
    prior = Prior(columns=layout.columns, precision=precision, centre=centre, variances={})
    return layout, theta, between_pairs(theta, prior, layout, None)


def _spread(values: Floats, otherwise: float = 1e-3) -> float:
    if len(values) < 5:
        return otherwise
    return max(robust_spread(values), 1e-3)


def _set(matrix: Floats, where: slice, value: float) -> None:
    matrix[np.arange(where.start, where.stop), np.arange(where.start, where.stop)] = value


def between_pairs(theta: Floats, prior: Prior, layout: Layout, covariance: Floats | None) -> Prior:
    """Return the prior with the variances between pairs that parameters and their covariance suggest."""
    where, variances = layout.slices(), dict(prior.variances)
    precision, centre = prior.precision.copy(), prior.centre.copy()
    centre[where["pair_share"]] = theta[where["pair_share"]].mean()
    for name, (low, high) in SPREADS.items():
        rows = where[f"pair_{name}"]
        square = float(np.sum((theta[rows] - centre[rows]) ** 2))
        used = float(layout.pairs)
        if covariance is not None:
            used = max(used - prior.lasting * float(np.trace(covariance[rows, rows])) / variances[name], 1e-2 * used)
        else:
            square = max(square, 0.05 * used)
        variances[name] = min(max(square / used, low), high)
        _set(precision, rows, 1 / variances[name])
    return replace(prior, precision=precision, centre=centre, variances=variances)
