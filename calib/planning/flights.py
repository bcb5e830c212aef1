"""Plans of flights: the precision of delays that are fitted with trajectories, and the gain of further measurements."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from calib.data.sources import Data
from calib.errors import BadInputError
from calib.planning.flight_information import ExpectedErrors, Information, PlannedFlight, flight_of
from calib.planning.reference_motion import reference_motion
from calib.planning.result import FlightPlan, NextBest, mean_std_ns
from calib.planning.settings import ACCELEROMETERS, FlightPlanSettings
from calib.settings import FlightSettings
from calib.spread import TWO_SIDED_95
from calib.trajectories.samples import SAMPLE_S, TRUSTED
from uwblink.arrays import Floats

MORE_KNOWN_S, MORE_ANCHORS, STANDS_S, HEADING_DEG = 10.0, 4, 5.0, 0.5
"""Further measurements that are proposed: so many seconds of known positions, anchors, seconds at a stand, and degrees
of error of headings. Each is what a team can do without other equipment."""

OTHER_DELAY_STD_NS = 0.05
"""Standard error of the delay of one tag from another calibration or a survey (`make surveys`: 41 to 94 ps)."""

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
    """Return that of a recorded flight, or of robots that fly about a room, with as many tapes as are asked for."""
    force_std_m_s2 = (
        None
        if asked.imu is None
        # The second part is vibration that is left in a mean (m/s^2): a judgement; a fit weighs by its residuals.
        else TRUSTED * math.hypot(ACCELEROMETERS[asked.imu] / math.sqrt(SAMPLE_S), 0.2)
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
                f"only {count} can be measured: of robots while they stand (`still_s`), and of anchors whose places "
                "are sought",
                parameter="taped",
            )
        found = Information(flight.taped([*found.flight.tapes, best], asked.still_s, asked.tape_sigma_m))
    return found


def _mean_ns(covariance: Floats) -> float:
    """Return the root mean square half interval, where each delay has the prior of a guess."""
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
    c = found.covariance_ns2
    means = [_mean_ns(c - np.outer(c[k], c[k]) / (c[k, k] + OTHER_DELAY_STD_NS**2)) for k in range(len(c))]
    best = int(np.argmin(np.round(means, 6)))
    yield NextBest(
        f"the delay of tag {found.tags[best]} from elsewhere, to {OTHER_DELAY_STD_NS:g} ns", means[best], now
    )


def _changes(asked: FlightPlanSettings, flight: PlannedFlight) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield further measurements in words, with the changes of the settings that they are.

    The words have places for both tags of the last taped distance.
    """
    longer, poses = (asked.poses_until_s or 0.0) + MORE_KNOWN_S, asked.attitudes == "poses"
    free, given = asked.robots is not None, {"anchor_places": "given"}
    tags = [*(tag for robot in asked.robots or () for tag in robot), *asked.anchors]
    one, four = (
        given | {"anchors": (*asked.anchors, *range(max(tags, default=0) + 1, max(tags, default=0) + 1 + more))}
        for more in (1, MORE_ANCHORS)
    )
    standing = f"robots that stand for the first {STANDS_S:g} s, and the distance of two of their tags by tape"
    tape = {"taped": asked.taped + 1}
    rows: list[tuple[bool, str, dict[str, Any]]] = [
        (
            longer < float(flight.scene.time_s[-1]),
            f"positions known for the first {longer:g} s",
            {"poses_until_s": longer},
        ),
        (True, "the distance of tags {0[0]} and {0[1]} by tape", tape),
        (bool(flight.scene.sought), "the places of the anchors, measured", given),
        (
            poses and asked.heading_std_deg > HEADING_DEG,
            f"headings good to {HEADING_DEG:g} degrees",
            {"heading_std_deg": HEADING_DEG},
        ),
        (free and not asked.still_s, standing, tape | {"still_s": STANDS_S}),
        (free, f"a flight of {2 * asked.seconds:g} s", {"seconds": 2 * asked.seconds}),
        (free and not asked.anchors, f"{MORE_ANCHORS} anchors at known places", four),
        (
            free and bool(asked.anchors) and asked.anchor_places == "given",
            "one anchor more at a known place",
            one,
        ),
        (free and poses and asked.imu is None, "inertial readings", {"imu": "consumer"}),
    ]
    yield from ((what, changes) for useful, what, changes in rows if useful)
