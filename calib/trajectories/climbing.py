"""The whole search: from followed trajectories to the likeliest delays, curve and trajectories together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from calib.estimation.pair_mixture import PairMixture
from calib.estimation.problem import Problem
from calib.estimation.robust import QuadraticModel, scale_of
from calib.estimation.smoothing import reml_penalty
from calib.estimator.losses import MIXTURE
from calib.spread import robust_spread
from calib.trajectories.arrow import Factored, normal_of
from calib.trajectories.coarseness import Coarseness, coarseness
from calib.trajectories.known_rows import JERK_M_S3, KnownRows, known_rows, smoothness
from calib.trajectories.likelihood import loss_of, mixture_of
from calib.trajectories.range_losses import Cauchy, RangeLoss
from calib.trajectories.range_rows import RangeRows, range_rows
from calib.trajectories.scene import Scene
from calib.trajectories.solving import minimise
from calib.trajectories.unknowns import Columns, State, columns_of, refined
from uwblink.arrays import Floats

if TYPE_CHECKING:
    from scipy.sparse import csr_array

FIRST_SCALE_M: Final = 0.15
WIDE: Final = 2.0
"""The loss on the way is wider than that of a fit with known distances: outliers are few, trajectories want all."""

LEAST_SCALE_M: Final = 0.01
MOST_USED: Final = 0.8
FEWEST_A_PAIR: Final = 15
"""Of fewer ranges a pair on average nobody can tell what their errors are made of."""

FELT: Final = 3.0
"""How much less than its residuals say an accelerometer is trusted: what it is off by lasts for some windows."""

FORCES_M_S2: Final = (0.02, 5.0)
PROBES: Final = 20
JERKS_M_S3: Final = (0.2, 2000.0)
QUICK_M_S3: Final = 100.0
"""By how much accelerations change in a second where they change too fast for the control points, to begin with."""

FINEST_S: Final = 0.11
"""Control points are not halved again below this."""

ROUNDS: Final = 2
FIRST_ROUGHNESS: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Climbed:
    """The top: unknowns, what the errors of ranges are made of, and all that is needed to judge it.

    `mixture` is None where ranges are too few to tell; the loss is Cauchy's then.

    `informed` (n,) is what a range is expected to say of its residual, 1/m^2; `ridge` (b, b) holds the curve;
    `used` is the share of the ranges that trajectories and attitudes use up.
    """

    scene: Scene
    columns: Columns
    rows: RangeRows
    known: KnownRows
    state: State
    loss: RangeLoss
    mixture: PairMixture | None
    ridge: Floats
    informed: Floats
    jerk_m_s3: float
    used: float
    steps: int
    settled: bool

    @property
    def told(self) -> str:
        """Return the name of the loss."""
        return "cauchy" if self.mixture is None else MIXTURE


def climb(scene: Scene, problem: Problem, state: State, done: Callable[[float], None]) -> Climbed:
    """Return the likeliest unknowns, beginning with a robust loss and a state that has its standing bodies in place."""
    columns = columns_of(scene, problem.design.shape[1])
    rows = range_rows(scene, columns, problem.error + problem.ranges.truth_m, problem.design.written_out())
    search = _Search(scene, problem, columns, rows, done)
    search.begin(state)
    loss = Cauchy(FIRST_SCALE_M)
    search.go(loss, 1 / (2 * FIRST_SCALE_M**2))
    loss = search.robust(loss)
    while search.coarseness(loss).shows and search.columns.places.step_s > FINEST_S:
        search.refine()
        loss = search.robust(loss)
    if len(scene.time_s) < FEWEST_A_PAIR * len(problem.pairs.ends):
        return search.found(loss, None)
    for _ in range(ROUNDS):
        mixture = search.mixture()
        search.tune(search.expected(loss_of(mixture), mixture))
        search.go(loss_of(mixture))
    mixture = search.mixture()
    return search.found(loss_of(mixture), mixture)


class _Search:
    """State of the search; each step of `climb` changes one part of it."""

    def __init__(
        self, scene: Scene, problem: Problem, columns: Columns, rows: RangeRows, done: Callable[[float], None]
    ) -> None:
        self.scene, self.problem, self.columns, self.rows, self.done = scene, problem, columns, rows, done
        self.jerk, self.steps, self.settled, self.used = JERK_M_S3, 0, True, 0.0
        size = columns.border
        self.ridge = np.zeros((size, size))
        self.penalties = [_widened(penalty, size) for penalty in problem.penalties()]

    def begin(self, state: State) -> None:
        """Take a state that has only trajectories and standing bodies."""
        border = np.zeros(self.columns.border)
        border[self.columns.stand] = state.border[: self.columns.stand.size].reshape(-1, 3)
        self.state = State(state.local, border)
        self.origin = self.state
        self.known = known_rows(self.scene, self.columns, self.origin, self.jerk)
        count = len(self.scene.time_s)
        for penalty in self.penalties:
            self.ridge += FIRST_ROUGHNESS * count / float(np.trace(penalty)) * penalty

    def robust(self, loss: Cauchy) -> Cauchy:
        """Go to the optimum of a robust loss, as wide as the data ask for, and return it."""
        for _ in range(ROUNDS):
            self.tune(self.expected(loss, None))
            loss = Cauchy(WIDE * self.scale())
            self.go(loss)
        return loss

    def coarseness(self, loss: RangeLoss) -> Coarseness:
        """Return how much of the bodies' motion is not in their trajectories."""
        return coarseness(self.scene, self.columns, self.rows, self.state, loss, self.expected(loss, None))

    def refine(self) -> None:
        """Put twice as many control points, which may be followed by quick motion."""
        finer = columns_of(self.scene, self.columns.design, self.columns.places.step_s / 2)
        self.state, self.origin = (refined(self.columns, finer, some) for some in (self.state, self.origin))
        self.columns, self.jerk = finer, QUICK_M_S3
        self.rows = range_rows(self.scene, finer, self.rows.error, self.rows.design)
        self.known = known_rows(self.scene, finer, self.origin, self.jerk)
        self.go(Cauchy(WIDE * self.scale()))

    def scale(self) -> float:
        """Return the scale of a loss by residuals, from which trajectories have taken a part, metres."""
        return max(scale_of(self.rows.residuals(self.state)) / math.sqrt(1 - self.used), LEAST_SCALE_M)

    def go(self, loss: RangeLoss, ridge_over: float = 1.0) -> None:
        """Go to the optimum of a loss."""
        found = minimise(self.rows, self.known, self.state, loss, ridge_over * self.ridge, each_step=self._step)
        self.state, self.settled = found.state, found.settled

    def _step(self) -> None:
        self.steps += 1
        self.done(1 - 0.97**self.steps)

    def tune(self, informed: Floats) -> None:
        """Choose how smooth curve and trajectories are by what the data say."""
        _, local, border = self.rows.linear(self.state)
        of_ranges = normal_of(local, border, informed)
        whole = Factored(of_ranges + self.known.linear(self.state).normal)
        if self.penalties:
            near = QuadraticModel(whole.schur, np.zeros(len(whole.schur)), 1.0)
            self.ridge = reml_penalty(near, self.state.border, self.penalties)[0]
        self.used = min(self._used(whole, local, informed), MOST_USED)
        self.jerk = self._jerk(whole)
        self.scene = self._felt()
        self.known = known_rows(self.scene, self.columns, self.origin, self.jerk)

    def _felt(self) -> Scene:
        """Return the scene with what accelerometers and height sensors are off by, as their residuals have it."""
        heights = self.scene.heights.weighed(self.known.of("height", self.state))
        off = self.known.of("force", self.state)
        if not len(off):
            return replace(self.scene, heights=heights)
        factor = FELT * robust_spread(off, 0.0)
        sensed = {
            body: replace(some, std_m_s2=float(np.clip(some.std_m_s2 * factor, *FORCES_M_S2)))
            for body, some in self.scene.inertial.items()
        }
        return replace(self.scene, inertial=sensed, heights=heights)

    def _used(self, whole: Factored, local: csr_array[Any], informed: Floats) -> float:
        probes = np.random.default_rng(0).choice([-1.0, 1.0], (len(informed), PROBES))
        root = np.sqrt(informed)[:, None] * probes
        return float(np.sum(root * (local @ whole.inverse_on(local.T @ root)))) / PROBES / len(informed)

    def _jerk(self, whole: Factored) -> float:
        """Return the jerk that trajectories have (Fellner and Schall's fixed point)."""
        rows = smoothness_rows(self.columns, len(self.scene.moving), self.jerk)
        count = rows.shape[0]
        probes = np.random.default_rng(1).choice([-1.0, 1.0], (count, PROBES))
        kept = float(np.sum(probes * (rows @ whole.inverse_on(rows.T @ probes)))) / PROBES
        square = float(np.sum((rows @ self.state.local) ** 2)) * self.jerk**2
        return float(np.clip(np.sqrt(square / max(count - kept, 0.02 * count)), *JERKS_M_S3))

    def mixture(self) -> PairMixture:
        """Fit what errors are made of, at these trajectories."""
        columns = self.columns.design
        error = self.rows.error - self.rows.distances(self.state)
        return mixture_of(self.problem, error, self.state.border[:columns], self.ridge[:columns, :columns])

    def expected(self, loss: RangeLoss, mixture: PairMixture | None) -> Floats:
        """Return what ranges are expected to say (n,): squared scores, averaged over a pair's ranges at a power."""
        residual = self.rows.residuals(self.state)
        slope, _ = loss.slopes(residual)
        if mixture is None:
            return np.full(len(slope), loss.known(residual / math.sqrt(1 - self.used)))
        place = mixture.scores.places_given()
        count = np.bincount(place)
        mean = np.bincount(place, slope**2) / np.maximum(count, 1)
        # A place with few ranges has the average of all.
        overall = float(np.mean(slope**2))
        return np.asarray(((count * mean + 20 * overall) / (count + 20))[place])

    def found(self, loss: RangeLoss, mixture: PairMixture | None) -> Climbed:
        """Return what was found."""
        return Climbed(
            scene=self.scene,
            columns=self.columns,
            rows=self.rows,
            known=self.known,
            state=self.state,
            loss=loss,
            mixture=mixture,
            ridge=self.ridge,
            informed=self.expected(loss, mixture),
            jerk_m_s3=self.jerk,
            used=self.used,
            steps=self.steps,
            settled=self.settled,
        )


def smoothness_rows(columns: Columns, bodies: int, jerk_m_s3: float) -> csr_array[Any]:
    """Return the rows that hold jerks of all bodies, over their standard error."""
    from scipy.sparse import csr_array

    blocks = [smoothness(columns, body, axis, jerk_m_s3) for body in range(bodies) for axis in range(3)]
    column = np.concatenate([block.column for block in blocks])
    value = np.concatenate([block.value / block.std[:, None] for block in blocks])
    starts = np.arange(len(column) + 1) * column.shape[1]
    return csr_array((value.ravel(), column.ravel(), starts), shape=(len(column), columns.size))


def _widened(penalty: Floats, size: int) -> Floats:
    found = np.zeros((size, size))
    found[: len(penalty), : len(penalty)] = penalty
    return found
