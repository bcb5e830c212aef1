"""What is known of a body at each of its ranges, and the noise of its velocity."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import numpy as np

from calib.data.sources import Flight
from calib.evaluation.tracking import Settings
from uwblink.arrays import Floats, Ints
from uwblink.recording.distances import antennas_m, bodies_m
from uwblink.recording.schema import Poses


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """What is known of one body at each of its ranges: rows of the flight, true place, own lever arm turned into the
    world, and the other antenna's place, (n, 3) each."""

    body: str
    rows: Ints
    time_ns: Ints
    attitude: Floats
    place: Floats
    arm: Floats
    other: Floats

    def first(self, count: int) -> Problem:
        """Return its first ranges."""
        columns = ("rows", "time_ns", "attitude", "place", "arm", "other")
        return replace(self, **{name: getattr(self, name)[:count] for name in columns})


def problems(flight: Flight) -> list[Problem]:
    """Return a problem for every body of a flight that moves, and ranges while its place is known."""
    return [problem for body in flight.moving_bodies() if (problem := _problem(flight, body)) is not None]


def _problem(flight: Flight, body: str) -> Problem | None:
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
    if not known.any():
        return None
    return Problem(
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
class Noise:
    """A start (3,) and displacements between ranges (n, 3), both with noise."""

    start: Floats
    moves: Floats

    @classmethod
    def drawn(cls, problem: Problem, settings: Settings, seed: int) -> Noise:
        """Draw the noise of a body in a flight: its own, and the same for every filter."""
        own = [zlib.crc32(part) for part in (problem.time_ns.tobytes(), problem.body.encode())]
        rng = np.random.default_rng([seed, *own])
        moves = np.diff(problem.place, axis=0, prepend=problem.place[:1])
        noise = rng.normal(size=moves.shape) * np.sqrt(velocity_spread(problem, settings))[:, None]
        start = problem.place[0] + rng.normal(size=3) * settings.initial_std_m + settings.initial_offset_m
        return cls(start, moves + noise)


def velocity_spread(problem: Problem, settings: Settings) -> Floats:
    """Return by how much velocity's noise widens each axis between ranges (n,), in square metres."""
    dt = np.diff(problem.time_ns, prepend=problem.time_ns[:1]) * 1e-9
    return np.asarray(settings.velocity_std_mps**2 / settings.velocity_rate_hz * np.maximum(dt, 0))
