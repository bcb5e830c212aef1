"""The sections of a report on what was recorded and fitted, as blocks."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.model import pair_rows as offset_rows
from calib.data.ranges import Ranges
from calib.evaluation.statistics import CORRECTION_STAGES, Evaluation, PlantedComparison, pair_rows
from calib.report.blocks import Block, Picture, Table, Text
from calib.spread import TWO_SIDED_95

if TYPE_CHECKING:
    from calib.estimation.passive_listeners import OverheardDelay
    from calib.estimation.result import FitResult

NOT_SPLIT: Final = (
    "How a delay splits into transmission and reception is not determined: stamps of free-running clocks leave it "
    "open, overheard exchanges included, because shifting a tag's clock shifts both. Where both are needed, 0.44 of a "
    "delay goes to transmission and 0.56 to reception by convention."
)


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
        half = TWO_SIDED_95 * calibration.delays_std_ns.get(tag, float("nan"))
        unknown = ["not stated" if np.isnan(half) else "undetermined", ""]
        bounds = [f"{delay - half:+.4f}", f"{delay + half:+.4f}"] if np.isfinite(half) else unknown
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
