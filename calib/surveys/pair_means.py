"""Ranges of boards that stand still as one number a pair and arrangement: nothing is lost, because nothing changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.data.ranges import Ranges
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints

HUBER: Final = 1.345
"""Standard deviations beyond which a range is discounted in the mean of its pair: 95 % efficient for normal ones."""

FEWEST: Final = 5
"""Ranges that a pair needs in an arrangement."""

PARTS: Final = 10
"""Stretches of time whose means say how well the mean of all is known, also where errors last."""

LIFT: Final = "mean-of-lifted"


@dataclass(frozen=True, slots=True, kw_only=True)
class PairMeans:
    """One row a pair and arrangement (n,), the pair's smaller id first.

    `range_m` is the robust mean of raw ranges, `std_m` how well it is known, `noise_m` the spread of single ranges;
    `weight_first` and `weight_second` multiply the two antenna delays; `lifted` is the mean lifted power, NaN without.
    """

    arrangement: Ints
    first: Ints
    second: Ints
    range_m: Floats
    std_m: Floats
    noise_m: Floats
    count: Ints
    weight_first: Floats
    weight_second: Floats
    lifted: Floats

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.range_m)

    def __getitem__(self, rows: Bools | Ints) -> PairMeans:
        """Return the chosen rows."""
        return replace(self, **{name: getattr(self, name)[rows] for name in self.__slots__})

    def tags(self) -> list[int]:
        """Return the ids of all tags, in order."""
        return sorted({*self.first.tolist(), *self.second.tolist()})


def pair_means(ranges: Ranges, arrangement: Ints) -> tuple[PairMeans, int]:
    """Return the means of ranges (n,) whose `arrangement` (n,) is a number, or -1 for none; and how many were too few.

    Pairs of fewer than five ranges in an arrangement are left out; the second value counts them.
    """
    low, high = np.minimum(ranges.initiator, ranges.target), np.maximum(ranges.initiator, ranges.target)
    good = (arrangement >= 0) & np.isfinite(ranges.raw_m)
    keys = np.column_stack([arrangement, low, high])[good]
    found, inverse = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(inverse, kind="stable")
    groups = np.split(np.flatnonzero(good)[order], np.cumsum(np.bincount(inverse, minlength=len(found))))[: len(found)]
    kept = [(key, rows) for key, rows in zip(found, groups, strict=True) if len(rows) >= FEWEST]
    lifted = lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, LIFT, ALPHA_DBM)
    table = np.array([_row(ranges, key, rows, lifted) for key, rows in kept], dtype=float).reshape(-1, 10)
    ints = ("arrangement", "first", "second", "count")
    names = (*ints, "range_m", "std_m", "noise_m", "weight_first", "weight_second", "lifted")
    columns: dict[str, Any] = {n: table[:, k].astype(np.int64 if n in ints else float) for k, n in enumerate(names)}
    return PairMeans(**columns), len(found) - len(kept)


def _row(ranges: Ranges, key: Ints, rows: Ints, lifted: Floats) -> tuple[float, ...]:
    raw = ranges.raw_m[rows]
    mean, noise = robust_mean(raw)
    from_first = ranges.initiator[rows] == key[1]
    first = np.where(from_first, ranges.weight_initiator[rows], ranges.weight_target[rows])
    second = np.where(from_first, ranges.weight_target[rows], ranges.weight_initiator[rows])
    power = lifted[rows]
    lifted_mean = float(np.mean(power[np.isfinite(power)])) if np.isfinite(power).any() else np.nan
    weights = float(np.mean(first)), float(np.mean(second))
    return (*key.tolist(), len(rows), mean, _std_of_mean(raw, noise), noise, *weights, lifted_mean)


def robust_mean(values: Floats) -> tuple[float, float]:
    """Return Huber's mean of values (n,) and their robust standard deviation."""
    spread = max(robust_spread(values), 1e-4)
    mean = float(np.median(values))
    for _ in range(20):
        size = np.abs(values - mean) / spread
        weight = np.minimum(1.0, HUBER / np.maximum(size, HUBER))
        step = float((values * weight).sum() / weight.sum()) - mean
        mean += step
        if abs(step) < 1e-6 * spread:
            break
    return mean, spread


def _std_of_mean(values: Floats, noise: float) -> float:
    """Return how well a mean is known: by the scatter of its parts where that is more than independence says."""
    independent = noise / np.sqrt(len(values))
    if len(values) < 4 * PARTS:
        return float(1.05 * independent)
    parts = np.array([robust_mean(part)[0] for part in np.array_split(values, PARTS)])
    return float(max(1.05 * independent, np.std(parts, ddof=1) / np.sqrt(PARTS)))
