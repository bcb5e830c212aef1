"""Combinations of antenna delays that the pairs of tags do not determine."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from calib.calibration.document import Split
from calib.data.ranges import Ranges
from uwblink.arrays import Floats

UNDETERMINED: Final = 1e-8
"""Smallest share of the largest eigenvalue at which a direction counts as determined.

Clock ratios differ from 1 by parts per million, so eigenvalues of undetermined directions are 1e-12 at most.
"""


def free_directions(tags: list[int], ranges: Ranges) -> tuple[Floats, list[Split]]:
    """Return the directions of delays that ranges do not determine, (tags, k) of length one, and the sides that they
    shift.

    `tags` are those whose delays are not known. Where tags range only with tags of another side (anchors against
    robots, a single pair), the delays of the sides can shift by +a and -a without changing any range.
    """
    ends, weights = (
        np.concatenate(both)
        for both in ((ranges.initiator, ranges.target), (ranges.weight_initiator, ranges.weight_target))
    )
    rows = np.flatnonzero(np.isin(ends, tags))
    place = (rows % len(ranges), np.searchsorted(tags, ends[rows]))
    design = sparse.csr_array((weights[rows], place), shape=(len(ranges), len(tags)))
    if ranges.arrivals is not None:
        # A difference of arrival depends only on the delay of the target.
        heard = np.intersect1d(ranges.target[ranges.arrivals.exchange], tags)
        alone = sparse.csr_array(
            (np.ones(len(heard)), (np.arange(len(heard)), np.searchsorted(tags, heard))), shape=(len(heard), len(tags))
        )
        design = sparse.vstack([design, alone], format="csr")
    # The square of the derivatives of ranges by the delays: pairs of tags that range have an entry.
    square = np.asarray((design.T @ design).toarray())
    pairs = np.array(tags)[np.argwhere(square - np.diag(np.diag(square)))]
    values, vectors = np.linalg.eigh(square)
    loose = vectors[:, values < UNDETERMINED * values[-1]]
    free = np.array(tags)[np.abs(loose).max(axis=1, initial=0.0) > 1e-3]
    ends = np.searchsorted(free, pairs[np.isin(pairs, free).all(axis=1)])
    graph = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(free), len(free)))
    count, group = connected_components(graph, directed=False)
    signs = [np.linalg.svd(loose[np.isin(tags, free[group == k])])[0][:, 0] for k in range(count)]
    sides = [[tuple(free[group == k][sign > 0].tolist()) for sign in (own, -own)] for k, own in enumerate(signs)]
    return np.asarray(loose), [(min(both), max(both)) for both in sides]
