"""What is between two antennas: obstacles and bodies to go through, surfaces to reflect from, and the first path.

All functions work on n straight segments from `a` (n, 3) to `b` (n, 3), metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints
from uwbsim.scenario.surroundings import Obstacle, Room, Shadow


@dataclass(frozen=True, slots=True)
class Link:
    """What reaches one antenna from another, shape (n,).

    `distance_m` is the straight line, `excess_m` how much longer the first detected path is or seems;
    `power_dbm` that path's power, `total_dbm` that of all paths together. Where there are several paths, `paths_m` and
    `paths_dbm` are the lengths and powers of all, (n, paths), in any order. `noise_s` is what noise does to the leading
    edge of the first path, a standard deviation, where a response tells.
    """

    distance_m: Floats
    excess_m: Floats
    power_dbm: Floats
    total_dbm: Floats
    _: KW_ONLY
    paths_m: Floats | None = None
    paths_dbm: Floats | None = None
    noise_s: Floats | None = None

    def __getitem__(self, rows: Ints) -> Link:
        """Return the chosen segments."""
        return replace(
            self,
            distance_m=self.distance_m[rows],
            excess_m=self.excess_m[rows],
            power_dbm=self.power_dbm[rows],
            total_dbm=self.total_dbm[rows],
            paths_m=None if self.paths_m is None else self.paths_m[rows],
            paths_dbm=None if self.paths_dbm is None else self.paths_dbm[rows],
            noise_s=None if self.noise_s is None else self.noise_s[rows],
        )


def box_chords_m(obstacles: Sequence[Obstacle], a: Floats, b: Floats) -> Floats:
    """Return how much of each segment lies in each box, shape (n, boxes): the slab method (Kay and Kajiya 1986)."""
    way, start = b - a, np.ascontiguousarray(a.T)
    length, along = np.linalg.norm(way, axis=1), np.ascontiguousarray(way.T)
    chords = np.zeros((len(a), len(obstacles)))
    for k, box in enumerate(obstacles):
        enter, leave = np.zeros(len(a)), np.ones(len(a))
        for axis in range(3):
            first, last = _slab(box.min_m[axis] - start[axis], box.max_m[axis] - start[axis], along[axis])
            np.maximum(enter, first, out=enter)
            np.minimum(leave, last, out=leave)
        chords[:, k] = np.maximum(leave - enter, 0) * length
    return chords


def _slab(low: Floats, high: Floats, along: Floats) -> tuple[Floats, Floats]:
    """Return at which shares of their ways lines enter and leave a slab between `low` and `high` of their starts."""
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = low / along, high / along
    enter, leave = np.minimum(near, far), np.maximum(near, far)
    # A segment along a face divides nothing by nothing: it is inside that slab or not at all.
    (beside,) = np.nonzero(along == 0)
    inside = (low[beside] <= 0) & (high[beside] >= 0)
    enter[beside], leave[beside] = np.where(inside, -np.inf, np.inf), np.where(inside, np.inf, -np.inf)
    return enter, leave


def ellipsoid_chord_m(shadow: Shadow, a: Floats, b: Floats) -> Floats:
    """Return how much of each segment (..., 3), given in the frame of a body, lies in its ellipsoid, shape (...)."""
    axes, centre = np.array(shadow.semi_axes_m), np.array(shadow.centre_m)
    way = b - a
    start, along = (a - centre) / axes, way / axes
    # |start + t along|^2 = 1: a quadratic in t.
    p = np.maximum(np.einsum("...j,...j->...", along, along), 1e-30)
    q = np.einsum("...j,...j->...", start, along)
    r = np.einsum("...j,...j->...", start, start) - 1
    square = q**2 - p * r
    chord = np.zeros(square.shape)
    # Most segments pass by.
    hit = square > 0
    if np.any(hit):
        p, q, root = p[hit], q[hit], np.sqrt(square[hit])
        low, high = np.clip((-q - root) / p, 0, 1), np.clip((-q + root) / p, 0, 1)
        chord[hit] = (high - low) * np.linalg.norm(way[hit], axis=-1)
    return chord


def through(obstacles: Sequence[Obstacle], a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Return loss in dB and excess length in metres of going straight through the obstacles, shape (n,) each."""
    properties = np.array([o.properties() for o in obstacles])
    chords = box_chords_m(obstacles, a, b)
    return chords @ properties[:, 0], chords @ (properties[:, 1] - 1)


SURFACES: Final = 6
"""A room's walls, floor and ceiling."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reflected:
    """The ways by a room's surfaces: lengths (n, 6) in metres, the points of reflection (n, 6, 3), and the unit vectors
    (n, 6, 3) in which they leave one end, and in which they come to the other, seen from there."""

    length_m: Floats
    point_m: Floats
    leaving: Floats
    arriving: Floats


def reflections(room: Room, a: Floats, b: Floats) -> Reflected:
    """Return the specular reflections by each of the room's six surfaces: the image method.

    Straight to the image of the other end is as long as the way by the surface, which it crosses where that reflects.
    """
    one, other = np.repeat(a[:, None], SURFACES, axis=1), np.repeat(b[:, None], SURFACES, axis=1)
    images = [_images(room, spots) for spots in (one, other)]
    way, back = images[1] - one, images[0] - other
    length = np.linalg.norm(way, axis=2)
    scale = np.maximum(length, 1e-10)[:, :, None]
    # How far in front of the surface the two ends are decides where the way meets it.
    near, far = (np.linalg.norm(images[k] - spots, axis=2) for k, spots in enumerate((one, other)))
    share = near / np.maximum(near + far, 1e-10)
    return Reflected(length_m=length, point_m=one + share[:, :, None] * way, leaving=way / scale, arriving=back / scale)


def _images(room: Room, spots: Floats) -> Floats:
    """Mirror points (n, 6, 3) at the surface of their column."""
    image = spots.copy()
    for axis in range(3):
        for side, wall in enumerate((room.min_m[axis], room.max_m[axis])):
            image[:, 2 * axis + side, axis] = 2 * wall - image[:, 2 * axis + side, axis]
    return image


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
        paths_m=lengths,
        paths_dbm=power,
    )


def with_path(link: Link, length_m: Floats, power_dbm: Floats) -> Link:
    """Return a link with one path more, whose power is part of the total already."""
    lengths, powers = link.paths_m, link.paths_dbm
    if lengths is None or powers is None:
        lengths, powers = (link.distance_m + link.excess_m)[:, None], link.power_dbm[:, None]
    return replace(link, paths_m=np.column_stack([lengths, length_m]), paths_dbm=np.column_stack([powers, power_dbm]))
