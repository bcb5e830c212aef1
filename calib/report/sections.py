"""The sections of a report, as blocks."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from calib.calibration.display import pair_rows as offset_rows
from calib.calibration.model import Calibration
from calib.calibration.parts import CorrectedRanges
from calib.error_mixture import fit_error_mixtures
from calib.evaluation.error_statistics import ErrorStatistics
from calib.evaluation.statistics import CORRECTION_STAGES, Evaluation, PlantedComparison, pair_rows
from calib.ranges import Ranges
from calib.report.blocks import Block, Heading, Picture, Table, Text

if TYPE_CHECKING:
    from calib.estimation.passive_listeners import OverheardDelay
    from calib.estimation.result import FitResult

OUTLIER_SIGMAS: Final = 3.0
NOT_SPLIT: Final = (
    "How a delay splits into transmission and reception is not determined: stamps of free-running clocks leave it "
    "open, overheard exchanges included, because shifting a tag's clock shifts both. Where both are needed, 0.44 of a "
    "delay goes to transmission and 0.56 to reception by convention."
)


FOLLOWS_CORE: Final = (
    "The curve follows the core of the errors: noise, without reflections, which can only lengthen a range. Points are "
    "the centre of that core (below: its spread), told from the tail bin by bin, without the curve. Medians are "
    "drawn, too, and lie above: with a share s of reflected ranges about the quantile 0.5 / (1 − s) of the core."
)
FOLLOWS: Final = {"l2": "The curve follows the mean of the errors, as least squares do; points are means, bin by bin."}


def summary(evaluation: Evaluation, on_what: str = "") -> str:
    """Return what the whole comes to, in a few sentences."""
    group = evaluation.overall
    cm = {stage: (100 * getattr(group, stage).mean_m, 100 * getattr(group, stage).std_m) for stage in CORRECTION_STAGES}
    where = f" of {on_what}" if on_what else ""
    return (
        f"Over {group.raw.n} ranges{where} the mean error goes from {cm['raw'][0]:+.1f} cm (raw) to "
        f"{cm['delays'][0]:+.1f} cm (delays corrected) and {cm['full'][0]:+.1f} cm (fully corrected); the standard "
        f"deviation from {cm['raw'][1]:.1f} to {cm['full'][1]:.1f} cm, its robust estimate from "
        f"{100 * group.raw.robust_std_m:.1f} to {100 * group.full.robust_std_m:.1f} cm. {reflected(evaluation)}"
    )


def reflected(evaluation: Evaluation) -> str:
    """Say what is beyond what noise explains, which is no harm that a calibration does."""
    group = evaluation.overall
    return (
        f"{100 * (1 - group.rejected):.1f} % of the corrected ranges are as near as noise alone explains (95 % would "
        f"be without reflections), with a mean of {100 * group.accepted.mean_m:+.1f} cm and a standard deviation of "
        f"{100 * group.accepted.std_m:.1f} cm; the other {100 * group.rejected:.1f} % are mostly reflected ones, which "
        "no calibration shortens and a filter's gate leaves out."
    )


def recordings(
    training: list[Ranges], tests: list[Ranges] | None = None, files: Mapping[str, str] | None = None
) -> Table:
    """Return one row a recording; `files` are SHA-256 by path, of which a row shows the beginning."""
    digests = {Path(path).name: digest[:12] for path, digest in (files or {}).items()}
    uses = [("fit", r) for r in training] + [("test", r) for r in tests or []]
    rows = [
        [
            r.source,
            *([use] if tests is not None else []),
            str(len(r)),
            f"{(r.time_ns.max() - r.time_ns.min()) * 1e-9:.0f}",
            ", ".join(map(str, r.tags())),
            str(len(pair_rows(r))),
            ", ".join(sorted(set(np.unique(r.protocol).tolist()))),
            ", ".join(f"{n} {why}" for why, n in r.excluded.items()) or "none",
            *([digests.get(r.source, "in memory")] if files is not None else []),
        ]
        for use, r in uses
    ]
    header = ["recording", *(["used to"] if tests is not None else [])]
    header += ["ranges", "seconds", "tags", "pairs", "protocol", "left out"]
    return Table([*header, *(["SHA-256"] if files is not None else [])], rows)


def determined(ranges: Ranges, calibration: Calibration, fit: FitResult) -> list[Block]:
    """Say whether the pairs settle the delays, and what the fit assumed."""
    free = calibration.provenance.get("undetermined", [])
    pairs = pair_rows(ranges)
    if free:
        groups = "; ".join(", ".join(map(str, group)) for group in free)
        trace = f"the delays of tags {groups} can shift against each other without a trace in any range"
        verdict = f"No: {calibration.provenance.get('left_open', trace)}."
    else:
        verdict = f"Yes: the {len(pairs)} pairs of {len(ranges.tags())} tags settle every delay."
    counts = [len(np.flatnonzero(rows)) for rows in pairs.values()]
    return [
        Text(
            f"{verdict} The rarest pair has {min(counts)} ranges, the most frequent {max(counts)}. The fit "
            f"{fit.message}, with the {calibration.loss} loss at a scale of {calibration.scale_ns:.3f} ns; its "
            f"standard errors are a {calibration.provenance.get('standard_errors', 'sandwich')}, so errors that "
            "persist within a block are not counted as independent ones."
        ),
        Text(NOT_SPLIT),
    ]


def delays(
    calibration: Calibration, planted: PlantedComparison | None, truth: dict[str, Any], heard: dict[int, OverheardDelay]
) -> list[Block]:
    """Return delays with intervals; beside them what was planted, and what listeners heard."""
    from calib import figures

    known = {int(tag): float(d) for tag, d in truth.get("delays_ns", {}).items()} if planted else {}
    header = ["tag", "delay (ns)", "95 % from", "to"]
    shift = planted.shift_ns if planted else 0.0
    header += ["planted, same gauge (ns)", "difference (ps)"] if known else []
    header += ["heard by others (ns)", "± 1 std"] if heard else []
    rows = []
    for tag, delay in sorted(calibration.delays_ns.items()):
        half = figures.TWO_SIDED_95 * calibration.delays_std_ns.get(tag, float("nan"))
        bounds = [f"{delay - half:+.4f}", f"{delay + half:+.4f}"] if np.isfinite(half) else ["undetermined", ""]
        row = [str(tag), f"{delay:+.4f}", *bounds]
        if known and planted:
            beside = (
                [f"{known[tag] + shift:+.4f}", f"{1e3 * planted.delay_error_ns[tag]:+.1f}"]
                if tag in known
                else ["", ""]
            )
            row += beside
        if heard:
            row += [f"{heard[tag].delay_ns:+.4f}", f"{heard[tag].std_ns:.4f}"] if tag in heard else ["", ""]
        rows.append(row)
    if calibration.pair_offsets:
        return [Table(["pair", "ranges too long by (cm)", "95 %"], [list(row) for row in offset_rows(calibration)])]
    blocks: list[Block] = [
        Table(header, rows),
        Picture(
            "delays",
            partial(figures.alone, partial(figures.delays, calibration, known, shift)),
            "Antenna delays with their 95 % intervals"
            + (", and what was planted, in the same gauge." if known else "."),
        ),
    ]
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
    return blocks


def sensitivity(calibration: Calibration, refits: dict[float, Calibration]) -> list[Block]:
    """Show how the delays depend on the scale of the loss."""
    from calib.report import figures_fit

    if not refits:
        return []
    draw = partial(
        figures_fit.scale_sensitivity,
        scales_ns=list(refits),
        fits=list(refits.values()),
        chosen_ns=calibration.scale_ns,
    )
    return [
        Picture(
            "scale-sensitivity", draw, "What another scale of the loss would have done to the delays, mean removed."
        )
    ]


def curves(ranges: Ranges, applied: CorrectedRanges, calibration: Calibration) -> list[Block]:
    """Return the curves over power, with bands and data, which are found once for all widths."""
    from calib import figures

    known = (ranges, applied, calibration)
    biases, sigmas = cache(partial(figures.biases, *known)), cache(partial(figures.sigmas, *known))
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
            lambda width: figures.alone(partial(figures.bias_over_power, *known, found=biases()), width),
            "Bias over power: what the delay-corrected errors centre on, and the curve with its 95 % band.",
        ),
        Picture(
            "sigma",
            lambda width: figures.alone(partial(figures.sigma_over_power, *known, found=sigmas()), width),
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
    from calib import figures

    rows = []
    error, z = applied.corrected_m - ranges.truth_m, (applied.corrected_m - ranges.truth_m) / applied.sigma_m
    groups = {**pair_rows(ranges), "all": np.ones(len(ranges), dtype=bool)}
    told = {name: mine for name, mine in groups.items() if np.count_nonzero(mine) >= figures.FEWEST_IN_BIN}
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
