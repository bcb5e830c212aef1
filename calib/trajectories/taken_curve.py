"""The curve of another calibration in the place of one that is fitted: what it takes off ranges, and leaves unsure."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.power_curves import basis
from calib.errors import BadInputError
from calib.estimation.problem import Problem
from calib.estimation.solver import Solved
from calib.fitting.known_delays import imported
from uwblink.arrays import Floats


def curve_source(curve_from: Calibration | str | os.PathLike[str] | None, other: str) -> Calibration | None:
    """Return the calibration whose curve is taken; raises `BadInputError` for one that has not one curve of all.

    `other` names a parameter of the fit that says otherwise what curves there are, or is empty.
    """
    known = imported(curve_from, "curve_from")
    if known is not None and other:
        raise BadInputError(f"gives the curve of all tags, and does not go with `{other}`", parameter="curve_from")
    if known is not None and (known.groups or known.power_at != "exchange"):
        what = "curves of groups of tags" if known.groups else "a curve of each reception"
        raise BadInputError(f"has {what}, expected one curve of all exchanges", parameter="curve_from")
    return known


def less_curve(problem: Problem, known: Calibration) -> Problem:
    """Return the columns of a fit without the bias that the ranges have by a calibration."""
    return replace(problem, error=problem.error - known.bias_curve(problem.lifted))


def unsure_of_curve(problem: Problem, known: Calibration, found: Solved, informed: Floats) -> Floats:
    """Return what the curve's own covariance adds to that of the delays (tags, tags) in ns^2; nothing is known: 0.

    `informed` (n,) is what each range says of its error, 1/m^2.
    """
    size = len(found.delays)
    if known.uncertainty is None or len(known.uncertainty.bias_m2) != len(known.bias_curve.coefficients):
        return np.zeros((size, size))
    design = found.scores.design.written_out()
    low, high = known.bias_curve.range
    splines = basis(np.clip(problem.lifted, low, high), np.array(known.bias_curve.knots))
    columns = design.shape[1]
    reach = found.delays @ found.inverse[:columns, :columns] @ ((design * informed[:, None]).T @ splines)
    return np.asarray(reach @ np.array(known.uncertainty.bias_m2) @ reach.T)


def with_curve(calibration: Calibration, known: Calibration) -> Calibration:
    """Return a calibration with the curve of another, and what is known of it."""
    uncertainty = calibration.uncertainty
    if uncertainty is not None:
        size = len(known.bias_curve.coefficients)
        of_curve = known.uncertainty.bias_m2 if known.uncertainty else tuple((0.0,) * size for _ in range(size))
        uncertainty = replace(uncertainty, bias_m2=of_curve)
    return replace(calibration, bias_curve=known.bias_curve, uncertainty=uncertainty)
