"""Plans of flights: the precision of delays that are fitted with trajectories, and the gain of further measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from calib.data.sources import Data
from calib.errors import BadInputError
from calib.planning.flight_information import Errors, Flight, Predicted, flight_of
from calib.planning.reference_motion import reference_motion
from calib.planning.result import FlightPlan, NextBest, mean_std_ns
from calib.planning.settings import FlightPlanSettings
from calib.settings import FlightSettings
from calib.spread import TWO_SIDED_95
from uwblink.arrays import Floats

MORE_KNOWN_S = 10.0
MORE_ANCHORS = 4
STANDS_S = 5.0
HEADING_DEG = 0.5
DELAY_STD_NS = 0.05
"""Standard error of the delay of one tag from another calibration or a survey."""

ACCELEROMETERS = {"consumer": 3e-3, "industrial": 1e-3, "tactical": 3e-4}
"""Noise in m/s^2 a root of Hz, orders of magnitude of data sheets."""

VIBRATION_M_S2 = 0.2
"""Vibration that is left in a mean over a tenth of a second."""

WINDOW_S = 0.1
TRUSTED = 3.0
"""Factor on the residuals of an accelerometer in a fit."""

Robots = int | Sequence[Sequence[int]]


def plan_flight(robots: Robots | Data, settings: FlightPlanSettings | None = None, **changes: Any) -> FlightPlan:
    """Return how well `fit_from_ranges` will know the delays of a flight, and what one more measurement would bring.

    `robots` is how many there are, with two tags each, or the ids of the tags of each; or a recording of a flight with
    poses all along (a simulated one, or an earlier one), from which motion, lever arms and powers are taken. `settings`
    and keyword arguments named like its fields (`FlightPlanSettings`, which explains them) say what will be measured.

    Raises `BadInputError` for what cannot be, and `UnanswerableError` for a recording that no fit could use.

    >>> import calib
    >>> plan = calib.plan_flight(3, seconds=20.0)
    >>> plan.undetermined, len(plan.half_ns)
    ((), 6)
    """
    data = None if isinstance(robots, int | Sequence) and not isinstance(robots, str) else robots
    asked = replace(settings or FlightPlanSettings(), robots=robots if data is None else None, **changes)
    with threadpool_limits(limits=1, user_api="blas"):
        return _plan(asked, data)


def _flight(asked: FlightPlanSettings, data: Data | None) -> Flight:
    """Return the flight of a recording, or of robots that fly about a room, with as many tapes as are asked for."""
    force = None
    if asked.imu is not None:
        force = TRUSTED * math.hypot(ACCELEROMETERS[asked.imu] / math.sqrt(WINDOW_S), VIBRATION_M_S2)
    flight = flight_of(
        reference_motion(asked) if data is None else data,
        FlightSettings(
            poses_until_s=asked.poses_until_s,
            attitudes=asked.attitudes,
            heading_std_deg=asked.heading_std_deg,
            anchors=asked.anchor_places,
        ),
        Errors(noise_m=asked.noise_m, reflected=asked.reflected),
        curve=not asked.delays_only,
        force_std_m_s2=force,
    )
    for _ in range(asked.taped):
        flight = _with_tape(asked, flight) or flight
    if len(flight.tapes) < asked.taped:
        raise BadInputError(
            f"only {len(flight.tapes)} can be measured: of robots while they stand (`still_s`), and of anchors "
            "whose places are sought",
            parameter="taped",
        )
    return flight


def _with_tape(asked: FlightPlanSettings, flight: Flight) -> Flight | None:
    """Return the flight with the best further taped distance; None if there is none."""
    best = flight.best_tape(asked.still_s, asked.tape_sigma_m)
    return best and flight.taped([*flight.tapes, best], asked.still_s, asked.tape_sigma_m)


def _plan(asked: FlightPlanSettings, data: Data | None) -> FlightPlan:
    flight = _flight(asked, data)
    found = flight.predicted()
    std = found.verdict.std
    known = np.isfinite(std)
    which = known if known.any() else np.ones(len(std), dtype=bool)
    covariance = found.covariance_ns2[np.ix_(which, which)]
    count = len(covariance)
    common = np.full(count, 1 / count)
    apart = np.eye(count) - 1 / count
    every = TWO_SIDED_95 * np.sqrt(np.diag(found.covariance_ns2))
    return FlightPlan(
        settings=asked,
        reflected=asked.reflected,
        ranges=len(flight.scene.time_s),
        seconds=float(np.ptp(flight.scene.time_s)),
        source=flight.scene.source,
        half_ns=dict(zip(found.tags, (TWO_SIDED_95 * std).tolist(), strict=True)),
        open_ns=dict(zip(found.tags, every.tolist(), strict=True)),
        common_ns=TWO_SIDED_95 * math.sqrt(float(common @ covariance @ common)),
        apart_ns=TWO_SIDED_95 * math.sqrt(float(np.trace(apart @ covariance @ apart)) / count),
        verdict=found.verdict,
        next_best=tuple(sorted(_more(asked, flight, found), key=lambda one: one.mean_ns)),
        taped=tuple(flight.tapes),
        path_m=flight.path.position_m,
        stands=dict(flight.stands),
        bodies=flight.scene.moving,
    )


def _mean_ns(covariance: Floats) -> float:
    """Return the root mean square half interval, where each delay has the prior of a guess."""
    return TWO_SIDED_95 * mean_std_ns(np.asarray(np.linalg.pinv(covariance, hermitian=True), np.float64))


def _more(asked: FlightPlanSettings, flight: Flight, found: Predicted) -> Iterator[NextBest]:
    """Yield the gain of single further measurements, for the same tags."""
    now = _mean_ns(found.covariance_ns2)
    for what, changed in (*_better_known(asked, flight), *_flown_otherwise(asked)):
        with_it = changed().predicted()
        same = [with_it.tags.index(tag) for tag in found.tags]
        mean = _mean_ns(with_it.covariance_ns2[np.ix_(same, same)])
        if mean < now:
            yield NextBest(what, mean, now)
    tag, mean = _one_delay(found)
    yield NextBest(f"the delay of tag {tag} from elsewhere, to {DELAY_STD_NS:g} ns", mean, now)


Change = tuple[str, Callable[[], Flight]]


def _better_known(asked: FlightPlanSettings, flight: Flight) -> Iterator[Change]:
    """Yield changes of what is known of the same flight."""
    longer = (asked.poses_until_s or 0.0) + MORE_KNOWN_S
    if longer < float(flight.scene.time_s[-1]):
        yield f"positions known for the first {longer:g} s", lambda: flight.known_until(longer)
    taped = _with_tape(asked, flight)
    if taped:
        first, second = taped.tapes[-1]
        yield f"the distance of tags {first} and {second} by tape", lambda: taped
    if flight.scene.sought:
        yield "the places of the anchors, measured", flight.with_anchors_given
    if asked.attitudes == "poses" and asked.heading_std_deg > HEADING_DEG:
        better = math.radians(HEADING_DEG)
        yield f"headings good to {HEADING_DEG:g} degrees", lambda: flight.with_headings(better)


def _flown_otherwise(asked: FlightPlanSettings) -> Iterator[Change]:
    """Yield changes of the flight."""
    if asked.robots is None:
        return
    others: dict[str, dict[str, Any]] = {}
    if not asked.still_s:
        text = f"robots that stand for the first {STANDS_S:g} s, and the distance of two of their tags by tape"
        others[text] = {"still_s": STANDS_S, "taped": asked.taped + 1}
    others[f"a flight of {2 * asked.seconds:g} s"] = {"seconds": 2 * asked.seconds}
    if not asked.anchors:
        four = {"anchors": _more_anchors(asked, MORE_ANCHORS), "anchor_places": "given"}
        others[f"{MORE_ANCHORS} anchors at known places"] = four
    elif asked.anchor_places == "given":
        others["one anchor more at a known place"] = {"anchors": _more_anchors(asked, 1)}
    if asked.imu is None and asked.attitudes == "poses":
        others["inertial readings"] = {"imu": "consumer"}
    for text, changes in others.items():
        # Invalid changes are not proposed.
        with suppress(BadInputError):
            yield text, partial(_flight, replace(asked, **changes), None)


def _more_anchors(asked: FlightPlanSettings, count: int) -> tuple[int, ...]:
    last = max(*(tag for robot in asked.robots for tag in robot), *asked.anchors, 0)
    return (*asked.anchors, *range(last + 1, last + 1 + count))


def _one_delay(found: Predicted) -> tuple[int, float]:
    """Return the tag whose delay is most useful to know from elsewhere, and the mean half interval with it."""
    c = found.covariance_ns2
    after = [c - np.outer(c[k], c[k]) / (c[k, k] + DELAY_STD_NS**2) for k in range(len(c))]
    means = [_mean_ns(one) for one in after]
    best = int(np.argmin(np.round(means, 6)))
    return found.tags[best], means[best]
