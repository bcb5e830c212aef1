"""Distances by a tape that contradict the ranges: each held against what all else says of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.trajectories.arrow import Factored
from calib.trajectories.known_rows import KnownRows
from calib.trajectories.tapes import Tapes
from calib.trajectories.unknowns import State
from uwblink.arrays import Floats

SURELY: Final = 4.0
MATTERS_M: Final = 0.03
ALONE: Final = 0.999
"""A distance that is known by itself alone, to such a share, contradicts nothing."""


def contradictions(known: KnownRows, tapes: Tapes, state: State, whole: Factored, schur: Floats) -> Iterator[str]:
    """Yield in sentences which distances are not what the fit would say without them (deleted residuals; Cook 1982)."""
    if not len(tapes):
        return
    residual, local, border = known.tapes.linear(state)
    for number, one in enumerate(tapes.told):
        mine = np.flatnonzero(tapes.number == number)
        row, edge = np.asarray(local[mine].mean(axis=0)).ravel(), border[mine].mean(axis=0)
        left = edge - row @ whole.reach
        variance = float(row @ whole.inverse_on(row)) + float(left @ np.linalg.lstsq(schur, left, rcond=1e-13)[0])
        share = min(variance / one.sigma_m**2, 1.0)
        off = float(residual[mine].mean())
        if share > ALONE or abs(off) < SURELY * one.sigma_m * np.sqrt(1 - share) or abs(off) < MATTERS_M * (1 - share):
            continue
        deviation, without = off / (one.sigma_m * np.sqrt(1 - share)), off / (1 - share)
        way = "more" if without > 0 else "less"
        yield (
            f"the distance of tags {one.first} and {one.second}, {one.distance_m:.3f} m, is {100 * abs(without):.0f} "
            f"cm {way} than all else says ({abs(deviation):.0f} standard errors): measure it again"
        )
