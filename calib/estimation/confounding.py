"""Whether the power of ranges is a function of their distance and of nothing else."""

from __future__ import annotations

from typing import Final

import numpy as np

from uwblink.arrays import Floats

FEWEST: Final = 300
ENOUGH: Final = 5000
"""Of more ranges, only every so many are looked at."""

SHORTEST_M: Final = 0.5
"""Distances that vary less than this cannot explain a power."""

GROUPS: Final = 40
LEFT: Final = 0.4
"""Share of the lifted power's variance that distance must leave unexplained.

Tags on turning quadcopters leave two thirds, an anchor on a pole and a board on a tripod, outdoors, a fifth.
"""


def explained_by_distance(lifted: Floats, truth_m: Floats) -> float | None:
    """Return the share of the variance of lifted powers (n,) that distance explains, where it is too much, else None.

    A curve over power then learns what belongs to distance.
    """
    every = slice(None, None, max(len(lifted) // ENOUGH, 1))
    lifted, truth_m = lifted[every], truth_m[every]
    good = np.isfinite(lifted) & np.isfinite(truth_m) & (truth_m > 0)
    if np.count_nonzero(good) < FEWEST or np.ptp(truth_m[good]) < SHORTEST_M:
        return None
    groups = np.array_split(lifted[good][np.argsort(truth_m[good])], GROUPS)
    within = float(np.mean([np.var(group) for group in groups]))
    between = float(np.var([np.mean(group) for group in groups]))
    if within >= LEFT * (within + between):
        return None
    return between / (within + between)
