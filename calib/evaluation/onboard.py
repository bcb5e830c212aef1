"""Localization without a motion-capture studio: ranges to fixed anchors, an IMU or none, a height sensor or none.

The start comes from the first ranges (`multilateration`), tilt from gravity, heading from several that are tried at
once; the likeliest so far is told. Where half of the latest ranges cannot be explained, the filter begins anew from
them. Poses of the body, where there are any, are truth to judge by and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from calib.calibration.model import Calibration, require_calibration
from calib.errors import BadInputError, UnanswerableError
from calib.evaluation.multilateration import Fix, multilaterate
from calib.evaluation.onboard_data import Readings, readings
from calib.evaluation.onboard_filter import GRAVITY, InertialFilter, Noise, P
from calib.evaluation.tracking_problem import nearest_attitude
from calib.sources import Data
from uwblink.arrays import Floats, Ints
from uwblink.recording.distances import bodies_m

MODELS: Final = ("imu", "constant-velocity")
FEWEST_RANGES: Final = 6
LOST_SIGMAS: Final = 3.0
"""Where half of the latest ranges are off by more standard deviations, a filter is not where it thinks to be."""

FEWEST_ANCHORS: Final = 3
MOVING_M_S2: Final = 0.7
"""How a body may accelerate while it begins."""

SPAN_S: Final = 0.5
CALM_RAD_S: Final = 0.004
CALM_M_S2: Final = 0.05
SLOW_RAD_S: Final = 0.02
"""A body is at rest in a span of time in which its readings scatter less: rotors vibrate twenty times as much."""

REST_EVERY: Final = 5
SLOW_S: Final = 1.0
"""How often it counts that a body is no faster than it may be; velocities of a second ago say nothing of now."""

LEAST_TILT_S: Final = 0.5
"""How long gravity is averaged for the first tilt."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OnboardSettings:
    """How a body is localized: `model` is one of `MODELS`, `height` whether its height sensor is used.

    `start_m` is where it begins, with a standard deviation of `start_std_m` an axis, instead of where its first ranges
    say; a wrong one is left after `reopen_s`, or as many ranges as a fix takes. `headings` are tried at once;
    inertial readings are averaged to `rate_hz`. `speed_m_s` is how fast it may move at a start.

    >>> import calib
    >>> calib.OnboardSettings(start_m=(0.0, 0.0, 1.0)).model
    'imu'
    """

    model: str = "imu"
    height: bool = True
    start_m: tuple[float, float, float] | None = None
    start_std_m: float = 0.3
    reopen_s: float = 0.5
    headings: int = 8
    rate_hz: float = 50.0
    speed_m_s: float = 1.0
    noise: Noise = field(default_factory=Noise)

    def __post_init__(self) -> None:
        """Refuse what no filter can run with; raises `BadInputError`."""
        if self.model not in MODELS:
            raise BadInputError(
                f"found {self.model!r:.40}, allowed: {', '.join(MODELS)}, or poses with motion capture",
                parameter="model",
            )
        for name in ("start_std_m", "reopen_s", "rate_hz", "speed_m_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise BadInputError(f"found {getattr(self, name)!r:.40}, expected a number above 0", parameter=name)
        if self.start_m is not None and not (len(self.start_m) == 3 and np.isfinite(self.start_m).all()):
            raise BadInputError(f"found {self.start_m!r:.60}, expected three numbers", parameter="start_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class OnboardTrack:
    """Where a body was (n, 3), with attitudes x y z w (n, 4), from the first fix on, and what to think of it.

    `std_m` (n,) is the root of the sum of the filter's three variances. `truth_m` (n, 3), `true_attitude` (n, 4) and
    `nees` (n,) are NaN where poses do not say. `nis` (ranges,) are squared innovations over their variance at
    `range_time_ns`, `believed` those that were; `restarts_s` when the filter began anew, in seconds since the first
    exchange.
    """

    source: str
    body: str
    model: str
    used: str
    time_ns: Ints
    estimate_m: Floats
    attitude: Floats
    std_m: Floats
    truth_m: Floats
    true_attitude: Floats
    nees: Floats
    range_time_ns: Ints
    nis: Floats
    believed: Floats
    restarts_s: tuple[float, ...]

    @property
    def rmse_m(self) -> float:
        """Root of the mean squared distance from the truth, NaN where nothing is known of it."""
        known = np.isfinite(self.truth_m).all(axis=1)
        wrong = self.estimate_m[known] - self.truth_m[known]
        return float(np.sqrt(np.mean(np.sum(wrong**2, axis=1)))) if known.any() else float("nan")

    def __repr__(self) -> str:
        """Return what it rests on and how far off it is, on one line."""
        off = f"rms error {self.rmse_m:.3f} m" if self.rmse_m == self.rmse_m else "no truth to judge by"
        return f"{self.body} of {self.source} by {self.used}: {off}"


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
    first, fix = _start(one, settings)
    begin_s = float(one.time_s[first])
    attitudes = _attitudes(one, begin_s, settings) if inertial else np.eye(3)[None]
    running = InertialFilter(fix, attitudes, settings.noise, inertial=inertial, speed_m_s=settings.speed_m_s)
    if inertial:
        running.pulled(_force(one, begin_s), MOVING_M_S2)
    log = _Log()
    _run(one, settings, running, first, log)
    return _told(one, settings, log)


def _run(one: Readings, settings: OnboardSettings, running: InertialFilter, first: int, log: _Log) -> None:
    """Play ranges, steps and heights in order of time."""
    now = float(one.time_s[first])
    window: list[tuple[int, float]] = []
    slow_every = max(round(settings.rate_hz * SLOW_S), 1)
    still = _still(one) if running.inertial else set()
    for time_s, kind, number, gyro, force in _events(one, settings, now):
        if time_s > now:
            running.predict(time_s - now, gyro, force)
            now = time_s
        best = int(np.argmax(running.likelihood))
        if kind == "height":
            running.level(float(one.height_m[number]))
        elif kind == "step" and int(now // SPAN_S) in still and number % REST_EVERY == 0:
            running.rest(gyro, force)
        elif kind == "step" and number % slow_every == 0:
            running.slow(settings.speed_m_s)
        elif kind == "range":
            heard = running.hear(
                float(one.range_m[number]), float(one.noise_m[number]), one.errors[number], one.arm_m[number],
                one.anchor_m[number],
            )  # fmt: skip
            log.heard_s.append(now)
            log.nis.append(float(heard.nis[best]))
            log.believed.append(bool(heard.believed[best]))
            window.append((number, float(np.sqrt(heard.nis[best]))))
            if _lost(one, window, settings):
                running.restart(_fix(one, np.array([row for row, _ in window]), settings), settings.speed_m_s)
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


def _events(
    one: Readings, settings: OnboardSettings, begin_s: float
) -> Iterator[tuple[float, str, int, Floats, Floats]]:
    """Yield times at which something happens, what, its number, and mean inertial readings since the one before."""
    step = 1 / settings.rate_hz
    end_s = float(one.time_s[-1])
    grid = np.arange(begin_s + step, end_s, step)
    times = {"step": grid, "range": one.time_s[one.time_s >= begin_s]}
    numbers = {"step": np.arange(len(grid)), "range": np.flatnonzero(one.time_s >= begin_s)}
    if settings.height and len(one.height_s):
        # Ten a second are enough: its offset wanders slowly.
        every = np.unique(np.floor(one.height_s * 10), return_index=True)[1]
        rows = every[(one.height_s[every] >= begin_s) & (one.height_s[every] <= end_s)]
        times["height"], numbers["height"] = one.height_s[rows], rows
    kinds = np.repeat(list(times), [len(part) for part in times.values()])
    when, which = np.concatenate(list(times.values())), np.concatenate(list(numbers.values()))
    order = np.argsort(when, kind="stable")
    means = _means(one, np.concatenate([[begin_s], when[order]]))
    for k, row in enumerate(order.tolist()):
        yield float(when[row]), str(kinds[row]), int(which[row]), means[k, :3], means[k, 3:]


def _means(one: Readings, edges: Floats) -> Floats:
    """Return the means of inertial readings between edges (n + 1,), straight between two readings: (n, 6)."""
    if not len(one.imu_s):
        return np.zeros((len(edges) - 1, 6))
    values = np.hstack([one.gyro, one.force])
    steps = np.diff(one.imu_s)[:, None] * (values[1:] + values[:-1]) / 2
    gathered = np.vstack([np.zeros(6), np.cumsum(steps, axis=0)])
    inside = np.clip(edges, one.imu_s[0], one.imu_s[-1])
    at = np.column_stack([np.interp(inside, one.imu_s, column) for column in gathered.T])
    span = np.diff(inside)[:, None]
    now = np.column_stack([np.interp(inside[1:], one.imu_s, column) for column in values.T])
    # A sum of straight pieces read straight between its own points is off by less than its last piece.
    return np.asarray(np.where(span > 1e-9, np.diff(at, axis=0) / np.maximum(span, 1e-9), now))


def _start(one: Readings, settings: OnboardSettings) -> tuple[int, Fix]:
    """Return the range at which the filter begins, and where it is by then."""
    if settings.start_m is not None:
        return 0, Fix(np.array(settings.start_m, dtype=np.float64), np.eye(3) * settings.start_std_m**2)
    for count in range(FEWEST_RANGES, len(one.time_s) + 1):
        if len(np.unique(one.anchor_m[:count], axis=0)) >= FEWEST_ANCHORS + 1:
            return count - 1, _fix(one, np.arange(count), settings)
    raise UnanswerableError(f"{one.source}: {one.body} ranges with too few anchors for a start; give it one")


def _fix(one: Readings, rows: Ints, settings: OnboardSettings) -> Fix:
    span = float(one.time_s[rows[-1]] - one.time_s[rows[0]])
    arm = float(np.linalg.norm(one.arm_m[rows], axis=1).max())
    moves = 0.3 * settings.speed_m_s * span
    near = np.abs(one.height_s - one.time_s[rows[-1]]) < 1.0 if settings.height else np.zeros(0, dtype=bool)
    height = float(np.median(one.height_m[near])) if near.any() else None
    found = multilaterate(one.range_m[rows], one.anchor_m[rows], float(np.hypot(arm / 2, moves)), height)
    return Fix(found.place_m, found.covariance_m2 + np.eye(3) * moves**2)


def _attitudes(one: Readings, begin_s: float, settings: OnboardSettings) -> Floats:
    """Return attitudes (headings, 3, 3) with the tilt that gravity says, and headings all around."""
    force = _force(one, begin_s)
    up = force / np.linalg.norm(force)
    # The world's vertical in the axes of the body, and two axes across it.
    east = np.cross((0.0, 1.0, 0.0), up)
    east = east / np.linalg.norm(east)
    tilt = np.vstack([east, np.cross(up, east), up])
    angles = 2 * np.pi * np.arange(settings.headings) / settings.headings
    found = np.zeros((settings.headings, 3, 3))
    for k, (c, s) in enumerate(zip(np.cos(angles), np.sin(angles), strict=True)):
        found[k] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ tilt
    return found


def _force(one: Readings, begin_s: float) -> Floats:
    """Return the mean specific force about the start (3,)."""
    near = np.abs(one.imu_s - begin_s) < LEAST_TILT_S / 2
    return one.force[near].mean(axis=0) if near.any() else np.array([0.0, 0.0, GRAVITY])


def _still(one: Readings) -> set[int]:
    """Return the half seconds in which inertial readings say that nothing moves: no vibration, no turning."""
    span = np.floor(one.imu_s / SPAN_S).astype(np.int64)
    edges = np.flatnonzero(np.diff(span, prepend=span[:1] - 1)) if len(span) else np.zeros(0, dtype=np.int64)
    found = set()
    for begin, end in zip(edges, np.append(edges[1:], len(span)), strict=True):
        turns, pulls = one.gyro[begin:end], one.force[begin:end]
        calm = turns.std(axis=0).max() < CALM_RAD_S and pulls.std(axis=0).max() < CALM_M_S2
        if end - begin > 1 and calm and np.abs(turns.mean(axis=0)).max() < SLOW_RAD_S:
            found.add(int(span[begin]))
    return found


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
