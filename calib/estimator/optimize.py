"""The one loop: from a start to the top of the log likelihood of all rows and priors.

Steps are Newton's with the information of the rows (squared slopes of a likelihood), shortened or lengthened by how
much of what their slope promised they kept; the weights of priors that data determine are estimated along.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calib.estimator.inverse import Inverse, Matrix, inverse_of
from calib.estimator.rows import Rows, sum_rows
from calib.estimator.unknowns import Layout, Priors
from uwblink.arrays import Floats, Ints

SETTLED = 1e-2
"""A step that promises less log likelihood than this moves no unknown by more than a tenth of its standard error."""

ROUGHLY = 0.3
"""The same for all unknowns together, where only some are asked for: a share of nothing may be any small number."""

EVIDENCE_STEPS = 12
"""Steps in which weights of priors are estimated: they converge as fast as the unknowns do, and then stand."""

MOST_STEPS = 60
"""Steps after which a search is given up: sound ones take ten to thirty."""

CHANGE = 0.05
"""Relative change of a weight below which it has settled."""


@dataclass(frozen=True, kw_only=True)
class Optimum:
    """Where a search ended: unknowns `x` (p,), inverse of information and priors, and the rows' own information."""

    layout: Layout
    priors: Priors
    x: Floats
    covariance: Inverse
    information: Matrix
    value: float
    steps: int
    success: bool

    def of(self, kind: str) -> Floats:
        """Return the unknowns of a kind."""
        return self.x[self.layout.where[kind]]


def maximize(
    rows: Sequence[Rows],
    priors: Priors,
    x: Floats,
    *,
    steps: int | None = None,
    tolerance: float = SETTLED,
    evidence_steps: int = EVIDENCE_STEPS,
    asked: Ints | None = None,
    longest: Callable[[Floats], float] | None = None,
) -> Optimum:
    """Climb from unknowns (p,) to the likeliest ones; of those that are `asked` for the search settles more closely.

    `longest` returns which share of a step (p,) may be taken at most, where unknowns are not linear.

    A likelihood that falls halves the step. Squared slopes are not quite the curvature: a step to the top keeps half of
    what its slope promises, one that keeps nearly all was short, and the next one is taken longer.
    """
    layout, free = priors.layout, priors.layout.free()
    best, top, step, shorter, length, promised = -np.inf, x, np.zeros_like(x), 0, 1.0, 0.0
    most = MOST_STEPS if steps is None else steps
    for taken in range(1, most + 1):
        found = sum_rows(rows, x)
        value = found.value + priors.value(x)
        if value < best - tolerance and shorter < 8:
            step, shorter, promised = 0.3 * step, shorter + 1, 0.0
            x = top + step
            continue
        if promised > 0:
            # Along a parabola the best length keeps a half of what the slope promises, one h times as long 1 - h/2.
            kept = (value - best) / promised
            length = float(np.clip(length * np.clip(0.5 / max(1 - kept, 1e-3), 0.5, 2.0) ** 0.7, 0.25, 8.0))
        sums, shorter = found, 0
        covariance = inverse_of(sums.information + priors.precision(), free, layout.local())
        slope = sums.gradient + priors.pull(x)
        step = covariance @ slope
        gain = float(slope @ step)
        settled = gain < tolerance
        if asked is not None:
            settled = abs(float(slope[asked] @ step[asked])) < tolerance and gain < max(ROUGHLY, tolerance)
        if taken <= evidence_steps:
            before = list(priors.weights)
            # At the start nothing has moved yet, and says nothing of how far it may.
            priors.update(x + step, covariance)
            moved = [abs(np.log(a / b)) for a, b in zip(priors.weights, before, strict=True)]
            settled = settled and max(moved, default=0.0) < CHANGE
            best = sums.value + priors.value(x)
        else:
            best = value
        if settled:
            return Optimum(
                layout=layout,
                priors=priors,
                x=x,
                covariance=covariance,
                information=sums.information,
                value=value,
                steps=taken,
                success=True,
            )
        step *= min(length, np.inf if longest is None else longest(step))
        promised = float(slope @ step)
        top, x = x, x + step
    return Optimum(
        layout=layout,
        priors=priors,
        x=top,
        covariance=covariance,
        information=sums.information,
        value=best,
        steps=most,
        success=False,
    )
