"""How long the errors of direct ranges last: a pair's ranges do not err independently of one another in time.

Short reflections, fading and power readings change slowly, so ranges of a pair that follow each other share a part of
their errors. A filter that takes them for independent is too sure of itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.document import Metres, Positive
from calib.data.ranges import Ranges
from uwblink.arrays import Floats

GATE: Final = 10.83
"""99.9 % quantile of chi-square with one degree of freedom: filters take ranges whose squared errors are below it."""

LONGEST_S: Final = 2.0
"""Lags that are looked at. A filter forgets its position within a second or so; fitted to lags of a minute, the
autocovariance says less of the first second, and positions in an office became 32 % worse instead of equal."""


@dataclass(frozen=True, slots=True)
class LastingErrors:
    """Errors of ranges within the gate of a filter, in units of sigma: mean, variance of the part that each range has
    of its own, variance of the part that lasts, and the time in which that forgets."""

    mean: Metres
    own_variance: Positive
    lasting_variance: Positive
    time_s: Positive


def lasting_errors(ranges: Ranges, z: Floats) -> LastingErrors | None:
    """Fit the autocovariance a exp(-lag / time) to errors over sigma (n,), pair by pair; None where none is seen.

    The autocovariance is averaged in bins of the logarithm of the lag; those with few products say nothing.
    """
    inside = np.flatnonzero(z**2 < GATE)
    low, high = (np.sort([ranges.initiator[inside], ranges.target[inside]], axis=0)).astype(np.int64)
    pair = (ranges.session[inside].astype(np.int64) << 32) + (low << 16) + high
    order = np.lexsort((ranges.time_ns[inside], pair))
    pair, time_s = pair[order], ranges.time_ns[inside][order] * 1e-9
    mean, total = float(np.mean(z[inside])), float(np.var(z[inside]))
    away = z[inside][order] - mean
    edges = np.geomspace(0.01, LONGEST_S, 17)
    count, product, lag = np.zeros((3, len(edges) + 1))
    for step in np.unique(np.rint(1.15 ** np.arange(60))).astype(np.int64):
        apart = time_s[step:] - time_s[:-step]
        same = (pair[step:] == pair[:-step]) & (apart < LONGEST_S)
        if not same.any():
            break
        place = np.digitize(apart[same], edges)
        count += np.bincount(place, minlength=len(count))
        product += np.bincount(place, (away[step:] * away[:-step])[same], len(count))
        lag += np.bincount(place, apart[same], len(count))
    told = np.flatnonzero(count[:-1] >= 50)
    if not len(told):
        return None
    covariance, lag = product[told] / count[told], lag[told] / count[told]
    times = np.geomspace(0.02, LONGEST_S, 60)
    shapes = np.exp(-lag / times[:, None])
    size = np.clip(shapes @ covariance / np.sum(shapes**2, axis=1), 1e-6, 0.99 * total)
    best = int(np.argmin(np.sum((size[:, None] * shapes - covariance) ** 2, axis=1)))
    return LastingErrors(mean, total - float(size[best]), float(size[best]), float(times[best]))
