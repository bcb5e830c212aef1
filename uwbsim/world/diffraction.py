"""Diffraction at edges of boxes and bodies, transmission through them, and reflection by plane faces.

Functions of segments take straight segments from `a` to `b`, in metres. The diffraction parameter nu of an edge is the
depth h of the segment in its shadow in units of the Fresnel zone: nu = h sqrt(2 (d1 + d2)/(wavelength d1 d2)) (ITU-R
P.526-15, equation 26).
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

MAX_NU: Final = 12.0
"""Largest |nu| of the table of Fresnel integrals: beyond it an edge blocks a wave fully, or not at all."""

STEPS_PER_UNIT: Final = 256
"""Steps of that table per unit of nu: with linear interpolation its error is 1e-5."""

LIT_NU: Final = -0.78
"""Below this nu an edge has no loss in the approximation of ITU-R P.526."""

LEAST_SIDE_M: Final = 1e-3
"""Least distance between an end and an edge, so that divisions are defined."""

PARALLEL: Final = 1e-9
"""Least component of a direction, so that divisions are defined."""

AXIAL: Final = 1e-4
"""Sines below this count as zero."""

WAVENUMBER: Final = 2 * np.pi / WAVELENGTH_M


def box_chords_m(obstacles: Sequence[Obstacle], a: Floats, b: Floats) -> Floats:
    """Return the length of each segment inside each box, (n, boxes): the slab method (Kay and Kajiya 1986)."""
    start, way = np.ascontiguousarray(a.T), np.ascontiguousarray((b - a).T)
    length, chords = np.linalg.norm(b - a, axis=1), np.zeros((len(a), len(obstacles)))
    for k, box in enumerate(obstacles):
        enter, leave = _slabs(np.array(box.min_m)[:, None] - start, np.array(box.max_m)[:, None] - start, way)
        chords[:, k] = np.maximum(np.minimum(leave.min(axis=0), 1) - np.maximum(enter.max(axis=0), 0), 0) * length
    return chords


def _slabs(low: Floats, high: Floats, way: Floats) -> tuple[Floats, Floats]:
    """Return the fractions of segments at which they enter and leave slabs; `low` and `high` are from their starts."""
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = low / way, high / way
    # A segment parallel to a slab (0/0) is inside it or outside over its whole length.
    parallel, inside = way == 0, (low <= 0) & (high >= 0)
    enter = np.where(parallel, np.where(inside, -np.inf, np.inf), np.minimum(near, far))
    return enter, np.where(parallel, -enter, np.maximum(near, far))


def ellipsoid_chord_m(shadow: Shadow, a: Floats, b: Floats) -> Floats:
    """Return the length of segments (..., 3), in the frame of a body, inside its ellipsoid, shape (...)."""
    axes, centre = np.array(shadow.semi_axes_m), np.array(shadow.centre_m)
    way = b - a
    start, along = (a - centre) / axes, way / axes
    # |start + t along|^2 = 1: a quadratic in t.
    p = np.maximum(np.einsum("...j,...j->...", along, along), 1e-30)
    q = np.einsum("...j,...j->...", start, along)
    r = np.einsum("...j,...j->...", start, start) - 1
    root = np.sqrt(np.maximum(q**2 - p * r, 0))
    low, high = np.clip((-q - root) / p, 0, 1), np.clip((-q + root) / p, 0, 1)
    return np.asarray((high - low) * np.linalg.norm(way, axis=-1))


def box_loss(obstacles: Sequence[Obstacle], a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Return loss in dB and excess length in metres of straight paths through the obstacles, shape (n,) each."""
    materials = np.array([properties(o.material) for o in obstacles])
    chords = box_chords_m(obstacles, a, b)
    return chords @ materials[:, 0], chords @ (materials[:, 1] - 1)


def edge_gain(nu: Floats) -> Floats:
    """Return the relative field behind a knife edge: ITU-R P.526-15, equation 31, and 1 below `LIT_NU`."""
    over = np.maximum(nu, LIT_NU) - 0.1
    # 6.9 dB and 20 log10(sqrt(over^2 + 1) + over), without the logarithm.
    return np.asarray(np.where(nu > LIT_NU, 10 ** (-6.9 / 20) / (np.sqrt(over * over + 1) + over), 1.0))


def blocked_fraction(nu: Floats) -> Complexes:
    """Return the fraction of a wave front that a half plane with an edge at nu blocks: a complex Fresnel integral.

    0 far from the shadow, 1/2 at grazing incidence, 1 deep in the shadow; the remaining field is 1 minus this.
    """
    place = np.clip((nu + MAX_NU) * STEPS_PER_UNIT, 0, 2 * MAX_NU * STEPS_PER_UNIT)
    step = np.minimum(place.astype(np.intp), int(2 * MAX_NU * STEPS_PER_UNIT) - 1)
    table = _blocked_table()
    return np.asarray(table[step] + (place - step) * (table[step + 1] - table[step]))


@cache
def _blocked_table() -> Complexes:
    nu = np.linspace(-MAX_NU, MAX_NU, int(2 * MAX_NU * STEPS_PER_UNIT) + 1)
    sine, cosine = special.fresnel(nu)
    exact = 0.5 + (cosine - 1j * sine) * (1 + 1j) / 2
    # The ripple of an edge decays slowly; it is attenuated to zero from nu = 8 to `MAX_NU`.
    fade = np.clip((MAX_NU - np.abs(nu)) / (MAX_NU - 8.0), 0, 1)
    return np.asarray(np.heaviside(nu, 0.5) + fade * (exact - np.heaviside(nu, 0.5)))


def fresnel_number(depth_m: Floats, share: Floats, length_m: Floats) -> Floats:
    """Return nu of an edge at a depth, positive in its shadow, and at a fraction `share` of the path."""
    before = np.clip(share, 0, 1) * length_m
    legs = np.maximum(before, LEAST_SIDE_M) * np.maximum(length_m - before, LEAST_SIDE_M)
    return np.asarray(depth_m * np.sqrt(2 * length_m / (WAVELENGTH_M * legs)))


def boxes_blocked(obstacles: Sequence[Obstacle], a: Floats, b: Floats) -> tuple[Complexes, Floats]:
    """Return the fraction of the wave front that boxes block on segments (n, 3) to (n, 3), and nu of the nearest edge.

    Shapes (n, boxes) each. The left and right edges bound one strip, the nearer edges above and below another; the
    blocked fraction is their product, as for a rectangular screen. It is 0 for boxes that are not between the ends.
    """
    low, high = (np.array([getattr(box, name) for box in obstacles]) for name in ("min_m", "max_m"))
    way = b - a
    length = np.maximum(np.linalg.norm(way, axis=1), LEAST_SIDE_M)[:, None]
    # Coordinates are mirrored so that all components of the path are positive: it enters by the lower faces and leaves
    # by the upper ones.
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
    cover = (blocked_fraction(left) + blocked_fraction(right) - 1) * (
        blocked_fraction(above) + blocked_fraction(below) - 1
    )
    return np.where(between, cover, 0), np.where(between, nearest, -MAX_NU)


def _edge(along: Floats, near: Floats, far: Floats, length: Floats, i: int, j: int) -> tuple[Floats, Floats]:
    """Return nu of the edge between entry face i and exit face j, and the fraction of the path at which it lies."""
    flat = along[..., i] ** 2 + along[..., j] ** 2
    depth = (along[..., i] * far[..., j] - along[..., j] * near[..., i]) / np.sqrt(flat)
    share = (along[..., i] * near[..., i] + along[..., j] * far[..., j]) / flat
    return fresnel_number(depth, share, length), share


def _nearer(one: tuple[Floats, Floats], other: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Return nu and fraction of the edge with the smaller nu."""
    first = one[0] < other[0]
    return np.where(first, one[0], other[0]), np.where(first, one[1], other[1])


def near_body(shadow: Shadow, start: Floats, way: Floats) -> Ints:
    """Return the indices of segments that an ellipsoid may shade; `start` (n, 3) are their starts from its centre.

    The other segments, which are most, pass at more than the largest radius of a Fresnel zone.
    """
    squared = np.maximum(_dot(way, way), LEAST_SIDE_M**2)
    share = np.clip(-_dot(start, way) / squared, 0, 1)
    nearest = start + share[:, None] * way
    reach = max(shadow.semi_axes_m) - LIT_NU * np.sqrt(WAVELENGTH_M * np.sqrt(squared) / 8)
    return np.flatnonzero(_dot(nearest, nearest) < reach**2)


def body_gain(shadow: Shadow, a: Floats, b: Floats) -> Floats:
    """Return the relative field around and through an ellipsoid on segments (n, 3) to (n, 3) in its frame.

    It blocks the product of two strips, one between its near and its far edge, one across. The blocked part of the
    field passes through with the loss per metre of the ellipsoid.
    """
    start, way = a - np.array(shadow.centre_m), b - a
    length_m = np.sqrt(np.maximum(_dot(way, way), LEAST_SIDE_M**2))
    axes = np.array(shadow.semi_axes_m)
    # In coordinates in which the ellipsoid is a unit sphere, the nearest point gives the depth.
    begin, along = start / axes, way / axes
    p, q = np.maximum(_dot(along, along), 1e-12), _dot(begin, along)
    line = np.clip(-q / p, 0, 1)
    point = begin + line[:, None] * along
    radius = np.sqrt(_dot(point, point))
    aside = _offset_direction(point * axes, way, int(np.argmin(axes)))
    unit = fresnel_number(np.ones(len(way)), line, length_m)
    out, wide = _extent_m(axes, aside) * unit, _extent_m(axes, np.cross(way, aside)) * unit
    near, opposite, across = edge_gain(np.stack([out * (1 - radius), out * (1 + radius), wide]))
    covered_share = (1 - np.minimum(near + opposite, 1.0)) * (1 - np.minimum(2 * across, 1.0))
    root = np.sqrt(np.maximum(q**2 - p * (_dot(begin, begin) - 1), 0))
    inside = np.clip((-q + root) / p, 0, 1) - np.clip((-q - root) / p, 0, 1)
    through = np.where(inside > 0, 10 ** (-inside * length_m * shadow.loss_db_per_m / 20), 0.0)
    return np.asarray(1 - covered_share * (1 - through))


def _offset_direction(point: Floats, way: Floats, flattest: int) -> Floats:
    """Return the direction of a path's offset from the centre; for a path through the centre, a normal on the flattest
    axis.
    """
    across = np.cross(way, np.eye(3)[flattest])
    across[_dot(across, across) < PARALLEL] = np.eye(3)[flattest - 1]
    centred = _dot(point, point) < 1e-4**2  # metres
    return np.where(centred[:, None], across, point)


def _extent_m(axes: Floats, direction: Floats) -> Floats:
    """Return the extent of an ellipsoid in directions (n, 3) of any length."""
    scaled = direction / axes
    return np.asarray(np.sqrt(_dot(direction, direction) / np.maximum(_dot(scaled, scaled), PARALLEL**2)))


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def permittivity(material: str | Material) -> complex:
    """Return the relative permittivity of a material, from its loss and refractive index."""
    if material == "metal":
        return 1 - 4.5e7j  # a conductor of 10^7 S/m at 4 GHz (ITU-R P.2040-3, table 3)
    loss_db_per_m, index = properties(material)
    # A wave exp(-j k n z) decays as exp(-k kappa z), kappa being minus the imaginary part of n; a neper is 8.7 dB.
    return complex((index - 1j * loss_db_per_m / (20 / np.log(10)) / WAVENUMBER) ** 2)


def fresnel(relative_permittivity: Complexes | complex, cosine: Floats) -> tuple[Complexes, Complexes]:
    """Return the reflection coefficients of the field across and in the plane of incidence, same shape as `cosine`.

    `cosine` is the cosine of the angle to the surface normal. In the plane the sign is the sign of the magnetic field:
    a perfect conductor has -1 and +1 (ITU-R P.2040-3, equations 31a and 31b).
    """
    inside = np.sqrt(relative_permittivity - (1 - cosine**2) + 0j)
    along = relative_permittivity * cosine
    return (cosine - inside) / (cosine + inside), (along - inside) / (along + inside)


def roughness_factor(height_m: Floats | float, cosine: Floats) -> Floats:
    """Return the relative specular field of a surface with heights of this standard deviation (Ament 1953)."""
    return np.asarray(np.exp(-2 * (WAVENUMBER * height_m * cosine) ** 2))


@dataclass(frozen=True, slots=True, kw_only=True)
class Mirrors:
    """m plane faces that reflect: the axis of the normal, the permittivity and the roughness of each, (m,).

    The first faces are the walls of the room, seen from inside, at `plane_m` (walls,). The others are the faces of
    obstacles across the three axes, three of a box, seen from outside; `low_m` and `high_m` (boxes, 3) are its corners.
    """

    axis: Ints
    permittivity: Complexes
    roughness_m: Floats
    plane_m: Floats
    low_m: Floats
    high_m: Floats

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the faces of a scenario's room and obstacles."""
        room, boxes = scenario.room, scenario.obstacles
        planes = [side[axis] for axis in range(3) for side in (room.min_m, room.max_m)] if room else []
        faces = [(k // 2, made, room.roughness_mm) for k, made in enumerate(room.materials())] if room else []
        faces += [(axis, box.material, box.roughness_mm) for box in boxes for axis in range(3)]
        return cls(
            axis=np.array([axis for axis, _, _ in faces], dtype=np.int64),
            permittivity=np.array([permittivity(made) for _, made, _ in faces], dtype=np.complex128),
            roughness_m=np.array([rough * 1e-3 for _, _, rough in faces], dtype=np.float64),
            plane_m=np.array(planes, dtype=np.float64),
            low_m=np.array([box.min_m for box in boxes], dtype=np.float64).reshape(-1, 3),
            high_m=np.array([box.max_m for box in boxes], dtype=np.float64).reshape(-1, 3),
        )


def planes(mirrors: Mirrors, a: Floats, b: Floats) -> tuple[Floats, Bools]:
    """Return the position of each mirror's plane for links (n,), and whether both ends are in front; (n, mirrors)."""
    walls, count = len(mirrors.plane_m), len(a)
    plane = np.empty((count, len(mirrors.axis)))
    there = np.ones(plane.shape, dtype=bool)
    plane[:, :walls] = mirrors.plane_m
    below = np.maximum(a, b)[:, None] <= mirrors.low_m
    above = np.minimum(a, b)[:, None] >= mirrors.high_m
    plane[:, walls:] = np.where(below, mirrors.low_m, mirrors.high_m).reshape(count, mirrors.low_m.size)
    there[:, walls:] = (below | above).reshape(count, mirrors.low_m.size)
    return plane, there


def face_fraction(mirrors: Mirrors, point: Floats, share: Floats, length: Floats) -> Complexes:
    """Return the complex fraction of the reflecting zone on each face, (n, mirrors); 1 for the room's walls."""
    walls, boxes = len(mirrors.plane_m), len(mirrors.low_m)
    whole = np.ones(share.shape, dtype=np.complex128)
    spots = point[:, walls:].reshape(len(point), boxes, 3, 3)
    for face in range(3 if boxes else 0):
        mine = slice(walls + face, None, 3)
        for other in {0, 1, 2} - {face}:
            spot = spots[:, :, face, other]
            edges = (spot - mirrors.low_m[:, other], mirrors.high_m[:, other] - spot)
            first, second = (fresnel_number(edge, share[:, mine], length[:, mine]) for edge in edges)
            whole[:, mine] *= blocked_fraction(first) + blocked_fraction(second) - 1
    return whole


def reflection_gain(mirrors: Mirrors, axes: tuple[Floats, Floats], way: Floats, cosine: Floats) -> Complexes:
    """Return the gain of reflections by Fresnel's coefficients and the antennas' polarisations, (n, mirrors).

    `axes` (n, 3) each are those of the two antennas, `way` (3, n, mirrors) unit vectors k towards the image, `cosine`
    their components along the normals n. The axis of the other antenna is replaced by its image. The polarisation of an
    antenna is its axis z minus the component along k. Its part along n x k has the first Fresnel coefficient, the part
    across it the second.
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
    # At normal incidence there is no plane of incidence, and both coefficients are equal.
    straight = s * ((one * other).sum(axis=0) - parts[0][2] * parts[1][2]) / (parts[0][3] * parts[1][3])
    return np.asarray(np.where(sine2 > AXIAL**2, split, straight))
