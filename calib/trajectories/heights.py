"""Readings of height sensors: means over short windows, and what they say of a body's middle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints

WINDOW_S: Final = 0.1
HEIGHT_STD_M: Final = 0.1
"""What a mean reading is off by beside a constant, before the data say it better."""

FELT: Final = 3.0
"""How much less than its residuals say a sensor is trusted: what it is off by lasts for some windows."""

STD_M: Final = (0.02, 1.0)
TURNS_AWAY: Final = 2.0
"""Beyond so many spreads a reading counts less (Huber 1964): a sensor that looks down sees what stands below it."""


@dataclass(frozen=True, slots=True)
class Heights:
    """Mean heights of moving bodies: seconds (k,), number of the body (k,), metres (k,), standard errors (k,)."""

    time_s: Floats
    body: Ints
    height_m: Floats
    std_m: Floats

    def __getitem__(self, rows: Bools) -> Heights:
        """Return the chosen ones."""
        return Heights(self.time_s[rows], self.body[rows], self.height_m[rows], self.std_m[rows])

    def within(self, begin_s: float, end_s: float) -> Heights:
        """Return those inside a span of time."""
        return self[(self.time_s >= begin_s) & (self.time_s <= end_s)]

    def weighed(self, residual: Floats) -> Heights:
        """Return them with standard errors by what they were off, `residual` (k,) over the present ones."""
        if not len(residual):
            return self
        off = residual * self.std_m
        spread = float(np.clip(FELT * robust_spread(off, 0.0), *STD_M))
        share = np.minimum(1.0, TURNS_AWAY * spread / FELT / np.maximum(np.abs(off), 1e-9))
        return replace(self, std_m=spread / np.sqrt(share))


def no_heights() -> Heights:
    """Return no readings."""
    return Heights(np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))


def heights_of(table: Mapping[str, NDArray[Any]], moving: Sequence[str], began_ns: int, last_s: float) -> Heights:
    """Return the readings of moving bodies in a recording's table, as medians over windows."""
    if not table:
        return no_heights()
    parts = [_of_body(table, body, number, began_ns, last_s) for number, body in enumerate(moving)]
    names = ("time_s", "body", "height_m", "std_m")
    return Heights(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _of_body(table: Mapping[str, NDArray[Any]], body: str, number: int, began_ns: int, last_s: float) -> Heights:
    rows = np.flatnonzero((table["body"] == body) & np.isfinite(table["height_m"]))
    time = np.asarray((table["time_ns"][rows] - began_ns) * 1e-9, dtype=np.float64)
    inside = (time >= 0) & (time <= last_s)
    order = np.argsort(time[inside], kind="stable")
    time, height = time[inside][order], np.asarray(table["height_m"][rows][inside][order], dtype=np.float64)
    starts = np.flatnonzero(np.diff(np.floor(time / WINDOW_S), prepend=-np.inf))
    groups = list(zip(np.split(time, starts[1:]), np.split(height, starts[1:]), strict=True)) if len(starts) else []
    middle = np.array([[float(np.mean(when)), float(np.median(some))] for when, some in groups]).reshape(-1, 2)
    count = len(middle)
    return Heights(middle[:, 0], np.full(count, number), middle[:, 1], np.full(count, HEIGHT_STD_M))
