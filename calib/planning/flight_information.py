"""Prediction for a planned flight: Fisher's information at the planned trajectories.

It is the information of `calib fit --truth ranges`: the same unknowns and the same rows, without data. Only the error
model is assumed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calib.data.sources import Data
from calib.errors import UnanswerableError
from calib.estimator.inverse import inverse_of
from calib.estimator.optimize import EVIDENCE_STEPS
from calib.estimator.range_model import RangeModel
from calib.estimator.range_rows import RESIDUAL, RangeRows
from calib.estimator.rows import sum_rows
from calib.estimator.unknowns import Layout, Priors
from calib.range_errors.densities import error_slopes
from calib.settings import FitSettings, FlightSettings
from calib.trajectories.fitting import range_model, variance_factor, verdict_on, with_known_distances
from calib.trajectories.motion import LEAST_JERK, Distances, Motion, known_rows
from calib.trajectories.samples import SAMPLE_S, tapes_of
from calib.trajectories.scene import Scene, scene_from
from calib.trajectories.start import Trajectories, interpolated
from uwblink.arrays import Floats
from uwblink.recording.schema import KnownDistance

TYPICAL_CURVE_M, CURVE_BENDS = 0.05, 3.0
"""Amplitude (m) and phase over the power range (rad) of a typical bias curve, which sets the smoothness that a fit will
estimate."""

ENDS = 4
"""Control points at either end of a path that planned positions do not determine well."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedErrors:
    """The expected errors of ranges: noise, and a share of reflections that are longer by `detour_m` on average.

    It is an error density (`calib.estimator.range_rows.Errors`) with residuals of zero and the mean information of a
    range.
    """

    noise_m: float
    reflected: float
    detour_m: float = 0.3
    parameters: tuple[str, ...] = ()

    def slopes(self, values: dict[str, Floats]) -> tuple[Floats, dict[str, Floats], Floats]:
        """Return log densities and slopes of zero, and the information of each residual (n,)."""
        zero = np.zeros_like(values[RESIDUAL])
        return zero, {RESIDUAL: zero}, zero + self.informed()

    def informed(self) -> float:
        """Return the information of a range on its distance, 1/m^2: the mean squared slope of the log likelihood."""
        longest = 12 * self.detour_m if self.reflected else 0.0
        error = np.linspace(-8 * self.noise_m, 8 * self.noise_m + longest, 4001)
        share, none = max(self.reflected, 1e-9), np.exp(-30.0)
        sizes = {
            "noise": self.noise_m,
            "odds": share / (1 - share),
            "detour": self.detour_m,
            "least": 1e-3,
            "outliers": none,
            "long": none,
        }
        found = error_slopes(error, {name: np.log([value]) for name, value in sizes.items()})
        weight = np.exp(found.log_density)
        return float(weight @ found.by[RESIDUAL] ** 2 / weight.sum())


@dataclass(frozen=True, kw_only=True)
class PlannedFlight:
    """A planned flight: the inputs of a fit (`scene`), true positions, and the model of ranges.

    `path` has the positions of moving bodies, `stands` those of standing bodies.
    """

    scene: Scene
    model: RangeModel
    errors: ExpectedErrors
    path: Trajectories
    stands: Mapping[str, Floats]

    @property
    def tapes(self) -> list[tuple[int, int]]:
        """The pairs of tags whose distance is taped."""
        return [(one.first, one.second) for one in self.scene.tapes.stated]

    def taped(self, pairs: Sequence[tuple[int, int]], still_s: float, sigma_m: float) -> PlannedFlight:
        """Return the flight with taped distances, of bodies that stand at first or of anchors."""
        when = f"0..{still_s:g}" if still_s else ""
        stated = [KnownDistance(first, second, 1.0, sigma_m, when) for first, second in pairs]
        bodies = {tag: body for tag, (body, _) in self.scene.arms.items()}
        tapes = tapes_of(stated, (), bodies, self.scene.still, 0, float(self.scene.time_s[-1]))
        return replace(self, scene=replace(self.scene, tapes=tapes))


def flight_of(
    data: Data, settings: FlightSettings, errors: ExpectedErrors, *, curve: bool, force_std_m_s2: float | None
) -> PlannedFlight:
    """Return a planned flight from a recording with poses over the whole flight.

    `force_std_m_s2` is the standard error of an accelerometer's mean over a tenth of a second; None without one. Raises
    what `scene_from` and `RangeModel.of` raise.
    """
    truth = scene_from(data, FlightSettings(attitudes="poses", heading_std_deg=0.0), need_power=curve)
    scene = scene_from(data, settings, need_power=curve)
    model, scene = range_model(scene, FitSettings(), curve=curve, offsets=False)
    for number, name in enumerate(truth.moving):
        if np.count_nonzero(truth.places.body == number) < 2:
            raise UnanswerableError(f"{truth.source}: no positions of body {name}; a plan takes its motion from them")
    # True attitudes, with the errors that a fit will assume.
    attitudes = {
        body: replace(known, time_s=truth.attitudes[body].time_s, quaternion=truth.attitudes[body].quaternion)
        for body, known in scene.attitudes.items()
        if body in truth.attitudes
    }
    sensed = {} if force_std_m_s2 is None else truth.inertial
    inertial = {body: replace(some, std_m_s2=float(force_std_m_s2 or 0.0)) for body, some in sensed.items()}
    times = truth.places.time_s
    return PlannedFlight(
        scene=replace(scene, attitudes=attitudes, inertial=inertial),
        model=model,
        errors=errors,
        path=interpolated(
            truth.places, np.arange(times.min(), times.max() + SAMPLE_S / 2, SAMPLE_S), len(truth.moving)
        ),
        stands={body: place for body, place in truth.still.items() if place is not None},
    )


class Information:
    """The information on a flight's unknowns at its planned trajectories.

    `covariance_ns2` (tags, tags) is that of the delays of `tags`, `verdict` says which of them are determined.
    """

    def __init__(self, flight: PlannedFlight) -> None:
        """Sum the information of all rows at the planned trajectories."""
        scene, model = flight.scene, flight.model
        self.flight, self.motion, self.tags = flight, Motion.of(scene), tuple(model.tags)
        stand = np.array([flight.stands[body] for body in scene.sought]).reshape(-1, 3)
        start = flight.path.state(scene, stand)
        self.jerk_m_s3 = _jerk(start["path"], self.motion.places.step_s)
        motion = self.motion.unknowns(start, self.jerk_m_s3)
        fixed = [replace(one, priors=tuple(replace(prior, bounds=None) for prior in one.priors)) for one in motion]
        self.layout = Layout((*model.unknowns, *fixed))
        self.x = self.layout.start()
        knots = np.zeros(0) if model.curve is None else model.curve.knots
        for kind in model.curve_kinds():
            centres = np.convolve(knots[1:-1], np.full(3, 1 / 3), mode="valid")
            self.x[self.layout.where[kind]] = TYPICAL_CURVE_M * np.sin(CURVE_BENDS * centres)
        geometry = Distances.of(self.motion, self.layout, (model.ranges.initiator, model.ranges.target), scene.time_s)
        raw = np.zeros(len(scene.time_s))
        ranges = RangeRows.of(raw, model.key(), model.parts, flight.errors, self.layout, geometry)
        of_ranges = sum_rows([ranges, *model.gauge_rows(self.layout)], self.x).information
        beside = sum_rows(list(known_rows(self.motion, self.layout).values()), self.x).information
        priors, self.delays = Priors(self.layout), self.layout.indices(["delay"])
        for _ in range(EVIDENCE_STEPS):
            known = of_ranges + beside + priors.precision()
            self.covariance = inverse_of(known, self.layout.free())
            priors.update(self.x, self.covariance)
        with_truth = with_known_distances(of_ranges + priors.precision(), self.layout, self.delays)
        self.covariance_ns2 = self.covariance[:, self.delays][self.delays] * variance_factor(scene)
        self.verdict = verdict_on(self.covariance_ns2, with_truth, self.tags)

    def best_tape(self, still_s: float, sigma_m: float) -> tuple[int, int] | None:
        """Return the pair of tags whose taped distance reduces the variance of the delays most; None if none does.

        Only distances between bodies that stand at unknown positions add information.
        """
        scene = self.flight.scene
        stand = set(scene.sought) | (set(scene.moving) if still_s else set())
        body = {tag: one for tag, (one, _) in scene.arms.items() if one in stand}
        pairs = [(a, b) for a, b in combinations(sorted(body), 2) if body[a] != body[b]]
        pairs = [pair for pair in pairs if pair not in self.flight.tapes]
        if not pairs:
            return None
        rows = np.zeros((len(pairs), self.layout.size))
        for row, pair in zip(rows, pairs, strict=True):
            tapes = self.flight.taped([pair], still_s, sigma_m).scene.tapes
            time_s = np.nan_to_num(tapes.time_s, nan=scene.time_s[0])
            geometry = Distances.of(self.motion, self.layout, (tapes.first, tapes.second), time_s)
            moved = geometry.distances(self.x)[1]
            np.add.at(row, geometry.columns, moved / len(moved))
        reach = self.covariance @ rows.T
        gain = np.sum(reach[self.delays] ** 2, axis=0) / (np.einsum("kp,pk->k", rows, reach) + sigma_m**2)
        # Rounded, so that of equal pairs every machine takes the first.
        return pairs[int(np.argmax(np.round(gain, 9)))]


def _jerk(points: Floats, step_s: float) -> float:
    """Return the jerk that paths by control points (k, bodies, 3) have, root mean square, away from their ends."""
    inner = points[ENDS:-ENDS] if len(points) > 3 * ENDS else points
    jerk = np.diff(inner, n=3, axis=0) / step_s**3
    return max(float(np.sqrt(np.mean(jerk**2))), LEAST_JERK)
