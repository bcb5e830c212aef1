"""Initial guess of trajectories: windows that follow each other, from known positions or from the best first window.

Delays and curve are unknown, so ranges have a wide Cauchy likelihood, which narrows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from calib.trajectories.motion import Motion
from calib.trajectories.samples import Places
from calib.trajectories.scene import Scene
from calib.trajectories.search import JERK_M_S3, MotionFit, State, fit_motion
from uwblink.arrays import Floats

WINDOW_S = (2.0, 20.0)
RANGES_A_BODY = 24
"""A window has so many ranges per moving body, within these bounds in seconds; the next begins half a window later."""

HEADING_WINDOW_S = 8.0
"""Shortest first window where headings are unknown."""

SAMPLE_S = 0.1
WINDOW_STD_M = 0.1
"""Standard error of positions from the window before."""

SCALES_M = (3.0, 1.0, 0.3)
"""Scales of Cauchy's likelihood while delays and curve are unknown: wide ones make the problem nearly convex."""

WINDOW_JERK_M_S3 = 3.0
"""Standard deviation of jerk in a window; small, because ranges count less under a wide likelihood."""

START_COUNT, KEPT_STARTS, SAMPLED_RANGES = 24, 8, 400
"""Random starts of the first window, how many of them go on after the widest likelihood, which is nearly convex, and
the number of the window's ranges that are used."""

START_SPREAD_M = 2.0
EQUAL_LIKELIHOOD = 6.0
"""Solutions whose log likelihoods differ by less are equally likely."""

OTHER_PLACE_M, OTHER_DISTANCE_M = 0.5, 0.1
"""Solutions differ if positions among given anchors, or distances, differ by more in the median."""

TURNS = tuple((np.arange(1, 12) * np.pi / 6).tolist())
"""Rotations by which unknown headings are tried."""

OTHER_HEADING_RAD = np.pi * 50 / 180
"""Headings that differ by less converge to one solution."""

PASSES, SAMPLED_FLIGHT = 2, 600
"""Passes over all headings, and the number of ranges of the flight that are used."""


@dataclass(frozen=True, slots=True)
class Trajectories:
    """Positions (k, bodies, 3) of the moving bodies at instants (k,), in metres."""

    time_s: Floats
    position_m: Floats

    def between(self, begin_s: float, end_s: float) -> Trajectories:
        """Return the positions within a span of time."""
        inner = (self.time_s >= begin_s - 1e-9) & (self.time_s <= end_s + 1e-9)
        return Trajectories(self.time_s[inner], self.position_m[inner])

    def joined(self, other: Trajectories) -> Trajectories:
        """Return both, in order of time."""
        time = np.concatenate([self.time_s, other.time_s])
        order = np.argsort(time, kind="stable")
        return Trajectories(time[order], np.concatenate([self.position_m, other.position_m])[order])

    def state(self, scene: Scene, stand: Floats) -> dict[str, Floats]:
        """Return control points of paths near the positions; before and after, bodies rest."""
        times = Motion.of(scene).places.times_s
        flat = self.position_m.reshape(len(self.time_s), -1)
        path = np.column_stack([np.interp(times, self.time_s, line) for line in flat.T])
        return {"path": path.reshape(len(times), -1, 3), "stand": stand}

    def places(self) -> Places:
        """Return the positions as known ones."""
        count, bodies = self.position_m.shape[:2]
        return Places(
            np.tile(self.time_s, bodies),
            np.repeat(np.arange(bodies), count),
            self.position_m.transpose(1, 0, 2).reshape(-1, 3),
            np.full(count * bodies, WINDOW_STD_M),
        )


def begin(scene: Scene, done: Callable[[float], None]) -> tuple[Scene, State, str]:
    """Return the scene, the initial guess of its motion, and a sentence on a second solution, "" without one.

    Headings that were unknown are estimated and applied to the scene's attitudes.
    """
    seed = longest_known(scene)
    stand, rival = np.zeros((len(scene.sought), 3)), ""
    if seed is None:
        scene, seed, stand, rival = _fit_first_window(scene)
    elif scene.sought:
        stand = _initial_anchors(scene, seed)
    found, stand = _extend(scene, seed, stand, lambda share: done(0.8 * share))
    scene, state, unsure = resolve_headings(scene, found.state(scene, stand))
    return scene, fit_motion(scene, state, SCALES_M, JERK_M_S3, steps=60).state, rival or unsure


def longest_known(scene: Scene) -> Trajectories | None:
    """Return the longest span in which the positions of all bodies are known; None without any."""
    places, bodies = scene.places, len(scene.moving)
    if not len(places.time_s):
        return None
    slots = np.floor(places.time_s / SAMPLE_S).astype(np.int64)
    low = int(slots.min())
    have = np.zeros((int(slots.max()) - low + 1, bodies), dtype=bool)
    have[slots - low, places.body] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[False], have.all(axis=1), [False]]).astype(int)))
    if not len(edges):
        return None
    pieces = edges.reshape(-1, 2)
    first, last = pieces[np.argmax(pieces[:, 1] - pieces[:, 0])]
    return interpolated(places, (low + np.arange(first, last) + 0.5) * SAMPLE_S, bodies)


def interpolated(places: Places, time_s: Floats, bodies: int) -> Trajectories:
    """Return the positions of bodies at instants (k,), linear between known positions."""
    found = np.empty((len(time_s), bodies, 3))
    for body in range(bodies):
        mine = places.body == body
        for axis in range(3):
            found[:, body, axis] = np.interp(time_s, places.time_s[mine], places.position_m[mine, axis])
    return Trajectories(time_s, found)


def _window_s(scene: Scene) -> float:
    """Return the length of a window in seconds."""
    rate = len(scene.time_s) / max(float(scene.time_s[-1] - scene.time_s[0]), 1e-9)
    seconds = RANGES_A_BODY * len(scene.moving) / rate
    return float(np.clip(2 * round(seconds / 2), *WINDOW_S))


def _fit_window(window: Scene, guess: Trajectories, stand: Floats, anchor: Trajectories | None = None) -> MotionFit:
    """Return the best motion of a window from a guess; `anchor` are positions of the window before."""
    if anchor is not None:
        window = replace(window, places=window.places + anchor.places())
    return fit_motion(window, guess.state(window, stand), SCALES_M, WINDOW_JERK_M_S3)


def _extend(
    scene: Scene, seed: Trajectories, stand: Floats, done: Callable[[float], None]
) -> tuple[Trajectories, Floats]:
    """Extend paths from a seed to both ends of a scene; return them and the positions of standing bodies."""
    begin_s, end_s = float(scene.time_s[0]), float(scene.time_s[-1])
    found, step = seed, _window_s(scene) / 2
    for sign in (1.0, -1.0):
        while True:
            edge = float(found.time_s[-1] if sign > 0 else found.time_s[0])
            if (end_s - edge if sign > 0 else edge - begin_s) <= 1e-6:
                break
            low, high = sorted((edge - sign * step, edge + sign * step))
            near = found.between(low, high)
            fresh = np.asarray(np.arange(1, round(step / SAMPLE_S) + 1) * SAMPLE_S * sign + edge, dtype=np.float64)
            fresh = fresh[(fresh >= begin_s - SAMPLE_S) & (fresh <= end_s + SAMPLE_S)]
            placed, window = _carried_on(near, fresh, sign), scene.between(low, high)
            if len(window.time_s) >= 2:
                settled = _fit_window(window, near.joined(Trajectories(fresh, placed)), stand, near)
                placed, stand = settled.positions(fresh), settled.state.get("stand", stand[None])[0]
            found = found.joined(Trajectories(fresh, placed))
            done(float(found.time_s[-1] - found.time_s[0]) / max(end_s - begin_s, 1e-9))
    return found, stand


def _carried_on(near: Trajectories, time_s: Floats, sign: float) -> Floats:
    """Return extrapolated positions (k, bodies, 3) of bodies that slow down."""
    edge, other = (-1, max(-4, -len(near.time_s))) if sign > 0 else (0, min(3, len(near.time_s) - 1))
    span = near.time_s[edge] - near.time_s[other]
    speed = (near.position_m[edge] - near.position_m[other]) / span if span else 0 * near.position_m[edge]
    ahead = time_s - near.time_s[edge]
    return np.asarray(near.position_m[edge] + speed * (np.tanh(ahead / 0.7) * 0.7)[:, None, None])


def _fit_first_window(scene: Scene) -> tuple[Scene, Trajectories, Floats, str]:
    """Return the best of many starts of the first window: scene, positions, standing bodies and a second solution."""
    headless = scene.without_heading
    length = max(_window_s(scene), HEADING_WINDOW_S if headless else 0.0)
    time = np.arange(float(scene.time_s[0]), float(scene.time_s[0]) + length + SAMPLE_S / 2, SAMPLE_S)
    window = scene.between(float(time[0]), float(time[-1]))
    window = window.only(np.arange(0, len(window.time_s), max(len(window.time_s) // SAMPLED_RANGES, 1)))
    wide = [
        (fit_motion(window.turned_by(heading), guess.state(window, stand), SCALES_M[:1], WINDOW_JERK_M_S3), heading)
        for guess, stand, heading in _guesses(window, time, headless)
    ]
    wide.sort(key=lambda one: -one[0].value)
    tried = [
        (fit_motion(window.turned_by(heading), one.state, SCALES_M[1:], WINDOW_JERK_M_S3), heading)
        for one, heading in wide[:KEPT_STARTS]
    ]
    best, heading = max(tried, key=lambda one: one[0].value)
    stand = best.state.get("stand", np.zeros((1, 0, 3)))[0]
    rival = _second_solution(scene, best, [one for one, _ in tried], time)
    return scene.turned_by(heading), Trajectories(time, best.positions(time)), stand, rival


def _second_solution(scene: Scene, best: MotionFit, tried: list[MotionFit], time: Floats) -> str:
    """Return a sentence on a second solution of the first window (seconds (k,)), "" without one."""
    close = sorted((one for one in tried if best.value - one.value < EQUAL_LIKELIHOOD), key=lambda one: -one.value)
    given = any(place is not None for place in scene.still.values())
    for one in close:
        if not given and float(np.median(np.abs(one.residuals - best.residuals))) < OTHER_DISTANCE_M:
            continue
        away = np.median(np.linalg.norm(one.positions(time) - best.positions(time), axis=2), axis=0)
        if given and away.max() < OTHER_PLACE_M:
            continue
        what = f"{scene.moving[int(np.argmax(away))]} {away.max():.1f} m elsewhere" if given else "other distances"
        return (
            f"a second solution, with {what}, fits the first {time[-1] - time[0]:.0f} s as well: delays are those of "
            "one of them; anchors out of one plane, heights or a known start tell which"
        )
    return ""


def _guesses(
    scene: Scene, time: Floats, headless: list[str]
) -> Iterator[tuple[Trajectories, Floats, dict[str, float]]]:
    """Yield constant positions of moving bodies, positions of standing bodies, and unknown headings."""
    rng = np.random.default_rng(0)
    known = np.array([place for place in scene.still.values() if place is not None]).reshape(-1, 3)
    shape, moving = _shape(scene), len(scene.moving)
    for _ in range(START_COUNT):
        if len(known):
            place = rng.normal(known.mean(axis=0), known.std(axis=0) + START_SPREAD_M / 2, (len(shape), 3))
        else:
            place = shape @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + rng.normal(0, 0.2, (len(shape), 3))
        heading = dict(zip(headless, rng.uniform(-np.pi, np.pi, len(headless)).tolist(), strict=True))
        yield Trajectories(time, np.tile(place[:moving], (len(time), 1, 1))), place[moving:], heading


def _shape(scene: Scene) -> Floats:
    """Return relative positions of bodies (moving, then sought) by multidimensional scaling of their mean ranges.

    Classical scaling (Torgerson 1952). Bodies that do not range with each other are as far apart as the shortest path
    over others.
    """
    bodies = [*scene.moving, *scene.sought]
    count = len(bodies)
    number = {tag: bodies.index(body) for tag, (body, _) in scene.arms.items() if body in bodies}
    total, times = np.zeros((count, count)), np.zeros((count, count))
    for a, b, r in zip(
        scene.ranges.initiator.tolist(), scene.ranges.target.tolist(), scene.ranges.raw_m.tolist(), strict=True
    ):
        if a in number and b in number:
            i, j = number[a], number[b]
            total[[i, j], [j, i]] += r
            times[[i, j], [j, i]] += 1
    apart = np.where(times > 0, total / np.maximum(times, 1), 1e3)
    np.fill_diagonal(apart, 0.0)
    for k in range(count):
        apart = np.minimum(apart, apart[:, [k]] + apart[[k], :])
    apart = np.minimum(apart, 20.0)
    centre = np.eye(count) - 1 / count
    values, vectors = np.linalg.eigh(-0.5 * centre @ apart**2 @ centre)
    found = vectors[:, ::-1][:, :3] * np.sqrt(np.maximum(values[::-1][:3], 0.0))
    return np.pad(found, ((0, 0), (0, 3 - found.shape[1])))


def _initial_anchors(scene: Scene, seed: Trajectories) -> Floats:
    """Return the positions of the standing bodies, each from the start that fits its ranges best."""
    window = scene.between(float(seed.time_s[0]), float(seed.time_s[-1]))
    rng = np.random.default_rng(0)
    here, sought = seed.position_m.reshape(-1, 3), scene.sought
    best, stand = np.full(len(sought), np.inf), np.zeros((len(sought), 3))
    ends = np.column_stack([window.ranges.initiator, window.ranges.target])
    mine = [
        np.isin(ends, [tag for tag, (body, _) in scene.arms.items() if body == name]).any(axis=1) for name in sought
    ]
    for _ in range(START_COUNT // 3):
        settled = _fit_window(
            window, seed, rng.normal(here.mean(axis=0), here.std(axis=0) + START_SPREAD_M, (len(sought), 3))
        )
        off = np.log1p((settled.residuals / SCALES_M[-1]) ** 2)
        cost = np.array([off[own].sum() for own in mine])
        better = cost < best
        best[better], stand[better] = cost[better], settled.state["stand"][0][better]
    return stand


def resolve_headings(scene: Scene, state: State) -> tuple[Scene, State, str]:
    """Return the scene with the headings that fit the whole flight best, its motion, and a sentence on doubtful ones.

    A first window with few ranges leaves a heading uncertain by tens of degrees, and a local search does not recover.
    Each unknown heading is therefore tried all around over the whole flight.
    """
    unknown = scene.without_heading
    if not unknown:
        return scene, state, ""
    few = scene.only(np.arange(0, len(scene.time_s), max(len(scene.time_s) // SAMPLED_FLIGHT, 1)))

    def settled(some: Scene, start: State) -> MotionFit:
        return fit_motion(some, start, SCALES_M[-1:], JERK_M_S3, steps=8)

    best, unsure = settled(few, state), list[str]()
    for _ in range(PASSES):
        unsure, turns = [], dict[str, float]()
        for body in unknown:
            tried = {0.0: best} | {turn: settled(few.turned_by({body: turn}), best.state) for turn in TURNS}
            turn = max(tried, key=lambda angle: tried[angle].value)
            best = tried[turn]
            if turn:
                turns[body], few = turn, few.turned_by({body: turn})
            rivals = [angle for angle, one in tried.items() if best.value - one.value < EQUAL_LIKELIHOOD]
            if any(abs(np.angle(np.exp(1j * (angle - turn)))) > OTHER_HEADING_RAD for angle in rivals):
                unsure.append(body)
        scene = scene.turned_by(turns)
        if not turns:
            break
    if not unsure:
        return scene, best.state, ""
    return (
        scene,
        best.state,
        f"a second solution, with another heading of {', '.join(unsure)}, fits as well: delays are those of one of "
        "them; attitudes or a known start tell which",
    )
