"""What gets past things in the way: soft shadows of boxes and of bodies, whose edges bend waves.

All functions work on straight segments from `a` to `b`, metres. An edge is described by nu, how deep the segment lies
in its shadow in units of the Fresnel zone: nu = h sqrt(2 (d1 + d2)/(wavelength d1 d2)) (ITU-R P.526-15, equation 26).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Final

import numpy as np

from uwblink.arrays import Complexes, Floats
from uwbsim.scenario.model import WAVELENGTH_M
from uwbsim.scenario.surroundings import Obstacle, Shadow

DEEPEST: Final = 12.0
FADES: Final = 8.0
STEPS_A_UNIT: Final = 256
LIT: Final = -0.78
"""From here on an edge takes nothing away, by the approximation of ITU-R P.526."""

AT_EDGE: Final = 10 ** (-6.9 / 20)
NEAREST_M: Final = 1e-3
PARALLEL: Final = 1e-9
CENTRED_M: Final = 1e-4


def edge_gain(nu: Floats) -> Floats:
    """Return the field behind a knife edge as a share: ITU-R P.526-15, equation 31, and 1 in the light."""
    over = np.maximum(nu, LIT) - 0.1
    # 6.9 dB and 20 log10(sqrt(over^2 + 1) + over), without the logarithm.
    return np.asarray(np.where(nu > LIT, AT_EDGE / (np.sqrt(over * over + 1) + over), 1.0))


def covered(nu: Floats) -> Complexes:
    """Return the share of a wave front that a half plane covers whose edge is this deep: a complex Fresnel integral.

    0 far in the light, 1/2 at grazing incidence, 1 deep in the shadow; the field that is left is one less it.
    """
    place = np.clip((nu + DEEPEST) * STEPS_A_UNIT, 0, 2 * DEEPEST * STEPS_A_UNIT)
    step = np.minimum(place.astype(np.intp), int(2 * DEEPEST * STEPS_A_UNIT) - 1)
    table = _covered_table()
    return np.asarray(table[step] + (place - step) * (table[step + 1] - table[step]))


@cache
def _covered_table() -> Complexes:
    from scipy.special import fresnel

    nu = np.linspace(-DEEPEST, DEEPEST, int(2 * DEEPEST * STEPS_A_UNIT) + 1)
    sine, cosine = fresnel(nu)
    exact = 0.5 + (cosine - 1j * sine) * (1 + 1j) / 2
    # The ripple of an edge dies out slowly; beyond a few zones edges no longer matter.
    fade = np.clip((DEEPEST - np.abs(nu)) / (DEEPEST - FADES), 0, 1)
    return np.asarray(np.heaviside(nu, 0.5) + fade * (exact - np.heaviside(nu, 0.5)))


def fresnel_number(depth_m: Floats, share: Floats, length_m: Floats) -> Floats:
    """Return nu of an edge that is passed at this depth, positive in its shadow, and at this share of the way."""
    before = np.clip(share, 0, 1) * length_m
    legs = np.maximum(before, NEAREST_M) * np.maximum(length_m - before, NEAREST_M)
    return np.asarray(depth_m * np.sqrt(2 * length_m / (WAVELENGTH_M * legs)))


def box_cover(obstacles: Sequence[Obstacle], a: Floats, b: Floats) -> tuple[Complexes, Floats]:
    """Return how boxes cover segments (n, 3) to (n, 3): the share of the wave front, and nu of the nearest edge around.

    Shapes (n, boxes) each. Two edges left and right make a strip, the nearer ones above and below another; the cover is
    their product, as for a rectangular screen. It is 0 for boxes that are not between the ends.
    """
    low, high = (np.array([getattr(box, name) for box in obstacles]) for name in ("min_m", "max_m"))
    way = b - a
    length = np.maximum(np.linalg.norm(way, axis=1), NEAREST_M)[:, None]
    # Mirrored so that the way goes up in all three coordinates, it comes by the lower faces and leaves by the upper.
    turned = way < 0
    start, along = np.where(turned, -a, a)[:, None], np.maximum(np.abs(way), PARALLEL)[:, None]
    near = np.where(turned[:, None], -high, low) - start
    far = np.where(turned[:, None], -low, high) - start
    edges = [_edge(along, near, far, length, i, j) for i, j in ((0, 1), (1, 0))]
    edges += [
        _nearer(*(_edge(along, near, far, length, i, j) for i, j in pair))
        for pair in (((0, 2), (1, 2)), ((2, 0), (2, 1)))
    ]
    (left, right, above, below), shares = zip(*edges, strict=True)
    nearest = np.minimum(np.minimum(left, right), np.minimum(above, below))
    crossed = ((near / along).max(axis=2) < 1) & ((far / along).min(axis=2) > 0)
    beside = [
        (nu >= 0) | ((share > 0) & (share < 1)) for nu, share in zip((left, right, above, below), shares, strict=True)
    ]
    between = np.where(nearest > 0, crossed, np.all(beside, axis=0))
    cover = (covered(left) + covered(right) - 1) * (covered(above) + covered(below) - 1)
    return np.where(between, cover, 0), np.where(between, nearest, -DEEPEST)


def _edge(along: Floats, near: Floats, far: Floats, length: Floats, i: int, j: int) -> tuple[Floats, Floats]:
    """Return nu of the edge where face i is entered and face j left, and at which share of the way it is passed."""
    flat = along[..., i] ** 2 + along[..., j] ** 2
    depth = (along[..., i] * far[..., j] - along[..., j] * near[..., i]) / np.sqrt(flat)
    share = (along[..., i] * near[..., i] + along[..., j] * far[..., j]) / flat
    return fresnel_number(depth, share, length), share


def _nearer(one: tuple[Floats, Floats], other: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Return the edge that is less deep in the shadow."""
    first = one[0] < other[0]
    return np.where(first, one[0], other[0]), np.where(first, one[1], other[1])


def body_gain(shadow: Shadow, a: Floats, b: Floats) -> Floats:
    """Return the field that gets past and through an ellipsoid, as a share: segments (n, 3) to (n, 3) in its frame.

    It covers what it covers of a strip between its edges on this side and that, and of one across; the rest goes by.
    What it covers goes through at its loss a metre.
    """
    axes, centre = np.array(shadow.semi_axes_m), np.array(shadow.centre_m)
    start, way = a - centre, b - a
    gain = np.ones(len(way))
    squared = np.maximum(_dot(way, way), NEAREST_M**2)
    share = np.clip(-_dot(start, way) / squared, 0, 1)
    nearest = start + share[:, None] * way
    # Most segments pass by, further than a Fresnel zone at its widest.
    reach = float(axes.max()) - LIT * np.sqrt(WAVELENGTH_M * np.sqrt(squared) / 8)
    (rows,) = np.nonzero(_dot(nearest, nearest) < reach**2)
    if len(rows):
        gain[rows] = _past(shadow, start[rows], way[rows], np.sqrt(squared[rows]))
    return gain


def _past(shadow: Shadow, start: Floats, way: Floats, length_m: Floats) -> Floats:
    axes = np.array(shadow.semi_axes_m)
    # Where the ellipsoid is a unit sphere, the nearest point decides.
    begin, along = start / axes, way / axes
    p, q = np.maximum(_dot(along, along), 1e-12), _dot(begin, along)
    line = np.clip(-q / p, 0, 1)
    point = begin + line[:, None] * along
    radius = np.sqrt(_dot(point, point))
    aside = _aside(point * axes, way, int(np.argmin(axes)))
    unit = fresnel_number(np.ones(len(way)), line, length_m)
    out = _extent_m(axes, aside) * unit
    gain = np.ones(len(way))
    # The bodies are flat: many pass over them, in the light.
    (rows,) = np.nonzero(out * (1 - radius) > LIT)
    if not len(rows):
        return gain
    begin, way, aside, unit = begin[rows], way[rows], aside[rows], unit[rows]
    p, q, out, radius = p[rows], q[rows], out[rows], radius[rows]
    wide = _extent_m(axes, _cross(way, aside)) * unit
    near, opposite, across = edge_gain(np.stack([out * (1 - radius), out * (1 + radius), wide]))
    covered_share = (1 - np.minimum(near + opposite, 1.0)) * (1 - np.minimum(2 * across, 1.0))
    root = np.sqrt(np.maximum(q**2 - p * (_dot(begin, begin) - 1), 0))
    inside = np.clip((-q + root) / p, 0, 1) - np.clip((-q - root) / p, 0, 1)
    through = np.where(inside > 0, 10 ** (-inside * length_m[rows] * shadow.loss_db_per_m / 20), 0.0)
    gain[rows] = 1 - covered_share * (1 - through)
    return gain


def _aside(point: Floats, way: Floats, flattest: int) -> Floats:
    """Return in which direction a way passes the centre; where it goes right through, one across the flattest axis."""
    centred = _dot(point, point) < CENTRED_M**2
    if not np.any(centred):
        return point
    across = _cross(way, np.broadcast_to(np.eye(3)[flattest], way.shape))
    across[_dot(across, across) < PARALLEL] = np.eye(3)[flattest - 1]
    return np.where(centred[:, None], across, point)


def _extent_m(axes: Floats, direction: Floats) -> Floats:
    """Return how far an ellipsoid reaches in directions (n, 3) of any length."""
    scaled = direction / axes
    return np.asarray(np.sqrt(_dot(direction, direction) / np.maximum(_dot(scaled, scaled), PARALLEL**2)))


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def _cross(a: Floats, b: Floats) -> Floats:
    """The vector product of rows, without the checks that make numpy's slow for few of them."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)
