"""What contradicts the ranges: single pairs, known distances, shapes that are none, labels that were exchanged.

Each doubt is a hypothesis with a few unknowns more. What it explains of the weighed squares, over what it leaves, has
Fisher's F where nothing is wrong; the likeliest hypothesis is taken first, because a wrong tape makes pairs look wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from calib.surveys.adjustment import PAIR_WORTH, Adjusted, adjust, leverages, settle
from calib.surveys.network import Network, Place
from calib.surveys.starts import first_start, scaled
from uwblink.arrays import Floats

ALARM: Final = 1e-3
"""Probability of a false alarm of all hypotheses of one survey together."""

LEAST_SHARE: Final = 0.02
"""Share of its variance that the fit must leave of a row before it can be doubted."""

LIFT_M: Final = 0.15


@dataclass(frozen=True, slots=True)
class Doubt:
    """What may be wrong: its kind, in words, how many unknowns more it has, the network without it, and a start."""

    kind: str
    text: str
    unknowns: int
    instead: Network
    start: Floats


def worst(found: Adjusted, names: tuple[str, ...], pair_std_m: float | None = None) -> Doubt | None:
    """Return the likeliest doubt that chance does not explain; `names` say what each known distance is called."""
    every = [*_pairs(found), *_distances(found, names), *_shapes(found)]
    rated = [(chance(found, d.instead, d.start, d.unknowns, pair_std_m), k) for k, d in enumerate(every)]
    if min(rated, default=(1.0, 0))[0] < ALARM:
        # Exchanged labels make something else look wrong, too; there are many pairs of labels to look at.
        more = list(_exchanged(found))
        rated += [
            (chance(found, d.instead, d.start, d.unknowns, pair_std_m), len(every) + k) for k, d in enumerate(more)
        ]
        every += more
    least, k = min(rated, default=(1.0, 0))
    # Of the pairs, which are many, the three oddest stand for all.
    return every[k] if least * (len(every) + len(found.network.means)) < ALARM else None


def chance(found: Adjusted, instead: Network, start: Floats, unknowns: int, pair_std_m: float | None) -> float:
    """Return how probable it is by chance that so many more unknowns explain so much of the weighed squares.

    The errors of pairs are weighed as they are without what is doubted: with it they would seem large enough for it.
    """
    from scipy.special import fdtrc

    without = adjust(instead, start, pair_std_m=pair_std_m, rounds=2)
    left = without.freedom + PAIR_WORTH
    if left < 1:
        return 1.0
    std = found.network.std_m(without.pair_std_m)
    _, weighed, _ = settle(found.network, found.x, std, without.curve_std_m)
    explained = max(weighed - without.weighed, 0.0)
    return float(fdtrc(unknowns, left, (explained / unknowns) / ((without.weighed + PAIR_WORTH) / left)))


def _standardized(found: Adjusted) -> tuple[Floats, Floats]:
    """Return the squares (n,) that each row would take along if it were left out, and which rows are controlled."""
    left = leverages(found)
    squares = (found.residuals_m / found.std_m) ** 2 / np.maximum(left, LEAST_SHARE)
    return np.where(left > LEAST_SHARE, squares, 0.0), left


def _pairs(found: Adjusted) -> Iterator[Doubt]:
    squares, left = _standardized(found)
    m, network = found.network.means, found.network
    for k in np.argsort(-squares[: len(m)])[:3].tolist():
        off = found.residuals_m[k] / max(left[k], LEAST_SHARE)
        where = network.places[int(m.arrangement[k])].name
        text = f"{where}: the range of {m.first[k]} and {m.second[k]} is {_cm(off)} off what all others say; left out"
        yield Doubt("pair", text, 1, network.without([k]), found.x)


def _distances(found: Adjusted, names: tuple[str, ...]) -> Iterator[Doubt]:
    left = leverages(found)
    network, known = found.network, found.network.known
    first = len(network.means)
    for statement in np.unique(known.distance_of).tolist():
        rows = np.flatnonzero(known.distance_of == statement)
        off = float(np.mean(found.residuals_m[first + rows] / np.maximum(left[first + rows], LEAST_SHARE)))
        keep = known.distance_of != statement
        less = replace(
            known,
            ends=known.ends[keep],
            distance_m=known.distance_m[keep],
            distance_std_m=known.distance_std_m[keep],
            distance_of=known.distance_of[keep],
        )
        text = f"{names[statement]} is {_cm(off)} off what the ranges say; measure it again or leave it out"
        yield Doubt("distance", text, len(rows), replace(network, known=less), found.x)


def _shapes(found: Adjusted) -> Iterator[Doubt]:
    network = found.network
    for k, place in enumerate(network.places):
        more = len(place.tags) - 1 - place.dimensions
        if place.dimensions == 3 or more < 1 or found.freedom + PAIR_WORTH - more < 1:
            continue
        places = list(network.places)
        places[k] = Place(place.name, place.dimensions + 1, place.tags)
        freed = replace(network, places=tuple(places))
        x = _lifted(found, freed, k)
        std = freed.std_m(found.pair_std_m)
        x, _, _ = settle(freed, x, std, found.curve_std_m)
        away = np.abs(freed.positions(x)[:, place.dimensions][[a == k for a, _ in freed.points]])
        shape, who = ("line", "straight") if place.dimensions == 1 else ("plane", "plane")
        odd = place.tags[int(np.argmax(np.abs(away - np.median(away))))]
        text = (
            f"{place.name} is said to be a {shape} and is none: its ranges fit if boards, {odd} first of all, stand up "
            f"to {_cm(float(np.ptp(away)), sign=False)} beside it; put them {who}, or do not say so"
        )
        yield Doubt("shape", text, more, freed, x)


def _lifted(found: Adjusted, freed: Network, arrangement: int) -> Floats:
    """Return unknowns of a network with one dimension more, in which that arrangement begins anew."""
    network = found.network
    x = np.concatenate([np.zeros(freed.coordinates), found.x[network.coordinates :]])
    place = network.positions(found.x)
    here = [k for k, (a, _) in enumerate(network.points) if a == arrangement]
    apart = np.linalg.norm(place[here][:, None] - place[here], axis=2)
    number = {point: k for k, point in enumerate(here)}
    measured = network.means.range_m - network.linear @ found.x
    for (i, j), length in zip(network.ends.tolist(), measured.tolist(), strict=True):
        if i in number and j in number:
            apart[number[i], number[j]] = apart[number[j], number[i]] = max(length, 0.01)
    place[here] = 0.0
    points = scaled(apart, freed.places[arrangement].dimensions)
    # Where scaling finds nothing beside the line, a derivative there would be zero.
    points[:, -1] += LIFT_M * np.where(np.arange(len(here)) % 2, 1.0, -1.0) * (np.ptp(points[:, -1]) < LIFT_M)
    place[np.array(here), : points.shape[1]] = points
    return freed.with_positions(x, place)


def _exchanged(found: Adjusted) -> Iterator[Doubt]:
    """Yield what is known with two tags' names exchanged."""
    network, known = found.network, found.network.known
    involved = {network.points[k][1] for k in [*known.ends.ravel().tolist(), *known.at.tolist()]}
    for one, other in combinations(sorted(involved), 2):
        swap = {one: other, other: one}
        number = [network.point_of.get((a, swap.get(t, t)), k) for k, (a, t) in enumerate(network.points)]
        instead = replace(known, ends=np.array(number)[known.ends], at=np.array(number)[known.at])
        changed = replace(network, known=instead)
        start = first_start(changed, found.x[network.delay_columns])
        text = f"what is known fits if {one} and {other} are exchanged: look at the labels of these two boards"
        yield Doubt("labels", text, 1, changed, start)


def _cm(length_m: float, *, sign: bool = True) -> str:
    return f"{100 * length_m:+.0f} cm" if sign else f"{100 * length_m:.0f} cm"
