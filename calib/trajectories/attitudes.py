"""Attitudes of bodies as they are given, and how far they may be wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uwblink.arrays import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Attitude:
    """Attitudes at `time_s` (k,) as quaternions x y z w (k, 4), body to world, and what is known of their errors.

    Errors are turns about the world's axes: `std_rad` (3,) is how large they are at any time, infinite where that is
    not known, and `wander_rad` (3,) by how much they change within a second (a random walk). Where both are zero the
    attitudes are taken as they are. `begun` says whether the first heading is known.
    """

    time_s: Floats
    quaternion: Floats
    std_rad: Floats
    wander_rad: Floats
    begun: bool = True

    def headed(self, heading_rad: float) -> Attitude:
        """Return them turned about the world's vertical."""
        s, c = np.sin(heading_rad / 2), np.cos(heading_rad / 2)
        x, y, z, w = self.quaternion.T
        turned = np.column_stack([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z])
        return replace(self, quaternion=turned)

    @property
    def exact(self) -> bool:
        """Whether they are taken as they are."""
        return not (self.std_rad.any() or self.wander_rad.any())

    def at(self, time_s: Floats) -> Floats:
        """Return rotation matrices (n, 3, 3) at instants (n,), along the chords of quaternions; held at the ends."""
        time = np.clip(time_s, self.time_s[0], self.time_s[-1])
        if len(self.time_s) == 1:
            return matrices(np.broadcast_to(self.quaternion[0], (len(time), 4)))
        after = np.clip(np.searchsorted(self.time_s, time, side="right"), 1, len(self.time_s) - 1)
        span = self.time_s[after] - self.time_s[after - 1]
        share = (time - self.time_s[after - 1]) / np.where(span > 0, span, 1.0)
        first, second = self.quaternion[after - 1], self.quaternion[after]
        # q and -q are one attitude.
        sign = np.where(np.einsum("ij,ij->i", first, second) < 0, -1.0, 1.0)
        return matrices((1 - share)[:, None] * first + (share * sign)[:, None] * second)


def matrices(quaternion: Floats) -> Floats:
    """Return the rotation matrices (n, 3, 3) of quaternions x y z w (n, 4) of any length but zero."""
    x, y, z, w = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def turned(turn_rad: Floats, vector: Floats) -> Floats:
    """Return vectors (n, 3) turned by rotation vectors (n, 3) (Rodrigues)."""
    angle = np.linalg.norm(turn_rad, axis=1, keepdims=True)
    near = np.maximum(angle, 1e-12)
    once = np.cross(turn_rad, vector)
    return np.asarray(vector + np.sin(near) / near * once + (1 - np.cos(near)) / near**2 * np.cross(turn_rad, once))
