"""Which delays are stated: those for which each curve is zero at a reference power.

A constant in a curve and a shift common to the delays of its tags change no range, so a fit has to choose. Chosen by
the powers that a recording happens to hold, the same boards would get other delays from a fainter recording; chosen at
a stated power, they get the same, and the interval of a stated delay holds what is not known of the curve there.
"""

from __future__ import annotations

import numpy as np

from calib.calibration.power_curves import basis
from calib.estimation.problem import Problem
from uwblink.arrays import Floats


def stating(problem: Problem, reference: float | None) -> Floats:
    """Return the matrix (m, m) that turns fitted parameters into stated ones.

    Those are delays for which each curve is zero at the lifted power `reference` (None: as they were fitted), and
    coefficients of the curves themselves. Where pinned delays fix a curve's constant it stays as it is.
    """
    found = np.eye(problem.design.shape[1])
    if not problem.unknowns.curve:
        return found
    row = None if reference is None else basis(np.array([reference]), problem.knots)[0]
    for (_, columns), centre, gauge in zip(problem.curves(), problem.centres, problem.gauges, strict=True):
        if row is None or gauge is None:
            # Splines sum to one everywhere, so a constant is the same number in every coefficient.
            found[columns, columns] -= centre
            continue
        found[columns, columns] -= row
        found[: problem.rank, columns] -= np.outer(gauge, row - centre)
    return found
