"""Positions in a stated frame, with the covariance that they have there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.surveys.network import Network
from uwblink.arrays import Floats


@dataclass(frozen=True, slots=True)
class Framed:
    """Points of one arrangement (n, 3) in a frame, their covariance (3n, 3n), and the frame in words."""

    position_m: Floats
    covariance_m2: Floats
    words: str


def framed(network: Network, x: Floats, covariance: Floats, arrangement: int) -> Framed:
    """Return an arrangement in the frame of its known positions, or in that of its first boards.

    `covariance` (unknowns, unknowns) is that of an adjustment in which rigid motions are held.
    """
    here = [k for k, (a, _) in enumerate(network.points) if a == arrangement]
    place = network.places[arrangement]
    points, spread = network.positions(x)[here], _of_points(network, covariance, here)
    if set(network.known.at.tolist()) & set(here):
        return Framed(points, spread, "that of the known positions")
    turn, who = _axes(points, place.dimensions)
    moved = (points - points[0]) @ turn.T
    turns = np.kron(np.eye(len(here)), turn)
    datum, words = _datum(who, place.tags, place.dimensions)
    return Framed(moved, _fixed(moved, turns @ spread @ turns.T, datum, place.dimensions), words)


def _of_points(network: Network, covariance: Floats, here: list[int]) -> Floats:
    columns = network.columns[here].ravel()
    free = columns >= 0
    found = np.zeros((len(columns),) * 2)
    found[np.ix_(free, free)] = covariance[np.ix_(columns[free], columns[free])]
    return found


def _axes(points: Floats, dimensions: int) -> tuple[Floats, tuple[int, ...]]:
    """Return the rotation whose rows are the axes: x to the second board, y to the side of the next beside it."""
    along = points[1] - points[0]
    x = along / max(float(np.linalg.norm(along)), 1e-9)
    if dimensions == 1:
        return np.diag([np.sign(x[0]) or 1.0, 1.0, 1.0]), (0, 1)
    beside = (points - points[0]) - np.outer((points - points[0]) @ x, x)
    reach = np.linalg.norm(beside, axis=1)
    third = int(np.argmax(reach > 0.2 * reach.max())) if reach.max() > 0 else 0
    y = beside[third] / max(float(reach[third]), 1e-9)
    if dimensions == 2:
        z = np.array([0.0, 0.0, 1.0])
        return np.array([x, y, z]), (0, 1, third)
    return np.array([x, y, np.cross(x, y)]), (0, 1, third)


def _datum(who: tuple[int, ...], tags: tuple[int, ...], dimensions: int) -> tuple[list[int], str]:
    """Return the coordinates that the frame makes zero, and its words."""
    first, second = tags[who[0]], tags[who[1]]
    if dimensions == 1:
        return [0], f"{first} at the origin, x towards {second}"
    if dimensions == 2:
        return [0, 1, 3 * who[1] + 1], f"{first} at the origin, x towards {second}, y towards {tags[who[2]]}"
    rows = [0, 1, 2, 3 * who[1] + 1, 3 * who[1] + 2, 3 * who[2] + 2]
    return rows, f"{first} at the origin, x towards {second}, {tags[who[2]]} in the plane of x and y, z right-handed"


def _fixed(points: Floats, covariance: Floats, datum: list[int], dimensions: int) -> Floats:
    """Return the covariance in which some coordinates have none (Baarda's transformation of the datum)."""
    fields = [np.tile(np.eye(3)[axis], (len(points), 1)) for axis in range(dimensions)]
    turns = {1: (), 2: (2,), 3: (0, 1, 2)}[dimensions]
    fields += [np.cross(np.eye(3)[axis], points) for axis in turns]
    motions = np.array([field.ravel() for field in fields]).T
    away = np.eye(len(motions)) - motions @ np.linalg.pinv(motions[datum]) @ np.eye(len(motions))[datum]
    found = away @ covariance @ away.T
    return np.asarray((found + found.T) / 2)
