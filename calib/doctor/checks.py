"""What a check is, and the tests that turn its statistic into a p-value.

A check asks one question of a recording. Its statistic has a known distribution where the recording is sound, which
gives a p-value; one budget of false alarms is shared by all checks. What a sound recording may show besides chance (the
delay of a warm board, a lever arm measured by a ruler) is a tolerance: the hypothesis that is tested is "no more than
the tolerance" (a minimum-effect test, Murphy and Myors 1999), so that no size is decided by how long a recording is.
Further conditions of a check only withhold findings, which no p-value suffers from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

import numpy as np
from scipy import special

from calib.doctor.base import RecordingView, less_pairs
from calib.spread import robust_spread
from uwblink.arrays import Floats

BUDGET: Final = 0.01
"""Share of sound recordings of which anything is said by chance: the checks share it (Bonferroni)."""

STRETCHES: Final = 16
FEWEST_ROWS: Final = 30
"""Ranges of a stretch, so that its spread is known to an eighth."""

CERTAIN: Final = "none: no chance is involved"


@dataclass(frozen=True, slots=True)
class Seen:
    """A fault that a check saw: what shows it, its p-value, and words for the remedy.

    `gain` is what undoing the fault takes off the errors of the recording, where undoing it is the test.
    """

    fault: str
    evidence: str
    p_value: float = 0.0
    words: Mapping[str, Any] = field(default_factory=dict)
    gain: float = 0.0


@dataclass(frozen=True, slots=True)
class Check:
    """A row of the table of checks: the question, the statistic, its distribution on sound data, and the remedies.

    `remedies` has what to do by the name of the fault, with fields for the words of what was seen; `look` yields it.
    """

    question: str
    statistic: str
    sound: str
    remedies: Mapping[str, str]
    look: Callable[..., Iterator[Seen]]

    @property
    def certain(self) -> bool:
        """Whether the check involves no chance."""
        return self.sound == CERTAIN


def exceeds(value: float, std: float, dof: float, *, tolerance: float = 0.0, tried: float = 1) -> float:
    """Return the p-value of a value whose true size is the tolerance at most, by Student's t; `tried` were tested."""
    if not np.isfinite(value) or not np.isfinite(std):
        return 1.0
    over = (abs(value) - tolerance) / max(std, 1e-12)
    return min(1.0, 2 * tried * float(special.stdtr(dof, -over))) if over > 0 else 1.0


def positive(values: Floats, *, tried: float = 1) -> float:
    """Return the p-value of values (n,) of stretches of time whose true mean is 0 or less, by Student's t."""
    good = values[np.isfinite(values)]
    if len(good) < STRETCHES // 2:
        return 1.0
    std = max(float(np.std(good, ddof=1)), 1e-12) / np.sqrt(len(good))
    return min(1.0, tried * float(special.stdtr(len(good) - 1, -float(np.mean(good)) / std)))


def more_often(count: int, of: int, chance: float, *, tried: float = 1) -> float:
    """Return the p-value of so many or more of independent trials with a chance of success."""
    return min(1.0, tried * float(special.bdtrc(count - 1, of, chance))) if count > 0 else 1.0


def stretches(count: int) -> list[slice]:
    """Return stretches of equal count of so many rows in order of time, none where there are too few."""
    some = min(STRETCHES, count // FEWEST_ROWS)
    edges = np.linspace(0, count, some + 1).astype(int) if some >= STRETCHES // 2 else np.zeros(1, dtype=int)
    return [slice(a, b) for a, b in pairwise(edges.tolist())]


def narrower(view: RecordingView, before_m: Floats, after_m: Floats, *, tried: float = 1) -> tuple[float, float]:
    """Return p-value and gain of errors `after_m` (n,) instead of `before_m`, each less its pair's own median.

    The statistic is the logarithm of how much wider they spread before, by stretches of time, less `MATERIAL`.
    """
    a, b = less_pairs(view, before_m), less_pairs(view, after_m)
    rows = np.flatnonzero(np.isfinite(a) & np.isfinite(b) & (np.abs(before_m - after_m) > 1e-3))
    rows = rows[np.argsort(view.exchanges.time_ns[rows], kind="stable")]
    a, b = a[rows], b[rows]
    cuts = stretches(len(rows))
    if not cuts:
        return 1.0, 0.0
    wider = np.array([np.log(max(robust_spread(a[s], 0.0), 1e-6) / max(robust_spread(b[s], 0.0), 1e-6)) for s in cuts])
    gain = float(np.sum(np.minimum(np.abs(a), FAR_M) - np.minimum(np.abs(b), FAR_M)))
    return positive(wider + np.log(MATERIAL), tried=tried), gain


MATERIAL: Final = 0.95
"""Undoing a fault that narrows ranges by less than a twentieth is not worth a word: curves that are left in do that."""

FAR_M: Final = 10.0
"""Errors beyond count no further in a gain."""
