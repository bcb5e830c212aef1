"""What a calibration is worth to a robot: an EKF that tracks one body from its ranges to the others.

State is the body's position; its velocity and attitude are inputs taken from motion capture, velocity with noise; the
other bodies are known (ICRA 2023, section V). Three filters see the same ranges: raw with a fixed variance,
calibrated with a fixed variance, and calibrated with the variance of the sigma curve.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.model import Calibration, require_calibration
from calib.errors import UnanswerableError
from calib.sources import Data, Flight, load_flight
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.distances import antennas_m, bodies_m

FILTERS: Final = ("raw", "calibrated", "variance")
PAPER_RMSE_M: Final = {"raw": 0.804, "calibrated": 0.500, "variance": 0.431}
"""Mean over six scenarios (ICRA 2023, Table II)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How the filter is set up.

    The velocity input comes at `velocity_rate_hz` with white noise of `velocity_std_mps` an axis; a range is taken
    when its squared innovation over its variance is below `gate` (chi-square with one degree of freedom; 10.83 is
    its 99.9 % quantile). After `reopen` refusals in a row the filter widens its uncertainty by `initial_std_m`, so
    that it cannot lock itself out.
    """

    velocity_std_mps: float = 0.3
    velocity_rate_hz: float = 100.0
    initial_std_m: float = 0.1
    fixed_std_m: float | None = None
    gate: float = 10.83
    reopen: int = 25
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """How one filter did: times (n,), estimates and truth (n, 3), normalised errors, and what was refused.

    `std_m` (n,) is the filter's own opinion of its error: the root of the sum of its three variances.
    """

    time_ns: Ints
    estimate_m: Floats
    truth_m: Floats
    std_m: Floats
    nis: Floats
    nees: Floats
    accepted: Bools

    def __repr__(self) -> str:
        """Return its length and how far off it is, on one line."""
        return f"track of {len(self.time_ns)} ranges, rms error {self.rmse_m:.3f} m"

    @property
    def rmse_m(self) -> float:
        """Root of the mean squared distance between estimate and truth."""
        return float(np.sqrt(np.mean(np.sum((self.estimate_m - self.truth_m) ** 2, axis=1))))


@dataclass(frozen=True, slots=True)
class Localization:
    """One body of one recording: a track for each of `FILTERS`."""

    source: str
    body: str
    tracks: dict[str, Track]

    def __repr__(self) -> str:
        """Return how far off each track is, on one line."""
        found = ", ".join(f"{name} {track.rmse_m:.3f} m" for name, track in self.tracks.items())
        return f"{self.body} of {self.source}: rms error {found}"


def localize(data: Data | Flight, calibration: Calibration, settings: Settings | None = None) -> list[Localization]:
    """Track every body that moves and ranges in a recording, one at a time, with an extended Kalman filter.

    `data` is the path of a recording, an open `Recording`, or anything with `exchanges`, `poses` and `tags`. Raises
    what `Calibration.apply` raises, and `UnanswerableError` where no body moves or the recording has no poses.

    >>> import calib
    >>> known = calib.fit(calib.sample_flight()).calibration
    >>> found = calib.localize(calib.sample_flight(seed=2), known)
    >>> [one.body for one in found]
    ['robot1', 'robot2', 'robot3']
    >>> found[0].tracks["calibrated"].rmse_m < 0.1
    True
    """
    require_calibration(calibration)
    chosen = settings or Settings()
    flight = data if isinstance(data, Flight) else load_flight(data)
    ranges = flight.ranges
    applied = calibration.apply(ranges)
    error = applied.raw_m - ranges.truth_m
    fixed = chosen.fixed_std_m or float(np.std(error))
    measured = {"raw": applied.raw_m, "calibrated": applied.corrected_m, "variance": applied.corrected_m}
    std = {"raw": np.full(len(ranges), fixed), "calibrated": np.full(len(ranges), fixed), "variance": applied.sigma_m}
    found = []
    for body in flight.moving_bodies():
        problem = _problem(flight, body)
        if problem is None:
            continue
        tracks = {
            stage: _filter(problem, measured[stage][problem.rows], std[stage][problem.rows], chosen)
            for stage in FILTERS
        }
        found.append(Localization(ranges.source, body, tracks))
    if not found:
        raise UnanswerableError(
            f"{ranges.source}: no body moves among poses and ranges, so there is nothing to localize"
        )
    return found


@dataclass(frozen=True, slots=True)
class _Problem:
    """What is known of one body at each of its ranges: rows of the flight, true place, own lever arm turned into the
    world, and the other antenna's place, (n, 3) each."""

    rows: Ints
    time_ns: Ints
    place: Floats
    arm: Floats
    other: Floats


def _problem(flight: Flight, body: str) -> _Problem | None:
    mine = {tag.tag for tag in flight.tags if tag.body == body}
    ranges = flight.ranges
    first, second = (np.isin(ids, list(mine)) for ids in (ranges.initiator, ranges.target))
    rows = np.flatnonzero(first ^ second)
    if not len(rows):
        return None
    rows = rows[np.argsort(ranges.time_ns[rows], kind="stable")]
    time = ranges.time_ns[rows]
    own = np.where(first[rows], ranges.initiator[rows], ranges.target[rows])
    other = np.where(first[rows], ranges.target[rows], ranges.initiator[rows])
    place = bodies_m(flight.poses, body, time)
    antenna = antennas_m(flight.poses, flight.tags, own, time)
    away = antennas_m(flight.poses, flight.tags, other, time)
    known = np.isfinite(place).all(axis=1) & np.isfinite(antenna).all(axis=1) & np.isfinite(away).all(axis=1)
    return _Problem(rows[known], time[known], place[known], (antenna - place)[known], away[known])


def _filter(problem: _Problem, measured_m: Floats, std_m: Floats, settings: Settings) -> Track:
    rng = np.random.default_rng(settings.seed)
    count = len(problem.rows)
    dt = np.diff(problem.time_ns, prepend=problem.time_ns[:1]) * 1e-9
    spread = settings.velocity_std_mps**2 / settings.velocity_rate_hz * np.maximum(dt, 0)
    moves = np.diff(problem.place, axis=0, prepend=problem.place[:1])
    moves = moves + rng.normal(size=(count, 3)) * np.sqrt(spread)[:, None]
    variance = std_m**2
    x = problem.place[0] + rng.normal(size=3) * settings.initial_std_m
    p = np.eye(3) * settings.initial_std_m**2
    estimate, nis, nees, opinion = np.empty((count, 3)), np.empty(count), np.empty(count), np.empty(count)
    accepted, refused = np.zeros(count, dtype=bool), 0
    eye = np.eye(3)
    for k in range(count):
        x = x + moves[k]
        p = p + spread[k] * eye
        towards = x + problem.arm[k] - problem.other[k]
        distance = float(np.sqrt(towards @ towards))
        h = towards / max(distance, 1e-6)
        gain = p @ h
        s = float(h @ gain) + variance[k]
        innovation = measured_m[k] - distance
        nis[k] = innovation**2 / s
        if nis[k] < settings.gate:
            x = x + gain * (innovation / s)
            p = p - np.outer(gain, gain) / s
            accepted[k], refused = True, 0
        else:
            refused += 1
            if refused >= settings.reopen:
                p, refused = p + eye * settings.initial_std_m**2, 0
        estimate[k] = x
        opinion[k] = p[0, 0] + p[1, 1] + p[2, 2]
        wrong = x - problem.place[k]
        nees[k] = wrong @ np.linalg.solve(p, wrong)
    return Track(
        time_ns=problem.time_ns,
        estimate_m=estimate,
        truth_m=problem.place,
        std_m=np.sqrt(opinion),
        nis=nis,
        nees=nees,
        accepted=accepted,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Over all bodies of all recordings: mean RMSE by stage, its reduction, mean NIS and NEES of the last stage.

    `nis` is over accepted ranges, of which a gate at 99.9 % leaves 0.99; `nees` should be 3, a state's dimension.
    `nis_bounds` and `nees_bounds` hold 95 % of such means if the filter is consistent: chi-square over the number of
    independent values (Bar-Shalom, Li and Kirubarajan 2001, section 5.4), where a NEES counts once in the time that the
    error takes to forget. `nis_inside` and `nees_inside` are the shares of single values within their 95 % bounds.
    """

    rmse_m: dict[str, float]
    reduction: dict[str, float]
    nis: float
    nis_bounds: tuple[float, float]
    nis_inside: float
    nees: float
    nees_bounds: tuple[float, float]
    nees_inside: float
    accepted: float


def summarize(found: list[Localization]) -> Summary:
    """Average over bodies and recordings, each counting the same, as in the paper."""
    rmse = {stage: float(np.mean([one.tracks[stage].rmse_m for one in found])) for stage in FILTERS}
    last = [one.tracks["variance"] for one in found]
    nis = np.concatenate([track.nis[track.accepted] for track in last])
    nees = np.concatenate([track.nees for track in last])
    return Summary(
        rmse_m=rmse,
        reduction={stage: 1 - rmse[stage] / rmse["raw"] for stage in FILTERS[1:]},
        nis=float(np.mean(nis)),
        nis_bounds=_bounds(len(nis), 1),
        nis_inside=_inside(nis, 1),
        nees=float(np.mean(nees)),
        nees_bounds=_bounds(sum(_independent(track.nees) for track in last), 3),
        nees_inside=_inside(nees, 3),
        accepted=float(np.mean([np.mean(track.accepted) for track in last])),
    )


def _bounds(count: float, degrees: int) -> tuple[float, float]:
    """Bounds that hold the mean of `count` independent chi-squares with 95 %."""
    from scipy.stats import chi2

    some = max(count, 1.0)
    return float(chi2.ppf(0.025, some * degrees) / some), float(chi2.ppf(0.975, some * degrees) / some)


def _inside(values: Floats, degrees: int) -> float:
    from scipy.stats import chi2

    low, high = float(chi2.ppf(0.025, degrees)), float(chi2.ppf(0.975, degrees))
    return float(np.mean((values >= low) & (values <= high)))


def _independent(values: Floats) -> float:
    """Return how many independent values a correlated series is worth: n over the sum of its autocorrelations.

    The sum ends where the autocorrelation first falls below a twentieth.
    """
    centred = values - values.mean()
    size = 1 << int(2 * len(centred) - 1).bit_length()
    power = np.abs(np.fft.rfft(centred, size)) ** 2
    correlation = np.fft.irfft(power, size)[: len(centred)]
    correlation = correlation / max(float(correlation[0]), 1e-300)
    small = np.flatnonzero(correlation < 0.05)
    end = int(small[0]) if len(small) else len(centred)
    return len(centred) / (1 + 2 * float(correlation[1:end].sum()))


def as_tum(track: Track) -> str:
    """Return an estimated trajectory in TUM form, without rotation: only the position is estimated."""
    rows = [
        f"{time * 1e-9:.9f} {x:.6f} {y:.6f} {z:.6f} 0 0 0 1"
        for time, (x, y, z) in zip(track.time_ns.tolist(), track.estimate_m.tolist(), strict=True)
    ]
    return "# time x y z qx qy qz qw\n" + "\n".join(rows) + "\n"
