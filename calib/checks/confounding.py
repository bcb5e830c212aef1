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
LEFT: Final = 0.215
"""Share of the lifted power's variance that distance must leave unexplained.

Tags on turning quadcopters leave a third and more, an anchor on a pole and a board on a tripod, outdoors, a fifth.
"""


def some_of(count: int) -> slice:
    """Return which of so many ranges are looked at."""
    return slice(None, None, max(count // ENOUGH, 1))


def explained_by_distance(lifted: Floats, truth_m: Floats) -> float | None:
    """Return the share of the variance of lifted powers (n,) that distance explains, where it is too much, else None.

    A curve over power then learns what belongs to distance.
    """
    every = some_of(len(lifted))
    lifted, truth_m = lifted[every], truth_m[every]
    good = np.isfinite(lifted) & np.isfinite(truth_m) & (truth_m > 0)
    if np.count_nonzero(good) < FEWEST or np.ptp(truth_m[good]) < SHORTEST_M:
        return None
    order = np.argsort(truth_m[good])
    # Lifted powers near the antennas outweigh all others, their decibels do not; either way is too much.
    share = max(_explained(lifted[good][order]), _explained(np.log(lifted[good][order])))
    return share if share > 1 - LEFT else None


def _explained(ordered: Floats) -> float:
    """Return the share of variance between groups of neighbours, of powers (n,) in order of distance."""
    groups = np.array_split(ordered, GROUPS)
    within = float(np.mean([np.var(group) for group in groups]))
    between = float(np.var([np.mean(group) for group in groups]))
    return between / max(within + between, 1e-300)
