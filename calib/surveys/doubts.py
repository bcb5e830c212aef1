"""What contradicts the ranges: known distances, shapes that are none, labels that were exchanged.

Each doubt is a hypothesis whose likelihood, whatever its unknowns are, is held against that of the survey as it was
said to be, each with the reflections that fit it best: a few reflected pairs can look like a string that is not
straight. The likeliest doubt is taken first, because a wrong tape makes other things look wrong, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from calib.surveys.adjustment import Adjusted, adjust, leverages
from calib.surveys.minima import alone, found_positions, settled_marks
from calib.surveys.network import Network
from calib.surveys.orders import along, exchanged, in_words
from calib.surveys.starts import first_start
from uwblink.arrays import Floats

SURE: Final = 2 * math.log(100.0)
"""By how much -2 log likelihood must fall for a doubt to be taken: a hundred to one."""

WORTH_A_LOOK: Final = 1.0
"""The same for one arrangement alone, with delays as they are, if there are more than a few: less is no doubt."""

FEW: Final = 3
ODD: Final = 3.0
"""Standard deviations by which something known must be off for labels to be looked at."""

WRONG_TAPE_M: Final = 0.5
BESIDE_M: Final = 0.5
"""How wrong a tape is if it is, and how far boards stand beside a line that is none, before any data."""

LEAST_SHARE: Final = 0.02
"""Share of its variance that the fit must leave of a row before it can be doubted."""

LIFT_M: Final = 0.15


@dataclass(frozen=True, slots=True)
class Doubt:
    """What may be wrong: its kind, in words, the network without it, a start, and how much more unlikely it is before.

    That brings what is known of its size (-2 log), where the network without it knows nothing of it.
    """

    kind: str
    text: str
    instead: Network
    start: Floats
    beforehand: float = 0.0


def worst(found: Adjusted, names: tuple[str, ...], pair_std_m: float | None = None) -> tuple[Doubt, Adjusted] | None:
    """Return the likeliest doubt that chance does not explain; `names` say what each known distance is called."""
    every = [*_distances(found, names), *_shapes(found)]
    if _odd(found):
        every += _exchanged(found)
    if not every:
        return None
    rated = [_rated(found, doubt, pair_std_m) for doubt in every]
    k = max(range(len(every)), key=lambda n: rated[n][0])
    return (every[k], rated[k][1]) if rated[k][0] > SURE else None


def _odd(found: Adjusted) -> bool:
    """Return whether labels are worth a look: what is known is off, or something is where it is known."""
    known, here = found.network.known, len(found.network.means)
    off = np.abs(found.residuals_m[here:]) > ODD * found.std_m[here:] * np.sqrt(leverages(found)[here:])
    return bool(off.any() or (len(known.at) + len(known.ends) and found.network.reflected.any()))


def _rated(found: Adjusted, doubt: Doubt, pair_std_m: float | None) -> tuple[float, Adjusted]:
    """Return by how much -2 log likelihood falls if a doubt is true, and the adjustment then."""
    without = adjust(doubt.instead, doubt.start, pair_std_m=pair_std_m)
    return found.unlikely - without.unlikely - doubt.beforehand, without


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
        # The rows go, and with them what they say of likelihood: as if the tape were wrong by some half a metre.
        std = np.append(known.distance_std_m[rows][1:], WRONG_TAPE_M)
        beforehand = 2 * float(np.log(std).sum()) + (off / WRONG_TAPE_M) ** 2
        yield Doubt("distance", text, replace(network, known=less), found.x, beforehand)


def _shapes(found: Adjusted) -> Iterator[Doubt]:
    network = found.network
    for k, place in enumerate(network.places):
        if place.dimensions == 3 or len(place.tags) < place.dimensions + 2:
            continue
        single, gain = _beside(found, k)
        if gain < WORTH_A_LOOK and len(network.places) > FEW:
            continue
        places = list(network.places)
        places[k] = single.network.places[0]
        freed = replace(network, places=tuple(places))
        x = np.concatenate([np.zeros(freed.coordinates), found.x[network.coordinates :]])
        points = network.positions(found.x)
        points[[n for n, (a, _) in enumerate(network.points) if a == k]] = single.network.positions(single.x)
        x = freed.with_positions(x, points)
        away = single.network.positions(single.x)[:, place.dimensions]
        shape, who = ("line", "straight") if place.dimensions == 1 else ("plane", "plane")
        odd = place.tags[int(np.argmax(np.abs(away - np.median(away))))]
        text = (
            f"{place.name} is said to be a {shape} and is none: its ranges fit if boards, {odd} first of all, stand up "
            f"to {_cm(float(np.ptp(away)), sign=False)} beside it; put them {who}, or do not say so"
        )
        yield Doubt("shape", text, freed, x)


@dataclass(frozen=True, slots=True)
class _Single:
    network: Network
    x: Floats


def _beside(found: Adjusted, arrangement: int) -> tuple[_Single, float]:
    """Return an arrangement alone in one dimension more, delays as they are, and by how much that is likelier."""
    flat = alone(found, arrangement)
    place = flat.places[0]
    here = settled_marks(flat, found, flat.with_positions(flat.centre(), found_positions(found, arrangement)))[0]
    freed = replace(flat, places=(replace(place, dimensions=place.dimensions + 1, beside_m=BESIDE_M),))
    freed = freed.marked(np.zeros_like(freed.reflected))
    points = first_start(freed, np.array([flat.fixed_m[tag] for tag in flat.tags]))
    place_m = freed.positions(points)
    last = place.dimensions
    # Where scaling finds nothing beside the line, a derivative there would be zero.
    if np.ptp(place_m[:, last]) < LIFT_M:
        place_m[:, last] += LIFT_M * np.where(np.arange(len(place_m)) % 2, 1.0, -1.0)
    there, x, marked = settled_marks(freed, found, freed.with_positions(points, place_m))
    return _Single(marked, x), here - there


def misplaced(found: Adjusted) -> Iterator[tuple[str, str]]:
    """Yield the kind of it and what is wrong with orders that were said of boards on a line, a line for each mistake.

    What several arrangements have in common is one mistake.
    """
    network = found.network
    points = network.positions(found.x)
    spots = {k: along(points[network.seats(k)][network.places[k].ordered_rows]) for k in network.out_of_order(found.x)}
    mistakes: list[tuple[set[tuple[int, int]], list[int]]] = []
    for k, spot in spots.items():
        pairs = exchanged(network.places[k].order, spot)
        same = next((n for n, (known, _) in enumerate(mistakes) if known & pairs), None)
        if same is None:
            mistakes.append((pairs, [k]))
        else:
            mistakes[same] = (mistakes[same][0] & pairs, [*mistakes[same][1], k])
    for pairs, rows in mistakes:
        places = [network.places[k] for k in rows]
        yield "labels", in_words([place.name for place in places], pairs, places[0].order, spots[rows[0]])


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
        yield Doubt("labels", text, changed, start)


def _cm(length_m: float, *, sign: bool = True) -> str:
    return f"{100 * length_m:+.0f} cm" if sign else f"{100 * length_m:.0f} cm"
