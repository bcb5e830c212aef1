"""The sections of a report: a table of functions from results to blocks, and the reports that are made of them.

A section returns its blocks, heading included, and nothing where there is nothing to tell. One more section is one
function and one row of `SECTIONS`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from math import isfinite, sqrt
from pathlib import Path
from typing import Any, Final

import numpy as np

from calib import figures
from calib.calibration.comparison import Comparison
from calib.calibration.model import Calibration, curve_rows, require_calibration, rests_on
from calib.calibration.model import pair_rows as offset_rows
from calib.data.sources import Data, each, load_each
from calib.error_mixture import fit_error_mixtures
from calib.errors import BadInputError
from calib.evaluation.localization import PAPER_RMSE_M, Localization, summarize
from calib.evaluation.onboard import OnboardTrack
from calib.evaluation.statistics import CORRECTION_STAGES, ErrorStatistics, Evaluation, pair_rows
from calib.evaluation.tracking import Settings
from calib.report.figures import FILTER_NAMES, onboard, rmse_bars, track
from calib.report.results import Origin, Results, check_places, origin_of
from calib.report.verdict import left_open, verdict
from calib.spread import TWO_SIDED_95
from calib.surveys.surveyed import SurveyedArrangement
from uwblink.pages.blocks import Block, Document, Heading, Listing, Picture, Table, Text, to_html, write_document

Section = Callable[[Results], list[Block]]
"""Returns what stands in a section, its heading included; nothing where there is nothing to tell."""

TITLE: Final = "Calibration of ultra-wideband ranges"


def _verdict(results: Results) -> list[Block]:
    if results.recordings:
        lead = _summary(results)
    else:
        lead = (
            "Nothing of this was held against a true distance. Where a recording has them, evaluate the calibration "
            "on it: the report of that evaluation has this section, too."
        )
    return [*verdict(results), Text(lead, "lead")]


def _summary(results: Results) -> str:
    """Return what the whole comes to, in a few sentences."""
    group, where = results.evaluation.overall, ""
    if results.fit is not None:
        where = " of the tests" if results.tests else " of the recordings it was fitted from"
    cm = {stage: (100 * getattr(group, stage).mean_m, 100 * getattr(group, stage).std_m) for stage in CORRECTION_STAGES}
    return (
        f"Over {group.raw.n} ranges{where} the mean error goes from {cm['raw'][0]:+.1f} cm (raw) to "
        f"{cm['delays'][0]:+.1f} cm (delays corrected) and {cm['full'][0]:+.1f} cm (fully corrected); the standard "
        f"deviation from {cm['raw'][1]:.1f} to {cm['full'][1]:.1f} cm, its robust estimate from "
        f"{100 * group.raw.robust_std_m:.1f} to {100 * group.full.robust_std_m:.1f} cm. "
        f"{100 * (1 - group.rejected):.1f} % of the corrected ranges are as near as noise alone explains (95 % would "
        f"be without reflections), with a mean of {100 * group.accepted.mean_m:+.1f} cm and a standard deviation of "
        f"{100 * group.accepted.std_m:.1f} cm; the other {100 * group.rejected:.1f} % are mostly reflected ones, which "
        "no calibration shortens and a filter's gate leaves out."
    )


def _warnings(results: Results) -> list[Block]:
    told = list(map(str, results.warnings))
    if results.fit is not None and not results.tests:
        told.append("no tests were given: the figures below are of the recordings that the fit has seen")
    for name, finding in results.findings:
        evidence, remedy = (text[:1].upper() + text[1:] for text in (finding.evidence, finding.remedy))
        told.append(f"{name}: {finding.fault}. {evidence}. {remedy}.")
    return [Text(f"Warning: {sentence}", "warning") for sentence in told]


def _recordings(results: Results) -> list[Block]:
    """Return one row a recording, with the beginning of the SHA-256 of its file."""
    if not results.recordings:
        return []
    digests = {Path(path).name: digest[:12] for path, digest in results.origin.files.items()}
    uses = [("fit", r) for r in results.training] + [("test", r) for r in results.tests]
    header = ["recording", "used to", "ranges", "seconds", "tags", "pairs", "protocol", "left out", "SHA-256"]
    rows = [
        [
            r.source,
            use,
            str(len(r)),
            f"{(r.time_ns.max() - r.time_ns.min()) * 1e-9:.0f}",
            ", ".join(map(str, r.tags())),
            str(len(pair_rows(r))),
            ", ".join(sorted(set(np.unique(r.protocol).tolist()))),
            ", ".join(f"{n} {why}" for why, n in r.excluded.items()) or "none",
            digests.get(r.source, "in memory"),
        ]
        for use, r in uses
    ]
    return [Heading("What was recorded"), Table(header, rows)]


def _foundations(results: Results) -> list[Block]:
    """Return what stands in the place of known distances; nothing where distances were known."""
    made = results.calibration.provenance
    if made.get("recipe") == "survey":
        return [Heading("What it rests on"), *_of_survey(made)]
    told = rests_on(made)
    if not told:
        return []
    rests = made["rests_on"]

    def names(key: str) -> str:
        return ", ".join(map(str, rests.get(key) or [])) or "none"

    rows = [
        ["moving bodies", names("moving")],
        ["positions known for", f"{float(rests.get('known_s', 0.0)):.1f} s"],
        ["anchors at given places", names("anchors_given")],
        ["anchors whose places were found", names("anchors_sought")],
        ["attitudes from", str(rests.get("attitudes", "nowhere"))],
        ["distances by tape", str(rests.get("distances", 0))],
        ["heights of", names("heights")],
    ]
    off = made.get("distance_std_m")
    if isinstance(off, int | float):
        rows.append(["distances found to (standard error)", f"{100 * off:.1f} cm"])
    if made.get("left_open"):
        rows.append(["left open", str(made["left_open"])])
    return [
        Heading("What it rests on"),
        Text(f"No true distance was known: {told}. Trajectories were found together with the delays."),
        Table(["what", "of this calibration"], [row for row in rows if row[1]], words=True),
    ]


def _of_survey(made: Any) -> list[Block]:
    def counted(count: int, what: str) -> str:
        return f"{count or 'no'} {what}{'s' * (count != 1)}"

    rests = made["rests_on"]
    beside = [
        counted(int(rests.get("known_distances", 0)), "known distance"),
        counted(int(rests.get("known_positions", 0)), "known position"),
        counted(len(made.get("fixed_ns", {})), "known delay"),
    ]
    blocks: list[Block] = [
        Text(
            f"No true distance was known. {counted(int(made['pairs']), 'mean range')} of pairs in "
            f"{counted(len(rests['arrangements']), 'arrangement')} of boards that stood still must fit together in "
            f"space, with {', '.join(beside)}. A pair has a constant error of {100 * float(rests['pair_error_m']):.1f} "
            f"cm in an arrangement; {float(rests['freedom']):.0f} degrees of freedom are left."
        )
    ]
    surveyed = [SurveyedArrangement.from_dict(row) for row in made.get("surveyed", [])]
    if not surveyed:
        return blocks
    rows = []
    for one in surveyed:
        known = [board for board in one.boards if board.determined]
        far = [TWO_SIDED_95 * sqrt(max(float(board.covariance_m2.trace()), 0.0)) for board in known]
        within = f"± {100 * max(far):.1f} cm" if far else "undetermined"
        tags = ", ".join(str(board.tag) for board in one.boards)
        rows.append([one.name, tags, one.known or "nothing", within, one.frame])

    def draw(width_in: float) -> Any:
        from calib.surveys.figures import board_figure

        return board_figure(surveyed, width_in)

    caption = (
        "Where boards stood, from above, with ellipses that hold them with 95 %; ten times as large and dashed where "
        "they would not be seen."
    )
    header = ["arrangement", "boards", "said to be", "places within (95 %)", "frame"]
    blocks += [Table(header, rows, words=True), Picture("places", draw, caption)]
    reflected = []
    for row in made.get("reflected", []):
        pair, longer_cm = "-".join(map(str, row["between"])), 100 * row["longer_m"]
        reflected.append([row["arrangement"], pair, f"{longer_cm:+.0f}", f"{100 * row['chance']:.0f} %"])
    if reflected:
        blocks += [
            Text("Pairs that are, or may be, longer by a reflection; they count for less by as much:"),
            Table(["arrangement", "pair", "longer by (cm)", "probability"], reflected),
        ]
    return blocks


def _determined(results: Results) -> list[Block]:
    """Say whether the pairs settle the delays, and what the fit assumed."""
    if results.fit is None:
        return []
    calibration, pairs = results.calibration, pair_rows(results.trained)
    if calibration.provenance.get("undetermined"):
        answer = f"No: {left_open(results)}."
    else:
        answer = f"Yes: the {len(pairs)} pairs of {len(results.trained.tags())} tags settle every delay."
    counts = [int(np.count_nonzero(rows)) for rows in pairs.values()]
    changed = calibration.provenance.get("settings", {})
    settings = f" Settings: {', '.join(f'{name} = {value}' for name, value in changed.items())}." if changed else ""
    return [
        Heading("Is it determined?"),
        Text(
            f"{answer} The rarest pair has {min(counts)} ranges, the most frequent {max(counts)}. The fit "
            f"{results.fit.message}, with the {calibration.loss} loss at a scale of {calibration.scale_ns:.3f} ns; its "
            f"standard errors are a {calibration.provenance.get('standard_errors', 'sandwich')}, so errors that "
            "persist within a block are not counted as independent ones." + settings
        ),
        Text(
            "How a delay splits into transmission and reception is not determined: stamps of free-running clocks leave "
            "it open, overheard exchanges included, because shifting a tag's clock shifts both. Where both are needed, "
            "0.44 of a delay goes to transmission and 0.56 to reception by convention."
        ),
    ]


def _delays(results: Results) -> list[Block]:
    """Return delays with intervals; beside them what was planted, and what listeners heard."""
    calibration, heard = results.calibration, results.heard
    if calibration.pair_offsets:
        rows = [list(row) for row in offset_rows(calibration)]
        table = Table(["pair", "ranges too long by (cm)", "95 %"], rows)
        return [Heading("Antenna delays"), table, *_sensitivity(results)]
    planted = results.evaluation.planted if results.recordings else None
    truth: dict[str, Any] = (results.trained.planted or {}).get("delays_ns", {}) if planted else {}
    known = {int(tag): float(delay) for tag, delay in truth.items()}
    shift = planted.shift_ns if planted else 0.0
    header = ["tag", "delay (ns)", "95 % from", "to"]
    header += ["planted, same gauge (ns)", "difference (ps)"] if known else []
    header += ["heard by others (ns)", "± 1 std"] if heard else []
    rows = []
    for tag, delay in sorted(calibration.delays_ns.items()):
        half = TWO_SIDED_95 * calibration.delays_std_ns.get(tag, float("nan"))
        unknown = ["not stated" if np.isnan(half) else "undetermined", ""]
        row = [str(tag), f"{delay:+.4f}"]
        row += [f"{delay - half:+.4f}", f"{delay + half:+.4f}"] if isfinite(half) else unknown
        if known and planted:
            beside = (known.get(tag, 0.0) + shift, 1e3 * planted.delay_error_ns.get(tag, 0.0))
            row += [f"{beside[0]:+.4f}", f"{beside[1]:+.1f}"] if tag in known else ["", ""]
        if heard:
            row += [f"{heard[tag].delay_ns:+.4f}", f"{heard[tag].std_ns:.4f}"] if tag in heard else ["", ""]
        rows.append(row)
    caption = "Antenna delays with their 95 % intervals" + (
        ", and what was planted, in the same gauge." if known else "."
    )
    draw = partial(figures.alone, partial(figures.delays, calibration, known, shift))
    blocks: list[Block] = [Heading("Antenna delays"), Table(header, rows), Picture("delays", draw, caption)]
    if planted:
        blocks.append(
            Text(
                "A constant in the bias curve and a shift common to all delays are the same thing: planted delays, and "
                f"the planted curve below, are shown after moving the common {shift:+.4f} ns from the curve to the "
                f"delays. The bias curve is {1e3 * planted.curve_rms_m:.1f} mm rms from the planted one over these "
                f"ranges, the whole correction of a range {1e3 * planted.correction_rms_m:.1f} mm.",
                "note",
            )
        )
    return [*blocks, *_sensitivity(results)]


def _sensitivity(results: Results) -> list[Block]:
    if not results.refits:
        return []
    draw = partial(
        figures.scale_sensitivity,
        scales_ns=list(results.refits),
        fits=list(results.refits.values()),
        chosen_ns=results.calibration.scale_ns,
    )
    caption = "What another scale of the loss would have done to the delays, mean removed."
    return [Picture("scale-sensitivity", draw, caption)]


def _curves(results: Results) -> list[Block]:
    """Return the curves over power: with bands and data, or without any recording as a table."""
    calibration = results.calibration
    if not results.recordings:
        power, *curves = curve_rows(calibration)
        return [Heading("Bias and spread over power"), Table(list(power), [list(row) for row in curves])]
    if calibration.loss == "l2":
        follows = "The curve follows the mean of the errors, as least squares do; points are means, bin by bin."
    else:
        follows = (
            "The curve follows the core of the errors: noise, without reflections, which can only lengthen a range. "
            "Points are the centre of that core (below: its spread), told from the tail bin by bin, without the curve. "
            "Medians are drawn, too, and lie above: with a share s of reflected ranges about the quantile "
            "0.5 / (1 − s) of the core."
        )
    mean_of_lifted = "the mean over both ends." if calibration.lift == "mean-of-lifted" else ""
    lifted = (
        "Lifted power is the first-path power p on a scale that stretches where ranges are good and the bias "
        f"changes: ψ = 10^((p − α) / 10 dB) with α = {calibration.alpha_dbm:g} dBm, so ψ = 1 at α and a tenth of "
        f"it 10 dB lower; of an exchange, {mean_of_lifted or 'that of the mean power of both ends.'} Powers in dBm "
        "stand above the figures."
    )
    known = (results.trained, calibration.apply(results.trained), calibration)
    # Binned once for both widths.
    bias, sigma = (cache(partial(figures.over_power, *known, which)) for which in ("bias", "sigma"))
    return [
        Heading("Bias and standard deviation over power"),
        Text(follows, "note"),
        Text(lifted, "note"),
        Picture(
            "bias",
            lambda width: figures.alone(partial(figures.bias_over_power, *known, found=bias()), width),
            "Bias over power: what the delay-corrected errors centre on, and the curve with its 95 % band.",
        ),
        Picture(
            "sigma",
            lambda width: figures.alone(partial(figures.sigma_over_power, *known, found=sigma()), width),
            "Standard deviation over power: that of the calibrated errors' noise, and the curve with its 95 % band.",
        ),
    ]


def _before_after(results: Results) -> list[Block]:
    """Return errors by pair and stage, how well sigma covers them, and their figures."""
    if not results.recordings:
        return []
    evaluation, overall = results.evaluation, results.evaluation.overall
    groups = [*evaluation.pairs.items(), ("all", overall)]
    header = ["pair", "n", *["mean", "std", "robust"] * len(CORRECTION_STAGES), "95 % |e|", "noise", "in 95 %", "new p"]
    above = [("", 2), *[(stage, 3) for stage in CORRECTION_STAGES], ("full", 3), ("", 1)]
    levels = list(overall.coverage)
    covered = [[name, *(f"{100 * group.coverage[level]:.0f} %" for level in levels)] for name, group in groups]
    low, high = 100 * overall.full.low_m, 100 * overall.full.high_m
    known: dict[str, Any] = {"ranges": results.judged, "applied": results.corrected}
    return [
        Heading("Before and after"),
        Table(header, [[name, *_error_cells(group)] for name, group in groups], above, total=True),
        Text(
            "Errors in cm. Robust is 1.4826 median absolute deviations; 95 % |e| is what 95 % of the calibrated errors "
            f"stay below in size (95 % of all lie between {low:+.1f} and {high:+.1f} cm). Noise: share of corrected "
            "ranges that their own sigma explains at 95 %, 95 % without reflections; the rest are mostly reflected. In "
            "95 %: share within the 95 % intervals that reckon with reflections. New p: share at powers the curves "
            "were not fitted at.",
            "note",
        ),
        Table(["pair", *[f"{level} %" for level in levels]], covered, [("", 1), ("nominal", len(levels))], total=True),
        Text(
            "Coverage: how many calibrated errors lie within the bounds that their sigma gives for a normal "
            "distribution. Reflections take from the high levels.",
            "note",
        ),
        Picture(
            "errors",
            partial(figures.distribution, **known),
            "Range errors: how many of which size and sign (the outermost bins hold everything beyond them), and how "
            "many are smaller than so much.",
        ),
        Picture(
            "z-scores",
            partial(figures.z_scores, **known),
            "Calibrated errors over their sigma: density, and quantiles against those of the standard normal.",
        ),
        Picture(
            "residuals",
            partial(figures.residuals, **known, alpha_dbm=results.calibration.alpha_dbm),
            "What is left over distance and over power, reflections included: they lift the medians off zero, the more "
            "of them the higher; a slope or a wave would be a bias that is left. A hundredth of the points is beyond.",
        ),
    ]


def _error_cells(group: ErrorStatistics) -> list[str]:
    cells = [str(group.raw.n)]
    for stage in CORRECTION_STAGES:
        stats = getattr(group, stage)
        cells += [f"{100 * v:.1f}" for v in (stats.mean_m, stats.std_m, stats.robust_std_m)]
    shares = ["–" if v != v else f"{100 * v:.1f} %" for v in (1 - group.rejected, group.inside_95, group.clamped)]
    return [*cells, f"{100 * group.full.abs95_m:.1f}", *shares]


def _outliers(results: Results) -> list[Block]:
    """Say what the calibrated errors are made of, by pair."""
    if not results.recordings:
        return []
    ranges, applied, rows = results.judged, results.corrected, []
    error = applied.corrected_m - ranges.truth_m
    z = error / applied.sigma_m
    groups = {**pair_rows(ranges), "all": np.ones(len(ranges), dtype=bool)}
    told = {name: mine for name, mine in groups.items() if np.count_nonzero(mine) >= figures.FEWEST_IN_BIN}
    mixtures = fit_error_mixtures([error[mine] for mine in told.values()])
    for (name, mine), mixture in zip(told.items(), mixtures, strict=True):
        rows.append(
            [
                name,
                f"{100 * np.mean(z[mine] > 3):.1f} %",
                f"{100 * np.mean(z[mine] < -3):.1f} %",
                f"{100 * mixture.sigma_m[0]:.1f}",
                f"{100 * mixture.tail_share:.1f} %",
                f"{100 * mixture.tail_mean_m:.0f}",
                f"{100 * mixture.outlier_share:.2f} %",
            ]
        )
    return [
        Heading("Outliers"),
        Table(["pair", "too long", "too short", "core (cm)", "tail", "its mean (cm)", "outliers"], rows, total=True),
        Text(
            "Too long and too short: share of ranges beyond three sigmas. Core, tail and outliers: a Gaussian, an "
            "exponential detour on the long side, and what fits neither, by maximum likelihood.",
            "note",
        ),
    ]


def _localization(results: Results) -> list[Block]:
    """Return the RMSE by body and filter beside the paper's own, and figures."""
    found, drawn = results.tracks, 12
    if not found:
        return []
    total = summarize(found)
    names = list(total.rmse_m)
    rows = [[f"{one.source} {one.body}", *(f"{one.rmse_m[name].mean():.3f}" for name in names)] for one in found]
    rows.append(["mean", *(f"{total.rmse_m[name]:.3f}" for name in names)])
    rows.append(["its spread over seeds", *(f"{total.spread_m[name]:.3f}" for name in names)])
    rows.append(["against raw", "", *(f"{-100 * less:+.0f} %" for less in total.reduction.values())])
    paper = [f"{PAPER_RMSE_M[name]:.3f}" if name in PAPER_RMSE_M else "" for name in names]
    rows.append(["ICRA 2023, its own flights", *paper])
    (nis_low, nis_high), (nees_low, nees_high) = total.nis_bounds, total.nees_bounds
    if total.nis > nis_high or total.nees > nees_high:
        meaning = (
            "Above their bounds: the filter is surer than it should be, as with reflections, which sigma leaves out."
        )
    elif total.nis < nis_low or total.nees < nees_low:
        meaning = "Below their bounds: the filter is less sure than it could be, as where a gate refuses the tail."
    else:
        meaning = "Both lie within: the filter knows how good it is."
    heads = [FILTER_NAMES[name].removeprefix("calibrated, ") for name in names]
    blocks: list[Block] = [
        Heading("Localization"),
        Table(["body", *heads], rows, [("", 1), ("RMSE (m)", len(names))]),
        Text(_filters(found), "note"),
        Text(
            f"With the calibrated variance the mean NIS is {total.nis:.2f} (1 expected, 95 % bounds {nis_low:.2f} to "
            f"{nis_high:.2f}, {100 * total.nis_inside:.0f} % of the values within their own), the mean NEES "
            f"{total.nees:.2f} (3 expected, {nees_low:.2f} to {nees_high:.2f}, {100 * total.nees_inside:.0f} %); "
            f"{100 * total.accepted:.1f} % of the ranges pass the gate. {meaning}",
            "note",
        ),
        Picture("rmse", partial(rmse_bars, found=found), "RMSE of the position of each body, and the mean."),
    ]
    for one in found[:drawn]:
        caption = (
            f"{one.source}, {one.body}: path from above, height, and position error over time, with three sigmas of "
            "the filter with variance."
        )
        blocks.append(Picture(_track_name(one.source, one.body), partial(track, one=one), caption))
    if len(found) > drawn:
        blocks.append(Text(f"The first {drawn} of {len(found)} tracks are drawn; the table has all.", "note"))
    return blocks


def _filters(found: list[Localization]) -> str:
    """Say how the filters were set up, and how far the paper's own figures may be compared."""
    chosen, fixed = Settings(), found[0].fixed
    own = "these flights are simulated" if all(one.simulated for one in found) else "these are other flights"
    paper = ", ".join(f"{value:.3f}" for value in PAPER_RMSE_M.values())
    return (
        "One body at a time is tracked by an EKF from its ranges to the others, whose positions are known; velocity "
        f"and attitude are inputs from the poses, velocity with white noise of {chosen.velocity_std_mps:g} m/s an axis "
        f"at {chosen.velocity_rate_hz:g} Hz, as a small drone's optical flow has it. How much a calibration gains "
        "depends on that choice: the better velocity is known, the less ranges decide. Fixed standard deviations, "
        f"{fixed.source}: raw {100 * fixed.std_m['raw']:.0f} cm, calibrated {100 * fixed.std_m['calibrated']:.0f} cm. "
        f"ICRA 2023 has {paper} m (raw, calibrated, with variance) for real flights of its own and another filter's "
        f"noise; {own}, so metres do not compare, and percentages only as far as the filters' noise is alike."
    )


def _track_name(source: str, body: str) -> str:
    return "track-" + "".join(c if c.isalnum() else "-" for c in f"{source.removesuffix('.uwb')}-{body}")


def _over_time(results: Results) -> list[Block]:
    """Return a figure a recording of the calibrated errors over time."""
    blocks: list[Block] = [Heading("Over time")] if results.recordings else []
    for k, recording in enumerate(results.recordings):
        pairs, most = len(pair_rows(recording)), figures.MOST_PAIRS
        left_out = (
            f" Of {pairs} pairs the {most} whose errors spread most; others are left out." if pairs > most else ""
        )
        caption = (
            f"{recording.source}: calibrated errors, and lines between which 95 % should lie without reflections."
            f"{left_out}"
        )
        draw = partial(figures.over_time, ranges=recording, applied=results.calibration.apply(recording))
        blocks.append(Picture(f"over-time-{k + 1}", draw, caption))
    return blocks


def _provenance(results: Results) -> list[Block]:
    """Return where a report and its calibration come from."""
    origin, made = results.origin, results.calibration.provenance
    rows = [["report", origin.made], ["version", origin.version], ["command", origin.command]]
    rows = [row for row in [*rows, ["distances", rests_on(made)]] if row[1]]
    rows += [[path, f"SHA-256 {digest}"] for path, digest in origin.files.items()]
    # What sections show as tables and figures is not repeated.
    rest = {key: value for key, value in made.items() if key not in ("surveyed", "reflected")}
    return [Heading("Provenance"), Table(["of", "what"], rows, words=True), Listing(json.dumps(rest, indent=1))]


SECTIONS: Final[dict[str, Section]] = {
    "verdict": _verdict,
    "warnings": _warnings,
    "recordings": _recordings,
    "foundations": _foundations,
    "determined": _determined,
    "delays": _delays,
    "curves": _curves,
    "before and after": _before_after,
    "outliers": _outliers,
    "localization": _localization,
    "over time": _over_time,
    "provenance": _provenance,
}
"""What stands in a report, in order; `register_report_section` adds to it."""


def register_report_section(name: str, section: Section, *, before: str = "provenance") -> None:
    """Add a section to the reports of campaigns and of evaluations, above the one called `before`.

    `section` takes the `Campaign` (of an evaluation, results with as much as is known) and returns blocks
    (`calib.report`: `Heading`, `Text`, `Table`, `Picture`, `Listing`), which appear in the HTML page and in the PDF;
    figures are drawn at the width they are asked for. Raises `BadInputError` for a name that is taken and for a
    `before` that is not there.

    >>> import calib
    >>> from calib.report import Heading, Text
    >>> def weather(campaign):
    ...     return [Heading("Weather"), Text(f"Dry, for all {len(campaign.judged)} ranges.")]
    >>> calib.register_report_section("weather", weather, before="outliers")

    And out again:

    >>> from calib.report.sections import SECTIONS
    >>> del SECTIONS["weather"]
    """
    if name in SECTIONS:
        raise BadInputError(f"a section {name!r} is there already; choose another name", parameter="name")
    if before not in SECTIONS:
        raise BadInputError(f"found {before!r}, allowed: {', '.join(SECTIONS)}", parameter="before")
    if not callable(section):
        raise BadInputError(f"found {section!r}, expected a function of a campaign", parameter="section")

    def of_recordings(results: Results) -> list[Block]:
        return section(results) if results.recordings else []

    rows = list(SECTIONS.items())
    rows.insert(list(SECTIONS).index(before), (name, of_recordings))
    SECTIONS.clear()
    SECTIONS.update(rows)


def document(results: Results, title: str) -> Document:
    """Return a report; raises `BadInputError` where the function of a section returns something else than blocks."""
    blocks: list[Block] = []
    for name, section in SECTIONS.items():
        found: object = section(results)
        if not isinstance(found, list) or not all(isinstance(block, Block) for block in found):
            raise BadInputError(
                f"report section {name!r}: returned {found!r:.60}, expected a list of blocks "
                "(Heading, Text, Table, Picture or Listing)"
            )
        blocks += found
    return Document(title, blocks, results.origin.sentence())


def render(data: Data | Iterable[Data], calibration: Calibration) -> str:
    """Return the report of an evaluation as HTML text; `data` is what `load_ranges` takes."""
    recordings = each(data)
    return to_html(_evaluated(load_each(recordings), calibration, None, origin_of(recordings)))


def write_report(
    path: str | os.PathLike[str] | None,
    data: Data | Iterable[Data],
    calibration: Calibration,
    *,
    figures: str | os.PathLike[str] | None = None,
    evaluation: Evaluation | None = None,
    origin: Origin | None = None,
    force: bool = False,
) -> None:
    """Evaluate a calibration on recordings and write what came out as one HTML file, or as PDF where it ends so.

    `data` is what `load_ranges` takes. `figures` is a folder for the figures at paper size (PDF and SVG); without a
    `path` they are all that is written. An `evaluation` of the same recordings is taken instead of another one, and
    `origin` as what the report says of where it comes from. Raises what `Calibration.apply`, `load_ranges` and
    `check_output` raise; nothing is written then. The report of a whole campaign is `run_campaign(...).write(path)`.

    >>> import calib, pathlib, tempfile
    >>> flight = calib.sample_flight(300)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     page = pathlib.Path(folder) / "report.html"
    ...     calib.write_report(page, flight, calib.fit(flight).calibration)
    ...     "Before and after" in page.read_text()
    True
    """
    require_calibration(calibration)
    output, folder = (None if place is None else Path(place) for place in (path, figures))
    check_places(output, None, folder, force=force)
    recordings = each(data)
    loaded = load_each(recordings, need_power=calibration.needs_power)
    made = _evaluated(loaded, calibration, evaluation, origin or origin_of(recordings))
    write_document(made, output, None, folder, force=force)


def _evaluated(recordings: list[Any], calibration: Calibration, known: Evaluation | None, origin: Origin) -> Document:
    told = list(map(str, calibration.provenance.get("warnings", [])))
    results = Results(calibration=calibration, tests=recordings, evaluated=known, warnings=told, origin=origin)
    return document(results, "Calibration report")


def write_survey_report(
    path: str | os.PathLike[str], calibration: Calibration, *, origin: Origin | None = None, force: bool = False
) -> None:
    """Write what a calibration without known distances rests on and whether it is fit for use, as HTML or .pdf.

    It needs no recording: everything stands in the calibration. Raises what `check_output` raises.
    """
    require_calibration(calibration)
    check_places(Path(path), None, None, force=force)
    told = list(map(str, calibration.provenance.get("warnings", [])))
    results = Results(calibration=calibration, warnings=told, origin=origin or origin_of([]))
    title = "Report of a calibration without motion capture"
    write_document(document(results, title), Path(path), force=force)


def write_track_figures(found: Sequence[Localization], folder: Path, *, force: bool = False) -> None:
    """Write bars of the RMSE and each body's track into a folder, as PDF and SVG at two widths.

    Raises what `check_places` raises.
    """
    tracks = [Picture(_track_name(one.source, one.body), partial(track, one=one), one.body) for one in found]
    _write_figures([Picture("rmse", partial(rmse_bars, found=list(found)), "RMSE"), *tracks], folder, force)


def write_onboard_figures(found: Sequence[OnboardTrack], folder: Path, *, force: bool = False) -> None:
    """Write each body's track by what is on board, likewise."""
    tracks = [Picture(_track_name(one.source, one.body), partial(onboard, one=one), one.body) for one in found]
    _write_figures(tracks, folder, force)


def write_comparison_figures(
    found: Comparison, known: Sequence[Calibration], names: Sequence[str], folder: Path, *, force: bool = False
) -> None:
    """Write the differences of delays and both calibrations' curves, likewise; `names` are what they are called."""
    pictures = [
        Picture("differences", partial(figures.differences, found=found), "Delays"),
        Picture("curves", partial(figures.both_curves, known=known, names=names), "Curves"),
    ]
    _write_figures(pictures, folder, force)


def _write_figures(pictures: Sequence[Block], folder: Path, force: bool) -> None:
    check_places(None, None, folder, force=force)
    write_document(Document("", list(pictures)), None, None, folder, force=force)
