"""Plane faces that reflect: a room's walls, floor and ceiling, and the sides of obstacles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from uwblink.arrays import Bools, Complexes, Floats, Ints
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.surroundings import Material, properties
from uwbsim.world.diffraction import covered, fresnel_number
from uwbsim.world.fresnel_reflection import fresnel, permittivity

AXIAL: Final = 1e-4
"""Sines below this count as none."""


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
        made_of = [_permittivity(m) for m in room.materials()] if room else []
        made_of += [_permittivity(box.material) for box in boxes for _ in range(3)]
        rough = [room.roughness_m] * 6 if room else []
        rough += [box.roughness_m for box in boxes for _ in range(3)]
        return cls(
            axis=np.array([*walls, *[0, 1, 2] * len(boxes)], dtype=np.int64),
            permittivity=np.array(made_of, dtype=np.complex128),
            roughness_m=np.array(rough, dtype=np.float64),
            plane_m=np.array(planes, dtype=np.float64),
            low_m=np.array([box.min_m for box in boxes], dtype=np.float64).reshape(-1, 3),
            high_m=np.array([box.max_m for box in boxes], dtype=np.float64).reshape(-1, 3),
        )


def _permittivity(material: str | Material) -> complex:
    return permittivity(*properties(material), metal=material == "metal")


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
