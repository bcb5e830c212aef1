"""How long errors last, and what that does to intervals: from the slopes of a fit, summed over short blocks of time.

Errors that share a cause (a reflection, a pose) come in stretches, and a sum of many blocks then varies more than
independent blocks would. How much more is read off the variances of sums over 1, 2, 4 ... blocks, all components
pooled, and fitted with an autocorrelation a rho^h. That sums over a whole recording are zero by construction (a fit
leaves no slope) is reckoned with: it hides errors that last for a good part of the recording.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import stdtrit

from calib.estimation.time_blocks import TimeBlocks
from calib.long_columns import let_go, spans
from uwblink.arrays import Floats, Ints

FEWEST_GROUPS: Final = 8
"""Sums of so few groups of blocks are looked at, and no fewer."""

FEWEST_STRETCHES: Final = 20.0
"""Of fewer independent stretches of time an interval is a guess."""

NESTED: Final = 2.0
"""Sums over 2 and over 4 blocks are made of the same blocks: what they say together counts so many times less."""

SHARES: Final = np.concatenate([[0.0], np.linspace(0.01, 1, 40) ** 1.5])
DURATIONS: Final = 40
LONGEST: Final = 6.0
"""Errors that last longer than such a part of a recording cannot be told from delays."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Persistence:
    """What persistence does: `factor` on variances, their degrees of freedom, and how many stretches are independent.

    `stretch_s` is how long a stretch of time is in which errors have to be taken for one.
    """

    factor: float
    freedom: float
    stretches: float
    stretch_s: float

    @property
    def quantile95(self) -> float:
        """Half the width of a 95 % interval, in standard errors."""
        return float(stdtrit(self.freedom, 0.975))


def lasting_in_pairs(slope: Floats, pair: Ints, blocks: TimeBlocks) -> float:
    """Return by how much more sums of slopes (n,) by pair (n,) vary than those of independent ranges would."""
    number, pairs = blocks.number, int(pair.max()) + 1
    flat = np.zeros(blocks.count * pairs)
    for rows in spans(len(slope)):
        flat += np.bincount(number[rows] * pairs + pair[rows], slope[rows], blocks.count * pairs)
        let_go(slope, pair)
    sums = flat.reshape(blocks.count, pairs)
    within = float(np.sum(sums**2) / max(float(slope @ slope), 1e-300))
    let_go(slope)
    return max(within, 1.0) * max(persistence(sums, blocks, pairs).factor, 1.0)


def persistence(slopes: Floats, time: TimeBlocks, independent: int, within: int = 1) -> Persistence:
    """Return what persistence does to sums of slopes (blocks, k), of whose columns so many are independent.

    How long errors last is looked at within sessions, and `within` so many spans of time: what differs between them is
    a matter of its own (`calib.estimation.alternatives`).
    """
    slopes, columns = time.pieces(slopes, within), slopes.shape[1]
    independent *= max(slopes.shape[1] // max(columns, 1) // within, 1)
    blocks = len(slopes)
    size = np.sum(slopes**2, axis=0)
    series = slopes[:, size > 0] / np.sqrt(size[size > 0])
    scales = [2**k for k in range(1, 12) if blocks // 2**k >= FEWEST_GROUPS]
    if not series.shape[1] or not scales:
        return Persistence(factor=1.0, freedom=max(blocks - 1.0, 1.0), stretches=float(time.count), stretch_s=0.0)
    found = np.log([_ratio(series, scale) for scale in scales])
    certain = 0.5 * max(independent, 1) * blocks / np.array(scales) / NESTED
    rho = np.exp(-1 / np.geomspace(0.3, blocks / LONGEST, DURATIONS))
    share, keep = (grid.ravel() for grid in np.meshgrid(SHARES, rho, indexing="ij"))
    factor = 1 + 2 * share * keep / (1 - keep)
    expected = np.array([_expected(share, keep, factor, scale, blocks) for scale in scales])
    with np.errstate(invalid="ignore", divide="ignore"):
        misfit = np.sum(certain[:, None] * (found[:, None] - np.log(expected)) ** 2, axis=0)
    misfit = np.where((factor < blocks / 3) & np.isfinite(misfit), misfit, np.inf)
    likely = np.exp(-0.5 * (misfit - misfit.min()))
    likely /= likely.sum()
    mean = float(np.exp(likely @ np.log(factor)))
    variance = float(likely @ (np.log(factor) - np.log(mean)) ** 2)
    # A variance known to a relative variance of 2/n has n degrees of freedom.
    freedom = min(2 / max(variance, 1e-12), (blocks / mean) * max(independent, 1))
    hidden = 1 - mean / blocks
    return Persistence(
        factor=mean / max(hidden, 0.25),
        freedom=max(freedom, 2.0),
        stretches=time.count / mean,
        stretch_s=time.seconds / time.count * mean,
    )


def _ratio(series: Floats, scale: int) -> float:
    """Return the mean square of sums over `scale` blocks over that of single ones, times as many."""
    whole = len(series) // scale * scale
    sums = series[:whole].reshape(-1, scale, series.shape[1]).sum(axis=1)
    return max(float(np.sum(sums**2) / max(np.sum(series[:whole] ** 2), 1e-300)), 1e-6)


def _expected(share: Floats, keep: Floats, factor: Floats, scale: int, blocks: int) -> Floats:
    """Return what `_ratio` is on average, where the sum over all blocks is held at zero."""
    # The sum over lags h below the scale s of (1 - h/s) rho^h.
    lasting = keep / (1 - keep) * (1 - (1 - keep**scale) / (scale * (1 - keep)))
    free = 1 + 2 * share * lasting
    return np.asarray((blocks * free - scale * factor) / (blocks - factor))
