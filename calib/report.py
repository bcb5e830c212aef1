"""The report: one HTML file with everything in it, readable on a screen, a phone and on paper."""

from __future__ import annotations

import base64
import json
from html import escape
from pathlib import Path
from typing import Final

from calib.calibration import Calibration, write_text
from calib.dataset import Ranges, concatenate
from calib.evaluation import STAGES, Evaluation, Group, evaluate

STYLE: Final = """
:root { color-scheme: light dark; --ink: #1a1a1a; --page: #fff; --line: #ccc; --soft: #f3f5f7; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --page: #16181b; --line: #444; --soft: #22262b; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--page); max-width: 1040px;
  margin: 0 auto; padding: 1rem; }
h1 { line-height: 1.2; } h2 { margin-top: 2.2rem; border-bottom: 1px solid var(--line); }
.lead { font-size: 1.15rem; background: var(--soft); padding: .8rem 1rem; border-radius: .4rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .6rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } tr.all { font-weight: bold; }
tr.above th { text-align: center; border-left: 1px solid var(--line); }
figure { margin: 1rem 0; } figure img { width: 100%; height: auto; background: #fff; border-radius: .4rem; }
figcaption { font-size: .9rem; } pre { background: var(--soft); padding: .6rem; overflow-x: auto; }
@media print { body { max-width: none; } h2 { break-after: avoid; } figure, tr { break-inside: avoid; } }
"""


def write_report(path: Path, recordings: list[Ranges], calibration: Calibration, *, force: bool = False) -> None:
    """Evaluate a calibration on recordings and write what came out as one HTML file.

    Raises what `Calibration.apply` and `check_output` raise; nothing is written then.
    """
    write_text(path, render(recordings, calibration), force=force)


def render(recordings: list[Ranges], calibration: Calibration) -> str:
    """Return the report as HTML text. All text that comes from files is escaped."""
    ranges = concatenate(recordings)
    evaluation = evaluate(ranges, calibration)
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>Calibration report</title><style>{STYLE}</style></head><body>",
        "<h1>Calibration report</h1>",
        _summary(evaluation),
        "<h2>Recordings</h2>",
        _recordings(recordings),
        "<h2>Antenna delays</h2>",
        _delays(ranges, calibration),
        "<h2>Before and after</h2>",
        _before_after(evaluation),
        *_figures(recordings, ranges, calibration),
        "<h2>Provenance</h2>",
        f"<pre>{escape(json.dumps(calibration.provenance, indent=1))}</pre>",
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _summary(evaluation: Evaluation) -> str:
    group = evaluation.overall
    cm = {stage: (100 * getattr(group, stage).mean_m, 100 * getattr(group, stage).std_m) for stage in STAGES}
    return (
        f"<p class='lead'>Over {group.raw.n} ranges the mean error goes from {cm['raw'][0]:+.1f} cm (raw) to "
        f"{cm['delays'][0]:+.1f} cm (delays corrected) and {cm['full'][0]:+.1f} cm (fully corrected); the standard "
        f"deviation from {cm['raw'][1]:.1f} to {cm['full'][1]:.1f} cm, its robust estimate from "
        f"{100 * group.raw.robust_std_m:.1f} to {100 * group.full.robust_std_m:.1f} cm. A chi-square test at 95 % "
        f"rejects {100 * group.rejected:.1f} % of the corrected ranges; the others have a mean of "
        f"{100 * group.accepted.mean_m:+.1f} cm and a standard deviation of {100 * group.accepted.std_m:.1f} cm.</p>"
    )


def _recordings(recordings: list[Ranges]) -> str:
    rows = [
        [
            escape(r.source),
            str(len(r)),
            f"{(r.time_ns.max() - r.time_ns.min()) * 1e-9:.0f}",
            escape(", ".join(map(str, r.tags()))),
            escape(", ".join(f"{n} {why}" for why, n in r.excluded.items()) or "none"),
        ]
        for r in recordings
    ]
    return _table(["recording", "ranges", "seconds", "tags", "left out"], rows)


def _delays(ranges: Ranges, calibration: Calibration) -> str:
    from calib.figures import common_shift_ns

    planted = (ranges.planted or {}).get("delays_ns", {})
    shift = common_shift_ns(ranges, calibration)
    header = ["tag", "fitted (ns)", "± 1 std (ns)"]
    rows = []
    for tag, delay in calibration.delays_ns.items():
        row = [str(tag), f"{delay:+.4f}", f"{calibration.delays_std_ns.get(tag, float('nan')):.4f}"]
        if str(tag) in planted:
            truth = float(planted[str(tag)])
            row += [f"{truth:+.4f}", f"{1e3 * (delay - shift - truth):+.1f}"]
        rows.append(row)
    if not planted:
        return _table(header, rows)
    note = (
        "<p>A constant in the bias curve and a shift common to all delays are the same thing: the last column, and the "
        f"planted curve in the figure, are compared after moving the common {shift:+.4f} ns from one to the other.</p>"
    )
    return _table([*header, "planted (ns)", "difference (ps)"], rows) + note


def _before_after(evaluation: Evaluation) -> str:
    header = ["pair", "n", *["mean", "std", "robust"] * len(STAGES), "rejected", "clamped"]
    rows = [[escape(name), *_cells(group)] for name, group in evaluation.pairs.items()]
    rows.append(["all", *_cells(evaluation.overall)])
    note = (
        "<p>Errors in cm. Robust is 1.4826 median absolute deviations. Rejected: share beyond the 95 % quantile of "
        "chi-square with the calibrated variance. Clamped: share at powers the curves were not fitted at.</p>"
    )
    spans = "<th colspan='2'></th>" + "".join(f"<th colspan='3'>{s}</th>" for s in STAGES) + "<th colspan='2'></th>"
    return _table(header, rows, last="all", above=f"<tr class='above'>{spans}</tr>") + note


def _cells(group: Group) -> list[str]:
    cells = [str(group.raw.n)]
    for stage in STAGES:
        stats = getattr(group, stage)
        cells += [f"{100 * v:.1f}" for v in (stats.mean_m, stats.std_m, stats.robust_std_m)]
    return [*cells, f"{100 * group.rejected:.1f} %", f"{100 * group.clamped:.1f} %"]


def _figures(recordings: list[Ranges], ranges: Ranges, calibration: Calibration) -> list[str]:
    from calib import figures

    applied = calibration.apply(ranges)
    parts = [
        "<h2>Errors</h2>",
        _figure(
            figures.png(figures.histogram(ranges, applied)),
            "Range errors. The outermost bins hold everything beyond them.",
        ),
        "<h2>Bias and standard deviation over power</h2>",
        _figure(
            figures.png(figures.bias_over_power(ranges, applied, calibration)),
            "Bias over lifted first-path power: medians of the delay-corrected errors, and the curve.",
        ),
        _figure(
            figures.png(figures.sigma_over_power(ranges, applied, calibration)),
            "Standard deviation over lifted first-path power: robust estimates, and the curve of the core.",
        ),
        "<h2>Over time</h2>",
    ]
    for recording in recordings:
        picture = figures.png(figures.over_time(recording, calibration.apply(recording)))
        caption = f"{escape(recording.source)}: calibrated errors, and the band in which 95 % should lie."
        parts.append(_figure(picture, caption))
    return parts


def _figure(png: bytes, caption: str) -> str:
    picture = base64.b64encode(png).decode()
    return (
        f"<figure><img alt='{escape(caption, quote=True)}' src='data:image/png;base64,{picture}'>"
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _table(header: list[str], rows: list[list[str]], last: str = "", above: str = "") -> str:
    head = "".join(f"<th>{name}</th>" for name in header)
    body = "".join(
        f"<tr class='{last if row is rows[-1] else ''}'>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>"
        for row in rows
    )
    return f"<div class='wide'><table><thead>{above}<tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
