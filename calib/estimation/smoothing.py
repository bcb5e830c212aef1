"""How smooth a curve should be, as the data say.

A penalty on curvature is a statement about how much a curve may bend. Its weight is estimated along with the curve by
restricted maximum likelihood, with the fixed point of Fellner and Schall as generalised by Wood and Fasiolo (Biometrics
2017): weight = dispersion (rank/weight - tr(V S)) / (b' S b) times the weight. The loss enters as the quadratic that it
looks like near the optimum (`calib.estimation.robust.quadratic_model`), so a robust loss gives a robust choice.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from calib.estimation.robust import QuadraticModel
from uwblink.arrays import Floats

FIRST: Final = 1e-6
"""Where the iteration begins: the penalty's trace over the data's."""

ITERATIONS: Final = 100
SETTLED: Final = 1e-3
RANGE: Final = (1e-9, 1e9)
"""Bounds of a weight, in dispersions over one square metre of squared curvature."""

HOLD: Final = 1e-9
"""Holds what neither data nor penalty determine (a constant of the curve, an empty stretch of power) at zero."""


def reml_penalty(near: QuadraticModel, x: Floats, penalties: list[Floats]) -> tuple[Floats, Floats]:
    """Return the weighted sum of `penalties` (m, m) that the data ask for, plus the hold, and the optimum under it.

    `near` is the loss near parameters x (m,). Without penalties there is nothing to weigh, and x is left as it is.
    """
    if not penalties:
        return np.zeros((len(x),) * 2), x
    hold = HOLD * float(np.trace(near.curvature)) / len(x) * np.any(np.sum(penalties, axis=0) != 0, axis=1)
    aim = near.curvature @ x + near.pull
    ranks = [int(np.linalg.matrix_rank(penalty)) for penalty in penalties]
    weights = [FIRST * float(np.trace(near.curvature)) / max(float(np.trace(p)), 1e-300) for p in penalties]
    for _ in range(ITERATIONS):
        ridge = _sum(weights, penalties) + np.diag(hold)
        inverse = np.linalg.pinv(near.curvature + ridge, rcond=1e-13)
        best = inverse @ aim
        before = list(weights)
        for k, (penalty, rank) in enumerate(zip(penalties, ranks, strict=True)):
            used = max(rank - weights[k] * float(np.sum(inverse * penalty)), 1e-6)
            bend = max(float(best @ penalty @ best), 1e-300)
            # Ranges without any error have no dispersion; a weight stays positive, so that its change can be told.
            weights[k] = max(near.dispersion * min(max(used / bend, RANGE[0]), RANGE[1]), 1e-300)
        if all(abs(np.log(w / b)) < SETTLED for w, b in zip(weights, before, strict=True)):
            break
    ridge = _sum(weights, penalties) + np.diag(hold)
    return ridge, np.asarray(np.linalg.pinv(near.curvature + ridge, rcond=1e-13) @ aim)


def unsure(covariance: Floats, x: Floats, penalties: list[Floats]) -> Floats:
    """Return the covariance (m, m) that not knowing the smoothness adds to that of parameters x (m,).

    `penalties` (m, m) are weighted, as parts of the inverse of `covariance` (m, m). A penalty pulls the parameters by
    covariance times penalty times x for each unit of its logarithm, which is known to 2 over what it leaves free, as a
    variance of so many values is (the first-order correction of Kass and Steffey 1989).
    """
    found = np.zeros_like(covariance)
    for penalty in penalties:
        pull = covariance @ (penalty @ x)
        free = int(np.linalg.matrix_rank(penalty, hermitian=True)) - float(np.sum(covariance * penalty))
        found += np.outer(pull, pull) * (2 / max(free, 1.0))
    return found


def _sum(weights: list[float], penalties: list[Floats]) -> Floats:
    return np.asarray(sum(w * p for w, p in zip(weights, penalties, strict=True)))
