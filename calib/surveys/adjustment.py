"""The adjustment of a network: the unknowns that agree best with what was measured, and how large its errors are.

Levenberg and Marquardt for the unknowns; restricted maximum likelihood (Patterson and Thompson, Biometrika, 1971) for
the constant error of pairs and the spread of the curve, with weak knowledge beforehand, since a small network says
little of either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.surveys.network import Network
from uwblink.arrays import Floats

PAIR_STD_M: Final = 0.02
"""What a constant error of a pair is like before any data, and worth how many degrees of freedom."""

PAIR_WORTH: Final = 3.0
CURVE_STD_M: Final = 0.03
CURVE_FACTOR: Final = 1.8
"""Spread of a curve before any data, and the factor by which that may be wrong."""

MOST_STEPS: Final = 60
ROUNDS: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Adjusted:
    """The best unknowns (unknowns,), their information without any prior on what the data say, and the residuals.

    `weighed` is the sum of squared residuals over their standard deviations, priors included; `freedom` the degrees of
    freedom that are left; `pair_std_m` and `curve_std_m` are the estimated spreads.
    """

    network: Network
    x: Floats
    residuals_m: Floats
    std_m: Floats
    weighed: float
    freedom: float
    pair_std_m: float
    curve_std_m: float
    settled: bool

    def information(self, *, guess: bool = False) -> Floats:
        """Return the information (unknowns, unknowns), rigid motions held; with the guess of delays, or without."""
        return information_at(self.network, self.x, self.std_m, self.curve_std_m, guess=guess)

    def covariance(self) -> Floats:
        """Return the covariance (unknowns, unknowns), with the guess of delays, so that there is always one."""
        return np.asarray(np.linalg.inv(self.information(guess=True)), dtype=np.float64)


def information_at(network: Network, x: Floats, std_m: Floats, curve_std_m: float, *, guess: bool = False) -> Floats:
    """Return the information of a network's rows at some unknowns."""
    rows = network.jacobian(x) / std_m[:, None]
    prior = network.prior(curve_std_m)
    if not guess:
        loose = [
            c for c, t in zip(network.delay_columns.tolist(), network.tags, strict=True) if t not in network.fixed_m
        ]
        prior[loose, loose] = 0.0
        points = np.arange(network.coordinates)
        prior[points, points] = 0.0
    held = network.motions(x)
    return np.asarray(rows.T @ rows + prior + held.T @ held)


def settle(network: Network, x: Floats, std_m: Floats, curve_std_m: float) -> tuple[Floats, float, bool]:
    """Return the best unknowns from a start, the weighed sum of squares, and whether the search ended."""
    prior, centre = network.prior(curve_std_m), network.centre()

    def cost(at: Floats) -> tuple[float, Floats]:
        scaled = network.residuals(at) / std_m
        away = at - centre
        return float(scaled @ scaled + away @ prior @ away), scaled

    value, scaled = cost(x)
    damping = 1e-3
    for _ in range(MOST_STEPS):
        rows = network.jacobian(x) / std_m[:, None]
        matrix = rows.T @ rows + prior
        slope = rows.T @ scaled - prior @ (x - centre)
        while damping < 1e12:
            step = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), slope)
            tried, tried_scaled = cost(x + step)
            if tried <= value:
                break
            damping *= 5
        else:
            return x, value, True
        gained = value - tried
        x, value, scaled = x + step, tried, tried_scaled
        damping = max(damping / 8, 1e-9)
        if gained < 1e-7 * max(value, 1.0) and np.abs(step).max() < 1e-6:
            return x, value, True
    return x, value, False


def adjust(network: Network, x: Floats, *, pair_std_m: float | None = None, rounds: int = ROUNDS) -> Adjusted:
    """Return the best unknowns from a start, with the spreads estimated along; `pair_std_m` is known where given."""
    pair, curve = pair_std_m or PAIR_STD_M, CURVE_STD_M
    for _ in range(rounds):
        x, _, _ = settle(network, x, network.std_m(pair), curve)
        pair, curve = _spreads(network, x, pair, curve, pair_std_m)
    std = network.std_m(pair)
    x, value, settled = settle(network, x, std, curve)
    return Adjusted(
        network=network,
        x=x,
        residuals_m=network.residuals(x),
        std_m=std,
        weighed=value,
        freedom=freedom(network, x, std, curve),
        pair_std_m=pair,
        curve_std_m=curve,
        settled=settled,
    )


def freedom(network: Network, x: Floats, std_m: Floats, curve_std_m: float) -> float:
    """Return the degrees of freedom left: rows less what they determine."""
    rows = network.jacobian(x) / std_m[:, None]
    matrix = rows.T @ rows
    held = network.motions(x)
    inverse = np.linalg.inv(matrix + network.prior(curve_std_m) + held.T @ held)
    return float(len(rows) - np.trace(inverse @ matrix))


def leverages(found: Adjusted) -> Floats:
    """Return the share (n,) of each row's variance that the fit leaves: 1 less its leverage."""
    rows = found.network.jacobian(found.x) / found.std_m[:, None]
    inverse = found.covariance()
    return np.asarray(1 - np.einsum("ij,jk,ik->i", rows, inverse, rows))


def _spreads(network: Network, x: Floats, pair: float, curve: float, known: float | None) -> tuple[float, float]:
    """Return the spreads of pairs and curve that are likeliest, by a search that halves its steps.

    By error contrasts: combinations of rows in which neither coordinates nor delays are, as many as freedoms are left.
    """
    jacobian = network.jacobian(x)
    flat = np.delete(jacobian, network.curve_columns, axis=1)
    held = [c for c, tag in zip(network.delay_columns.tolist(), network.tags, strict=True) if tag in network.fixed_m]
    flat[:, held] = 0.0
    basis, size, _ = np.linalg.svd(flat, full_matrices=True)
    contrasts = basis[:, int(np.count_nonzero(size > 1e-9 * size[0])) :].T
    curves = contrasts @ jacobian[:, network.curve_columns]
    seen = contrasts @ network.residuals(x) + curves @ x[network.curve_columns]
    of_pairs = np.arange(len(jacobian)) < len(network.means)
    own = (contrasts * network.std_m(0.0) ** 2) @ contrasts.T
    shared = (contrasts * of_pairs) @ contrasts.T
    smooth = curves @ np.linalg.inv(network.power.precision) @ curves.T if network.power is not None else 0.0

    def unlikely(log_pair: float, log_curve: float) -> float:
        value = PAIR_WORTH * (2 * log_pair + math.exp(2 * (math.log(PAIR_STD_M) - log_pair)))
        value += ((log_curve - math.log(CURVE_STD_M)) / math.log(CURVE_FACTOR)) ** 2
        if len(seen):
            root = np.linalg.cholesky(own + math.exp(2 * log_pair) * shared + math.exp(2 * log_curve) * smooth)
            value += 2 * float(np.log(np.diag(root)).sum()) + float(np.sum(np.linalg.solve(root, seen) ** 2))
        return value

    at = [math.log(pair), math.log(curve)]
    free = [k for k in (0, 1) if not (k == 0 and known) and not (k == 1 and network.power is None)]
    best, step = unlikely(*at), 0.5
    while step > 0.02 and free:
        better = False
        for k in free:
            for sign in (step, -step):
                tried = [*at]
                tried[k] = min(max(tried[k] + sign, math.log(5e-4)), 0.0)
                if (value := unlikely(*tried)) < best - 1e-9:
                    at, best, better = tried, value, True
        step = step if better else step / 2
    return math.exp(at[0]), math.exp(at[1])
