"""The command that calibrates without true distances: survey."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from calib.cli.arguments import AsJson, DelaysOnly, Fix, Force, NewCalibration
from calib.cli.flags import with_flags
from uwblink.cli.guide import add
from uwblink.cli.waiting import waiting

if TYPE_CHECKING:
    import calib

PANEL: Final = "Calibrate"


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    add(
        app,
        survey,
        "calib survey string.uwb -o delays.json --known line",
        "calib survey a.uwb b.uwb c.uwb -o delays.json --known known.toml",
        "calib survey room.uwb -o delays.json --known known.toml --anchors anchors.yaml",
        panel=PANEL,
    )


def survey(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings of boards that stand still (.uwb).")],
    output: NewCalibration,
    known: Annotated[
        str,
        typer.Option(
            metavar="line|plane|FILE",
            help="What is known of the arrangements: all on a line, all on a plane, or a file that says more (.toml).",
        ),
    ] = "",
    anchors: Annotated[
        Path | None, typer.Option(help="Where boards stood, to write: \\[\\[anchors]] (.toml) or for ROS (.yaml).")
    ] = None,
    arrangement: Annotated[str | None, typer.Option(help="The arrangement that --anchors writes.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Picture of where boards stood, to write (.svg, .png or .pdf).")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Report to write: verdict, what it rests on, places (.html or .pdf).")
    ] = None,
    fix: Fix = None,
    pair_error: Annotated[
        float | None, typer.Option(help="Constant error of a pair in an arrangement (m); by default estimated.")
    ] = None,
    delays_only: DelaysOnly = False,
    curve_from: Annotated[
        Path | None, typer.Option(help="Calibration whose curve over power is taken over (.json).")
    ] = None,
    regardless: Annotated[
        bool, typer.Option("--regardless", help="Survey even where ranges contradict what is said to be known.")
    ] = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Calibrate without true distances: boards that stand still, in arrangements of which little is known."""
    import calib
    from calib.cli.options import fixed_ns
    from uwblink.output import check_apart, check_output

    written = {"output": output, "anchors": anchors, "plot": plot, "report": report}
    for path in filter(None, written.values()):
        check_output(path, force=force)
    check_apart(
        written, [*recordings, *([Path(known)] if known.endswith(".toml") else []), *filter(None, [curve_from])]
    )
    try:
        with waiting("surveying"):
            result = calib.survey(
                recordings,
                known=known,
                fixed_ns=fixed_ns(fix or ()),
                pair_error_m=pair_error,
                delays_only=delays_only,
                curve_from=curve_from,
                regardless=regardless,
            )
        if anchors:
            result.save_anchors(anchors, arrangement=arrangement, force=force)
        if plot:
            result.save_picture(plot, force=force)
    except calib.UnanswerableError as error:
        if as_json:
            typer.echo(json.dumps({"error": with_flags(str(error)), "undetermined": error.undetermined}, indent=1))
        raise
    result.save(output, force=force)
    if report:
        _write_report(report, result, recordings, force=force)
    if as_json:
        typer.echo(json.dumps(_figures(result), indent=1))
        return
    typer.echo(f"{output}: {result.headline()}")
    boards = f"boards of {result.arrangement(arrangement).name}" if anchors else ""
    _tell(
        result,
        {boards: anchors, "where boards stood, with ellipses of 95 %": plot, "whether it is fit for use": report},
    )


def _tell(result: calib.SurveyResult, written: dict[str, Path | None]) -> None:
    for line in _lines(result):
        typer.echo(line)
    for what, path in written.items():
        if path:
            typer.echo(f"{path}: {what}")
    for warning in result.warnings:
        typer.echo(f"warning: {with_flags(warning)}", err=True)


def _write_report(path: Path, result: calib.SurveyResult, recordings: list[Path], *, force: bool) -> None:
    from calib.cli.evaluating import command_line
    from calib.report import origin_of, write_survey_report

    write_survey_report(path, result.calibration, origin=origin_of(recordings, command_line()), force=force)


def _lines(result: calib.SurveyResult) -> Iterator[str]:
    from calib.cli.fitting import delay_lines

    yield from delay_lines(result.calibration)
    for one in result.arrangements:
        shape = f", on a {one.known}" if one.known else ""
        yield f"  arrangement {one.name}{shape}: {one.frame}"
        for board in one.boards:
            place = "  ".join(f"{value:+8.3f}" for value in board.position_m)
            half = 196 * math.sqrt(max(float(board.covariance_m2.trace()), 0.0))
            known = f"± {half:.1f} cm (95 %)" if board.determined else "undetermined"
            yield f"    tag {board.tag:3d}  {place} m  {known}"


def _figures(result: calib.SurveyResult) -> dict[str, Any]:
    return {
        "calibration": json.loads(result.calibration.to_json()),
        "arrangements": [one.to_dict() for one in result.arrangements],
        "pair_error_m": result.pair_error_m,
        "findings": list(result.findings),
        "reflected": [one.to_dict() for one in result.reflected],
        "warnings": [with_flags(text) for text in result.warnings],
    }
