"""Commands that judge: evaluate, localize, doctor, compare."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

if TYPE_CHECKING:
    from calib import Calibration
    from calib.evaluation import Evaluation

from calib.cli.arguments import AsJson, CalibrationFile, Figures, Force, Recordings
from calib.cli.loading import known_calibration
from uwblink.cli.guide import add, choice
from uwblink.cli.starting import keep_imported
from uwblink.cli.waiting import waiting

PANEL: Final = "Judge"


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    for command, *examples in (
        (
            evaluate,
            "calib evaluate test.uwb -c calibration.json",
            "calib evaluate test.uwb -c calibration.json --report r.html",
        ),
        (
            localize,
            "calib localize test.uwb -c calibration.json",
            "calib localize test.uwb -c calibration.json --model imu",
        ),
        (doctor, "calib doctor flight.uwb"),
        (compare, "calib compare before.json after.json"),
    ):
        add(app, command, *examples, panel=PANEL)


def evaluate(
    recordings: Recordings,
    calibration: CalibrationFile,
    report: Annotated[
        Path | None, typer.Option(help="Report of the evaluation to write, one page (.html) or pages (.pdf).")
    ] = None,
    figures: Figures = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Compare raw, delay-corrected and fully corrected ranges with the true distances, in cm, pair by pair."""
    import calib
    from calib.data import load_each

    if report or figures:
        from calib.report import check_places

        check_places(report, None, figures, force=force)
        keep_imported()
    known = known_calibration(calibration, recordings)
    with waiting("evaluating"):
        parts = load_each(recordings, need_power=known.needs_power)
        evaluation = calib.evaluate(parts, known)
        if report or figures:
            from calib.report import origin_of

            origin = origin_of([*recordings, calibration], command_line())
            calib.write_report(report, parts, known, figures=figures, evaluation=evaluation, origin=origin, force=force)
    tell_seen(evaluation)
    if as_json:
        typer.echo(json.dumps(evaluation.to_dict(), indent=1))
        return
    from rich.console import Console

    from calib.cli.table import WIDE, print_table

    print_table(evaluation, Console(width=None if sys.stdout.isatty() else WIDE))
    for path in filter(None, (report, figures)):
        typer.echo(f"report: {path}")


def command_line() -> str:
    """Return how the command was called, for the report to say."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def tell_seen(evaluation: Evaluation) -> None:
    """Warn where a calibration was judged on what it was fitted to."""
    if evaluation.seen:
        names = ", ".join(evaluation.seen)
        typer.echo(
            f"warning: the calibration was fitted to {names}: errors there are smaller than where it is used; "
            "judge it on recordings that the fit has not seen",
            err=True,
        )


def localize(
    recordings: Recordings,
    calibration: CalibrationFile,
    model: Annotated[
        str,
        typer.Option(
            help="What moves the estimate between ranges: velocity and attitude from motion capture (to weigh "
            "calibrations), or without any, by ranges to fixed anchors and a height sensor, an IMU or nothing.",
            **choice("poses", "imu", "constant-velocity"),
        ),
    ] = "poses",
    training: Annotated[
        Path | None, typer.Option(help="Flight on which the fixed variances are tuned; else they are the fit's (.uwb).")
    ] = None,
    process_noise: Annotated[
        float, typer.Option(help="White noise of the velocity input, m/s an axis at 100 Hz; gains depend on it.")
    ] = 0.3,
    seeds: Annotated[int, typer.Option(help="Runs with other noise, of which mean and spread are told.")] = 3,
    tum: Annotated[
        Path | None, typer.Option(help="Folder for the estimated trajectories, one file a body and filter (.tum).")
    ] = None,
    figures: Figures = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Track each moving body by its ranges, with and without calibration, and print the RMSE in m."""
    import calib
    from calib.evaluation import Settings, localization_json, localization_text, summarize, write_tum

    if figures:
        from calib.report import check_places, write_track_figures

        check_places(None, None, figures, force=force)
    known = known_calibration(calibration, recordings)
    if model != "poses":
        _onboard(recordings, known, model, tum, figures, as_json=as_json, force=force)
        return
    settings = Settings(velocity_std_mps=process_noise, seeds=seeds)
    with waiting("localizing"):
        found = [one for path in recordings for one in calib.localize(path, known, settings, training=training)]
    # What is printed first: where it cannot be said, nothing is written.
    told = (
        json.dumps(localization_json(found), indent=1)
        if as_json
        else localization_text(found, summarize(found), settings)
    )
    if tum:
        write_tum(found, tum, force=force)
    if figures:
        write_track_figures(found, figures, force=force)
    typer.echo(told)


def _onboard(
    recordings: list[Path],
    known: Calibration,
    model: str,
    tum: Path | None,
    figures: Path | None,
    *,
    as_json: bool,
    force: bool,
) -> None:
    """Localize by what is on board, and print it."""
    from calib.evaluation import OnboardSettings, localize_onboard, onboard_json, onboard_text, write_onboard_tum

    settings = OnboardSettings(model=model)
    with waiting("localizing"):
        found = [one for path in recordings for one in localize_onboard(path, known, settings)]
    told = json.dumps(onboard_json(found), indent=1) if as_json else onboard_text(found, settings)
    if tum:
        write_onboard_tum(found, tum, force=force)
    if figures:
        from calib.report import write_onboard_figures

        write_onboard_figures(found, figures, force=force)
    typer.echo(told)


def doctor(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings (.uwb); of several, what changed between them is said, too.")
    ],
    as_json: AsJson = False,
) -> None:
    """Name the faults in recordings, each with what shows it and what to do about it, and compare clocks by pair."""
    from dataclasses import asdict, replace

    import calib
    from calib.cli.flags import with_flags
    from calib.doctor import examined_part
    from uwblink import Recording
    from uwblink.recording import clock_skews

    skews = {}
    with waiting("examining"):
        found = calib.examine(recordings)
        parts = {str(path): part for path in recordings if (part := examined_part(path))}
        for path in recordings:
            with Recording.open(path) as recording:
                skews[str(path)] = clock_skews(recording.exchange_blocks())
    findings = [replace(f, evidence=with_flags(f.evidence), remedy=with_flags(f.remedy)) for f in found]
    if as_json:
        clocks = {path: [asdict(one) | {"slope": one.slope} for one in some] for path, some in skews.items()}
        found_all = {"findings": [asdict(f) for f in findings], "clock_skews": clocks}
        typer.echo(json.dumps(found_all | ({"examined": parts} if parts else {}), indent=1))
        return
    for name, part in parts.items():
        typer.echo(f"{name}: {part}")
    if not findings:
        typer.echo(f"{', '.join(map(str, recordings))}: nothing found")
    for finding in findings:
        typer.echo(f"{finding.fault}" + (f" (p = {finding.p_value:.1g})" if finding.p_value else ""))
        typer.echo(f"  evidence: {finding.evidence}")
        typer.echo(f"  remedy:   {finding.remedy}")
    for name, some in skews.items():
        if some:
            typer.echo(f"clock skew in {name}, the second tag against the first")
        for one in some:
            typer.echo(f"  {one}")


def compare(
    first: Annotated[Path, typer.Argument(help="Calibration to compare with (.json).")],
    second: Annotated[Path, typer.Argument(help="Calibration whose differences are told (.json).")],
    figures: Figures = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Say whether two calibrations' delays differ by more than their standard errors explain (differences in ns)."""
    import calib

    if figures:
        from calib.report import check_places, write_comparison_figures

        check_places(None, None, figures, force=force)
    known = [known_calibration(path) for path in (first, second)]
    found = calib.compare(*known)
    if figures:
        write_comparison_figures(found, known, [first.stem, second.stem], figures, force=force)
    if as_json:
        typer.echo(json.dumps(found.to_dict(), indent=1))
        return
    typer.echo(found.table(str(first), str(second)))
