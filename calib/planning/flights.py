"""Plans of flights: how well delays will be known when distances are found together with them, and what brings more."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np
from threadpoolctl import threadpool_limits

from calib.data.sources import Data
from calib.errors import BadInputError
from calib.planning.flight_information import Errors, Flight, Predicted, flight_of
from calib.planning.flight_result import FlightPlan
from calib.planning.reference_motion import FlightInputs, flight_inputs, reference_motion
from calib.planning.result import NextBest
from calib.settings import check_choice
from calib.spread import TWO_SIDED_95
from calib.trajectories.fitting import ANCHORS, usable_of
from calib.trajectories.scene import Usable
from uwblink.arrays import Floats

GUESS_NS = 1.5
"""How far a delay is known without any data, for means over tags of which some are not determined."""

MORE_KNOWN_S = 10.0
MORE_ANCHORS = 4
STANDS_S = 5.0
MOST_TAPED = 10
HEADING_DEG = 0.5
DELAY_STD_NS = 0.05
"""How well another calibration, or a survey, says the delay of one tag."""

ACCELEROMETERS = {"consumer": 3e-3, "industrial": 1e-3, "tactical": 3e-4}
"""Noise in m/s^2 a root of Hz, orders of magnitude of data sheets."""

VIBRATION_M_S2 = 0.2
"""What propellers leave of their shaking in a mean over a tenth of a second."""

WINDOW_S = 0.1
TRUSTED = 3.0
"""By how much less a fit trusts an accelerometer than its residuals say."""

Robots = int | Sequence[Sequence[int]]


def plan_flight(  # noqa: PLR0913 - what somebody may have, each with its default
    robots: Robots | Data,
    *,
    seconds: float = 60.0,
    rate_hz: float = 80.0,
    size_m: Sequence[float] = (6.0, 5.0, 2.5),
    speed_m_s: float = 1.0,
    apart_m: float = 0.5,
    poses_until_s: float = 10.0,
    attitudes: str = "poses",
    heading_std_deg: float = 3.0,
    imu: str | None = None,
    anchors: Sequence[int] = (),
    anchor_places: str = "given",
    still_s: float = 0.0,
    taped: int = 0,
    tape_sigma_m: float = 0.01,
    noise_m: float = 0.04,
    reflected: float = 0.08,
    delays_only: bool = False,
    seed: int = 1,
) -> FlightPlan:
    """Return how well `fit_from_ranges` will know the delays of a flight, and what one more measurement would bring.

    `robots` is how many there are, with two tags each, or the ids of the tags of each; or a recording of a flight with
    poses all along (a simulated one, or an earlier one), from which motion, lever arms and powers are taken. Without a
    recording robots fly for `seconds` about a room of `size_m` at about `speed_m_s`, tags of a robot are `apart_m` from
    each other, and all pairs but those of two `anchors` (ids of tags about the walls) range in turn, `rate_hz` times a
    second. Robots stand for the first `still_s`.

    Positions will be known for the first `poses_until_s`; `attitudes` come from "poses" (an attitude reference) or the
    "imu", whose grade is "consumer", "industrial" or "tactical"; places of anchors are "given" or "sought". `taped`
    distances are measured to `tape_sigma_m` where they bring most: of tags of robots that stand, and of anchors whose
    places are sought. A range has `noise_m`, and a share `reflected` is longer by 0.3 m on average.

    Raises `BadInputError` for what cannot be, and `UnanswerableError` for a recording that no fit could use.

    >>> import calib
    >>> plan = calib.plan_flight(3, seconds=20.0)
    >>> plan.undetermined, len(plan.half_ns)
    ((), 6)
    """
    check_choice("anchor_places", anchor_places, ANCHORS)
    usable = usable_of(poses_until_s, attitudes, heading_std_deg, anchor_places, (), "used")
    for name, value, least, most in (
        ("noise_m", noise_m, 1e-4, 10.0),
        ("reflected", reflected, 0.0, 0.9),
        ("still_s", still_s, 0.0, 600.0),
        ("taped", taped, 0, MOST_TAPED),
        ("tape_sigma_m", tape_sigma_m, 1e-4, 1.0),
    ):
        if not (math.isfinite(value) and least <= value <= most):
            raise BadInputError(f"found {value}, expected {least:g} to {most:g}", parameter=name)
    if imu is not None and imu not in ACCELEROMETERS:
        raise BadInputError(f"found {imu!r:.40}, allowed: {', '.join(ACCELEROMETERS)}", parameter="imu")
    asked = _Asked(
        usable=usable,
        errors=Errors(noise_m=noise_m, reflected=reflected),
        curve=not delays_only,
        imu=imu,
        still_s=still_s,
        taped=taped,
        tape_sigma_m=tape_sigma_m,
    )
    # As in a fit; SciPy brings a linear algebra of its own, which must be there to be held.
    import_module("scipy.linalg")
    with threadpool_limits(limits=1, user_api="blas"):
        if not isinstance(robots, int | Sequence) or isinstance(robots, str):
            return _promise(asked, asked.flight(robots), None)
        flown = flight_inputs(
            robots,
            anchors,
            seconds=seconds,
            rate_hz=rate_hz,
            size_m=size_m,
            speed_m_s=speed_m_s,
            apart_m=apart_m,
            still_s=still_s,
            inertial=imu is not None or attitudes == "imu",
            seed=seed,
        )
        return _promise(asked, asked.flight(reference_motion(flown)), flown)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Asked:
    """What a fit will be given."""

    usable: Usable
    errors: Errors
    curve: bool
    imu: str | None
    still_s: float
    taped: int
    tape_sigma_m: float

    def flight(self, data: Data) -> Flight:
        """Return the flight of a recording, or of what one would hold."""
        force = None
        if self.imu is not None:
            force = TRUSTED * math.hypot(ACCELEROMETERS[self.imu] / math.sqrt(WINDOW_S), VIBRATION_M_S2)
        flight = flight_of(data, self.usable, self.errors, curve=self.curve, force_std_m_s2=force)
        for _ in range(self.taped):
            flight = self.with_tape(flight) or flight
        if len(flight.tapes) < self.taped:
            raise BadInputError(
                f"only {len(flight.tapes)} can be measured: of robots while they stand (`still_s`), and of anchors "
                "whose places are sought",
                parameter="taped",
            )
        return flight

    def with_tape(self, flight: Flight) -> Flight | None:
        """Return the flight with one distance more, the best one; None where there is none."""
        best = flight.best_tape(self.still_s, self.tape_sigma_m)
        return best and flight.taped([*flight.tapes, best], self.still_s, self.tape_sigma_m)


def _promise(asked: _Asked, flight: Flight, flown: FlightInputs | None) -> FlightPlan:
    found = flight.predicted()
    std = found.verdict.std
    known = np.isfinite(std)
    which = known if known.any() else np.ones(len(std), dtype=bool)
    covariance = found.covariance_ns2[np.ix_(which, which)]
    count = len(covariance)
    common = np.full(count, 1 / count)
    apart = np.eye(count) - 1 / count
    return FlightPlan(
        flown=flown,
        usable=asked.usable,
        imu=asked.imu,
        noise_m=asked.errors.noise_m,
        reflected=asked.errors.reflected,
        ranges=len(flight.scene.time_s),
        seconds=float(np.ptp(flight.scene.time_s)),
        source=flight.scene.source,
        half_ns={tag: TWO_SIDED_95 * float(s) for tag, s in zip(found.tags, std, strict=True)},
        open_ns={
            tag: TWO_SIDED_95 * math.sqrt(v)
            for tag, v in zip(found.tags, np.diag(found.covariance_ns2).tolist(), strict=True)
        },
        common_ns=TWO_SIDED_95 * math.sqrt(float(common @ covariance @ common)),
        apart_ns=TWO_SIDED_95 * math.sqrt(float(np.trace(apart @ covariance @ apart)) / count),
        verdict=found.verdict,
        next_best=tuple(sorted(_more(asked, flight, flown, found), key=lambda one: one.mean_ns)),
        taped=tuple(flight.tapes),
        still_s=asked.still_s,
        path_m=flight.path.position_m,
        stands=dict(flight.stands),
        bodies=flight.scene.moving,
    )


def _mean_ns(covariance: Floats) -> float:
    """Return the root mean square of half intervals, of which each is known to `GUESS_NS` at worst."""
    information = np.linalg.pinv(covariance, hermitian=True) + np.eye(len(covariance)) / GUESS_NS**2
    return TWO_SIDED_95 * float(np.sqrt(np.trace(np.linalg.inv(information)) / len(covariance)))


def _more(asked: _Asked, flight: Flight, flown: FlightInputs | None, found: Predicted) -> Iterator[NextBest]:
    """Yield what one thing more would bring; intervals are of the same tags."""
    now = _mean_ns(found.covariance_ns2)
    for what, changed in (*_better_known(asked, flight), *_flown_otherwise(asked, flown)):
        with_it = changed().predicted()
        same = [with_it.tags.index(tag) for tag in found.tags]
        mean = _mean_ns(with_it.covariance_ns2[np.ix_(same, same)])
        if mean < now:
            yield NextBest(what, mean, now)
    tag, mean = _one_delay(found)
    yield NextBest(f"the delay of tag {tag} from elsewhere, to {DELAY_STD_NS:g} ns", mean, now)


Change = tuple[str, Callable[[], Flight]]


def _better_known(asked: _Asked, flight: Flight) -> Iterator[Change]:
    """Yield what might be known better of the same flight."""
    usable = asked.usable
    longer = (usable.poses_until_s or 0.0) + MORE_KNOWN_S
    if longer < float(flight.scene.time_s[-1]):
        yield f"positions known for the first {longer:g} s", lambda: flight.known_until(longer)
    taped = asked.with_tape(flight)
    if taped:
        first, second = taped.tapes[-1]
        yield f"the distance of tags {first} and {second} by tape", lambda: taped
    if flight.scene.sought:
        yield "the places of the anchors, measured", flight.with_anchors_given
    if usable.attitudes == "poses" and usable.heading_std_deg > HEADING_DEG:
        better = math.radians(HEADING_DEG)
        yield f"headings good to {HEADING_DEG:g} degrees", lambda: flight.with_headings(better)


def _flown_otherwise(asked: _Asked, flown: FlightInputs | None) -> Iterator[Change]:
    """Yield other flights."""
    if flown is None:
        return
    if not asked.still_s:
        stands = replace(asked, still_s=STANDS_S, taped=asked.taped + 1)
        text = f"robots that stand for the first {STANDS_S:g} s, and the distance of two of their tags by tape"
        yield text, lambda: stands.flight(reference_motion(replace(flown, still_s=STANDS_S)))
    longer = replace(flown, seconds=2 * flown.seconds)
    yield f"a flight of {longer.seconds:g} s", lambda: asked.flight(reference_motion(longer))
    if not flown.anchors:
        four = replace(flown, anchors=_fresh(flown, MORE_ANCHORS))
        fixed = replace(asked, usable=replace(asked.usable, anchors="given"))
        yield f"{MORE_ANCHORS} anchors at known places", lambda: fixed.flight(reference_motion(four))
    elif asked.usable.anchors == "given":
        more = replace(flown, anchors=(*flown.anchors, *_fresh(flown, 1)))
        yield "one anchor more at a known place", lambda: asked.flight(reference_motion(more))
    if asked.imu is None and asked.usable.attitudes == "poses":
        sensed = replace(asked, imu="consumer")
        yield "inertial readings", lambda: sensed.flight(reference_motion(replace(flown, inertial=True)))


def _fresh(flown: FlightInputs, count: int) -> tuple[int, ...]:
    last = max(*(tag for robot in flown.robots for tag in robot), *flown.anchors, 0)
    return tuple(range(last + 1, last + 1 + count))


def _one_delay(found: Predicted) -> tuple[int, float]:
    """Return which tag's delay is best known from elsewhere, and the mean half interval with it."""
    c = found.covariance_ns2
    after = [c - np.outer(c[k], c[k]) / (c[k, k] + DELAY_STD_NS**2) for k in range(len(c))]
    means = [_mean_ns(one) for one in after]
    best = int(np.argmin(np.round(means, 6)))
    return found.tags[best], means[best]
