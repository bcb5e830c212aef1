"""Plans of flights: the precision of delays that are fitted with trajectories, and the gain of further measurements.

The precision is Fisher's information of `calib fit --truth ranges` at the planned trajectories: the same unknowns and
the same rows, without data. Only the error model is assumed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from calib.data.sources import Data
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.inverse import inverse_of
from calib.estimator.optimize import MOST_STEPS, SETTLED
from calib.estimator.range_model import RangeModel
from calib.estimator.range_rows import RESIDUAL, RangeInformation
from calib.estimator.rows import sum_rows
from calib.estimator.unknowns import Priors
from calib.evaluation.filters import IMUS
from calib.planning.reference_motion import reference_motion
from calib.planning.result import FlightPlan, NextBest, mean_std_ns
from calib.planning.settings import FlightPlanSettings
from calib.range_errors.densities import error_slopes
from calib.settings import FitSettings, FlightSettings
from calib.spread import TWO_SIDED_95
from calib.trajectories.fitting import range_model, variance_factor, verdict_on
from calib.trajectories.motion import LEAST_JERK, Distances, Motion, known_rows
from calib.trajectories.samples import SAMPLE_S, TRUSTED, tapes_of
from calib.trajectories.scene import Scene, scene_from
from calib.trajectories.start import Trajectories, interpolated
from uwblink.arrays import Floats
from uwblink.recording.schema import KnownDistance


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
    dispersion: float = 1.0

    def slopes(self, values: dict[str, Floats]) -> tuple[Floats, dict[str, Floats], RangeInformation]:
        """Return log densities and slopes of zero, and the information of each residual."""
        zero = np.zeros_like(values[RESIDUAL])
        return zero, {RESIDUAL: zero}, RangeInformation(residual=zero + self.informed())

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
    model, scene = range_model(scene, FitSettings(), curve=curve, offsets=())
    for number, name in enumerate(truth.moving):
        if np.count_nonzero(truth.places.body == number) < 2:
            raise UnanswerableError(f"{truth.source}: no positions of body {name}, which a plan needs for its motion")
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

    `covariance_ns2` (tags, tags) is the covariance of the delays of `tags`; `verdict` states which are determined.
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
        self.layout, rows = model.build(np.zeros(len(scene.time_s)), flight.errors, fixed)
        self.x = self.layout.start()
        knots = np.zeros(0) if model.curve is None else model.curve.knots
        for kind in model.curve_kinds():
            centres = np.convolve(knots[1:-1], np.full(3, 1 / 3), mode="valid")
            # A typical bias curve has 5 cm and 3 rad over the range of powers; it determines the estimated smoothness.
            self.x[self.layout.where[kind]] = 0.05 * np.sin(3.0 * centres)
        ranges = replace(rows, geometry=Distances.of_ranges(self.motion, self.layout))
        of_ranges = sum_rows([ranges, *model.gauge_rows(self.layout)], self.x).information
        beside = sum_rows(list(known_rows(self.motion, self.layout).values()), self.x).information
        priors, self.delays = Priors(self.layout), self.layout.indices(["delay"])
        for _ in range(MOST_STEPS):
            known = of_ranges + beside + priors.precision()
            self.covariance = inverse_of(known, self.layout.free())
            if priors.update(self.x, self.covariance) < SETTLED:
                break
        self.covariance_ns2 = self.covariance[:, self.delays][self.delays] * variance_factor(scene)
        # Splits of tags that no range determines are zero, as in a fit: known distances would not determine them.
        held = sum_rows(model.held_rows(self.layout), self.x).information
        known = of_ranges + held + priors.precision()
        self.verdict = verdict_on(self.covariance_ns2, known, self.layout, self.delays, self.tags)

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
        tapes = self.flight.taped(pairs, still_s, sigma_m).scene.tapes
        time_s = np.nan_to_num(tapes.time_s, nan=scene.time_s[0])
        geometry = Distances.of(self.motion, self.layout, (tapes.first, tapes.second), time_s)
        moved = geometry.distances(self.x)[1] / np.bincount(tapes.number)[tapes.number, None]
        np.add.at(rows, (tapes.number[:, None], geometry.columns), moved)
        reach = self.covariance @ rows.T
        gain = np.sum(reach[self.delays] ** 2, axis=0) / (np.einsum("kp,pk->k", rows, reach) + sigma_m**2)
        # Gains are rounded, so that every machine chooses the first of equal pairs.
        return pairs[int(np.argmax(np.round(gain, 9)))]


def _jerk(points: Floats, step_s: float) -> float:
    """Return the root mean square jerk of paths with control points (k, bodies, 3), without their ends."""
    # Planned positions hardly determine the four control points at either end.
    inner = points[4:-4] if len(points) > 12 else points
    jerk = np.diff(inner, n=3, axis=0) / step_s**3
    return max(float(np.sqrt(np.mean(jerk**2))), LEAST_JERK)


Robots = int | Sequence[Sequence[int]]


def plan_flight(robots: Robots | Data, settings: FlightPlanSettings | None = None, **changes: Any) -> FlightPlan:
    """Plan a flight for `fit_from_ranges`: the expected accuracy of the delays, and the gain of further measurements.

    `robots` is the number of robots with two tags each, or the ids of the tags of each; or a recording of a flight
    with poses throughout (simulated, or an earlier flight), which gives motion, lever arms and powers. `settings` and
    keyword arguments named like its fields (`FlightPlanSettings`, which explains them) state what will be measured.

    Raises `BadInputError` for impossible robots or settings, and `UnanswerableError` for a recording that no fit could
    use.

    >>> import calib
    >>> plan = calib.plan_flight(3, seconds=20.0)
    >>> plan.undetermined, len(plan.half_ns)
    ((), 6)
    """
    data = None if isinstance(robots, int | Sequence) and not isinstance(robots, str) else robots
    asked = replace(settings or FlightPlanSettings(), robots=robots if data is None else None, **changes)
    with threadpool_limits(limits=1, user_api="blas"):
        found = _information(asked, data)
        next_best = sorted(_more(asked, data, found), key=lambda one: one.mean_ns)
    flight, std = found.flight, found.verdict.std
    which = np.isfinite(std) | ~np.isfinite(std).any()
    covariance = found.covariance_ns2[np.ix_(which, which)]
    common = covariance.mean()
    every = TWO_SIDED_95 * np.sqrt(np.diag(found.covariance_ns2))
    return FlightPlan(
        settings=asked,
        reflected=asked.reflected,
        ranges=len(flight.scene.time_s),
        seconds=float(np.ptp(flight.scene.time_s)),
        source=flight.scene.source,
        half_ns=dict(zip(found.tags, (TWO_SIDED_95 * std).tolist(), strict=True)),
        open_ns=dict(zip(found.tags, every.tolist(), strict=True)),
        common_ns=TWO_SIDED_95 * math.sqrt(common),
        apart_ns=TWO_SIDED_95 * math.sqrt(np.trace(covariance) / len(covariance) - common),
        verdict=found.verdict,
        next_best=tuple(next_best),
        taped=tuple(flight.tapes),
        path_m=flight.path.position_m,
        stands=dict(flight.stands),
        bodies=flight.scene.moving,
    )


def _information(asked: FlightPlanSettings, data: Data | None) -> Information:
    """Return the information of a recorded flight, or of robots that fly in a room, with the requested number of taped
    distances.
    """
    force_std_m_s2 = (
        None
        if asked.imu is None
        # The second part is the vibration that a mean retains (m/s^2): a judgement, because a fit weights by residuals.
        else TRUSTED * math.hypot(IMUS[asked.imu].force / math.sqrt(SAMPLE_S), 0.2)
    )
    flight = flight_of(
        reference_motion(asked) if data is None else data,
        FlightSettings(
            poses_until_s=asked.poses_until_s,
            attitudes=asked.attitudes,
            heading_std_deg=asked.heading_std_deg,
            anchors=asked.anchor_places,
        ),
        ExpectedErrors(noise_m=asked.noise_m, reflected=asked.reflected),
        curve=not asked.delays_only,
        force_std_m_s2=force_std_m_s2,
    )
    found = Information(flight)
    for count in range(asked.taped):
        best = found.best_tape(asked.still_s, asked.tape_sigma_m)
        if best is None:
            raise BadInputError(
                f"only {count} distances can be measured: between robots while they stand still (`still_s`), and "
                f"between anchors whose positions are sought",
                parameter="taped",
            )
        found = Information(flight.taped([*found.flight.tapes, best], asked.still_s, asked.tape_sigma_m))
    return found


def _mean_ns(covariance: Floats) -> float:
    """Return the root mean square half interval of the delays with the prior of `mean_std_ns`."""
    return TWO_SIDED_95 * mean_std_ns(np.asarray(np.linalg.pinv(covariance, hermitian=True), np.float64))


def _more(asked: FlightPlanSettings, data: Data | None, found: Information) -> Iterator[NextBest]:
    """Yield the gain of single further measurements, for the same tags."""
    now = _mean_ns(found.covariance_ns2)
    for what, changes in _changes(asked, found.flight):
        # Invalid changes are not proposed.
        with suppress(BadInputError):
            changed = _information(replace(asked, **changes), data)
            same = [changed.tags.index(tag) for tag in found.tags]
            mean = _mean_ns(changed.covariance_ns2[np.ix_(same, same)])
            if mean < now:
                yield NextBest(what.format(*changed.flight.tapes[-1:]), mean, now)
    # Another calibration or a survey finds the delay of a tag to 41 to 94 ps (`make surveys`).
    c, other_ns = found.covariance_ns2, 0.05
    means = [_mean_ns(c - np.outer(c[k], c[k]) / (c[k, k] + other_ns**2)) for k in range(len(c))]
    best = int(np.argmin(np.round(means, 6)))
    yield NextBest(
        f"the delay of tag {found.tags[best]} known to {other_ns:g} ns from another calibration", means[best], now
    )


def _changes(asked: FlightPlanSettings, flight: PlannedFlight) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield additional measurements in words, with the changed settings.

    The words have fields for both tags of the last taped distance.
    """
    # Standstill, number of anchors and error of headings that a team can achieve without other equipment, and ten more
    # seconds of known positions.
    stands_s, more_anchors, heading_deg = 5.0, 4, 0.5
    longer, poses = (asked.poses_until_s or 0.0) + 10.0, asked.attitudes == "poses"
    free, given = asked.robots is not None, {"anchor_places": "given"}
    tags = [*(tag for robot in asked.robots or () for tag in robot), *asked.anchors]
    one, four = (
        given | {"anchors": (*asked.anchors, *range(max(tags, default=0) + 1, max(tags, default=0) + 1 + more))}
        for more in (1, more_anchors)
    )
    standing = f"robots that stand still for the first {stands_s:g} s, with a measured distance of two of their tags"
    tape = {"taped": asked.taped + 1}
    rows: list[tuple[bool, str, dict[str, Any]]] = [
        (
            longer < float(flight.scene.time_s[-1]),
            f"positions known for the first {longer:g} s",
            {"poses_until_s": longer},
        ),
        (True, "a measured distance of tags {0[0]} and {0[1]}", tape),
        (bool(flight.scene.sought), "measured positions of the anchors", given),
        (
            poses and asked.heading_std_deg > heading_deg,
            f"headings with errors of {heading_deg:g} degrees",
            {"heading_std_deg": heading_deg},
        ),
        (free and not asked.still_s, standing, tape | {"still_s": stands_s}),
        (free, f"a flight of {2 * asked.seconds:g} s", {"seconds": 2 * asked.seconds}),
        (free and not asked.anchors, f"{more_anchors} anchors at known positions", four),
        (
            free and bool(asked.anchors) and asked.anchor_places == "given",
            "one more anchor at a known position",
            one,
        ),
        (free and poses and asked.imu is None, "inertial readings", {"imu": "consumer"}),
    ]
    yield from ((what, changes) for useful, what, changes in rows if useful)
