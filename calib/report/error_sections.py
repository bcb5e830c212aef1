"""Sections of a report on errors: over power and direction, by pair and stage, error model, localization, over time."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np

from calib import figures
from calib.calibration.model import curve_rows, pattern_rows
from calib.estimator.grouped_errors import fit_grouped_errors
from calib.evaluation.localization import PAPER_RMSE_M, Localization, nees_row, rmse_rows, summarize
from calib.evaluation.statistics import CORRECTION_STAGES, ErrorStatistics, pair_rows, stage_cells
from calib.evaluation.tracking import Settings
from calib.report.figures import FILTER_STYLES, rmse_bars, track
from calib.report.results import Results
from uwblink.pages.blocks import Block, Heading, Picture, Table, Text
from uwblink.pages.figures import Draw


def curves(results: Results) -> list[Block]:
    """Return figures of the curves over power with bands and data; without a recording, a table of the curves."""
    calibration = results.calibration
    if not results.recordings:
        power, *curves = curve_rows(calibration)
        return [Heading("Bias and spread over power"), Table(list(power), [list(row) for row in curves])]
    follows = (
        "The curve follows the mean of the errors, as least squares do; points are means, bin by bin."
        if calibration.loss == "l2"
        else "The curve is fitted to the core of the errors, that is noise without reflections, which can only "
        "lengthen a range. Points are the centre of the core (below: its spread), estimated bin by bin without the "
        "curve. Medians are also drawn, and lie above: with a share s of reflected ranges about the quantile "
        "0.5 / (1 − s) of the core."
    )
    mean_of_lifted = "the mean over both ends." if calibration.lift == "mean-of-lifted" else ""
    lifted = (
        "Lifted power is the first-path power p on a scale that expands high powers, where the bias changes most: ψ "
        f"= 10^((p − α) / 10 dB) with α = {calibration.alpha_dbm:g} dBm, so ψ = 1 at α and a tenth of "
        f"it 10 dB lower; of an exchange, {mean_of_lifted or 'that of the mean power of both ends.'} Powers in dBm "
        "stand above the figures."
    )
    known = (results.trained, calibration.apply(results.trained), calibration)
    captions = {
        "bias": "Bias over power: the centre of the delay-corrected errors, and the curve with its 95 % band.",
        "sigma": "Standard deviation over power: the noise of the ranges, and the curve with its 95 % band.",
    }
    pictures = [Picture(which, _over_power(known, which), caption) for which, caption in captions.items()]
    return [Heading("Bias and standard deviation over power"), Text(follows, "note"), Text(lifted, "note"), *pictures]


def _over_power(known: tuple[Any, Any, Any], which: Any) -> Draw:
    """Return a function that draws a curve at a width. Errors are binned once for all widths."""
    found = cache(lambda: figures.over_power(*known, which))

    def draw(axes: figures.Axes) -> figures.Axes:
        return figures.curve_over_power(*known, which, axes, found())

    return partial(figures.single_figure, draw)


def patterns(results: Results) -> list[Block]:
    """Return a table and a figure of patterns over direction; nothing if the calibration has none."""
    calibration = results.calibration
    if not calibration.patterns:
        return []
    draw = partial(figures.patterns, calibration=calibration, ranges=results.trained if results.recordings else None)
    caption = (
        "Excess of ranges by direction, relative to the average, in the frame of the body that carries the tag: "
        "outside the inner circle ranges are longer, inside it shorter. If the band includes the circle, the sign is "
        "not significant."
    )
    rows = list(map(list, pattern_rows(calibration)))
    table = Table(["tags", "rms (cm)", "most, at the level of the body"], rows, words=True)
    return [Heading("Patterns over direction"), table, Picture("patterns", draw, caption)]


def before_after(results: Results) -> list[Block]:
    """Return errors by pair and stage, their coverage by sigma, and figures."""
    evaluation, overall = results.evaluation, results.evaluation.overall
    groups = [*evaluation.pairs.items(), ("all", overall)]
    header = [
        "pair",
        "n",
        *["mean", "median", "robust"] * len(CORRECTION_STAGES),
        "95 % |e|",
        "noise",
        "in 95 %",
        "new p",
    ]
    above = [("", 2), *[(stage, 3) for stage in CORRECTION_STAGES], ("full", 3), ("", 1)]
    levels = list(overall.coverage)
    least = min(evaluation.pairs, key=lambda name: evaluation.pairs[name].coverage[levels[-1]])
    covered = [
        [name, *(f"{100 * group.coverage[level]:.0f} %" for level in levels)]
        for name, group in ((f"pair {least}, the lowest", evaluation.pairs[least]), ("all", overall))
    ]
    low, high = 100 * overall.full.low_m, 100 * overall.full.high_m
    known: dict[str, Any] = {"ranges": results.judged, "applied": results.corrected}
    return [
        Heading("Before and after"),
        Table(header, [[name, *_error_cells(group)] for name, group in groups], above, total=True),
        Text(
            "Errors in cm. Means contain the reflections that remain; medians nearly exclude them. "
            "Robust is 1.4826 median absolute deviations; 95 % |e| is the 95 % quantile of the absolute calibrated "
            f"errors (95 % of all lie between {low:+.1f} and {high:+.1f} cm). Noise: share of corrected ranges within "
            "the 95 % bounds of their sigma, 95 % without reflections; the others are mostly reflected. In 95 %: "
            "share within the 95 % intervals that include reflections. New p: share at powers outside the fitted ones.",
            "note",
        ),
        Table(["within nominal", *[f"{level} %" for level in levels]], covered, total=True),
        Text(
            "Coverage: the share of calibrated errors within the bounds of a normal distribution with their sigma. "
            "Reflections reduce the coverage at high levels.",
            "note",
        ),
        Picture(
            "errors",
            partial(figures.distribution, **known),
            "Range errors: histogram (the outermost bins include all larger errors), and the share of absolute "
            "errors below each value.",
        ),
        Picture(
            "z-scores",
            partial(figures.z_scores, **known),
            "Calibrated errors divided by their sigma. Left: their density. Right: the share of errors larger than a "
            "number of sigmas, on a logarithmic axis. Reflections lie above the line for noise only.",
        ),
        Picture(
            "residuals",
            partial(figures.residuals, **known, alpha_dbm=results.calibration.alpha_dbm),
            "Calibrated errors over distance and over power, reflections included: these shift the medians above "
            "zero. A slope or a wave would be a remaining bias. One per cent of the points is outside the figure.",
        ),
    ]


def _error_cells(group: ErrorStatistics) -> list[str]:
    shares = ["–" if v != v else f"{100 * v:.1f} %" for v in (1 - group.rejected, group.inside_95, group.clamped)]
    return [*stage_cells(group), f"{100 * group.full.abs95_m:.1f}", *shares]


def outliers(results: Results) -> list[Block]:
    """Return the error model of calibrated ranges by pair."""
    ranges, applied = results.judged, results.corrected
    error = applied.corrected_m - ranges.truth_m
    z = error / applied.sigma_m
    groups = {**pair_rows(ranges), "all": np.ones(len(ranges), dtype=bool)}
    fitted = {name: rows for name, rows in groups.items() if np.count_nonzero(rows) >= figures.MIN_RANGES_PER_BIN}
    if not fitted:
        return []
    parts = fit_grouped_errors([error[own] for own in fitted.values()])
    rows = [
        [
            name,
            *(f"{100 * np.mean(side[own]):.1f} %" for side in (z > 3, z < -3)),
            f"{100 * parts.sigma_m[k]:.1f}",
            f"{100 * parts.reflected[k]:.1f} %",
            f"{100 * parts.detour_m[k]:.0f}",
            f"{100 * parts.outliers[k]:.2f} %",
        ]
        for k, (name, own) in enumerate(fitted.items())
    ]
    return [
        Heading("Outliers"),
        Table(
            ["pair", "too long", "too short", "noise (cm)", "reflected", "mean detour (cm)", "outliers"],
            rows,
            total=True,
        ),
        Text(
            "Too long and too short: share of ranges outside three sigmas. Noise, reflections, their mean detour and "
            "outliers: parts of the errors of each pair, by the likelihood of the fit.",
            "note",
        ),
    ]


def localization(results: Results) -> list[Block]:
    """Return a table of the RMSE by body and filter with the values of ICRA 2023, and figures."""
    found = results.tracks
    if not found:
        return []
    total = summarize(found)
    names = list(total.rmse_m)
    rows = [
        *rmse_rows(found, total),
        ["ICRA 2023, its own flights", *(f"{PAPER_RMSE_M[n]:.3f}" if n in PAPER_RMSE_M else "" for n in names)],
        nees_row(total),
    ]
    (nis_low, nis_high), (nees_low, nees_high) = total.nis_bounds, total.nees_bounds
    meaning = (
        "Above their bounds: the filter is overconfident, for example because sigma does not include reflections."
        if total.nis > nis_high or total.nees > nees_high
        else "Below their bounds: the filter is underconfident, for example because a gate rejects the tail."
        if total.nis < nis_low or total.nees < nees_low
        else "Both lie within: the filter is consistent."
    )
    heads = [FILTER_STYLES[name][0].removeprefix("calibrated, ") for name in names]
    worst = max(found, key=lambda one: float(one.rmse_m["variance"].mean()))
    caption = (
        f"{worst.source}, {worst.body}, the body with the largest error after calibration: path from above, height, "
        f"and position error over time. If the blue line is above three sigmas, the filter underestimates its error."
    )
    return [
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
        Picture(track_name(worst.source, worst.body), partial(track, one=worst), caption),
    ]


def _filters(found: list[Localization]) -> str:
    """Return the settings of the filters in words, and the limits of a comparison with the paper."""
    chosen, fixed = Settings(), found[0].fixed
    own = "these flights are simulated" if all(one.simulated for one in found) else "these are other flights"
    paper = ", ".join(f"{value:.3f}" for value in PAPER_RMSE_M.values())
    return (
        "One body at a time is tracked by an EKF from its ranges to the others, whose positions are known; velocity "
        f"and attitude are inputs from the poses, velocity with white noise of {chosen.velocity_std_mps:g} m/s an axis "
        f"at {chosen.velocity_rate_hz:g} Hz, as for optical flow of a small drone. The gain of a calibration depends "
        f"on this choice: with a better known velocity, ranges have less weight. Fixed standard deviations, "
        f"{fixed.source}: raw {100 * fixed.std_m['raw']:.0f} cm, calibrated {100 * fixed.std_m['calibrated']:.0f} cm. "
        f"ICRA 2023 has {paper} m (raw, calibrated, with variance) for its own real flights and another process "
        f"noise; {own}, so values in metres cannot be compared, and percentages only if the process noise is similar."
    )


def track_name(source: str, body: str) -> str:
    """Return the name of the figure of a body in a recording."""
    return "track-" + "".join(c if c.isalnum() else "-" for c in f"{source.removesuffix('.uwb')}-{body}")


def over_time(results: Results) -> list[Block]:
    """Return a figure of the calibrated errors over time for each recording."""
    blocks: list[Block] = [Heading("Over time")]
    for k, recording in enumerate(results.recordings):
        caption = f"{recording.source}: calibrated errors, and the lines that should enclose 95 % without reflections."
        pairs, most = len(pair_rows(recording)), figures.MOST_PAIRS
        if pairs > most:
            caption += f" Only the {most} of {pairs} pairs with the largest spread of errors are drawn."
        draw = partial(figures.over_time, ranges=recording, applied=results.judged_calibration.apply(recording))
        blocks.append(Picture(f"over-time-{k + 1}", draw, caption))
    return blocks
