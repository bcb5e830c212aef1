"""What happens to a body in order of time: steps of its inertial readings, ranges, heights; and when it is at rest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.evaluation.onboard_data import Readings
from calib.evaluation.onboard_track import OnboardSettings
from uwblink.arrays import Floats

SPAN_S: Final = 0.5
CALM_RAD_S: Final = 0.004
CALM_M_S2: Final = 0.05
SLOW_RAD_S: Final = 0.02
"""A body is at rest in a span of time in which its readings scatter less: rotors vibrate twenty times as much."""


def events(
    one: Readings, settings: OnboardSettings, begin_s: float
) -> Iterator[tuple[float, str, int, Floats, Floats]]:
    """Yield times at which something happens, what, its number, and mean inertial readings since the one before."""
    step = 1 / settings.rate_hz
    end_s = float(one.time_s[-1])
    grid = np.arange(begin_s + step, end_s, step)
    times = {"step": grid, "range": one.time_s[one.time_s >= begin_s]}
    numbers = {"step": np.arange(len(grid)), "range": np.flatnonzero(one.time_s >= begin_s)}
    if settings.height and len(one.height_s):
        # Ten a second are enough: its offset wanders slowly.
        every = np.unique(np.floor(one.height_s * 10), return_index=True)[1]
        rows = every[(one.height_s[every] >= begin_s) & (one.height_s[every] <= end_s)]
        times["height"], numbers["height"] = one.height_s[rows], rows
    kinds = np.repeat(list(times), [len(part) for part in times.values()])
    when, which = np.concatenate(list(times.values())), np.concatenate(list(numbers.values()))
    order = np.argsort(when, kind="stable")
    between = _means(one, np.concatenate([[begin_s], when[order]]))
    for k, row in enumerate(order.tolist()):
        yield float(when[row]), str(kinds[row]), int(which[row]), between[k, :3], between[k, 3:]


def _means(one: Readings, edges: Floats) -> Floats:
    """Return the means of inertial readings between edges (n + 1,), straight between two readings: (n, 6)."""
    if not len(one.imu_s):
        return np.zeros((len(edges) - 1, 6))
    values = np.hstack([one.gyro, one.force])
    steps = np.diff(one.imu_s)[:, None] * (values[1:] + values[:-1]) / 2
    gathered = np.vstack([np.zeros(6), np.cumsum(steps, axis=0)])
    inside = np.clip(edges, one.imu_s[0], one.imu_s[-1])
    at = np.column_stack([np.interp(inside, one.imu_s, column) for column in gathered.T])
    span = np.diff(inside)[:, None]
    now = np.column_stack([np.interp(inside[1:], one.imu_s, column) for column in values.T])
    # A sum of straight pieces read straight between its own points is off by less than its last piece.
    return np.asarray(np.where(span > 1e-9, np.diff(at, axis=0) / np.maximum(span, 1e-9), now))


def still_spans(one: Readings) -> set[int]:
    """Return the half seconds in which inertial readings say that nothing moves: no vibration, no turning."""
    span = np.floor(one.imu_s / SPAN_S).astype(np.int64)
    edges = np.flatnonzero(np.diff(span, prepend=span[:1] - 1)) if len(span) else np.zeros(0, dtype=np.int64)
    found = set()
    for begin, end in zip(edges, np.append(edges[1:], len(span)), strict=True):
        turns, pulls = one.gyro[begin:end], one.force[begin:end]
        calm = turns.std(axis=0).max() < CALM_RAD_S and pulls.std(axis=0).max() < CALM_M_S2
        if end - begin > 1 and calm and np.abs(turns.mean(axis=0)).max() < SLOW_RAD_S:
            found.add(int(span[begin]))
    return found
