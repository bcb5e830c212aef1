"""Headings that nobody knows, found over a whole flight: by accelerations and lever arms, one body after the other.

A first window that is short of ranges leaves a heading open by tens of degrees, and a search does not come back from
there. Where trajectories have been followed, each heading all around can be tried against all of the flight.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from calib.trajectories.known_rows import known_rows
from calib.trajectories.range_losses import Cauchy
from calib.trajectories.range_rows import range_rows
from calib.trajectories.scene import Scene
from calib.trajectories.solving import Optimum, minimise
from calib.trajectories.unknowns import State, columns_of

OTHERS: Final = tuple((np.arange(1, 12) * np.pi / 6).tolist())
"""By how much headings are turned, all around."""

FAR: Final = float(np.radians(50.0))
"""Headings that are nearer are the same, to be found by going downhill."""

PASSES: Final = 2
ENOUGH: Final = 600
"""Ranges of a flight that are looked at."""

LOOSE_M: Final = 0.3
STEPS: Final = 8
AS_LIKELY: Final = 6.0
"""Headings are taken for alike whose log likelihoods differ by less."""


def without_heading(scene: Scene) -> list[str]:
    """Return the bodies whose first heading is not known."""
    return [body for body, known in scene.attitudes.items() if not np.isfinite(known.std_rad[2]) and not known.begun]


def headed(scene: Scene, heading: dict[str, float]) -> Scene:
    """Return the scene with the attitudes of some bodies turned about the vertical by their headings."""
    if not heading:
        return scene
    attitudes = {body: known.headed(heading.get(body, 0.0)) for body, known in scene.attitudes.items()}
    inertial = {body: some.headed(heading.get(body, 0.0)) for body, some in scene.inertial.items()}
    return replace(scene, attitudes=attitudes, inertial=inertial)


def turned_right(scene: Scene, state: State) -> tuple[Scene, State, str]:
    """Return the scene with the headings that fit all of a flight best, its unknowns, and what is not sure of them.

    `state` has the trajectories that were followed, and no delays or curve. Nothing changes where headings are known.
    """
    unknown = without_heading(scene)
    if not unknown:
        return scene, state, ""
    few = scene.only(np.arange(0, len(scene.time_s), max(len(scene.time_s) // ENOUGH, 1)))
    best, unsure = _settled(few, state), list[str]()
    for _ in range(PASSES):
        unsure, turns = [], dict[str, float]()
        for body in unknown:
            tried = {0.0: best} | {turn: _settled(headed(few, {body: turn}), best.state) for turn in OTHERS}
            turn = min(tried, key=lambda angle: tried[angle].cost)
            best = tried[turn]
            if turn:
                turns[body], few = turn, headed(few, {body: turn})
            if any(one.cost - best.cost < AS_LIKELY and _apart(angle, turn) > FAR for angle, one in tried.items()):
                unsure.append(body)
        scene = headed(scene, turns)
        if not turns:
            break
    return scene, best.state, _told(unsure)


def _settled(scene: Scene, state: State) -> Optimum:
    """Return what fits a scene best near a state."""
    columns = columns_of(scene, 0)
    rows = range_rows(scene, columns, scene.ranges.raw_m, np.zeros((len(scene.time_s), 0)))
    return minimise(rows, known_rows(scene, columns, state), state, Cauchy(LOOSE_M), most_steps=STEPS, settled=1.0)


def _apart(first: float, second: float) -> float:
    return abs(float(np.angle(np.exp(1j * (first - second)))))


def _told(unsure: list[str]) -> str:
    if not unsure:
        return ""
    return (
        f"a second solution, with another heading of {', '.join(unsure)}, fits as well: delays are those of one of "
        "them; attitudes or a known start tell which"
    )
