"""Whether bodies move faster than their control points follow: neighbouring ranges that are wrong by one motion.

A motion that a trajectory leaves out is in all ranges of its body, along each one's direction. So residuals of ranges
that follow each other within a fraction of the distance between control points go together, as far as their directions
do, whatever their partners. Errors that belong to a pair of tags (a reflection that lasts) are kept out of it: only
ranges of other pairs are multiplied.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from calib.trajectories.range_losses import RangeLoss
from calib.trajectories.range_rows import RangeRows
from calib.trajectories.scene import Scene
from calib.trajectories.unknowns import Columns, State
from uwblink.arrays import Floats

NEAR: Final = (0.08, 0.16, 0.3)
"""Ranges follow each other closely if they do within such parts of the time between control points."""

NEIGHBOURS: Final = 8
SURELY: Final = 4.0
MATTERS_M: Final = 0.01
FEWEST: Final = 50


@dataclass(frozen=True, slots=True)
class Coarseness:
    """How many standard errors neighbours go together by, and how large a motion along an axis in metres that says."""

    deviation: float = 0.0
    motion_m: float = 0.0

    @property
    def shows(self) -> bool:
        """Whether bodies move as their control points cannot."""
        return self.deviation > SURELY and self.motion_m > MATTERS_M

    def told(self, step_s: float) -> list[str]:
        """Return it as a sentence, if it shows; control points are `step_s` apart."""
        if not self.shows:
            return []
        return [
            f"bodies move faster than control points every {step_s:.1f} s follow: about {100 * self.motion_m:.0f} cm "
            "of their motion is not in the trajectories, and distances are off by it; fly more calmly"
        ]


@dataclass(frozen=True, slots=True)
class _Neighbours:
    """Products of neighbouring slopes (k,), what they would be for a motion of a metre, and how far apart in time."""

    product: Floats
    of_a_metre: Floats
    apart_s: Floats

    def within(self, begin_s: float, end_s: float) -> Coarseness:
        """Return what the products of ranges so far apart say."""
        some = (self.apart_s > begin_s) & (self.apart_s <= end_s)
        if np.count_nonzero(some) < FEWEST:
            return Coarseness()
        product = self.product[some]
        deviation = float(np.sum(product) / np.sqrt(np.sum(product**2) + 1e-300))
        return Coarseness(deviation, float(np.sqrt(max(np.sum(product) / np.sum(self.of_a_metre[some]), 0.0))))


def coarseness(
    scene: Scene, columns: Columns, rows: RangeRows, state: State, loss: RangeLoss, informed: Floats
) -> Coarseness:
    """Return how much of the bodies' motion is not in their trajectories.

    `loss` is that of the ranges, `informed` (n,) what each says of its residual.
    """
    slope = loss.slopes(rows.residuals(state))[0]
    away = rows.directions(state)
    parts = [_of_body(scene, rows, body, away, slope, informed) for body in range(len(scene.moving))]
    names = ("product", "of_a_metre", "apart_s")
    every = _Neighbours(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
    edges = [-1.0, *(part * columns.places.step_s for part in NEAR)]
    return max((every.within(*span) for span in pairwise(edges)), key=lambda one: one.deviation)


def _of_body(scene: Scene, rows: RangeRows, body: int, away: Floats, slope: Floats, informed: Floats) -> _Neighbours:
    first, second = (side.ends.mover == body for side in rows.sides)
    mine = np.flatnonzero(first != second)
    away = away[mine] * np.where(first[mine], 1.0, -1.0)[:, None]
    slope, known, time = slope[mine], informed[mine], scene.time_s[mine]
    low, high = (choose(scene.ranges.initiator, scene.ranges.target)[mine] for choose in (np.minimum, np.maximum))
    found = []
    for step in range(1, min(NEIGHBOURS, len(mine) - 1) + 1):
        before = np.flatnonzero((low[step:] != low[:-step]) | (high[step:] != high[:-step]))
        after = before + step
        along = np.einsum("na,na->n", away[before], away[after])
        products = slope[before] * slope[after] * along, known[before] * known[after] * along**2
        found.append(np.vstack([*products, time[after] - time[before]]))
    return _Neighbours(*np.concatenate([np.zeros((3, 0)), *found], axis=1))
