"""Whether a calibration is fit for use: criteria with their thresholds, what was found, and a sentence of it all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.parts import CorrectedRanges
from calib.data.ranges import Ranges
from calib.evaluation.statistics import Evaluation
from calib.report.blocks import Block
from calib.report.grades import BAD, DOUBT, GOOD, Criterion, graded, judgement
from calib.report.without_truth import criteria
from calib.spread import TWO_SIDED_95

if TYPE_CHECKING:
    from calib.evaluation.tracking import Localization

MOST_BIAS: Final = 0.5
"""Of the spread of one range: a bias half as large adds an eighth to the error of a single range."""

WORST_BIAS: Final = 1.0
INTERVAL: Final = (0.90, 0.985)
"""Share of errors within their 95 % intervals that is right; less, and a filter trusts the ranges too much."""

INTERVAL_LEAST: Final = 0.80
MOST_DELAY_NS: Final = 0.1
"""3 cm of range: as much as DW1000s of one kind differ by chance."""

MOST_CLAMPED: Final = 0.05
WORST_CLAMPED: Final = 0.25
LEAST_GAIN: Final = 0.05
"""Of the typical error: a calibration that takes off less is hardly worth its trouble."""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What a verdict is on: a calibration, ranges and how it does on them, whether those were held out, and doubts.

    `warnings` are those of the fit, `faults` those that the doctor found, `tracks` bodies that were localized.
    """

    calibration: Calibration
    ranges: Ranges
    corrected: CorrectedRanges
    evaluation: Evaluation
    held_out: bool
    warnings: Sequence[str] = ()
    faults: Sequence[str] = ()
    tracks: Sequence[Localization] = field(default_factory=list)


def verdict(judged: Judged) -> list[Block]:
    """Return the verdict: a sentence, and the table of criteria behind it."""
    return judgement([one for ask in CRITERIA for one in ask(judged)])


def _held_out(judged: Judged) -> list[Criterion]:
    held = judged.held_out
    return [
        Criterion(
            "Was it judged on recordings that the fit has not seen?",
            "yes",
            f"{judged.ranges.source}: {len(judged.ranges)} ranges" if held else "no: on those it was fitted to",
            GOOD if held else DOUBT,
            "it was judged on recordings that the fit has not seen"
            if held
            else "it was not judged on recordings that the fit has not seen, so what follows is too good",
        )
    ]


def _gain(judged: Judged) -> list[Criterion]:
    raw, full = (
        float(np.median(np.abs(getattr(judged.corrected, name) - judged.ranges.truth_m)))
        for name in ("raw_m", "corrected_m")
    )
    less = 1 - full / raw if raw > 0 else 0.0
    return [
        Criterion(
            "Does it make ranges better?",
            f"typical error at least {100 * LEAST_GAIN:.0f} % smaller than raw",
            f"from {100 * raw:.1f} to {100 * full:.1f} cm ({-100 * less:+.0f} %); half of the errors are smaller",
            graded(less >= LEAST_GAIN, less >= 0),
            f"the typical error goes from {100 * raw:.1f} to {100 * full:.1f} cm",
        )
    ]


def _bias(judged: Judged) -> list[Criterion]:
    worst = max(
        judged.evaluation.pairs.items(),
        key=lambda item: abs(item[1].full.median_m) / max(item[1].full.robust_std_m, 1e-9),
    )
    name, stats = worst[0], worst[1].full
    ratio = abs(stats.median_m) / max(stats.robust_std_m, 1e-9)
    return [
        Criterion(
            "Is no pair left with a bias?",
            f"median of each pair within {MOST_BIAS:g} of its spread",
            f"worst: {name} with {100 * stats.median_m:+.1f} cm, {ratio:.2f} of its spread of "
            f"{100 * stats.robust_std_m:.1f} cm",
            graded(ratio <= MOST_BIAS, ratio <= WORST_BIAS),
            f"no pair keeps a bias beyond {100 * abs(stats.median_m):.1f} cm"
            if ratio <= MOST_BIAS
            else f"pair {name} keeps a bias of {100 * stats.median_m:+.1f} cm",
        )
    ]


def _interval(judged: Judged) -> list[Criterion]:
    overall = judged.evaluation.overall
    known = bool(np.isfinite(overall.inside_95))
    share = overall.inside_95 if known else overall.coverage["95"]
    of_what = "reflections included" if known else "by sigma alone; the calibration does not describe reflections"
    low, high = INTERVAL
    return [
        Criterion(
            "Does it say rightly how far ranges can be off?",
            f"{100 * low:.0f} to {100 * high:.1f} % of errors within their 95 % intervals",
            f"{100 * share:.1f} % ({of_what})",
            graded(low <= share <= high, share >= INTERVAL_LEAST),
            f"{100 * share:.0f} % of the errors lie within their 95 % intervals",
        )
    ]


def settled(known: Calibration) -> list[Criterion]:
    """Return whether the antenna delays of a calibration are known well enough; nothing where pairs have constants."""
    if known.pair_offsets:
        return []
    free = known.provenance.get("undetermined", [])
    half = {t: TWO_SIDED_95 * known.delays_std_ns.get(t, float("nan")) for t in known.delays_ns}
    measured = {tag: h for tag, h in half.items() if np.isfinite(h)}
    asked = f"95 % interval of each within ± {MOST_DELAY_NS:g} ns (3 cm)"
    question = "Are the antenna delays known well enough?"
    if free:
        groups = "; ".join(", ".join(map(str, group)) for group in free)
        trace = f"the delays of tags {groups} can shift against each other without a trace in any range"
        told = str(known.provenance.get("left_open", trace))
        return [Criterion(question, asked, told, BAD, told)]
    if not measured:
        return [Criterion(question, asked, "the calibration states no intervals", DOUBT, "delays have no intervals")]
    tag = max(measured, key=lambda t: measured[t])
    fine = measured[tag] <= MOST_DELAY_NS
    return [
        Criterion(
            question,
            asked,
            f"widest: tag {tag}, ± {measured[tag]:.3f} ns",
            graded(fine, measured[tag] <= 3 * MOST_DELAY_NS),
            f"delays are known to ± {measured[tag]:.3f} ns or better"
            if fine
            else f"the delay of tag {tag} is known to ± {measured[tag]:.2f} ns only",
        )
    ]


def _powers(judged: Judged) -> list[Criterion]:
    share = judged.evaluation.overall.clamped
    return [
        Criterion(
            "Was the curve fitted at such powers?",
            f"at most {100 * MOST_CLAMPED:.0f} % of the ranges beyond them",
            f"{100 * share:.1f} % beyond",
            graded(share <= MOST_CLAMPED, share <= WORST_CLAMPED),
            f"{100 * share:.1f} % of the ranges have powers that the fit has not seen",
        )
    ]


def _positions(judged: Judged) -> list[Criterion]:
    if not judged.tracks:
        return []
    raw, best = (float(np.mean([one.rmse_m[name].mean() for one in judged.tracks])) for name in ("raw", "variance"))
    return [
        Criterion(
            "Do positions become better?",
            "RMSE of the position not larger than with raw ranges",
            f"from {raw:.3f} to {best:.3f} m over {len(judged.tracks)} tracks",
            graded(best < raw, False),
            f"positions go from {100 * raw:.0f} to {100 * best:.0f} cm RMSE",
        )
    ]


def _doubts(judged: Judged) -> list[Criterion]:
    count = len(judged.warnings) + len(judged.faults)
    names = "; ".join([*judged.warnings, *judged.faults])
    return [
        Criterion(
            "Is there nothing to warn of?",
            "no warning of the fit, no fault in a recording",
            names or "nothing",
            GOOD if not count else DOUBT,
            "nothing to warn of was found" if not count else f"{count} warning{'s' * (count > 1)}, below",
        )
    ]


CRITERIA: Final[tuple[Callable[[Judged], list[Criterion]], ...]] = (
    _held_out,
    _gain,
    _bias,
    _interval,
    lambda judged: settled(judged.calibration),
    _powers,
    _positions,
    lambda judged: criteria(judged.calibration),
    _doubts,
)
"""What makes a calibration fit for use, in the order in which it is told."""
