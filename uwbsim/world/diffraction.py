"""Waves at edges, bodies and surfaces: soft shadows of boxes and bodies, and reflection by plane faces.

The functions on segments work on straight segments from `a` to `b`, metres. An edge is described by nu, how deep the
segment lies in its shadow in units of the Fresnel zone: nu = h sqrt(2 (d1 + d2)/(wavelength d1 d2)) (ITU-R P.526-15,
equation 26).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final, Self

import numpy as np
from scipy import special

from uwblink.arrays import Bools, Complexes, Floats, Ints
from uwbsim.scenario.bodies import Material, Obstacle, Shadow, properties
from uwbsim.scenario.model import WAVELENGTH_M, Scenario

DEEPEST: Final = 12.0
"""Largest |nu| of the table of Fresnel integrals: beyond it an edge shades fully, or not at all."""

STEPS_PER_UNIT: Final = 256
"""Of that table; linear in between it is exact to 1e-5."""

LIT: Final = -0.78
"""From this nu on an edge takes nothing away, by the approximation of ITU-R P.526."""

NEAREST_M: Final = 1e-3
"""Shortest leg between an end and an edge, and PARALLEL the smallest component: they keep divisions defined."""

PARALLEL: Final = 1e-9
AXIAL: Final = 1e-4
"""Sines below this count as zero."""

WAVENUMBER: Final = 2 * np.pi / WAVELENGTH_M


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


def box_loss(obstacles: Sequence[Obstacle], a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Return loss in dB and excess length in metres of going straight through the obstacles, shape (n,) each."""
    materials = np.array([properties(o.material) for o in obstacles])
    chords = box_chords_m(obstacles, a, b)
    return chords @ materials[:, 0], chords @ (materials[:, 1] - 1)


def edge_gain(nu: Floats) -> Floats:
    """Return the field behind a knife edge as a share: ITU-R P.526-15, equation 31, and 1 in the light."""
    over = np.maximum(nu, LIT) - 0.1
    # 6.9 dB and 20 log10(sqrt(over^2 + 1) + over), without the logarithm.
    return np.asarray(np.where(nu > LIT, 10 ** (-6.9 / 20) / (np.sqrt(over * over + 1) + over), 1.0))


def covered(nu: Floats) -> Complexes:
    """Return the share of a wave front that a half plane covers whose edge is this deep: a complex Fresnel integral.

    0 far in the light, 1/2 at grazing incidence, 1 deep in the shadow; the field that is left is one less it.
    """
    place = np.clip((nu + DEEPEST) * STEPS_PER_UNIT, 0, 2 * DEEPEST * STEPS_PER_UNIT)
    step = np.minimum(place.astype(np.intp), int(2 * DEEPEST * STEPS_PER_UNIT) - 1)
    table = _covered_table()
    return np.asarray(table[step] + (place - step) * (table[step + 1] - table[step]))


@cache
def _covered_table() -> Complexes:
    nu = np.linspace(-DEEPEST, DEEPEST, int(2 * DEEPEST * STEPS_PER_UNIT) + 1)
    sine, cosine = special.fresnel(nu)
    exact = 0.5 + (cosine - 1j * sine) * (1 + 1j) / 2
    # The ripple of an edge dies out slowly; it is faded out from nu = 8 on, where edges no longer matter.
    fade = np.clip((DEEPEST - np.abs(nu)) / (DEEPEST - 8.0), 0, 1)
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
    centred = _dot(point, point) < 1e-4**2  # metres
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


def permittivity(material: str | Material) -> complex:
    """Return the relative permittivity of a material, from its loss and refractive index."""
    if material == "metal":
        return 1 - 4.5e7j  # a conductor of 10^7 S/m at 4 GHz (ITU-R P.2040-3, table 3)
    loss_db_per_m, index = properties(material)
    # A wave exp(-j k n z) loses exp(-k kappa z), kappa being minus the imaginary part of n; a neper is 8.7 dB.
    return complex((index - 1j * loss_db_per_m / (20 / np.log(10)) / WAVENUMBER) ** 2)


def fresnel(relative_permittivity: Complexes | complex, cosine: Floats) -> tuple[Complexes, Complexes]:
    """Return the reflection coefficients of the field across and in the plane of incidence, same shape as `cosine`.

    `cosine` is that of the angle to the surface's normal. In the plane the sign is the magnetic field's: a perfect
    conductor has -1 and +1 (ITU-R P.2040-3, equations 31a and 31b).
    """
    inside = np.sqrt(relative_permittivity - (1 - cosine**2) + 0j)
    along = relative_permittivity * cosine
    return (cosine - inside) / (cosine + inside), (along - inside) / (along + inside)


def roughness_factor(height_m: Floats | float, cosine: Floats) -> Floats:
    """Return the share of the specular field that is left by heights of this standard deviation (Ament 1953)."""
    return np.asarray(np.exp(-2 * (WAVENUMBER * height_m * cosine) ** 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class Mirrors:
    """m plane faces that reflect: the axis of each one's normal, and its material's permittivity and roughness, (m,).

    The first `walls` are the room's, seen from inside, at `plane_m` (walls,). The others are obstacles' faces across
    the three axes, three to a box, seen from outside, with the boxes' corners `low_m` and `high_m` (boxes, 3).
    """

    axis: Ints
    permittivity: Complexes
    roughness_m: Floats
    plane_m: Floats
    low_m: Floats
    high_m: Floats

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Collect those of a scenario."""
        room, boxes = scenario.room, scenario.obstacles
        walls = [0, 0, 1, 1, 2, 2] if room else []
        planes = [side[axis] for axis in range(3) for side in (room.min_m, room.max_m)] if room else []
        made_of = [permittivity(m) for m in room.materials()] if room else []
        made_of += [permittivity(box.material) for box in boxes for _ in range(3)]
        rough = [(room.roughness_mm * 1e-3)] * 6 if room else []
        rough += [(box.roughness_mm * 1e-3) for box in boxes for _ in range(3)]
        return cls(
            axis=np.array([*walls, *[0, 1, 2] * len(boxes)], dtype=np.int64),
            permittivity=np.array(made_of, dtype=np.complex128),
            roughness_m=np.array(rough, dtype=np.float64),
            plane_m=np.array(planes, dtype=np.float64),
            low_m=np.array([box.min_m for box in boxes], dtype=np.float64).reshape(-1, 3),
            high_m=np.array([box.max_m for box in boxes], dtype=np.float64).reshape(-1, 3),
        )


def planes(mirrors: Mirrors, a: Floats, b: Floats) -> tuple[Floats, Bools]:
    """Where each mirror's plane is for links (n,), and whether both ends are in front of it; (n, mirrors) each."""
    walls, count = len(mirrors.plane_m), len(a)
    plane = np.empty((count, len(mirrors.axis)))
    there = np.ones(plane.shape, dtype=bool)
    plane[:, :walls] = mirrors.plane_m
    below = np.maximum(a, b)[:, None] <= mirrors.low_m
    above = np.minimum(a, b)[:, None] >= mirrors.high_m
    plane[:, walls:] = np.where(below, mirrors.low_m, mirrors.high_m).reshape(count, -1)
    there[:, walls:] = (below | above).reshape(count, -1)
    return plane, there


def on_faces(mirrors: Mirrors, point: Floats, share: Floats, length: Floats) -> Complexes:
    """How much of the zone that reflects lies on the face, as a complex share: 1 on the room's walls; (n, mirrors)."""
    walls, boxes = len(mirrors.plane_m), len(mirrors.low_m)
    whole = np.ones(share.shape, dtype=np.complex128)
    spots = point[:, walls:].reshape(len(point), boxes, 3, 3)
    for face in range(3 if boxes else 0):
        mine = slice(walls + face, None, 3)
        for other in {0, 1, 2} - {face}:
            spot = spots[:, :, face, other]
            edges = (spot - mirrors.low_m[:, other], mirrors.high_m[:, other] - spot)
            first, second = (fresnel_number(edge, share[:, mine], length[:, mine]) for edge in edges)
            whole[:, mine] *= covered(first) + covered(second) - 1
    return whole


def coupling(mirrors: Mirrors, axes: tuple[Floats, Floats], way: Floats, cosine: Floats) -> Complexes:
    """What reflections make of the field of one antenna in the other's, with both polarisations, (n, mirrors).

    `axes` (n, 3) each are those of the two antennas, `way` (3, n, mirrors) unit vectors k towards the image, `cosine`
    their parts along the normals. Seen in the mirror, the other antenna is polarised on the same straight way. An
    antenna's field there is its axis z less the part along k; it is split along n x k, for Fresnel's first coefficient,
    and across, for his second.
    """
    columns, axis = np.arange(len(mirrors.axis)), mirrors.axis
    next_one, last_one = (axis + 1) % 3, (axis + 2) % 3
    one = np.repeat(axes[0].T[:, :, None], len(axis), axis=2)
    other = np.repeat(axes[1].T[:, :, None], len(axis), axis=2)
    other[axis, :, columns] *= -1
    sine2 = np.maximum(1 - cosine**2, 0)
    parts = []
    for z in (one, other):
        along = (z * way).sum(axis=0)
        first, second = way[next_one, :, columns], way[last_one, :, columns]
        turned = first * z[last_one, :, columns] - second * z[next_one, :, columns]
        size = np.sqrt(np.maximum(1 - along**2, AXIAL**2))
        parts.append((turned.T / size, (z[axis, :, columns].T - cosine * along) / size, along, size))
    s, p = fresnel(mirrors.permittivity, np.abs(cosine))
    split = (s * parts[0][0] * parts[1][0] - p * parts[0][1] * parts[1][1]) / np.maximum(sine2, AXIAL**2)
    # Straight on the mirror there is no plane of incidence, and both coefficients are one.
    straight = s * ((one * other).sum(axis=0) - parts[0][2] * parts[1][2]) / (parts[0][3] * parts[1][3])
    return np.asarray(np.where(sine2 > AXIAL**2, split, straight))


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedShadow:
    """The shadow of a body, where the body is: centre (n, 3) in metres, rotation body to world (n, 3, 3)."""

    shadow: Shadow
    position_m: Floats
    rotation: Floats

    def loss_db(self, one: Floats, other: Floats) -> Floats:
        """Return what the body takes away from segments (n, k or 1, 3) to (n, k, 3), in dB, (n, k)."""
        a, b = ((spots - self.position_m[:, None]) @ self.rotation for spots in (one, other))
        return ellipsoid_chord_m(self.shadow, a, b) * self.shadow.loss_db_per_m
