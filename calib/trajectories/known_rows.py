"""All that is known beside ranges, as rows that are linear in the unknowns: places, attitudes, forces, calm flight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.trajectories.arrow import Normal, normal_of
from calib.trajectories.inertial import GRAVITY_M_S2
from calib.trajectories.range_rows import RangeRows, tape_rows
from calib.trajectories.scene import Scene
from calib.trajectories.splines import cubic, cubic_speed, straight
from calib.trajectories.unknowns import Columns, State
from uwblink.arrays import Floats, Ints

if TYPE_CHECKING:
    from scipy.sparse import csr_array

CALM_M_S2: Final = 5.0
"""Accelerations that a body may have without surprise; it holds a trajectory where ranges fail for a while."""

SLOW_M_S: Final = 3.0
"""Speeds that a body in a room may have without surprise."""

JERK_M_S3: Final = 8.0
"""By how much accelerations change in a second, before the data say it better."""

FAR_M: Final = 30.0
"""Places are within so much of where they are thought to be at first; it holds what nothing else does."""

BIAS_M_S2: Final = 0.4
"""What an accelerometer's bias may be."""

LEVEL_M: Final = 0.15
"""What a height sensor may be off by all along."""

STANDS_M: Final = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """Rows of one kind: columns (n, k) with values (n, k), columns of the border with values, aims (n,), and a std."""

    column: Ints
    value: Floats
    border: Ints
    border_value: Floats
    aim: Floats
    std: Floats
    kind: str = ""


@dataclass(frozen=True, slots=True)
class Linear:
    """Residuals (k,) over their standard errors, their derivatives (k, L) and (k, b), and their normal equations."""

    residual: Floats
    local: csr_array[Any]
    border: Floats
    normal: Normal


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownRows:
    """Rows `local @ x + border @ y - aim`, each over its standard error, and their normal equations.

    `kinds` (k,) says which are of an accelerometer ("force") and of a height sensor ("height"). Distances that were
    measured otherwise, `tapes` with standard errors `tape_std`, follow them, and are not linear.
    """

    local: csr_array[Any]
    border: Floats
    aim: Floats
    normal: Normal
    kinds: NDArray[np.str_]
    tapes: RangeRows
    tape_std: Floats

    def residuals(self, state: State) -> Floats:
        """Return the residuals (k,) over their standard errors."""
        return np.concatenate([self._plain(state), self.tapes.residuals(state) / self.tape_std])

    def of(self, kind: str, state: State) -> Floats:
        """Return the residuals of one kind over their standard errors."""
        return np.asarray(self._plain(state)[self.kinds == kind])

    def linear(self, state: State) -> Linear:
        """Return the rows as they are near a state."""
        from scipy.sparse import vstack

        plain = self._plain(state)
        if not len(self.tape_std):
            return Linear(plain, self.local, self.border, self.normal)
        residual, local, border = self.tapes.linear(state)
        weight = 1 / self.tape_std
        return Linear(
            np.concatenate([plain, residual * weight]),
            vstack([self.local, local.multiply(weight[:, None])], format="csr"),
            np.concatenate([self.border, border * weight[:, None]]),
            self.normal + normal_of(local, border, weight**2),
        )

    def _plain(self, state: State) -> Floats:
        return np.asarray(self.local @ state.local + self.border @ state.border - self.aim)


def known_rows(scene: Scene, columns: Columns, start: State, jerk_m_s3: float = JERK_M_S3) -> KnownRows:
    """Return what is known beside the ranges; `start` is where the bodies are thought to be."""
    from scipy.sparse import csr_array

    blocks = [block for block in _blocks(scene, columns, start, jerk_m_s3) if len(block.aim)]
    parts: list[tuple[Ints, Ints, Floats]] = []
    border, aims, begin = [], [], 0
    for block in blocks:
        count, rows = len(block.aim), np.arange(len(block.aim))
        scale = 1 / block.std
        width = block.column.shape[1]
        parts.append((np.repeat(begin + rows, width), block.column.ravel(), (block.value * scale[:, None]).ravel()))
        dense = np.zeros((count, columns.border))
        np.add.at(dense, (rows[:, None], block.border), block.border_value * scale[:, None])
        border.append(dense)
        aims.append(block.aim * scale)
        begin += count
    row, column, value = (np.concatenate([part[k] for part in parts]) for k in range(3))
    local = csr_array((value, (row, column)), shape=(begin, columns.size))
    dense = np.concatenate(border)
    return KnownRows(
        local=local,
        border=dense,
        aim=np.concatenate(aims),
        normal=normal_of(local, dense, np.ones(begin)),
        kinds=np.concatenate([np.full(len(block.aim), block.kind, dtype="U6") for block in blocks]),
        tapes=tape_rows(scene, columns),
        tape_std=scene.tapes.std_m,
    )


def _blocks(scene: Scene, columns: Columns, start: State, jerk_m_s3: float) -> Iterator[Block]:
    for body in range(len(scene.moving)):
        for axis in range(3):
            yield from _of_axis(scene, columns, start, body, axis)
            yield smoothness(columns, body, axis, jerk_m_s3)
        yield from _attitude(scene, columns, body)
        yield from _forces(scene, columns, body)
        yield from _height(scene, columns, body)
    for where in columns.stand:
        yield _of_border(where, start.border[where], STANDS_M)


def _of_axis(scene: Scene, columns: Columns, start: State, body: int, axis: int) -> Iterator[Block]:
    column = columns.place[:, body, axis]
    three = np.column_stack([column[:-2], column[1:-1], column[2:]])
    second = np.tile(np.array([1.0, -2.0, 1.0]) / columns.places.step_s**2, (len(three), 1))
    calm = CALM_M_S2 if body not in _sensed(scene) else 10 * CALM_M_S2
    yield _plain(three, second, np.zeros(len(three)), calm)
    two = np.column_stack([column[:-1], column[1:]])
    first = np.tile(np.array([-1.0, 1.0]) / columns.places.step_s, (len(two), 1))
    yield _plain(two, first, np.zeros(len(two)), SLOW_M_S)
    yield _plain(column[:, None], np.ones((len(column), 1)), start.local[column], FAR_M)
    mine = scene.places.body == body
    weights = cubic(columns.places, scene.places.time_s[mine])
    yield _plain(column[weights.point], weights.share, scene.places.position_m[mine, axis], scene.places.std_m[mine])


def smoothness(columns: Columns, body: int, axis: int, jerk_m_s3: float) -> Block:
    """Return what holds the jerk of a body along an axis: third differences of its control points."""
    column = columns.place[:, body, axis]
    four = np.column_stack([column[k : len(column) - 3 + k] for k in range(4)])
    third = np.tile(np.array([-1.0, 3.0, -3.0, 1.0]) / columns.places.step_s**3, (len(four), 1))
    return _plain(four, third, np.zeros(len(four)), jerk_m_s3)


def _attitude(scene: Scene, columns: Columns, body: int) -> Iterator[Block]:
    known = scene.attitudes.get(scene.moving[body])
    if known is None or known.exact:
        return
    for axis in range(3):
        column = columns.turn[:, body, axis]
        if np.isfinite(known.std_rad[axis]):
            yield _plain(column[:, None], np.ones((len(column), 1)), np.zeros(len(column)), known.std_rad[axis])
        step = known.wander_rad[axis] * np.sqrt(columns.turns.step_s)
        pair = np.column_stack([column[:-1], column[1:]])
        yield _plain(pair, np.tile([-1.0, 1.0], (len(pair), 1)), np.zeros(len(pair)), step)


def _forces(scene: Scene, columns: Columns, body: int) -> Iterator[Block]:
    """Mean accelerations are mean specific forces, turned, less the bias, and gravity: v2 - v1 = (R (f - b) + g) dt."""
    sensed = scene.inertial.get(scene.moving[body])
    if sensed is None or not len(sensed.begin_s):
        return
    late, early = (cubic_speed(columns.places, time) for time in (sensed.end_s, sensed.begin_s))
    middle = straight(columns.turns, (sensed.begin_s + sensed.end_s) / 2)
    lasts = (sensed.end_s - sensed.begin_s)[:, None]
    share = np.concatenate([late.share, -early.share], axis=1) / lasts
    points = np.concatenate([late.point, early.point], axis=1)
    for axis in range(3):
        column = [columns.place[points, body, axis]]
        value = [share]
        # A turn t of the attitude adds t x (R f) to the force.
        for other, arm in _crossed(axis, sensed.force_m_s2) if columns.turn[0, body, 0] >= 0 else ():
            column.append(columns.turn[middle.point, body, other])
            value.append(-arm[:, None] * middle.share)
        where = np.broadcast_to(columns.bias[body], (len(lasts), 3))
        aim = sensed.force_m_s2[:, axis] - GRAVITY_M_S2 * (axis == 2)
        yield Block(
            column=np.concatenate(column, axis=1),
            value=np.concatenate(value, axis=1),
            border=where,
            border_value=sensed.turn[:, axis, :],
            aim=aim,
            std=np.full(len(aim), sensed.std_m_s2),
            kind="force",
        )
    yield _of_border(columns.bias[body], np.zeros(3), BIAS_M_S2)


def _height(scene: Scene, columns: Columns, body: int) -> Iterator[Block]:
    mine = scene.heights[scene.heights.body == body]
    if not len(mine.time_s):
        return
    weights = cubic(columns.places, mine.time_s)
    where = np.full((len(mine.time_s), 1), columns.level[body])
    yield Block(
        column=columns.place[weights.point, body, 2],
        value=weights.share,
        border=where,
        border_value=np.ones(where.shape),
        aim=mine.height_m,
        std=mine.std_m,
        kind="height",
    )
    yield _of_border(columns.level[[body]], np.zeros(1), LEVEL_M)


def _crossed(axis: int, vector: Floats) -> list[tuple[int, Floats]]:
    """Return by which components of a turn t, times what, the component of t x v is made up."""
    following, last = (axis + 1) % 3, (axis + 2) % 3
    return [(following, vector[:, last]), (last, -vector[:, following])]


def _sensed(scene: Scene) -> set[int]:
    return {k for k, body in enumerate(scene.moving) if body in scene.inertial}


def _plain(column: Ints, value: Floats, aim: Floats, std: float | Floats) -> Block:
    nothing = np.zeros((len(aim), 0))
    return Block(
        column=column,
        value=value,
        border=nothing.astype(np.int64),
        border_value=nothing,
        aim=aim,
        std=np.broadcast_to(std, aim.shape),
    )


def _of_border(where: Ints, aim: Floats, std: float) -> Block:
    nothing = np.zeros((len(where), 0))
    return Block(
        column=nothing.astype(np.int64),
        value=nothing,
        border=where[:, None],
        border_value=np.ones((len(where), 1)),
        aim=aim,
        std=np.full(len(where), std),
    )
