"""Commands that make and show calibrations: fit, add-tag, survey, show, sample."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import typer

import calib
from calib.cli.shared import (
    STOPPED,
    NewCalibration,
    Recordings,
    TrimStatic,
    command_line,
    known_calibration,
    warn,
    with_flags,
)
from calib.errors import BadInputError, UnanswerableError
from calib.settings import FitSettings, FlightSettings, SurveySettings, check_choice
from uwblink.cli.shared import (
    AsJson,
    CalibrationFile,
    Force,
    Plot,
    ReportFile,
    Seed,
    add,
    choice,
    count,
    output,
    tags_of,
    waiting,
)
from uwblink.output import check_apart, check_output


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    panel = "Calibrate"
    add(
        app,
        fit,
        "calib fit flight.uwb -o calibration.json",
        "calib fit monday.uwb tuesday.uwb -o both.json --fix 1=-0.36",
        "calib fit ranges.uwb -o delays.json --delays-only",
        "calib fit flight.uwb -o found.json --truth ranges --poses-until 10",
        panel=panel,
    )
    add(app, add_tag, "calib add-tag new.uwb -c calibration.json --tag 7 -o seven.json", panel=panel, name="add-tag")
    add(
        app,
        survey,
        "calib survey string.uwb -o delays.json --known line",
        "calib survey a.uwb b.uwb c.uwb -o delays.json --known known.toml",
        "calib survey room.uwb -o delays.json --known known.toml --save-anchors anchors.yaml",
        panel=panel,
        renamed={"--anchors": "--save-anchors", "--arrangement": "a part of --save-anchors NAME=FILE"},
    )
    add(app, show, "calib show calibration.json", panel=panel)
    add(
        app,
        sample,
        "calib sample -o sample.uwb",
        "calib sample -o other.uwb --seed 2",
        panel=panel,
        renamed={"--anchors": "--with-anchors"},
    )


def fit(
    recordings: Recordings,
    output: NewCalibration,
    *,
    settings: FitSettings,
    truth: Annotated[
        str,
        typer.Option(
            rich_help_panel="Without known distances (--truth ranges)",
            help="Source of true distances. recorded: poses or measured distances; ranges: none, distances are "
            "estimated together with the delays.",
            **choice("recorded", "ranges"),
        ),
    ] = "recorded",
    flight: FlightSettings,
    trim_static: TrimStatic = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fit the tags' antenna delays (ns) and the curves of bias and standard deviation over first-path power (m)."""
    check_choice("truth", truth, ("recorded", "ranges"))
    if truth == "recorded":
        for name in flight.changed():
            raise BadInputError("can only be used if `truth` is ranges", parameter=name)
    check_output(output, force=force)
    with _undetermined_as_json(as_json):
        if truth == "ranges":
            result = _fit_from_ranges(recordings, flight, settings, trim_static=trim_static)
        else:
            with waiting("fitting"):
                ranges = calib.load_ranges(
                    recordings, trim_static=trim_static, need_power=not settings.delays_only, use=settings.use
                )
                result = calib.fit(ranges, settings)
    result.save(output, force=force)
    _print_fit(result, output, as_json=as_json)


def _print_fit(result: calib.FitResult, output: Path, *, as_json: bool) -> None:
    """Print the result of a fit and its warnings; exit with status 1 if the fit stopped before it converged."""
    found, left_out = result.calibration, result.ranges.excluded.items()
    if as_json:
        typer.echo(found.to_json(), nl=False)
    else:
        heard = found.provenance.get("arrivals")
        also = f", {heard} differences of arrival" if heard else ""
        used = f"{found.provenance['exchanges']} exchanges{also}"
        typer.echo(f"{output}: {used}, {result.message}, scale {found.scale_ns:.3f} ns")
        lines = [*delay_lines(found), *(f"  left out: {number} exchanges, {reason}" for reason, number in left_out)]
        typer.echo("\n".join(filter(str.strip, [*lines, f"  {calib.calibration.held_out_line(found)}"])))
        for warning in result.warnings:
            warn(warning)
    if not result.success:
        raise typer.Exit(STOPPED)


@contextmanager
def _undetermined_as_json(as_json: bool) -> Iterator[None]:
    """Print an `UnanswerableError` as JSON, too, if JSON was requested."""
    try:
        yield
    except UnanswerableError as error:
        if as_json:
            typer.echo(json.dumps({"error": with_flags(str(error)), "undetermined": error.undetermined}, indent=1))
        raise


def _fit_from_ranges(
    recordings: Sequence[Path], flight: FlightSettings, settings: FitSettings, *, trim_static: bool
) -> calib.FitResult:
    """Fit without known distances; raises `BadInputError` for settings that need them."""
    if len(recordings) != 1:
        raise BadInputError("ranges needs exactly one recording, of one flight", parameter="truth")
    if trim_static:
        raise BadInputError("can only be used with known distances", parameter="trim_static")
    with waiting(recordings[0].name) as report:
        return calib.fit_from_ranges(recordings[0], flight, settings, progress=report)


def delay_lines(found: calib.Calibration) -> list[str]:
    """Return a line per pair with a constant, per tag, per pattern and per slope, each with its 95 % interval."""
    tables = calib.calibration
    lines = [f"  pair {pair:>7}  ranges {cm} cm too long  {interval}" for pair, cm, interval in tables.pair_rows(found)]
    lines += [f"  tag {tag:>3}  delay {value} ns  {interval}" for tag, value, interval in tables.delay_rows(found)]
    lines += [f"  tags {tags}  {rms} cm rms over direction, {most}" for tags, rms, most in tables.pattern_rows(found)]
    slopes = tables.temperature_rows(found)
    return lines + [f"  tags {tags}  {slope} over temperature, {more}" for tags, slope, more in slopes]


def add_tag(
    recording: Annotated[Path, typer.Argument(help="Recording of the new tag with calibrated tags (.uwb).")],
    calibration: CalibrationFile,
    tag: Annotated[int, typer.Option(help="Id of the tag to add.", autocompletion=tags_of())],
    output: NewCalibration,
    force: Force = False,
) -> None:
    """Fit the delay of one new tag from its ranges with calibrated tags; all other values stay the same."""
    check_output(output, force=force)
    with waiting("fitting"):
        result = calib.add_tag(recording, known_calibration(calibration), tag)
    result.save(output, force=force)
    _print_fit(result, output, as_json=False)


def survey(
    recordings: Annotated[list[Path], typer.Argument(help="Recordings of boards that stand still (.uwb).")],
    output: NewCalibration,
    settings: SurveySettings,
    save_anchors: Annotated[
        str | None,
        typer.Option(
            metavar="[NAME=]FILE",
            help="File for the positions of the boards; if there are several arrangements, NAME is the one to save: "
            "\\[\\[anchors]] (.toml) or for ROS (.yaml).",
        ),
    ] = None,
    plot: Plot = None,
    report: ReportFile = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Calibrate without true distances, from boards that stand still in one or more arrangements."""
    arrangement, anchors = _named_file(save_anchors)
    written = {"output": output, "save_anchors": anchors, "plot": plot, "report": report}
    for path in filter(None, written.values()):
        check_output(path, force=force)
    files = [Path(settings.known)] if settings.known.endswith(".toml") else []
    read = [*recordings, *files, *filter(None, [settings.curve_from])]
    check_apart(written, read)
    with _undetermined_as_json(as_json):
        with waiting("surveying"):
            result = calib.survey(recordings, settings)
        if anchors:
            result.save_anchors(anchors, arrangement=arrangement, force=force)
        if plot:
            result.save_picture(plot, force=force)
    result.save(output, force=force)
    if report:
        origin = calib.report.origin_of(recordings, command_line())
        calib.report.write_survey_report(report, result.calibration, origin=origin, force=force)
    if as_json:
        typer.echo(json.dumps(_survey_figures(result), indent=1))
        return
    contents = {
        output: result.headline(),
        anchors: f"positions of the boards of {result.arrangement(arrangement).name}" if anchors else "",
        plot: "positions of the boards with ellipses of 95 %",
        report: "verdict",
    }
    headline, *others = [f"{file}: {what}" for file, what in contents.items() if file]
    lines = [*delay_lines(result.calibration), *_arrangement_lines(result)]
    typer.echo("\n".join([headline, *lines, *others]))
    for warning in result.warnings:
        warn(warning)


def _named_file(text: str | None) -> tuple[str | None, Path | None]:
    """Return the name before a file, if there is one, and the file: "NAME=FILE" or "FILE"."""
    name, equals, path = (text or "").rpartition("=")
    return (name if equals else None), (Path(path) if path else None)


def _arrangement_lines(result: calib.SurveyResult) -> Iterator[str]:
    for one in result.arrangements:
        shape = f", on a {one.known}" if one.known else ""
        yield f"  arrangement {one.name}{shape}: {one.frame}"
        for board in one.boards:
            place = "  ".join(f"{value:+8.3f}" for value in board.position_m)
            known = f"± {100 * board.within_m:.1f} cm (95 %)" if board.determined else "undetermined"
            yield f"    tag {board.tag:3d}  {place} m  {known}"


def _survey_figures(result: calib.SurveyResult) -> dict[str, Any]:
    return {
        "calibration": json.loads(result.calibration.to_json()),
        "arrangements": [one.to_dict() for one in result.arrangements],
        "pair_error_m": result.pair_error_m,
        "findings": [asdict(one) for one in result.findings],
        "reflected": [one.to_dict() for one in result.reflected],
        "warnings": [with_flags(text) for text in result.warnings],
    }


def show(
    calibration: Annotated[Path, typer.Argument(help="Calibration to show (.json).")], as_json: AsJson = False
) -> None:
    """Print a calibration: delays, curves, the data of its fit, and its limits."""
    known = calib.load_calibration(calibration)
    if as_json:
        typer.echo(known.to_json(), nl=False)
        return
    provenance, distances = known.provenance, calib.calibration.known_facts(known.provenance)
    shown = {name: provenance.get(name) for name in ("fitted", "gauge", "recordings", "settings")}
    lines = [
        *(f"{name}: {_listed(value)}" for name, value in shown.items() if value),
        *([f"distances: {distances}"] if distances else _survey_lines(provenance.get("geometry"))),
        *([f"age: {age}"] if (age := calib.calibration.age_line(known)) else []),
    ]
    warnings = (f"warning: {with_flags(text)}" for text in calib.calibration.warnings_of(known))
    typer.echo("\n".join([repr(known), *(f"  {line}" for line in lines), *warnings]))


def _listed(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} = {one}" for name, one in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _survey_lines(facts: object) -> Iterator[str]:
    """Yield lines on the known facts of a survey: arrangements by known shape, known distances and positions."""
    if not isinstance(facts, dict):
        return
    listed = facts.get("arrangements")
    rows = [row for row in listed if isinstance(row, dict)] if isinstance(listed, list) else []
    for shape in dict.fromkeys(str(row.get("known", "")) for row in rows):
        names = ", ".join(str(row.get("name")) for row in rows if row.get("known", "") == shape)
        yield f"arrangements: {names}{f', on a {shape}' if shape else ''}"
    distances, positions = facts.get("known_distances", 0), facts.get("known_positions", 0)
    yield f"known: {distances} distances and {positions} positions"


def sample(
    output: Annotated[Path, output("Recording to write (.uwb).")],
    count: Annotated[int, count("Number of exchanges, 100 per second.", min=3, max=1_000_000)] = 3000,
    seed: Seed = 1,
    with_anchors: Annotated[bool, typer.Option("--with-anchors", help="One moving tag and four anchors.")] = False,
    force: Force = False,
) -> None:
    """Write a small example flight with known delays, without the simulator."""
    check_output(output, force=force, recording=True)
    seed = 1 if seed is None else seed
    flight = calib.sample_flight(count, seed=seed, anchors=with_anchors)
    meta = {"planted": flight.meta["planted"], "source": "sample", "seed": seed}
    replace(flight, meta=meta).save(output, force=force)
    typer.echo(f"{output}: {count} exchanges of tags {', '.join(str(tag.tag) for tag in flight.tags)}, known delays")
