"""Extended Kalman filters of one body, side by side: what they are given, how they run, and what they come to.

State is the body's position; its velocity and attitude are inputs taken from motion capture, velocity with noise; the
places of the other bodies are known (ICRA 2023, section V).
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.calibration.lasting import LastingErrors
from calib.data.sources import Flight
from calib.errors import BadInputError
from calib.evaluation.range_updates import RangeErrors, RangeUpdate, gated_update, mixture_update, multilaterate
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.distances import antennas_m, bodies_m
from uwblink.recording.schema import Poses

FILTERS: Final = ("raw", "calibrated", "variance", "robust")

PATIENCE: Final = 3.0
"""Times `reopen_s` that a filter which explained its ranges for as long is given.

In a room (scenarios/room) reflections of half of the ranges last for one to two seconds, and a filter that begins anew
by them is lost by metres.
"""

MIN_RANGES_IN_WINDOW: Final = 12
"""Ranges by which a filter may be found lost: four for each coordinate."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How the filters are set up.

    The velocity input comes at `velocity_rate_hz` with white noise of `velocity_std_mps` an axis; that is the process
    noise. Percentages depend on it: the noisier velocity, the more the ranges decide. Filters begin at the true place,
    but for noise of `initial_std_m` and an `initial_offset_m` that they do not know of. A range is taken when its
    squared innovation over its variance is below `gate` (chi-square with one degree of freedom; 10.83 is its 99.9 %
    quantile); the robust filter has no gate. A filter that cannot explain half of the ranges of the last `reopen_s`
    begins anew where they say (`multilaterate`), so that it finds back from anywhere; one that explained them
    for three times as long is given that time. `seeds` are runs with other noise, each body and flight with its own;
    tracks are those of the first, `seed`.
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
        """Check the settings; raises `BadInputError`."""
        for name in ("velocity_std_mps", "velocity_rate_hz", "initial_std_m", "gate", "reopen_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise BadInputError(f"found {getattr(self, name)!r:.40}, expected a number above 0", parameter=name)
        if not 1 <= self.seeds <= 1000:
            raise BadInputError(f"found {self.seeds!r:.40}, expected 1 to 1000", parameter="seeds")


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
class Problem:
    """What is known of one body at each of its ranges: rows of the flight, true place, own lever arm turned into the
    world, and the other antenna's place, (n, 3) each; numbers of its pairs of tags (n,), from 0."""

    body: str
    rows: Ints
    time_ns: Ints
    attitude: Floats
    place: Floats
    arm: Floats
    other: Floats
    pair: Ints

    def first(self, count: int) -> Problem:
        """Return the first ranges."""
        columns = ("rows", "time_ns", "attitude", "place", "arm", "other", "pair")
        return replace(self, **{name: getattr(self, name)[:count] for name in columns})

    def velocity_spread(self, settings: Settings) -> Floats:
        """Return the variance that velocity noise adds per axis between ranges (n,), in square metres."""
        dt = np.diff(self.time_ns, prepend=self.time_ns[:1]) * 1e-9
        return np.asarray(settings.velocity_std_mps**2 / settings.velocity_rate_hz * np.maximum(dt, 0))

    def noisy(self, settings: Settings, seed: int) -> tuple[Floats, Floats]:
        """Draw a start (3,) and displacements between ranges (n, 3), both with noise.

        The noise depends on body and flight, and is the same for every filter.
        """
        own = [zlib.crc32(part) for part in (self.time_ns.tobytes(), self.body.encode())]
        rng = np.random.default_rng([seed, *own])
        moves = np.diff(self.place, axis=0, prepend=self.place[:1])
        noise = rng.normal(size=moves.shape) * np.sqrt(self.velocity_spread(settings))[:, None]
        start = self.place[0] + rng.normal(size=3) * settings.initial_std_m + settings.initial_offset_m
        return start, moves + noise


def problems(flight: Flight) -> list[Problem]:
    """Return a problem for every body of a flight that moves, and ranges while its place is known."""
    ranges, found = flight.ranges, []
    for body in flight.moving_bodies():
        mine = [tag.tag for tag in flight.tags if tag.body == body]
        first, second = (np.isin(ids, mine) for ids in (ranges.initiator, ranges.target))
        rows = np.flatnonzero(first ^ second)
        rows = rows[np.argsort(ranges.time_ns[rows], kind="stable")]
        time = ranges.time_ns[rows]
        own = np.where(first[rows], ranges.initiator[rows], ranges.target[rows])
        other = np.where(first[rows], ranges.target[rows], ranges.initiator[rows])
        place = bodies_m(flight.poses, body, time)
        antenna, away = (antennas_m(flight.poses, flight.tags, ids, time) for ids in (own, other))
        known = np.isfinite(np.hstack([place, antenna, away])).all(axis=1)
        if known.any():
            found.append(
                Problem(
                    body=body,
                    rows=rows[known],
                    time_ns=time[known],
                    attitude=nearest_attitude(flight.poses, body, time[known]),
                    place=place[known],
                    arm=(antenna - place)[known],
                    other=away[known],
                    pair=np.unique(own[known] * 2**16 + other[known], return_inverse=True)[1],
                )
            )
    return found


def nearest_attitude(poses: Poses, body: str, time_ns: Ints) -> Floats:
    """Return the attitude of a body at the pose nearest to each time, (n, 4)."""
    rows = np.flatnonzero(poses.body == body)
    known = poses.time_ns[rows]
    after = np.clip(np.searchsorted(known, time_ns), 1, max(len(known) - 1, 1))
    later = known[np.minimum(after, len(known) - 1)] - time_ns
    nearest = np.where(time_ns - known[after - 1] < later, after - 1, after)
    return poses.quaternion[rows[np.minimum(nearest, len(rows) - 1)]]


@dataclass(frozen=True, slots=True)
class FilterRanges:
    """What a filter measures (n,), its standard deviation (n,), and what errors are made of if it reckons with it.

    With `lasting`, ranges of a pair share errors that last, in units of `sigma_m` (n,), about zero.
    """

    measured_m: Floats
    std_m: Floats
    errors: RangeErrors | None = None
    lasting: LastingErrors | None = None
    sigma_m: Floats | None = None


@dataclass(frozen=True, slots=True)
class Run:
    """A body, and what some filters measure of it, by name."""

    problem: Problem
    ranges: Mapping[str, FilterRanges]


def run_filters(runs: Sequence[Run], settings: Settings) -> list[dict[str, list[Track]]]:
    """Run filters with every noise; return the tracks of each run by filter, a noise each. All have the same filters.

    A state is the position, and for each pair of tags the error that its ranges share: a Gauss-Markov process of first
    order, in units of sigma (Bar-Shalom, Li and Kirubarajan 2001, section 8.2); zero without lasting errors.

    Bodies run side by side: arrays are by time, filter, and a column a body and noise. Runs that end before the
    longest one stand still then, and go on measuring what they measured last.
    """
    if not runs:
        return []
    count, body = max(len(run.problem.rows) for run in runs), np.repeat(np.arange(len(runs)), settings.seeds)

    def stacked(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return arrays (some, ...) stacked to (count, parts, ...); shorter ones repeat their last row."""
        return np.stack([part[np.minimum(np.arange(count), len(part) - 1)] for part in parts], axis=1)

    measured = stacked([np.array([one.measured_m for one in run.ranges.values()]).T for run in runs])
    variance = stacked([np.array([one.std_m for one in run.ranges.values()]).T for run in runs]) ** 2
    seeds = range(settings.seed, settings.seed + settings.seeds)
    noises = [run.problem.noisy(settings, seed) for run in runs for seed in seeds]
    moves = stacked([np.vstack([own, np.zeros(3)]) for _, own in noises])
    spread = stacked([np.append(run.problem.velocity_spread(settings), 0.0) for run in runs])
    place, arm, other = (stacked([getattr(run.problem, name) for run in runs]) for name in ("place", "arm", "other"))
    errors = [_stacked_errors([run.ranges[name].errors for run in runs], count) for name in runs[0].ranges]

    sigma = stacked([np.array([_shared_sigma(one) for one in run.ranges.values()]).T for run in runs])
    known = [one.lasting for one in runs[0].ranges.values()]
    shared = np.array([one.lasting_variance if one else 0.0 for one in known])
    kept = np.exp(-stacked([np.array([_steps(run, one) for one in known]).T for run in runs]))
    pair = 3 + stacked([run.problem.pair for run in runs])

    shape, size = (len(errors), len(body)), int(pair.max()) + 1
    every, of_filter = np.arange(len(body)), np.arange(len(errors))[:, None]
    x, h, p = np.zeros((*shape, size)), np.zeros((*shape, size)), np.zeros((*shape, size, size))
    x[..., :3] = [start for start, _ in noises]
    diagonal = np.einsum("fsii->fsi", p)
    diagonal[..., :3], diagonal[..., 3:] = settings.initial_std_m**2, shared[:, None, None]
    estimate, (std, nis, nees) = np.empty((count, *shape, 3)), np.empty((3, count, *shape))
    accepted, began = np.zeros((count, *shape), dtype=bool), np.zeros(shape, dtype=np.int64)
    settled = np.zeros(shape, dtype=bool)
    for k in range(count):
        keep = kept[k].T[:, body][..., None]
        x[..., 3:] *= keep
        x[..., :3] += moves[k]
        p[..., 3:] *= keep[..., None]
        p[..., 3:, :] *= keep[..., None]
        diagonal[..., :3] += spread[k][body][:, None]
        diagonal[..., 3:] += shared[:, None, None] * (1 - keep**2)
        towards = x[..., :3] + arm[k][body] - other[k][body]
        distance = np.sqrt(np.einsum("fsi,fsi->fs", towards, towards))
        h[..., 3:], h[..., :3] = 0.0, towards / np.maximum(distance, 1e-6)[..., None]
        own = of_filter, every, pair[k][body]
        h[own] = sigma[k].T[:, body]
        ph = np.matmul(p, h[..., None])[..., 0]
        innovation = measured[k].T[:, body] - distance - h[own] * x[own]
        s = np.einsum("fsi,fsi->fs", h, ph) + variance[k].T[:, body]
        nis[k] = innovation**2 / s
        update = _range_update(innovation, s, [one and one.at((k, body)) for one in errors], settings.gate)
        gain = ph / s[..., None]
        x += gain * update.noise_m[..., None]
        p += gain[..., None] * (gain * (update.variance_m2 - s)[..., None])[..., None, :]
        for f, one, first in _diverged(nis[: k + 1], runs, body, settings, began, settled) if k % 8 == 0 else ():
            problem, rows = runs[body[one]].problem, slice(first, k + 1)
            # The motion of the body since each range, from its velocity, is added to the anchors.
            since = np.vstack([moves[first + 1 : k + 1, one][::-1].cumsum(axis=0)[::-1], np.zeros(3)])
            anchors = problem.other[rows] - problem.arm[rows] + since
            fix = multilaterate(measured[rows, body[one], f], anchors, 0.0)
            x[f, one, :3] = fix.place_m
            p[f, one, :3], p[f, one, :, :3] = 0.0, 0.0
            p[f, one, :3, :3] = fix.covariance_m2
            began[f, one], settled[f, one] = k + 1, False
        wrong, of_place = x[..., :3] - place[k][body], p[..., :3, :3]
        estimate[k], accepted[k] = x[..., :3], update.believed
        std[k] = np.sqrt(np.trace(of_place, axis1=-2, axis2=-1))
        nees[k] = np.einsum("fsi,fsi->fs", wrong, np.linalg.solve(of_place, wrong[..., None])[..., 0])

    def track(problem: Problem, f: int, column: int) -> Track:
        some = (slice(0, len(problem.rows)), f, column)
        return Track(
            time_ns=problem.time_ns,
            attitude=problem.attitude,
            estimate_m=estimate[some],
            truth_m=problem.place,
            std_m=std[some],
            nis=nis[some],
            nees=nees[some],
            accepted=accepted[some],
        )

    return [
        {
            name: [track(run.problem, f, column) for column in np.flatnonzero(body == k).tolist()]
            for f, name in enumerate(run.ranges)
        }
        for k, run in enumerate(runs)
    ]


def _shared_sigma(ranges: FilterRanges) -> Floats:
    """Return the unit of the errors that last (n,), in metres; zeros where none do."""
    return ranges.sigma_m if ranges.sigma_m is not None else np.zeros(len(ranges.measured_m))


def _steps(run: Run, lasting: LastingErrors | None) -> Floats:
    """Return the time since the range before (n,) in units of that in which lasting errors forget."""
    time_s = np.diff(run.problem.time_ns, prepend=run.problem.time_ns[:1]) * 1e-9
    return np.asarray(time_s / (lasting.time_s if lasting else np.inf))


def _stacked_errors(parts: Sequence[RangeErrors | None], count: int) -> RangeErrors | None:
    """Return errors of several bodies side by side, `share` and `detour_m` (count, bodies)."""
    known = [part for part in parts if part is not None]
    if not known:
        return None
    rows = [np.minimum(np.arange(count), len(np.asarray(part.share)) - 1) for part in known]
    each = [part.at(some) for part, some in zip(known, rows, strict=True)]
    share, detour = (np.stack([getattr(part, name) for part in each], axis=1) for name in ("share", "detour_m"))
    return replace(known[0], share=share, detour_m=detour)


def _range_update(
    innovation: Floats, variance: Floats, errors: Sequence[RangeErrors | None], gate: float
) -> RangeUpdate:
    """Return what all filters make of a range: a gate for most, the whole of its error for those who reckon with it."""
    update = gated_update(innovation, variance, gate)
    for f, known in enumerate(errors):
        if known is not None:
            own = mixture_update(innovation[f], variance[f], known)
            update.noise_m[f], update.variance_m2[f], update.believed[f] = own.noise_m, own.variance_m2, own.believed
    return update


def _diverged(
    nis: Floats, runs: Sequence[Run], body: Ints, settings: Settings, began: Ints, settled: Bools
) -> Iterator[tuple[int, int, int]]:
    """Yield filters (filter, column) that cannot explain half of the latest ranges, and the first of these ranges.

    Half of them are off by more than three standard deviations. `nis` (n, filters, columns) are those of all ranges so
    far; those before a filter `began` anew do not count, nor do windows that do not reach back for `reopen_s`. Filters
    are `settled` (filters, columns) when they explained their ranges for `PATIENCE` times as long, and are then given
    that time.
    """
    last = len(nis) - 1
    for k, run in enumerate(runs):
        time_ns, mine = run.problem.time_ns, np.flatnonzero(body == k)
        if last >= len(time_ns):
            continue
        for windows in (1.0, PATIENCE):
            since_ns = time_ns[last] - int(windows * settings.reopen_s * 1e9)
            first = int(np.searchsorted(time_ns, since_ns))
            if time_ns[0] > since_ns or last + 1 - first < MIN_RANGES_IN_WINDOW:
                continue
            inside = began[:, mine] <= first
            lost = inside & (np.median(nis[first:, :, mine], axis=0) > 9.0)
            if windows == PATIENCE:
                settled[:, mine] |= inside & ~lost
            told = lost & (settled[:, mine] == (windows == PATIENCE))
            yield from ((int(f), int(mine[one]), first) for f, one in np.argwhere(told))
