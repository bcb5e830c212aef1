"""Maximum likelihood of delays, curve, errors and trajectories together, from an initial guess of trajectories.

Ranges first have Cauchy's likelihood, which converges from far away, then that of `calib.range_errors`. The parameters
of errors and the motion are fitted in turn. The variance of jerk and the standard deviations of accelerometers and
height sensors are estimated as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import sparse

from calib.estimator.error_unknowns import NOISE_M, NOISE_WORTH
from calib.estimator.optimize import Optimum, maximize
from calib.estimator.range_model import RangeModel
from calib.estimator.range_rows import RESIDUAL, Errors, Mixture, Part, RangeRows
from calib.estimator.rows import NormalRows, Rows
from calib.estimator.unknowns import Layout, Priors, Unknown
from calib.spread import robust_spread
from calib.trajectories.motion import Distances, Motion, known_rows
from calib.trajectories.samples import TRUSTED
from calib.trajectories.scene import Scene
from uwblink.arrays import Floats, Ints

State = Mapping[str, Floats]
"""Unknowns of motion by their kind."""

JERK_M_S3, QUICK_M_S3 = 8.0, 100.0
"""Standard deviation of jerk before it is estimated; the second for refined control points."""

FIRST_SCALE_M, LEAST_SCALE_M = 0.15, 0.01
"""First scale of Cauchy's loss, while delays and curve are unknown, and its lower bound."""

ROUNDS = 3
"""Iterations of the scale of Cauchy's loss."""

LITTLE_LEVERAGE, MAX_LEVERAGE = 0.5, 0.9
"""Ranges with a leverage up to the first inform about errors. Leverages are limited to the second, because residuals
are divided by the root of 1 - leverage."""

MIN_RANGES_PER_PAIR = 15
"""With fewer ranges per pair, less those that the unknowns use up, all pairs share one error model."""

MAX_TURNS, STILL = 8, 0.1
"""Maximum number of alternations of motion and errors. They end when no delay moves by more than this share of its
standard error."""

MIN_POINT_S = 0.11
"""Control points are not refined below this interval."""

FORCE_BOUNDS_M_S2 = (0.02, 5.0)
"""Bounds of the standard error of a mean specific force."""


@dataclass(frozen=True, slots=True)
class Cauchy:
    """Cauchy's likelihood of residuals, with a curvature that converges from far away (an error density, `Errors`)."""

    scale_m: float
    parameters: tuple[str, ...] = ()

    def slopes(self, values: dict[str, Floats]) -> tuple[Floats, dict[str, Floats], Floats | None]:
        """Return log densities (n,), slopes by the residual (n,) and information (n,)."""
        u = values[RESIDUAL] / self.scale_m
        weight = 2 / self.scale_m**2 / (1 + u**2)
        curvature = weight * (1 - u**2) / (1 + u**2)
        # Where the curvature is negative, a fifth of the weight of reweighted least squares replaces it.
        tells = np.maximum(curvature, 0.2 * weight)
        return -np.log1p(u**2), {RESIDUAL: -weight * values[RESIDUAL]}, tells


@dataclass(frozen=True, kw_only=True)
class MotionFit:
    """Motion that fits the raw ranges of a scene: unknowns, residuals (n,) and log likelihood."""

    motion: Motion
    state: State
    residuals: Floats
    value: float

    def positions(self, time_s: Floats) -> Floats:
        """Return the positions (k, bodies, 3) of the moving bodies at instants (k,)."""
        return self.motion.positions(self.state["path"], time_s)


def fit_motion(
    scene: Scene,
    start: State,
    scales_m: tuple[float, ...],
    jerk_m_s3: float,
    *,
    steps: int = 25,
    tolerance: float = 1.0,
) -> MotionFit:
    """Return the motion near a start that fits raw ranges best, by Cauchy's likelihood with decreasing scales."""
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
    return MotionFit(motion=motion, state=motion.state(layout, x), residuals=rows.residuals(x), value=value)


def search(scene: Scene, model: RangeModel, error_m: Floats, start: State, done: Callable[[float], None]) -> Search:
    """Return the likeliest unknowns; `error_m` (n,) are the ranges of the scene, less a known curve."""
    state = Search(scene, model, error_m, start, done)
    state.fit_robustly()
    while state.coarseness().shows and state.motion.places.step_s > MIN_POINT_S:
        state.refine()
        state.fit_robustly()
    state.fit_likelihood()
    return state


class Search:
    """The state of a search; each method changes one part of it.

    At its end `optimum` has all unknowns of `motion` and ranges (`rows`), beside what else is `known` of the motion.
    """

    optimum: Optimum

    def __init__(
        self, scene: Scene, model: RangeModel, error_m: Floats, start: State, done: Callable[[float], None]
    ) -> None:
        """Begin at a start of the motion; `error_m` (n,) are ranges, `done` is told the share that is done."""
        self.model, self.error_m, self.done = model, error_m, done
        self.motion, self.origin, self.steps = Motion.of(scene), start, 0
        self.leverage: Floats = np.zeros(len(error_m))
        self.weights: dict[tuple[str, int], float] = {}
        self.values: dict[str, Floats] = dict(start)
        self.build(Cauchy(FIRST_SCALE_M))

    def build(
        self, errors: Errors, more: tuple[tuple[Unknown, ...], tuple[Part, ...]] = ((), ()), jerk: float = JERK_M_S3
    ) -> None:
        """Build layout, priors and rows with the present values."""
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
        self.gauge = (*model.gauge_rows(self.layout), *model.held_rows(self.layout))
        self.x = self.layout.start(self.values)
        self.priors.recall(self.weights)

    def optimize(self, *, evidence_steps: int = 12, tolerance: float = 0.1, steps: int = 60) -> Optimum:
        """Maximise the likelihood, and update values and leverages."""
        rows: list[Rows] = [replace(self.rows, errors=self.errors), *self.known.values(), *self.gauge]
        asked = self.layout.indices(["delay", *self.model.curve_kinds()])
        found = maximize(
            rows, self.priors, self.x, steps=steps, evidence_steps=evidence_steps, tolerance=tolerance, asked=asked
        )
        self.x, self.steps = found.x, self.steps + found.steps
        self.rows = replace(self.rows, errors=self.errors)
        self.values = {kind: found.x[where] for kind, where in self.layout.where.items()}
        self.weights = self.priors.by_key()
        self.leverage = leverages(self.rows, found)
        self.done(1 - 0.97**self.steps)
        return found

    def fit_robustly(self) -> None:
        """Maximise Cauchy's likelihood, whose scale is estimated."""
        scale = FIRST_SCALE_M
        for turn in range(ROUNDS):
            self.errors = Cauchy(scale)
            self.optimize(evidence_steps=12 if turn else 0)
            scale = self.scale()
        self.update_sensor_errors()

    def scale(self) -> float:
        """Return the scale of residuals, combined with the prior of noise by their numbers of ranges."""
        free = len(self.rows) * (1 - self.used)
        square = free * robust_spread(self.residuals()[self.informative_rows()]) ** 2 + NOISE_WORTH * NOISE_M**2
        return float(np.sqrt(square / (free + NOISE_WORTH)))

    def residuals(self) -> Floats:
        """Return the residuals of the ranges (n,), divided by the root of 1 - leverage."""
        return np.asarray(self.rows.residuals(self.x) / np.sqrt(1 - self.leverage))

    @property
    def used(self) -> float:
        """Return the mean leverage of the ranges."""
        return float(np.mean(self.leverage))

    def informative_rows(self) -> Ints:
        """Return the half of the ranges with the lowest leverage, and all with little."""
        return np.flatnonzero(self.leverage <= max(LITTLE_LEVERAGE, float(np.median(self.leverage))))

    def update_sensor_errors(self) -> None:
        """Update the standard errors of accelerometers and height sensors from their residuals."""
        scene = self.motion.scene
        left = {kind: rows.left(self.x) for kind, rows in self.known.items() if isinstance(rows, NormalRows)}
        inertial = {}
        for body, some in scene.inertial.items():
            std = TRUSTED * robust_spread(left[f"force {body}"], 0.0)
            inertial[body] = replace(some, std_m_s2=float(np.clip(std, *FORCE_BOUNDS_M_S2)))
        heights = scene.heights.reweighted(left.get("height", np.zeros(0)))
        self.motion = replace(self.motion, scene=replace(scene, inertial=inertial, heights=heights))
        self.known = known_rows(self.motion, self.layout)

    def coarseness(self) -> Coarseness:
        """Return the motion of the bodies that their paths miss."""
        return coarseness(self.motion, self.rows, self.geometry, self.x)

    def refine(self) -> None:
        """Double the number of control points, and allow quicker motion."""
        finer = self.motion.refined(self.values)
        self.origin = self.motion.refined(self.origin)[1]
        self.motion, self.values = finer[0], dict(finer[1])
        self.weights.pop(("path", 0))
        self.build(self.errors, jerk=QUICK_M_S3)
        self.optimize(evidence_steps=0)

    def fit_likelihood(self) -> None:
        """Maximise the likelihood of direct, reflected and outlying ranges.

        Motion and errors are fitted in turn: the joint likelihood is unbounded where a path goes exactly through some
        ranges and their noise is zero.
        """
        mixture, unknowns, parts = self.model.error_model(self.residuals())
        few = len(self.rows) * (1 - self.used) < MIN_RANGES_PER_PAIR * len(self.model.pairs.ends)
        if few:
            unknowns = tuple(u if len(u.names) == 1 else _as_known(u, u.start) for u in unknowns)
        errors, delays, settled = replace(mixture, expected=True), self.values["delay"], False
        for turn in range(MAX_TURNS):
            self.fit_errors(mixture, unknowns, parts)
            known = tuple(_as_known(unknown, self.values[unknown.kind]) for unknown in unknowns)
            self.build(errors, (known, parts))
            found = self.optimize(evidence_steps=0 if turn > 1 else 12, tolerance=0.03, steps=20)
            if turn == 0:
                self.update_sensor_errors()
            own = self.layout.where["delay"]
            std = np.sqrt(np.maximum(np.diag(found.covariance[:, own][own]), 1e-12))
            moved, delays = np.abs(found.x[own] - delays), found.x[own]
            settled = turn > 1 and bool(np.all(moved < STILL * std))
            if settled:
                break
        # The parameters of errors are unknowns as well: the covariance contains them.
        self.build(errors, (unknowns, parts))
        if not few:
            self.errors = replace(mixture, used=self.used)
            self.optimize(evidence_steps=0, tolerance=0.03, steps=20)
        self.errors = replace(errors, used=self.used)
        self.optimum = replace(self.optimize(evidence_steps=0, tolerance=np.inf), success=settled)

    def fit_errors(self, errors: Mixture, unknowns: tuple[Unknown, ...], parts: tuple[Part, ...]) -> None:
        """Fit the parameters of the error model to the residuals."""
        layout, rows = self.model.build(self.residuals(), errors, unknowns, parts, only=())
        priors = Priors(layout)
        priors.recall(self.weights)
        found = maximize([rows.sample(self.informative_rows())], priors, layout.start(self.values), tolerance=0.1)
        self.values |= {kind: found.x[where] for kind, where in layout.where.items()}
        self.weights |= priors.by_key()


def _as_known(unknown: Unknown, values: Floats) -> Unknown:
    """Return a block of unknowns with fixed values and prior weights."""
    priors = tuple(replace(prior, bounds=None) for prior in unknown.priors)
    return replace(unknown, start=values, known=np.ones(len(values), dtype=bool), priors=priors)


PROBES = 48
"""Random vectors for leverages (Hutchinson 1990; Bekas, Kokiopoulou and Saad 2007): exact to about 10 %."""


def leverages(rows: RangeRows, found: Optimum) -> Floats:
    """Return the leverage of each range (n,), at most `MAX_LEVERAGE`: the share of it that the unknowns use up.

    This is the diagonal of W^1/2 A C A' W^1/2, with the information W of residuals, their derivatives A and the
    covariance C.
    """
    size, parts, values = found.layout.size, [], rows.values(found.x)
    for terms in rows.terms(found.x):
        part = terms.beside or terms
        weight = np.ones(1) if part.weight is None else part.weight
        if part is not terms and terms.residual is not None:
            weight = weight + np.mean(terms.residual**2)
        parts.append((part.as_matrix(part.slopes if part.entries is None else part.entries, size), weight))
    weight = np.concatenate([known for _, known in parts])
    if "noise" in values:
        # The information of a residual is at most that of normal errors (Stam 1959).
        weight = np.minimum(weight, np.exp(-2 * values["noise"][rows.order]))
    reach = sparse.csr_matrix(sparse.diags_array(np.sqrt(weight)) @ sparse.vstack([matrix for matrix, _ in parts]))
    probes = np.random.default_rng(0).choice([-1.0, 1.0], (len(rows), PROBES))
    shares = np.empty(len(rows))
    shares[rows.order] = np.mean(probes * (reach @ (found.covariance @ (reach.T @ probes))), axis=1)
    return np.clip(shares, 0.0, MAX_LEVERAGE)


NEAR = (0.08, 0.16, 0.3)
"""Time differences of neighbouring ranges, as shares of the time between control points."""

NEIGHBOURS, FEWEST = 8, 50
"""Previous ranges of the body that each range is compared with, and the minimum number of products."""

MIN_DEVIATION, MIN_MOTION_M = 4.0, 0.01
"""The path misses motion if neighbours correlate by so many standard errors, and by a motion of so many metres."""


@dataclass(frozen=True, slots=True)
class Coarseness:
    """Correlation of neighbouring residuals in standard errors, and the size of the missed motion along an axis in
    metres."""

    deviation: float = 0.0
    motion_m: float = 0.0

    @property
    def shows(self) -> bool:
        """Whether the paths miss motion."""
        return self.deviation > MIN_DEVIATION and self.motion_m > MIN_MOTION_M


def coarseness(motion: Motion, rows: RangeRows, geometry: Distances, x: Floats) -> Coarseness:
    """Return the motion of the bodies that their paths miss.

    A missed motion enters all ranges of the body along their directions, so residuals of ranges that follow each other
    correlate as their directions do. Only ranges of different pairs are multiplied, which excludes lasting errors of a
    pair (reflections).
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
        one, other = (side.mover == body for side in geometry.sides)
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
