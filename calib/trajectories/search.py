"""The search: the likeliest delays, curve, errors and trajectories together, from where trajectories are thought to be.

Ranges first have Cauchy's likelihood, which descends from anywhere, then that of `calib.range_errors`, whose parameters
and the motion are fitted in turn. The variance of jerk is estimated along, and so are the standard deviations of
accelerometers and height sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import sparse

from calib.estimator.optimize import Optimum, maximize
from calib.estimator.range_model import NOISE_M, NOISE_WORTH, RangeModel
from calib.estimator.range_rows import RESIDUAL, Errors, Mixture, Part, RangeRows
from calib.estimator.rows import NormalRows, Rows
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

LITTLE_TAKEN, MOST_TAKEN = 0.5, 0.9
"""Ranges of which unknowns take no more say what errors are; shares are held below the most, as roots are divided by
what is left."""

FEWEST_A_PAIR = 15
"""Of fewer ranges a pair on average, beside those that paths use up, errors of all pairs are taken to be alike."""

MOST_TURNS, STILL = 8, 0.1
"""Turns in which motion and errors are fitted, at most; the last moves no delay by more of its standard error."""

FINEST_S = 0.11
"""Control points are not put twice as densely again below this."""

TRUSTED = 3.0
"""How much less than its residuals say a sensor is trusted: what it is off by lasts for some windows."""

FORCES_M_S2 = (0.02, 5.0)
"""Bounds of what a mean specific force is off by."""


@dataclass(frozen=True, slots=True)
class Cauchy:
    """Cauchy's likelihood of residuals, with a curvature that descends from anywhere (`Errors`)."""

    scale_m: float
    parameters: tuple[str, ...] = ()

    def slopes(self, values: dict[str, Floats]) -> tuple[Floats, dict[str, Floats], Floats | None]:
        """Return log densities (n,), slopes by the residual (n,) and what each tells (n,)."""
        u = values[RESIDUAL] / self.scale_m
        weight = 2 / self.scale_m**2 / (1 + u**2)
        curvature = weight * (1 - u**2) / (1 + u**2)
        # Where the loss bends upwards there is none: a fifth of the weight, as of reweighted least squares.
        tells = np.maximum(curvature, 0.2 * weight)
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

    `used` is the share of the ranges that the unknowns use up, `coarse` how much of motion they leave out.
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
        self.motion, self.origin, self.steps = Motion.of(scene), start, 0
        self.taken: Floats = np.zeros(len(error_m))
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

    def climb(self, *, evidence_steps: int = 12, tolerance: float = 0.1, steps: int = 60) -> Optimum:
        """Go to the top, and see what the unknowns use up of the ranges there."""
        rows: list[Rows] = [replace(self.rows, errors=self.errors), *self.known.values(), *self.gauge]
        asked = self.layout.indices(["delay", *self.model.curve_kinds()])
        found = maximize(
            rows, self.priors, self.x, steps=steps, evidence_steps=evidence_steps, tolerance=tolerance, asked=asked
        )
        self.x, self.steps = found.x, self.steps + found.steps
        self.rows = replace(self.rows, errors=self.errors)
        self.values = {kind: found.x[where] for kind, where in self.layout.where.items()}
        self.weights = dict(zip(self._keys(), self.priors.weights, strict=True))
        self.taken = taken_shares(self.rows, found)
        self.done(1 - 0.97**self.steps)
        return found

    def robustly(self) -> None:
        """Go to the top of Cauchy's likelihood, as wide as the data ask for."""
        scale = FIRST_SCALE_M
        for turn in range(ROUNDS):
            self.errors = Cauchy(scale)
            self.climb(evidence_steps=12 if turn else 0)
            scale = self.scale()
        self.trust()

    def scale(self) -> float:
        """Return the scale of residuals, and what is known of noise beforehand, each by how many ranges it is worth."""
        free = len(self.rows) * (1 - self.used)
        square = free * robust_spread(self.residuals()[self.telling()]) ** 2 + NOISE_WORTH * NOISE_M**2
        return float(np.sqrt(square / (free + NOISE_WORTH)))

    def residuals(self) -> Floats:
        """Return the residuals of the ranges (n,), as large as they were if the unknowns had taken nothing of them."""
        return np.asarray(self.rows.residuals(self.x) / np.sqrt(1 - self.taken))

    @property
    def used(self) -> float:
        """Return the share of the ranges that the unknowns use up."""
        return float(np.mean(self.taken))

    def telling(self) -> Ints:
        """Return the ranges of which the unknowns take the least: half of them, and all that they take little of."""
        return np.flatnonzero(self.taken <= max(LITTLE_TAKEN, float(np.median(self.taken))))

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
            scene = replace(scene, heights=scene.heights.reweighted(height.left(self.x) / height.std))
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
        """Go to the top of the likelihood of ranges that are direct, reflected or outliers.

        Motion and errors are fitted in turn: the likelihood of both together is greatest where paths go through some
        ranges exactly and the noise of those is zero.
        """
        mixture, unknowns, parts = self.model.error_model(self.residuals())
        few = len(self.rows) * (1 - self.used) < FEWEST_A_PAIR * len(self.model.pairs.ends)
        if few:
            unknowns = tuple(u if len(u.names) == 1 else _as_known(u, u.start) for u in unknowns)
        errors, delays, settled = replace(mixture, expected=True), self.values["delay"], False
        for turn in range(MOST_TURNS):
            self.fit_errors(mixture, unknowns, parts)
            known = tuple(_as_known(unknown, self.values[unknown.kind]) for unknown in unknowns)
            self.build(errors, (known, parts))
            found = self.climb(evidence_steps=0 if turn > 1 else 12, tolerance=0.03, steps=20)
            if turn == 0:
                self.trust()
            own = self.layout.where["delay"]
            std = np.sqrt(np.maximum(np.diag(found.covariance[:, own][own]), 1e-12))
            moved, delays = np.abs(found.x[own] - delays), found.x[own]
            settled = turn > 1 and bool(np.all(moved < STILL * std))
            if settled:
                break
        # What errors are made of is as unknown as all else: it has its part in the covariance.
        self.build(errors, (unknowns, parts))
        if not few:
            self.errors = replace(mixture, used=self.used)
            self.climb(evidence_steps=0, tolerance=0.03, steps=20)
        self.errors = replace(errors, used=self.used)
        return self.found(replace(self.climb(evidence_steps=0, tolerance=np.inf), success=settled))

    def fit_errors(self, errors: Mixture, unknowns: tuple[Unknown, ...], parts: tuple[Part, ...]) -> None:
        """Fit what errors are made of to the residuals."""
        layout, rows = self.model.build(self.residuals(), errors, unknowns, parts, only=())
        x, priors = layout.start(), Priors(layout)
        for kind, where in layout.where.items():
            x[where] = self.values.get(kind, x[where])
        keys = [(block.kind, k) for block in layout.blocks for k in range(len(block.priors))]
        priors.weights = [self.weights.get(key, w) for key, w in zip(keys, priors.weights, strict=True)]
        found = maximize([rows.sample(self.telling())], priors, x, tolerance=0.1)
        self.values |= {kind: found.x[where] for kind, where in layout.where.items()}
        self.weights |= dict(zip(keys, priors.weights, strict=True))

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


def _as_known(unknown: Unknown, values: Floats) -> Unknown:
    """Return a block of unknowns that keep their values, and the weights of their priors."""
    priors = tuple(replace(prior, bounds=None) for prior in unknown.priors)
    return replace(unknown, start=values, known=np.ones(len(values), dtype=bool), priors=priors)


PROBES = 48
"""Random vectors by which shares are estimated (Hutchinson 1990; Bekas, Kokiopoulou, Saad 2007), to a tenth or so."""


def taken_shares(rows: RangeRows, found: Optimum) -> Floats:
    """Return the share of each range (n,) that the unknowns use up: its leverage, at most `MOST_TAKEN`.

    These are the diagonal of W^1/2 A C A' W^1/2, of what residuals tell W, their derivatives A and the covariance C.
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
        # A residual tells no more than if all errors were normal (Stam 1959).
        weight = np.minimum(weight, np.exp(-2 * values["noise"][rows.order]))
    reach = sparse.csr_matrix(sparse.diags_array(np.sqrt(weight)) @ sparse.vstack([matrix for matrix, _ in parts]))
    probes = np.random.default_rng(0).choice([-1.0, 1.0], (len(rows), PROBES))
    shares = np.empty(len(rows))
    shares[rows.order] = np.mean(probes * (reach @ (found.covariance @ (reach.T @ probes))), axis=1)
    return np.clip(shares, 0.0, MOST_TAKEN)


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
