"""Localization without a motion-capture studio: ranges to fixed anchors, an IMU or none, a height sensor or none.

The start comes from the first ranges (`multilateration`), tilt from gravity, heading from several that are tried at
once; the likeliest so far is told. Where half of the latest ranges cannot be explained, the filter begins anew from
them. Poses of the body, where there are any, are truth to judge by and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from calib.calibration.model import Calibration, require_calibration
from calib.data.sources import Data
from calib.errors import UnanswerableError
from calib.evaluation.onboard_data import Readings, readings
from calib.evaluation.onboard_events import SPAN_S, events, still_spans
from calib.evaluation.onboard_filter import InertialFilter, P
from calib.evaluation.onboard_start import (
    FEWEST_ANCHORS,
    FEWEST_RANGES,
    first_attitudes,
    first_fix,
    latest_fix,
    mean_force,
)
from calib.evaluation.onboard_track import OnboardSettings, OnboardTrack
from calib.evaluation.tracking_problem import nearest_attitude
from uwblink.arrays import Floats
from uwblink.recording.distances import bodies_m

LOST_SIGMAS: Final = 3.0
"""Where half of the latest ranges are off by more standard deviations, a filter is not where it thinks to be."""

MOVING_M_S2: Final = 0.7
"""How a body may accelerate while it begins."""

REST_EVERY: Final = 5
SLOW_S: Final = 1.0
"""How often it counts that a body is no faster than it may be; velocities of a second ago say nothing of now."""


def localize_onboard(
    data: Data, calibration: Calibration, settings: OnboardSettings | None = None
) -> list[OnboardTrack]:
    """Track every moving body by its ranges to fixed anchors, its IMU and its height sensor.

    `data` is the path of a recording, an open `Recording`, or anything with `exchanges`, `poses`, `tags`, `imu` and
    `height` (as `uwblink.load` returns). Anchors are bodies whose poses stay in one place. Raises `UnanswerableError`
    where there are too few of them, no ranges, or no inertial readings for the model "imu".

    >>> import calib
    >>> known = calib.fit(calib.sample_flight(anchors=True)).calibration
    >>> flight = calib.sample_flight(seed=2, anchors=True)
    >>> (track,) = calib.localize_onboard(flight, known, calib.OnboardSettings(model="constant-velocity"))
    >>> track.body, track.used, track.rmse_m < 0.2
    ('robot1', 'ranges', True)
    """
    require_calibration(calibration)
    chosen = settings or OnboardSettings()
    return [_track(one, chosen) for one in readings(data, calibration)]


@dataclass(slots=True, kw_only=True)
class _Log:
    """What is kept of the likeliest heading, step by step."""

    time_s: list[float] = field(default_factory=list)
    place: list[Floats] = field(default_factory=list)
    attitude: list[Floats] = field(default_factory=list)
    covariance: list[Floats] = field(default_factory=list)
    heard_s: list[float] = field(default_factory=list)
    nis: list[float] = field(default_factory=list)
    believed: list[bool] = field(default_factory=list)
    restarts_s: list[float] = field(default_factory=list)


def _track(one: Readings, settings: OnboardSettings) -> OnboardTrack:
    inertial = settings.model == "imu"
    if inertial and not len(one.imu_s):
        raise UnanswerableError(f"{one.source}: no inertial readings of {one.body}; choose the model constant-velocity")
    first, found = first_fix(one, settings)
    begin_s = float(one.time_s[first])
    turned = first_attitudes(one, begin_s, settings) if inertial else np.eye(3)[None]
    running = InertialFilter(found, turned, settings.noise, inertial=inertial, speed_m_s=settings.speed_m_s)
    if inertial:
        running.pulled(mean_force(one, begin_s), MOVING_M_S2)
    log = _Log()
    _run(one, settings, running, first, log)
    return _told(one, settings, log)


def _run(one: Readings, settings: OnboardSettings, running: InertialFilter, first: int, log: _Log) -> None:
    """Play ranges, steps and heights in order of time."""
    now = float(one.time_s[first])
    window: list[tuple[int, float]] = []
    slow_every = max(round(settings.rate_hz * SLOW_S), 1)
    calm = still_spans(one) if running.inertial else set()
    for time_s, kind, number, gyro, force in events(one, settings, now):
        if time_s > now:
            running.predict(time_s - now, gyro, force)
            now = time_s
        best = int(np.argmax(running.likelihood))
        if kind == "height":
            running.level(float(one.height_m[number]))
        elif kind == "step" and int(now // SPAN_S) in calm and number % REST_EVERY == 0:
            running.rest(gyro, force)
        elif kind == "step" and number % slow_every == 0:
            running.slow(settings.speed_m_s)
        elif kind == "range":
            heard = running.hear(
                float(one.range_m[number]), float(one.noise_m[number]), one.errors.at(number), one.arm_m[number],
                one.anchor_m[number],
            )  # fmt: skip
            log.heard_s.append(now)
            log.nis.append(float(heard.nis[best]))
            log.believed.append(bool(heard.believed[best]))
            window.append((number, float(np.sqrt(heard.nis[best]))))
            if _lost(one, window, settings):
                running.restart(latest_fix(one, np.array([row for row, _ in window]), settings), settings.speed_m_s)
                log.restarts_s.append(now)
                window = []
        best = int(np.argmax(running.likelihood))
        log.time_s.append(now)
        log.place.append(running.place[best].copy())
        log.attitude.append(running.attitude[best].copy())
        log.covariance.append(running.covariance[best][P, P].copy())


def _lost(one: Readings, window: list[tuple[int, float]], settings: OnboardSettings) -> bool:
    """Return whether half of the latest ranges are further off than noise explains; forget those before them.

    The window reaches back for `reopen_s`, or for as many ranges as a fix takes.
    """
    now = float(one.time_s[window[-1][0]])
    while len(window) > FEWEST_RANGES and now - one.time_s[window[1][0]] > settings.reopen_s:
        window.pop(0)
    rows = [row for row, _ in window]
    if len(window) < FEWEST_RANGES or now - one.time_s[rows[0]] < settings.reopen_s:
        return False
    enough = len(np.unique(one.anchor_m[rows], axis=0)) > FEWEST_ANCHORS
    return enough and float(np.median([score for _, score in window])) > LOST_SIGMAS


def _told(one: Readings, settings: OnboardSettings, log: _Log) -> OnboardTrack:
    from scipy.spatial.transform import Rotation

    time_ns = one.began_ns + np.rint(np.array(log.time_s) * 1e9).astype(np.int64)
    place, covariance = np.array(log.place), np.array(log.covariance)
    truth = np.full_like(place, np.nan)
    turned = np.full((len(place), 4), np.nan)
    if one.truth is not None:
        truth = bodies_m(one.truth, one.body, time_ns)
        turned = nearest_attitude(one.truth, one.body, time_ns)
    wrong = place - truth
    nees = np.einsum("ni,ni->n", wrong, np.linalg.solve(covariance, wrong[..., None])[..., 0])
    used = ["ranges"] + ["imu"] * (settings.model == "imu") + ["height"] * (settings.height and len(one.height_s) > 0)
    return OnboardTrack(
        source=one.source,
        body=one.body,
        model=settings.model,
        used=", ".join(used),
        time_ns=time_ns,
        estimate_m=place,
        attitude=np.asarray(Rotation.from_matrix(np.array(log.attitude)).as_quat()),
        std_m=np.sqrt(np.trace(covariance, axis1=1, axis2=2)),
        truth_m=truth,
        true_attitude=turned,
        nees=nees,
        range_time_ns=one.began_ns + np.rint(np.array(log.heard_s) * 1e9).astype(np.int64),
        nis=np.array(log.nis),
        believed=np.array(log.believed),
        restarts_s=tuple(log.restarts_s),
    )
