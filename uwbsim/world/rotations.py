"""Rotations by quaternions x y z w, bit for bit as `scipy.spatial.transform` has them, which takes long to import.

Quaternions are body to world, (n, 4), of any length but zero. The formulas are those of Diebel, Representing Attitude
(2006), in the order in which scipy sums.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from uwblink.arrays import Floats

SMALL_RAD: Final = 1e-3
"""Below this a sine over its angle is taken by its series."""


def normalized(quaternion: Floats) -> Floats:
    """Return quaternions of length one."""
    x, y, z, w = quaternion.T
    return np.asarray(quaternion / np.sqrt(x * x + y * y + z * z + w * w)[:, None])


def matrices(quaternion: Floats) -> Floats:
    """Return rotation matrices, (n, 3, 3)."""
    x, y, z, w = np.ascontiguousarray(normalized(quaternion).T)
    x2, y2, z2, w2 = x * x, y * y, z * z, w * w
    xy, zw, xz, yw, yz, xw = x * y, z * w, x * z, y * w, y * z, x * w
    found = np.empty((len(x), 3, 3))
    found[:, 0, 0], found[:, 1, 1], found[:, 2, 2] = x2 - y2 - z2 + w2, -x2 + y2 - z2 + w2, -x2 - y2 + z2 + w2
    found[:, 1, 0], found[:, 0, 1] = 2 * (xy + zw), 2 * (xy - zw)
    found[:, 2, 0], found[:, 0, 2] = 2 * (xz - yw), 2 * (xz + yw)
    found[:, 2, 1], found[:, 1, 2] = 2 * (yz + xw), 2 * (yz - xw)
    return found


def turned(quaternion: Floats, vector: Floats) -> Floats:
    """Return a vector (3,), or vectors (n, 3), in the world's axes, (n, 3)."""
    found = np.einsum("nij,nj->ni" if vector.ndim == 2 else "nij,j->ni", matrices(quaternion), vector)
    return np.asarray(found)


def of_vectors(vector: Floats) -> Floats:
    """Return the quaternions of rotation vectors (n, 3), in radians."""
    x, y, z = vector.T
    angle = np.sqrt(x * x + y * y + z * z)
    squared = angle * angle
    small = angle <= SMALL_RAD
    series = 0.5 - squared / 48 + squared * squared / 3840
    scale = np.where(small, series, np.sin(angle / 2) / np.where(small, 1.0, angle))
    return np.column_stack([vector * scale[:, None], np.cos(angle / 2)])


def product(first: Floats, second: Floats) -> Floats:
    """Return what turns by the second quaternions, then by the first, of length one as these are."""
    a, b, c, d = np.ascontiguousarray(first.T)
    x, y, z, w = np.ascontiguousarray(second.T)
    found = np.empty_like(first)
    found[:, 0] = d * x + w * a + (b * z - c * y)
    found[:, 1] = d * y + w * b + (c * x - a * z)
    found[:, 2] = d * z + w * c + (a * y - b * x)
    found[:, 3] = d * w - a * x - b * y - c * z
    return normalized(found)
