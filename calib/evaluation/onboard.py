"""Localization without motion capture: ranges to fixed anchors, optionally an IMU and a height sensor.

With `OnboardSettings(use="receptions")` differences of arrival are measurements, too: frames of anchors that the body
overhears, and frames of the body that anchors overhear.

The first ranges give the start (`multilaterate`), gravity gives the tilt, and several headings are tried in parallel;
the likeliest is reported. If it does not explain its ranges, the filter restarts from them. Poses of the
body are only used as truth for evaluation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from calib.calibration.applying import keep_determined
from calib.calibration.document import for_json
from calib.calibration.error_model import GATE
from calib.calibration.model import Calibration, CalibrationSource, given_calibration
from calib.data.sources import Data, load_flight, require_times, sensor_rows
from calib.errors import BadInputError, UnanswerableError
from calib.evaluation.filters import (
    GRAVITY_M_S2,
    EndPattern,
    Fix,
    InertialFilter,
    P,
    ProcessNoise,
    end_patterns,
    multilaterate,
    squared_over,
    without_directions,
)
from calib.evaluation.localization import MeasuredReceptions, delay_lines, delays_json, with_delays
from calib.evaluation.models import FilterRanges, side_by_side
from calib.evaluation.tracking import PATIENCE_S, Measurements, Track, nearest_attitude, ranges_among, used_part
from calib.online import RangeErrors
from calib.settings import CheckedSettings
from uwblink.arrays import Floats, Ints
from uwblink.recording.distances import bodies_m
from uwblink.recording.schema import Poses
from uwblink.settings import setting
from uwblink.twr import names_in

MIN_ANCHORS: Final = 3
"""Anchors of a fix: fewer leave the position ambiguous; a start needs one more, because three leave its mirror image.
"""

MIN_RANGES_PER_FIX: Final = 6
"""Two ranges for each coordinate, so that the median of their errors excludes a reflected one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OnboardSettings(CheckedSettings):
    """How a body is localized: `model` is "imu" or "constant-velocity", `height` whether its height sensor is used.

    `start_m` is the start position, with a standard deviation of `start_std_m` per axis, instead of a fix by its first
    ranges; a wrong start is replaced after `reopen_s`, or the number of ranges of a fix. `headings` are tried in
    parallel; inertial readings are averaged to `rate_hz`. `speed_m_s` is the largest speed at a start. `use` is
    "exchanges", or "receptions", with differences of arrival. With `online` each body has one more track, with delays
    as states.

    >>> import calib
    >>> calib.OnboardSettings(start_m=(0.0, 0.0, 1.0)).model
    'imu'
    """

    model: str = setting("imu", "Motion model between ranges.", names=("imu", "constant-velocity"))
    height: bool = True
    start_m: tuple[float, float, float] | None = None
    start_std_m: float = 0.3
    reopen_s: float = 0.5
    headings: int = 8
    rate_hz: float = 50.0
    speed_m_s: float = 1.0
    use: str = setting("exchanges", "Measurements to use.", names=("exchanges", "receptions"))
    online: bool = False
    noise: ProcessNoise = field(default_factory=ProcessNoise)

    def __post_init__(self) -> None:
        """Check the settings; raises `BadInputError`."""
        CheckedSettings.__post_init__(self)
        if self.start_m is not None and not (len(self.start_m) == 3 and np.isfinite(self.start_m).all()):
            raise BadInputError(f"found {self.start_m!r:.60}, expected three numbers", parameter="start_m")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class OnboardTrack(Track):
    """The track of a body from its first fix on, by the sensors that are `used`.

    `nis` and `accepted` (ranges,) are at `range_time_ns`; `restarts_s` is when the filter began anew, in seconds since
    the first exchange.
    """

    source: str
    body: str
    model: str
    used: str
    range_time_ns: Ints
    restarts_s: tuple[float, ...]

    @property
    def label(self) -> str:
        """The body and the model in names of files."""
        return f"{self.body}-{self.model}{'-online' if self.delays else ''}"

    @property
    def title(self) -> str:
        """The recording, the body, and whether delays were states, in words."""
        return f"{self.source} {self.body}{', delays online' if self.delays else ''}"

    def __repr__(self) -> str:
        """Return the inputs and the RMSE, on one line."""
        off = f"rms error {self.rmse_m:.3f} m" if self.rmse_m == self.rmse_m else "no true positions"
        return f"{self.body} of {self.source} by {self.used}: {off}"


def localize_onboard(
    data: Data, calibration: CalibrationSource, settings: OnboardSettings | None = None
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
    calibration = given_calibration(calibration)
    chosen = settings or OnboardSettings()
    return [_track(one, chosen) for one in _readings(data, calibration, chosen)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Readings(Measurements):
    """Readings of one body: measurements (n,), inertial readings, heights.

    Of the k distances in a measurement `sign` (n, k) is 0 for distances between anchors, which are subtracted from
    `measured`; the others are from the antenna at `arm_m` (n, 3) to `anchor_m` (n, k, 3). Times are seconds since
    `began_ns`, the first exchange. `imu` are angular velocities in rad/s and specific forces in m/s^2 (m, 6) in the
    axes of the body. `patterns` are the patterns in measurements, with the body at end 0. `truth` are its poses, or
    None.
    """

    body: str
    time_s: Floats
    measured: FilterRanges
    errors: RangeErrors
    arm_m: Floats
    anchor_m: Floats
    imu_s: Floats
    imu: Floats
    height_s: Floats
    height_m: Floats
    patterns: list[list[EndPattern]]
    truth: Poses | None
    began_ns: int

    def at_ns(self, seconds: Sequence[float]) -> Ints:
        """Return host times of seconds since the first exchange (n,)."""
        return self.began_ns + np.rint(np.array(seconds) * 1e9).astype(np.int64)

    def true_poses(self, time_ns: Ints) -> tuple[Floats, Floats]:
        """Return true positions (n, 3) and attitudes (n, 4) at some times, NaN without poses."""
        if self.truth is None:
            return np.full((len(time_ns), 3), np.nan), np.full((len(time_ns), 4), np.nan)
        return bodies_m(self.truth, self.body, time_ns), nearest_attitude(self.truth, self.body, time_ns)

    def used(self, settings: OnboardSettings) -> str:
        """Return the kinds of readings that are used, in words."""
        overheard = (self.measured.common_m > 0) | ((self.sign != 0).sum(axis=1) > 1)
        used = {
            "ranges": not overheard.all(),
            "differences of arrival": overheard.any(),
            "imu": settings.model == "imu",
            "height": settings.height and len(self.height_s) > 0,
        }
        return ", ".join(name for name, there in used.items() if there)


def _readings(data: Data, calibration: Calibration, settings: OnboardSettings) -> list[_Readings]:
    """Return the readings of every body other than anchors that ranges with an anchor, or listens: with fixed delays,
    and if chosen also with delays as states."""
    use = settings.use
    flight = load_flight(data, need_power=calibration.needs_power, need_truth=False, use=use, sensors=("imu", "height"))
    name, (imu, heights) = flight.ranges.source, flight.sensors.values()
    poses, tags = flight.poses, flight.tags
    ranges = without_directions(used_part(keep_determined(calibration, flight.ranges), use))
    anchors = {body: poses[poses.body == body] for body in set(names_in(poses.body)) - set(flight.moving_bodies())}
    mounted = [tag for tag in tags if tag.body in anchors]
    fixed = {tag.tag: np.median(anchors[tag.body].position_m, axis=0) + tag.lever_arm_m for tag in mounted}
    turned = {tag.tag: Rotation.from_quat(anchors[tag.body].quaternion[0]).as_matrix() for tag in mounted}
    if len(fixed) < MIN_ANCHORS:
        raise UnanswerableError(
            f"{name}: by its poses {len(fixed)} tags stand still, but at least {MIN_ANCHORS} anchors are needed; add "
            f"their poses with 'uwblink poses'"
        )
    require_times(ranges)
    began = int(ranges.time_ns.min())
    found = []
    for body in sorted({tag.body for tag in tags if tag.body not in anchors}):
        arms = {tag.tag: np.array(tag.lever_arm_m) for tag in tags if tag.body == body}
        rows, others = Measurements.of_body(ranges_among(ranges, [*arms, *fixed]), list(arms))
        if not len(rows):
            continue
        place = np.full((max(*arms, *fixed) + 1, 3), np.nan)
        place[[*fixed, *arms]] = [*fixed.values(), *arms.values()]
        own, other = np.moveaxis(place[rows.ends], 2, 0)
        between_m = np.sum(others * np.linalg.norm(own - other, axis=2), axis=1)
        every, _, errors = MeasuredReceptions.of(rows.ranges, calibration).robust(calibration)
        imu_s, inertial = inertial_readings(imu, body, began)
        height_s, height = sensor_rows(heights, body, ("height_m",), began)
        known = poses.body == body
        found += [
            _Readings(
                **rows.to_dict(),
                ranges=rows.ranges,
                body=body,
                time_s=np.asarray((rows.time_ns - began) * 1e-9, dtype=np.float64),
                measured=replace(measured, measured_m=measured.measured_m - between_m),
                errors=errors.at(rows.rows),
                arm_m=own[np.arange(len(rows)), np.argmax(rows.sign != 0, axis=1)],
                anchor_m=other,
                imu_s=imu_s,
                imu=inertial,
                height_s=height_s,
                height_m=height.ravel(),
                patterns=end_patterns(calibration, rows.ends, rows.sign, turned),
                truth=poses[known] if known.any() else None,
                began_ns=began,
            )
            for kind in (every, *with_delays(every, rows.ranges, calibration, online=settings.online).values())
            for measured in (kind.at(rows.rows),)
        ]
    if not found:
        raise UnanswerableError(
            f"{name}: no moving body ranges with a fixed anchor, so there is nothing to localize; a body that only "
            f"listens needs `use` receptions"
        )
    return found


def inertial_readings(table: Mapping[str, NDArray[Any]], body: str, began_ns: int) -> tuple[Floats, Floats]:
    """Return times in seconds since `began_ns` and inertial readings (n, 6) of a body, in order of time."""
    return sensor_rows(table, body, ("wx", "wy", "wz", "ax", "ay", "az"), began_ns)


def _begin(one: _Readings, settings: OnboardSettings) -> tuple[int, InertialFilter]:
    """Return the index of the range at which the filter starts, and the filter."""
    inertial, first = settings.model == "imu", 0
    if inertial and len(one.imu_s) < 2:
        raise UnanswerableError(
            f"{one.ranges.source}: no inertial readings of {one.body}; add imu.csv to an export and import it "
            f"(`uwblink import exported`), or use the model constant-velocity"
        )
    if settings.start_m is not None:
        fix = Fix(np.array(settings.start_m, dtype=np.float64), np.eye(3) * settings.start_std_m**2)
    else:
        counts = range(MIN_RANGES_PER_FIX, len(one.time_s) + 1)
        enough = (k for k in counts if _determined(one, np.arange(k)))
        first = next(enough, 0) - 1
        if first < 0:
            raise UnanswerableError(
                f"{one.ranges.source}: {one.body} ranges with too few anchors for an initial position; give one"
            )
        fix = _fix(one, np.arange(first + 1), settings)
    near = np.abs(one.imu_s - float(one.time_s[first])) < 0.25  # s: the first tilt is the mean of half a second
    force = one.imu[near, 3:].mean(axis=0) if near.any() else np.array([0.0, 0.0, GRAVITY_M_S2])
    turned = _attitudes(force, settings.headings) if inertial else np.eye(3)[None]
    delays = one.measured.delays
    found = InertialFilter(fix, turned, settings.noise, inertial=inertial, speed_m_s=settings.speed_m_s, delays=delays)
    if inertial:
        found.update_gravity(force, 0.7)  # m/s^2: acceleration of a body at the start
    return first, found


def _determined(one: _Readings, rows: Ints) -> bool:
    """Return whether some measurements have enough anchors for a start: with only differences one more is needed."""
    used = one.sign[rows] != 0
    anchors = len(np.unique(one.anchor_m[rows][used], axis=0))
    return bool(anchors - (used.sum(axis=1) > 1).all() > MIN_ANCHORS)


def _fix(one: _Readings, rows: Ints, settings: OnboardSettings) -> Fix:
    """Return the position of a body at the last of some ranges (n,), during which it may move."""
    span = float(one.time_s[rows[-1]] - one.time_s[rows[0]])
    arm = float(np.linalg.norm(one.arm_m[rows], axis=1).max())
    moves = 0.3 * settings.speed_m_s * span
    near = np.abs(one.height_s - one.time_s[rows[-1]]) < 1.0 if settings.height else np.zeros(0, dtype=bool)
    height = float(np.median(one.height_m[near])) if near.any() else None
    spread_m, legs_m = float(np.hypot(arm / 2, moves)), one.measured.measured_m[rows]
    found = multilaterate(legs_m, one.anchor_m[rows], spread_m, height, one.sign[rows])
    return Fix(found.place_m, found.covariance_m2 + np.eye(3) * moves**2)


def _attitudes(force: Floats, headings: int) -> Floats:
    """Return attitudes (headings, 3, 3) with the tilt from gravity, and headings all around."""
    up = force / np.linalg.norm(force)
    # The world's vertical in the axes of the body, and two axes across it.
    east = np.cross((0.0, 1.0, 0.0), up)
    east = east / np.linalg.norm(east)
    tilt = np.vstack([east, np.cross(up, east), up])
    turns = Rotation.from_rotvec(np.outer(2 * np.pi * np.arange(headings) / headings, (0.0, 0.0, 1.0)))
    return np.asarray(turns.as_matrix() @ tilt)


def _events(one: _Readings, settings: OnboardSettings, begin_s: float) -> Iterator[tuple[float, str, int, Floats]]:
    """Yield events in order of time: time, kind, number, and the mean inertial readings since the previous event."""
    end_s = float(one.time_s[-1])
    grid = np.arange(begin_s + 1 / settings.rate_hz, end_s, 1 / settings.rate_hz)
    ranges = np.flatnonzero(one.time_s >= begin_s)
    happens = [(time_s, "step", number) for number, time_s in enumerate(grid.tolist())]
    happens += [(float(one.time_s[row]), "range", row) for row in ranges.tolist()]
    if settings.height:
        # Ten per second are enough: the sensor's offset changes slowly.
        every = np.unique(np.floor(one.height_s * 10), return_index=True)[1]
        rows = every[(one.height_s[every] >= begin_s) & (one.height_s[every] <= end_s)]
        happens += [(float(one.height_s[row]), "height", row) for row in rows.tolist()]
    happens.sort(key=itemgetter(0))
    between = mean_readings(one.imu_s, one.imu, np.array([begin_s, *(time_s for time_s, _, _ in happens)]))
    for event, inertial in zip(happens, between, strict=True):
        yield *event, inertial


def mean_readings(time_s: Floats, readings: Floats, edges: Floats) -> Floats:
    """Return the means of inertial readings (m, 6) between edges (n + 1,), linear between two readings: (n, 6)."""
    if len(time_s) < 2:
        return np.zeros((len(edges) - 1, 6))
    curve = make_interp_spline(time_s, readings, k=1)
    inside = np.clip(edges, time_s[0], time_s[-1])
    span = np.diff(inside)[:, None]
    sums = np.diff(curve.antiderivative()(inside), axis=0)
    # The rounding error of a sum is divided by the span.
    return np.asarray(np.where(span > 1e-9, sums / np.maximum(span, 1e-9), curve(inside[1:])))


def _track(one: _Readings, settings: OnboardSettings) -> OnboardTrack:
    """Process ranges, steps and heights in order of time, and return the track of the likeliest heading."""
    (first, running), known = _begin(one, settings), one.measured
    now = heard = float(one.time_s[first])
    states, updates, restarts, exchange = list[Any](), list[tuple[float, float, bool, float]](), list[float](), -1
    unexplained_s, numbers = 0.0, np.column_stack([known.measured_m, known.std_m]).tolist()
    *_, common, _, slopes = side_by_side([known])
    shared = np.column_stack([common, slopes[:, 0]])
    # The speed limit is applied once per second: velocities are independent after a second.
    slow_every = max(round(settings.rate_hz), 1)
    for time_s, kind, number, inertial in _events(one, settings, now):
        if time_s > now:
            running.step(time_s - now, inertial)
            now = time_s
        best = int(np.argmax(running.likelihood))
        if kind == "height":
            running.update_height(float(one.height_m[number]))
        elif kind == "step" and number % slow_every == 0:
            running.limit_speed(settings.speed_m_s)
        elif kind == "range":
            if exchange != (exchange := int(one.exchange[number])):
                running.begin_exchange()
            measured, noise_m = numbers[number]
            geometry = one.arm_m[number], one.anchor_m[number], one.sign[number]
            more = shared[number], one.patterns[number]
            update = running.update_range(measured, noise_m, one.errors.at(number), *geometry, *more)
            updates.append((now, float(update.nis[best]), bool(update.accepted[best]), running.drifts))
            # As in `tracking.run_filters`, but explained ranges do not extend the time before a restart: this filter
            # drifts.
            lasted_s = min(now - heard, settings.reopen_s / 2 / MIN_RANGES_PER_FIX)
            unexplained_s = max(unexplained_s + (lasted_s if update.nis[best] > GATE else -lasted_s / 3), 0.0)
            heard, rows = now, _latest(one, number, settings)
            if unexplained_s > settings.reopen_s / 2 and _determined(one, rows):
                running.restart(_fix(one, rows, settings), settings.speed_m_s)
                restarts.append(now)
                unexplained_s = 0.0
        best = int(np.argmax(running.likelihood))
        state = running.state[best, P], running.attitude[best, 0], running.covariance[best, P, P]
        states.append((now, *(part.copy() for part in state)))

    delays, changes = known.delays.estimates(), running.changes
    if running.drift[best]:
        delays = known.delays.estimates(running.state[best, changes], running.covariance[best, changes, changes])
    times, places, attitudes, covariances = zip(*states, strict=True)
    heard_s, nis, accepted, drifts = zip(*updates, strict=True)
    time_ns, place, covariance = one.at_ns(times), np.array(places), np.array(covariances)
    truth, turned = one.true_poses(time_ns)
    return OnboardTrack(
        source=one.ranges.source,
        body=one.body,
        model=settings.model,
        used=one.used(settings),
        time_ns=time_ns,
        estimate_m=place,
        attitude=np.asarray(Rotation.from_matrix(np.array(attitudes)).as_quat()),
        std_m=np.sqrt(np.trace(covariance, axis1=1, axis2=2)),
        truth_m=truth,
        true_attitude=turned,
        nees=squared_over(place - truth, covariance),
        range_time_ns=one.at_ns(heard_s),
        nis=np.array(nis),
        accepted=np.array(accepted),
        drifts=np.array(drifts),
        restarts_s=tuple(restarts),
        delays=delays,
    )


def _latest(one: _Readings, last: int, settings: OnboardSettings) -> Ints:
    """Return the ranges of the last `reopen_s`, or as many as a fix needs."""
    first = int(np.searchsorted(one.time_s, one.time_s[last] - settings.reopen_s))
    return np.arange(max(min(first, last + 1 - MIN_RANGES_PER_FIX), 0), last + 1)


def onboard_text(found: list[OnboardTrack], settings: OnboardSettings) -> str:
    """Return a line per body: its RMSE if truth is known."""
    lines = [f"{'by ranges to fixed anchors':33s}{'RMSE (m)':>10s}{'median':>9s}{'95 %':>9s}{'own std':>9s}  restarts"]
    for one in found:
        off = np.linalg.norm(one.estimate_m - one.truth_m, axis=1)
        off = off[np.isfinite(off)]
        figures = (one.rmse_m, *np.quantile(off, (0.5, 0.95))) if len(off) else (np.nan,) * 3
        cells = "".join(f"{'-':>9s}" if value != value else f"{value:9.3f}" for value in figures)
        own = float(np.sqrt(np.mean(one.std_m**2)))
        lines.append(f"{one.title:33s} {cells}{own:9.3f}  {len(one.restarts_s)}")
        lasts_s = float(np.ptp(one.range_time_ns)) * 1e-9
        if len(one.restarts_s) > max(lasts_s / PATIENCE_S, 3):
            lines.append(
                f"  restarted {len(one.restarts_s)} times in {lasts_s:.0f} s: the measurements contradict the "
                f"positions of the anchors, or differences without stamps have a wrong unit or sign (from_id and "
                f"to_id of the import)"
            )
    noise = settings.noise
    moves = (
        f"accelerometer {noise.force:g} m/s^2 and gyro {noise.gyro:g} rad/s a root of Hz"
        if settings.model == "imu"
        else f"random walk of the velocity {noise.acceleration:g} m/s^2 per root of Hz"
    )
    lines += [line for one in found for line in delay_lines(f"{one.source} {one.body}", one)]
    return "\n".join([*lines, f"used: {found[0].used}; process noise: {moves}, speed about {settings.speed_m_s:g} m/s"])


def onboard_json(found: list[OnboardTrack]) -> list[dict[str, Any]]:
    """Return a table per body for JSON; unknown values are None."""
    return [
        {
            "recording": one.source,
            "body": one.body,
            "model": one.model,
            "used": one.used,
            "rmse_m": for_json(one.rmse_m),
            "std_m": float(np.sqrt(np.mean(one.std_m**2))),
            "nis": float(np.mean(one.nis)),
            "accepted": float(np.mean(one.accepted)),
            "restarts_s": list(one.restarts_s),
            **delays_json(one),
        }
        for one in found
    ]
