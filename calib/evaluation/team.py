"""Relative poses of a team of robots from ranges, overheard frames and IMUs, without anchors or motion capture.

All robots are estimated together in the frame of one of them (`calib.evaluation.filters.RelativeFilter`). Poses of the
recording are used only for the start, with noise of a stated size, and for evaluation. Rows are those of
`calib.evaluation.tracking`: sums of distances with signs, of which differences of arrival of one exchange share an
error. Several filters run in parallel, with different models of range errors, with and without overheard frames.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import numpy as np
from scipy.spatial.transform import Rotation

from calib.calibration.applying import keep_determined
from calib.calibration.document import for_json
from calib.calibration.error_model import GATE
from calib.calibration.model import CalibrationSource, given_calibration
from calib.data.ranges import Ranges
from calib.data.sources import Data, load_flight, require_times
from calib.errors import BadInputError, UnanswerableError, WeakHeadingWarning
from calib.evaluation.filters import (
    BODY,
    A,
    EndPattern,
    P,
    ProcessNoise,
    RelativeFilter,
    V,
    end_patterns,
    squared_over,
    turned_by,
    without_directions,
)
from calib.evaluation.localization import Localization, consistency, delay_lines, delays_json, filter_ranges, fixed_std
from calib.evaluation.models import FilterBank, FilterRanges, ModelAverage
from calib.evaluation.onboard import inertial_readings, mean_readings
from calib.evaluation.tracking import Measurements, Settings, Track, ranges_among, used_part
from calib.pairs import pairs_of
from calib.settings import CheckedSettings
from uwblink.arrays import Bools, Floats, Ints
from uwblink.display import first_few, printable
from uwblink.errors import warn
from uwblink.recording.distances import tracks_of
from uwblink.recording.schema import Poses, Tag
from uwblink.settings import setting

BASELINES: Final = (", own ranges", ", ranges only")
"""Suffixes of the names of filters without overheard frames: with the ranges of the reference only, as measured by the
robot's own tags; with the ranges of the whole team."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamSettings(CheckedSettings):
    """How relative poses are estimated, in the frame of the body `reference`, by default the first by name.

    The start is the relative pose and velocity at the first exchange with noise of `start_std_m` and `start_std_m_s` an
    axis and `start_std_deg` about each, drawn from `seed`. `use` is "exchanges", or "receptions": also overheard
    frames. Poses are predicted at every exchange and `rate_hz` times a second. A range is accepted if its squared
    innovation over its variance is below `gate`. With `online` one more filter has delays as states. `noise` is the
    noise of the IMUs.

    >>> import calib
    >>> calib.TeamSettings(use="receptions").start_std_deg
    3.0
    """

    use: str = setting("exchanges", "Measurements to use.", names=("exchanges", "receptions"))
    reference: str | None = None
    start_std_m: float = 0.1
    start_std_deg: float = 3.0
    start_std_m_s: float = 0.1
    rate_hz: float = 50.0
    gate: float = GATE
    seed: int = 0
    online: bool = False
    noise: ProcessNoise = field(default_factory=ProcessNoise)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RelativeTrack(Track):
    """Poses of a body in the frame of another: positions (n, 3), attitudes x y z w (n, 4), and the true ones.

    `nees` (n,) are for positions and attitudes, with six degrees of freedom.
    """

    DEGREES: ClassVar[int] = 6

    @property
    def attitude_rmse_deg(self) -> float:
        """Root of the mean squared angle between estimate and truth, NaN without truth."""
        if not self.known.any():
            return np.nan
        estimate, truth = (Rotation.from_quat(some[self.known]) for some in (self.attitude, self.true_attitude))
        return float(np.degrees(np.sqrt(np.mean((estimate.inv() * truth).magnitude() ** 2))))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RelativePose(Localization):
    """One body of a team, in the frame of another: tracks by filter (`FILTERS`), with the measurements that the
    settings select.

    Further tracks are "dead reckoning" and, if overheard frames are used, the tracks without them (`BASELINES`).
    """

    reference: str

    @property
    def label(self) -> str:
        """Both bodies in names of files."""
        return f"{self.body}-from-{self.reference}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Team(Measurements):
    """A recording: bodies with IMUs, the reference last, and measurements (n,) between them.

    `body` (n, k, 2) and `arm` (n, k, 2, 3) are body and lever arm of the ends of distances, `sides` (n, k) the numbers
    of their pairs of bodies. `readings` are times in seconds and inertial readings of each body.
    """

    bodies: list[str]
    body: Ints
    arm: Floats
    sides: Ints
    readings: list[tuple[Floats, Floats]]
    poses: Poses

    def points_m(self, time_ns: Ints) -> Floats:
        """Return points of each body in the world, a metre along its axes and its centre, NaN without a pose.

        The shape is (bodies, n, 4, 3).
        """
        tracks, points = tracks_of(self.poses), np.full((len(self.bodies), len(time_ns), 4, 3), np.nan)
        for one, body in zip(points, self.bodies, strict=True):
            if body in tracks:
                one[:] = np.stack([tracks[body].point_m(time_ns, at).T for at in np.eye(4)[:, :3]], axis=1)
        return points

    def relative_poses(self, time_ns: Ints) -> tuple[Floats, Floats]:
        """Return positions (n, bodies, 3) and attitudes (n, bodies, 3, 3) in the frame of the reference, which is left
        out.

        Without poses, positions are NaN and attitudes the identity.
        """
        points = self.points_m(time_ns)
        middle = points[-1, :, 3:]
        found = np.einsum("bnpi,nai->nbpa", points[:-1] - middle, points[-1, :, :3] - middle)
        place, turned = found[:, :, 3], (found[:, :, :3] - found[:, :, 3:]).swapaxes(2, 3)
        return place, np.where(np.isfinite(place[..., None]), turned, np.eye(3))

    def start(self) -> tuple[Floats, Floats, Floats]:
        """Return positions, velocities (bodies, 3) and attitudes (bodies, 3, 3) at the first exchange.

        Velocities are derivatives of parabolas through poses of the first 0.2 s.
        """
        points = self.points_m(self.time_ns[0] + 10**8 * np.arange(3))
        place, turned = self.relative_poses(self.time_ns[:1])
        speed = np.einsum("bni,n->bi", points[:-1, :, 3] - points[-1, :, 3], [-15.0, 20.0, -5.0])
        return place[0], speed @ (points[-1, 0, :3] - points[-1, 0, 3]).T, turned[0]


def localize_team(
    data: Data, calibration: CalibrationSource, settings: TeamSettings | None = None
) -> list[RelativePose]:
    """Estimate the poses of robots in the frame of one of them by IMUs and ranges, with and without calibration.

    `data` is what `localize_onboard` takes. Bodies without inertial readings, and so anchors, are left out. Robots with
    one tag are estimated with a `WeakHeadingWarning`. Raises what `Calibration.apply` raises, and `UnanswerableError`
    if fewer than two robots have inertial readings, if these do not range with each other, if overheard frames are to
    be used but absent, and if poses do not give the start.

    >>> import calib
    >>> known = calib.fit(calib.sample_flight()).calibration
    >>> calib.localize_team(calib.sample_flight(), known)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    calib.errors.UnanswerableError: memory: inertial readings of 0 bodies with tags (none), ...
    """
    calibration = given_calibration(calibration)
    chosen = settings or TeamSettings()
    flight = load_flight(data, need_power=calibration.needs_power, need_truth=False, sensors=("imu",))
    require_times(flight.ranges)
    ranges = keep_determined(calibration, flight.ranges)
    team = _team(ranges, flight.poses, flight.tags, flight.sensors["imu"], chosen)
    fixed = fixed_std(calibration, Settings())
    every = filter_ranges(without_directions(team.ranges), calibration, fixed, online=chosen.online)
    measured = {name: one.at(team.rows) for name, one in every.items()}
    heard = team.heard
    filters = {"dead reckoning": (measured["raw"], np.zeros_like(heard))}
    if chosen.use == "receptions":
        own = ~heard & (team.body == len(team.bodies) - 1).any(axis=(1, 2))
        for end, used in zip(BASELINES, (own, ~heard), strict=True):
            filters |= {name + end: (one, used) for name, one in measured.items()}
    filters |= {name: (one, np.ones_like(heard)) for name, one in measured.items()}
    return [
        RelativePose(
            source=ranges.source,
            body=body,
            reference=team.bodies[-1],
            tracks=dict(tracks),
            rmse_m={name: np.array([track.rmse_m]) for name, track in tracks.items()},
            fixed=fixed,
            simulated=ranges.planted is not None,
            arrivals=int(np.count_nonzero(heard)),
        )
        for body, tracks in _run(team, filters, end_patterns(calibration, team.ends, team.sign, {}), chosen).items()
    ]


def _team(ranges: Ranges, poses: Poses, tags: Sequence[Tag], imu: Mapping[str, Any], settings: TeamSettings) -> _Team:
    """Return the measurements between bodies that have inertial readings, and warn of those with one tag."""
    name, sensing = ranges.source, sorted({tag.body for tag in tags} & set(np.unique(imu.get("body", [])).tolist()))
    if len(sensing) < 2:
        raise UnanswerableError(
            f"{name}: inertial readings of {len(sensing)} bodies with tags ({', '.join(sensing) or 'none'}), but "
            f"relative poses need two or more; record or import the table imu"
        )
    reference = settings.reference or sensing[0]
    if reference not in sensing:
        raise BadInputError(f"found {reference!r:.60}, {name} has {', '.join(sensing)}", parameter="reference")
    bodies = [*(body for body in sensing if body != reference), reference]
    mine = [tag for tag in tags if tag.body in bodies]
    members = [tag.tag for tag in mine]
    ranges = used_part(ranges_among(ranges, members), settings.use)
    numbers, arms = np.zeros(max(members) + 1, dtype=np.int64), np.zeros((max(members) + 1, 3))
    numbers[members], arms[members] = [bodies.index(tag.body) for tag in mine], [tag.lever_arm_m for tag in mine]
    found = Measurements.of(ranges, lambda ends: np.asarray(np.diff(numbers[ends])[..., 0] != 0))
    if not len(found):
        raise UnanswerableError(f"{name}: the tags of {', '.join(bodies)} do not range with each other")
    single = [one for one, count in Counter(numbers[np.unique(found.ends)].tolist()).items() if count == 1]
    if single:
        warn(
            f"{name}: {first_few(bodies[one] for one in single)} has only one tag that ranges or listens: its heading "
            "is weakly observable, from motion only",
            WeakHeadingWarning,
        )
    time_ns, body = found.time_ns, numbers[found.ends]
    readings = [inertial_readings(imu, one, int(time_ns[0])) for one in bodies]
    last_s = float(np.ptp(time_ns)) * 1e-9
    for one, (time_s, _) in zip(bodies, readings, strict=True):
        # Beyond the first and last reading they are taken as constant, for a tenth of a second at most.
        if time_s[0] > 0.1 or time_s[-1] < last_s - 0.1:
            raise UnanswerableError(
                f"{name}: inertial readings of {one} cover {time_s[0]:.1f} to {time_s[-1]:.1f} s after the first "
                f"exchange, but the last exchange is at {last_s:.1f} s"
            )
    return _Team(
        **found.to_dict(),
        ranges=ranges,
        bodies=bodies,
        body=body,
        arm=arms[found.ends],
        sides=pairs_of(*np.moveaxis(body, 2, 0)).number,
        readings=readings,
        poses=poses,
    )


def _start(team: _Team, settings: TeamSettings, filters: int) -> RelativeFilter:
    """Return filters that begin at the relative poses of the first exchange with noise; they get no other
    true value.
    """
    place, speed, attitude = team.start()
    lost = [body for body, one in zip(team.bodies, place + speed, strict=False) if not np.isfinite(one).all()]
    if lost:
        raise UnanswerableError(
            f"{team.ranges.source}: no poses of {lost[0]} and {team.bodies[-1]} at the first exchange, where the "
            f"estimate starts; import poses that cover it"
        )
    turn_std, noise = np.radians(settings.start_std_deg), settings.noise
    stds = settings.start_std_m, settings.start_std_m_s, turn_std, noise.gyro_start, noise.force_start
    spread = np.concatenate([np.tile(np.repeat(stds, 3), len(place)), np.repeat(stds[3:], 3)])
    rng = np.random.default_rng([settings.seed, zlib.crc32(team.time_ns.tobytes())])
    place = place + rng.normal(size=place.shape) * settings.start_std_m
    attitude = attitude @ Rotation.from_rotvec(rng.normal(size=place.shape) * turn_std).as_matrix()
    start = np.tile(place, (filters, 1, 1)), np.tile(attitude, (filters, 1, 1, 1))
    found = RelativeFilter(*start, spread, noise, moving=True)
    found.own[..., V] = speed + rng.normal(size=speed.shape) * settings.start_std_m_s
    return found


def _run(
    team: _Team,
    filters: Mapping[str, tuple[FilterRanges, Bools]],
    patterns: list[list[EndPattern]],
    settings: TeamSettings,
) -> dict[str, dict[str, RelativeTrack]]:
    """Run filters on the measurements that each uses (n,); return the tracks of each body by filter.

    States are those of `RelativeFilter`, non-linear parts of distances by pairs of bodies in units of their standard
    deviation, and those of `FilterBank`.
    """
    # Raw ranges are not corrected, also not for patterns.
    raw = filters["dead reckoning"][0]
    corrected = np.array([one is not raw for one, _ in filters.values()])
    known, uses = [one for one, _ in filters.values()], np.stack([used for _, used in filters.values()], axis=1)
    running = _start(team, settings, len(known))
    sides = running.append(np.eye(team.sides.max() + 1))
    bank = FilterBank(known, running, settings.gate, uses, team.pair, team.sign)
    steps = np.arange(team.time_ns[0], team.time_ns[-1], round(1e9 / settings.rate_hz))
    time_ns = np.unique(np.concatenate([team.time_ns, steps]))
    time_s = (time_ns - time_ns[0]) * 1e-9
    inertial = np.stack([mean_readings(*one, time_s) for one in team.readings], axis=1)
    firsts, elapsed_s = np.append(np.searchsorted(team.time_ns, time_ns), len(team.rows)), team.elapsed_s
    truth, turned = team.relative_poses(time_ns)
    shape, same_exchange = (len(time_ns), len(bank.average.shown), len(team.bodies) - 1), team.same_exchange
    place, attitude, std_m, nees = np.empty((*shape, 3)), np.empty((*shape, 3, 3)), np.empty(shape), np.empty(shape)
    for k in range(len(time_ns)):
        if k:
            running.predict(time_s[k] - time_s[k - 1], inertial[k - 1, :-1], inertial[k - 1, -1])
        for row in range(firsts[k], firsts[k + 1]):
            if not same_exchange[row]:
                # Errors of the state across the line of sight last for 5 s.
                running.decay(sides, np.exp([-elapsed_s[row] / 5.0]))
                bank.pass_time(elapsed_s[row], same_exchange=False)
            geometry = team.body[row], team.arm[row], team.sign[row]
            expected, slopes, bent_m = running.distances(*geometry)
            expected += corrected * running.longer_m(*geometry, patterns[row])
            for which, side in enumerate(team.sides[row].tolist()):
                slopes[:, sides.start + side] += team.sign[row, which] * bent_m[:, which]
            bank.observe(row, slopes, expected)
        place[k], attitude[k], covariance = _mean_poses(running, bank.average)
        turns = Rotation.from_matrix((attitude[k].swapaxes(2, 3) @ turned[k]).reshape(-1, 3, 3)).as_rotvec()
        wrong = np.concatenate([truth[k] - place[k], turns.reshape(place[k].shape)], axis=-1)
        nees[k] = squared_over(wrong, covariance)
        std_m[k] = np.sqrt(np.trace(covariance[..., P, P], axis1=-2, axis2=-1))

    def track(f: int, b: int) -> RelativeTrack:
        return RelativeTrack(
            time_ns=time_ns,
            attitude=Rotation.from_matrix(attitude[:, f, b]).as_quat(),
            estimate_m=place[:, f, b],
            truth_m=truth[:, b],
            true_attitude=np.where(np.isfinite(truth[:, b, :1]), Rotation.from_matrix(turned[:, b]).as_quat(), np.nan),
            std_m=std_m[:, f, b],
            nees=nees[:, f, b],
            **bank.outcome(f),
        )

    names = [name for name, (one, _) in filters.items() if one.shown]
    return {body: {name: track(f, b) for f, name in enumerate(names)} for b, body in enumerate(team.bodies[:-1])}


def _mean_poses(running: RelativeFilter, average: ModelAverage) -> tuple[Floats, Floats, Floats]:
    """Return mean positions (shown, bodies, 3), attitudes (shown, bodies, 3, 3) and covariances of both (shown, bodies,
    6, 6).

    Attitudes are averaged as rotation vectors relative to those of the likeliest model.
    """
    bodies, likeliest = running.attitude[:, :-1], average.weights.argmax(axis=1)
    away = Rotation.from_matrix((bodies[likeliest, None].swapaxes(-1, -2) @ bodies).reshape(-1, 3, 3)).as_rotvec()
    places = np.broadcast_to(running.own[..., P], (len(likeliest), *running.own.shape[:2], 3))
    pose = BODY * np.arange(running.bodies)[:, None] + np.r_[P, A]
    state, covariance = average.moments(
        np.concatenate([places, away.reshape(places.shape)], axis=-1),
        running.covariance[:, pose[:, :, None], pose[:, None]],
    )
    return state[..., :3], bodies[likeliest] @ turned_by(state[..., 3:]), covariance


def team_text(found: list[RelativePose], settings: TeamSettings) -> str:
    """Return a table with a row for each filter: means over bodies and recordings."""
    rows, noise, fixed = _figures(found), settings.noise, found[0].fixed
    title = f"pose in the frame of {printable(found[0].reference)}"
    lines = [f"{title:36s}{'RMSE (m)':>10s}{'(deg)':>8s}{'NEES':>9s}  95 % bounds   accepted"]
    for name, one in rows.items():
        low, high = one["nees_bounds"]
        lines.append(
            f"{name:36s}{one['rmse_m']:10.3f}{one['attitude_rmse_deg']:8.2f}{one['nees']:9.2f}"
            f"  {low:4.2f} to {high:5.2f}{100 * one['accepted']:9.1f} %".replace("nan %", "    -")
        )
    lines += [
        f"start: relative poses within {settings.start_std_m:g} m, {settings.start_std_deg:g} deg and "
        f"{settings.start_std_m_s:g} m/s per axis (standard deviations); later poses are used only as true poses",
        f"IMU: {noise.force:g} m/s^2 and {noise.gyro:g} rad/s a root of Hz, biases of {noise.force_start:g} m/s^2 and "
        f"{noise.gyro_start:g} rad/s that wander by {noise.force_bias:g} and {noise.gyro_bias:g} a root of a second",
        f"fixed standard deviations, {fixed.source}: raw {fixed.std_m['raw']:.3f} m, calibrated "
        f"{fixed.std_m['calibrated']:.3f} m; NEES should be {RelativeTrack.DEGREES}",
    ]
    lines += delay_lines(found[0].source, found[0].tracks.get("online"))
    for end, less in _reductions(rows).items():
        changes = ", ".join(f"{name} {-100 * share:+.0f} %" for name, share in less.items())
        lines.append(
            f"change of position errors by overheard frames, compared with {end}: {changes}; arXiv "
            f"2304.03837 reports up to -48 %"
        )
    return "\n".join(lines)


def team_json(found: list[RelativePose]) -> dict[str, Any]:
    """Return what `calib localize --model team --json` prints: figures by body and filter, and their means."""
    rows = [
        {"recording": one.source, "body": one.body, "reference": one.reference, "filters": for_json(_figures([one]))}
        | delays_json(one.tracks.get("online"))
        for one in found
    ]
    summary = _figures(found)
    return {"bodies": rows, "summary": for_json(summary), "reduction_by_listening": for_json(_reductions(summary))}


def _reductions(rows: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Return the relative reduction of the position's RMSE by overheard frames, by baseline and filter."""
    both = {end[2:]: {name: name + end for name in rows if name + end in rows} for end in BASELINES}
    return {
        end: {name: 1 - rows[name]["rmse_m"] / rows[other]["rmse_m"] for name, other in names.items()}
        for end, names in both.items()
        if names
    }


def _figures(found: list[RelativePose]) -> dict[str, dict[str, Any]]:
    """Return means over bodies and recordings by filter: RMSE, NEES with bounds, and the share that passes the gate."""
    table = dict[str, dict[str, Any]]()
    for name in found[0].tracks:
        tracks: list[Any] = [one.tracks[name] for one in found]
        mean, bounds, inside = consistency(tracks)
        shares = [track.accepted.mean() for track in tracks if len(track.accepted)]
        table[name] = {
            "rmse_m": float(np.mean([track.rmse_m for track in tracks])),
            "attitude_rmse_deg": float(np.mean([track.attitude_rmse_deg for track in tracks])),
            "nees": mean,
            "nees_bounds": bounds,
            "nees_inside": inside,
            "accepted": float(np.mean(shares)) if shares else np.nan,
        }
    return table
