"""What is between two antennas: obstacles and bodies to go through, surfaces to reflect from, and the first path.

All functions work on n straight segments from `a` (n, 3) to `b` (n, 3), metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwblink.arrays import Floats, Ints
from uwbsim.scenario.radio import Obstacle, Room, Shadow


@dataclass(frozen=True, slots=True)
class Link:
    """What reaches one antenna from another, shape (n,).

    `distance_m` is the straight line, `excess_m` how much longer the first detected path is or seems;
    `power_dbm` that path's power, `total_dbm` that of all paths together.
    """

    distance_m: Floats
    excess_m: Floats
    power_dbm: Floats
    total_dbm: Floats

    def __getitem__(self, rows: Ints) -> Link:
        """Return the chosen segments."""
        return Link(self.distance_m[rows], self.excess_m[rows], self.power_dbm[rows], self.total_dbm[rows])


def box_chords_m(obstacles: Sequence[Obstacle], a: Floats, b: Floats) -> Floats:
    """Return how much of each segment lies in each box, shape (n, boxes): the slab method (Kay and Kajiya 1986)."""
    direction = b - a
    length = np.linalg.norm(direction, axis=1)
    chords = np.zeros((len(a), len(obstacles)))
    with np.errstate(divide="ignore", invalid="ignore"):
        for k, box in enumerate(obstacles):
            near = (np.array(box.min_m) - a) / direction
            far = (np.array(box.max_m) - a) / direction
            # A segment along a face divides nothing by nothing: it is inside that slab or not at all.
            inside = (a >= box.min_m) & (a <= box.max_m)
            enter = np.where(direction == 0, np.where(inside, -np.inf, np.inf), np.minimum(near, far))
            leave = np.where(direction == 0, np.where(inside, np.inf, -np.inf), np.maximum(near, far))
            share = np.minimum(leave.min(axis=1), 1) - np.maximum(enter.max(axis=1), 0)
            chords[:, k] = np.maximum(share, 0) * length
    return chords


def ellipsoid_chord_m(shadow: Shadow, a: Floats, b: Floats) -> Floats:
    """Return how much of each segment, given in the body's frame, lies in the body's ellipsoid, shape (n,)."""
    axes, centre = np.array(shadow.semi_axes_m), np.array(shadow.centre_m)
    start, along = (a - centre) / axes, (b - a) / axes
    # |start + t along|^2 = 1: a quadratic in t.
    p = np.maximum(np.einsum("ij,ij->i", along, along), 1e-30)
    q = np.einsum("ij,ij->i", start, along)
    r = np.einsum("ij,ij->i", start, start) - 1
    root = np.sqrt(np.maximum(q**2 - p * r, 0))
    low, high = np.clip((-q - root) / p, 0, 1), np.clip((-q + root) / p, 0, 1)
    return np.asarray((high - low) * np.linalg.norm(b - a, axis=1))


def through(obstacles: Sequence[Obstacle], a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Return loss in dB and excess length in metres of going straight through the obstacles, shape (n,) each."""
    properties = np.array([o.properties() for o in obstacles])
    chords = box_chords_m(obstacles, a, b)
    return chords @ properties[:, 0], chords @ (properties[:, 1] - 1)


def reflected_lengths_m(room: Room, a: Floats, b: Floats) -> Floats:
    """Return the lengths by way of each of the room's six surfaces, shape (n, 6): the image method."""
    lengths = []
    for axis in range(3):
        for wall in (room.min_m[axis], room.max_m[axis]):
            image = b.copy()
            image[:, axis] = 2 * wall - image[:, axis]
            lengths.append(np.linalg.norm(image - a, axis=1))
    return np.stack(lengths, axis=1)


def first_path(link: Link, reflected_m: Floats, reflected_dbm: Floats, dynamic_range_db: float) -> Link:
    """Return a link with reflections (n, paths): which path the chip takes for the first, and the power of all.

    The detector takes the earliest path that is not weaker than the strongest by more than its dynamic range.
    """
    lengths = np.column_stack([link.distance_m + link.excess_m, reflected_m])
    power = np.column_stack([link.power_dbm, reflected_dbm])
    audible = power >= power.max(axis=1, keepdims=True) - dynamic_range_db
    first = np.argmin(np.where(audible, lengths, np.inf), axis=1)
    rows = np.arange(len(first))
    return replace(
        link,
        excess_m=lengths[rows, first] - link.distance_m,
        power_dbm=power[rows, first],
        total_dbm=np.asarray(10 * np.log10(np.sum(10 ** (power / 10), axis=1))),
    )
