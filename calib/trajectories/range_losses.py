"""How unlikely residuals of ranges are: Cauchy's loss for the way there, the likelihood of reflections at the end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from calib.estimation.reflections import Shape, expected
from uwblink.arrays import Floats

LEAST_CURVED: Final = 0.2
"""Share of the weight of reweighted least squares below which a curvature is not taken: a hill has none to descend."""

REFLECTED: Final = 0.3
"""How much of the weight of a direct range a reflected one has: an exponential detour has little to say."""


class RangeLoss(Protocol):
    """What a search minimises over residuals (n,)."""

    def cost(self, residual: Floats) -> float:
        """Return the negative log likelihood, but for a constant."""

    def slopes(self, residual: Floats) -> tuple[Floats, Floats]:
        """Return its slope (n,) by each residual, 1/m, and a positive curvature (n,), 1/m^2, near its own."""

    def known(self, residual: Floats) -> float:
        """Return what a range says of its residual on average, 1/m^2."""


@dataclass(frozen=True, slots=True)
class Cauchy:
    """log(1 + (r / scale)^2): Cauchy's likelihood."""

    scale_m: float

    def cost(self, residual: Floats) -> float:
        """Return the sum over all residuals."""
        return float(np.sum(np.log1p((residual / self.scale_m) ** 2)))

    def slopes(self, residual: Floats) -> tuple[Floats, Floats]:
        """Return slopes and curvatures."""
        u = residual / self.scale_m
        weight = 2 / self.scale_m**2 / (1 + u**2)
        return weight * residual, np.maximum(weight * (1 - u**2) / (1 + u**2), LEAST_CURVED * weight)

    def known(self, residual: Floats) -> float:
        """Return the mean curvature."""
        u = residual / self.scale_m
        weight = 2 / self.scale_m**2 / (1 + u**2)
        return float(max(np.mean(weight * (1 - u**2) / (1 + u**2)), LEAST_CURVED * np.mean(weight)))


@dataclass(frozen=True, slots=True)
class Reflecting:
    """A core of noise, a one-sided tail of reflections, and outliers, as `shape` has them for each range (n,)."""

    shape: Shape

    def cost(self, residual: Floats) -> float:
        """Return the sum over all residuals."""
        return -float(np.sum(expected(residual, self.shape).log_density))

    def slopes(self, residual: Floats) -> tuple[Floats, Floats]:
        """Return slopes and curvatures."""
        found, sigma = expected(residual, self.shape), self.shape.sigma_m
        slope = (found.core * residual + found.tail_noise_m) / sigma**2
        return slope, (found.core + REFLECTED * found.tail) / sigma**2 + 1e-6

    def known(self, residual: Floats) -> float:
        """Return the mean squared slope."""
        return float(np.mean(self.slopes(residual)[0] ** 2))
