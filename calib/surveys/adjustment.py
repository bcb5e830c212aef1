"""The adjustment of a network: the unknowns that agree best with what was measured, and how large its errors are.

Levenberg and Marquardt for the unknowns; restricted maximum likelihood (Patterson and Thompson, Biometrika, 1971) for
the constant error of pairs and the spread of the curve, with weak knowledge beforehand, since a small network says
little of either.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.surveys.network import DETOUR_M, Network
from calib.surveys.power import CURVE_FACTOR, CURVE_STD_M
from calib.surveys.reflections import choices, of_marked, searched, unlikely
from uwblink.arrays import Bools, Floats

PAIR_STD_M: Final = 0.02
"""What a constant error of a pair is like before any data, and worth how many degrees of freedom."""

PAIR_WORTH: Final = 3.0
SETTLED: Final = 1e-8
"""Share of the weighed squares below which a step gains nothing: a ten-thousandth of a standard deviation."""

ORDER_IS_RIGHT: Final = 2 * math.log(100.0)
"""-2 log of the chance that boards stand in another order than somebody said who put them so: one in a hundred."""

LEAST_WEIGHT: Final = 1e-3
"""Share of the likeliest spreads' weight below which others are left out of the mean."""

MOST_STEPS: Final = 60
ROUNDS: Final = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Adjusted:
    """The best unknowns (unknowns,), their information without any prior on what the data say, and the residuals.

    `unlikely` is -2 log of the likelihood of everything, up to a constant that all adjustments of one set of means
    share; `freedom` the degrees of freedom that are left; `pair_std_m` and `curve_std_m` are the estimated spreads.
    Which means are reflected is marked in `network`; `chance` (n,) is how probable that is of each, and `open_m2` what
    it adds to the covariance (unknowns, unknowns) that others may be reflected instead, or spreads be others.
    `pair_known` says that the spread of pairs was given.
    """

    network: Network
    x: Floats
    residuals_m: Floats
    std_m: Floats
    unlikely: float
    freedom: float
    pair_std_m: float
    curve_std_m: float
    settled: bool
    chance: Floats
    open_m2: Floats
    pair_known: bool

    def information(self, *, guess: bool = False) -> Floats:
        """Return the information (unknowns, unknowns), rigid motions held; with the guess of delays, or without."""
        found = information_at(self.network, self.x, self.std_m, self.curve_std_m, guess=guess)
        # Of the sum of two covariances, the first of which may be infinite.
        wider = np.linalg.solve(np.eye(len(found)) + found @ self.open_m2, found)
        return np.asarray((wider + wider.T) / 2)

    def covariance(self) -> Floats:
        """Return the covariance (unknowns, unknowns), with the guess of delays, so that there is always one."""
        found = information_at(self.network, self.x, self.std_m, self.curve_std_m, guess=True)
        return np.asarray(np.linalg.inv(found) + self.open_m2, dtype=np.float64)


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
    # Rigid motions change nothing: without this each step would drift along them.
    motions = network.motions(x)
    held = motions.T @ motions / float(np.mean(std_m)) ** 2
    damping = 1e-3
    for _ in range(MOST_STEPS):
        rows = network.jacobian(x) / std_m[:, None]
        matrix = rows.T @ rows + prior + held
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
        if gained < SETTLED * max(value, 1.0):
            return x, value, True
    return x, value, False


def adjust(network: Network, x: Floats, *, pair_std_m: float | None = None, careful: bool = False) -> Adjusted:
    """Return the best unknowns from a start, with the spreads and the reflected means estimated along.

    `pair_std_m` is known where given. A `careful` one begins with all means straight and large errors of pairs, too,
    and takes what is likelier.
    """
    found = _alternated(network, x, pair_std_m, first_spread=False)
    if careful:
        other = _alternated(network.marked(np.zeros_like(network.reflected)), x, pair_std_m, first_spread=True)
        found = min(found, other, key=lambda one: one.unlikely)
    return found


def _alternated(network: Network, x: Floats, known: float | None, *, first_spread: bool) -> Adjusted:
    """Return what comes of settling, of searching for reflections, and of estimating spreads, in turns."""
    pair, curve = known or PAIR_STD_M, CURVE_STD_M
    if first_spread:
        x, _, _ = settle(network, x, network.std_m(pair), curve)
        pair, curve = _spreads(network, x, pair, curve, known)
    for _ in range(ROUNDS):
        x, _, _ = settle(network, x, network.std_m(pair), curve)
        marks = searched(network, x, network.std_m(pair), curve)
        before = pair, network.reflected
        network = network.marked(marks)
        x, _, _ = settle(network, x, network.std_m(pair), curve)
        pair, curve = _spreads(network, x, pair, curve, known)
        if abs(pair - before[0]) < 0.02 * pair and np.array_equal(marks, before[1]):
            break
    std = network.std_m(pair)
    x, value, settled = settle(network, x, std, curve)
    return Adjusted(
        network=network,
        x=x,
        residuals_m=network.residuals(x),
        std_m=std,
        unlikely=unlikely_at(network, x, std, curve, value) + _unlikely_spreads(pair, curve),
        freedom=freedom(network, x, std, curve),
        pair_std_m=pair,
        curve_std_m=curve,
        settled=settled,
        chance=network.reflected.astype(float),
        open_m2=np.zeros((network.size,) * 2),
        pair_known=known is not None,
    )


def unlikely_at(network: Network, x: Floats, std_m: Floats, curve_std_m: float, weighed: float) -> float:
    """Return -2 log likelihood where a search settled with so many weighed squares (Laplace), whatever the unknowns."""
    rows = network.jacobian(x) / std_m[:, None]
    prior = network.prior(curve_std_m)
    known = float(np.linalg.slogdet(rows.T @ rows + prior)[1]) - float(np.linalg.slogdet(prior)[1])
    marks = unlikely(int(network.reflected.sum()), len(network.means))
    marks += of_marked(network, x, std_m, curve_std_m)
    orders = ORDER_IS_RIGHT * len(network.out_of_order(x))
    return weighed + known + 2 * float(np.log(std_m).sum()) + marks + orders


def averaged(found: Adjusted) -> Adjusted:
    """Return the mean over what is nearly as likely, with the covariance that the other possibilities add.

    These are other choices of reflected means and, where there is a curve, other spreads of pairs and curve: few pairs
    say little of how large a curve is, and what all delays share depends on it.
    """
    network, x, std = found.network, found.x, found.std_m
    every = choices(network, x, std, found.curve_std_m)
    here = _Case(network.reflected, found.pair_std_m, found.curve_std_m)
    solve_case = _solver_of_cases(network, x)
    mean, more = _mixed(solve_case, here, [replace(here, marks=marks) for marks in every.marks], every.weight)
    if network.power is not None:
        spreads, weight = _likely_spreads(found)
        cases = [replace(here, pair_m=pair, curve_m=curve) for pair, curve in spreads]
        step, wider = _mixed(solve_case, here, cases, weight)
        mean, more = mean + step, more + wider
    at = x + mean
    return replace(found, x=at, residuals_m=network.residuals(at), chance=every.chance, open_m2=more)


@dataclass(frozen=True, slots=True)
class _Case:
    """What may be: which means are reflected, the spread of pairs, that of the curve."""

    marks: Bools
    pair_m: float
    curve_m: float


def _solver_of_cases(network: Network, x: Floats) -> Callable[[_Case], tuple[Floats, Floats]]:
    """Return a function of a case: the step from `x` to its best unknowns, linear, and their covariance."""
    held, jacobian = network.motions(x), network.jacobian(x)
    straight = network.marked(np.zeros_like(network.reflected)).residuals(x)

    def solved(case: _Case) -> tuple[Floats, Floats]:
        std, prior = network.marked(case.marks).std_m(case.pair_m), network.prior(case.curve_m)
        rows = jacobian / std[:, None]
        spread = np.asarray(np.linalg.inv(rows.T @ rows + prior + held.T @ held), dtype=np.float64)
        away = (straight - DETOUR_M * _padded(case.marks, len(std))) / std
        return spread @ (rows.T @ away - prior @ (x - network.centre())), spread

    return solved


def _mixed(
    solve_case: Callable[[_Case], tuple[Floats, Floats]], here: _Case, cases: list[_Case], weight: Floats
) -> tuple[Floats, Floats]:
    """Return the mean step over cases, and what the mixture's covariance is more than that of one case, not below 0."""
    solved = [solve_case(case) for case in cases]
    steps, spreads = np.array([step for step, _ in solved]), np.array([spread for _, spread in solved])
    mean = weight @ steps
    around = steps - mean
    wider = np.einsum("k,kij->ij", weight, spreads) - solve_case(here)[1] + (around.T * weight) @ around
    values, vectors = np.linalg.eigh((wider + wider.T) / 2)
    return np.asarray(mean), np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _likely_spreads(found: Adjusted) -> tuple[list[tuple[float, float]], Floats]:
    """Return spreads of pairs and curve about those that were found, and their weights, which sum to 1.

    Logarithms in steps of 0.3 for pairs and 0.4 for the curve, about half of what a survey knows of either.
    """
    unlikely = _unlikeliness(found.network, found.x)
    steps = [(0.3 * i, 0.4 * k) for i in range(-2, 3) for k in range(-4, 5)]
    if found.pair_known:
        steps = [(pair, curve) for pair, curve in steps if pair == 0.0]
    spreads = [(found.pair_std_m * math.exp(pair), found.curve_std_m * math.exp(curve)) for pair, curve in steps]
    worse = np.array([unlikely(math.log(pair), math.log(curve)) for pair, curve in spreads])
    weight = np.exp(-0.5 * (worse - worse.min()))
    kept = np.flatnonzero(weight > LEAST_WEIGHT)
    return [spreads[k] for k in kept.tolist()], weight[kept] / weight[kept].sum()


def _padded(marks: Bools, rows: int) -> Floats:
    return np.pad(marks.astype(float), (0, rows - len(marks)))


def _unlikely_spreads(pair: float, curve: float) -> float:
    """Return -2 log of what is known of the spreads beforehand."""
    log_pair = math.log(pair)
    found = PAIR_WORTH * (2 * log_pair + math.exp(2 * (math.log(PAIR_STD_M) - log_pair)))
    return found + ((math.log(curve) - math.log(CURVE_STD_M)) / math.log(CURVE_FACTOR)) ** 2


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
    information = information_at(found.network, found.x, found.std_m, found.curve_std_m, guess=True)
    return np.asarray(1 - np.einsum("ij,ji->i", rows, np.linalg.solve(information, rows.T)))


def _unlikeliness(network: Network, x: Floats) -> Callable[[float, float], float]:
    """Return -2 log likelihood as a function of the logarithms of the spreads of pairs and curve.

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
        value = _unlikely_spreads(math.exp(log_pair), math.exp(log_curve))
        if len(seen):
            root = np.linalg.cholesky(own + math.exp(2 * log_pair) * shared + math.exp(2 * log_curve) * smooth)
            value += 2 * float(np.log(np.diag(root)).sum()) + float(np.sum(np.linalg.solve(root, seen) ** 2))
        return value

    return unlikely


def _spreads(network: Network, x: Floats, pair: float, curve: float, known: float | None) -> tuple[float, float]:
    """Return the spreads of pairs and curve that are likeliest, by a search that halves its steps."""
    unlikely = _unlikeliness(network, x)
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
