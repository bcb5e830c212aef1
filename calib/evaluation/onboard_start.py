"""Where a body begins, by its first ranges, and how it may be turned, by gravity and all around."""

from __future__ import annotations

from typing import Final

import numpy as np

from calib.errors import UnanswerableError
from calib.evaluation.multilateration import Fix, multilaterate
from calib.evaluation.onboard_data import Readings
from calib.evaluation.onboard_filter import GRAVITY
from calib.evaluation.onboard_track import OnboardSettings
from uwblink.arrays import Floats, Ints

FEWEST_RANGES: Final = 6
FEWEST_ANCHORS: Final = 3
LEAST_TILT_S: Final = 0.5
"""How long gravity is averaged for the first tilt."""


def first_fix(one: Readings, settings: OnboardSettings) -> tuple[int, Fix]:
    """Return the range at which the filter begins, and where it is by then."""
    if settings.start_m is not None:
        return 0, Fix(np.array(settings.start_m, dtype=np.float64), np.eye(3) * settings.start_std_m**2)
    for count in range(FEWEST_RANGES, len(one.time_s) + 1):
        if len(np.unique(one.anchor_m[:count], axis=0)) >= FEWEST_ANCHORS + 1:
            return count - 1, latest_fix(one, np.arange(count), settings)
    raise UnanswerableError(f"{one.source}: {one.body} ranges with too few anchors for a start; give it one")


def latest_fix(one: Readings, rows: Ints, settings: OnboardSettings) -> Fix:
    """Return where a body is at the last of some ranges (n,), which it may have moved between."""
    span = float(one.time_s[rows[-1]] - one.time_s[rows[0]])
    arm = float(np.linalg.norm(one.arm_m[rows], axis=1).max())
    moves = 0.3 * settings.speed_m_s * span
    near = np.abs(one.height_s - one.time_s[rows[-1]]) < 1.0 if settings.height else np.zeros(0, dtype=bool)
    height = float(np.median(one.height_m[near])) if near.any() else None
    found = multilaterate(one.range_m[rows], one.anchor_m[rows], float(np.hypot(arm / 2, moves)), height)
    return Fix(found.place_m, found.covariance_m2 + np.eye(3) * moves**2)


def first_attitudes(one: Readings, begin_s: float, settings: OnboardSettings) -> Floats:
    """Return attitudes (headings, 3, 3) with the tilt that gravity says, and headings all around."""
    force = mean_force(one, begin_s)
    up = force / np.linalg.norm(force)
    # The world's vertical in the axes of the body, and two axes across it.
    east = np.cross((0.0, 1.0, 0.0), up)
    east = east / np.linalg.norm(east)
    tilt = np.vstack([east, np.cross(up, east), up])
    angles = 2 * np.pi * np.arange(settings.headings) / settings.headings
    found = np.zeros((settings.headings, 3, 3))
    for k, (c, s) in enumerate(zip(np.cos(angles), np.sin(angles), strict=True)):
        found[k] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ tilt
    return found


def mean_force(one: Readings, begin_s: float) -> Floats:
    """Return the mean specific force about the start (3,)."""
    near = np.abs(one.imu_s - begin_s) < LEAST_TILT_S / 2
    return one.force[near].mean(axis=0) if near.any() else np.array([0.0, 0.0, GRAVITY])
