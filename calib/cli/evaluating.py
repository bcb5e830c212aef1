"""Commands that judge: evaluate, localize, doctor, compare."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from calib.cli.arguments import CalibrationFile, Force, Recordings


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    for command in (evaluate, localize, doctor, compare):
        app.command()(command)


def evaluate(
    recordings: Recordings,
    calibration: CalibrationFile,
    report: Annotated[Path | None, typer.Option(help="Report of the evaluation to write, one page (.html).")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print all figures as JSON, in metres and ns, instead of a table.")
    ] = False,
    force: Force = False,
) -> None:
    """Compare raw, delay-corrected and fully corrected ranges with the true distances, in cm, pair by pair."""
    import calib
    from calib.sources import load_each

    if report:
        from uwblink.output import check_output

        check_output(report, force=force)
    known = calib.load_calibration(calibration)
    parts = load_each(recordings)
    evaluation = calib.evaluate(parts, known)
    if report:
        calib.write_report(report, parts, known, force=force)
    if as_json:
        typer.echo(json.dumps(evaluation.to_dict(), indent=1))
        return
    from rich.console import Console

    from calib.cli.table import WIDE, print_table

    print_table(evaluation, Console(width=None if sys.stdout.isatty() else WIDE))
    if report:
        typer.echo(f"report: {report}")


def localize(
    recordings: Recordings,
    calibration: CalibrationFile,
    tum: Annotated[
        Path | None, typer.Option(help="Folder for the estimated trajectories, one file a body and filter (.tum).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
    force: Force = False,
) -> None:
    """Track each moving body by its ranges, raw, calibrated and weighted by their variance, and print the RMSE in m."""
    from dataclasses import asdict

    import calib
    from calib.evaluation import FILTERS, PAPER_RMSE_M, as_tum, summarize
    from uwblink.output import write_text

    known = calib.load_calibration(calibration)
    found = [one for path in recordings for one in calib.localize(path, known)]
    if tum:
        tum.mkdir(parents=True, exist_ok=True)
        for one in found:
            for stage, track in one.tracks.items():
                name = "".join(c if c.isalnum() or c in "-_" else "_" for c in f"{one.source}-{one.body}-{stage}")
                write_text(tum / f"{name}.tum", as_tum(track), force=force)
    summary = summarize(found)
    if as_json:
        rows = [
            {"recording": one.source, "body": one.body, "rmse_m": {s: one.tracks[s].rmse_m for s in FILTERS}}
            for one in found
        ]
        typer.echo(json.dumps({"scenarios": rows, "summary": asdict(summary)}, indent=1))
        return
    typer.echo(f"{'RMSE of the position (m)':34s}{'raw':>8s}{'calibrated':>13s}{'and variance':>14s}")
    for one in found:
        figures = [one.tracks[stage].rmse_m for stage in FILTERS]
        typer.echo(f"{one.source + ' ' + one.body:34s}{figures[0]:8.3f}{figures[1]:13.3f}{figures[2]:14.3f}")
    mean, less = summary.rmse_m, summary.reduction
    typer.echo(f"{'mean':34s}{mean['raw']:8.3f}{mean['calibrated']:13.3f}{mean['variance']:14.3f}")
    typer.echo(f"{'':42s}{-100 * less['calibrated']:+12.0f} %{-100 * less['variance']:+12.0f} %")
    paper = PAPER_RMSE_M
    typer.echo(
        f"{'ICRA 2023, its own flights':34s}{paper['raw']:8.3f}{paper['calibrated']:13.3f}{paper['variance']:14.3f}"
    )
    typer.echo(
        f"with the calibrated variance: NIS {summary.nis:.2f} (1 expected, 95 % bounds {summary.nis_bounds[0]:.2f} to "
        f"{summary.nis_bounds[1]:.2f}), NEES {summary.nees:.2f} (3 expected, {summary.nees_bounds[0]:.2f} to "
        f"{summary.nees_bounds[1]:.2f}), {100 * summary.accepted:.1f} % of the ranges pass the gate"
    )


def doctor(
    recording: Annotated[Path, typer.Argument(help="Recording (.uwb).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
) -> None:
    """Name the faults in a recording, each with what shows it and what to do about it."""
    from dataclasses import asdict, replace

    import calib
    from calib.cli.flags import with_flags

    findings = [
        replace(f, evidence=with_flags(f.evidence), remedy=with_flags(f.remedy)) for f in calib.examine(recording)
    ]
    if as_json:
        typer.echo(json.dumps([asdict(finding) for finding in findings], indent=1))
        return
    if not findings:
        typer.echo(f"{recording}: nothing found")
    for finding in findings:
        typer.echo(f"{finding.fault} (confidence {finding.confidence:.2f})")
        typer.echo(f"  evidence: {finding.evidence}")
        typer.echo(f"  remedy:   {finding.remedy}")


def compare(
    first: Annotated[Path, typer.Argument(help="Calibration to compare with (.json).")],
    second: Annotated[Path, typer.Argument(help="Calibration whose differences are told (.json).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
) -> None:
    """Say whether two calibrations' delays differ by more than their standard errors explain (differences in ps)."""
    import calib

    found = calib.compare(calib.load_calibration(first), calib.load_calibration(second))
    if as_json:
        typer.echo(json.dumps(found.to_dict(), indent=1))
        return
    typer.echo(found.table(str(first), str(second)))
