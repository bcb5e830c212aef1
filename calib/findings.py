"""Findings and checks, and the tests that turn a statistic into a p-value.

A check asks one question of a recording or of a fit. Its statistic has a known distribution on sound data, which gives
a p-value. All checks share one budget of false alarms. Sound recordings have small systematic errors, such as the delay
of a warm board or a lever arm measured with a ruler. They are a tolerance: the null hypothesis is "at most the
tolerance" (a minimum-effect test, Murphy and Myors 1999). So a small error does not become a finding because a
recording is long. Other conditions can only suppress a finding, so p-values stay valid.
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
"""Share of sound recordings with at least one false finding; checks of a recording and of its fit share it
(Bonferroni)."""

OF_A_FIT: Final = BUDGET / 2
"""Share of sound fits with at least one false finding, over all alternatives. The other half of the budget belongs to
the checks of the recording."""

SMALLEST_NS: Final = 0.02
"""Smallest error of a delay that is a finding: 3 mm of a range."""

NAMED_DETOUR_M: Final = 0.12
"""Smallest mean detour that is a finding. Noise that is not normal, or that changes slowly, looks like shorter detours:
in some simulated flights of six robots without a fault, a fifth of the ranges is fitted as reflected by 8 cm."""

STRETCHES: Final = 16
"""Number of stretches of time over which a statistic is averaged. The relative standard error of the variance of 16
means is about a third: the root of 2/15."""

CERTAIN: Final = "none: no chance is involved"
"""Distribution (`Check.sound`) of a check whose findings are certain."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault: its name, the evidence, the remedy, and the probability that sound data show as much evidence.

    `p_value` is 0 if no chance is involved, for example if numbers contradict each other.
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

    `gain` is the reduction of the recording's errors if the fault is undone; 0 for checks that do not undo it.
    """

    fault: str
    evidence: str
    p_value: float = 0.0
    words: Mapping[str, Any] = field(default_factory=dict)
    gain: float = 0.0


@dataclass(frozen=True, slots=True)
class Check:
    """A row of the table of checks: stage, question, statistic, its distribution on sound data, and remedies.

    `remedies` maps names of faults to remedies, with format fields for the `words` of a candidate. `look` is a function
    that yields candidates.
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
    """Return the p-value of a value with a standard error, by Student's t with `dof` degrees of freedom.

    The null hypothesis is that the true absolute value is at most `tolerance`. `tried` is the number of tests, over
    which the p-value is corrected (Bonferroni). Returns 1 for values that are not finite.
    """
    if not np.isfinite(value) or not np.isfinite(std):
        return 1.0
    over = (abs(value) - tolerance) / max(std, 1e-12)
    return min(1.0, 2 * tried * float(special.stdtr(dof, -over))) if over > 0 else 1.0


def positive(values: Floats, *, tried: float = 1) -> float:
    """Return the p-value of values (n,) of stretches of time, by Student's t.

    The null hypothesis is that their mean is at most 0. `tried` is the number of tests (Bonferroni). Returns 1 if fewer
    than half of `STRETCHES` values are finite.
    """
    good = values[np.isfinite(values)]
    if len(good) < STRETCHES // 2:
        return 1.0
    std = max(float(np.std(good, ddof=1)), 1e-12) / np.sqrt(len(good))
    return min(1.0, tried * float(special.stdtr(len(good) - 1, -float(np.mean(good)) / std)))


def more_often(count: int, of: int, chance: float, *, tried: float = 1) -> float:
    """Return the probability of at least `count` successes in `of` independent trials with probability `chance`.

    It is multiplied by the number of tests `tried` (Bonferroni), and at most 1.
    """
    return min(1.0, tried * float(special.bdtrc(count - 1, of, chance))) if count > 0 else 1.0


def stretches(count: int, fewest: int = 30) -> list[slice]:
    """Divide `count` rows, in order of time, into at most `STRETCHES` stretches of equal count.

    Each has at least `fewest` rows. Returns none if this allows fewer than half of `STRETCHES`.
    """
    some = min(STRETCHES, count // fewest)
    edges = np.linspace(0, count, some + 1).astype(int) if some >= STRETCHES // 2 else np.zeros(1, dtype=int)
    return [slice(a, b) for a, b in pairwise(edges.tolist())]
