"""Where the whole search begins: bodies followed from where they are known to be, or from what fits a first window."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.trajectories.headings import headed, turned_right, without_heading
from calib.trajectories.known_rows import known_rows
from calib.trajectories.range_losses import Cauchy
from calib.trajectories.range_rows import range_rows
from calib.trajectories.scene import Scene
from calib.trajectories.solving import minimise
from calib.trajectories.starting import (
    SAMPLE_S,
    SCALES_M,
    Followed,
    Settled,
    follow,
    known_at_first,
    positions,
    settle,
    through,
    window_s,
)
from calib.trajectories.unknowns import State, columns_of
from uwblink.arrays import Floats

STARTS: Final = 24
ENOUGH: Final = 400
"""Ranges of a first window that are looked at."""

AROUND_M: Final = 2.0
HEADED_S: Final = 8.0
"""A first window lasts so long at least where headings are to be found in it."""

AS_LIKELY: Final = 6.0
"""Solutions of a first window are taken for alike whose log likelihoods differ by less."""

ELSEWHERE_M: Final = 0.5
APART_M: Final = 0.1
"""Places among given anchors, and distances, that differ by more in the median are other ones."""


@dataclass(frozen=True, slots=True)
class Beginning:
    """Trajectories and standing bodies that fit the raw ranges, as unknowns without delays or curve.

    The `scene` has headings in its attitudes that were found, where they were not known. `rival` says in a sentence
    whether something else fits as well; it is empty where nothing does.
    """

    scene: Scene
    state: State
    rival: str = ""


def beginning(scene: Scene, done: Callable[[float], None]) -> Beginning:
    """Return where the search begins."""
    seed = next(known_at_first(scene), None)
    stand, rival = np.zeros((len(scene.sought), 3)), ""
    if seed is None:
        scene, seed, stand, rival = _first_window(scene)
    elif scene.sought:
        stand = _seen_from(scene, seed)
    found, stand = follow(scene, seed, stand, lambda share: done(0.8 * share))
    columns = columns_of(scene, 0)
    scene, start, unsure = turned_right(scene, through(scene, columns, found, stand))
    rows = range_rows(scene, columns, scene.ranges.raw_m, np.zeros((len(scene.time_s), 0)))
    known = known_rows(scene, columns, start)
    for scale in SCALES_M:
        start = minimise(rows, known, start, Cauchy(scale), settled=1.0).state
    return Beginning(scene, start, rival or unsure)


def _first_window(scene: Scene) -> tuple[Scene, Followed, Floats, str]:
    """Return where bodies are in the first window, from many starts: the one that fits best, and what rivals it."""
    begin = float(scene.time_s[0])
    headless = without_heading(scene)
    length = max(window_s(scene), HEADED_S if headless else 0.0)
    time = np.arange(begin, begin + length + SAMPLE_S / 2, SAMPLE_S)
    window = scene.between(begin, float(time[-1]))
    window = window.only(np.arange(0, len(window.time_s), max(len(window.time_s) // ENOUGH, 1)))
    tried = [
        (settle(headed(window, heading), guess, stand), heading)
        for guess, stand, heading in _guesses(window, time, headless)
    ]
    best, heading = min(tried, key=lambda one: one[0].cost)
    rival = _rival(scene, best, [one for one, _ in tried], time)
    return headed(scene, heading), Followed(time, positions(best.columns, best.state, time)), best.stand, rival


def _rival(scene: Scene, best: Settled, tried: list[Settled], time: Floats) -> str:
    """Return in a sentence what else fits a first window (seconds (k,)) as well; nothing if nothing does."""
    close = sorted((one for one in tried if one.cost - best.cost < AS_LIKELY), key=lambda one: one.cost)
    given = any(place is not None for place in scene.still.values())
    for one in close:
        if not given and float(np.median(np.abs(one.residuals - best.residuals))) < APART_M:
            continue
        here, there = (positions(some.columns, some.state, time) for some in (best, one))
        away = np.median(np.linalg.norm(there - here, axis=2), axis=0)
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
    shape = _shape(scene)
    moving = len(scene.moving)
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
    here = seed.position_m.reshape(-1, 3)
    sought = scene.sought
    best, stand = np.full(len(sought), np.inf), np.zeros((len(sought), 3))
    mine = [
        np.isin(ids, [tag for tag, (body, _) in scene.arms.items() if body == name])
        for name in sought
        for ids in (window.ranges.initiator, window.ranges.target)
    ]
    for _ in range(STARTS // 3):
        guess = rng.normal(here.mean(axis=0), here.std(axis=0) + AROUND_M, (len(sought), 3))
        settled = settle(window, seed, guess)
        off = np.log1p((settled.residuals / SCALES_M[-1]) ** 2)
        cost = np.array([off[mine[2 * k] | mine[2 * k + 1]].sum() for k in range(len(sought))])
        better = cost < best
        best[better], stand[better] = cost[better], settled.stand[better]
    return stand
