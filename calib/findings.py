"""Findings and checks, and the tests that turn a statistic into a p-value.

A check asks one question of a recording or of a fit. Its statistic has a known distribution if nothing is wrong, which
gives a p-value; all checks share one budget of false alarms. What a sound recording may show besides chance (the delay
of a warm board, a lever arm measured with a ruler) is a tolerance: the null hypothesis is "no more than the tolerance"
(a minimum-effect test, Murphy and Myors 1999), so a small fault does not become a finding because a recording is long.
Other conditions can only suppress a finding, so p-values stay valid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

import numpy as np
from scipy import special

from uwblink.arrays import Floats

BUDGET: Final = 0.01
"""Share of sound recordings with any finding by chance: checks of a recording and of its fit share it (Bonferroni)."""

OF_A_FIT: Final = BUDGET / 2
"""Share of sound fits with any finding by chance, all alternatives together; the other half is the recording's."""

SMALLEST_NS: Final = 0.02
"""Error of a delay below which no fault is named: 3 mm of a range."""

NAMED_DETOUR_M: Final = 0.12
"""Detours that are named: shorter ones may as well be noise that is not normal, or an error that wanders. In
some flights of the simulator's six robots, without a fault, a fifth of the ranges is taken for reflected by 8 cm."""

STRETCHES: Final = 16
"""Stretches of time over which a statistic is averaged: their variance is then known to about a third."""

CERTAIN: Final = "none: no chance is involved"


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault: its name, the evidence, the remedy, and the probability that sound data show as much evidence.

    `p_value` is 0 if no chance is involved, as for numbers that contradict each other.
    """

    fault: str
    evidence: str
    remedy: str
    p_value: float

    def __str__(self) -> str:
        """Return the evidence and the remedy."""
        return f"{self.evidence}; {self.remedy}"


@dataclass(frozen=True, slots=True)
class Candidate:
    """A possible finding of a check: the fault, its evidence, its p-value, and words that complete the remedy.

    `gain` is by how much undoing the fault reduces the errors of the recording, where undoing it is the test.
    """

    fault: str
    evidence: str
    p_value: float = 0.0
    words: Mapping[str, Any] = field(default_factory=dict)
    gain: float = 0.0


@dataclass(frozen=True, slots=True)
class Check:
    """A row of the table of checks: stage, question, statistic, its distribution on sound data, and remedies.

    `remedies` maps names of faults to what to do, with fields for the words of a candidate; `look` yields candidates.
    """

    stage: str
    question: str
    statistic: str
    sound: str
    remedies: Mapping[str, str]
    look: Callable[..., Iterator[Candidate]]

    @property
    def certain(self) -> bool:
        """Whether the check involves no chance."""
        return self.sound == CERTAIN

    def findings(self, candidates: Iterable[Candidate], level: float) -> list[Finding]:
        """Return the candidates whose p-value is below a level as findings."""
        return [
            Finding(one.fault, one.evidence, self.remedies[one.fault].format(**one.words), one.p_value)
            for one in candidates
            if one.p_value < level
        ]


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
    """Return the p-value of at least `count` successes in independent trials with a probability of `chance`."""
    return min(1.0, tried * float(special.bdtrc(count - 1, of, chance))) if count > 0 else 1.0


def stretches(count: int, fewest: int = 30) -> list[slice]:
    """Return stretches of equal count of `count` rows in order of time, none where they have less than the `fewest`."""
    some = min(STRETCHES, count // fewest)
    edges = np.linspace(0, count, some + 1).astype(int) if some >= STRETCHES // 2 else np.zeros(1, dtype=int)
    return [slice(a, b) for a, b in pairwise(edges.tolist())]
