"""Positions and attitudes of bodies as unknowns of a fit.

Positions are uniform cubic B-splines. Errors of attitudes are rotations about the world's axes, linear between points a
second apart. `Distances` gives distances between antennas and their derivatives, `known_rows` the rows of what is known
beside ranges.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from calib.estimator.rows import NormalRows, Terms, normal_terms
from calib.estimator.unknowns import Layout, Prior, Unknown
from calib.trajectories.scene import Ends, Scene, ends_of
from uwblink.arrays import Floats, Ints

POINT_S = 0.4
"""Time between control points of a path: a multirotor does not change its acceleration faster."""

TURN_S = 1.0
"""Time between points of the errors of attitudes."""

GRAVITY_M_S2 = 9.81


@dataclass(frozen=True, slots=True)
class Grid:
    """`count` control points, the first at `start_s`, the next every `step_s` seconds."""

    start_s: float
    step_s: float
    count: int

    @property
    def times_s(self) -> Floats:
        """Return the times (count,) at which control points have their greatest weight."""
        return np.asarray(self.start_s + self.step_s * np.arange(self.count), dtype=np.float64)

    def piece(self, time_s: Floats, low: int, high: int) -> tuple[Ints, Floats]:
        """Return the segment of each instant and the position inside it; the first and last segments are extended."""
        place = (time_s - self.start_s) / self.step_s
        first = np.clip(np.floor(place).astype(np.int64), low, self.count - high)
        return first, place - first

    def cubic(self, time_s: Floats, derivative: int = 0) -> tuple[Ints, Floats]:
        """Return the control points (n, 4) and weights (n, 4) of the cubic B-spline, or of its first derivative."""
        first, x = self.piece(time_s, 1, 3)
        if derivative:
            share = np.column_stack([-((1 - x) ** 2), 3 * x**2 - 4 * x, -3 * x**2 + 2 * x + 1, x**2]) / 2 / self.step_s
        else:
            share = np.column_stack([(1 - x) ** 3, 3 * x**3 - 6 * x**2 + 4, -3 * x**3 + 3 * x**2 + 3 * x + 1, x**3]) / 6
        return first[:, None] - 1 + np.arange(4), share

    def straight(self, time_s: Floats) -> tuple[Ints, Floats]:
        """Return the control points (n, 2) and weights (n, 2) of linear interpolation."""
        first, x = self.piece(time_s, 0, 2)
        return first[:, None] + np.arange(2), np.column_stack([1 - x, x])


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The layout of the unknowns of motion.

    Kinds are "path" (points, moving, 3), "turn" (points, turning, 3), "stand" (sought, 3), "bias" (sensed, 3) of
    accelerometers and "level" (levelled,) of height sensors. `turning`, `sensed` and `levelled` are numbers of moving
    bodies.
    """

    scene: Scene
    places: Grid
    turns: Grid
    turning: tuple[int, ...]
    sensed: tuple[int, ...]
    levelled: tuple[int, ...]

    @classmethod
    def of(cls, scene: Scene, point_s: float = POINT_S) -> Motion:
        """Return the motion of a scene with control points `point_s` seconds apart."""
        # At multiples of the interval, so that parts of a scene have the control points of the whole.
        begin = float(np.floor(scene.time_s[0] / TURN_S) * TURN_S)
        length = float(scene.time_s[-1]) - begin
        names = list(enumerate(scene.moving))
        return cls(
            scene=scene,
            places=Grid(begin - point_s, point_s, max(int(np.ceil(length / point_s)), 1) + 3),
            turns=Grid(begin, TURN_S, max(int(np.ceil(length / TURN_S)), 1) + 1),
            turning=tuple(k for k, body in names if body in scene.attitudes and not scene.attitudes[body].exact),
            sensed=tuple(k for k, body in names if body in scene.inertial),
            levelled=tuple(k for k, _ in names if k in scene.heights.body),
        )

    def unknowns(self, start: Mapping[str, Floats], jerk_m_s3: float) -> tuple[Unknown, ...]:
        """Return the blocks of unknowns at `start`, or at zero. The variance of jerk is estimated, starting at
        `jerk_m_s3`."""
        scene, count, moving = self.scene, self.places.count, len(self.scene.moving)
        third = sparse.diags([-1.0, 3.0, -3.0, 1.0], [0, 1, 2, 3], shape=(count - 3, count)) / self.places.step_s**3
        each = sparse.kron(third, sparse.eye(3 * moving), format="csc")
        smooth = Prior(
            weight=jerk_m_s3**-2,
            structure=sparse.csc_matrix(each.T @ each),
            rows=each.shape[0],
            bounds=(MOST_JERK**-2, LEAST_JERK**-2),
        )
        here = start.get("path", np.zeros(3 * moving * count)).ravel()
        calm = np.full(moving, CALM_M_S2)
        calm[list(self.sensed)] = CALM_SENSED_M_S2
        held = [(2, calm * self.places.step_s**2), (1, np.full(moving, SLOW_M_S * self.places.step_s))]
        path = tuple(_differences(count, order, np.repeat(std, 3)) for order, std in held)
        attitudes = [scene.attitudes[scene.moving[k]] for k in self.turning]
        # Unknown components have an infinite standard deviation: zero information.
        wander = np.ravel([attitude.wander_rad * np.sqrt(self.turns.step_s) for attitude in attitudes])
        turn = [(0, np.ravel([attitude.std_rad for attitude in attitudes])), (1, wander)]
        turns = tuple(_differences(self.turns.count, order, std) for order, std in turn)
        blocks = [
            ("path", (count, scene.moving, 3), (smooth, Prior.of_deviation(FAR_M, here), *path)),
            ("turn", (self.turns.count, [scene.moving[k] for k in self.turning], 3), turns),
            ("stand", (1, scene.sought, 3), (Prior.of_deviation(STANDS_M),)),
            ("bias", (1, [scene.moving[k] for k in self.sensed], 3), (Prior.of_deviation(BIAS_M_S2),)),
            ("level", (1, [scene.moving[k] for k in self.levelled], 1), (Prior.of_deviation(LEVEL_M),)),
        ]
        found = []
        for kind, (several, bodies, axes), priors in blocks:
            names = tuple(body for _ in range(several) for body in bodies for _ in range(axes))
            values = start.get(kind, np.zeros(len(names))).ravel()
            if names:
                found.append(Unknown(kind=kind, names=names, start=values, priors=priors))
        return tuple(found)

    def numbers(self, layout: Layout, kind: str) -> Ints:
        """Return the indices (points, bodies, axes) of a kind into all unknowns."""
        bodies = {"path": len(self.scene.moving), "turn": len(self.turning), "stand": len(self.scene.sought)}
        bodies |= {"bias": len(self.sensed), "level": len(self.levelled)}
        where = layout.where.get(kind, slice(0, 0))
        return np.arange(where.start, where.stop).reshape(-1, max(bodies[kind], 1), 1 if kind == "level" else 3)

    def state(self, layout: Layout, x: Floats) -> dict[str, Floats]:
        """Return the unknowns of motion by kind, in their shapes."""
        kinds = ("path", "turn", "stand", "bias", "level")
        return {kind: x[self.numbers(layout, kind)] for kind in kinds if kind in layout.where}

    def positions(self, path: Floats, time_s: Floats) -> Floats:
        """Return the positions (k, bodies, 3) of the moving bodies at instants (k,)."""
        point, share = self.places.cubic(time_s)
        return np.asarray(np.einsum("kp,kpba->kba", share, path.reshape(self.places.count, -1, 3)[point]))

    def refined(self, start: Mapping[str, Floats]) -> tuple[Motion, dict[str, Floats]]:
        """Return the same paths with twice as many control points (Lane and Riesenfeld 1980).

        A new point is the mean of two old ones, or 6/8 of one and 1/8 of both neighbours.
        """
        finer = Motion.of(self.scene, self.places.step_s / 2)
        points = start["path"].reshape(self.places.count, -1, 3)
        whole = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
        place = np.rint(2 * (finer.places.times_s - self.places.start_s) / self.places.step_s).astype(np.int64)
        near = np.clip(place // 2 + 1, 1, len(whole) - 2)
        onto = (whole[near - 1] + 6 * whole[near] + whole[near + 1]) / 8
        between = (whole[near] + whole[near + 1]) / 2
        return finer, dict(start) | {"path": np.where((place % 2 == 1)[:, None, None], between, onto)}


@dataclass(frozen=True, slots=True)
class Side:
    """One end of each distance: columns (n, k, 3) and weights (n, k) of the unknowns of its position and attitude."""

    ends: Ends
    place: Ints
    place_share: Floats
    turn: Ints
    turn_share: Floats
    stand: Ints


@dataclass(frozen=True)
class Distances:
    """Distances between antennas of bodies that move or stand, as functions of all unknowns (a `Geometry`)."""

    sides: tuple[Side, Side]
    columns: Ints

    @classmethod
    def of(cls, motion: Motion, layout: Layout, ids: tuple[Ints, Ints], time_s: Floats) -> Distances:
        """Return the distances of tags `ids` (n,) each at instants (n,)."""
        path, turn, stand = (motion.numbers(layout, kind) for kind in ("path", "turn", "stand"))
        (point, share), (bend, part) = motion.places.cubic(time_s), motion.turns.straight(time_s)
        turning = np.full(len(motion.scene.moving) + 1, -1)
        turning[list(motion.turning)] = np.arange(len(motion.turning))
        sides = []
        for some in ids:
            ends = ends_of(motion.scene, some, time_s)
            moves, turns, stands = ends.mover >= 0, turning[ends.mover] >= 0, ends.stander >= 0
            nowhere = np.full((1, 1, 1), -1)
            sides.append(
                Side(
                    ends,
                    np.where(moves[:, None, None], path[point, ends.mover[:, None]], nowhere),
                    np.where(moves[:, None], share, 0.0),
                    np.where(turns[:, None, None], turn[bend, turning[ends.mover][:, None]], nowhere)
                    if turn.size
                    else np.zeros((len(some), 0, 3), dtype=np.int64),
                    np.where(turns[:, None], part, 0.0) if turn.size else np.zeros((len(some), 0)),
                    np.where(stands[:, None], stand[0, ends.stander], -1)
                    if stand.size
                    else np.zeros((len(some), 0), dtype=np.int64),
                )
            )
        count = len(time_s)
        columns = np.concatenate(
            [part.reshape(count, -1) for side in sides for part in (side.place, side.turn, side.stand)], axis=1
        )
        # Where an end does not depend on an unknown, its entry is zero in a column that the other end uses.
        # Between anchors at given positions no entry is used, and any column is valid.
        return cls((sides[0], sides[1]), np.maximum(np.where(columns < 0, columns.max(axis=1)[:, None], columns), 0))

    def antennas(self, x: Floats, rows: Ints | slice = slice(None)) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the antennas of both ends (n, 3), and their lever arms in the world's axes (n, 3)."""
        found = []
        for side in self.sides:
            place = np.einsum("nk,nka->na", side.place_share[rows], x[side.place[rows]])
            arm = side.ends.arm_m[rows]
            if side.turn.shape[1]:
                arm = Rotation.from_rotvec(np.einsum("nk,nka->na", side.turn_share[rows], x[side.turn[rows]])).apply(
                    arm
                )
            stand = np.zeros_like(place)
            if side.stand.shape[1]:
                stand = np.where(side.ends.stander[rows, None] >= 0, x[side.stand[rows]], 0.0)
            found += [side.ends.base_m[rows] + stand + place + arm, arm]
        return found[0], found[2], found[1], found[3]

    def distances(self, x: Floats, rows: Ints | slice = slice(None)) -> tuple[Floats, Floats]:
        """Return the distances (m,) of some ranges in metres, and their derivatives (m, k) by the unknowns (p,)."""
        first, second, *arms = self.antennas(x, rows)
        away = second - first
        distance = np.linalg.norm(away, axis=1)
        towards = away / np.maximum(distance, 1e-6)[:, None]
        parts = []
        for side, arm, sign in zip(self.sides, arms, (-1.0, 1.0), strict=True):
            pull = sign * towards
            # By a turn t the arm a moves by t x a, and u (t x a) = t (a x u).
            parts.append(side.place_share[rows][:, :, None] * pull[:, None, :])
            parts.append(side.turn_share[rows][:, :, None] * np.cross(arm, pull)[:, None, :])
            if side.stand.shape[1]:
                parts.append(np.where(side.ends.stander[rows, None] >= 0, pull, 0.0))
        return distance, np.concatenate([part.reshape(len(away), -1) for part in parts], axis=1)


@dataclass(frozen=True)
class TapeRows:
    """Rows of distances by tape."""

    geometry: Distances
    measured_m: Floats
    std_m: Floats

    def residuals(self, x: Floats) -> Floats:
        """Return taped less estimated distances (n,)."""
        return self.measured_m - self.geometry.distances(x)[0]

    def terms(self, x: Floats) -> Iterator[Terms]:
        """Yield all rows."""
        distance, moved = self.geometry.distances(x)
        yield normal_terms(self.measured_m - distance, self.std_m, moved.T, self.geometry.columns)


LEAST_JERK, MOST_JERK = 0.2, 2000.0
"""Bounds of jerk, m/s^3."""

FAR_M = 30.0
"""Prior standard deviation of a control point around its initial guess: it holds points without any range."""

STANDS_M = 100.0
BIAS_M_S2 = 0.4
"""Prior standard deviation of an accelerometer's bias."""

LEVEL_M = 0.15
"""Prior standard deviation of the constant offset of a height sensor."""

CALM_M_S2, CALM_SENSED_M_S2 = 5.0, 50.0
"""Prior standard deviation of accelerations, which holds a path where ranges are missing; the second where an
accelerometer measures them."""

SLOW_M_S = 3.0
"""Prior standard deviation of speeds in a room."""


def known_rows(motion: Motion, layout: Layout) -> dict[str, NormalRows | TapeRows]:
    """Return the rows of positions, forces, heights and tapes, by kind."""
    scene, path = motion.scene, motion.numbers(layout, "path")
    found: dict[str, NormalRows | TapeRows] = {}
    known = scene.places
    if len(known.time_s):
        point, share = motion.places.cubic(known.time_s)
        columns = np.moveaxis(path[point, known.body[:, None]], 1, 2)
        found["place"] = _rows(columns, share[:, None, :], known.position_m, known.std_m[:, None])
    if motion.sensed:
        found["force"] = _forces(motion, layout)
    if motion.levelled:
        read, level = scene.heights, motion.numbers(layout, "level")[0, :, 0]
        point, share = motion.places.cubic(read.time_s)
        own = level[np.searchsorted(motion.levelled, read.body)]
        found["height"] = NormalRows(
            value=read.height_m,
            std=read.std_m,
            entries=np.column_stack([share, np.ones(len(own))]),
            columns=np.column_stack([path[point, read.body[:, None], 2], own]),
        )
    tapes = scene.tapes
    if len(tapes):
        # Distances that always hold are between standing bodies: any instant is valid.
        time = np.where(np.isnan(tapes.time_s), scene.time_s[0], tapes.time_s)
        geometry = Distances.of(motion, layout, (tapes.first, tapes.second), time)
        found["tape"] = TapeRows(geometry, tapes.distance_m, tapes.std_m)
    return found


def _differences(count: int, order: int, std: Floats) -> Prior:
    """Return the prior of independent differences between `count` points of several columns, of deviation `std`
    (columns,)."""
    step = sparse.csr_matrix(sparse.eye(count))
    for _ in range(order):
        step = step[1:] - step[:-1]
    each = sparse.kron(step, sparse.diags(1 / std), format="csr")
    return Prior(weight=1.0, structure=sparse.csc_matrix(each.T @ each), rows=each.shape[0])


def _rows(columns: Ints, entries: Floats, value: Floats | float, std: Floats | float) -> NormalRows:
    """Return a row for each element of columns (..., K) but the last axis; entries, value and std are broadcast."""
    shape = columns.shape[:-1]
    return NormalRows(
        value=np.broadcast_to(value, shape).ravel(),
        std=np.broadcast_to(std, shape).ravel(),
        entries=np.broadcast_to(entries, columns.shape).reshape(-1, columns.shape[-1]),
        columns=columns.reshape(-1, columns.shape[-1]),
    )


def _forces(motion: Motion, layout: Layout) -> NormalRows:
    """Return rows of mean accelerations: (v2 - v1) / dt = R (f - b) + g with bias b and rotation R."""
    path, turn, bias = (motion.numbers(layout, kind) for kind in ("path", "turn", "bias"))
    parts = []
    for own, body in enumerate(motion.sensed):
        sensed = motion.scene.inertial[motion.scene.moving[body]]
        lasts = (sensed.end_s - sensed.begin_s)[:, None]
        (late, end), (early, begin) = (motion.places.cubic(t, 1) for t in (sensed.end_s, sensed.begin_s))
        middle, part = motion.turns.straight((sensed.begin_s + sensed.end_s) / 2)
        for axis in range(3):
            following, last = (axis + 1) % 3, (axis + 2) % 3
            columns = [path[late, body, axis], path[early, body, axis], np.tile(bias[0, own], (len(lasts), 1))]
            entries = [end / lasts, -begin / lasts, sensed.turn[:, axis, :]]
            if body in motion.turning:
                # A turn t of the attitude adds t x (R f) to the force.
                k = motion.turning.index(body)
                columns += [turn[middle, k, following], turn[middle, k, last]]
                force = sensed.force_m_s2
                entries += [-force[:, [last]] * part, force[:, [following]] * part]
            else:
                # As many columns as other bodies have.
                columns += [path[late, body, axis]]
                entries += [np.zeros(late.shape)]
            aim = sensed.force_m_s2[:, axis] - GRAVITY_M_S2 * (axis == 2)
            std = np.full(len(aim), sensed.std_m_s2)
            parts.append((aim, std, np.concatenate(entries, axis=1), np.concatenate(columns, axis=1)))
    whole = [np.concatenate([part[k] for part in parts]) for k in range(4)]
    return NormalRows(value=whole[0], std=whole[1], entries=whole[2], columns=whole[3])
