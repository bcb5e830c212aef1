"""What is left of errors after each pair's own level and what power does to all ranges have been taken off.

Examinations of delays, pairs and reflections look at these: neither delays nor a curve over power nor a few outliers
move them. How uncertain a mean is comes from means over stretches of time, so that errors that last count as one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.checks.recording_view import RecordingView, pair_ids
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints

ROUNDS: Final = 4
STEPS: Final = 24
"""Steps of power of equal count in which a common bias is taken off."""

FEWEST: Final = 40
"""Ranges of a pair, below which nothing is said of it."""

STRETCHES: Final = 16
DOF: Final = 9
"""Degrees of freedom of a variance from differences of neighbouring stretches: two thirds of fourteen (von Neumann)."""

OF_MEDIAN: Final = np.pi / 2
"""Variance of a median over that of a mean, of normal errors."""

PAUSE_S: Final = 10.0
"""Time without ranges counts for so long at most: what lies between two sessions says nothing of errors that last."""

CLIP: Final = 2.5
"""Spreads beyond which an error counts no further: a reflection is not to move a mean."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Levels:
    """Ranges with a true distance (n,), in order of time, and the `level` of each pair (k,), metres.

    `rest` (n,) is what is left of each error, `ends` (k, 2) the tags of a pair, `pair` (n,) which one it is, `time_s`
    (n,) counts from the first without pauses, `host_s` (n,) with them, `spread` is that of the rest. `rows` are those
    of the view.
    """

    rows: Ints
    time_s: Floats
    host_s: Floats
    pair: Ints
    ends: Ints
    level: Floats
    rest: Floats
    spread: float

    def named(self, pair: int) -> str:
        """Return a pair as it is written."""
        return "-".join(map(str, self.ends[pair].tolist()))

    def pairs_of(self, tag: int) -> Ints:
        """Return the numbers of a tag's pairs."""
        return np.flatnonzero((self.ends == tag).any(axis=1))

    def variances(self, values: Floats) -> Floats:
        """Return the variance that a range of each pair (k,) adds to a sum of values (n,); see `variance_of_sum`."""
        return np.array([
            variance_of_sum(values[self.pair == p], self.time_s[self.pair == p]) for p in range(len(self.level))
        ])  # fmt: skip

    @property
    def clipped(self) -> Floats:
        """The rest, held within some spreads."""
        reach = CLIP * self.spread
        return np.clip(self.rest, -reach, reach)


def levels(view: RecordingView) -> Levels | None:
    """Return the levels of a recording; None where too little is known of any pair."""
    error = view.error_m
    rows = np.flatnonzero(np.isfinite(error))
    rows = rows[np.argsort(view.exchanges.time_ns[rows], kind="stable")]
    keys, pair, count = np.unique(pair_ids(view.exchanges)[rows], return_inverse=True, return_counts=True)
    rows, pair = rows[count[pair] >= FEWEST], pair[count[pair] >= FEWEST]
    if not len(rows):
        return None
    kept, pair = np.unique(pair, return_inverse=True)
    e, error = view.exchanges, error[rows]
    step = _steps(lifted_power(e.fpp1_dbm[rows], e.fpp2_dbm[rows], "mean-of-lifted", ALPHA_DBM))
    level, common = np.zeros(len(kept)), np.zeros(int(step.max()) + 1)
    for _ in range(ROUNDS):
        level = medians(error - common[step], pair, len(kept))
        common = medians(error - level[pair], step, len(common))
        common -= np.median(common)
    rest = error - level[pair] - common[step]
    host_s = (e.time_ns[rows] - e.time_ns[rows[0]]) * 1e-9
    time_s = np.cumsum(np.minimum(np.diff(host_s, prepend=0.0), PAUSE_S))
    ends = np.column_stack([keys[kept] // 65_536, keys[kept] % 65_536])
    return Levels(
        rows=rows, time_s=time_s, host_s=host_s, pair=pair, ends=ends, level=level, rest=rest,
        spread=max(robust_spread(rest), 1e-4),
    )  # fmt: skip


def _steps(lifted: Floats) -> Ints:
    """Number steps of power (n,), one of their own for ranges without."""
    known = np.isfinite(lifted)
    count = max(1, min(STEPS, int(np.count_nonzero(known)) // 60))
    found = np.full(len(lifted), count, dtype=np.int64)
    order = np.argsort(lifted[known], kind="stable")
    found[np.flatnonzero(known)[order]] = np.arange(len(order)) * count // max(len(order), 1)
    return np.unique(found, return_inverse=True)[1]


def medians(values: Floats, place: Ints, count: int) -> Floats:
    """Return the median of values (n,) at each place (count,)."""
    order = np.argsort(place, kind="stable")
    parts = np.split(values[order], np.searchsorted(place[order], np.arange(1, count)))
    return np.array([np.median(part) if len(part) else 0.0 for part in parts])


def variance_of_sum(values: Floats, time_s: Floats) -> float:
    """Return the variance that each value (n,) adds to a sum, errors that last reckoned with.

    From differences of means over neighbouring stretches of time, without the largest: one step is no noise.
    """
    plain = float(np.var(values))
    edges = np.linspace(time_s[0], time_s[-1], STRETCHES + 1)[1:-1]
    parts = [part for part in np.split(values, np.searchsorted(time_s, edges)) if len(part) >= 3]
    if len(parts) < STRETCHES // 2:
        return plain
    size = np.array([len(part) for part in parts])
    mean = np.array([part.mean() for part in parts])
    square = np.sort(np.diff(mean) ** 2 / (1 / size[1:] + 1 / size[:-1]))[:-1]
    return max(plain, float(square.mean()) * len(square) / max(len(square) - 1, 1))
