"""The one search: Newton steps to the maximum of the log likelihood of all rows and priors.

The information of the rows (squared slopes of a likelihood) is used as the curvature, corrected by the changes of
slopes over the last steps. The weights of priors that data determine are estimated in the same steps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from calib.estimator.inverse import Inverse, Matrix, inverse_of
from calib.estimator.range_rows import RangeRows
from calib.estimator.rows import Rows, Sums, sum_rows
from calib.estimator.unknowns import Layout, Priors
from uwblink.arrays import Floats, Ints

SETTLED = 1e-2
"""A step with a smaller expected gain of log likelihood moves no unknown by more than a tenth of its standard error."""

EVIDENCE_STEPS = 9
"""Steps near the optimum in which weights of priors are estimated; then they stay. With 9 steps, fits of twelve flights
with listeners end within 0.18 standard errors from other starts, with 12 within 0.1. Intervals of few ranges do not
depend on it: those for 95 % contain 94.4 % of the errors with 9 steps, and 94.2 % with 30 (30 worlds of twelve tags
with 250 ranges)."""

MOST_STEPS = 100
"""Maximum number of steps of a search: sound searches take ten to sixty."""

LONGER = 2.0
"""How many times longer a corrected step may be than one by the information alone, in standard errors, and by how much
a logarithm may grow. With 4, one of 21 flights in simulated rooms was given up. Half or twice of it moves delays of
worlds by 0.02 standard errors, and changes these by 8 % (`python -m benchmarks.constants`)."""


@dataclass(frozen=True)
class Optimum:
    """Where a search ended: unknowns `x` (p,), inverse of information and priors, and the rows' own information.

    `rows` are those whose likelihood is largest there.
    """

    layout: Layout
    priors: Priors
    x: Floats
    covariance: Inverse
    information: Matrix
    value: float
    steps: int
    success: bool
    rows: tuple[Rows, ...] = ()

    def of(self, kind: str) -> Floats:
        """Return the unknowns of a kind."""
        return self.x[self.layout.where[kind]]

    def by_kind(self) -> dict[str, Floats]:
        """Return all unknowns by kind."""
        return {kind: self.x[where] for kind, where in self.layout.where.items()}


def maximize(  # noqa: PLR0913 - a search has many settings
    rows: Sequence[Rows],
    priors: Priors,
    x: Floats,
    *,
    steps: int | None = None,
    tolerance: float = SETTLED,
    evidence_steps: int = EVIDENCE_STEPS,
    asked: Ints | None = None,
    longest: Callable[[Floats], float] | None = None,
    longer: float = LONGER,
) -> Optimum:
    """Search from unknowns (p,) for the likeliest ones; `asked` unknowns converge more closely.

    The weights of `priors` are estimated in the first `evidence_steps` near the optimum, and changed in place: a next
    search with the same object continues with them.

    `longest` returns which share of a step (p,) may be taken at most, where unknowns are not linear; `longer` limits
    corrected steps, as `LONGER` says.

    Squared slopes are only approximately the curvature: their inverse is corrected by the changes of slopes over the
    last steps (L-BFGS: Nocedal and Wright 2006, algorithm 7.4), and for steps by the second derivatives of distances
    (`Sums`) and by `_with_logarithms`. The step is shortened if the likelihood falls.
    """
    layout, free = priors.layout, priors.layout.free()
    few = {k: one for k, one in enumerate(rows) if isinstance(one, RangeRows) and one.restricted}
    most, near, shorter = MOST_STEPS if steps is None else steps, 0, 0
    # The last 3 to 20 steps give equal results (Nocedal and Wright 2006, section 7.2).
    changes = deque[tuple[Floats, Floats]](maxlen=10)
    sums = Sums(-np.inf, np.zeros_like(x), np.zeros((0, 0)), np.zeros((0, 0)))
    best, gain, promised, settled, taken = -np.inf, np.inf, 0.0, False, 0
    best_x, slope, step = x, np.zeros_like(x), np.zeros_like(x)
    while taken < most and not settled:
        taken += 1
        found = sum_rows(rows, x)
        value = found.value + priors.value(x)
        if gain < len(free):
            changes.append((x - best_x, sums.gradient - found.gradient))
        # After eight reductions, to a thousandth or less, a step is accepted unchanged.
        if not value >= best - tolerance and shorter < 8:
            # To the maximum of the parabola through both values and the slope (Nocedal and Wright 2006, equation 3.58).
            share = 0.5 * promised / (promised + best - value)
            step *= float(np.clip(share, 0.1, 0.5)) if np.isfinite(share) else 0.1
            promised, shorter = float(slope @ step), shorter + 1
            x = best_x + step
            continue
        best_x, sums, shorter = x, found, 0
        priors.scale_by_units(x)
        value = found.value + priors.value(x)
        precision = priors.precision()
        known = sums.information + precision
        slope = sums.gradient + priors.pull(x)
        bent = [(moved, _damped(moved, fell + precision @ moved, known @ moved)) for moved, fell in changes]
        quick = inverse_of(_with_logarithms(sums.curvature + precision, layout, sums.gradient, longer), free)
        step = _corrected(quick, slope, bent)
        reach = float(slope @ (quick @ slope)) / max(float(step @ known @ step), 1e-300)
        step *= min(1.0, longer * reach**0.5) if reach > 0 else 1.0
        gain, best = float(slope @ step), value
        settled = gain < tolerance
        if asked is not None:
            # The others may converge less closely: the log odds of a share of zero may be any large negative number.
            settled = abs(float(slope[asked] @ step[asked])) < tolerance and gain < max(0.3, tolerance)
        near += gain < len(free)
        if near < evidence_steps:
            # At the start there are no earlier steps to limit the first one.
            # Squares of few slopes are often small by chance, and then the spread of groups would seem large.
            expecting = [few[k].expecting() if k in few else one for k, one in enumerate(rows)]
            expected = sum_rows(expecting, x).information + precision if few else known
            covariance = inverse_of(expected, free)
            settled = priors.update(x + step, covariance) < tolerance and settled
            if few:
                few = {k: one.with_uncertainty(x, covariance) for k, one in few.items()}
                rows = [few.get(k, one) for k, one in enumerate(rows)]
                sums = sum_rows(rows, x)
            best = sums.value + priors.value(x)
        step *= 1.0 if longest is None else min(1.0, longest(step))
        promised = float(slope @ step)
        x = best_x + step
    # Weights changed after the last step, too.
    covariance = inverse_of(sums.information + priors.precision(), free)
    return Optimum(layout, priors, best_x, covariance, sums.information, best, taken, settled, tuple(rows))


def _with_logarithms(known: Matrix, layout: Layout, slope: Floats, longer: float) -> Matrix:
    """Return the information (p, p) plus the curvature that logarithms add by the `slope` (p,) of the likelihood.

    The curvature by a share or a length is about its squared slopes. For its logarithm the slope is subtracted, so that
    no value falls by more than a factor e per step; `longer` limits its growth. Without this a share near zero, whose
    squared slopes are small, shortens most steps.
    """
    more = np.where(layout.logarithms(), np.maximum(-slope, slope / longer), 0.0)
    if sparse.issparse(known):
        return sparse.csc_matrix(known + sparse.diags(more))
    return np.asarray(known + np.diag(more))


def _damped(moved: Floats, fell: Floats, expected: Floats) -> Floats:
    """Return the decrease of slopes (p,) over a move (p,), at least a fifth of the expected one (p,).

    Powell's damping (Nocedal and Wright 2006, procedure 18.2, with its constant 0.2) keeps the curvature positive.
    """
    whole, own = float(moved @ expected), float(moved @ fell)
    if own >= 0.2 * whole:
        return fell
    share = 0.8 * whole / (whole - own)
    return share * fell + (1 - share) * expected


def _corrected(covariance: Inverse, slope: Floats, changes: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Return the step (p,) from a slope (p,) by an inverse curvature that agrees with changes over earlier steps.

    `changes` are moves of unknowns (p,) and decreases of slopes (p,), in order of time.
    """
    kept = [(moved, fell, float(moved @ fell)) for moved, fell in changes if float(moved @ fell) > 0]
    rest, shares = slope.copy(), []
    for moved, fell, product in reversed(kept):
        shares.append(float(moved @ rest) / product)
        rest -= shares[-1] * fell
    step = np.asarray(covariance @ rest)
    for (moved, fell, product), share in zip(kept, reversed(shares), strict=True):
        step += (share - float(fell @ step) / product) * moved
    return step
