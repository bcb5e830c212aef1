"""Autocovariance of the errors of direct ranges: errors of a pair are not independent in time.

Short reflections, fading and power readings change slowly, so successive ranges of a pair share a part of their errors.
A filter that assumes independent errors is overconfident.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.document import Metres, Positive
from calib.data.ranges import Ranges
from calib.pairs import pairs_of
from uwblink.arrays import Floats

GATE: Final = 10.83
"""99.9 % quantile of chi-square with one degree of freedom: filters take ranges whose squared errors are below it."""

LONGEST_S: Final = 2.0
"""Longest lag. A filter forgets its position within about a second; with lags up to a minute the fit describes the
first second less well, and positions in an office became 32 % worse instead of equal."""


@dataclass(frozen=True, slots=True)
class LastingErrors:
    """Errors of ranges within the gate of a filter, in units of sigma: mean, variance of the independent part, variance
    of the lasting part, and the time constant of the latter."""

    mean: Metres
    own_variance: Positive
    lasting_variance: Positive
    time_s: Positive


def lasting_errors(ranges: Ranges, z: Floats) -> LastingErrors | None:
    """Fit the autocovariance a exp(-lag / time) to errors over sigma (n,) by pair; None without enough products.

    The autocovariance is averaged in bins of the logarithm of the lag; bins with few products are left out.
    """
    inside = np.flatnonzero(z**2 < GATE)
    pairs = pairs_of(ranges.initiator[inside], ranges.target[inside])
    pair = ranges.session[inside] * np.int64(len(pairs.ends)) + pairs.number
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
