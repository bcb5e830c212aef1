"""The one covariance: slopes summed over blocks of time, between the inverses of what rows and priors know.

Errors that share a cause (a reflection, a pose) come in stretches. Slopes are therefore summed over blocks of time
within a pair, and of all pairs together, of several lengths; the length that makes the asked unknowns least certain
counts. Few blocks make an uncertain variance: intervals are those of Student's t. What the fit itself used of the data
is given back (HC1 of MacKinnon and White 1985, for a penalised fit), and what priors may pull is added (Wahba 1983).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from calib.estimator.inverse import trace_of_product
from calib.estimator.optimize import Optimum
from calib.estimator.range_rows import RangeRows
from calib.estimator.rows import projected
from calib.spread import TWO_SIDED_95
from uwblink.arrays import Floats, Ints

FINEST = 960
"""Shortest blocks of time: so many in a recording."""

LENGTHS = (1, 2, 4, 8, 16, 32, 64, 120)
"""Lengths of blocks, in the shortest ones; eight of the longest cover a recording."""


@dataclass(frozen=True, kw_only=True)
class Covariance:
    """Covariance (k, k) of the asked unknowns, and how long errors last: seconds of a block, and how many there are."""

    matrix: Floats
    block_s: float
    stretches: float


def sandwich(
    optimum: Optimum, rows: RangeRows, keep: Ints, pair: Ints, time: Ints, seconds: float, rank_by: Floats | None = None
) -> Covariance:
    """Return the covariance of the unknowns `keep` (k,) at an optimum.

    `pair` (n,) and `time` (n,) number the pair and the shortest block of time of each given range, which cover
    `seconds`; `rank_by` (m, k) are the combinations whose certainty chooses the length, by default all.
    """
    reach = optimum.covariance[:, keep]
    blocks = int(time.max()) + 1
    pairs = int(pair.max()) + 1
    sums = np.zeros((pairs * blocks, len(keep)))
    squares = np.zeros((len(keep),) * 2)
    at = 0
    for pull in projected(rows, optimum.x, reach):
        own = rows.order[at : at + len(pull)]
        at += len(pull)
        np.add.at(sums, pair[own] * blocks + time[own], pull)
        squares += pull.T @ pull
    series = sums.reshape(pairs, blocks, -1)
    combination = np.eye(len(keep)) if rank_by is None else rank_by
    best: Floats = squares
    chosen, several = 0.0, float(len(rows))
    largest = float(np.trace(combination @ squares @ combination.T))
    for length in LENGTHS:
        count = -(-blocks // length)
        if count < min(8, blocks):
            continue
        within = _summed(series, length)
        for sum_of, freedom in ((within.reshape(-1, len(keep)), count - 1.0), (within.sum(axis=0), count - 1.0)):
            if len(sum_of) < 24 and length > 1:
                continue
            wider = float(stdtrit(max(freedom, 2.0), 0.975) / TWO_SIDED_95) ** 2
            matrix = wider * (sum_of.T @ sum_of)
            size = float(np.trace(combination @ matrix @ combination.T))
            if size > largest:
                best, largest, chosen, several = matrix, size, length * seconds / blocks, count
    count = len(rows)
    used = trace_of_product(optimum.covariance, optimum.information)
    fresh = count / max(count - used, 0.2 * count)
    prior = reach.T @ optimum.priors.precision() @ reach
    return Covariance(matrix=fresh * best + prior, block_s=chosen, stretches=several)


def _summed(series: Floats, length: int) -> Floats:
    """Return sums over `length` blocks that follow each other, (pairs, blocks / length, k)."""
    starts = np.arange(0, series.shape[1], length)
    return np.asarray(np.add.reduceat(series, starts, axis=1))
