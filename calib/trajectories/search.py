"""Maximum likelihood of delays, curve, errors and trajectories together, from an initial guess of trajectories.

Ranges first have Cauchy's likelihood, which converges from far away, then that of `calib.range_errors`, whose
parameters are unknowns like those of the motion. The variance of jerk and the standard deviations of accelerometers and
height sensors are estimated as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import sparse

from calib.estimator.grouped_errors import NOISE_M, NOISE_WORTH
from calib.estimator.inverse import diagonal_of
from calib.estimator.losses import LOSSES
from calib.estimator.optimize import Optimum, maximize
from calib.estimator.range_model import RangeModel
from calib.estimator.range_rows import RESIDUAL, Errors, Part, RangeRows, Robust
from calib.estimator.rows import NormalRows, Rows
from calib.estimator.unknowns import Layout, Priors, Unknown
from calib.spread import robust_spread
from calib.trajectories.motion import Distances, Motion, known_rows
from calib.trajectories.samples import TRUSTED
from calib.trajectories.scene import Scene
from uwblink.arrays import Floats, Ints

State = Mapping[str, Floats]
"""Unknowns of motion by their kind."""

JERK_M_S3 = 8.0
"""Standard deviation of jerk before it is estimated. Half or twice of it moves delays by 0.1 standard errors
(`python -m benchmarks.constants`)."""

FIRST_SCALE_M = 0.15
"""First scale of Cauchy's loss, while delays and curve are unknown."""

LITTLE_LEVERAGE, MAX_LEVERAGE = 0.5, 0.9
"""Errors are estimated from ranges with a leverage up to the first value. Leverages are limited to the second, because
residuals are divided by the root of 1 - leverage."""

SMOOTHING = 4.0
"""The likelihood of a mixture has many maxima, because bodies may move as reflected ranges say. It is first divided by
this, so that the priors of motion weigh more. With half or twice of it, errors of flights with lasting reflections are
the same to 3 ps; without it one of six has 101 instead of 46 ps."""

MIN_RANGES_PER_PAIR = 15
"""With fewer ranges per pair, minus the number of unknowns per pair, all pairs share one error model."""


def _cauchy(scale_m: float) -> Robust:
    """Return Cauchy's likelihood of residuals: twice its loss.

    A fifth of the weights of reweighted least squares replaces a negative curvature, so that the search converges from
    far away.
    """
    return Robust(weights=LOSSES["cauchy"].weights, scale_m=scale_m, least=0.2, dispersion=0.5)


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
    scene: Scene, start: State, scales_m: tuple[float, ...], jerk_m_s3: float, *, steps: int = 25
) -> MotionFit:
    """Return the motion near a start that fits raw ranges best, by Cauchy's likelihood with decreasing scales."""
    motion = Motion.of(scene)
    layout = Layout(motion.unknowns(start, jerk_m_s3))
    key = np.zeros(len(scene.time_s), dtype=np.int64)
    rows = RangeRows.of(scene.ranges.raw_m, key, [], _cauchy(scales_m[0]), layout, Distances.of_ranges(motion, layout))
    known, priors, x, value = list(known_rows(motion, layout).values()), Priors(layout), layout.start(), 0.0
    for scale in scales_m:
        these: list[Rows] = [replace(rows, errors=_cauchy(scale)), *known]
        found = maximize(these, priors, x, steps=steps, tolerance=1.0, evidence_steps=0)
        x, value = found.x, found.value
    return MotionFit(motion=motion, state=motion.state(layout, x), residuals=rows.residuals(x), value=value)


def search(scene: Scene, model: RangeModel, error_m: Floats, start: State, done: Callable[[float], None]) -> Search:
    """Return the likeliest unknowns; `error_m` (n,) are the ranges of the scene minus a known curve."""
    state = Search(scene, model, error_m, start, done)
    state.fit_robustly()
    # Control points are not refined below 0.11 s.
    while state.missed_motion_m() and state.motion.places.step_s > 0.11:
        state.refine()
        state.fit_robustly()
    state.fit_likelihood()
    return state


class Search:
    """The state of a search; each method changes one part of it.

    At its end `optimum` has all unknowns of `motion` and ranges (`rows`); `known` are the other rows on the motion.
    """

    optimum: Optimum

    def __init__(
        self, scene: Scene, model: RangeModel, error_m: Floats, start: State, done: Callable[[float], None]
    ) -> None:
        """Begin at a start of the motion; `error_m` (n,) are ranges, `done` is called with the completed share."""
        self.model, self.error_m, self.done = model, error_m, done
        self.motion, self.origin, self.steps = Motion.of(scene), start, 0
        self.leverage: Floats = np.zeros(len(error_m))
        self.weights: dict[tuple[str, int], float] = {}
        self.values: dict[str, Floats] = dict(start)
        self.build(_cauchy(FIRST_SCALE_M))

    def build(
        self,
        errors: Errors,
        unknowns: tuple[Unknown, ...] = (),
        parts: tuple[Part, ...] = (),
        *,
        jerk_m_s3: float = JERK_M_S3,
    ) -> None:
        """Build layout, priors and rows with the present values; `unknowns` and `parts` are for the errors."""
        model, motion = self.model, self.motion
        more = (*motion.unknowns(self.origin, jerk_m_s3), *unknowns)
        self.layout, rows = model.build(self.error_m, errors, more, parts)
        self.geometry = Distances.of_ranges(motion, self.layout)
        self.rows = replace(rows, geometry=self.geometry)
        self.known = known_rows(motion, self.layout)
        self.gauge = (*model.gauge_rows(self.layout), *model.held_rows(self.layout))
        self.x = self.layout.start(self.values)
        self.priors = Priors(self.layout)
        self.priors.recall(self.weights)

    def optimize(self, errors: Errors, *, evidence_steps: int = 0, tolerance: float = 0.1) -> Optimum:
        """Maximise the likelihood, and update values and leverages."""
        self.rows = replace(self.rows, errors=errors)
        found = maximize(
            [self.rows, *self.known.values(), *self.gauge],
            self.priors,
            self.x,
            steps=60,
            evidence_steps=evidence_steps,
            tolerance=tolerance,
            asked=self.layout.indices(["delay", *self.model.curve_kinds()]),
        )
        self.x, self.steps = found.x, self.steps + found.steps
        self.values = found.by_kind()
        self.weights = self.priors.by_key()
        self.leverage = leverages(self.rows, found)
        self.done(1 - 0.97**self.steps)
        return found

    def fit_robustly(self) -> None:
        """Maximise Cauchy's likelihood, whose scale is estimated."""
        scale = FIRST_SCALE_M
        # The scale converges in three rounds.
        for turn in range(3):
            self.optimize(_cauchy(scale), evidence_steps=12 if turn else 0)
            # The spread of residuals, combined with the prior of noise by their numbers of ranges.
            spread, free = robust_spread(self.residuals()[self.informative_rows()]), self.free_ranges
            scale = float(np.sqrt((free * spread**2 + NOISE_WORTH * NOISE_M**2) / (free + NOISE_WORTH)))
        self.update_sensor_errors()

    def _restrict(self) -> None:
        """Use restricted likelihood for noise: the variances of residuals follow from the mean leverage of all ranges.

        The leverage of a single range has an error of some 14 % (`diagonal_of`).
        """
        noise = self.rows.values(self.x, ("noise",))["noise"][self.rows.order]
        self.rows = replace(self.rows, unsure_m2=np.mean(self.leverage) * np.exp(2 * noise))

    def residuals(self) -> Floats:
        """Return the residuals of the ranges (n,), divided by the root of 1 - leverage."""
        return np.asarray(self.rows.residuals(self.x) / np.sqrt(1 - self.leverage))

    @property
    def free_ranges(self) -> float:
        """Return the number of ranges minus the effective number of unknowns."""
        return float(np.sum(1 - self.leverage))

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
            inertial[body] = replace(some, std_m_s2=float(np.clip(std, 0.02, 5.0)))
        heights = scene.heights.reweighted(left.get("height", np.zeros(0)))
        self.motion = replace(self.motion, scene=replace(scene, inertial=inertial, heights=heights))
        self.known = known_rows(self.motion, self.layout)

    def refine(self) -> None:
        """Double the number of control points, and allow faster motion."""
        finer, self.values = self.motion.refined(self.values)
        self.origin = self.motion.refined(self.origin)[1]
        self.motion = finer
        self.weights.pop(("path", 0))
        errors = self.rows.errors
        # Motion that fewer control points do not represent is fast; this is the start for its jerk.
        self.build(errors, jerk_m_s3=100.0)
        self.optimize(errors)

    def fit_likelihood(self) -> None:
        """Maximise the restricted likelihood of direct, reflected and outlying ranges in all unknowns at once.

        Estimating motion and errors alternately can end in a local maximum, because errors that fit a wrong motion
        keep the motion wrong.
        """
        mixture, unknowns, parts = self.model.error_model(self.residuals())
        if self.free_ranges < MIN_RANGES_PER_PAIR * len(self.model.pairs.ends):
            unknowns = tuple(u if len(u.names) == 1 else _as_known(u, u.start) for u in unknowns)
        self.build(mixture, unknowns, parts)
        self._restrict()
        self.optimize(replace(mixture, dispersion=SMOOTHING))
        own, settled = self.layout.where["delay"], False
        # At most five rounds, because leverages change; they end if no delay moves by a tenth of its standard error.
        for turn in range(5):
            delays = self.values["delay"]
            self._restrict()
            found = self.optimize(mixture, evidence_steps=12 if turn < 3 else 0, tolerance=0.03 if turn else 0.1)
            if turn == 0:
                self.update_sensor_errors()
            std = np.sqrt(np.maximum(np.diag(found.covariance[:, own][own]), 1e-12))
            settled = turn > 0 and bool(np.all(np.abs(found.x[own] - delays) < 0.1 * std))
            if settled:
                break
        self._restrict()
        found = self.optimize(replace(mixture, expected=True), tolerance=np.inf)
        self.optimum = replace(found, success=settled)

    def missed_motion_m(self) -> float:
        """Return the size of the motion along an axis that paths do not represent, in metres; 0 below 4 standard errors
        or 1 cm.

        A missed motion changes all ranges of the body along their directions, so residuals of consecutive ranges
        correlate like their directions. Only ranges of different pairs are multiplied, which excludes lasting errors of
        a pair (reflections).
        """
        time, pair = self.motion.scene.time_s, self.model.pairs.number
        _, by, known = self.rows.errors.slopes(self.rows.values(self.x))
        slope, information = by[RESIDUAL], float(np.mean(by[RESIDUAL] ** 2 if known is None else known.residual))
        first, second, *_ = self.geometry.antennas(self.x)
        away = (second - first) / np.maximum(np.linalg.norm(second - first, axis=1), 1e-6)[:, None]
        found = [np.zeros((3, 0))]
        for body in range(len(self.motion.scene.moving)):
            one, other = (side.mover == body for side in self.geometry.sides)
            mine = np.flatnonzero(one != other)
            towards = away[mine] * np.where(one[mine], 1.0, -1.0)[:, None]
            # Each range is compared with the eight before it.
            for step in range(1, min(8, len(mine) - 1) + 1):
                a, b = mine[:-step], mine[step:]
                along = np.einsum("na,na->n", towards[:-step], towards[step:])
                products = [slope[a] * slope[b] * along, (information * along) ** 2, time[b] - time[a]]
                found.append(np.array(products)[:, pair[a] != pair[b]])
        product, of_a_metre, apart = np.concatenate(found, axis=1)
        spans = []
        # Time differences of neighbours, as shares of the time between control points.
        for begin, end in pairwise([-1.0, *(part * self.motion.places.step_s for part in (0.08, 0.16, 0.3))]):
            some = (apart > begin) & (apart <= end)
            if np.count_nonzero(some) >= 50:
                total = float(np.sum(product[some]))
                deviation = total / float(np.sqrt(np.sum(product[some] ** 2) + 1e-300))
                spans.append((deviation, float(np.sqrt(max(total / np.sum(of_a_metre[some]), 0.0)))))
        deviation, motion_m = max(spans, default=(0.0, 0.0))
        return motion_m if deviation > 4.0 and motion_m > 0.01 else 0.0


def _as_known(unknown: Unknown, values: Floats) -> Unknown:
    """Return a block of unknowns with fixed values and prior weights."""
    priors = tuple(replace(prior, bounds=None) for prior in unknown.priors)
    return replace(unknown, start=values, known=np.ones(len(values), dtype=bool), priors=priors)


def leverages(rows: RangeRows, found: Optimum) -> Floats:
    """Return the leverage of each range (n,), at most `MAX_LEVERAGE`: the share of its information that determines
    unknowns.

    This is the diagonal of W^1/2 A C A' W^1/2, with the information W of residuals, their derivatives A and the
    covariance C.
    """
    size, parts, values = found.layout.size, [], rows.values(found.x)
    for terms in rows.terms(found.x):
        *shared, part = terms.squares
        weight = part.weight + sum(np.mean(one.residual**2) for one in shared)
        matrix = terms.as_matrix(part.entries, part.residual, size)
        parts.append((matrix, np.broadcast_to(weight, matrix.shape[0])))
    weight = np.concatenate([known for _, known in parts])
    if "noise" in values:
        # The information of a residual is at most that of normal errors (Stam 1959).
        weight = np.minimum(weight, np.exp(-2 * values["noise"][rows.order]))
    reach = sparse.csr_matrix(sparse.diags_array(np.sqrt(weight)) @ sparse.vstack([matrix for matrix, _ in parts]))
    shares = np.empty(len(rows))
    shares[rows.order] = diagonal_of(reach, found.covariance)
    return np.clip(shares, 0.0, MAX_LEVERAGE)
