"""From means of pairs and what is known beside them to a network: points, columns of what is known, the curve."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from calib.errors import BadInputError
from calib.surveys.gathering import Gathered
from calib.surveys.knowledge import Knowledge, check_knowledge
from calib.surveys.network import DIMENSIONS, Known, Network, Place
from calib.surveys.power import power_model
from calib.surveys.scales import M_PER_NS
from uwblink.recording.schema import KnownDistance


def assembled(
    gathered: Gathered, knowledge: Knowledge, fixed_ns: dict[int, float], *, delays_only: bool
) -> tuple[Network, tuple[str, ...]]:
    """Return the network, and what to call each distance that is known."""
    means = gathered.means
    there = {
        one.name: {*means.first[rows].tolist(), *means.second[rows].tolist()}
        for k, one in enumerate(gathered.arrangements)
        for rows in [means.arrangement == k]
    }
    check_knowledge(knowledge, there)
    missing = sorted(set(fixed_ns) - set(means.tags()))
    if missing:
        raise BadInputError(f"tag {missing[0]} is not in the recordings", parameter="fixed_ns")
    used = [k for k, one in enumerate(gathered.arrangements) if there[one.name]]
    renumbered = np.searchsorted(used, means.arrangement)
    places = tuple(_place(gathered, knowledge, there, k) for k in used)
    distances = (*gathered.distances, *knowledge.distances)
    network = Network(
        means=replace(means, arrangement=renumbered),
        places=places,
        tags=tuple(means.tags()),
        known=_known(places, knowledge, distances),
        fixed_m={tag: delay * M_PER_NS for tag, delay in fixed_ns.items()},
        power=None if delays_only else power_model(means.lifted),
        reflected=np.zeros(len(means), dtype=bool),
    )
    names = tuple(
        f"the known distance of {d.first} and {d.second}{' in ' + d.arrangement if d.arrangement else ''}"
        for d in distances
    )
    return network, names


def _place(gathered: Gathered, knowledge: Knowledge, there: dict[str, set[int]], k: int) -> Place:
    one = gathered.arrangements[k]
    shape = knowledge.shape_of(one)
    tags = tuple(sorted(there[one.name]))
    placed = [p for p in knowledge.positions if p.arrangement in ("", one.name) and p.tag in tags]
    if placed and shape == "line":
        raise BadInputError(
            f"{one.name}: positions are for a plane or for space; on a line give distances", parameter="known"
        )
    if placed and shape == "plane" and len({p.position_m[2] for p in placed}) > 1:
        raise BadInputError(f"{one.name}: a plane is that of x and y; its positions differ in z", parameter="known")
    order = knowledge.order_of(one)
    strangers = sorted(set(order) - set(tags))
    if strangers or len(set(order)) < len(order):
        who = f"tag {strangers[0]}, which does not range there" if strangers else "a tag twice"
        raise BadInputError(f"{one.name}: its order of boards has {who}", parameter="known")
    return Place(one.name, DIMENSIONS[shape], tags, order=order)


def _known(places: tuple[Place, ...], knowledge: Knowledge, distances: tuple[KnownDistance, ...]) -> Known:
    """Return what is known as columns. What holds in several arrangements is one reading, not several."""
    point = {(k, tag): n for n, (k, tag) in enumerate((k, t) for k, p in enumerate(places) for t in p.tags)}
    ends, at = [], []
    for number, d in enumerate(distances):
        rows = [
            (point[k, d.first], point[k, d.second])
            for k, place in enumerate(places)
            if d.arrangement in ("", place.name) and {d.first, d.second} <= set(place.tags)
        ]
        ends += [(*row, d.distance_m, d.sigma_m * math.sqrt(len(rows)), number) for row in rows]
    for p in knowledge.positions:
        seats = [
            (k, point[k, p.tag])
            for k, place in enumerate(places)
            if p.arrangement in ("", place.name) and p.tag in place.tags
        ]
        for k, seat in seats:
            height = 0.0 if places[k].dimensions == 2 else p.position_m[2]
            at.append((seat, *p.position_m[:2], height, p.sigma_m * math.sqrt(len(seats))))
    lengths, corners = np.array(ends).reshape(-1, 5), np.array(at).reshape(-1, 5)
    return Known(
        ends=lengths[:, :2].astype(np.int64),
        distance_m=lengths[:, 2],
        distance_std_m=lengths[:, 3],
        distance_of=lengths[:, 4].astype(np.int64),
        at=corners[:, 0].astype(np.int64),
        position_m=corners[:, 1:4],
        position_std_m=corners[:, 4],
    )
