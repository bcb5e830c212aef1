"""Curves that do not depend on power, for fits that look for none."""

from __future__ import annotations

import numpy as np

from calib.calibration.power_curves import DEGREE, Curve, flat_curve
from calib.error_mixture import ErrorMixture
from calib.estimation.problem import Problem
from calib.estimation.sigma_curve import SigmaFit, fit_sigma
from uwblink.arrays import Floats


def no_bias(problem: Problem) -> dict[str, Curve]:
    """Return a curve of nothing for every group."""
    return dict.fromkeys(problem.groups, flat_curve(0.0, problem.span))


def sigma_of(problem: Problem, centred_m: Floats, mixture: ErrorMixture) -> SigmaFit:
    """Return the curve of standard deviation: by power where every range has one and they vary, else one value.

    `centred_m` (n,) are errors about the centre of the core, `mixture` their parts in the problem's bins.
    """
    if problem.powered.all() and not problem.unknowns.constant_power:
        return fit_sigma(problem, centred_m, mixture)
    counts = problem.bins.count
    value = float(np.sqrt(np.average(mixture.sigma_m**2, weights=counts)))
    variance = value**2 / (2 * float(counts.sum()))
    curve = flat_curve(value, problem.span)
    return SigmaFit(dict.fromkeys(problem.groups, curve), np.full((DEGREE + 1,) * 2, variance))
