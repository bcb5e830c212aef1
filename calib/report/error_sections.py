"""The sections of a report on errors: over power, before and after, what they are made of, over time."""

from __future__ import annotations

from functools import cache, partial
from typing import Final

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.parts import CorrectedRanges
from calib.data.ranges import Ranges
from calib.error_mixture import fit_error_mixtures
from calib.evaluation.error_statistics import ErrorStatistics
from calib.evaluation.statistics import CORRECTION_STAGES, Evaluation, pair_rows
from calib.over_power import FEWEST_IN_BIN, biases, sigmas
from calib.report.blocks import Block, Heading, Picture, Table, Text

OUTLIER_SIGMAS: Final = 3.0

FOLLOWS_CORE: Final = (
    "The curve follows the core of the errors: noise, without reflections, which can only lengthen a range. Points are "
    "the centre of that core (below: its spread), told from the tail bin by bin, without the curve. Medians are "
    "drawn, too, and lie above: with a share s of reflected ranges about the quantile 0.5 / (1 − s) of the core."
)
FOLLOWS: Final = {"l2": "The curve follows the mean of the errors, as least squares do; points are means, bin by bin."}


def curves(ranges: Ranges, applied: CorrectedRanges, calibration: Calibration) -> list[Block]:
    """Return the curves over power, with bands and data, which are found once for all widths."""
    from calib import figures

    known = (ranges, applied, calibration)
    bias, sigma = cache(partial(biases, *known)), cache(partial(sigmas, *known))
    return [
        Heading("Bias and standard deviation over power"),
        Text(FOLLOWS.get(calibration.loss, FOLLOWS_CORE), "note"),
        Text(
            "Lifted power is the first-path power p on a scale that stretches where ranges are good and the bias "
            f"changes: ψ = 10^((p − α) / 10 dB) with α = {calibration.alpha_dbm:g} dBm, so ψ = 1 at α and a tenth of "
            "it 10 dB lower; of an exchange, "
            + (
                "the mean over both ends."
                if calibration.lift == "mean-of-lifted"
                else "that of the mean power of both ends."
            )
            + " Powers in dBm stand above the figures.",
            "note",
        ),
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


def before_after(evaluation: Evaluation) -> list[Block]:
    """Return the table of errors by pair and stage, and how well sigma covers them."""
    header = ["pair", "n", *["mean", "std", "robust"] * len(CORRECTION_STAGES), "95 % |e|", "noise", "in 95 %", "new p"]
    rows = [[name, *_cells(group)] for name, group in evaluation.pairs.items()]
    rows.append(["all", *_cells(evaluation.overall)])
    above = [("", 2), *[(stage, 3) for stage in CORRECTION_STAGES], ("full", 3), ("", 1)]
    overall = evaluation.overall
    levels = list(overall.coverage)
    covered = [
        [name, *[f"{100 * group.coverage[level]:.0f} %" for level in levels]]
        for name, group in [*evaluation.pairs.items(), ("all", overall)]
    ]
    low, high = 100 * overall.full.low_m, 100 * overall.full.high_m
    return [
        Table(header, rows, above, total=True),
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
    ]


def _cells(group: ErrorStatistics) -> list[str]:
    cells = [str(group.raw.n)]
    for stage in CORRECTION_STAGES:
        stats = getattr(group, stage)
        cells += [f"{100 * v:.1f}" for v in (stats.mean_m, stats.std_m, stats.robust_std_m)]
    shares = [_percent(share) for share in (1 - group.rejected, group.inside_95, group.clamped)]
    return [*cells, f"{100 * group.full.abs95_m:.1f}", *shares]


def _percent(share: float) -> str:
    return "–" if share != share else f"{100 * share:.1f} %"


def errors(ranges: Ranges, applied: CorrectedRanges, calibration: Calibration) -> list[Block]:
    """Return histograms, z-scores, and residuals over distance and power."""
    from calib.report import figures_errors

    return [
        Picture(
            "errors",
            partial(figures_errors.distribution, ranges=ranges, applied=applied),
            "Range errors: how many of which size and sign (the outermost bins hold everything beyond them), and how "
            "many are smaller than so much.",
        ),
        Picture(
            "z-scores",
            partial(figures_errors.z_scores, ranges=ranges, applied=applied),
            "Calibrated errors over their sigma: density, and quantiles against those of the standard normal.",
        ),
        Picture(
            "residuals",
            partial(figures_errors.residuals, ranges=ranges, applied=applied, alpha_dbm=calibration.alpha_dbm),
            "What is left over distance and over power, reflections included: they lift the medians off zero, the more "
            "of them the higher; a slope or a wave would be a bias that is left. A hundredth of the points is beyond.",
        ),
    ]


def outliers(ranges: Ranges, applied: CorrectedRanges) -> list[Block]:
    """Say what the calibrated errors are made of, by pair."""
    rows = []
    error, z = applied.corrected_m - ranges.truth_m, (applied.corrected_m - ranges.truth_m) / applied.sigma_m
    groups = {**pair_rows(ranges), "all": np.ones(len(ranges), dtype=bool)}
    told = {name: mine for name, mine in groups.items() if np.count_nonzero(mine) >= FEWEST_IN_BIN}
    mixtures = fit_error_mixtures([error[mine] for mine in told.values()])
    for (name, mine), mixture in zip(told.items(), mixtures, strict=True):
        rows.append(
            [
                name,
                f"{100 * np.mean(z[mine] > OUTLIER_SIGMAS):.1f} %",
                f"{100 * np.mean(z[mine] < -OUTLIER_SIGMAS):.1f} %",
                f"{100 * mixture.sigma_m[0]:.1f}",
                f"{100 * mixture.tail_share:.1f} %",
                f"{100 * mixture.tail_mean_m:.0f}",
                f"{100 * mixture.outlier_share:.2f} %",
            ]
        )
    header = ["pair", "too long", "too short", "core (cm)", "tail", "its mean (cm)", "outliers"]
    return [
        Table(header, rows, total=True),
        Text(
            "Too long and too short: share of ranges beyond three sigmas. Core, tail and outliers: a Gaussian, an "
            "exponential detour on the long side, and what fits neither, by maximum likelihood.",
            "note",
        ),
    ]


def over_time(recordings: list[Ranges], calibration: Calibration) -> list[Block]:
    """Return a figure a recording of the calibrated errors over time."""
    from calib.report import figures_errors

    blocks: list[Block] = [Heading("Over time")]
    for k, recording in enumerate(recordings):
        applied, pairs = calibration.apply(recording), len(pair_rows(recording))
        blocks.append(
            Picture(
                f"over-time-{k + 1}",
                partial(figures_errors.over_time, ranges=recording, applied=applied),
                f"{recording.source}: calibrated errors, and lines between which 95 % should lie without reflections."
                + (
                    f" Of {pairs} pairs the {figures_errors.MOST_PAIRS} whose errors spread most; others are left out."
                    if pairs > figures_errors.MOST_PAIRS
                    else ""
                ),
            )
        )
    return blocks
