"""Places from lengths between them: where searches begin."""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import floyd_warshall

from uwblink.arrays import Floats


def scaled_places(length_m: Floats, dimensions: int, *, most_m: float = np.inf, least_m2: float = 0.0) -> Floats:
    """Return places (n, 3) about their centre, in so many dimensions, from lengths (n, n), infinite where unknown.

    Classical scaling (Torgerson 1952). What has no length is as far apart as the shortest path over others, or as the
    longest of these where there is none; all are `most_m` at most. Eigenvalues are `least_m2` at least.
    """
    apart = np.minimum(floyd_warshall(length_m, directed=False), most_m)
    apart = np.where(np.isfinite(apart), apart, apart[np.isfinite(apart)].max(initial=1.0))
    centring = np.eye(len(apart)) - 1 / len(apart)
    values, vectors = np.linalg.eigh(-0.5 * centring @ apart**2 @ centring)
    top = np.argsort(values)[::-1][:dimensions]
    found = np.zeros((len(apart), 3))
    found[:, : len(top)] = vectors[:, top] * np.sqrt(np.maximum(values[top], least_m2))
    return found
