"""The search: the likeliest delays, curve, errors and trajectories together, from where trajectories are thought to be.

Ranges first have Cauchy's likelihood, which descends from anywhere, then that of `calib.range_errors`. How much jerk
paths have is estimated along, and so is how far accelerometers and height sensors are to be trusted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from calib.estimator.inverse import Matrix, SparseInverse
from calib.estimator.optimize import Optimum, maximize
from calib.estimator.range_model import RangeModel
from calib.estimator.range_rows import RESIDUAL, Errors, Mixture, Part, RangeRows
from calib.estimator.rows import NormalRows, Rows, sum_rows
from calib.estimator.unknowns import Layout, Priors, Unknown
from calib.spread import robust_spread
from calib.trajectories.motion import Distances, Motion, TapeRows, known_rows
from calib.trajectories.scene import Scene
from uwblink.arrays import Floats, Ints

State = Mapping[str, Floats]
"""Unknowns of motion by their kind."""

MOTION = ("path", "turn", "stand", "bias", "level")
"""The kinds of unknowns that distances are made of, and what is known beside them."""

JERK_M_S3, QUICK_M_S3 = 8.0, 100.0
"""By how much accelerations change in a second, before the data say it better, and where control points are closer."""

FIRST_SCALE_M, LEAST_SCALE_M = 0.15, 0.01
"""Scale of the first loss, while neither delays nor curve are known, and the least one."""

ROUNDS = 3
"""Rounds in which the scale of a loss, or the share of ranges that paths use up, is found again."""

MOST_USED = 0.8
FEWEST_A_PAIR = 15
"""Of fewer ranges a pair on average nobody can tell what their errors are made of: they keep Cauchy's likelihood."""

FINEST_S = 0.11
"""Control points are not put twice as densely again below this."""

TRUSTED = 3.0
"""How much less than its residuals say a sensor is trusted: what it is off by lasts for some windows."""

FORCES_M_S2 = (0.02, 5.0)
"""Bounds of what a mean specific force is off by."""


@dataclass(frozen=True, slots=True)
class Cauchy:
    """Cauchy's likelihood of residuals, with a curvature that descends from anywhere (`Errors`).

    With `expected` each tells what all do on average, as near the top.
    """

    scale_m: float
    expected: bool = False
    parameters: tuple[str, ...] = ()

    def slopes(self, values: dict[str, Floats]) -> tuple[Floats, dict[str, Floats], Floats | None]:
        """Return log densities (n,), slopes by the residual (n,) and what each tells (n,)."""
        u = values[RESIDUAL] / self.scale_m
        weight = 2 / self.scale_m**2 / (1 + u**2)
        curvature = weight * (1 - u**2) / (1 + u**2)
        # Where the loss bends upwards there is none: a fifth of the weight, as of reweighted least squares.
        tells = np.maximum(curvature, 0.2 * weight)
        if self.expected:
            tells = np.full(len(u), max(float(np.mean(curvature)), 0.2 * float(np.mean(weight))))
        return -np.log1p(u**2), {RESIDUAL: -weight * values[RESIDUAL]}, tells


@dataclass(frozen=True, kw_only=True)
class Settled:
    """Motion that fits the raw ranges of a scene: its unknowns, the residuals of the ranges (n,), its likelihood."""

    motion: Motion
    state: State
    residuals: Floats
    value: float

    def positions(self, time_s: Floats) -> Floats:
        """Return where the moving bodies are at instants (k,), shape (k, bodies, 3)."""
        return self.motion.positions(self.state["path"], time_s)


def settle(
    scene: Scene,
    start: State,
    scales_m: tuple[float, ...],
    jerk_m_s3: float,
    *,
    steps: int = 25,
    tolerance: float = 1.0,
) -> Settled:
    """Return the motion that fits raw ranges best near a start, by Cauchy's likelihood of one scale after the other."""
    motion = Motion.of(scene)
    layout = Layout(motion.unknowns(start, jerk_m_s3))
    ends = scene.ranges.initiator, scene.ranges.target
    geometry = Distances.of(motion, layout, ends, scene.time_s)
    key = np.zeros(len(scene.time_s), dtype=np.int64)
    rows = RangeRows.of(scene.ranges.raw_m, key, [], Cauchy(scales_m[0]), layout, geometry)
    known, priors, x, value = list(known_rows(motion, layout).values()), Priors(layout), layout.start(), 0.0
    for scale in scales_m:
        these: list[Rows] = [replace(rows, errors=Cauchy(scale)), *known]
        found = maximize(these, priors, x, steps=steps, tolerance=tolerance, evidence_steps=0)
        x, value = found.x, found.value
    return Settled(motion=motion, state=motion.state(layout, x), residuals=rows.residuals(x), value=value)


@dataclass(frozen=True, kw_only=True)
class Found:
    """The top: all unknowns, and what is needed to judge them.

    `used` is the share of the ranges that paths and attitudes use up, `coarse` how much of motion they leave out.
    """

    scene: Scene
    motion: Motion
    rows: RangeRows
    gauge: tuple[NormalRows, ...]
    known: Mapping[str, NormalRows | TapeRows]
    optimum: Optimum
    geometry: Distances
    used: float
    coarse: Coarseness
    jerk_m_s3: float
    steps: int
    success: bool


def search(scene: Scene, model: RangeModel, error_m: Floats, start: State, done: Callable[[float], None]) -> Found:
    """Return the likeliest unknowns; `error_m` (n,) are the ranges of the scene, less a curve that is known."""
    state = _Search(scene, model, error_m, start, done)
    state.robustly()
    while state.coarse().shows and state.motion.places.step_s > FINEST_S:
        state.refine()
        state.robustly()
    return state.likeliest()


class _Search:
    """A search under way: each method changes one part of it."""

    def __init__(
        self, scene: Scene, model: RangeModel, error_m: Floats, start: State, done: Callable[[float], None]
    ) -> None:
        self.model, self.error_m, self.done = model, error_m, done
        self.motion, self.origin, self.used, self.steps = Motion.of(scene), start, 0.0, 0
        self.weights: dict[tuple[str, int], float] = {}
        self.values: dict[str, Floats] = dict(start)
        self.build(Cauchy(FIRST_SCALE_M))

    def build(
        self, errors: Errors, more: tuple[tuple[Unknown, ...], tuple[Part, ...]] = ((), ()), jerk: float = JERK_M_S3
    ) -> None:
        """Lay all unknowns out anew, with what is known of them by now."""
        model, ranges = self.model, self.model.ranges
        self.errors, self.more = errors, more
        self.layout = Layout((*model.unknowns, *self.motion.unknowns(self.origin, jerk), *more[0]))
        self.priors = Priors(self.layout)
        self.geometry = Distances.of(
            self.motion, self.layout, (ranges.initiator, ranges.target), self.motion.scene.time_s
        )
        parts = [*model.parts, *more[1]]
        self.rows = RangeRows.of(self.error_m, model.key(), parts, errors, self.layout, self.geometry)
        self.known = known_rows(self.motion, self.layout)
        self.gauge = tuple(model.gauge_rows(self.layout))
        self.x = self.layout.start()
        for kind, where in self.layout.where.items():
            if kind in self.values:
                self.x[where] = self.values[kind].ravel()
        self.priors.weights = [
            self.weights.get(key, w) for key, w in zip(self._keys(), self.priors.weights, strict=True)
        ]

    def _keys(self) -> list[tuple[str, int]]:
        """Return kind and number of each prior."""
        return [(block.kind, k) for block in self.layout.blocks for k in range(len(block.priors))]

    def climb(self, *, evidence_steps: int = 12, tolerance: float = 0.1) -> Optimum:
        """Go to the top, and see what paths use up of the ranges there."""
        rows: list[Rows] = [replace(self.rows, errors=self.errors), *self.known.values(), *self.gauge]
        asked = self.layout.indices(["delay", *self.model.curve_kinds()])
        found = maximize(
            rows, self.priors, self.x, steps=60, evidence_steps=evidence_steps, tolerance=tolerance, asked=asked
        )
        self.x, self.steps = found.x, self.steps + found.steps
        self.rows = replace(self.rows, errors=self.errors)
        self.values = {kind: found.x[where] for kind, where in self.layout.where.items()}
        self.weights = dict(zip(self._keys(), self.priors.weights, strict=True))
        own = self.layout.indices(MOTION)
        information = sum_rows([self.rows], found.x).information
        self.used = min(_trace(found, information, own) / len(self.rows), MOST_USED)
        self.done(1 - 0.97**self.steps)
        return found

    def robustly(self) -> None:
        """Go to the top of Cauchy's likelihood, as wide as the data ask for."""
        scale = FIRST_SCALE_M
        for turn in range(ROUNDS):
            self.errors = Cauchy(scale)
            self.climb(evidence_steps=12 if turn else 0)
            scale = max(robust_spread(self.residuals()), LEAST_SCALE_M)
        self.trust()

    def residuals(self) -> Floats:
        """Return the residuals of the ranges (n,), of which paths have taken a part."""
        return np.asarray(self.rows.residuals(self.x) / np.sqrt(1 - self.used))

    def trust(self) -> None:
        """Trust accelerometers and height sensors as far as their residuals say."""
        scene, known = self.motion.scene, self.known
        if isinstance(force := known.get("force"), NormalRows):
            factor = TRUSTED * robust_spread(force.left(self.x) / force.std, 0.0)
            scene = replace(
                scene,
                inertial={
                    body: replace(some, std_m_s2=float(np.clip(some.std_m_s2 * factor, *FORCES_M_S2)))
                    for body, some in scene.inertial.items()
                },
            )
        if isinstance(height := known.get("height"), NormalRows):
            scene = replace(scene, heights=scene.heights.weighed(height.left(self.x) / height.std))
        self.motion = replace(self.motion, scene=scene)
        self.known = known_rows(self.motion, self.layout)

    def coarse(self) -> Coarseness:
        """Return how much of the bodies' motion is not in their paths."""
        return coarseness(self.motion, self.rows, self.geometry, self.x)

    def refine(self) -> None:
        """Put twice as many control points, which may be followed by quick motion."""
        finer = self.motion.refined(self.values)
        self.origin = self.motion.refined(self.origin)[1]
        self.motion, self.values = finer[0], dict(finer[1])
        self.weights.pop(("path", 0))
        self.build(self.errors, jerk=QUICK_M_S3)
        self.climb(evidence_steps=0)

    def likeliest(self) -> Found:
        """Go to the top of the likelihood of ranges that are direct, reflected or outliers."""
        if len(self.rows) < FEWEST_A_PAIR * len(self.model.pairs.ends):
            self.errors = Cauchy(max(robust_spread(self.residuals()), LEAST_SCALE_M), expected=True)
            return self.found(self.climb(evidence_steps=0, tolerance=0.01))
        errors, unknowns, parts = self.model.error_model(self.residuals())
        self.of_errors(errors, unknowns, parts)
        self.build(errors, (unknowns, parts))
        self.errors = replace(errors, used=self.used)
        self.climb()
        self.trust()
        self.errors = replace(errors, used=self.used)
        found = self.climb(evidence_steps=0, tolerance=0.03)
        # At the top, what ranges tell on average: squares of the slopes of few are too unsteady for its covariance.
        self.errors = replace(self.errors, expected=True)
        return self.found(replace(self.climb(evidence_steps=0, tolerance=np.inf), success=found.success))

    def of_errors(self, errors: Mixture, unknowns: tuple[Unknown, ...], parts: tuple[Part, ...]) -> None:
        """Find what errors are made of at the present distances, which are a start for all together."""
        distances = self.geometry.distances(self.x)[0]
        layout, rows = self.model.build(self.error_m - distances, errors, unknowns, parts)
        x, priors = layout.start(), Priors(layout)
        for kind, where in layout.where.items():
            x[where] = self.values.get(kind, x[where])
        found = maximize([rows, *self.model.gauge_rows(layout)], priors, x, tolerance=1.0)
        own = {block.kind for block in unknowns}
        self.values |= {kind: found.x[where] for kind, where in layout.where.items() if kind in own}
        keys = [(block.kind, k) for block in layout.blocks for k in range(len(block.priors))]
        self.weights |= {key: w for key, w in zip(keys, priors.weights, strict=True) if key[0] in own}

    def found(self, found: Optimum) -> Found:
        """Return what was found."""
        path = next(k for k, key in enumerate(self._keys()) if key == ("path", 0))
        return Found(
            scene=self.motion.scene,
            motion=self.motion,
            rows=self.rows,
            gauge=self.gauge,
            known=self.known,
            optimum=found,
            geometry=self.geometry,
            used=self.used,
            coarse=self.coarse(),
            jerk_m_s3=float(self.priors.weights[path] ** -0.5),
            steps=self.steps,
            success=found.success,
        )


def _trace(found: Optimum, information: Matrix, own: Ints) -> float:
    """Return how many of some unknowns (k,) the information of rows determines."""
    inverse = found.covariance
    if not isinstance(inverse, SparseInverse):
        return float(np.sum((inverse @ information)[own, own]))
    probes = np.zeros((found.layout.size, 24))
    probes[own] = np.random.default_rng(0).choice([-1.0, 1.0], (len(own), 24))
    return float(np.sum(probes * (inverse @ (information @ probes)))) / 24


NEAR = (0.08, 0.16, 0.3)
"""Ranges follow each other closely if they do within such parts of the time between control points."""

NEIGHBOURS, FEWEST = 8, 50
"""Of a body's ranges, so many before each are looked at, and no fewer products of two are."""

SURELY, MATTERS_M = 4.0, 0.01
"""Motion is left out where neighbours go together by so many standard errors, and by so much."""


@dataclass(frozen=True, slots=True)
class Coarseness:
    """How many standard errors neighbours go together by, and how large a motion along an axis in metres that says."""

    deviation: float = 0.0
    motion_m: float = 0.0

    @property
    def shows(self) -> bool:
        """Whether bodies move as their control points cannot."""
        return self.deviation > SURELY and self.motion_m > MATTERS_M


def coarseness(motion: Motion, rows: RangeRows, geometry: Distances, x: Floats) -> Coarseness:
    """Return how much of the bodies' motion is not in their paths.

    A motion that a path leaves out is in all ranges of its body, along each one's direction, so residuals of ranges
    that follow each other closely go together as far as their directions do. Errors of a pair that last (a reflection)
    are kept out: only ranges of other pairs are multiplied.
    """
    scene = motion.scene
    values = rows.values(x)
    _, by, tells = rows.errors.slopes(values)
    slope = by[RESIDUAL]
    known = np.full(len(slope), np.mean(slope**2 if tells is None else tells))
    first, second, *_ = geometry.antennas(x)
    away = (second - first) / np.maximum(np.linalg.norm(second - first, axis=1), 1e-6)[:, None]
    low, high = (choose(scene.ranges.initiator, scene.ranges.target) for choose in (np.minimum, np.maximum))
    found = [np.zeros((3, 0))]
    for body in range(len(scene.moving)):
        one, other = (side.ends.mover == body for side in geometry.sides)
        mine = np.flatnonzero(one != other)
        towards = away[mine] * np.where(one[mine], 1.0, -1.0)[:, None]
        for step in range(1, min(NEIGHBOURS, len(mine) - 1) + 1):
            a, b = mine[:-step], mine[step:]
            others = (low[a] != low[b]) | (high[a] != high[b])
            along = np.einsum("na,na->n", towards[:-step], towards[step:])
            products = [slope[a] * slope[b] * along, known[a] * known[b] * along**2, scene.time_s[b] - scene.time_s[a]]
            found.append(np.array(products)[:, others])
    product, of_a_metre, apart = np.concatenate(found, axis=1)
    spans = []
    for begin, end in pairwise([-1.0, *(part * motion.places.step_s for part in NEAR)]):
        some = (apart > begin) & (apart <= end)
        if np.count_nonzero(some) >= FEWEST:
            total = float(np.sum(product[some]))
            deviation = total / float(np.sqrt(np.sum(product[some] ** 2) + 1e-300))
            spans.append(Coarseness(deviation, float(np.sqrt(max(total / np.sum(of_a_metre[some]), 0.0)))))
    return max(spans, key=lambda one: one.deviation, default=Coarseness())
