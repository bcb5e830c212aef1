"""Extended Kalman filters of one body: settings, measurements, the run, and the resulting tracks.

State is the body's position; its velocity and attitude are inputs taken from motion capture, velocity with noise; the
places of the other bodies are known (ICRA 2023, section V). A measurement is a sum of distances with signs: one for a
range, two for a difference of arrival (`calib.data.arrivals`); distances between other bodies are known.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final

import numpy as np

from calib.calibration.error_model import GATE
from calib.data.ranges import Ranges
from calib.data.sources import Flight, require_arrivals
from calib.evaluation.filters import GaussianFilters, multilaterate, squared_over
from calib.evaluation.models import FilterBank, FilterRanges
from calib.pairs import pairs_of
from calib.settings import CheckedSettings
from uwblink.arrays import Bools, ColumnTable, Floats, Ints
from uwblink.recording.distances import antennas_m, bodies_m
from uwblink.recording.schema import Poses
from uwblink.settings import setting

Trajectory = tuple[Ints, Floats, Floats]
"""Times in ns (n,), positions in metres (n, 3), attitudes x y z w (n, 4)."""

FILTERS: Final = ("raw", "calibrated", "variance", "robust", "online")

PATIENCE_S: Final = 10.0
"""Maximum time in seconds without restart for a filter that no longer explains its ranges, but did before.

Between metal racks (scenarios/hall_with_metal) half of a body's ranges are metres too long for up to nine seconds, and
a position from these ranges alone is metres off.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings(CheckedSettings):
    """Settings of the filters of `localize`.

    The velocity input has the rate `velocity_rate_hz` and white noise of `velocity_std_mps` per axis, which is the
    process noise. Percentages depend on it: with noisier velocity, ranges have more weight. Filters begin at the true
    place plus noise of `initial_std_m` and an `initial_offset_m` that is unknown to them. A range is accepted if its
    squared innovation over its variance is below `gate` (the default is the 99.9 % quantile of chi-square with one
    degree of freedom); the robust filter has no gate. A filter restarts at the fix by its last ranges (`multilaterate`)
    if they were outside the gate for longer than they were inside before, 10 s at most, plus half of `reopen_s`. Time
    in which the robust filter takes ranges for reflected counts half. `seeds` are runs with other noise, each body and
    flight with its own; tracks are from the first, `seed`. `use` is "exchanges", a body's ranges, or "receptions", also
    with overheard frames of and by the body. With `online` one more filter averages over fixed delays and delays that
    drift (`calib.online.DelayStates`). Raises `BadInputError` that names the setting.
    """

    velocity_std_mps: float = 0.3
    velocity_rate_hz: float = 100.0
    initial_std_m: float = 0.1
    initial_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fixed_std_m: float | None = None
    gate: float = GATE
    reopen_s: float = 1.0
    seed: int = 0
    seeds: int = 3
    use: str = setting("exchanges", "Measurements to use.", names=("exchanges", "receptions"))
    online: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Track:
    """Estimated and true positions of a body (n, 3) at times (n,), with attitudes x y z w (n, 4).

    `std_m` (n,) is the standard deviation by the filter itself: the root of the sum of its three variances. `nees` (n,)
    are the squared errors over their covariance, which should be `DEGREES`. Truth and `nees` are NaN without poses.
    `nis` (measurements,) are the squared innovations over their variance, and `accepted` (measurements,) whether they
    are within the gate. `offsets` (measurements,) are the probabilities that pairs have constants in this flight,
    `drifts` (measurements,) the probabilities that delays drift. `delays` are the delays at the end and their standard
    deviations by tag, in ns, if they are states.
    """

    DEGREES: ClassVar[int] = 3
    time_ns: Ints
    attitude: Floats
    estimate_m: Floats
    truth_m: Floats
    true_attitude: Floats
    std_m: Floats
    nis: Floats
    nees: Floats
    accepted: Bools
    drifts: Floats
    offsets: Floats = field(default_factory=lambda: np.zeros(0))
    delays: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    @property
    def known(self) -> Bools:
        """Whether the true position is known at each time (n,)."""
        return np.asarray(np.isfinite(self.truth_m).all(axis=1))

    @property
    def rmse_m(self) -> float:
        """Root of the mean squared distance between estimate and truth, NaN without truth."""
        wrong = (self.estimate_m - self.truth_m)[self.known]
        return float(np.sqrt(np.mean(np.sum(wrong**2, axis=1)))) if len(wrong) else np.nan

    def trajectories(self) -> dict[str, Trajectory]:
        """Return the trajectory as "", and the true one as "truth", where it is known at some time."""
        truth = (self.time_ns[self.known], self.truth_m[self.known], self.true_attitude[self.known])
        return {"": (self.time_ns, self.estimate_m, self.attitude)} | ({"truth": truth} if len(truth[0]) else {})

    def __repr__(self) -> str:
        """Return its length and RMSE, on one line."""
        return f"track of {len(self.time_ns)} measurements, rms error {self.rmse_m:.3f} m"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurements(ColumnTable):
    """Measurements (n,) in order of time, and then of exchange: `rows` among ranges and then their arrivals.

    A measurement is a sum of k distances between tags `ends` (n, k, 2) with a `sign` (n, k), 0 for none. `exchange`
    (n,) numbers exchanges.
    """

    rows: Ints
    time_ns: Ints
    exchange: Ints
    ends: Ints
    sign: Floats
    ranges: Ranges

    @classmethod
    def of(cls, ranges: Ranges, unknown: Callable[[Ints], Bools]) -> Measurements:
        """Return the measurements of ranges with an `unknown` (n, k) distance between ends (n, k, 2)."""
        ends, sign, exchange = distances_in(ranges)
        time_ns = ranges.time_ns[exchange]
        rows = np.lexsort((exchange, time_ns))
        rows = rows[(unknown(ends) & (sign != 0)).any(axis=1)[rows]]
        return cls(
            ranges=ranges,
            rows=rows,
            time_ns=time_ns[rows],
            exchange=exchange[rows],
            ends=ends[rows],
            sign=sign[rows],
        )

    @classmethod
    def of_body(cls, ranges: Ranges, own: Sequence[int]) -> tuple[Measurements, Floats]:
        """Return the measurements of a body with `own` tags, and the signs (n, k) of the distances without this body.

        Distances from or to the body begin with its tag in `ends`; the `sign` of others is 0.
        """

        def unknown(ends: Ints) -> Bools:
            inside = np.isin(ends, own)
            return np.asarray(inside[..., 0] ^ inside[..., 1])

        found = cls.of(ranges_about(ranges, own), unknown)
        ends = np.where(np.isin(found.ends[..., :1], own), found.ends, found.ends[..., ::-1])
        sign = np.where(unknown(ends), found.sign, 0.0)
        return replace(found, ends=ends, sign=sign), found.sign - sign

    @property
    def pair(self) -> Ints:
        """The numbers (n, k), from 0, of the pairs of tags."""
        return pairs_of(*np.moveaxis(self.ends, 2, 0)).number

    @property
    def elapsed_s(self) -> Floats:
        """Time since the measurement before (n,)."""
        return np.asarray(np.diff(self.time_ns, prepend=self.time_ns[:1]) * 1e-9)

    @property
    def same_exchange(self) -> Bools:
        """Which measurements (n,) are of the same exchange as the one before."""
        return np.asarray(np.diff(self.exchange, prepend=-1) == 0)

    @property
    def heard(self) -> Bools:
        """Which measurements (n,) are differences of arrival."""
        return np.asarray((self.rows >= len(self.ranges)) | self.ranges.differences[self.exchange])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem(Measurements):
    """Inputs of the filters of one body at each of its measurements (n,).

    `place` is the true position (n, 3). Of the k distances in a measurement `sign` (n, k) is 0 for distances without
    the body, `arm` is the own lever arm in the world's axes, and `other` the other antenna's position (n, k, 3);
    `known_m` is the sum of distances without the body.
    """

    body: str
    attitude: Floats
    place: Floats
    arm: Floats
    other: Floats
    known_m: Floats

    def velocity_spread(self, settings: Settings) -> Floats:
        """Return the variance that velocity noise adds per axis between measurements (n,), in square metres."""
        return settings.velocity_std_mps**2 / settings.velocity_rate_hz * self.elapsed_s

    def noisy(self, settings: Settings, seed: int) -> tuple[Floats, Floats]:
        """Draw a start (3,) and displacements between measurements (n, 3), both with noise.

        The noise depends on body and flight, and is the same for every filter.
        """
        own = [zlib.crc32(part) for part in (self.time_ns.tobytes(), self.body.encode())]
        rng = np.random.default_rng([seed, *own])
        moves = np.diff(self.place, axis=0, prepend=self.place[:1])
        noise = rng.normal(size=moves.shape) * np.sqrt(self.velocity_spread(settings))[:, None]
        start = self.place[0] + rng.normal(size=3) * settings.initial_std_m + settings.initial_offset_m
        return start, moves + noise


def problems(flight: Flight) -> list[Problem]:
    """Return a problem for every moving body of a flight that ranges or listens while its position is known."""
    found = []
    for body in flight.moving_bodies():
        measured, others = Measurements.of_body(flight.ranges, [tag.tag for tag in flight.tags if tag.body == body])
        if not len(measured):
            continue
        time, shape = measured.time_ns, measured.sign.shape
        place = bodies_m(flight.poses, body, time)
        antenna, away = (
            antennas_m(flight.poses, flight.tags, ids.ravel(), np.repeat(time, shape[1])).reshape(*shape, 3)
            for ids in np.moveaxis(measured.ends, 2, 0)
        )
        problem = Problem(
            **measured.to_dict(),
            ranges=measured.ranges,
            body=body,
            attitude=nearest_attitude(flight.poses, body, time),
            place=place,
            arm=antenna - place[:, None],
            other=away,
            known_m=np.sum(others * np.linalg.norm(antenna - away, axis=2), axis=1),
        )
        known = np.flatnonzero(np.isfinite(problem.arm + problem.other).all(axis=(1, 2)))
        if len(known):
            found.append(problem[known])
    return found


def ranges_among(ranges: Ranges, tags: list[int]) -> Ranges:
    """Return the ranges between some tags, with the frames of these that they overheard."""
    found = ranges[
        np.isin(ranges.initiator, tags) & np.isin(ranges.target, tags) & np.isin(ranges.listener, [-1, *tags])
    ]
    heard = found.arrivals
    return found if heard is None else replace(found, arrivals=heard[np.isin(heard.listener, tags)])


def used_part(ranges: Ranges, use: str) -> Ranges:
    """Return ranges with overheard frames if receptions are used, else without them.

    Raises what `require_arrivals` raises.
    """
    if use == "receptions":
        require_arrivals(ranges)
        return ranges
    return replace(ranges, arrivals=None)


def ranges_about(ranges: Ranges, tags: Sequence[int]) -> Ranges:
    """Return the ranges of some tags with others, and ranges that either overheard, with their arrivals."""
    needed, heard = np.isin(ranges.initiator, tags) ^ np.isin(ranges.target, tags), ranges.arrivals
    needed |= np.isin(ranges.listener, tags)
    if heard is not None:
        heard = heard[needed[heard.exchange] | np.isin(heard.listener, tags)]
        needed[heard.exchange] = True
    return replace(ranges, arrivals=heard)[needed]


def distances_in(ranges: Ranges) -> tuple[Ints, Floats, Ints]:
    """Return the tags (n, k, 2) and signs (n, k) of the distances in ranges and arrivals, and exchanges (n,)."""
    ends, exchange, heard = ranges.ends, np.arange(len(ranges)), ranges.arrivals
    if heard is None and not ranges.differences.any():
        return ends[:, None], np.ones((len(ranges), 1)), exchange
    listener = ranges.listener
    if heard is not None:
        exchange, listener = np.append(exchange, heard.exchange), np.append(listener, heard.listener)
    # Distance from the target minus distance from the initiator.
    listens, listener, senders = listener[:, None, None] >= 0, listener[:, None], ends[exchange, ::-1]
    of_heard = np.stack([senders, np.broadcast_to(listener, senders.shape)], axis=2)
    signs = np.where(listens[:, 0], [1.0, -1.0], [1.0, 0.0])
    return np.where(listens, of_heard, np.stack([ends, ends], axis=1)[exchange]), signs, exchange


def nearest_attitude(poses: Poses, body: str, time_ns: Ints) -> Floats:
    """Return the attitude of a body at the pose nearest to each time, (n, 4)."""
    rows = np.flatnonzero(poses.body == body)
    known = poses.time_ns[rows]
    place = np.interp(time_ns - known[0], known - known[0], np.arange(len(rows)))
    return np.asarray(poses.quaternion[rows[np.rint(place).astype(np.int64)]])


def run_filters(problem: Problem, ranges: Mapping[str, FilterRanges], settings: Settings) -> dict[str, list[Track]]:
    """Run filters on the ranges of a body for each seed; return the tracks of each filter, one per seed.

    A state is the position, and those of `FilterBank`, of which a restart keeps the delays. Tracks are averages over a
    filter and its rivals. Arrays are (filters, seeds, ...).
    """
    count, known, elapsed_s, same = len(problem), list(ranges.values()), problem.elapsed_s, problem.same_exchange
    noises = [problem.noisy(settings, settings.seed + k) for k in range(settings.seeds)]
    moves, spread = np.stack([moves for _, moves in noises], axis=1), problem.velocity_spread(settings)
    moved, shape, place = moves.cumsum(axis=0), (len(known), settings.seeds), slice(0, 3)
    running = GaussianFilters(np.zeros((*shape, 3)), np.tile(settings.initial_std_m**2 * np.eye(3), (*shape, 1, 1)), 3)
    running.state[..., place] = [start for start, _ in noises]
    used = np.ones((count, len(known)), dtype=bool)
    bank = FilterBank(known, running, settings.gate, used, problem.pair, problem.sign)
    own = slice(running.changes.start)
    prior = running.covariance[0, 0, own, own].copy()
    averaged = count, len(bank.average.shown), settings.seeds
    estimate, (std_m, nees) = np.empty((*averaged, 3)), np.empty((2, *averaged))
    # Twelve unexplained ranges at least, four for each coordinate, before a filter begins anew.
    explained_s, most_s = np.zeros(shape), settings.reopen_s / 2 / 12
    for k in range(count):
        running.state[..., place] += moves[k]
        running.add_variance(place, spread[k])
        bank.pass_time(elapsed_s[k], same_exchange=same[k])
        towards = running.state[..., None, place] + problem.arm[k] - problem.other[k]
        distance = np.linalg.norm(towards, axis=-1)
        h = np.zeros_like(running.state)
        h[..., place] = np.sum(towards * (problem.sign[k] / np.maximum(distance, 1e-6))[..., None], axis=-2)
        update = bank.observe(k, h, problem.known_m[k] + distance @ problem.sign[k])
        lasted_s = min(elapsed_s[k], most_s)
        # A body with two others, one of them behind an obstacle, has reflections in half of its ranges: no reason to
        # restart.
        counts = np.where(update.nis < settings.gate, 1.0, np.where(update.accepted, -0.5, -1.0))
        explained_s = np.minimum(explained_s + counts * lasted_s, PATIENCE_S)
        for lost in zip(*np.nonzero(explained_s < -settings.reopen_s / 2), strict=True):
            rows = slice(np.searchsorted(problem.time_ns, problem.time_ns[k] - settings.reopen_s * 1e9), k + 1)
            # The body moved since these ranges: anchors are moved likewise.
            anchors = problem.other[rows] - problem.arm[rows] + (moved[k] - moved[rows])[:, lost[1], None]
            known_m = problem.known_m[rows] + bank.slopes[rows, lost[0], 0] @ running.state[lost][running.changes]
            fix = multilaterate(bank.measured[(rows, *lost)] - known_m, anchors, 0.0, sign=problem.sign[rows])
            state, covariance, explained_s[lost] = running.state[lost], running.covariance[lost], 0.0
            state[own], covariance[own], covariance[:, own], covariance[own, own] = 0.0, 0.0, 0.0, prior
            state[place], covariance[place, place] = fix.place_m, fix.covariance_m2
            bank.forget_reflections(lost)
        estimate[k], covariance = bank.average.moments(running.state[..., place], running.covariance[..., place, place])
        std_m[k] = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
        nees[k] = squared_over(estimate[k] - problem.place[k], covariance)

    def track(f: int, seed: int) -> Track:
        own = slice(None), f, seed
        return Track(
            time_ns=problem.time_ns,
            attitude=problem.attitude,
            estimate_m=estimate[own],
            truth_m=problem.place,
            true_attitude=problem.attitude,
            std_m=std_m[own],
            nees=nees[own],
            **bank.outcome(f, seed),
        )

    names = [name for name, one in ranges.items() if one.shown]
    return {name: [track(f, seed) for seed in range(settings.seeds)] for f, name in enumerate(names)}
