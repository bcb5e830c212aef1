"""Where a body is by its ranges alone: a robust start, from anywhere."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np

from uwblink.arrays import Floats

SCALE_M: Final = 0.15
"""Errors of ranges beyond which they count for less: reflections are longer."""

HEIGHT_STD_M: Final = 0.3


@dataclass(frozen=True, slots=True)
class Fix:
    """A position (3,) and its covariance (3, 3), in metres."""

    place_m: Floats
    covariance_m2: Floats


def multilaterate(range_m: Floats, anchor_m: Floats, spread_m: float, height_m: float | None = None) -> Fix:
    """Return the position that ranges (n,) to anchors (n, 3) agree on, by a Cauchy loss, from nine starts.

    `spread_m` is by how much each range may be off besides its noise: by its lever arm, or because the body moves.
    A `height_m` above the world's zero counts as a measurement of `HEIGHT_STD_M`.
    """
    from scipy.optimize import least_squares

    scale = float(np.hypot(SCALE_M, spread_m))

    def misfit(place: Floats) -> Floats:
        errors = (np.linalg.norm(place - anchor_m, axis=1) - range_m) / scale
        return errors if height_m is None else np.append(errors, (place[2] - height_m) / HEIGHT_STD_M)

    middle, reach = anchor_m.mean(axis=0), np.maximum(np.ptp(anchor_m, axis=0), 1.0)
    starts = [middle, *(middle + 0.4 * reach * np.array(signs) for signs in product((-1, 1), repeat=3))]
    found = min((least_squares(misfit, start, loss="cauchy") for start in starts), key=lambda one: float(one.cost))
    slopes = np.asarray(found.jac, dtype=np.float64)
    return Fix(np.asarray(found.x), np.asarray(np.linalg.inv(slopes.T @ slopes + 1e-3 * np.eye(3))))
