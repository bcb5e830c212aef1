"""Covariances of what was fitted, from slopes summed over short blocks of time; persistence is reckoned with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.estimation.scores import Scores
from calib.estimator.time_blocks import Persistence, TimeBlocks, persistence
from calib.spread import TWO_SIDED_95
from uwblink.arrays import Floats

CURVE_SERIES: Final = 5
"""So many values of a smooth curve are about independent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Intervals:
    """Covariance (m, m) of the parameters of the design, and what persistence of errors it reckons with.

    1.96 of its standard errors make 95 % intervals: what a small sample takes is in it already. `by_block` (blocks, D)
    are the slopes summed over short blocks of time, from which all that follows.
    """

    covariance: Floats
    lasting: Persistence
    by_block: Floats


def intervals(
    scores: Scores, inverse: Floats, prior: Floats, delays: Floats, rank: int, blocks: TimeBlocks
) -> Intervals:
    """Return the covariance of the parameters of the design at an optimum.

    `inverse` (D, D) is that of information and penalty, `prior` (D, D) the covariance of the penalty's pull, which is
    the penalty itself only where the slopes of ranges are those of a likelihood, and ranges independent;
    `delays` (tags, m) turns parameters into delays, which the first `rank` stand for. Errors of delays and of curves
    may last differently.
    """
    columns = scores.design.shape[1]
    reach = inverse[:columns]
    by_block = scores.by_block(scores.design.kept(blocks.number), blocks.count)
    pulls = by_block @ reach.T
    # What all delays share is the curve's constant: it would hide how long errors of single delays last.
    apart = delays - delays.mean(axis=0) if len(delays) > 1 else delays
    lasting = persistence(pulls @ apart.T, blocks, max(len(delays) - 1, 1))
    factors = [lasting] * (rank > 0)
    if columns > rank:
        factors.append(persistence(pulls[:, rank:], blocks, CURVE_SERIES))
    widths = [np.sqrt(each.factor) * each.quantile95 / TWO_SIDED_95 for each in factors]
    width = np.repeat(widths, [rank, columns - rank] if rank and columns > rank else [columns])
    # Slopes at the optimum are smaller than at the truth: with information I and penalty P, the squares of so many
    # ranges are smaller by the share tr((I + P)^-1 I) / n on average, the parameters that the ranges determine over
    # their number. Of n ranges n less that many are left (HC1 of MacKinnon and White 1985, for a penalised fit).
    used = float(np.sum(inverse * scores.information()))
    fresh = len(blocks.number) / max(len(blocks.number) - used, 0.2 * len(blocks.number))
    covariance = fresh * (pulls.T @ pulls) * width[:, None] * width + reach @ prior @ reach.T
    lasting = lasting if rank else factors[-1]
    return Intervals(covariance=np.asarray(covariance), lasting=lasting, by_block=by_block)
