"""Where a search begins: trajectories followed window by window, from known places or from what fits a first window.

Neither delays nor a curve are known then, so ranges have a wide Cauchy likelihood, which narrows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from calib.trajectories.motion import Motion
from calib.trajectories.samples import Places
from calib.trajectories.scene import Scene
from calib.trajectories.search import JERK_M_S3, Settled, State, settle
from uwblink.arrays import Floats

WINDOW_S = (2.0, 20.0)
RANGES_A_BODY = 24
"""A window lasts until it has so many ranges a moving body, but within bounds; it moves on by a half of that."""

HEADED_S = 8.0
"""A first window lasts so long at least where headings are to be found in it."""

SAMPLE_S = 0.1
FOLLOWED_M = 0.1
"""How well a path is known where a window before has followed it."""

SCALES_M = (3.0, 1.0, 0.3)
"""Scales of the likelihood while neither delays nor curve are known: nearly a convex problem at first."""

STEADY_M_S3 = 3.0
"""Jerk that paths of a window are taken to have: the wide likelihood makes ranges count for less."""

STARTS, LOOKED_AT = 24, 400
"""Starts of a first window, and how many of its ranges are looked at."""

AROUND_M = 2.0
AS_LIKELY = 6.0
"""Solutions are taken for alike whose log likelihoods differ by less."""

ELSEWHERE_M, APART_M = 0.5, 0.1
"""Places among given anchors, and distances, that differ by more in the median are other ones."""

TURNS = tuple((np.arange(1, 12) * np.pi / 6).tolist())
"""By how much headings that nobody knows are turned, all around."""

FAR_RAD = np.pi * 50 / 180
"""Headings that are nearer are the same, to be found by going downhill."""

PASSES, OF_FLIGHT = 2, 600
"""How often all headings are tried, and how many ranges of the flight are looked at."""


@dataclass(frozen=True, slots=True)
class Followed:
    """Where the moving bodies were found at instants (k,): metres (k, bodies, 3)."""

    time_s: Floats
    position_m: Floats

    def among(self, begin_s: float, end_s: float) -> Followed:
        """Return where they were within a span of time."""
        inner = (self.time_s >= begin_s - 1e-9) & (self.time_s <= end_s + 1e-9)
        return Followed(self.time_s[inner], self.position_m[inner])

    def joined(self, other: Followed) -> Followed:
        """Return both, in order of time."""
        time = np.concatenate([self.time_s, other.time_s])
        order = np.argsort(time, kind="stable")
        return Followed(time[order], np.concatenate([self.position_m, other.position_m])[order])

    def state(self, scene: Scene, stand: Floats) -> dict[str, Floats]:
        """Return control points of paths that pass nearly there, at rest before and after."""
        times = Motion.of(scene).places.times_s
        flat = self.position_m.reshape(len(self.time_s), -1)
        path = np.column_stack([np.interp(times, self.time_s, line) for line in flat.T])
        return {"path": path.reshape(len(times), -1, 3), "stand": stand}

    def places(self) -> Places:
        """Return them as known places."""
        count, bodies = self.position_m.shape[:2]
        return Places(
            np.tile(self.time_s, bodies),
            np.repeat(np.arange(bodies), count),
            self.position_m.transpose(1, 0, 2).reshape(-1, 3),
            np.full(count * bodies, FOLLOWED_M),
        )


def begin(scene: Scene, done: Callable[[float], None]) -> tuple[Scene, State, str]:
    """Return a scene, its motion to start from, and in a sentence what fits as well, if anything does.

    The scene has headings in its attitudes that were found, where they were not known.
    """
    seed = known_at_first(scene)
    stand, rival = np.zeros((len(scene.sought), 3)), ""
    if seed is None:
        scene, seed, stand, rival = _first_window(scene)
    elif scene.sought:
        stand = _seen_from(scene, seed)
    found, stand = _follow(scene, seed, stand, lambda share: done(0.8 * share))
    scene, state, unsure = turned_right(scene, found.state(scene, stand))
    return scene, settle(scene, state, SCALES_M, JERK_M_S3, steps=60).state, rival or unsure


def known_at_first(scene: Scene) -> Followed | None:
    """Return where all bodies are known to be, in the longest stretch in which they are."""
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
    return path_between(places, (low + np.arange(first, last) + 0.5) * SAMPLE_S, bodies)


def path_between(places: Places, time_s: Floats, bodies: int) -> Followed:
    """Return where so many bodies are at instants (k,), on straight lines between known places."""
    found = np.empty((len(time_s), bodies, 3))
    for body in range(bodies):
        mine = places.body == body
        for axis in range(3):
            found[:, body, axis] = np.interp(time_s, places.time_s[mine], places.position_m[mine, axis])
    return Followed(time_s, found)


def _window_s(scene: Scene) -> float:
    """Return how many seconds a window lasts."""
    rate = len(scene.time_s) / max(float(scene.time_s[-1] - scene.time_s[0]), 1e-9)
    seconds = RANGES_A_BODY * len(scene.moving) / rate
    return float(np.clip(2 * round(seconds / 2), *WINDOW_S))


def _settle(window: Scene, guess: Followed, stand: Floats, anchor: Followed | None = None) -> Settled:
    """Return what fits a window's ranges best, from a guess; `anchor` is where bodies have been followed."""
    if anchor is not None:
        window = replace(window, places=window.places + anchor.places())
    return settle(window, guess.state(window, stand), SCALES_M, STEADY_M_S3)


def _follow(scene: Scene, seed: Followed, stand: Floats, done: Callable[[float], None]) -> tuple[Followed, Floats]:
    """Follow paths from a seed to both ends of a scene; return them and where standing bodies were found."""
    begin_s, end_s = float(scene.time_s[0]), float(scene.time_s[-1])
    found, step = seed, _window_s(scene) / 2
    for sign in (1.0, -1.0):
        while True:
            edge = float(found.time_s[-1] if sign > 0 else found.time_s[0])
            if (end_s - edge if sign > 0 else edge - begin_s) <= 1e-6:
                break
            low, high = sorted((edge - sign * step, edge + sign * step))
            near = found.among(low, high)
            fresh = np.asarray(np.arange(1, round(step / SAMPLE_S) + 1) * SAMPLE_S * sign + edge, dtype=np.float64)
            fresh = fresh[(fresh >= begin_s - SAMPLE_S) & (fresh <= end_s + SAMPLE_S)]
            placed, window = _carried_on(near, fresh, sign), scene.between(low, high)
            if len(window.time_s) >= 2:
                settled = _settle(window, near.joined(Followed(fresh, placed)), stand, near)
                placed, stand = settled.positions(fresh), settled.state.get("stand", stand[None])[0]
            found = found.joined(Followed(fresh, placed))
            done(float(found.time_s[-1] - found.time_s[0]) / max(end_s - begin_s, 1e-9))
    return found, stand


def _carried_on(near: Followed, time_s: Floats, sign: float) -> Floats:
    """Return where bodies would be if they slowed down gently (k, bodies, 3)."""
    edge, other = (-1, max(-4, -len(near.time_s))) if sign > 0 else (0, min(3, len(near.time_s) - 1))
    span = near.time_s[edge] - near.time_s[other]
    speed = (near.position_m[edge] - near.position_m[other]) / span if span else 0 * near.position_m[edge]
    ahead = time_s - near.time_s[edge]
    return np.asarray(near.position_m[edge] + speed * (np.tanh(ahead / 0.7) * 0.7)[:, None, None])


def _first_window(scene: Scene) -> tuple[Scene, Followed, Floats, str]:
    """Return where bodies are in the first window, from many starts: the one that fits best, and what rivals it."""
    headless = scene.without_heading
    length = max(_window_s(scene), HEADED_S if headless else 0.0)
    time = np.arange(float(scene.time_s[0]), float(scene.time_s[0]) + length + SAMPLE_S / 2, SAMPLE_S)
    window = scene.between(float(time[0]), float(time[-1]))
    window = window.only(np.arange(0, len(window.time_s), max(len(window.time_s) // LOOKED_AT, 1)))
    tried = [
        (_settle(window.headed(heading), guess, stand), heading)
        for guess, stand, heading in _guesses(window, time, headless)
    ]
    best, heading = max(tried, key=lambda one: one[0].value)
    stand = best.state.get("stand", np.zeros((1, 0, 3)))[0]
    rival = _rival(scene, best, [one for one, _ in tried], time)
    return scene.headed(heading), Followed(time, best.positions(time)), stand, rival


def _rival(scene: Scene, best: Settled, tried: list[Settled], time: Floats) -> str:
    """Return in a sentence what else fits a first window (seconds (k,)) as well; nothing if nothing does."""
    close = sorted((one for one in tried if best.value - one.value < AS_LIKELY), key=lambda one: -one.value)
    given = any(place is not None for place in scene.still.values())
    for one in close:
        if not given and float(np.median(np.abs(one.residuals - best.residuals))) < APART_M:
            continue
        away = np.median(np.linalg.norm(one.positions(time) - best.positions(time), axis=2), axis=0)
        if given and away.max() < ELSEWHERE_M:
            continue
        what = f"{scene.moving[int(np.argmax(away))]} {away.max():.1f} m elsewhere" if given else "other distances"
        return (
            f"a second solution, with {what}, fits the first {time[-1] - time[0]:.0f} s as well: delays are those of "
            "one of them; anchors out of one plane, heights or a known start tell which"
        )
    return ""


def _guesses(scene: Scene, time: Floats, headless: list[str]) -> Iterator[tuple[Followed, Floats, dict[str, float]]]:
    """Yield places of moving bodies all along, of standing ones, and headings of those that have none."""
    rng = np.random.default_rng(0)
    known = np.array([place for place in scene.still.values() if place is not None]).reshape(-1, 3)
    shape, moving = _shape(scene), len(scene.moving)
    for _ in range(STARTS):
        if len(known):
            place = rng.normal(known.mean(axis=0), known.std(axis=0) + AROUND_M / 2, (len(shape), 3))
        else:
            place = shape @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + rng.normal(0, 0.2, (len(shape), 3))
        heading = dict(zip(headless, rng.uniform(-np.pi, np.pi, len(headless)).tolist(), strict=True))
        yield Followed(time, np.tile(place[:moving], (len(time), 1, 1))), place[moving:], heading


def _shape(scene: Scene) -> Floats:
    """Return how bodies lie to each other (moving, then sought), by multidimensional scaling of their mean ranges.

    Classical scaling (Torgerson 1952); what does not range with each other is as far apart as the shortest way.
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


def _seen_from(scene: Scene, seed: Followed) -> Floats:
    """Return where the sought bodies are, each from the start that fits its ranges best while others are known."""
    window = scene.between(float(seed.time_s[0]), float(seed.time_s[-1]))
    rng = np.random.default_rng(0)
    here, sought = seed.position_m.reshape(-1, 3), scene.sought
    best, stand = np.full(len(sought), np.inf), np.zeros((len(sought), 3))
    ends = np.column_stack([window.ranges.initiator, window.ranges.target])
    mine = [
        np.isin(ends, [tag for tag, (body, _) in scene.arms.items() if body == name]).any(axis=1) for name in sought
    ]
    for _ in range(STARTS // 3):
        settled = _settle(window, seed, rng.normal(here.mean(axis=0), here.std(axis=0) + AROUND_M, (len(sought), 3)))
        off = np.log1p((settled.residuals / SCALES_M[-1]) ** 2)
        cost = np.array([off[own].sum() for own in mine])
        better = cost < best
        best[better], stand[better] = cost[better], settled.state["stand"][0][better]
    return stand


def turned_right(scene: Scene, state: State) -> tuple[Scene, State, str]:
    """Return the scene with the headings that fit all of a flight best, its motion, and what is not sure of them.

    A first window that is short of ranges leaves a heading open by tens of degrees, and a search does not come back
    from there: each heading is tried all around over the whole flight. Nothing changes where headings are known.
    """
    unknown = scene.without_heading
    if not unknown:
        return scene, state, ""
    few = scene.only(np.arange(0, len(scene.time_s), max(len(scene.time_s) // OF_FLIGHT, 1)))

    def settled(some: Scene, start: State) -> Settled:
        return settle(some, start, SCALES_M[-1:], JERK_M_S3, steps=8)

    best, unsure = settled(few, state), list[str]()
    for _ in range(PASSES):
        unsure, turns = [], dict[str, float]()
        for body in unknown:
            tried = {0.0: best} | {turn: settled(few.headed({body: turn}), best.state) for turn in TURNS}
            turn = max(tried, key=lambda angle: tried[angle].value)
            best = tried[turn]
            if turn:
                turns[body], few = turn, few.headed({body: turn})
            rivals = [angle for angle, one in tried.items() if best.value - one.value < AS_LIKELY]
            if any(abs(np.angle(np.exp(1j * (angle - turn)))) > FAR_RAD for angle in rivals):
                unsure.append(body)
        scene = scene.headed(turns)
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
