"""Which unknown stands in which column: control points in order of time, then the border."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.trajectories.scene import Scene
from calib.trajectories.splines import Grid, grid_over, halved
from uwblink.arrays import Floats, Ints

POINT_S: Final = 0.4
"""Time between control points of a place: a multirotor does not change its acceleration faster."""

TURN_S: Final = 1.0
"""Time between control points of what attitudes are wrong by."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Columns:
    """Columns of places (points, moving, 3) and of errors of attitudes (points, moving, 3), -1 where none is sought.

    The border has `design` columns of delays and curves, then three for each standing body that is sought, then three
    of an accelerometer's bias for each body that has one, then one of what a height sensor is off by for each that has.
    """

    places: Grid
    turns: Grid
    place: Ints
    turn: Ints
    size: int
    design: int
    stand: Ints
    bias: Ints
    level: Ints
    border: int


def columns_of(scene: Scene, design: int, point_s: float = POINT_S) -> Columns:
    """Number the unknowns of a scene with so many columns of delays and curves."""
    begin, end = float(scene.time_s[0]), float(scene.time_s[-1])
    # On multiples of their distance, so that those of a part of the scene are those of the whole.
    begin = np.floor(begin / TURN_S) * TURN_S
    places, turns = grid_over(begin, end, point_s, 1), grid_over(begin, end, TURN_S, 0)
    loose = [body in scene.attitudes and not scene.attitudes[body].exact for body in scene.moving]
    moving = len(scene.moving)
    sought = np.ones((places.count, moving, 3), dtype=bool)
    turning = np.broadcast_to(np.array(loose, dtype=bool)[None, :, None], (turns.count, moving, 3))
    time = np.concatenate(
        [
            np.broadcast_to(places.times_s[:, None, None], sought.shape)[sought],
            np.broadcast_to(turns.times_s[:, None, None], turning.shape)[turning],
        ]
    )
    rank = np.empty(len(time), dtype=np.int64)
    rank[np.argsort(time, kind="stable")] = np.arange(len(time))
    place, turn = np.full(sought.shape, -1), np.full(turning.shape, -1)
    place[sought], turn[turning] = rank[: place.size], rank[place.size :]
    stand = design + np.arange(3 * len(scene.sought)).reshape(-1, 3)
    sensed = [body in scene.inertial for body in scene.moving]
    bias = np.full((moving, 3), -1)
    bias[sensed] = design + stand.size + np.arange(3 * sum(sensed)).reshape(-1, 3)
    levelled = np.isin(np.arange(moving), scene.heights.body)
    level = np.full(moving, -1)
    level[levelled] = design + stand.size + 3 * sum(sensed) + np.arange(np.count_nonzero(levelled))
    return Columns(
        places=places,
        turns=turns,
        place=place,
        turn=turn,
        size=len(time),
        design=design,
        stand=stand,
        bias=bias,
        level=level,
        border=design + stand.size + 3 * sum(sensed) + int(np.count_nonzero(levelled)),
    )


@dataclass(frozen=True, slots=True)
class State:
    """Values of the unknowns: those of the band (L,) and of the border (b,)."""

    local: Floats
    border: Floats

    def moved(self, local: Floats, border: Floats) -> State:
        """Return the state after a step."""
        return replace(self, local=self.local + local, border=self.border + border)


def refined(columns: Columns, finer: Columns, state: State) -> State:
    """Return the same trajectories by control points at half the distance."""
    local = np.zeros(finer.size)
    local[finer.place] = halved(columns.places, finer.places, state.local[columns.place])
    turns = finer.turn >= 0
    local[finer.turn[turns]] = state.local[columns.turn[turns]]
    return replace(state, local=local)
