"""The solution of a network: the likeliest unknowns, the sizes of errors, and other solutions that fit as well.

For given errors `calib.estimator.optimize` finds the unknowns. The constant error of pairs and the spread of the curve
are those of restricted maximum likelihood (Patterson and Thompson, Biometrika, 1971) with weak priors, since a small
network determines neither well. Likelihoods are integrated over the unknowns (Laplace's approximation), so that
solutions with different reflections, orders and spreads can be compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter, itemgetter

import numpy as np
from scipy.optimize import minimize

from calib.estimator.optimize import maximize
from calib.surveys.network import Case, Lengths, Network
from calib.surveys.reflections import Marks, unlikely
from calib.surveys.result import SecondBest
from calib.surveys.starts import first_start, is_in_order, line_coordinates, other_starts, start_in_order
from uwblink.arrays import Bools, Floats, Ints

PAIR_STD_M, PAIR_PRIOR_FREEDOM = 0.02, 3.0
"""Standard deviation of the constant error of a pair before any data, and the degrees of freedom that it counts as."""

PAIR_STARTS_M = (0.01, 0.015, 0.02, 0.03, 0.045, 0.07)
"""Errors of pairs from which a search begins: with small ones too much looks reflected, with large ones too little."""

CURVE_STD_M, CURVE_FACTOR = 0.1, 1.7
"""Standard deviation of a curve before any data, and the factor by which that may be wrong (`CURVE_LENGTH_DB`)."""

WRONG_ORDER_PENALTY = 2 * math.log(100.0)
"""-2 log of the chance that boards stand in another order than somebody said who put them so: one in a hundred."""

MIN_DIFFERENCE_M = 0.03
"""How far a board must move for a solution to count as another one."""

MAX_WORSE_ALONE = 60.0
"""By how much -2 log likelihood of one arrangement's other solution may be worse for all to be solved with it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Solution:
    """The best unknowns `x` (p,) of a network, and the errors that go with them.

    `unlikely` is -2 log of the likelihood of everything, up to a constant that all solutions of one set of means share;
    `freedom` the degrees of freedom that are left. `chance` (n,) is how probable it is of each mean that it is
    reflected, and `more` (p, p) what it adds to the covariance that others may be reflected, or spreads be others.
    """

    network: Network
    x: Floats
    case: Case
    unlikely: float
    freedom: float
    settled: bool
    chance: Floats
    more: Floats

    @property
    def delays(self) -> Floats:
        """The delays (tags,), ns."""
        return self.x[self.network.layout.where["delay"]]

    def covariance(self) -> Floats:
        """Return the covariance (p, p), with what is known of delays beforehand, so that there is always one."""
        return self.network.at(self.x, self.case).covariance() + self.more

    def information(self) -> Floats:
        """Return the information (p, p) of what was measured, and of what is known of the curve."""
        here, curve = self.network.at(self.x, self.case), self.network.layout.where["curve"]
        found = here.information()
        found[curve, curve] += here.prior[curve, curve]
        # Of the sum of two covariances, the first of which may be infinite.
        wider = np.linalg.solve(np.eye(len(found)) + found @ self.more, found)
        return np.asarray((wider + wider.T) / 2)


def optimize(network: Network, x: Floats, case: Case, only: int | None = None) -> tuple[Floats, bool]:
    """Return the likeliest unknowns from a start (of `only` one arrangement), and whether the search converged."""
    places = network.layout.where["place"]
    found = maximize(
        [Lengths(network, case)],
        network.priors(case.curve_m, only),
        x,
        evidence_steps=0,
        tolerance=1e-6,
        longest=lambda step: 1 / max(1.0, float(np.abs(step[places]).max(initial=0.0))),
    )
    return found.x, found.success


def unlikelihood(network: Network, x: Floats, case: Case, only: int | None = None) -> float:
    """Return -2 log likelihood at an optimum, integrated over the unknowns (those of `only` one arrangement)."""
    here = network.at(x, case, only)
    free = np.ix_(here.free, here.free)
    value = float(np.sum((here.left / here.std) ** 2) + here.away @ here.prior @ here.away)
    value += 2 * float(np.log(here.std).sum())
    value += float(np.linalg.slogdet((here.information() + here.prior)[free])[1])
    value -= float(np.linalg.slogdet(here.prior[free])[1])
    value += unlikely(int(case.marks.sum()), len(case.marks))
    if case.marks.any():
        value += float(Marks.at(network, x, case, only).penalties()[case.marks].sum())
    return value + WRONG_ORDER_PENALTY * len(out_of_order(network, x))


def out_of_order(network: Network, x: Floats) -> list[int]:
    """Return the arrangements in which boards do not stand in the order that is said."""
    points = network.positions(x)
    return [
        k
        for k, boards in enumerate(network.arrangements)
        if boards.order and not is_in_order(line_coordinates(points[network.seats(k)], boards.tags, boards.order))
    ]


def adjust(
    network: Network,
    x: Floats,
    *,
    marks: Bools | None = None,
    start_m: float = PAIR_STD_M,
    rounds: int = 6,
) -> Solution:
    """Return the best unknowns from a start, with the spreads and the reflected means estimated along, in turns.

    `start_m` is the constant error of pairs at first, where that is not known, and `marks` (n,) are the means that are
    reflected at first.
    """
    none = np.zeros(len(network.means), dtype=bool)
    case = Case(none if marks is None else marks, network.pair_m or start_m, CURVE_STD_M)
    for _ in range(rounds):
        before = case
        x, _ = optimize(network, x, case)
        case = replace(case, marks=Marks.at(network, x, case).searched())
        x, _ = optimize(network, x, case)
        case = _spreads(network, x, case)
        if abs(case.pair_m - before.pair_m) < 0.02 * case.pair_m and np.array_equal(case.marks, before.marks):
            break
    x, settled = optimize(network, x, case)
    here = network.at(x, case)
    # Lengths, and known coordinates that may be free.
    dimensions = np.array([boards.dimensions for boards in network.arrangements])
    rows = len(network.ends) + int(dimensions[network.owner[network.known.at]].sum())
    return Solution(
        network=network,
        x=x,
        case=case,
        unlikely=unlikelihood(network, x, case) + _unlikely_spreads(case),
        freedom=float(rows - np.sum(here.covariance() * here.information())),
        settled=settled,
        chance=case.marks.astype(float),
        more=np.zeros((len(x),) * 2),
    )


def _unlikely_spreads(case: Case) -> float:
    """Return -2 log of what is known of the spreads beforehand."""
    known = PAIR_PRIOR_FREEDOM * (2 * math.log(case.pair_m) + (PAIR_STD_M / case.pair_m) ** 2)
    return known + (math.log(case.curve_m / CURVE_STD_M) / math.log(CURVE_FACTOR)) ** 2


def _unlikely_by_spreads(network: Network, x: Floats, case: Case) -> Callable[[Case], float]:
    """Return -2 log likelihood as a function of cases that differ in the spreads of pairs and curve.

    By error contrasts: combinations of rows in which neither coordinates nor delays are, as many as freedoms are left.
    """
    here, curve = network.at(x, replace(case, pair_m=0.0)), network.layout.indices(["curve"])
    basis, size, _ = np.linalg.svd(here.jacobian[:, np.setdiff1d(here.free, curve)], full_matrices=True)
    contrasts = basis[:, int(np.count_nonzero(size > 1e-9 * size[0])) :].T
    curves = contrasts @ here.jacobian[:, curve]
    seen = contrasts @ here.left + curves @ x[curve]
    own = (contrasts * here.std**2) @ contrasts.T
    shared = contrasts[:, : len(case.marks)] @ contrasts[:, : len(case.marks)].T
    smooth = 0.0 if network.curve is None else curves @ np.linalg.inv(network.curve.precision) @ curves.T

    def value(case: Case) -> float:
        found = _unlikely_spreads(case)
        if len(seen):
            root = np.linalg.cholesky(own + case.pair_m**2 * shared + case.curve_m**2 * smooth)
            found += 2 * float(np.log(np.diag(root)).sum()) + float(np.sum(np.linalg.solve(root, seen) ** 2))
        return found

    return value


def _spreads(network: Network, x: Floats, case: Case) -> Case:
    """Return a case with the spreads of pairs and curve that are likeliest."""
    value = _unlikely_by_spreads(network, x, case)
    free = np.array([network.pair_m is None, network.curve is not None])

    def unlikely_by(steps: Floats) -> float:
        return value(case.scaled(*np.where(free, steps, 0.0).tolist()))

    # What is known of the spreads beforehand bounds them.
    simplex = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
    found = minimize(
        unlikely_by, np.zeros(2), method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 0.02}
    )
    return case.scaled(*np.where(free, found.x, 0.0).tolist())


def averaged(found: Solution) -> Solution:
    """Return the mean over what is nearly as likely, with the covariance that the other possibilities add.

    These are other choices of reflected means and, where there is a curve, other spreads of pairs and curve: few pairs
    say little of how large a curve is, and what all delays share depends on it.
    """
    network, x, case = found.network, found.x, found.case
    marks, weight = Marks.at(network, x, case).window()
    mean, more = _mixed(found, [replace(case, marks=one) for one in marks], weight)
    if network.curve is not None:
        value = _unlikely_by_spreads(network, x, case)
        # Steps of logarithms of about half of what a survey knows of either.
        steps = [(0.3 * i, 0.4 * k) for i in range(-2, 3) for k in range(-4, 5) if network.pair_m is None or not i]
        cases = [case.scaled(*step) for step in steps]
        worse = np.array([value(one) for one in cases])
        likely = np.exp(-0.5 * (worse - worse.min()))
        kept = np.flatnonzero(likely > 1e-3)
        step, wider = _mixed(found, [cases[k] for k in kept.tolist()], likely[kept] / likely[kept].sum())
        mean, more = mean + step, more + wider
    return replace(found, x=x + mean, chance=weight @ np.array(marks), more=more)


def _mixed(found: Solution, cases: Sequence[Case], weight: Floats) -> tuple[Floats, Floats]:
    """Return the mean step over cases, linear, and what their covariance is more than that of one case, not below 0."""

    def solved(case: Case) -> tuple[Floats, Floats]:
        here = found.network.at(found.x, case)
        spread = here.covariance()
        return spread @ (here.jacobian.T @ (here.left / here.std**2) - here.prior @ here.away), spread

    own = solved(found.case)[1]
    every = [solved(case) for case in cases]
    steps = np.array([step for step, _ in every])
    mean = weight @ steps
    around = steps - mean
    wider = sum(w * (spread - own) for w, (_, spread) in zip(weight, every, strict=True)) + (around.T * weight) @ around
    values, vectors = np.linalg.eigh((wider + wider.T) / 2)
    return mean, (vectors * np.maximum(values, 0.0)) @ vectors.T


def solve(network: Network, *, moves: int = 6) -> tuple[Solution, SecondBest | None]:
    """Return the best solution that any start leads to, and the second-best."""
    start, least = first_start(network), attrgetter("unlikely")
    spreads = PAIR_STARTS_M if network.pair_m is None else (network.pair_m,)
    found = min((adjust(network, start, start_m=spread) for spread in spreads), key=least)
    # Once more with the delays that came out: the first guess of places was made without any.
    found = min(found, adjust(network, first_start(network, found.delays)), key=least)
    wrong = out_of_order(network, found.x)
    if wrong:
        start = start_in_order(network, found.x, wrong)
        found = min(found, adjust(network, start), key=least)
    worse: list[tuple[float, tuple[str, tuple[int, ...]]]] = []
    for _ in range(moves):
        here = unlikelihood(network, found.x, found.case)
        others = [other for k in range(len(network.arrangements)) for other in _other_solutions(found, k)]
        # Rounded, so that of mirror images the same one is named on every machine.
        worse = [(round(value - here, 3), who) for value, _, _, who in others if value >= here - 1e-3]
        better = [other for other in others if other[0] < here - 1e-3]
        if not better:
            break
        _, x, case, _ = min(better, key=itemgetter(0))
        moved = adjust(network, x, marks=case.marks)
        if moved.unlikely > found.unlikely - 1e-3:
            break
        found = moved
    if not worse:
        return found, None
    gap, (name, tags) = min(worse)
    return found, SecondBest(name, tags, max(0.0, gap))


def optimize_with_marks(network: Network, x: Floats, case: Case, only: int | None = None) -> tuple[float, Floats, Case]:
    """Return -2 log likelihood, the unknowns and the case with what is likeliest reflected, from a start."""
    for _ in range(2):
        x, _ = optimize(network, x, case, only)
        marks = Marks.at(network, x, case, only).searched()
        if np.array_equal(marks, case.marks):
            break
        case = replace(case, marks=marks)
        x, _ = optimize(network, x, case, only)
    return unlikelihood(network, x, case, only), x, case


def _other_solutions(
    found: Solution, arrangement: int
) -> Iterator[tuple[float, Floats, Case, tuple[str, tuple[int, ...]]]]:
    """Yield other solutions that differ in one arrangement: how likely, unknowns, errors, and who is elsewhere."""
    network, mine = found.network, found.network.rows_of(arrangement)
    seats = network.seats(arrangement)
    if not mine.any():
        return
    straight = replace(found.case, marks=found.case.marks & ~mine)
    seen = [_signature(network, found.x, seats)]
    here = unlikelihood(network, found.x, found.case, arrangement)
    for start in other_starts(network, found.x, arrangement):
        value, x, case = optimize_with_marks(network, start, straight, arrangement)
        mark = _signature(network, x, seats)
        if value > here + MAX_WORSE_ALONE or any(float(np.abs(mark - one).max()) < MIN_DIFFERENCE_M for one in seen):
            continue
        seen.append(mark)
        value, x, case = optimize_with_marks(network, x, case)
        change = np.abs(_signature(network, x, seats) - seen[0]).max(axis=1)
        if change.max() >= MIN_DIFFERENCE_M:
            tags = np.array(network.arrangements[arrangement].tags)[change > max(MIN_DIFFERENCE_M, 0.5 * change.max())]
            yield value, x, case, (network.arrangements[arrangement].name, tuple(tags.tolist()))


def _signature(network: Network, x: Floats, seats: Ints) -> Floats:
    """Return what tells two solutions apart (points, k): distances to all others, and places where a frame is known."""
    place = network.positions(x)[seats]
    apart = np.linalg.norm(place[:, None] - place, axis=2)
    return np.hstack([apart, place]) if len(network.known.at) else apart
