"""Where the whole search begins: bodies followed from where they are known to be, or from what fits a first window."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calib.errors import UnanswerableError
from calib.trajectories.known_rows import known_rows
from calib.trajectories.range_losses import Cauchy
from calib.trajectories.range_rows import range_rows
from calib.trajectories.scene import Scene
from calib.trajectories.solving import minimise
from calib.trajectories.starting import SCALES_M, follow, known_at_first, through
from calib.trajectories.unknowns import State, columns_of


def beginning(scene: Scene, done: Callable[[float], None]) -> State:
    """Return trajectories and standing bodies that fit the raw ranges, as unknowns without delays or curve."""
    seed = next(known_at_first(scene), None)
    if seed is None:
        raise UnanswerableError(f"{scene.source}: nowhere are all bodies known to be; give a known stretch")
    found, stand = follow(scene, seed, np.zeros((len(scene.sought), 3)), lambda share: done(0.8 * share))
    columns = columns_of(scene, 0)
    start = through(scene, columns, found, stand)
    rows = range_rows(scene, columns, scene.ranges.raw_m, np.zeros((len(scene.time_s), 0)))
    known = known_rows(scene, columns, start)
    for scale in SCALES_M:
        start = minimise(rows, known, start, Cauchy(scale), settled=1.0).state
    return start
