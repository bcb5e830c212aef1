"""The verdict on a calibration: criteria with thresholds and results, and a summary.

Thresholds without a comment are judgements.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from scipy.special import stdtrit
from scipy.stats import binomtest

from calib.calibration.document import pair_name, reading_provenance, split_text
from calib.calibration.model import known_facts
from calib.estimator.range_model import METRES_A_NS
from calib.evaluation.statistics import Stats
from calib.findings import contradictions_in
from calib.report.results import Results
from calib.spread import STD_OF_MEDIAN, TWO_SIDED_95
from uwblink.pages.blocks import Block, Table, Text

GOOD, DOUBT, BAD = "good", "doubt", "bad"

MOST_NS: Final = 0.1
"""Largest half interval of a delay, 3 cm of range: delays of DW1000 boards of one kind differ by as much."""


class Criterion(NamedTuple):
    """A question, the requirement, the result, its grade (good, doubt, bad), and a clause for the summary."""

    question: str
    required: str
    found: str
    grade: str
    summary: str


def verdict(results: Results) -> list[Block]:
    """Return a summary of all criteria, and their table."""
    found = list(criteria(results))
    bad, doubt, good = ("; ".join(one.summary for one in found if one.grade == grade) for grade in (BAD, DOUBT, GOOD))
    also = f" Also: {doubt}." if doubt else ""
    sentences = (
        (bad, BAD, f"Not fit for use. {capitalized(bad)}.{also}"),
        (doubt, DOUBT, f"Fit for use, with reservations. {capitalized(doubt)}."),
        (True, GOOD, f"Fit for use. All {len(found)} criteria are met: {good}."),
    )
    kind, text = next((kind, text) for applies, kind, text in sentences if applies)
    marks = {GOOD: "✓ yes", DOUBT: "! in part", BAD: "✗ no"}
    rows = [[one.question, marks[one.grade], one.found, one.required] for one in found]
    return [Text(text, kind), Table(["criterion", "met", "found", "required"], rows, words=True)]


def capitalized(text: str) -> str:
    """Return a text with its first letter in upper case."""
    return text[:1].upper() + text[1:]


def criteria(results: Results) -> Iterator[Criterion]:
    """Yield the criteria that apply to a calibration and its recordings."""
    made = results.calibration.provenance
    if results.recordings:
        yield _held_out(results)
        yield _gain(results)
        yield _bias(results)
        yield _interval(results)
    elif not made.get("converged", True):
        yield Criterion("Did the search converge?", "yes", "no", BAD, "the search stopped before it converged")
    if not results.calibration.pair_offsets:
        yield _settled(results)
    if results.recordings:
        yield from _of_uses(results)
    if made.get("recipe") == "survey":
        with reading_provenance():
            found = list(_of_survey(results))
        yield from found
    elif known_facts(made) and isinstance(std_m := made.get("distance_std_m"), int | float):
        yield _distances(std_m)
    if results.recordings:
        yield _warned(results)


def _graded(good: bool, tolerable: bool) -> str:
    return GOOD if good else DOUBT if tolerable else BAD


def _of_uses(results: Results) -> Iterator[Criterion]:
    """Yield the criteria on powers outside the fitted ones, and on position errors."""
    most, share = 0.05, results.evaluation.overall.clamped
    yield Criterion(
        "Are the powers of the recordings within the fitted powers?",
        f"at most {100 * most:.0f} % of the ranges outside",
        f"{100 * share:.1f} % outside",
        _graded(share <= most, share <= 0.25),
        f"{100 * share:.1f} % of the ranges have powers outside the fitted ones",
    )
    if results.tracks:
        raw, best = (np.mean([one.rmse_m[name].mean() for one in results.tracks]) for name in ("raw", "variance"))
        yield Criterion(
            "Do position errors decrease?",
            "RMSE of the position not larger than with raw ranges",
            f"from {raw:.3f} to {best:.3f} m over {len(results.tracks)} track{'s' * (len(results.tracks) > 1)}",
            _graded(bool(best < raw), False),
            f"the RMSE of positions changes from {100 * raw:.0f} to {100 * best:.0f} cm",
        )


def _held_out(results: Results) -> Criterion:
    judged = results.judged
    found = f"{judged.source}: {len(judged)} ranges"
    summary = "it was evaluated on other recordings than the fitted ones"
    if results.part is not None:
        share = len(judged) / (len(judged) + int(results.part.provenance["exchanges"]))
        found = f"in part: a second fit was evaluated on {100 * share:.0f} % of the same recordings, held out from it"
        summary = "it was evaluated on held-out parts of the fitted recordings, not on another recording"
    elif not results.held_out:
        found = "no: on the fitted recordings"
        summary = "it was evaluated only on the fitted recordings, so the following results are too optimistic"
    return Criterion(
        "Was it evaluated on other recordings than the fitted ones?",
        "yes",
        found,
        _graded(results.held_out, True),
        summary,
    )


def _gain(results: Results) -> Criterion:
    least = 0.05  # share of the median absolute error that a useful calibration removes at least
    truth, corrected = results.judged.truth_m, results.corrected
    raw, full = (float(np.median(np.abs(range_m - truth))) for range_m in (corrected.raw_m, corrected.corrected_m))
    less = 1 - full / raw if raw > 0 else 0.0
    return Criterion(
        "Do range errors decrease?",
        f"median absolute error at least {100 * least:.0f} % smaller than raw",
        f"from {100 * raw:.1f} to {100 * full:.1f} cm ({-100 * less:+.0f} %), median absolute error",
        _graded(less >= least, less >= 0),
        f"the median absolute error changes from {100 * raw:.1f} to {100 * full:.1f} cm",
    )


def _bias(results: Results) -> Criterion:
    most = 0.5  # of the spread of one range: a bias of this size increases the rms error by an eighth, sqrt(1 + 0.5^2)
    pairs = {name: group.full for name, group in results.evaluation.pairs.items()}
    # The significant part of the bias: the median error of few ranges is uncertain.
    ratios = {
        name: max(abs(full.median_m) - _median_bound_m(full, len(pairs)), 0.0) / max(full.robust_std_m, 1e-9)
        for name, full in pairs.items()
    }
    name = max(ratios, key=lambda pair: ratios[pair])
    full, ratio = pairs[name], ratios[name]
    return Criterion(
        "Are all pairs free of bias?",
        f"median error of each pair, minus its bound by chance, within {most:g} of its spread",
        f"worst: {name} with {100 * full.median_m:+.1f} cm of {full.n} ranges; above its bound by chance {ratio:.2f} "
        f"of its spread of {100 * full.robust_std_m:.1f} cm",
        _graded(ratio <= most, ratio <= 1.0),
        f"no pair has a significant bias above {most:g} of its spread"
        if ratio <= most
        else f"pair {name} has a remaining bias of {100 * full.median_m:+.1f} cm",
    )


def _median_bound_m(stats: Stats, pairs: int) -> float:
    """Return the bound of the median error of an unbiased pair in metres, by Student's t.

    The medians of all pairs are within their bounds except with a probability of 1 % (Bonferroni).
    """
    if stats.n < 2:
        return math.inf
    return float(STD_OF_MEDIAN * stats.robust_std_m / math.sqrt(stats.n) * stdtrit(stats.n - 1, 1 - 0.005 / pairs))


def _interval(results: Results) -> Criterion:
    overall = results.evaluation.overall
    known = bool(np.isfinite(overall.inside_95))
    share = overall.inside_95 if known else overall.coverage["95"]
    of_what = "reflections included" if known else "by sigma only; the calibration has no error model"
    low, high = 0.90, 0.985  # below, a filter gives ranges too much weight; above, too little
    # 99 % interval of the share for independent ranges (Wilson 1927).
    count = overall.full.n
    least, most = map(float, binomtest(round(share * count), count).proportion_ci(0.99, "wilson"))
    return Criterion(
        "Are the stated errors of ranges right?",
        f"{100 * low:.0f} to {100 * high:.1f} % of errors within their 95 % intervals",
        f"{100 * share:.1f} % ({of_what})",
        _graded(low <= most and least <= high, most >= 0.80),
        f"{100 * share:.0f} % of the errors lie within their 95 % intervals",
    )


def _settled(results: Results) -> Criterion:
    known = results.calibration
    head = ("Are the antenna delays known well enough?", f"95 % interval of each within ± {MOST_NS:g} ns (3 cm)")
    if known.provenance.get("undetermined"):
        return Criterion(*head, undetermined_delays(results), BAD, undetermined_delays(results))
    half = {f"tag {t}": TWO_SIDED_95 * std for t, std in known.delays_std_ns.items() if np.isfinite(std)}
    if known.undetermined_splits:
        of_pairs = {pair_name(pair): one.std_m for pair, one in known.pair_constants.items()}
        half |= {f"pair {name}": TWO_SIDED_95 * std / METRES_A_NS for name, std in of_pairs.items() if np.isfinite(std)}
    if not half:
        return Criterion(*head, "the calibration states no intervals", DOUBT, "delays have no intervals")
    widest = max(half, key=lambda name: half[name])
    summary = (
        f"the delay of {widest} is only known to ± {half[widest]:.2f} ns"
        if half[widest] > MOST_NS
        else f"delays are known to ± {half[widest]:.3f} ns or better"
    )
    grade = _graded(half[widest] <= MOST_NS, half[widest] <= 3 * MOST_NS)
    return Criterion(*head, f"widest: {widest}, ± {half[widest]:.3f} ns", grade, summary)


@reading_provenance()
def undetermined_delays(results: Results) -> str:
    """Return a text on the delays that the pairs do not determine, "" without any."""
    made, splits = results.calibration.provenance, results.calibration.undetermined_splits
    if splits and "undetermined_text" not in made:
        return split_text(splits)
    groups = "; ".join(", ".join(map(str, group)) for group in made.get("undetermined", []))
    return str(made.get("undetermined_text", f"the delays of tags {groups} are not determined" if groups else ""))


def _warned(results: Results) -> Criterion:
    found = [*results.warnings, *(f"{name}: {finding.fault}" for name, finding in results.findings)]
    return Criterion(
        "Are there no warnings?",
        "no warning of the fit, no fault in a recording",
        "; ".join(found) or "nothing",
        _graded(not found, True),
        f"{len(found)} warning{'s' * (len(found) > 1)}, below" if found else "there are no warnings",
    )


def _of_survey(results: Results) -> Iterator[Criterion]:
    """Yield the criteria for surveys of boards that stand still."""
    made = results.calibration.provenance
    geometry, pairs = made["geometry"], int(made["pairs"])
    against = contradictions_in(made)
    yield Criterion(
        "Do the ranges agree with the known facts?",
        "no contradiction to known shapes, distances, orders and labels; no board was moved",
        "; ".join(against) or "they do",
        _graded(not against, False),
        f"{len(against)} contradiction{'s' * (len(against) > 1)} to the known facts"
        if against
        else "nothing contradicts",
    )
    # With few degrees of freedom, wrong ranges are not detected, and the spread of errors is hardly determined.
    freedom, least = float(geometry["freedom"]), 10.0
    yield Criterion(
        "Do the arrangements check each other?",
        f"at least {least:g} more mean ranges of pairs than unknowns",
        f"{freedom:.0f} more, of {pairs} in total",
        _graded(freedom >= least, freedom >= 4.0),
        f"{freedom:.0f} of {pairs} mean ranges of pairs are redundant",
    )
    error, most_m = float(geometry["pair_error_m"]), 0.03
    yield Criterion(
        "Are the constant errors of pairs small enough?",
        f"at most {100 * most_m:g} cm, without reflections",
        f"{100 * error:.1f} cm",
        _graded(error <= most_m, error <= 2 * most_m),
        f"a pair has a constant error of {100 * error:.1f} cm in an arrangement",
    )
    # If more pairs are reflected, positions of boards absorb a part of the detours.
    count, most = sum(float(row["chance"]) for row in made.get("reflected", [])), 0.05
    share = count / max(pairs, 1)
    yield Criterion(
        "Are few pairs reflected?",
        f"at most {100 * most:g} % of them",
        f"{count:.1f} of {pairs} ({100 * share:.0f} %)",
        _graded(share <= most, share <= 0.2),
        f"{100 * share:.0f} % of the pairs are probably reflected",
    )
    # -2 log likelihood is 9 at three standard deviations of one unknown.
    second, clear = made.get("second_best"), 9.0
    worse = math.inf if second is None else float(second)
    yield Criterion(
        "Is there no other solution?",
        f"the second-best worse by at least {clear:g} in -2 log likelihood: three standard deviations",
        f"{worse:.0f} worse" if math.isfinite(worse) else "none was found",
        _graded(worse >= clear, True),
        "no other positions of the boards agree with the ranges"
        if worse >= clear
        else "other positions of the boards agree with the ranges as well",
    )
    known = results.calibration.uncertainty
    if known is not None and known.tags:
        half = TWO_SIDED_95 * math.sqrt(max(float(np.mean(np.array(known.delays_ns2))), 0.0))
        yield Criterion(
            "Is the common part of all delays known?",
            f"95 % interval of their mean within ± {MOST_NS:g} ns; a measured distance or a known delay determines it",
            f"± {half:.3f} ns",
            _graded(half <= MOST_NS, half <= 3 * MOST_NS),
            f"the common part of all delays is known to ± {half:.2f} ns",
        )


def _distances(std_m: float) -> Criterion:
    """Return the criterion for distances that were estimated together with the delays."""
    most_m = 0.02
    return Criterion(
        "Are the estimated distances known well enough?",
        f"standard error at most {100 * most_m:g} cm",
        f"{100 * std_m:.1f} cm",
        _graded(std_m <= most_m, std_m <= 0.05),
        f"distances were estimated to {100 * std_m:.1f} cm",
    )
