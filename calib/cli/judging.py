"""Commands that evaluate: evaluate, localize, doctor, compare, report."""

from __future__ import annotations

import json
from collections import ChainMap
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import typer

import calib
import uwblink
from calib.cli.shared import (
    STOPPED,
    Recordings,
    TrimStatic,
    check_report,
    command_line,
    known_calibration,
    refuse_given,
    warn,
    with_flags,
)
from calib.settings import FitSettings, check_choice
from uwblink.cli.shared import AsJson, CalibrationFile, Figures, Force, ReportFile, add, choice, output, waiting


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    judged = "calib evaluate test.uwb -c calibration.json"
    tracked = "calib localize test.uwb -c calibration.json"
    reported = "calib report train.uwb --tests test1.uwb test2.uwb -o report.html"
    files = "calib report train.uwb -o report.html --pdf report.pdf --figures figures"
    add(app, evaluate, judged, f"{judged} --report r.html", panel="Judge")
    add(app, localize, tracked, f"{tracked} --model imu", panel="Judge")
    add(app, doctor, "calib doctor flight.uwb", panel="Judge")
    add(app, compare, "calib compare before.json after.json", panel="Judge")
    add(app, report, reported, files, panel="Judge")


def evaluate(
    recordings: Recordings,
    calibration: CalibrationFile,
    report: ReportFile = None,
    figures: Figures = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Compare raw, delay-corrected and fully corrected ranges with the true distances, in cm, pair by pair."""
    check_report(report, figures, force=force)
    known = known_calibration(calibration, recordings)
    with waiting("evaluating"):
        loaded = calib.data.load_each(recordings, need_power=known.needs_power)
        parts = [calib.calibration.keep_determined(known, part) for part in loaded]
        evaluation = calib.evaluate(parts, known)
        if report or figures:
            origin = calib.report.origin_of([*recordings, calibration], command_line())
            calib.write_report(report, parts, known, figures=figures, evaluation=evaluation, origin=origin, force=force)
    _warn_if_fitted(evaluation)
    written = [f"report: {path}" for path in (report, figures) if path]
    text = "\n".join([repr(evaluation), *_remarks(evaluation), *written])
    typer.echo(json.dumps(evaluation.to_dict(), indent=1) if as_json else text)


def _warn_if_fitted(evaluation: calib.evaluation.Evaluation) -> None:
    """Warn if a calibration was evaluated on recordings of its fit."""
    if evaluation.seen:
        warn(
            f"the calibration was fitted to {', '.join(evaluation.seen)}: errors there are smaller than in other "
            f"recordings; evaluate it on recordings that were not fitted"
        )


MODELS_OF_OPTION: Final = {
    "training": ("poses",),
    "process_noise": ("poses",),
    "seeds": ("poses",),
    "imu": ("imu", "team"),
    "start_std": ("team",),
}
"""The motion models that use an option of `localize`; all models use the options that are not listed."""


def _model_option(option: str, text: str, **more: Any) -> Any:
    """Return an option of `localize`, with the motion models that use it in its help."""
    return typer.Option(help=f"{text} For --model {' or '.join(MODELS_OF_OPTION[option])}.", **more)


def localize(
    context: typer.Context,
    recordings: Recordings,
    calibration: CalibrationFile,
    model: Annotated[
        str,
        typer.Option(
            help="Motion model between ranges. poses: velocity and attitude from motion capture, to compare "
            "calibrations; imu, constant-velocity: on board, by ranges to anchors and a height sensor; team: poses of "
            "robots in the frame of one of them by their IMUs and ranges, without anchors.",
            **choice("poses", "imu", "constant-velocity", "team"),
        ),
    ] = "poses",
    use: Annotated[
        str,
        typer.Option(
            help="Measurements. exchanges: ranges of the body; receptions: also overheard frames, which localize a "
            "body that only listens as well.",
            **choice("exchanges", "receptions"),
        ),
    ] = "exchanges",
    training: Annotated[
        Path | None,
        _model_option(
            "training", "Flight for tuning the fixed variances (.uwb); by default the variances of the fit are used."
        ),
    ] = None,
    process_noise: Annotated[
        float, _model_option("process_noise", "White noise of the velocity input (m/s per axis at 100 Hz).")
    ] = 0.3,
    imu: Annotated[
        str,
        _model_option(
            "imu",
            "Noise of the IMUs. drone: a consumer IMU on a vibrating frame.",
            **choice("drone", "consumer", "industrial", "tactical"),
        ),
    ] = "drone",
    start_std: Annotated[
        tuple[float, float, float],
        _model_option(
            "start_std",
            "Uncertainty of relative positions (m), attitudes (deg) and velocities (m/s) at the first exchange, "
            "as standard deviations per axis.",
        ),
    ] = (0.1, 3.0, 0.1),
    seeds: Annotated[int, _model_option("seeds", "Number of simulated runs, each with another seed.", min=1)] = 3,
    online: Annotated[
        bool,
        typer.Option(
            "--online",
            help="Compare with a filter that also estimates drifting delays.",
        ),
    ] = False,
    tum: Annotated[
        Path | None, typer.Option(help="Folder for the estimated trajectories, one file per body and filter (.tum).")
    ] = None,
    figures: Figures = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Track each moving body with and without the calibration, and print the errors of position (RMSE in m)."""
    models = calib.evaluation.MODELS
    check_choice("model", model, models)
    check_choice("imu", imu, calib.evaluation.IMUS)
    for option, its_models in MODELS_OF_OPTION.items():
        if model not in its_models:
            why = f"can only be used with `model` {' or '.join(its_models)}, not with {model}"
            refuse_given(context, [option], why)
    check_report(None, figures, force=force)
    fields: dict[str, dict[str, Any]] = {
        "process_noise": {"velocity_std_mps": process_noise},
        "seeds": {"seeds": seeds},
        "imu": {"noise": calib.evaluation.IMUS[imu]},
        "start_std": dict(zip(("start_std_m", "start_std_deg", "start_std_m_s"), start_std, strict=True)),
    }
    used = [values for option, values in fields.items() if model in MODELS_OF_OPTION[option]]
    settings = models[model].settings(use=use, online=online, **dict(ChainMap(*used)))
    track = partial(models[model].localize, **({} if training is None else {"training": training}))
    known = known_calibration(calibration, recordings)
    with waiting("localizing"):
        found = [one for path in recordings for one in track(path, known, settings)]
        # Before the files: if this fails, nothing is written.
        table, text = models[model].table(found), models[model].text(found, settings)
    if tum:
        calib.evaluation.write_tum(found, tum, force=force)
    if figures:
        calib.report.write_track_figures(found, figures, force=force)
    typer.echo(json.dumps(table, indent=1) if as_json else text)


def doctor(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings (.uwb); several are compared with each other, too.")
    ],
    as_json: AsJson = False,
) -> None:
    """Find faults in recordings, each with evidence and remedy, and compare the clocks of pairs."""
    skews, parts = dict[str, list[Any]](), dict[str, str]()
    with waiting("examining"):
        found = calib.examine(recordings)
        for path in recordings:
            with uwblink.Recording.open(path) as recording:
                skews[str(path)] = uwblink.recording.clock_skews(recording.exchange_blocks())
                if part := calib.checks.examined_part(recording.count("exchanges")):
                    parts[str(path)] = part
    findings = [replace(f, evidence=with_flags(f.evidence), remedy=with_flags(f.remedy)) for f in found]
    if as_json:
        clocks = {path: [asdict(one) for one in pairs] for path, pairs in skews.items()}
        found_all = {"findings": [asdict(f) for f in findings], "clock_skews": clocks}
        typer.echo(json.dumps(found_all | ({"examined": parts} if parts else {}), indent=1))
        return
    nothing = [] if findings else [f"{', '.join(map(str, recordings))}: nothing found"]
    lines = [*(f"{name}: {part}" for name, part in parts.items()), *nothing]
    for finding in findings:
        by_chance = f" (p = {finding.p_value:.1g})" if finding.p_value else ""
        lines += [f"{finding.fault}{by_chance}", f"  evidence: {finding.evidence}", f"  remedy:   {finding.remedy}"]
    for name, pairs in skews.items():
        if pairs:
            lines += [f"clock skew in {name}, of the second tag relative to the first", *(f"  {one}" for one in pairs)]
    typer.echo("\n".join(lines))


def compare(
    first: Annotated[Path, typer.Argument(help="First calibration (.json).")],
    second: Annotated[Path, typer.Argument(help="Calibration to compare with the first (.json).")],
    figures: Figures = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Test whether the delays (ns) of two calibrations differ significantly."""
    check_report(None, figures, force=force)
    known = [known_calibration(path) for path in (first, second)]
    found = calib.compare(*known)
    if figures:
        calib.report.write_comparison_figures(found, known, [first.stem, second.stem], figures, force=force)
    text = found.table(str(first), str(second))
    typer.echo(json.dumps(found.to_dict(), indent=1) if as_json else text)


def spread_tests(arguments: Sequence[str]) -> list[str]:
    """Return command-line arguments with `--tests` repeated before each of its files, so that it takes several."""
    many, found = "--tests", list[str]()
    inside = False
    for word in arguments:
        if word.startswith("-"):
            inside = word == many
            if not inside:
                found.append(word)
        else:
            found += [many, word] if inside else [word]
    return found


def report(
    recordings: Recordings,
    output: Annotated[Path, output("Report to write (.html or .pdf).")],
    settings: FitSettings,
    tests: Annotated[
        list[Path] | None,
        typer.Option(help="Recordings for the evaluation, which are not used in the fit (.uwb). Takes several."),
    ] = None,
    pdf: Annotated[Path | None, typer.Option(help="The same report as PDF (.pdf).")] = None,
    figures: Figures = None,
    trim_static: TrimStatic = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fit a calibration, evaluate it on other recordings, and write a report with tables and figures."""
    check_report(output, figures, pdf=pdf, force=force)
    with waiting("loading") as progress:
        campaign = calib.run_campaign(
            recordings,
            tests or [],
            trim_static=trim_static,
            progress=progress,
            command=command_line(),
            settings=settings,
        )
        campaign.write(output, pdf, figures, force=force, progress=progress)
    if as_json:
        typer.echo(json.dumps(campaign.to_dict(), indent=1))
    else:
        typer.echo("\n".join(f"report: {path}" for path in (output, pdf, figures) if path))
        if tests:  # without tests the report itself states that the training was judged
            _warn_if_fitted(campaign.evaluation)
        findings = [f"{name}: {finding.fault}" for name, finding in campaign.findings]
        for warning in [*campaign.fit.warnings, *findings]:
            warn(warning)
    if not campaign.fit.success:
        raise typer.Exit(STOPPED)


def _remarks(evaluation: calib.evaluation.Evaluation) -> Iterator[str]:
    """Yield the lines below the table: quantiles, spread within and between pairs, coverage, planted values."""
    group = evaluation.overall
    yield (
        f"95 % of the calibrated errors lie between {100 * group.full.low_m:+.1f} and {100 * group.full.high_m:+.1f} cm"
        f"; {100 * group.rejected:.1f} % lie outside the 95 % bounds of sigma (5 % expected without reflections)"
    )
    split = evaluation.split
    yield (
        f"of the calibrated errors, {100 * split.within_m:.1f} cm (standard deviation) are within pairs"
        + (f", {100 * split.between_pairs_m:.1f} cm between pairs" if len(evaluation.pairs) > 1 else "")
        + (f", {100 * split.between_sessions_m:.1f} cm between sessions" if split.sessions > 1 else "")
    )
    covered = ", ".join(f"{100 * share:.1f} % for {name} %" for name, share in group.coverage.items())
    yield f"sigma covers {covered}"
    if group.total_std == group.total_std:
        yield (
            f"with {100 * group.tail_share:.1f} % of reflections expected: errors divided by the total sigma have a "
            f"standard deviation of {group.total_std:.2f}, and {100 * group.inside_95:.1f} % lie between their "
            "quantiles for 95 %"
        )
    planted = evaluation.planted
    if planted:
        rms = (sum(d**2 for d in planted.delay_error_ns.values()) / len(planted.delay_error_ns)) ** 0.5
        curve_cm, whole_cm = 100 * planted.curve_rms_m, 100 * planted.correction_rms_m
        curve = (
            f", bias curve {curve_cm:.2f} cm, whole correction {whole_cm:.2f} cm rms" if curve_cm == curve_cm else ""
        )
        yield f"difference from planted values: delays {rms:.4f} ns rms{curve}"
