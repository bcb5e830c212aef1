"""What the ranges of a planned flight would say of delays: Fisher's information, at trajectories that are planned.

It is linearised as `calib fit --truth ranges` does: the same control points, the same rows of ranges and of what is
known beside them, the same unknowns of curves, anchors and biases. Only what a fit learns of its errors is assumed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM
from calib.data.sources import Data
from calib.errors import UnanswerableError
from calib.estimation.gauge import stating
from calib.estimation.problem import Problem
from calib.estimation.reflections import Shape, expected
from calib.estimation.robust import QuadraticModel
from calib.estimation.smoothing import reml_penalty
from calib.information import Verdict
from calib.trajectories.arrow import Factored, normal_of
from calib.trajectories.attitudes import Attitude
from calib.trajectories.fitting import Asked, problem_of
from calib.trajectories.given import Usable, scene_from
from calib.trajectories.inertial import Inertial
from calib.trajectories.judging import beyond_linear, verdict_on
from calib.trajectories.known_rows import known_rows
from calib.trajectories.range_rows import range_rows, tape_rows
from calib.trajectories.scene import Places, Scene
from calib.trajectories.starting import SAMPLE_S, Followed, through
from calib.trajectories.tapes import tapes_of
from calib.trajectories.unknowns import Columns, State, columns_of
from uwblink.arrays import Floats
from uwblink.recording.schema import KnownDistance

CURVE_M: Final = 0.05
CURVE_BENDS: Final = 3.0
"""A curve over lifted power as boards have it, for how smooth a fit will find it: so many metres, so many radians."""

EDGE: Final = 4
STEADIEST_M_S3: Final = 0.2
GRID: Final = 4001
ROUNDING: Final = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """What a range will be off by: noise, and a share of reflected ones that are longer by `detour_m` on average."""

    noise_m: float
    reflected: float
    detour_m: float = 0.3

    def informed(self) -> float:
        """Return what a range says of its distance, 1/m^2: its mean squared slope of the log likelihood."""
        longest = 12 * self.detour_m if self.reflected else 0.0
        error = np.linspace(-8 * self.noise_m, 8 * self.noise_m + longest, GRID)
        shape = Shape(
            sigma_m=np.array(self.noise_m),
            tail_share=np.array(self.reflected),
            mean_m=np.array(self.detour_m),
            least_m=1e-3,
            outlier_share=0.0,
            outlier_density=1.0,
        )
        found = expected(error, shape)
        weight = np.exp(found.log_density)
        slope = (found.core * error + found.tail_noise_m) / self.noise_m**2
        return float(weight @ slope**2 / weight.sum())


@dataclass(frozen=True, slots=True, kw_only=True)
class Foreseen:
    """What a fit will say: the covariance (tags, tags) of the delays in ns^2, and the verdict on them."""

    tags: tuple[int, ...]
    covariance_ns2: Floats
    verdict: Verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """A planned flight: what a fit will be given (`scene`), where everything truly is, and what is looked for.

    `path_m` (k, bodies, 3) are the moving bodies at `path_s` (k,), `stands` are all that do not move; `known` are the
    places of moving bodies all along, of which the scene has the first.
    """

    scene: Scene
    problem: Problem
    errors: Errors
    reference: float
    known: Places
    path_s: Floats
    path_m: Floats
    stands: Mapping[str, Floats]

    @property
    def tapes(self) -> list[tuple[int, int]]:
        """The pairs of tags whose distance is measured beside."""
        return [(one.first, one.second) for one in self.scene.tapes.told]

    def known_until(self, seconds: float) -> Flight:
        """Return the flight with positions known so long."""
        return replace(self, scene=replace(self.scene, places=self.known[self.known.time_s < seconds]))

    def with_anchors_given(self) -> Flight:
        """Return the flight with the places of all anchors known."""
        return replace(self, scene=replace(self.scene, still=dict(self.stands)))

    def taped(self, pairs: Sequence[tuple[int, int]], still_s: float, sigma_m: float) -> Flight:
        """Return the flight with distances of tags measured beside, while bodies stand at first or between anchors."""
        when = f"0..{still_s:g}" if still_s else ""
        stated = [KnownDistance(first, second, 1.0, sigma_m, when) for first, second in pairs]
        bodies = {tag: body for tag, (body, _) in self.scene.arms.items()}
        tapes = tapes_of(stated, (), bodies, self.scene.still, 0, float(self.scene.time_s[-1]))
        return replace(self, scene=replace(self.scene, tapes=tapes))

    def pairs_to_tape(self, still_s: float) -> list[tuple[int, int]]:
        """Return the pairs of tags whose distance says something: of bodies that stand where nobody knows."""
        stand = {body for body, place in self.scene.still.items() if place is None}
        stand |= set(self.scene.moving) if still_s else set()
        body = {tag: one for tag, (one, _) in self.scene.arms.items() if one in stand}
        return [(a, b) for a, b in combinations(sorted(body), 2) if body[a] != body[b]]

    def with_headings(self, std_rad: float) -> Flight:
        """Return the flight with headings known so well."""
        better = {
            body: replace(known, std_rad=np.array([*known.std_rad[:2], std_rad]))
            for body, known in self.scene.attitudes.items()
        }
        return replace(self, scene=replace(self.scene, attitudes=better))


def flight_of(data: Data, usable: Usable, errors: Errors, *, curve: bool, force_std_m_s2: float | None) -> Flight:
    """Return a planned flight from what a recording of it would hold, with poses all along.

    `force_std_m_s2` is what an accelerometer's mean over a tenth of a second will be off by; None without one.
    Raises what `scene_from` and `build_problem` raise.
    """
    truth = scene_from(data, Usable(attitudes="poses", heading_std_deg=0.0), need_power=curve)
    asked = Asked(
        usable=usable,
        lift="mean-of-lifted",
        alpha_dbm=ALPHA_DBM,
        fixed={},
        groups={},
        reference_dbm=ALPHA_DBM,
        curve=curve,
    )
    problem, scene = problem_of(scene_from(data, usable, need_power=curve), asked)
    scene = replace(scene, attitudes=_upright(scene, truth), inertial=_sensed(truth, force_std_m_s2))
    path_s, path_m = _path(truth)
    return Flight(
        scene=scene,
        problem=problem,
        errors=errors,
        reference=asked.reference,
        known=truth.places,
        path_s=path_s,
        path_m=path_m,
        stands={body: place for body, place in truth.still.items() if place is not None},
    )


def _upright(scene: Scene, truth: Scene) -> dict[str, Attitude]:
    """Return the attitudes as they truly are, with what will be known of their errors."""
    return {
        body: replace(known, time_s=truth.attitudes[body].time_s, quaternion=truth.attitudes[body].quaternion)
        for body, known in scene.attitudes.items()
        if body in truth.attitudes
    }


def _sensed(truth: Scene, std_m_s2: float | None) -> dict[str, Inertial]:
    if std_m_s2 is None:
        return {}
    return {body: replace(some, std_m_s2=std_m_s2) for body, some in truth.inertial.items()}


def _path(truth: Scene) -> tuple[Floats, Floats]:
    """Return instants (k,) and where the moving bodies are (k, bodies, 3)."""
    known = truth.places
    for number, name in enumerate(truth.moving):
        if np.count_nonzero(known.body == number) < 2:
            raise UnanswerableError(f"{truth.source}: no positions of body {name}; a plan takes its motion from them")
    time = np.arange(float(known.time_s.min()), float(known.time_s.max()) + SAMPLE_S / 2, SAMPLE_S)
    found = np.empty((len(time), len(truth.moving), 3))
    for body in range(len(truth.moving)):
        mine = known.body == body
        for axis in range(3):
            found[:, body, axis] = np.interp(time, known.time_s[mine], known.position_m[mine, axis])
    return time, found


def foresee(flight: Flight) -> Foreseen:
    """Return what a fit of the flight will say of the delays."""
    return Linearised(flight).foreseen()


def best_tape(flight: Flight, still_s: float, sigma_m: float) -> tuple[int, int] | None:
    """Return the pair of tags whose taped distance narrows the delays most; None where none would say anything."""
    pairs = [pair for pair in flight.pairs_to_tape(still_s) if pair not in flight.tapes]
    if not pairs:
        return None
    near = Linearised(flight)
    means = [near.mean_variance_with(near.tape(pair, still_s), sigma_m) for pair in pairs]
    return pairs[int(np.argmin(np.round(means, 9)))]


class Linearised:
    """A flight near its planned trajectories: the arrow of its information, and delays as combinations of unknowns."""

    def __init__(self, flight: Flight) -> None:
        """Linearise at the planned trajectories."""
        scene, problem = flight.scene, flight.problem
        self.flight = flight
        self.columns = columns_of(scene, problem.design.shape[1])
        stand = np.array([flight.stands[body] for body in scene.sought]).reshape(-1, 3)
        self.state = through(scene, self.columns, Followed(flight.path_s, flight.path_m), stand)
        self.design = problem.design.written_out()
        rows = range_rows(scene, self.columns, np.zeros(len(scene.time_s)), self.design)
        _, local, border = rows.linear(self.state)
        self.informed = np.full(len(scene.time_s), flight.errors.informed())
        self.jerk_m_s3 = _jerk(self.columns, self.state)
        known = known_rows(scene, self.columns, self.state, self.jerk_m_s3).linear(self.state)
        self.arrow = Factored(normal_of(local, border, self.informed) + known.normal)
        self.ridge = _ridge(problem, self.arrow.schur)
        self.covariance = _covariance(self.arrow.schur + self.ridge)
        self.delays = problem.directions @ stating(problem, flight.reference)[: problem.rank]

    @property
    def of_delays(self) -> Floats:
        """Return the covariance (tags, tags) of the delays, ns^2."""
        size = self.columns.design
        return np.asarray(self.delays @ self.covariance[:size, :size] @ self.delays.T)

    def foreseen(self) -> Foreseen:
        """Return what a fit will say."""
        problem, size = self.flight.problem, self.columns.design
        of_ranges = (self.design * self.informed[:, None]).T @ self.design + self.ridge[:size, :size]
        with_truth = self.delays @ _covariance(of_ranges) @ self.delays.T
        covariance = beyond_linear(self.of_delays, self.flight.scene)
        return Foreseen(
            tags=tuple(problem.tags), covariance_ns2=covariance, verdict=verdict_on(covariance, with_truth, problem)
        )

    def tape(self, pair: tuple[int, int], still_s: float) -> tuple[Floats, Floats]:
        """Return the derivatives (L,) and (b,) of the distance of two tags, halfway through their standing."""
        taped = self.flight.taped([pair], still_s, 1.0).scene
        _, local, border = tape_rows(taped, self.columns).linear(self.state)
        middle = local.shape[0] // 2
        return local[[middle]].toarray()[0], border[middle]

    def mean_variance_with(self, row: tuple[Floats, Floats], sigma_m: float) -> float:
        """Return the mean variance of the delays, ns^2, when what a row stands for is known to so much."""
        local, border = row
        outer = self.covariance @ (border - self.arrow.reach.T @ local)
        inner = self.arrow.inverse_on(local[:, None])[:, 0] - self.arrow.reach @ outer
        own = float(local @ inner + border @ outer)
        moved = self.delays @ outer[: self.columns.design]
        return float(np.mean(np.diag(self.of_delays) - moved**2 / (own + sigma_m**2)))


def _covariance(information: Floats) -> Floats:
    """Return the inverse of an information matrix; what it hardly says is hardly known, not left out."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    spread = vectors / np.sqrt(np.maximum(values, ROUNDING * float(values[-1])))
    return np.asarray(spread @ spread.T * scale[:, None] * scale)


def _jerk(columns: Columns, state: State) -> float:
    """Return the jerk that trajectories have, root mean square, away from their ends."""
    points = state.local[columns.place]
    inner = points[EDGE:-EDGE] if len(points) > 3 * EDGE else points
    jerk = np.diff(inner, n=3, axis=0) / columns.places.step_s**3
    return max(float(np.sqrt(np.mean(jerk**2))), STEADIEST_M_S3)


def _ridge(problem: Problem, schur: Floats) -> Floats:
    """Return how smooth a fit will find curves to be (b, b), where they are as boards have them."""
    border = len(schur)
    if not problem.unknowns.curve:
        return np.zeros_like(schur)
    penalties = [np.pad(penalty, (0, border - len(penalty))) for penalty in problem.penalties()]
    curve = np.zeros(border)
    for _, columns in problem.curves():
        centres = np.convolve(problem.knots[1:-1], np.full(3, 1 / 3), mode="valid")
        curve[columns] = CURVE_M * np.sin(CURVE_BENDS * centres)
    return reml_penalty(QuadraticModel(schur, np.zeros(border), 1.0), curve, penalties)[0]
