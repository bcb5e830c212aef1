"""The curve of standard deviation over lifted power, of the core of the errors, and its band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.power_curves import (
    DEGREE,
    SIGMA_FLOOR_M,
    SIGMA_SEGMENTS,
    Curve,
    basis,
    curvature,
    equal_bins,
    knots_for,
)
from calib.error_mixture import ErrorMixture, fit_error_mixture
from calib.errors import UnanswerableError
from calib.estimation.problem import Problem
from calib.long_columns import picked
from uwblink.arrays import Floats, Ints

FEWEST: Final = 20
"""Ranges of a combination of groups from which a standard deviation is estimated."""

SMOOTHNESSES: Final = np.logspace(-6, 2, 17)
"""Weights of the penalty that are tried; generalised cross-validation chooses."""


@dataclass(frozen=True, slots=True)
class SigmaFit:
    """A curve for each group, and the covariance (m, m) of the coefficients of their average."""

    curves: dict[str, Curve]
    covariance: Floats


def fit_sigma(problem: Problem, centred_m: Floats, mixture: ErrorMixture) -> SigmaFit:
    """Draw curves through the standard deviations of the core in bins of power.

    `centred_m` (n,) are errors about the centre of the core, `mixture` their parts in the problem's bins. With groups
    of tags each combination of groups has its own bins, and a range between two groups the mean of both curves.
    """
    if len(problem.groups) == 1:
        shares = np.ones((mixture.sigma_m.size, 1))
        where, sigma, counts = problem.bins.middle, mixture.sigma_m, problem.bins.count
    else:
        where, sigma, counts, shares = _by_groups(problem, centred_m)
    # Nothing is known of sigma beyond the middles of the outermost bins.
    span = (float(where.min()), float(where.max()))
    known = picked(problem.lifted, (problem.lifted >= span[0]) & (problem.lifted <= span[1]))
    # A copy of its own, which may be sorted where it lies.
    known.sort()
    knots = knots_for(known, SIGMA_SEGMENTS)
    splines = basis(where, knots)
    design = np.hstack([splines * shares[:, k, None] for k in range(shares.shape[1])])
    each, rough = splines.shape[1], curvature(knots)
    penalty = np.kron(np.eye(shares.shape[1]), rough / np.trace(rough))
    # A standard deviation from n errors has a relative error of 1/sqrt(2 n).
    weight = counts / np.maximum(sigma, SIGMA_FLOOR_M) ** 2
    solution, covariance = _penalised(design, sigma, weight / weight.mean(), penalty)
    curves = {
        name: Curve(
            tuple(knots.tolist()),
            tuple(solution[k * each : (k + 1) * each].tolist()),
            DEGREE,
            (float(knots[0]), float(knots[-1])),
        )
        for k, name in enumerate(problem.groups)
    }
    mean = np.kron(np.full((1, shares.shape[1]), 1 / shares.shape[1]), np.eye(each))
    return SigmaFit(curves, np.asarray(mean @ covariance @ mean.T))


def _by_groups(problem: Problem, centred_m: Floats) -> tuple[Floats, Floats, Ints, Floats]:
    """Take the errors of every combination of groups apart on their own, in bins of power.

    Raises `UnanswerableError` for a group that is in no combination with enough ranges for a bin.
    """
    shares = np.column_stack([problem.share(k) for k in range(len(problem.groups))])
    kinds, kind = np.unique(shares, axis=0, return_inverse=True)
    parts = []
    for k in range(len(kinds)):
        rows = np.flatnonzero(kind == k)
        if len(rows) < FEWEST:
            continue
        own = equal_bins(problem.lifted[rows], 12)
        sigma = fit_error_mixture(centred_m[rows], own.number, len(own.count)).sigma_m
        parts.append((own.middle, sigma, own.count, np.tile(kinds[k], (len(sigma), 1))))
    covered = np.any([share.any(axis=0) for *_, share in parts], axis=0) if parts else np.zeros(len(problem.groups))
    for name, enough in zip(problem.groups, covered, strict=True):
        if not enough:
            raise UnanswerableError(
                f"group {name!r} has too few ranges for a curve, at least {FEWEST} are needed", parameter="groups"
            )
    where, sigma, counts, share = (np.concatenate(column) for column in zip(*parts, strict=True))
    return where, sigma, counts, share


def _penalised(design: Floats, aim: Floats, weight: Floats, penalty: Floats) -> tuple[Floats, Floats]:
    """Return coefficients held above the floor, and their covariance, with the smoothness that predicts best."""
    square, pull, count = (design.T * weight) @ design, design.T @ (weight * aim), len(aim)
    tiny = 1e-9 * np.eye(len(square)) * np.trace(square) / len(square)
    best = (np.inf, SMOOTHNESSES[0], 1.0)
    for smoothness in SMOOTHNESSES * count:
        inverse = np.linalg.inv(square + smoothness * penalty + tiny)
        used = float(np.trace(inverse @ square))
        left = float(np.sum(weight * (aim - design @ (inverse @ pull)) ** 2))
        score = left / max(1 - used / count, 1e-3) ** 2
        best = min(best, (score, smoothness, left / max(count - used, 1.0)))
    _, smoothness, dispersion = best
    whole = square + smoothness * penalty + tiny
    return _above(whole, pull, SIGMA_FLOOR_M), np.asarray(dispersion * np.linalg.inv(whole))


def _above(square: Floats, pull: Floats, floor: float) -> Floats:
    """Minimise x' square x / 2 - pull' x over x not below a floor (Lawson and Hanson's active set)."""
    held = np.zeros(len(pull), dtype=bool)
    for _ in range(4 * len(pull)):
        x = np.full(len(pull), floor)
        free = ~held
        if free.any():
            x[free] = np.linalg.solve(square[np.ix_(free, free)], (pull - square[:, held].sum(axis=1) * floor)[free])
        below = free & (x < floor)
        slope = square @ x - pull
        wrong = held & (slope < -1e-12 * np.abs(pull).max())
        if below.any():
            held |= below
        elif wrong.any():
            held[np.argmin(np.where(wrong, slope, np.inf))] = False
        else:
            break
    return np.asarray(np.maximum(x, floor))
