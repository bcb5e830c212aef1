"""Where a search begins: trajectories followed window by window from where the bodies are known to be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.trajectories.arrow import Factored
from calib.trajectories.known_rows import known_rows
from calib.trajectories.range_losses import Cauchy
from calib.trajectories.range_rows import range_rows
from calib.trajectories.scene import Places, Scene
from calib.trajectories.solving import minimise
from calib.trajectories.splines import cubic
from calib.trajectories.unknowns import Columns, State, columns_of
from uwblink.arrays import Floats

WINDOW_S: Final = (2.0, 20.0)
RANGES_A_BODY: Final = 24
"""A window lasts until it has so many ranges a moving body, but within bounds; it moves on by a half of that."""

SAMPLE_S: Final = 0.1
FOLLOWED_M: Final = 0.1
"""How well a trajectory is known where a window before has followed it."""

LOOSE_M: Final = 0.3
"""Scale of the loss while neither delays nor curve are known."""

SCALES_M: Final = (3.0, 1.0, LOOSE_M)
"""The same from where a body may be far from where it is thought to be: nearly a convex problem at first."""

STEADY_M_S3: Final = 3.0


@dataclass(frozen=True, slots=True)
class Followed:
    """Where the moving bodies were found at instants (k,): metres (k, bodies, 3)."""

    time_s: Floats
    position_m: Floats


def blank(columns: Columns) -> State:
    """Return unknowns that are all zero."""
    return State(np.zeros(columns.size), np.zeros(columns.border))


def positions(columns: Columns, state: State, time_s: Floats) -> Floats:
    """Return where the moving bodies are at instants (k,), shape (k, bodies, 3)."""
    weights = cubic(columns.places, time_s)
    return np.asarray(np.einsum("kp,kpba->kba", weights.share, state.local[columns.place[weights.point]]))


def through(scene: Scene, columns: Columns, followed: Followed, stand: Floats) -> State:
    """Return control points of trajectories that pass where bodies were found, at rest before and after."""
    places = _places_of(followed)
    start = blank(columns)
    for body in range(len(scene.moving)):
        for axis in range(3):
            line = np.interp(columns.places.times_s, followed.time_s, followed.position_m[:, body, axis])
            start.local[columns.place[:, body, axis]] = line
    start.border[columns.stand] = stand
    known = known_rows(scene.at(places), columns, start)
    normal = replace(known.normal, border=known.normal.border + np.eye(columns.border))
    step = Factored(normal).solve(-(known.local.T @ known.residuals(start)), np.zeros(columns.border))
    return start.moved(step[0], np.zeros(columns.border))


def follow(scene: Scene, seed: Followed, stand: Floats, done: Callable[[float], None]) -> tuple[Followed, Floats]:
    """Follow trajectories from a seed to both ends of a scene; return them and where standing bodies were found."""
    begin, end = float(scene.time_s[0]), float(scene.time_s[-1])
    found, whole = seed, max(end - begin, 1e-9)
    for forward in (True, False):
        while (found.time_s[-1] < end - 1e-6) if forward else (found.time_s[0] > begin + 1e-6):
            found, stand = _further(scene, found, stand, forward=forward)
            done(float(found.time_s[-1] - found.time_s[0]) / whole)
    return found, stand


def _further(scene: Scene, found: Followed, stand: Floats, *, forward: bool) -> tuple[Followed, Floats]:
    edge = found.time_s[-1] if forward else found.time_s[0]
    sign = 1.0 if forward else -1.0
    step = window_s(scene) / 2
    target = edge + sign * step
    low, high = sorted((edge - sign * step, target))
    inner = (found.time_s >= low - 1e-9) & (found.time_s <= high + 1e-9)
    near = Followed(found.time_s[inner], found.position_m[inner])
    fresh = np.arange(1, round(step / SAMPLE_S) + 1) * SAMPLE_S * sign + edge
    fresh = fresh[(fresh >= scene.time_s[0] - SAMPLE_S) & (fresh <= scene.time_s[-1] + SAMPLE_S)]
    guess = _carried_on(near, fresh, forward=forward)
    window = scene.between(low, high)
    if len(window.time_s) < 2:
        placed = guess
    else:
        settled = settle(window, _joined(near, Followed(fresh, guess)), stand, near)
        placed, stand = positions(settled.columns, settled.state, fresh), settled.stand
    return _joined(found, Followed(fresh, placed)), stand


def window_s(scene: Scene) -> float:
    """Return how many seconds a window lasts."""
    rate = len(scene.time_s) / max(float(scene.time_s[-1] - scene.time_s[0]), 1e-9)
    seconds = RANGES_A_BODY * len(scene.moving) / rate
    return float(np.clip(2 * round(seconds / 2), *WINDOW_S))


def _carried_on(near: Followed, time_s: Floats, *, forward: bool) -> Floats:
    """Return where bodies would be if they slowed down gently (k, bodies, 3)."""
    edge, other = (-1, max(-4, -len(near.time_s))) if forward else (0, min(3, len(near.time_s) - 1))
    span = near.time_s[edge] - near.time_s[other]
    speed = (near.position_m[edge] - near.position_m[other]) / span if span else 0 * near.position_m[edge]
    ahead = time_s - near.time_s[edge]
    return np.asarray(near.position_m[edge] + speed * (np.tanh(ahead / 0.7) * 0.7)[:, None, None])


def _joined(first: Followed, second: Followed) -> Followed:
    time, place = (np.concatenate([getattr(first, n), getattr(second, n)]) for n in ("time_s", "position_m"))
    order = np.argsort(time, kind="stable")
    return Followed(time[order], place[order])


@dataclass(frozen=True, slots=True)
class Settled:
    """What a window settled to: its columns and unknowns, the residuals of its ranges (n,), and what was minimised."""

    columns: Columns
    state: State
    residuals: Floats
    cost: float

    @property
    def stand(self) -> Floats:
        """Return where the standing bodies are that are sought (k, 3)."""
        return self.state.border[self.columns.stand]


def settle(window: Scene, guess: Followed, stand: Floats, anchor: Followed | None = None) -> Settled:
    """Return what fits the ranges of a window best, from a guess; `anchor` is where bodies have been followed."""
    columns = columns_of(window, 0)
    if anchor is not None:
        window = replace(window, places=window.places + _places_of(anchor))
    start = through(window, columns, guess, stand)
    rows = range_rows(window, columns, window.ranges.raw_m, np.zeros((len(window.time_s), 0)))
    known = known_rows(window, columns, start, STEADY_M_S3)
    cost = 0.0
    for scale in SCALES_M:
        found = minimise(rows, known, start, Cauchy(scale), most_steps=25, settled=1.0)
        start, cost = found.state, found.cost
    return Settled(columns, start, rows.residuals(start), cost)


def _places_of(followed: Followed) -> Places:
    count, bodies = followed.position_m.shape[:2]
    return Places(
        np.tile(followed.time_s, bodies),
        np.repeat(np.arange(bodies), count),
        followed.position_m.transpose(1, 0, 2).reshape(-1, 3),
        np.full(count * bodies, FOLLOWED_M),
    )


def known_at_first(scene: Scene) -> Iterator[Followed]:
    """Yield where all bodies are known to be, in the longest stretch in which they are."""
    bodies = len(scene.moving)
    slots = np.floor(scene.places.time_s / SAMPLE_S).astype(np.int64)
    if not len(slots):
        return
    have = np.zeros((int(slots.max() - slots.min()) + 1, bodies), dtype=bool)
    have[slots - slots.min(), scene.places.body] = True
    full = have.all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], full, [False]]).astype(int)))
    if not len(edges):
        return
    pieces = edges.reshape(-1, 2)
    first, last = pieces[np.argmax(pieces[:, 1] - pieces[:, 0])]
    time = (slots.min() + np.arange(first, last) + 0.5) * SAMPLE_S
    place = np.empty((len(time), bodies, 3))
    for body in range(bodies):
        mine = scene.places.body == body
        for axis in range(3):
            place[:, body, axis] = np.interp(time, scene.places.time_s[mine], scene.places.position_m[mine, axis])
    yield Followed(time, place)
