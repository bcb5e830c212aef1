"""Short blocks of the time that ranges cover, and the persistence of errors, from sums over such blocks.

Time counts only where there are ranges. Sessions are laid end to end, and gaps within a session are left out: a gap has
no measurements, so a pause of hours must neither lengthen blocks nor count as recorded time.

Errors that share a cause (a reflection, a pose) last for some time. The increase of the variance of sums is fitted with
an autocorrelation a rho^h. The fit makes sums over a whole recording zero, which hides errors that last for a large
part of the recording; this is included.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse

from calib.data.ranges import Ranges
from uwblink.arrays import Floats, Ints

GAP_S: Final = 10.0
"""There is a gap between ranges that are further apart than this and than twenty usual intervals. Errors in recordings
last for seconds (docs/accuracy.md); slow schedules and pairs in turn make no gaps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeBlocks:
    """Blocks of time: `number` (n,) is the block of each range, `bounds` (sessions + 1,) are the first blocks of
    sessions.

    `seconds` is the time that the ranges cover.
    """

    number: Ints
    bounds: Ints
    seconds: float

    @property
    def count(self) -> int:
        """Return the number of blocks."""
        return int(self.bounds[-1])

    def summing(self, rows: Ints) -> sparse.csr_matrix:
        """Return a matrix (blocks, k) that sums over the given rows (k,) by block."""
        place = (self.number[rows], np.arange(len(rows)))
        return sparse.csr_matrix((np.ones(len(rows)), place), shape=(self.count, len(rows)))

    def pieces(self, series: Floats, spans: int = 1) -> Floats:
        """Return sums by block (blocks, k) as columns of pieces of equal length, minus their means.

        There are about as many pieces as `spans`; no piece crosses sessions. A single piece is the unchanged series.
        """
        sizes = np.diff(self.bounds)
        spans = min(spans, self.count)
        if len(sizes) == 1 and spans == 1:
            return series
        length = self.count // spans
        if len(sizes) > 1:
            # A quarter shorter than the mean session, so that sessions of different lengths have pieces too.
            length = max(int(0.75 * self.count / max(spans, len(sizes))), 1)
        starts = [
            first + length * k
            for first, size in zip(self.bounds[:-1].tolist(), sizes.tolist(), strict=True)
            for k in range(size // length)
        ]
        cut = np.array([series[first : first + length] for first in starts])
        return np.hstack(list(cut - cut.mean(axis=1, keepdims=True)))


def in_order(ranges: Ranges) -> Ranges:
    """Return ranges in order of their sessions, and of time within each."""
    order = np.lexsort((ranges.time_ns, ranges.session))
    return ranges if np.all(np.diff(order) == 1) else ranges[order]


def time_blocks(time_ns: Ints, session: Ints) -> TimeBlocks:
    """Cut the time that ranges (n,) cover into a thousand short blocks, fewer if these would be shorter than 0.1 s.

    Ranges are in order of their sessions, and of time within each. Blocks do not cross sessions or gaps. There are
    thirty blocks at least: with fewer blocks than unknowns (some twenty) the covariance of block sums is singular.
    """
    steps = np.diff(time_ns, prepend=time_ns[:1])
    changed = np.diff(session, prepend=session[:1]) != 0
    cut = changed | (steps > max(GAP_S * 1e9, 20 * float(np.median(steps))))
    steps[cut] = 0
    elapsed = np.cumsum(steps)
    whole = int(elapsed[-1])
    length = max(whole // 1000, min(100_000_000, whole // 30), 1)
    cut[1:] |= np.diff(elapsed // length) > 0
    number: Ints = np.asarray(np.cumsum(cut), dtype=np.int32)
    first = np.concatenate([[0], np.flatnonzero(changed)])
    bounds = np.append(number[first], number[-1] + 1).astype(np.int64)
    return TimeBlocks(number=number, bounds=bounds, seconds=float(elapsed[-1]) * 1e-9)


FEWEST_STRETCHES: Final = 20.0
"""Minimum number of independent stretches of time for a reliable interval: a variance over twenty is known to a third
(the root of 2/19)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Persistence:
    """The effect of persistence: `factor` on variances, degrees of freedom, and the number of independent stretches.

    `stretch_s` is the length of a stretch of time whose errors count as one.
    """

    factor: float
    freedom: float
    stretches: float
    stretch_s: float


def lasting_in_pairs(slope: Floats, pair: Ints, blocks: TimeBlocks, spans: int = 1) -> float:
    """Return the variance of sums of slopes (n,) by pair (n,) in `spans` spans, divided by the variance for independent
    ranges.
    """
    pairs = int(pair.max()) + 1
    flat = np.bincount(blocks.number * pairs + pair, slope, blocks.count * pairs)
    sums: Floats = flat.astype(np.float64).reshape(blocks.count, pairs)
    within = float(np.sum(sums**2) / max(float(slope @ slope), 1e-300))
    return max(within, 1.0) * max(persistence(sums, blocks, pairs, spans).factor, 1.0)


def persistence(slopes: Floats, time: TimeBlocks, independent: int, within: int = 1) -> Persistence:
    """Return the effect of persistence on sums of slopes (blocks, k), with this number of independent columns.

    Persistence is measured within sessions and within spans of time (`within` of them). Differences between these are
    tested separately (`calib.checks.fitted`).
    """
    slopes, columns = time.pieces(slopes, within), slopes.shape[1]
    independent *= max(slopes.shape[1] // max(columns, 1) // within, 1)
    blocks = len(slopes)
    size = np.sum(slopes**2, axis=0)
    series = slopes[:, size > 0] / np.sqrt(size[size > 0])
    # At least eight sums are compared: the variance of fewer is too uncertain.
    scales = [2**k for k in range(1, 12) if blocks // 2**k >= 8]
    if not series.shape[1] or not scales:
        return Persistence(factor=1.0, freedom=max(blocks - 1.0, 1.0), stretches=float(time.count), stretch_s=0.0)
    found = np.log([_ratio(series, scale) for scale in scales])
    # Sums over 2 and over 4 blocks share blocks: together they have half of the information of independent sums.
    certain = 0.5 * max(independent, 1) * blocks / np.array(scales) / 2
    # Errors that last longer than a sixth of a recording cannot be distinguished from delays.
    rho = np.exp(-1 / np.geomspace(0.3, blocks / 6, 40))
    shares = np.concatenate([[0.0], np.linspace(0.01, 1, 40) ** 1.5])
    share, keep = (grid.ravel() for grid in np.meshgrid(shares, rho, indexing="ij"))
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
    """Return the mean square of sums over `scale` blocks, divided by `scale` times the mean square of single blocks."""
    whole = len(series) // scale * scale
    sums = series[:whole].reshape(-1, scale, series.shape[1]).sum(axis=1)
    return max(float(np.sum(sums**2) / max(np.sum(series[:whole] ** 2), 1e-300)), 1e-6)


def _expected(share: Floats, keep: Floats, factor: Floats, scale: int, blocks: int) -> Floats:
    """Return the mean of `_ratio` under the condition that the sum over all blocks is zero."""
    # The sum over lags h below the scale s of (1 - h/s) rho^h.
    lasting = keep / (1 - keep) * (1 - (1 - keep**scale) / (scale * (1 - keep)))
    free = 1 + 2 * share * lasting
    return np.asarray((blocks * free - scale * factor) / (blocks - factor))
