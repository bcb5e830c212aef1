"""Commands that plan measurements: plan survey, plan flight."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

import calib
from calib.cli.shared import check_report, refuse_given
from calib.errors import BadInputError
from calib.planning import FlightPlanSettings, SurveyPlanSettings, read_whole
from uwblink.cli.shared import AsJson, Figures, Force, Group, add, epilog, output, waiting

PlanPage = Annotated[Path | None, output("Plan to write (.html or .pdf).")]
Ports = Annotated[str, typer.Option(help="Serial ports of the boards, for the printed commands, as in 'ports/*'.")]


class _PlanGroup(Group):
    moved = "calib plan is now calib plan survey (boards that stand still) and calib plan flight (--on flight)"


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    plans = typer.Typer(
        cls=_PlanGroup,
        help="Plan a calibration without true distances: its steps, and the expected accuracy of the delays.",
        epilog=epilog("calib plan survey 4 --on line", "calib plan flight 1,2/3,4/5,6 --duration 60"),
        no_args_is_help=True,
    )
    app.add_typer(plans, name="plan", rich_help_panel="Calibrate")
    add(
        plans,
        survey,
        "calib plan survey 4 --on line",
        "calib plan survey 6 --on plane --size 3,2 --arrangements 8 --taped 2 -o plan.html",
        "calib plan survey 1,2,3,4,5,6 --on space --anchor-tags 1,2,3,4",
        renamed={"--anchors": "--anchor-tags"},
    )
    add(
        plans,
        flight,
        "calib plan flight 1,2/3,4/5,6 --duration 60 --poses-until 10",
        "calib plan flight simulated.uwb --poses-until 0 --imu consumer",
        renamed={
            "--seconds": "--duration",
            "--speed": "--robot-speed",
            "--apart": "--tag-spacing",
            "--still": "--standstill",
            "--noise": "--range-noise",
            "--anchor-places": "--anchors",
        },
    )


def survey(
    boards: Annotated[str, typer.Argument(metavar="COUNT|TAG,TAG...", help="Number of boards, or their ids.")],
    settings: SurveyPlanSettings,
    output: PlanPage = None,
    figures: Figures = None,
    ports: Ports = "PORTS",
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Plan arrangements of boards that stand still: the steps, and the expected accuracy of each delay."""
    check_report(output, figures, force=force)
    if boards.endswith(".uwb"):
        raise BadInputError("a plan that starts from a recording needs `calib plan flight`", parameter="boards")
    tags = read_whole(boards, "boards")
    with waiting("planning"):
        found = calib.plan(tags if "," in boards else tags[0], settings)
    _finish(found, found.commands(ports), output, figures, as_json=as_json, force=force)


def flight(
    context: typer.Context,
    robots: Annotated[
        str,
        typer.Argument(
            metavar="COUNT|TAG,TAG/...|FILE",
            help="Number of robots with two tags each, tags by robot (1,2/3,4), or a recording whose motion is used "
            "(.uwb).",
        ),
    ],
    settings: FlightPlanSettings,
    output: PlanPage = None,
    figures: Figures = None,
    ports: Ports = "PORTS",
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Plan a flight without true distances: the steps, and the expected accuracy of each delay."""
    check_report(output, figures, force=force)
    who: Any = Path(robots)
    if robots.endswith(".uwb"):
        recorded = ("seconds", "rate_hz", "size_m", "speed_m_s", "apart_m", "anchors")
        refuse_given(context, recorded, "is determined by the recording; remove this option")
    else:
        tags = [read_whole(robot, "robots") for robot in robots.split("/")]
        who = tags if "/" in robots or "," in robots else tags[0][0]
    with waiting("planning"):
        found = calib.plan_flight(who, settings)
    recording = robots if isinstance(who, Path) else ""
    _finish(found, found.commands(ports, recording), output, figures, as_json=as_json, force=force)


def _finish(
    found: calib.Plan | calib.FlightPlan,
    following: Iterable[str],
    output: Path | None,
    figures: Path | None,
    *,
    as_json: bool,
    force: bool,
) -> None:
    """Write the page and the figures; print the plan, and the commands that carry it out."""
    commands = list(following)
    if output or figures:
        calib.report.write_plan(found, output, figures, commands=commands, force=force)
    text = "\n".join([str(found), "", "Commands, one after the other:", *(f"  {line}" for line in commands)])
    typer.echo(json.dumps(found.to_dict(), indent=1) if as_json else text)
