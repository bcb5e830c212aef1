"""What a calibration is worth to a robot: an EKF that tracks one body from its ranges to the others.

State is the body's position; its velocity and attitude are inputs taken from motion capture, velocity with noise; the
other bodies are known (ICRA 2023, section V). Four filters see the same ranges and the same noise of velocity: raw and
calibrated with fixed variances, calibrated with the variance of the sigma curve, and calibrated with all that a
calibration says of errors, reflections included. `calib.evaluation.onboard` does without motion capture.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.calibration.model import Calibration, CorrectedRanges, require_calibration
from calib.errors import BadInputError, UnanswerableError
from calib.evaluation.multilateration import multilaterate
from calib.evaluation.range_updates import Heard, RangeErrors, gated, weighed
from calib.ranges import Ranges
from calib.sources import Data, Flight, load_flight
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.distances import antennas_m, bodies_m
from uwblink.recording.schema import Poses

FILTERS: Final = ("raw", "calibrated", "variance", "robust")
ROBUST: Final = "robust"
PAPER_RMSE_M: Final = {"raw": 0.804, "calibrated": 0.500, "variance": 0.431}
"""Mean over six scenarios (ICRA 2023, its only table): flights of its own, another filter's noise."""

TUNED_OVER: Final = (0.04, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.6, 1.0)
"""Fixed standard deviations that are tried, in metres."""

TUNED_RANGES: Final = 2500
"""Ranges of each body of a training flight by which they are judged."""

FEWEST_IN_WINDOW: Final = 12
LOOK_EVERY: Final = 8
LOST_NIS: Final = 9.0
"""Where half of the latest ranges are off by more than three standard deviations, a filter is not where it thinks."""

LEAST_OUTLIERS: Final = 1e-3
LEAST_OUTLIER_M: Final = 3.0
"""What a filter has to reckon with that a calibration has not seen: a thousandth of any size."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How the filters are set up.

    The velocity input comes at `velocity_rate_hz` with white noise of `velocity_std_mps` an axis; that is the process
    noise. Percentages depend on it: the noisier velocity, the more the ranges decide. Filters begin at the true place,
    but for noise of `initial_std_m` and an `initial_offset_m` that they do not know of. A range is taken when its
    squared innovation over its variance is below `gate` (chi-square with one degree of freedom; 10.83 is its 99.9 %
    quantile); the robust filter has no gate. A filter that cannot explain half of the ranges of the last `reopen_s`
    begins anew where they say (`multilaterate`), so that it finds back from anywhere. `seeds` are runs with other
    noise, each body and flight with its own; tracks are those of the first, `seed`.
    """

    velocity_std_mps: float = 0.3
    velocity_rate_hz: float = 100.0
    initial_std_m: float = 0.1
    initial_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fixed_std_m: float | None = None
    gate: float = 10.83
    reopen_s: float = 1.0
    seed: int = 0
    seeds: int = 3

    def __post_init__(self) -> None:
        """Refuse what no filter can run with; raises `BadInputError`."""
        for name in ("velocity_std_mps", "velocity_rate_hz", "initial_std_m", "gate", "reopen_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise BadInputError(f"found {getattr(self, name)!r:.40}, expected a number above 0", parameter=name)
        if not 1 <= self.seeds <= 1000:
            raise BadInputError(f"found {self.seeds!r:.40}, expected 1 to 1000", parameter="seeds")


@dataclass(frozen=True, slots=True)
class FixedStd:
    """The fixed standard deviations of ranges, by filter, and where they come from, in words."""

    std_m: dict[str, float]
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """How one filter did: times (n,), estimates and truth (n, 3), normalised errors, and what was refused.

    `std_m` (n,) is the filter's own opinion of its error: the root of the sum of its three variances. `attitude`
    (n, 4), x y z w, is the filter's input.
    """

    time_ns: Ints
    attitude: Floats
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Localization:
    """One body of one recording: a track for each of `FILTERS`, and the RMSE of each over seeds (seeds,) in metres.

    `simulated` says whether the flight was; `fixed` are the fixed variances of the filters that have one.
    """

    source: str
    body: str
    tracks: dict[str, Track]
    rmse_m: dict[str, Floats]
    fixed: FixedStd
    simulated: bool

    def __repr__(self) -> str:
        """Return how far off each filter is, over seeds, on one line."""
        found = ", ".join(f"{name} {np.mean(rmse):.3f} m" for name, rmse in self.rmse_m.items())
        return f"{self.body} of {self.source}: rms error {found}"


def localize(
    data: Data | Flight,
    calibration: Calibration,
    settings: Settings | None = None,
    *,
    training: Data | Flight | None = None,
) -> list[Localization]:
    """Track every body that moves and ranges in a recording, one at a time, with extended Kalman filters.

    `data` is the path of a recording, an open `Recording`, or anything with `exchanges`, `poses` and `tags`. The fixed
    variances are the best ones on the flight `training`; without it those of the errors that the calibration was fitted
    to, as it remembers them; never those of the flight itself, which a filter cannot know. Raises what
    `Calibration.apply` raises, and `UnanswerableError` where no body moves or the recording has no poses.

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
    flight = data if isinstance(data, Flight) else load_flight(data, need_power=calibration.needs_power)
    fixed = fixed_std(calibration, chosen, training)
    applied = calibration.apply(flight.ranges)
    found = []
    for problem in _problems(flight):
        noises = [_Noise.drawn(problem, chosen, chosen.seed + k) for k in range(chosen.seeds)]
        ranges = _filters(flight.ranges[problem.rows], applied, problem.rows, calibration, fixed.std_m)
        tracks = _run(problem, list(ranges.values()), noises, chosen)
        found.append(
            Localization(
                source=flight.ranges.source,
                body=problem.body,
                tracks={name: tracks[k][0] for k, name in enumerate(ranges)},
                rmse_m={name: np.array([track.rmse_m for track in tracks[k]]) for k, name in enumerate(ranges)},
                fixed=fixed,
                simulated=flight.ranges.planted is not None,
            )
        )
    if not found:
        raise UnanswerableError(
            f"{flight.ranges.source}: no body moves among poses and ranges, so there is nothing to localize"
        )
    return found


def fixed_std(calibration: Calibration, settings: Settings, training: Data | Flight | None = None) -> FixedStd:
    """Return the fixed standard deviations of raw and calibrated ranges, by what is known before the flight.

    The one that is given; else the best ones on a training flight; else those of the errors that the calibration was
    fitted to, or its sigma at the middle of its powers, where it is too old to remember them.
    """
    if settings.fixed_std_m is not None:
        return FixedStd(dict.fromkeys(("raw", "calibrated"), settings.fixed_std_m), "given")
    if training is not None:
        return _tuned(training if isinstance(training, Flight) else load_flight(training), calibration, settings)
    known = calibration.provenance.get("error_std_m")
    if isinstance(known, dict) and {"raw", "corrected"} <= set(known):
        return FixedStd(
            {"raw": float(known["raw"]), "calibrated": float(known["corrected"])}, "of the errors that were fitted"
        )
    middle = float(calibration.sigma_curve(np.array([np.mean(calibration.sigma_curve.range)]))[0])
    return FixedStd(dict.fromkeys(("raw", "calibrated"), middle), "the sigma curve's middle")


def _tuned(flight: Flight, calibration: Calibration, settings: Settings) -> FixedStd:
    """Return the standard deviations with which the filters err least on a flight."""
    applied = calibration.apply(flight.ranges)
    squares = np.zeros((2, len(TUNED_OVER)))
    for whole in _problems(flight):
        problem = whole.first(TUNED_RANGES)
        noises = [_Noise.drawn(problem, settings, settings.seed + k) for k in range(settings.seeds)]
        measured = (applied.raw_m[problem.rows], applied.corrected_m[problem.rows])
        ranges = [_Ranges(m, np.full(len(m), std)) for m in measured for std in TUNED_OVER]
        errors = [[track.rmse_m for track in tracks] for tracks in _run(problem, ranges, noises, settings)]
        squares += np.sum(np.array(errors) ** 2, axis=1).reshape(squares.shape)
    best = [TUNED_OVER[k] for k in np.argmin(squares, axis=1)]
    return FixedStd({"raw": best[0], "calibrated": best[1]}, f"tuned on {flight.ranges.source}")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Problem:
    """What is known of one body at each of its ranges: rows of the flight, true place, own lever arm turned into the
    world, and the other antenna's place, (n, 3) each."""

    body: str
    rows: Ints
    time_ns: Ints
    attitude: Floats
    place: Floats
    arm: Floats
    other: Floats

    def first(self, count: int) -> _Problem:
        """Return its first ranges."""
        columns = ("rows", "time_ns", "attitude", "place", "arm", "other")
        return replace(self, **{name: getattr(self, name)[:count] for name in columns})


def _problems(flight: Flight) -> list[_Problem]:
    return [problem for body in flight.moving_bodies() if (problem := _problem(flight, body)) is not None]


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
    return _Problem(
        body=body,
        rows=rows[known],
        time_ns=time[known],
        attitude=nearest_attitude(flight.poses, body, time[known]),
        place=place[known],
        arm=(antenna - place)[known],
        other=away[known],
    )


def nearest_attitude(poses: Poses, body: str, time_ns: Ints) -> Floats:
    """Return the attitude of a body at the pose nearest to each time, (n, 4)."""
    rows = np.flatnonzero(poses.body == body)
    known = poses.time_ns[rows]
    after = np.clip(np.searchsorted(known, time_ns), 1, max(len(known) - 1, 1))
    nearest = np.where(
        time_ns - known[after - 1] < known[np.minimum(after, len(known) - 1)] - time_ns, after - 1, after
    )
    return poses.quaternion[rows[np.minimum(nearest, len(rows) - 1)]]


@dataclass(frozen=True, slots=True)
class _Ranges:
    """What a filter measures (n,), its standard deviation (n,), and what errors are made of if it reckons with it."""

    measured_m: Floats
    std_m: Floats
    errors: list[RangeErrors] | None = None


def _filters(
    ranges: Ranges, applied: CorrectedRanges, rows: Ints, calibration: Calibration, fixed: dict[str, float]
) -> dict[str, _Ranges]:
    """Return what each of `FILTERS` measures; the robust one only where it is known what errors are made of."""
    raw, corrected, sigma = applied.raw_m[rows], applied.corrected_m[rows], applied.sigma_m[rows]
    found = {
        "raw": _Ranges(raw, np.full(len(rows), fixed["raw"])),
        "calibrated": _Ranges(corrected, np.full(len(rows), fixed["calibrated"])),
        "variance": _Ranges(corrected, sigma),
    }
    if calibration.errors is not None:
        noise, errors = range_errors(calibration, ranges)
        found[ROBUST] = _Ranges(corrected - calibration.errors.location_m, noise, errors)
    return found


def range_errors(calibration: Calibration, ranges: Ranges) -> tuple[Floats, list[RangeErrors]]:
    """Return the noise (n,) of corrected ranges, and what their errors are made of besides.

    Raises `UnanswerableError` for a calibration that does not say.
    """
    model = calibration.errors
    if model is None:
        raise UnanswerableError("the calibration does not say what errors are made of; fit anew from a recording")
    lifted = calibration.lifted(ranges)
    shapes = model.shapes(lifted, ranges.initiator, ranges.target)
    errors = [
        RangeErrors(
            share=float(share),
            least_m=model.least_m,
            detour_m=float(detour),
            outlier=max(model.outlier_share, LEAST_OUTLIERS),
            outlier_m=max(model.outlier_m, LEAST_OUTLIER_M),
        )
        for share, detour in zip(shapes.tail_share, shapes.detour_m, strict=True)
    ]
    return np.hypot(shapes.noise_m, calibration.bias_curve.beyond(lifted)), errors


@dataclass(frozen=True, slots=True)
class _Noise:
    """A start (3,) and displacements between ranges (n, 3), both with noise."""

    start: Floats
    moves: Floats

    @classmethod
    def drawn(cls, problem: _Problem, settings: Settings, seed: int) -> _Noise:
        """Draw the noise of a body in a flight: its own, and the same for every filter."""
        own = [zlib.crc32(part) for part in (problem.time_ns.tobytes(), problem.body.encode())]
        rng = np.random.default_rng([seed, *own])
        moves = np.diff(problem.place, axis=0, prepend=problem.place[:1])
        noise = rng.normal(size=moves.shape) * np.sqrt(_spread(problem, settings))[:, None]
        start = problem.place[0] + rng.normal(size=3) * settings.initial_std_m + settings.initial_offset_m
        return cls(start, moves + noise)


def _spread(problem: _Problem, settings: Settings) -> Floats:
    """Return by how much velocity's noise widens each axis between ranges (n,), in square metres."""
    dt = np.diff(problem.time_ns, prepend=problem.time_ns[:1]) * 1e-9
    return np.asarray(settings.velocity_std_mps**2 / settings.velocity_rate_hz * np.maximum(dt, 0))


def _run(problem: _Problem, ranges: list[_Ranges], noises: list[_Noise], settings: Settings) -> list[list[Track]]:
    """Run filters with every noise, all at once: arrays are (filters, noises, ...). Return their tracks."""
    shape, count = (len(ranges), len(noises)), len(problem.rows)
    spread, eye = _spread(problem, settings), np.eye(3)
    measured, variance = (np.array([getattr(r, name) for r in ranges]) for name in ("measured_m", "std_m"))
    variance = variance**2
    moves = np.array([noise.moves for noise in noises])
    x = np.tile([noise.start for noise in noises], (len(ranges), 1, 1))
    p = np.tile(eye * settings.initial_std_m**2, (*shape, 1, 1))
    estimate, covariance = np.empty((count, *shape, 3)), np.empty((count, *shape, 3, 3))
    nis, accepted = np.empty((count, *shape)), np.zeros((count, *shape), dtype=bool)
    began = np.zeros(shape, dtype=np.int64)
    for k in range(count):
        x = x + moves[:, k]
        p = p + spread[k] * eye
        towards = x + problem.arm[k] - problem.other[k]
        distance = np.sqrt(np.einsum("fsi,fsi->fs", towards, towards))
        h = towards / np.maximum(distance, 1e-6)[..., None]
        ph = np.matmul(p, h[..., None])[..., 0]
        innovation = measured[:, k, None] - distance
        s = np.einsum("fsi,fsi->fs", h, ph) + variance[:, k, None]
        nis[k] = innovation**2 / s
        heard = _heard(innovation, s, ranges, k, settings.gate)
        gain = ph / s[..., None]
        x = x + gain * heard.noise_m[..., None]
        p = p + gain[..., None] * gain[..., None, :] * (heard.variance_m2 - s)[..., None, None]
        for f, one in _lost(nis[: k + 1], problem, settings, began):
            window = _Window.until(problem, moves[one], k, settings.reopen_s)
            if window is not None:
                fix = multilaterate(measured[f, window.first : k + 1], window.anchor_m, 0.0)
                x[f, one], p[f, one] = fix.place_m, fix.covariance_m2
                began[f, one] = k + 1
        estimate[k], covariance[k], accepted[k] = x, p, heard.believed
    wrong = estimate - problem.place[:, None, None, :]
    nees = np.einsum("kfsi,kfsi->kfs", wrong, np.linalg.solve(covariance, wrong[..., None])[..., 0])
    std = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    return [
        [
            Track(
                time_ns=problem.time_ns,
                attitude=problem.attitude,
                estimate_m=estimate[:, f, s],
                truth_m=problem.place,
                std_m=std[:, f, s],
                nis=nis[:, f, s],
                nees=nees[:, f, s],
                accepted=accepted[:, f, s],
            )
            for s in range(shape[1])
        ]
        for f in range(shape[0])
    ]


def _lost(nis: Floats, problem: _Problem, settings: Settings, began: Ints) -> list[tuple[int, int]]:
    """Return which filters (filter, noise) cannot explain half of the latest ranges, looked at now and then.

    `nis` (n, filters, noises) are those of all ranges so far; those before a filter `began` anew do not count.
    """
    last = len(nis) - 1
    if last % LOOK_EVERY:
        return []
    first = int(np.searchsorted(problem.time_ns, problem.time_ns[last] - int(settings.reopen_s * 1e9)))
    if last + 1 - first < FEWEST_IN_WINDOW:
        return []
    lost = (np.median(nis[first:], axis=0) > LOST_NIS) & (began <= first)
    return [(int(f), int(s)) for f, s in np.argwhere(lost)]


def _heard(innovation: Floats, variance: Floats, ranges: list[_Ranges], k: int, gate: float) -> Heard:
    """Return what all filters make of range k: a gate for most, the whole of its error for those who reckon with it."""
    heard = gated(innovation, variance, gate)
    for f, one in enumerate(ranges):
        if one.errors is not None:
            own = weighed(innovation[f], variance[f], one.errors[k])
            heard.noise_m[f], heard.variance_m2[f], heard.believed[f] = own.noise_m, own.variance_m2, own.believed
    return heard


@dataclass(frozen=True, slots=True)
class _Window:
    """The latest ranges of a body: rows `first` to `last`, and where antennas would be, were it where it is now (n, 3).

    What it moved meanwhile is known from its velocity, and counted to the anchors.
    """

    first: int
    last: int
    anchor_m: Floats

    @classmethod
    def until(cls, problem: _Problem, moves: Floats, last: int, seconds: float) -> _Window | None:
        """Return the window that ends at a range, None where it holds too few or does not reach back so far."""
        began = problem.time_ns[last] - int(seconds * 1e9)
        first = int(np.searchsorted(problem.time_ns, began))
        if problem.time_ns[0] > began or last + 1 - first < FEWEST_IN_WINDOW:
            return None
        rows = slice(first, last + 1)
        since = moves[first + 1 : last + 1][::-1].cumsum(axis=0)[::-1]
        since = np.vstack([since, np.zeros(3)])
        return cls(first, last, problem.other[rows] - problem.arm[rows] + since)


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """Over all bodies of all recordings: mean RMSE by filter, its reduction, mean NIS and NEES of the variance filter.

    `rmse_m` are means over seeds, too, `spread_m` standard deviations over seeds of the mean over bodies (NaN of one
    seed). `nis` is over accepted ranges, of which a gate at 99.9 % leaves 0.99; `nees` should be 3, a state's size.
    `nis_bounds` and `nees_bounds` hold 95 % of such means if the filter is consistent: chi-square over the number of
    independent values (Bar-Shalom, Li and Kirubarajan 2001, section 5.4), where a NEES counts once in the time that the
    error takes to forget. `nis_inside` and `nees_inside` are the shares of single values within their 95 % bounds.
    """

    rmse_m: dict[str, float]
    spread_m: dict[str, float]
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
    filters = [name for name in FILTERS if all(name in one.tracks for one in found)]
    means = {name: np.mean([one.rmse_m[name] for one in found], axis=0) for name in filters}
    rmse = {name: float(np.mean(over)) for name, over in means.items()}
    last = [one.tracks["variance"] for one in found]
    nis = np.concatenate([track.nis[track.accepted] for track in last])
    nees = np.concatenate([track.nees for track in last])
    return Summary(
        rmse_m=rmse,
        spread_m={name: float(np.std(over, ddof=1)) if len(over) > 1 else np.nan for name, over in means.items()},
        reduction={name: 1 - rmse[name] / rmse["raw"] for name in filters[1:]},
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
