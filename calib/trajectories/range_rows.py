"""Ranges as functions of trajectories: residuals, and their derivatives by every unknown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.trajectories.attitudes import turned
from calib.trajectories.scene import Ends, Scene, ends_of
from calib.trajectories.splines import Weights, cubic, straight
from calib.trajectories.unknowns import Columns, State
from uwblink.arrays import Bools, Floats, Ints

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, slots=True)
class Side:
    """One end of each range, and the columns (n, k, 3) with shares (n, k) that say where it is and how it is turned."""

    ends: Ends
    place: Ints
    place_share: Floats
    turn: Ints
    turn_share: Floats


@dataclass(frozen=True, slots=True)
class RangeRows:
    """Residuals `error + design @ delays and curves - distance` (n,), in metres.

    `error` is the range with what pinned delays add.
    """

    sides: tuple[Side, Side]
    columns: Columns
    error: Floats
    design: Floats

    def distances(self, state: State) -> Floats:
        """Return the distances between antennas (n,), metres."""
        first, second = (self._antenna(side, state)[0] for side in self.sides)
        return np.asarray(np.linalg.norm(second - first, axis=1))

    def directions(self, state: State) -> Floats:
        """Return unit vectors (n, 3) from each range's first antenna to its second."""
        first, second = (self._antenna(side, state)[0] for side in self.sides)
        return _unit(second - first)

    def residuals(self, state: State) -> Floats:
        """Return the residuals (n,)."""
        fitted = self.design @ state.border[: self.columns.design]
        return np.asarray(self.error + fitted - self.distances(state))

    def linear(self, state: State) -> tuple[Floats, csr_array[Any], Floats]:
        """Return residuals (n,), and their derivatives by the band (n, L) and by the border (n, b)."""
        from scipy.sparse import csr_array

        (first, arm_first), (second, arm_second) = (self._antenna(side, state) for side in self.sides)
        away = second - first
        distance = np.linalg.norm(away, axis=1)
        towards = _unit(away)
        count, columns = len(distance), self.columns
        border = np.zeros((count, columns.border))
        border[:, : columns.design] = self.design
        parts = []
        for side, arm, sign in zip(self.sides, (arm_first, arm_second), (1.0, -1.0), strict=True):
            pull = sign * towards
            parts.append(_entries(side.place, side.place_share, pull))
            # By a turn t the arm a moves by t x a, and u (t x a) = t (a x u).
            parts.append(_entries(side.turn, side.turn_share, np.cross(arm, pull)))
            known = np.flatnonzero(side.ends.stander >= 0)
            where = columns.stand[side.ends.stander[known]]
            for axis in range(3):
                np.add.at(border, (known, where[:, axis]), pull[known, axis])
        index, value = (np.concatenate([part[k] for part in parts], axis=1) for k in (0, 1))
        starts = np.arange(count + 1) * index.shape[1]
        local = csr_array((value.ravel(), index.ravel(), starts), shape=(count, columns.size))
        fitted = self.design @ state.border[: columns.design]
        return self.error + fitted - distance, local, border

    def _antenna(self, side: Side, state: State) -> tuple[Floats, Floats]:
        """Return where the antennas of one end are (n, 3), and their lever arms in the world's axes (n, 3)."""
        place = np.einsum("nk,nka->na", side.place_share, _taken(state.local, side.place))
        turn = np.einsum("nk,nka->na", side.turn_share, _taken(state.local, side.turn))
        arm = turned(turn, side.ends.arm_m)
        stand = np.zeros_like(arm)
        known = side.ends.stander >= 0
        stand[known] = state.border[self.columns.stand[side.ends.stander[known]]]
        return side.ends.base_m + stand + place + arm, arm


def range_rows(scene: Scene, columns: Columns, error: Floats, design: Floats) -> RangeRows:
    """Return the ranges of a scene as rows over its columns."""
    ends = scene.ranges.initiator, scene.ranges.target
    return RangeRows(_sides(scene, columns, ends, scene.time_s), columns, error, design)


def tape_rows(scene: Scene, columns: Columns) -> RangeRows:
    """Return the distances that were measured otherwise as rows over the columns of a scene."""
    tapes = scene.tapes
    # What holds always is between bodies that stand: any instant will do.
    time = np.where(np.isnan(tapes.time_s), scene.time_s[0], tapes.time_s)
    sides = _sides(scene, columns, (tapes.first, tapes.second), time)
    return RangeRows(sides, columns, tapes.distance_m, np.zeros((len(tapes), columns.design)))


def _sides(scene: Scene, columns: Columns, ends: tuple[Ints, Ints], time_s: Floats) -> tuple[Side, Side]:
    weights = cubic(columns.places, time_s), straight(columns.turns, time_s)
    first, second = (_side(ends_of(scene, ids, time_s), columns, *weights) for ids in ends)
    return first, second


def _side(ends: Ends, columns: Columns, place: Weights, turn: Weights) -> Side:
    moves = ends.mover >= 0
    where = np.where(moves[:, None, None], columns.place[place.point, ends.mover[:, None]], -1)
    turns = np.where(moves[:, None, None], columns.turn[turn.point, ends.mover[:, None]], -1)
    return Side(ends, where, _shares(where, place.share), turns, _shares(turns, turn.share))


def _unit(away: Floats) -> Floats:
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1), 1e-6)[:, None])


def _shares(columns: Ints, share: Floats) -> Floats:
    return np.where(columns[:, :, 0] >= 0, share, 0.0)


def _taken(values: Floats, columns: Ints) -> Floats:
    """Return values at columns, which may be -1 where their share is zero."""
    return values[columns] if len(values) else np.zeros(columns.shape)


def _entries(columns: Ints, share: Floats, pull: Floats) -> tuple[Ints, Floats]:
    """Return column and value of the derivatives (n, k * 3); what has no column stands in the first, as zero."""
    value = share[:, :, None] * pull[:, None, :]
    flat = (len(columns), -1)
    return np.maximum(columns, 0).reshape(flat), value.reshape(flat)


def rows_within(mask: Bools, rows: RangeRows) -> RangeRows:
    """Return some of the rows."""

    def some(side: Side) -> Side:
        ends = Ends(*(getattr(side.ends, name)[mask] for name in ("mover", "stander", "base_m", "arm_m")))
        return Side(ends, *(getattr(side, name)[mask] for name in ("place", "place_share", "turn", "turn_share")))

    return RangeRows((some(rows.sides[0]), some(rows.sides[1])), rows.columns, rows.error[mask], rows.design[mask])
