"""The solution of a network: the start of a search, the likeliest unknowns, the sizes of errors, and other solutions.

A search begins at a multidimensional scaling of the ranges. The order of boards on a line may be stated: an order and
its reverse are the same, because a line has no first end, and boards within 10 cm of each other may be in either order,
because they are side by side.

For given errors `calib.estimator.optimize` finds the unknowns. The constant error of pairs and the spread of the curve
maximise the likelihood integrated over the unknowns (restricted maximum likelihood: Patterson and Thompson, Biometrika,
1971) with weak priors, since a small network determines neither well. By the same likelihood solutions with different
reflections, orders and spreads are compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise
from operator import attrgetter, itemgetter

import numpy as np
from scipy.linalg import orthogonal_procrustes
from scipy.optimize import minimize_scalar

from calib.estimator.inverse import positive_part
from calib.estimator.optimize import maximize
from calib.estimator.scaling import scaled_places
from calib.surveys.network import Boards, Case, Lengths, Linear, Network
from calib.surveys.reflections import Marks, deviance_of_count
from calib.surveys.result import SecondBest
from uwblink.arrays import Bools, Floats, Ints

RANDOM_STARTS = 4
"""Random starts of an arrangement beside those that are mirrored or exchanged: half or twice as many change nothing
(`python -m benchmarks.constants`)."""


def is_in_order(coordinates: Floats) -> bool:
    """Return whether coordinates (n,) of boards in their stated order increase or decrease throughout."""
    ways = coordinates, coordinates[::-1]
    # Boards within 10 cm of each other are side by side: they touch, and their order has no meaning.
    return any(float(np.max(np.maximum.accumulate(v) - v)) <= 0.1 for v in ways)


def exchanged_boards(stated: Sequence[int], coordinates: Floats) -> set[tuple[int, int]]:
    """Return two boards that must change places so that the boards `stated`, at coordinates (n,), are in order; or
    nothing.

    Returns more than one pair if the ranges do not distinguish them: 1-2-3-4 with the inner two exchanged is the same
    as with the outer two exchanged, from the other end.
    """
    fitting = set()
    for i, j in combinations(range(len(stated)), 2):
        changed = coordinates.copy()
        changed[[i, j]] = coordinates[[j, i]]
        if is_in_order(changed):
            fitting.add((min(stated[i], stated[j]), max(stated[i], stated[j])))
    return fitting


def first_start(network: Network, delays: Floats | None = None) -> Floats:
    """Return unknowns from the ranges alone, with delays (tags,) in ns, or none: by classical scaling."""
    x = network.layout.start()
    if delays is not None:
        x[network.layout.where["delay"]] = delays
    place = np.zeros((len(network.points), 3))
    measured = network.linear(np.where(np.arange(len(x)) < place.size, 0.0, x))[0]  # with all points at the origin
    for k, boards in enumerate(network.arrangements):
        here = network.members(k)
        rows = np.flatnonzero(np.isin(network.ends[: len(network.means.range_m), 0], here))
        ends, length = np.searchsorted(here, network.ends[rows]), np.maximum(measured[rows], 0.01)
        # The derivative by a coordinate that is zero for all boards would be zero.
        found = scaled_places(ends, length, len(here), boards.dimensions, least_m2=1e-6)
        known = [n for n, point in enumerate(here.tolist()) if point in network.known_places]
        if known:
            goal, mine = np.array([network.known_places[here[n]][0] for n in known]), found[known]
            turn = orthogonal_procrustes(mine - mine.mean(axis=0), goal - goal.mean(axis=0))[0]
            found = (found - mine.mean(axis=0)) @ turn + goal.mean(axis=0)
        place[here] = found
    return network.with_positions(x, place)


def other_starts(points: Floats, boards: Boards, seed: int) -> Iterator[Floats]:
    """Yield other places (n, 3) of boards: neighbours exchanged, in the stated order, mirrored, or randomly
    displaced.
    """
    if boards.order:
        rows = [boards.tags.index(tag) for tag in boards.order]
        upward = points[sorted(rows, key=lambda row: float(points[row, 0]))]
        for places in (upward, upward[::-1]):
            yield _replaced(points, rows, places)
    if boards.dimensions == 1:
        for a, b in pairwise(np.argsort(points[:, 0]).tolist()):
            yield _replaced(points, [a, b], points[[b, a]])
    middle = points - points.mean(axis=0)
    _, size, axes = np.linalg.svd(middle)
    if boards.dimensions > 1:
        # Mirrored at the plane in which boards nearly lie: a board on one side might be on the other.
        normal = axes[boards.dimensions - 1]
        yield points - 2 * np.outer(middle @ normal, normal)
    rng, spread = np.random.default_rng(seed), max(float(size[0]) / np.sqrt(len(points)), 0.1)
    for _ in range(RANDOM_STARTS):
        yield points + 0.5 * spread * rng.normal(size=points.shape)


def _replaced(points: Floats, rows: list[int], places: Floats) -> Floats:
    found = points.copy()
    found[rows] = places
    return found


PAIR_STD_M, PAIR_PRIOR_FREEDOM = 0.02, 3.0
"""Prior standard deviation of the constant error of a pair, and the degrees of freedom that it counts as.
Half or twice of either moves delays beside reflections by 0.29 standard errors, which become 0.93 to 1.3 times as large
(`python -m benchmarks.constants`)."""


CURVE_STD_M, CURVE_FACTOR = 0.1, 1.7
"""Prior standard deviation of a curve, and the factor of its uncertainty (`CURVE_LENGTH_DB`)."""


MAX_WORSE_ALONE = 60.0
"""Maximum increase of -2 log likelihood of one arrangement's other solution for which the whole network is solved with
it: half or twice of it does not change results (`python -m benchmarks.constants`)."""


@dataclass(frozen=True, kw_only=True)
class Solution:
    """The best unknowns `x` (p,) of a network, and their errors.

    `deviance` is -2 log of the total likelihood, up to a constant that all solutions of one set of means share.
    `chance` (n,) is the probability of each mean of being reflected, and `more` (p, p) the covariance that is added
    because other means may be reflected, or spreads may differ.
    """

    network: Network
    x: Floats
    case: Case
    deviance: float
    settled: bool
    chance: Floats
    more: Floats

    @property
    def delays(self) -> Floats:
        """The delays (tags,), ns."""
        return self.x[self.network.layout.where["delay"]]

    @cached_property
    def linear(self) -> Linear:
        """The network about the unknowns."""
        return Linear(self.network, self.x, self.case)

    @property
    def freedom(self) -> float:
        """The remaining degrees of freedom: the number of rows minus the effective number of unknowns."""
        return float(len(self.linear.left) - np.sum(self.linear.covariance * self.linear.information))

    def covariance(self) -> Floats:
        """Return the covariance (p, p), with the priors of delays, so that it always exists."""
        return np.asarray(self.linear.covariance + self.more)

    def information(self) -> Floats:
        """Return the information (p, p) of measurements and known facts."""
        # The inverse of the sum of two covariances, the first of which may be infinite.
        wider = np.linalg.solve(np.eye(len(self.x)) + self.linear.known @ self.more, self.linear.known)
        return np.asarray((wider + wider.T) / 2)


def optimize(network: Network, x: Floats, case: Case) -> tuple[Floats, bool]:
    """Return the likeliest unknowns from a start, and whether the search converged."""
    places = network.layout.where["place"]
    found = maximize(
        [Lengths(network, case)],
        network.priors(case.curve_m),
        x,
        evidence_steps=0,
        tolerance=1e-6,
        longest=lambda step: 1 / max(1.0, float(np.abs(step[places]).max(initial=0.0))),
    )
    return found.x, found.success


def of_spreads(network: Network, x: Floats, case: Case) -> float:
    """Return -2 log likelihood near an optimum, integrated over the unknowns, with the prior density of the spreads."""
    pairs = PAIR_PRIOR_FREEDOM * (2 * math.log(case.pair_m) + (PAIR_STD_M / case.pair_m) ** 2)
    curve = (math.log(case.curve_m / CURVE_STD_M) / math.log(CURVE_FACTOR)) ** 2
    return Linear(network, x, case).deviance() + pairs + curve


def total_deviance(network: Network, x: Floats, case: Case) -> float:
    """Return the same plus -2 log probability of the reflections and of the order of the boards."""
    value = of_spreads(network, x, case) + deviance_of_count(int(case.marks.sum()), len(case.marks))
    if case.marks.any():
        value += float(Marks.at(network, x, case).penalties()[case.marks].sum())
    # One stated order in a hundred is wrong.
    return value + 2 * math.log(100.0) * len(out_of_order(network, x))


def out_of_order(network: Network, x: Floats) -> list[int]:
    """Return the arrangements in which boards are not in the stated order."""
    points = network.positions_m(x)
    return [
        k
        for k, boards in enumerate(network.arrangements)
        if boards.order and not is_in_order(points[[network.points[k, tag] for tag in boards.order], 0])
    ]


def find_reflected_means(network: Network, x: Floats, case: Case) -> tuple[Floats, Case]:
    """Return the unknowns from a start, and the case with the likeliest reflected means."""
    for _ in range(2):
        x, _ = optimize(network, x, case)
        before, case = case.marks, replace(case, marks=Marks.at(network, x, case).search())
        if np.array_equal(before, case.marks):
            return x, case
    return optimize(network, x, case)[0], case


def adjust(network: Network, x: Floats, *, marks: Bools | None = None, start_m: float = PAIR_STD_M) -> Solution:
    """Return the best unknowns from a start, with the spreads and the reflected means estimated alternately.

    `start_m` is the start value of the constant error of pairs, if this is unknown, and `marks` (n,) are the reflected
    means at the start.
    """
    none = np.zeros(len(network.means.range_m), dtype=bool)
    case = Case(none if marks is None else marks, network.pair_m or start_m, CURVE_STD_M)
    # At most six rounds; they end if the spread changes by 2 % at most.
    for _ in range(6):
        before = case
        x, case = find_reflected_means(network, x, case)
        case = _spreads(network, x, case)
        if abs(case.pair_m - before.pair_m) < 0.02 * case.pair_m and np.array_equal(case.marks, before.marks):
            break
    x, settled = optimize(network, x, case)
    return Solution(
        network=network,
        x=x,
        case=case,
        deviance=total_deviance(network, x, case),
        settled=settled,
        chance=case.marks.astype(float),
        more=np.zeros((len(x),) * 2),
    )


def _spreads(network: Network, x: Floats, case: Case) -> Case:
    """Return a case with the likeliest spread of pairs, and then of the curve."""
    for pair, curve in ((network.pair_m is None, False), (False, network.curve is not None)):
        if pair or curve:
            found = minimize_scalar(
                lambda step, pair=pair, curve=curve, case=case: of_spreads(
                    network, x, case.scaled(pair * step, curve * step)
                ),
                bounds=(-1.0, 1.0),
                options={"xatol": 0.01},
            )
            case = case.scaled(pair * found.x, curve * found.x)
    return case


def averaged(found: Solution) -> Solution:
    """Return the mean over nearly equally likely cases, with the covariance that the other cases add.

    These are other choices of reflected means and, where there is a curve, other spreads of pairs and curve: few pairs
    determine the size of a curve poorly, and the common part of all delays depends on it.
    """
    network, x, case = found.network, found.x, found.case
    marks, weight = Marks.at(network, x, case).window()
    mean, more = _average_cases(found, [replace(case, marks=one) for one in marks], weight)
    if network.curve is not None:
        # Steps of logarithms, about half of the standard error of either in a survey.
        steps = [(0.3 * i, 0.4 * k) for i in range(-2, 3) for k in range(-4, 5) if network.pair_m is None or not i]
        cases = [case.scaled(*step) for step in steps]
        worse = np.array([of_spreads(network, x, one) for one in cases])
        likely = np.exp(-0.5 * (worse - worse.min()))
        step, wider = _average_cases(found, cases, likely / likely.sum())
        mean, more = mean + step, more + wider
    return replace(found, x=x + mean, chance=weight @ np.array(marks), more=more)


def _average_cases(found: Solution, cases: Sequence[Case], weight: Floats) -> tuple[Floats, Floats]:
    """Return the mean step over linearized cases, and the excess of their covariance over the covariance of one case,
    at least 0.
    """
    every = [Linear(found.network, found.x, case) for case in cases]
    steps = np.array([one.step for one in every])
    mean = weight @ steps
    around = steps - mean
    wider = sum(w * one.covariance for w, one in zip(weight, every, strict=True)) - found.linear.covariance
    return mean, positive_part(wider + (around.T * weight) @ around)


def solve(network: Network) -> tuple[Solution, SecondBest | None]:
    """Return the best solution from all starts, and the second-best."""
    start, least = first_start(network), attrgetter("deviance")
    # With small errors of pairs too many means seem reflected at first, with large ones too few.
    spreads = (0.01, 0.015, 0.02, 0.03, 0.045, 0.07) if network.pair_m is None else (network.pair_m,)
    found = min((adjust(network, start, start_m=spread) for spread in spreads), key=least)
    # Again with the estimated delays: the first guess of places was made without delays.
    found = min(found, adjust(network, first_start(network, found.delays)), key=least)
    worse: list[SecondBest] = []
    # At most six moves to another solution.
    for _ in range(6):
        here = total_deviance(network, found.x, found.case)
        others = [other for k in range(len(network.arrangements)) for other in _other_solutions(found, k)]
        # Rounded, so that every machine chooses the same one of mirror images.
        worse = [
            SecondBest(*who, max(0.0, round(value - here, 3))) for value, _, _, who in others if value > here - 1e-3
        ]
        value, x, case, _ = min(others, key=itemgetter(0), default=(here, found.x, found.case, None))
        moved = adjust(network, x, marks=case.marks) if value < here - 1e-3 else found
        if moved.deviance > found.deviance - 1e-3:
            break
        found = moved
    return found, min(worse, key=attrgetter("worse", "arrangement", "tags"), default=None)


def _other_solutions(
    found: Solution, arrangement: int
) -> Iterator[tuple[float, Floats, Case, tuple[str, tuple[int, ...]]]]:
    """Yield other solutions that differ in one arrangement: likelihood, unknowns, errors, and the displaced boards."""
    network = found.network
    boards, members = network.arrangements[arrangement], network.members(arrangement)
    alone, mine = network.alone(arrangement), network.means.arrangement == arrangement
    case = replace(found.case, marks=found.case.marks[mine])
    # A solution counts as another one if a board moves by 3 cm.
    least_m = 0.03
    most, seen = total_deviance(alone, found.x, case) + MAX_WORSE_ALONE, [_signature(network, found.x, members)]
    for points in other_starts(network.positions_m(found.x)[members], boards, seed=arrangement):
        start = network.with_positions(found.x, points, members)
        x, own = find_reflected_means(alone, start, replace(case, marks=np.zeros_like(case.marks)))
        mark = _signature(network, x, members)
        if total_deviance(alone, x, own) > most or any(np.abs(mark - one).max() < least_m for one in seen):
            continue
        seen.append(mark)
        marks = found.case.marks.copy()
        marks[mine] = own.marks
        x, whole = find_reflected_means(network, x, replace(found.case, marks=marks))
        change = np.abs(_signature(network, x, members) - seen[0]).max(axis=1)
        if change.max() >= least_m:
            tags = np.array(boards.tags)[change > max(least_m, 0.5 * change.max())]
            yield total_deviance(network, x, whole), x, whole, (boards.name, tuple(tags.tolist()))


def _signature(network: Network, x: Floats, members: Ints) -> Floats:
    """Return the features (points, k) that distinguish solutions of an arrangement: distances, and places if a frame is
    known.
    """
    place = network.positions_m(x)[members]
    apart = np.linalg.norm(place[:, None] - place, axis=2)
    return np.hstack([apart, place]) if network.known_places.keys() & set(members.tolist()) else apart
