"""Positions and attitudes of bodies as unknowns of a fit.

Positions are uniform cubic B-splines. Errors of attitudes are rotations about the world's axes, linear between points a
second apart. `Distances` computes distances between antennas and their derivatives, `known_rows` the rows of all other
measurements.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from calib.estimator.rows import Movements, NormalRows, Terms, normal_terms
from calib.estimator.unknowns import Layout, Prior, Unknown
from calib.evaluation.filters import GRAVITY_M_S2
from calib.trajectories.samples import POINT_S, SAMPLE_S
from calib.trajectories.scene import Scene
from uwblink.arrays import Floats, Ints

TURN_S = 1.0
"""Time between points of the errors of attitudes. Half or twice of it moves delays by 0.03 standard errors
(`python -m benchmarks.constants`)."""

MOTION = {"path": 3, "turn": 3, "stand": 3, "bias": 3, "level": 1}
"""Kinds of unknowns of motion, and the number of axes of each."""


@dataclass(frozen=True, slots=True)
class Grid:
    """`count` control points of uniform B-splines, the first at `start_s`, the next every `step_s` seconds."""

    start_s: float
    step_s: float
    count: int

    @property
    def times_s(self) -> Floats:
        """Return the times (count,) at which control points have their greatest weight."""
        return np.asarray(self.start_s + self.step_s * np.arange(self.count), dtype=np.float64)

    def splines(self, time_s: Floats, degree: int = 3) -> tuple[Ints, Floats]:
        """Return the control points (n, degree + 1) and weights (n, degree + 1) at instants (n,).

        The first and last segments are extended.
        """
        knots = self.start_s + self.step_s * (np.arange(self.count + degree + 1) - (degree + 1) / 2)
        found = BSpline.design_matrix(time_s, knots, degree, extrapolate=True)
        shape = (len(time_s), degree + 1)
        return found.indices.reshape(shape).astype(np.int64), found.data.reshape(shape)

    def velocities(self, time_s: Floats) -> tuple[Ints, Floats]:
        """Return the control points (n, 4) and weights (n, 4) of the derivative of cubic B-splines."""
        # The derivative is a quadratic B-spline, whose points are differences of control points divided by the step.
        first, share = Grid(self.start_s + self.step_s / 2, self.step_s, self.count - 1).splines(time_s, 2)
        return first[:, :1] + np.arange(4), -np.diff(np.pad(share, ((0, 0), (1, 1)))) / self.step_s


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The layout of the unknowns of motion.

    Kinds are "path" (points, moving, 3), "turn" (points, turning, 3), "stand" (1, sought, 3), "bias" (1, sensed, 3) of
    accelerometers and "level" (1, levelled, 1) of height sensors; `bodies` names the bodies of each.
    """

    scene: Scene
    places: Grid
    turns: Grid
    bodies: Mapping[str, Sequence[str]]

    @classmethod
    def of(cls, scene: Scene, point_s: float = POINT_S) -> Motion:
        """Return the motion of a scene with control points `point_s` seconds apart."""
        # At multiples of the interval, so that parts of a scene have the same control points as the whole.
        begin = float(np.floor(scene.time_s[0] / TURN_S) * TURN_S)
        length = float(scene.time_s[-1]) - begin
        return cls(
            scene=scene,
            places=Grid(begin - point_s, point_s, max(int(np.ceil(length / point_s)), 1) + 3),
            turns=Grid(begin, TURN_S, max(int(np.ceil(length / TURN_S)), 1) + 1),
            bodies={
                "path": scene.moving,
                "turn": [body for body, one in scene.attitudes.items() if one.std_rad.any() or one.wander_rad.any()],
                "stand": scene.sought,
                "bias": list(scene.inertial),
                "level": [scene.moving[k] for k in np.unique(scene.heights.body)],
            },
        )

    def unknowns(self, start: Mapping[str, Floats], jerk_m_s3: float) -> tuple[Unknown, ...]:
        """Return the blocks of unknowns at `start`, or at zero. The variance of jerk is estimated, starting at
        `jerk_m_s3`."""
        scene, count, step_s = self.scene, self.places.count, self.places.step_s
        calm = np.array([CALM_SENSED_M_S2 if body in scene.inertial else CALM_M_S2 for body in scene.moving])
        jerk = _differences(count, 3, np.full(3 * len(scene.moving), step_s**3))
        attitudes = [scene.attitudes[body] for body in self.bodies["turn"]]
        # Unknown components have an infinite standard deviation: zero information.
        std = np.ravel([attitude.std_rad for attitude in attitudes])
        wander = np.ravel([attitude.wander_rad * np.sqrt(TURN_S) for attitude in attitudes])
        blocks = {
            "path": (
                count,
                [
                    replace(jerk, weight=jerk_m_s3**-2, bounds=(MOST_JERK**-2, LEAST_JERK**-2)),
                    Prior.of_deviation(FAR_M, start["path"].ravel() if "path" in start else 0.0),
                    _differences(count, 2, np.repeat(calm * step_s**2, 3)),
                    _differences(count, 1, np.full(3 * len(scene.moving), SLOW_M_S * step_s)),
                ],
            ),
            "turn": (
                self.turns.count,
                [_differences(self.turns.count, k, one) for k, one in enumerate((std, wander))],
            ),
            # larger than any hall
            "stand": (1, [Prior.of_deviation(100.0)]),
            # 40 mg, the order of magnitude in data sheets of MEMS sensors
            "bias": (1, [Prior.of_deviation(0.4)]),
            # the constant offset of a height sensor, chosen on the MILUV flight (docs/theory.md)
            "level": (1, [Prior.of_deviation(0.15)]),
        }
        names = {
            kind: tuple(np.repeat(self.bodies[kind], MOTION[kind]).tolist()) * points
            for kind, (points, _) in blocks.items()
        }
        return tuple(
            Unknown(
                kind=kind,
                names=own,
                start=np.ravel(start.get(kind, np.zeros(len(own)))),
                priors=tuple(blocks[kind][1]),
            )
            for kind, own in names.items()
            if own
        )

    def numbers(self, layout: Layout, kind: str) -> Ints:
        """Return the indices (points, bodies, axes) of a kind into all unknowns."""
        return layout.indices([kind]).reshape(-1, max(len(self.bodies[kind]), 1), MOTION[kind])

    def state(self, layout: Layout, x: Floats) -> dict[str, Floats]:
        """Return the unknowns of motion by kind, in their shapes."""
        return {kind: x[self.numbers(layout, kind)] for kind in MOTION if kind in layout.where}

    def positions(self, path: Floats, time_s: Floats) -> Floats:
        """Return the positions (k, bodies, 3) of the moving bodies at instants (k,)."""
        point, share = self.places.splines(time_s)
        return np.asarray(np.einsum("kp,kpba->kba", share, path.reshape(self.places.count, -1, 3)[point]))

    def refined(self, start: Mapping[str, Floats]) -> tuple[Motion, dict[str, Floats]]:
        """Return the same paths with twice as many control points (Lane and Riesenfeld 1980).

        A new point is the mean of two old ones, or 6/8 of one and 1/8 of both neighbours.
        """
        finer = Motion.of(self.scene, self.places.step_s / 2)
        points = start["path"].reshape(self.places.count, -1, 3)
        found = np.empty((2 * len(points) - 3, *points.shape[1:]))
        found[::2] = (points[:-1] + points[1:]) / 2
        found[1::2] = (points[:-2] + 6 * points[1:-1] + points[2:]) / 8
        return finer, {**start, "path": found[: finer.places.count]}


@dataclass(frozen=True, slots=True)
class RangeEnd:
    """One end of each distance (n,): the position of its antenna as a function of the unknowns.

    `mover` is the number of the moving body, -1 for other bodies. For a moving body, `place` (n, 4, 3) are the control
    points of its path with weights `place_share` (n, 4), and `arm_m` (n, 3) is the lever arm by the given attitude,
    whose errors are `turn` (n, 2, 3) with weights `turn_share` (n, 2). For a standing body, `base_m` (n, 3) is the
    antenna's position, or its offset from the sought position, which is the only entry of `place`. -1 means no unknown.
    """

    mover: Ints
    base_m: Floats
    arm_m: Floats
    place: Ints
    place_share: Floats
    turn: Ints
    turn_share: Floats

    @classmethod
    def of(cls, motion: Motion, layout: Layout, ids: Ints, time_s: Floats) -> RangeEnd:
        """Return the ends of tags `ids` (n,) at instants (n,)."""
        scene, turning, count = motion.scene, motion.bodies["turn"], len(ids)
        path, turn, stand = (motion.numbers(layout, kind) for kind in ("path", "turn", "stand"))
        (point, share), (bend, part) = motion.places.splines(time_s), motion.turns.splines(time_s, 1)
        found = cls(
            mover=np.full(count, -1),
            base_m=np.zeros((count, 3)),
            arm_m=np.zeros((count, 3)),
            place=np.full((count, 4, 3), -1),
            place_share=np.zeros((count, 4)),
            turn=np.full((count, 2 if turning else 0, 3), -1),
            turn_share=np.zeros((count, 2 if turning else 0)),
        )
        for tag, (body, arm) in scene.arms.items():
            rows = np.flatnonzero(ids == tag)
            if body in scene.moving:
                number = scene.moving.index(body)
                found.mover[rows] = number
                found.place[rows], found.place_share[rows] = path[point[rows], number], share[rows]
                if body in scene.attitudes:
                    found.arm_m[rows] = scene.attitudes[body].at(time_s[rows]).apply(arm)
                if body in turning:
                    found.turn[rows] = turn[bend[rows], turning.index(body)]
                    found.turn_share[rows] = part[rows]
            else:
                place = scene.still[body]
                found.base_m[rows] = arm if place is None else place + arm
                if place is None:
                    found.place[rows, 0], found.place_share[rows, 0] = stand[0, scene.sought.index(body)], 1.0
        return found


@dataclass(frozen=True)
class Distances:
    """Distances between antennas of moving or standing bodies, as functions of all unknowns (a `Geometry`)."""

    sides: tuple[RangeEnd, RangeEnd]
    columns: Ints
    axes: Ints

    @classmethod
    def of(cls, motion: Motion, layout: Layout, ids: tuple[Ints, Ints], time_s: Floats) -> Distances:
        """Return the distances of tags `ids` (n,) each at instants (n,)."""
        first, second = (RangeEnd.of(motion, layout, some, time_s) for some in ids)
        blocks = [part.reshape(len(time_s), -1) for side in (first, second) for part in (side.place, side.turn)]
        columns = np.concatenate(blocks, axis=1)
        axes = np.swapaxes(np.concatenate([first.place, second.place], axis=1), 1, 2)
        return cls((first, second), _used(columns), _used(axes))

    @classmethod
    def of_ranges(cls, motion: Motion, layout: Layout) -> Distances:
        """Return the distances of the ranges of a motion's scene."""
        scene = motion.scene
        return cls.of(motion, layout, (scene.ranges.initiator, scene.ranges.target), scene.time_s)

    def movements(self, rows: Ints, derivative: Floats, bend: Floats) -> Movements:
        """Return what some ranges depend on (`Geometry`)."""
        first, second = (side.place_share[rows] for side in self.sides)
        return Movements(
            columns=self.columns[rows],
            derivative=-derivative,
            axes=self.axes[rows],
            shares=np.concatenate([-first, second], axis=1),
            bend=bend,
        )

    def antennas(self, x: Floats, rows: Ints | slice = slice(None)) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the antennas of both ends (n, 3), and their lever arms in the world's axes (n, 3)."""
        found = []
        for side in self.sides:
            place = np.einsum("nk,nka->na", side.place_share[rows], x[side.place[rows]])
            turn = np.einsum("nk,nka->na", side.turn_share[rows], x[side.turn[rows]])
            arm = Rotation.from_rotvec(turn).apply(side.arm_m[rows])
            found += [side.base_m[rows] + place + arm, arm]
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
            # A rotation t moves the arm a by t x a, and u (t x a) = t (a x u).
            parts.append(side.place_share[rows][:, :, None] * pull[:, None, :])
            parts.append(side.turn_share[rows][:, :, None] * np.cross(arm, pull)[:, None, :])
        return distance, np.concatenate([part.reshape(len(away), -1) for part in parts], axis=1)

    def derivatives(self, x: Floats, rows: Ints) -> Floats:
        """Return the derivatives (m, p) of some distances by all unknowns (p,)."""
        found = np.zeros((len(rows), len(x)))
        np.add.at(found, (np.arange(len(rows))[:, None], self.columns[rows]), self.distances(x, rows)[1])
        return found


def _used(columns: Ints) -> Ints:
    """Return columns (n, ..., k) in which -1, no unknown, is replaced by another one of the same row.

    Its entry is zero. Between anchors at given positions no entry is used, and any column is valid.
    """
    return np.maximum(np.where(columns < 0, columns.max(axis=-1, keepdims=True), columns), 0)


@dataclass(frozen=True)
class TapeRows:
    """Rows of distances by tape."""

    geometry: Distances
    measured_m: Floats
    std_m: Floats

    def left(self, x: Floats) -> Floats:
        """Return taped minus estimated distances (n,)."""
        return self.measured_m - self.geometry.distances(x)[0]

    def terms(self, x: Floats) -> Iterator[Terms]:
        """Yield all rows."""
        distance, moved = self.geometry.distances(x)
        yield normal_terms(self.measured_m - distance, self.std_m, moved.T, self.geometry.columns)


LEAST_JERK, MOST_JERK = 0.2, 2000.0
"""Bounds of jerk, m/s^3."""

FAR_M = 30.0
"""Prior standard deviation of a control point around its initial guess: it determines points without any range. Half or
twice of it moves delays by 0.05 standard errors (`python -m benchmarks.constants`)."""


CALM_M_S2, CALM_SENSED_M_S2 = 5.0, 50.0
"""Prior standard deviation of accelerations, which determines a path where ranges are missing; the second is for bodies
with an accelerometer. Half or twice of the first moves delays by 0.03 standard errors (`python -m
benchmarks.constants`)."""

SLOW_M_S = 3.0
"""Prior standard deviation of speeds in a room. Half or twice of it moves delays by 0.14 standard errors
(`python -m benchmarks.constants`)."""


def known_rows(motion: Motion, layout: Layout) -> dict[str, NormalRows | TapeRows]:
    """Return the rows of positions ("place"), heights, tapes ("tape"), and forces of each body, by kind."""
    scene, path = motion.scene, motion.numbers(layout, "path")
    found: dict[str, NormalRows | TapeRows] = {}
    if len(known := scene.places):
        point, share = motion.places.splines(known.time_s)
        found["place"] = NormalRows(
            value=known.position_m.ravel(),
            std=np.repeat(known.std_m, 3),
            entries=np.repeat(share, 3, axis=0),
            columns=np.swapaxes(path[point, known.body[:, None]], 1, 2).reshape(-1, 4),
        )
    for body, sensed in scene.inertial.items():
        if len(sensed):
            found[f"force {body}"] = _forces(motion, layout, body)
    if len(read := scene.heights):
        point, share = motion.places.splines(read.time_s)
        own = motion.numbers(layout, "level")[0, np.unique(read.body, return_inverse=True)[1], 0]
        found["height"] = NormalRows(
            value=read.height_m,
            std=read.std_m,
            entries=np.column_stack([share, np.ones(len(own))]),
            columns=np.column_stack([path[point, read.body[:, None], 2], own]),
        )
    if len(tapes := scene.tapes):
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


def _forces(motion: Motion, layout: Layout, body: str) -> NormalRows:
    """Return rows of mean accelerations (n x 3 axes): (v2 - v1) / dt = R (f - b) + g with bias b and rotation R."""
    sensed, turning = motion.scene.inertial[body], motion.bodies["turn"]
    path = motion.numbers(layout, "path")[:, motion.scene.moving.index(body)]
    bias = motion.numbers(layout, "bias")[0, motion.bodies["bias"].index(body)]
    count, force = len(sensed), sensed.force_m_s2
    early, begin = motion.places.velocities(sensed.time_s - SAMPLE_S / 2)
    late, end = motion.places.velocities(sensed.time_s + SAMPLE_S / 2)
    # Columns and entries are (n, unknowns, axes).
    columns = [path[late], path[early], np.broadcast_to(bias[:, None], (count, 3, 3))]
    weights = [share[:, :, None] * np.full(3, 1 / SAMPLE_S) for share in (end, -begin)]
    entries = [*weights, np.swapaxes(sensed.turn, 1, 2)]
    if body in turning:
        # A rotation t of the attitude adds t x (R f) to the force: its component on an axis depends on t about the
        # other two.
        middle, part = motion.turns.splines(sensed.time_s, 1)
        turn = motion.numbers(layout, "turn")[middle, turning.index(body)]
        following, last = [1, 2, 0], [2, 0, 1]
        columns += [turn[:, :, following], turn[:, :, last]]
        entries += [-force[:, None, last] * part[:, :, None], force[:, None, following] * part[:, :, None]]
    by_axis = [np.swapaxes(np.concatenate(some, axis=1), 1, 2).reshape(3 * count, -1) for some in (columns, entries)]
    return NormalRows(
        value=(force - (0, 0, GRAVITY_M_S2)).ravel(),
        std=np.full(3 * count, sensed.std_m_s2),
        columns=by_axis[0],
        entries=by_axis[1],
    )
