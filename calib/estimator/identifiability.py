"""Whether the pairs of tags determine the antenna delays, and which combinations of delays they leave free."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from uwblink.arrays import Floats, Ints

UNDETERMINED: Final = 1e-8
"""Smallest share of the largest eigenvalue at which a direction counts as determined.

Clock ratios differ from 1 by parts per million, which lifts a free direction to 1e-12 at most.
"""


def square_of(tags: list[int], initiator: Ints, target: Ints, first: Floats, second: Floats) -> tuple[Floats, Ints]:
    """Return the square (tags, tags) of the derivatives of ranges (n,) by the delays of tags, and their pairs (k, 2).

    `first` and `second` are the weights of the delays of initiator and target.
    """
    rows = np.arange(len(initiator))
    columns = [np.searchsorted(tags, ids) for ids in (initiator, target)]
    place = (np.tile(rows, 2), np.concatenate(columns))
    design = sparse.csr_matrix((np.concatenate([first, second]), place), shape=(len(rows), len(tags)))
    square = np.asarray((design.T @ design).toarray())
    return square, np.array(tags)[np.argwhere(square - np.diag(np.diag(square)))]


def free_directions(square: Floats, tags: list[int], pairs: Ints) -> tuple[Floats, list[list[int]]]:
    """Return the directions that ranges leave free, (tags, k) of length one, and the tags that they shift.

    `square` (tags, tags) is that of the derivatives of ranges by the delays, `pairs` (pairs, 2) are the ids that range.
    The free tags come in groups that shift together: tags that range only with tags of another group (anchors against
    robots, a single pair) can shift by +a and -a without a trace in any range.
    """
    values, vectors = np.linalg.eigh(square)
    loose = vectors[:, values < UNDETERMINED * values[-1]]
    free = np.array(tags)[np.abs(loose).max(axis=1, initial=0.0) > 1e-3]
    ends = np.searchsorted(free, pairs[np.isin(pairs, free).all(axis=1)])
    graph = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(free), len(free)))
    count, group = connected_components(graph, directed=False)
    return np.asarray(loose), [free[group == k].tolist() for k in range(count)]
