"""Places from the lengths between them: the start of searches."""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import floyd_warshall

from uwblink.arrays import Floats, Ints


def scaled_places(
    ends: Ints, length_m: Floats, count: int, dimensions: int, *, most_m: float = np.inf, least_m2: float = 0.0
) -> Floats:
    """Return `count` places (n, 3) about their centre, in so many dimensions, from lengths (k,) between `ends` (k, 2).

    Classical scaling (Torgerson 1952). Points without a length have the distance of the shortest path over others, or
    the longest such distance if there is no path; all are `most_m` at most. Eigenvalues are `least_m2` at least.
    """
    known = np.full((count, count), np.inf)
    known[ends[:, 0], ends[:, 1]] = known[ends[:, 1], ends[:, 0]] = length_m
    apart = np.minimum(floyd_warshall(known, directed=False), most_m)
    apart = np.where(np.isfinite(apart), apart, apart[np.isfinite(apart)].max(initial=1.0))
    centring = np.eye(count) - 1 / count
    values, vectors = np.linalg.eigh(-0.5 * centring @ apart**2 @ centring)
    top = np.argsort(values)[::-1][:dimensions]
    found = np.zeros((count, 3))
    found[:, : len(top)] = vectors[:, top] * np.sqrt(np.maximum(values[top], least_m2))
    return found
