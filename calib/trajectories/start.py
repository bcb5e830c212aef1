"""Initial guess of trajectories: consecutive windows, from known positions or from the best first window.

Delays and curve are unknown, so ranges have a wide Cauchy likelihood, which becomes narrower.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from calib.estimator.scaling import scaled_places
from calib.pairs import pairs_of
from calib.trajectories.motion import Motion
from calib.trajectories.samples import SAMPLE_S, Places, Samples
from calib.trajectories.scene import Scene
from calib.trajectories.search import JERK_M_S3, MotionFit, State, fit_motion
from uwblink.arrays import Floats

RANGES_A_BODY = 24
"""Number of ranges per moving body in a window, within 2 to 20 s; the next begins half a window later."""


SCALES_M = (3.0, 1.0, 0.3)
"""Scales of Cauchy's likelihood while delays and curve are unknown: wide ones make the problem nearly convex."""

WINDOW_JERK_M_S3 = 3.0
"""Standard deviation of jerk in a window; small, because ranges have less weight with a wide likelihood."""

START_COUNT, SAMPLED_RANGES = 24, 400
"""Random starts of the first window, and the number of its ranges that are used."""

START_SPREAD_M = 2.0
"""Standard deviation of random starts about known positions: the size of a room."""

EQUAL_LIKELIHOOD = 6.0
"""Solutions whose log likelihoods differ by less are equally likely."""


@dataclass(frozen=True, slots=True)
class Trajectories(Samples):
    """Positions (k, bodies, 3) of the moving bodies at instants (k,), in metres."""

    position_m: Floats

    def joined(self, other: Trajectories) -> Trajectories:
        """Return both, in order of time."""
        both = Trajectories.concatenate([self, other])
        return both[np.argsort(both.time_s, kind="stable")]

    def state(self, scene: Scene, stand: Floats) -> dict[str, Floats]:
        """Return control points of paths near the positions; before and after, bodies rest."""
        return {"path": _linear(Motion.of(scene).places.times_s, self.time_s, self.position_m), "stand": stand}

    def places(self) -> Places:
        """Return the positions as known ones."""
        count, bodies = self.position_m.shape[:2]
        # A decimetre is the standard error of positions from the window before.
        body, std = np.tile(np.arange(bodies), count), np.full(count * bodies, 0.1)
        return Places(np.repeat(self.time_s, bodies), body, self.position_m.reshape(-1, 3), std)


def _linear(time_s: Floats, known_s: Floats, values: Floats) -> Floats:
    """Return values (n, ...) at instants (n,), linear between those at `known_s` (k,) and constant outside."""
    return np.apply_along_axis(lambda line: np.interp(time_s, known_s, line), 0, values)


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
    slots = np.floor(places.time_s / SAMPLE_S).astype(np.int64)
    common = reduce(np.intersect1d, [slots[places.body == body] for body in range(bodies)], slots)
    if not len(common):
        return None
    spans = np.split(common, np.flatnonzero(np.diff(common) > 1) + 1)
    middles: Floats = np.asarray((max(spans, key=len) + 0.5) * SAMPLE_S, dtype=np.float64)
    return interpolated(places, middles, bodies)


def interpolated(places: Places, time_s: Floats, bodies: int) -> Trajectories:
    """Return the positions of bodies at instants (k,), linear between known positions."""
    known = [places[places.body == body] for body in range(bodies)]
    found = [_linear(time_s, own.time_s, own.position_m) for own in known]
    return Trajectories(time_s, np.stack(found, axis=1))


def _window_s(scene: Scene) -> float:
    """Return the length of a window in seconds."""
    rate = len(scene.time_s) / max(float(scene.time_s[-1] - scene.time_s[0]), 1e-9)
    return float(np.clip(2 * round(RANGES_A_BODY * len(scene.moving) / rate / 2), 2.0, 20.0))


def _extend(
    scene: Scene, seed: Trajectories, stand: Floats, done: Callable[[float], None]
) -> tuple[Trajectories, Floats]:
    """Extend paths from a seed to both ends of a scene; return them and the positions of standing bodies."""
    begin_s, end_s = float(scene.time_s[0]), float(scene.time_s[-1])
    found, step = seed, _window_s(scene) / 2
    for sign, last_s in ((1, end_s), (-1, begin_s)):
        edge = float(found.time_s[::sign][-1])
        while sign * (last_s - edge) > 1e-6:
            window = scene.between(edge - step, edge + step)
            # Sums of steps have rounding errors.
            near = found.between(edge - step - 1e-9, edge + step + 1e-9)
            fresh: Floats = np.asarray(edge + sign * SAMPLE_S * np.arange(1, round(step / SAMPLE_S) + 1))
            fresh = fresh[sign * (fresh - last_s) <= SAMPLE_S]
            new = Trajectories(fresh, _carried_on(near, fresh, sign))
            if len(window.time_s) >= 2:
                window = replace(window, places=Places.concatenate([window.places, near.places()]))
                guess = near.joined(new).state(window, stand)
                fitted = fit_motion(window, guess, SCALES_M, WINDOW_JERK_M_S3)
                new, stand = Trajectories(fresh, fitted.positions(fresh)), _stand(fitted)
            found, edge = found.joined(new), float(fresh[-1])
            done(float(found.time_s[-1] - found.time_s[0]) / max(end_s - begin_s, 1e-9))
    return found, stand


def _stand(fitted: MotionFit) -> Floats:
    """Return the positions (sought, 3) of standing bodies."""
    return fitted.state["stand"][0] if "stand" in fitted.state else np.zeros((0, 3))


def _carried_on(near: Trajectories, time_s: Floats, sign: int) -> Floats:
    """Return extrapolated positions (k, bodies, 3) of bodies that slow down, forwards or backwards (`sign` -1)."""
    time, place = near.time_s[::sign][-4:], near.position_m[::sign][-4:]
    # They stop within two seconds (time constant 0.7 s), a judgement: windows overlap, and the next one corrects it.
    speed = (place[-1] - place[0]) / (time[-1] - time[0]) if len(time) > 1 else np.zeros_like(place[0])
    return np.asarray(place[-1] + speed * (np.tanh((time_s - time[-1]) / 0.7) * 0.7)[:, None, None])


def _fit_first_window(scene: Scene) -> tuple[Scene, Trajectories, Floats, str]:
    """Return the best of many starts of the first window: scene, positions, standing bodies and a second solution."""
    headless = scene.without_heading
    # With unknown headings the first window lasts at least 8 s.
    length = max(_window_s(scene), 8.0 if headless else 0.0)
    time = np.arange(float(scene.time_s[0]), float(scene.time_s[0]) + length + SAMPLE_S / 2, SAMPLE_S)
    window = scene.between(float(time[0]), float(time[-1])).thinned(SAMPLED_RANGES)

    def tried(start: State, heading: Mapping[str, float], scales_m: tuple[float, ...]) -> MotionFit:
        return fit_motion(window.turned_by(heading), start, scales_m, WINDOW_JERK_M_S3)

    guesses = list(_guesses(window, time, headless))
    wide = [(tried(guess.state(window, stand), heading, SCALES_M[:1]), heading) for guess, stand, heading in guesses]
    # Eight starts are kept after the widest likelihood, which is nearly convex.
    kept = sorted(wide, key=lambda one: -one[0].value)[:8]
    narrow = [(tried(one.state, heading, SCALES_M[1:]), heading) for one, heading in kept]
    best, heading = max(narrow, key=lambda one: one[0].value)
    rival = _second_solution(scene, best, [one for one, _ in narrow], time)
    return scene.turned_by(heading), Trajectories(time, best.positions(time)), _stand(best), rival


def _second_solution(scene: Scene, best: MotionFit, tried: list[MotionFit], time: Floats) -> str:
    """Return a sentence on a second solution of the first window (seconds (k,)), "" without one."""
    given = any(place is not None for place in scene.still.values())
    for one in sorted(tried, key=lambda one: -one.value):
        away = np.median(np.linalg.norm(one.positions(time) - best.positions(time), axis=2), axis=0)
        longer = float(np.median(np.abs(one.residuals - best.residuals)))
        # Positions among given anchors differ by half a metre, or distances by a decimetre, in the median.
        differs = away.max() >= 0.5 if given else longer >= 0.1
        if differs and best.value - one.value < EQUAL_LIKELIHOOD:
            what = f"{scene.moving[int(np.argmax(away))]} {away.max():.1f} m away" if given else "other distances"
            return (
                f"a second solution, with {what}, fits the first {time[-1] - time[0]:.0f} s as well: the delays may "
                f"belong to the wrong one"
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
    """Return relative positions of bodies (moving, then sought) by scaling of their mean ranges."""
    bodies = [*scene.moving, *scene.sought]
    number = {tag: bodies.index(body) for tag, (body, _) in scene.arms.items() if body in bodies}
    ranges = scene.ranges[np.isin(scene.ranges.initiator, [*number]) & np.isin(scene.ranges.target, [*number])]
    pairs = pairs_of(
        *(np.array([number[tag] for tag in ids.tolist()], np.int64) for ids in (ranges.initiator, ranges.target))
    )
    mean = np.bincount(pairs.number, ranges.raw_m) / np.bincount(pairs.number)
    # A distance of zero would be no link, and delays can make a range negative. Twenty metres are a large hall.
    return scaled_places(pairs.ends, np.maximum(mean, 1e-3), len(bodies), 3, most_m=20.0)


def _initial_anchors(scene: Scene, seed: Trajectories) -> Floats:
    """Return the positions of the standing bodies, each from the start that fits its ranges best."""
    window = scene.between(float(seed.time_s[0]), float(seed.time_s[-1]))
    rng = np.random.default_rng(0)
    here, sought = seed.position_m.reshape(-1, 3), scene.sought
    tags = [[tag for tag, (body, _) in scene.arms.items() if body == name] for name in sought]
    mine = np.array([np.isin(window.ranges.ends, own).any(axis=1) for own in tags], dtype=np.float64)
    starts = rng.normal(here.mean(axis=0), here.std(axis=0) + START_SPREAD_M, (START_COUNT // 3, len(sought), 3))
    fits = [fit_motion(window, seed.state(window, start), SCALES_M, WINDOW_JERK_M_S3) for start in starts]
    cost = [mine @ np.log1p((one.residuals / SCALES_M[-1]) ** 2) for one in fits]
    best = np.argmin(cost, axis=0).tolist()
    return np.array([_stand(fits[start])[number] for number, start in enumerate(best)])


def resolve_headings(scene: Scene, state: State) -> tuple[Scene, State, str]:
    """Return the scene with the headings that fit the whole flight best, its motion, and a sentence on doubtful ones.

    A first window with few ranges leaves a heading uncertain by tens of degrees, and a local search does not recover.
    Therefore a full circle of headings is tried over the whole flight for each unknown one.
    """
    unknown = scene.without_heading
    if not unknown:
        return scene, state, ""

    def fitted(heading: Mapping[str, float], start: State) -> MotionFit:
        few = scene.turned_by(heading).thinned(600)
        return fit_motion(few, start, SCALES_M[-1:], JERK_M_S3, steps=8)

    turns = np.radians(np.arange(30, 360, 30)).tolist()
    heading, unsure = dict.fromkeys(unknown, 0.0), list[str]()
    best = fitted(heading, state)
    for _ in range(2):
        unsure, before = [], dict(heading)
        for body in unknown:
            here = heading[body]
            tried = {here: best} | {here + turn: fitted(heading | {body: here + turn}, best.state) for turn in turns}
            heading[body] = max(tried, key=lambda angle: tried[angle].value)
            best = tried[heading[body]]
            rivals = [angle for angle, one in tried.items() if best.value - one.value < EQUAL_LIKELIHOOD]
            # Headings that differ by less than 50 degrees converge to one solution.
            if any(abs(np.angle(np.exp(1j * (angle - heading[body])))) > np.radians(50.0) for angle in rivals):
                unsure.append(body)
        if heading == before:
            break
    text = (
        f"a second solution, with another heading of {', '.join(unsure)}, fits as well: the delays may belong to the "
        f"wrong one"
    )
    return scene.turned_by(heading), best.state, text if unsure else ""
