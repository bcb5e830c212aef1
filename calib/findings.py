"""Findings and checks, and the tests that turn a statistic into a p-value.

A check asks one question of a recording or of a fit. Its statistic has a known distribution on sound data, which gives
a p-value. All checks share one budget of false alarms. Sound recordings have small systematic errors, such as the delay
of a warm board or a lever arm measured with a ruler. They are a tolerance: the null hypothesis is "at most the
tolerance" (a minimum-effect test, Murphy and Myors 1999). So a small error does not become a finding because a
recording is long. Other conditions can only suppress a finding, so p-values stay valid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

import numpy as np
from scipy import special

import uwblink
from uwblink.arrays import Floats

BUDGET: Final = 0.01
"""Share of sound recordings with at least one false finding; checks of a recording and of its fit share it
(Bonferroni)."""

OF_A_FIT: Final = BUDGET / 2
"""Share of sound fits with at least one false finding, over all tests. The other half of the budget belongs to the
checks of the recording."""

FIT_LEVELS: Final = {
    "offsets": 0.5 * OF_A_FIT,
    "places": 0.3 * OF_A_FIT,
    **dict.fromkeys(("reflections", "directions", "powers", "clocks", "distances"), 0.04 * OF_A_FIT),
}
"""Parts of `OF_A_FIT`, a judgement: offsets and errors of places that matter may have p-values near the level, and the
others have p-values far below any level."""

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
    """A fault or a limit: its name, the evidence, the remedy, and the probability that sound data show as much.

    `p_value` is 0 if no chance is involved, for example if numbers contradict each other, and None if nothing was
    tested, as for a limit of the data.
    """

    fault: str
    evidence: str
    remedy: str
    p_value: float | None

    def __str__(self) -> str:
        """Return the evidence and the remedy."""
        return f"{self.evidence}; {self.remedy}" if self.remedy else self.evidence


REMEDIES: Final = {
    # Unknowns that the data do not determine.
    "undetermined delays": "record ranges among three of these tags, or state a known delay (`fixed_ns`)",
    "undetermined pattern over direction": "record a flight in which the robot makes a full turn at several places",
    "undetermined slope over temperature": "record while the boards warm up",
    "pattern or effect of power": "compare with a fit with `pattern` none and `groups` of tags",
    "pattern or wrong lever arm": "measure this lever arm again, or run `calib doctor`",
    "pattern of another tag": "fit all recordings together to estimate it",
    "constants of pairs": "record three or more tags that all range with each other for delays",
    "given delays": "fit without `delays_from` to estimate them",
    "no curve": "fit without `delays_only` if the powers of a pair vary",
    "no powers": "record with powers, at several distances and attitudes, to fit a curve",
    "constant power": "record at several distances and attitudes to fit a curve",
    "reference power without effect": "leave it out, or let the fit determine all delays",
    "reference power": "compare the delays only with those at the same power",
    "no redundant pairs": "record more tags, or anchors",
    "power confounded with distance": "turn the antennas while recording, or fit with `delays_only`",
    # Faults of tags, pairs and true distances.
    "offset of a pair": "record this pair again",
    "delay changed for a time": "check whether the antenna was touched",
    "delay changed between recordings": "check whether an antenna was changed, or something moved, in between, and fit "
    "the recordings separately",
    "errors of one tag over power": "check its antenna and the objects near it",
    "power readings of a tag": "check its gain and its antenna",
    "power levels of tags": "compare its delay only with delays at the same powers",
    "noisy powers": "turn the antennas while recording",
    "clock skew": "import with protocol ss-cfo, or change the sign of the carrier readings",
    "clocks contradict the carriers": "check the firmware's third messages, or import with protocol ss-cfo",
    "two antenna delays of a tag": "program also the firmware's constants (`calib export --to firmware`), and record "
    "again",
    "positions of listeners": "check the positions of the listeners, or fit with `use` exchanges",
    "positions of a target and a listener": "check the positions of both tags",
    "unused differences of arrival": "fit with `use` receptions",
    "scale of true distances": "check scale, unit and lever arms of the true distances; weak reflections, which shift "
    "first paths, can grow with the distance as well",
    "time offset of true distances": "check the clocks (`calib doctor` states the difference)",
    "errors of places": "check the lever arms, then record also at other places, or farther from walls: a common error "
    "of all ranges cannot be detected",
    "unknown offsets of bodies": "record more robots or anchors, or their positions for the whole flight",
    "reflections of a pair": "record it again, the delays depend on the other pairs",
    "reflections of a tag": "check for objects near its antenna",
    "supply voltage": "keep the supply constant while boards warm up",
    "wrong known distance": "measure it again, antenna to antenna, or leave it out",
    "motion faster than the trajectory": "fly more slowly",
    "unused known distance": "give an arrangement or its seconds",
    "second solution": "use anchors that are not in one plane, attitudes, heights, or a known start",
    # Surveys.
    "arrangement not as stated": "move the boards onto the line or plane, or survey without `known`",
    "board moved within an arrangement": "record that arrangement again, or end it before",
    "exchanged labels": "check the labels of these boards",
    "few ranges of a pair": "record for longer",
    "powers outside those of the curve": "use the curve of a calibration at such powers",
    "common part of delays": "state a measured distance (`known`)",
    "delays that a survey leaves open": "record another arrangement, or measure a distance: `calib plan survey` "
    "proposes which",
    "two solutions of a survey": "measure a distance that differs between the two solutions, and give it as known",
    # Limits of the data as a whole.
    "few independent stretches": "record for longer",
    "short recording": "record for longer",
    "ranges without stamps": "record the stamps, if the device states them",
    "implausible delay": "check the unit of true distances, the order of stamps, the sign of carrier readings and the "
    "configured antenna delays",
    "large errors": "check the true distances",
    "ranges outside three sigmas": "run `calib doctor`",
    "exchanges left out": "run `calib doctor`",
    "another loss": "compare with other losses",
    "not converged": "check the data with `calib doctor`, or try another loss",
}
"""What to do about each fault and limit of a fit or a survey."""


def combined(findings: Sequence[Finding]) -> Finding:
    """Return one finding for causes that have the same effect, with the names of all."""
    return Finding(
        " or ".join(one.fault for one in findings),
        "; or ".join(one.evidence for one in findings),
        "; ".join(filter(None, (one.remedy for one in findings))),
        findings[0].p_value,
    )


def warning(fault: str, evidence: str, p_value: float | None = None) -> Finding:
    """Return the finding of a fault or limit among `REMEDIES`."""
    return Finding(fault, evidence, REMEDIES[fault], p_value)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A possible finding of a check: the fault, its evidence, its p-value, and words that complete the remedy.

    A check that involves no chance states no p-value. `gain` is the reduction of the recording's errors if the fault is
    undone; 0 for checks that do not undo it.
    """

    fault: str
    evidence: str
    p_value: float = 1.0
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
        """Return the candidates whose p-value is below a level as findings; all of them if no chance is involved."""
        return [
            Finding(one.fault, one.evidence, self.remedies[one.fault].format(**one.words), p_value)
            for one in candidates
            if (p_value := 0.0 if self.certain else one.p_value) < level
        ]


def for_provenance(
    findings: Iterable[Finding], settings: Mapping[str, Any], fixed_ns: Mapping[int, float]
) -> dict[str, Any]:
    """Return what every calibration states: its writer, changed settings, known delays and findings.

    Findings are sentences, and the fault and the p-value of each in their order.
    """
    several = list(findings)
    given = {"settings": settings, "fixed_ns": {str(tag): delay for tag, delay in sorted(fixed_ns.items())}}
    return {
        "writer": f"uwbcal {uwblink.__version__}",
        **{name: values for name, values in given.items() if values},
        "warnings": [str(one) for one in several],
        "findings": [{"fault": one.fault, "p_value": one.p_value} for one in several],
    }


def contradictions_in(provenance: Mapping[str, Any]) -> list[str]:
    """Return the sentences of the findings in a calibration that have a p-value, so that they are no mere limits.

    Calibrations from before 0.3 have the sentences themselves as findings. Raises `AttributeError`, `TypeError` and
    `ValueError` for entries that no version writes.
    """
    found = list(provenance.get("findings", []))
    if all(isinstance(one, str) for one in found):
        return found
    rows = zip(provenance["warnings"], found, strict=True)
    return [str(text) for text, one in rows if one.get("p_value") is not None]


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
