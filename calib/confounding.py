"""Whether the power of ranges is a function of their distance and of nothing else."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FEWEST: Final = 300
ENOUGH: Final = 5000
"""Of more ranges, only every so many are looked at."""

SHORTEST_M: Final = 0.5
"""Distances that vary less than this cannot explain a power."""

GROUPS: Final = 40
LEFT: Final = 0.12
"""Share of the power's variance that distance must leave unexplained."""


def explained_by_distance(power: Floats, truth_m: Floats) -> float | None:
    """Return the share of the variance of `power` (n,) that distance explains, where it is too much, else None.

    A curve over power then learns what belongs to distance. Power may be in any unit that grows with power.
    """
    every = slice(None, None, max(len(power) // ENOUGH, 1))
    power, truth_m = power[every], truth_m[every]
    good = np.isfinite(power) & np.isfinite(truth_m) & (truth_m > 0)
    if np.count_nonzero(good) < FEWEST or np.ptp(truth_m[good]) < SHORTEST_M:
        return None
    groups = np.array_split(power[good][np.argsort(truth_m[good])], GROUPS)
    within = float(np.median([np.var(group) for group in groups]))
    between = float(np.var([np.mean(group) for group in groups]))
    if within >= LEFT * (within + between):
        return None
    return between / (within + between)
