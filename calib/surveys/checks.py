"""What contradicts the ranges: wrong known distances, wrong shapes, exchanged labels.

Each check compares hypotheses of a fault with the survey as described, each with the reflections that fit it best: a
few reflected pairs can look like a string that is not straight. The statistic is the ratio of the likelihoods,
integrated over the unknowns; by Markov's inequality it exceeds 1/p with a probability of at most p where nothing is
wrong. The likeliest hypothesis is taken first, because a wrong tape makes other things look wrong, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calib.surveys.network import Network
from calib.surveys.result import Contradiction
from calib.surveys.solution import Solution, adjust, optimize_with_marks, out_of_order, unlikelihood
from calib.surveys.starts import exchanged_boards, first_start, line_coordinates
from uwblink.arrays import Floats

FALSE_ALARMS = 0.01
"""Share of sound surveys in which a check may find something."""

MIN_SHAPE_GAIN = 1.0
"""Fall of -2 log likelihood of one arrangement from which its shape is tested; of up to three, all are tested."""

MIN_LABEL_SIGMAS = 3.0
"""Standard deviations by which a known distance or position must be off for labels to be tested."""

TAPE_ERROR_M = 0.5
"""Standard deviation of the error of a wrong tape, before any data."""

MIN_VARIANCE_SHARE = 0.02
"""Share of its variance that the fit must leave of a known distance for its error to be seen."""

START_BESIDE_M = 0.15
"""How far boards are put beside a line, or plane, at the start of a search: on it a derivative would be zero."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A possible fault in words, the network without it, a start, and -2 log of the prior density of its size."""

    text: str
    network: Network
    start: Floats
    beforehand: float = 0.0


def likeliest_fault(found: Solution) -> tuple[Contradiction, Solution] | None:
    """Return the likeliest fault that chance does not explain, and the solution without it."""
    best: tuple[float, Contradiction, Solution] | None = None
    for name, (hypotheses, remedy) in CHECKS.items():
        for one in hypotheses(found):
            without = adjust(one.network, one.start)
            p_value = math.exp(min(0.5 * (without.unlikely + one.beforehand - found.unlikely), 0.0))
            if p_value < FALSE_ALARMS and (best is None or without.unlikely + one.beforehand < best[0]):
                finding = Contradiction(name, f"{one.text}; {remedy}", p_value)
                best = without.unlikely + one.beforehand, finding, without
    return None if best is None else best[1:]


def _of_known(found: Solution) -> tuple[Floats, Floats, Floats]:
    """Return residuals (k,) of known distances and positions, their standard deviations, and the shares of variance
    that the fit leaves of them."""
    here, known = found.network.at(found.x, found.case), slice(len(found.network.means), None)
    rows, std = here.jacobian[known], here.std[known]
    share = 1 - np.einsum("ij,jk,ik->i", rows, here.covariance(), rows) / std**2
    return here.left[known], std, np.clip(share, 1e-9, 1.0)


def _distances(found: Solution) -> Iterator[Hypothesis]:
    """Yield the network without each of the known distances."""
    network, known = found.network, found.network.known
    left, _, share = _of_known(found)
    for statement in np.unique(known.statement).tolist():
        rows = np.flatnonzero(known.statement == statement)
        off = float(np.mean(left[rows] / np.maximum(share[rows], MIN_VARIANCE_SHARE)))
        keep = known.statement != statement
        less = replace(
            known,
            ends=known.ends[keep],
            distance_m=known.distance_m[keep],
            distance_std_m=known.distance_std_m[keep],
            statement=known.statement[keep],
        )
        # The rows go, and with them what they say of likelihood: as if the tape were wrong by some half a metre.
        std = np.append(known.distance_std_m[rows][1:], TAPE_ERROR_M)
        beforehand = 2 * float(np.log(std).sum()) + (off / TAPE_ERROR_M) ** 2
        text = f"{known.names[statement]} is {100 * off:+.0f} cm off what the ranges say"
        yield Hypothesis(text, replace(network, known=less), found.x, beforehand)


def _shapes(found: Solution) -> Iterator[Hypothesis]:
    """Yield the network with each arrangement beside the line, or plane, that it is said to be on."""
    network = found.network
    for k, boards in enumerate(network.arrangements):
        if boards.dimensions == 3 or len(boards.tags) < boards.dimensions + 2 or boards.freed:
            continue
        arrangements = list(network.arrangements)
        arrangements[k] = replace(boards, dimensions=boards.dimensions + 1, freed=True)
        freed = replace(network, arrangements=tuple(arrangements))
        seats, beside = network.seats(k), boards.dimensions
        place = network.positions(found.x)
        place[seats] = freed.positions(first_start(freed, found.delays))[seats]
        # Where scaling finds nothing beside the line, a derivative there would be zero.
        if np.ptp(place[seats, beside]) < START_BESIDE_M:
            place[seats, beside] += START_BESIDE_M * np.where(np.arange(len(seats)) % 2, 1.0, -1.0)
        mine = replace(found.case, marks=found.case.marks & ~network.rows_of(k))
        value, x, _ = optimize_with_marks(freed, freed.with_positions(found.x, place), mine, k)
        alone = unlikelihood(network, found.x, found.case, k)
        if alone - value < MIN_SHAPE_GAIN and len(network.arrangements) > 3:
            continue
        away = freed.positions(x)[seats, beside]
        odd = boards.tags[int(np.argmax(np.abs(away - np.median(away))))]
        shape = "line" if boards.dimensions == 1 else "plane"
        text = (
            f"{boards.name} is said to be a {shape} and is none: its ranges fit if boards, {odd} first of all, stand "
            f"up to {100 * np.ptp(away):.0f} cm beside it"
        )
        yield Hypothesis(text, freed, x)


def _exchanged(found: Solution) -> Iterator[Hypothesis]:
    """Yield the network with two tags exchanged in what is known, where something known is off or reflected."""
    network, known = found.network, found.network.known
    left, std, share = _of_known(found)
    if not (np.abs(left) > MIN_LABEL_SIGMAS * std * np.sqrt(share)).any() and not (
        len(left) and found.case.marks.any()
    ):
        return
    points = list(network.points)
    involved = {points[k][1] for k in [*known.ends.ravel().tolist(), *known.at.tolist()]}
    for one, other in combinations(sorted(involved), 2):
        swap = {one: other, other: one}
        new = np.array([network.points.get((a, swap.get(t, t)), k) for k, (a, t) in enumerate(points)])
        changed = replace(network, known=replace(known, ends=new[known.ends], at=new[known.at]))
        text = f"what is known fits if {one} and {other} are exchanged"
        yield Hypothesis(text, changed, first_start(changed, found.delays))


CHECKS = {
    "distance": (_distances, "measure it again or leave it out"),
    "shape": (_shapes, "put the boards as is said, or do not say so"),
    "labels": (_exchanged, "look at the labels of these two boards"),
}
"""The checks by what may be wrong: the hypotheses, and what to do where one is true."""


def wrong_orders(found: Solution) -> Iterator[Contradiction]:
    """Yield the contradictions between the stated orders of boards on a line and the ranges.

    What several arrangements have in common is one contradiction.
    """
    network = found.network
    points = network.positions(found.x)
    mistakes: list[tuple[set[tuple[int, int]], list[int], Floats]] = []
    for k in out_of_order(network, found.x):
        boards = network.arrangements[k]
        spot = line_coordinates(points[network.seats(k)], boards.tags, boards.order)
        pairs = exchanged_boards(boards.order, spot)
        same = next((n for n, (known, _, _) in enumerate(mistakes) if known & pairs), None)
        if same is None:
            mistakes.append((pairs, [k], spot))
        else:
            known, rows, first = mistakes[same]
            mistakes[same] = known & pairs, [*rows, k], first
    for pairs, rows, spot in mistakes:
        wrong = [network.arrangements[k] for k in rows]
        said = wrong[0].order
        forward = np.corrcoef(np.arange(len(spot)), spot)[0, 1] > 0
        way = [said[k] for k in np.argsort(spot if forward else -spot).tolist()]
        words = ", or ".join(f"{i} and {j}" for i, j in sorted(pairs))
        where = ", ".join(boards.name for boards in wrong)
        orders = f"said was {'-'.join(map(str, said))}, the ranges of {wrong[0].name} say {'-'.join(map(str, way))}"
        text = f"{where}: boards {words} stand in each other's place: {orders}; look at the labels of these two"
        if not pairs:
            text = f"{where}: boards stand in another order than said: {orders}; look at their labels"
        yield Contradiction("labels", text, FALSE_ALARMS)
