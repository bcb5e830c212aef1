"""Commands that say what to measure, and what will come of it: plan survey, plan flight."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from calib.errors import BadInputError
from uwblink.cli.guide import add, choice, epilog
from uwblink.cli.options import AsJson, Figures, Force, Group, output
from uwblink.cli.waiting import waiting
from uwblink.settings import setting

if TYPE_CHECKING:
    import calib


def _numbers(text: str) -> list[float]:
    """Return numbers from a text with commas; raises `BadInputError`."""
    try:
        return [float(part) for part in text.split(",")] if text.strip() else []
    except ValueError:
        raise BadInputError(f"found {text!r:.40}, expected numbers with commas") from None


def _whole(text: str) -> list[int]:
    """Return ids or a count from a text with commas; raises `BadInputError`."""
    found = _numbers(text)
    if not found or not all(math.isfinite(value) and value == int(value) for value in found):
        raise BadInputError(f"found {text!r:.40}, expected whole numbers with commas")
    return [int(value) for value in found]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shared:
    """What plans of both kinds take; None stands for the default of `calib.plan` and `calib.plan_flight`."""

    size_m: list[float] | None = setting(
        None,
        "Length of the line, or sides of plane or room (m).",
        flag="--size",
        kind=str | None,
        parse=_numbers,
        metavar="M,M,M",
    )
    anchors: list[int] | None = setting(
        None,
        "Boards at known positions, which stay there.",
        flag="--anchor-tags",
        kind=str | None,
        parse=_whole,
        metavar="TAG,TAG...",
    )
    taped: int | None = setting(None, "Number of distances that will be measured with a tape.")


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyPlanSettings(_Shared):
    """What `calib plan survey` passes on to `calib.plan`."""

    rate_hz: float | None = setting(
        None, "Exchanges per second, all pairs together (Hz); 50 by default.", flag="--rate"
    )
    tape_sigma_m: float | None = setting(
        None, "Standard deviation of a distance by tape (m); 0.005 by default.", flag="--tape-sigma"
    )
    reflected: float | None = setting(None, "Share of pairs that are reflected; 0 by default.")
    arrangements: int | None = setting(None, "Number of arrangements; by default as many as are worth it.")
    anchor_sigma_m: float | None = setting(
        None, "Standard deviation of known positions (m); 0.01 by default.", flag="--anchor-sigma"
    )
    pair_error_m: float | None = setting(
        None, "Constant error of a pair in an arrangement (m); 0.02 by default.", flag="--pair-error"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlanSettings(_Shared):
    """What `calib plan flight` passes on to `calib.plan_flight`."""

    rate_hz: float | None = setting(
        None, "Exchanges per second, all pairs together (Hz); 80 by default.", flag="--rate"
    )
    tape_sigma_m: float | None = setting(
        None, "Standard deviation of a distance by tape (m); 0.01 by default.", flag="--tape-sigma"
    )
    reflected: float | None = setting(None, "Share of ranges that are reflected; 0.08 by default.")
    seconds: float | None = setting(None, "Duration in seconds; 60 by default.", flag="--duration")
    speed_m_s: float | None = setting(None, "Mean speed of the robots (m/s); 1 by default.", flag="--robot-speed")
    apart_m: float | None = setting(
        None, "Distance between the tags of a robot (m); 0.5 by default.", flag="--tag-spacing"
    )
    poses_until_s: float | None = setting(
        None, "How long positions are known at first; 10 by default.", flag="--poses-until", metavar="SECONDS"
    )
    attitudes: str | None = setting(
        None,
        "Source of attitudes: poses (an attitude reference, the default), the IMU, or none.",
        names=("poses", "imu", "none"),
    )
    heading_std_deg: float | None = setting(
        None,
        "Standard deviation of headings; 0: headings are exact; 3 by default.",
        flag="--heading-std",
        metavar="DEGREES",
    )
    imu: str | None = setting(
        None, "Grade of the robots' inertial sensors.", names=("consumer", "industrial", "tactical")
    )
    anchor_places: str | None = setting(
        None,
        "Positions of anchors: given (the default), or sought (estimated).",
        flag="--anchors",
        names=("given", "sought"),
    )
    still_s: float | None = setting(
        None, "How long the robots stand before they fly, for a tape.", flag="--standstill", metavar="SECONDS"
    )
    noise_m: float | None = setting(None, "Noise of a range (m); 0.04 by default.", flag="--range-noise")
    delays_only: bool = setting(False, "Plan for a fit without a curve over power.")


PlanPage = Annotated[Path | None, output("Plan to write (.html or .pdf).")]
Ports = Annotated[str, typer.Option(help="Serial ports of the boards, for the printed commands, as in 'ports/*'.")]


class _PlanGroup(Group):
    moved = "calib plan is now calib plan survey (boards that stand still) and calib plan flight (--on flight)"


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    plans = typer.Typer(
        cls=_PlanGroup,
        help="Plan a calibration without true distances: what to do, and how well delays will be known.",
        epilog=epilog("calib plan survey 4 --on line", "calib plan flight 1,2/3,4/5,6 --duration 60"),
        no_args_is_help=True,
    )
    app.add_typer(plans, name="plan", rich_help_panel="Calibrate")
    renamed = {"--seconds": "--duration", "--speed": "--robot-speed", "--apart": "--tag-spacing"}
    renamed |= {"--still": "--standstill", "--noise": "--range-noise", "--anchor-places": "--anchors"}
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
        renamed=renamed,
    )


def survey(
    boards: Annotated[str, typer.Argument(metavar="COUNT|TAG,TAG...", help="Number of boards, or their ids.")],
    settings: SurveyPlanSettings,
    on: Annotated[
        str,
        typer.Option(
            help="Where the boards stand: on a string (line), on a table (plane), or in a room (space).",
            **choice("line", "plane", "space"),
        ),
    ] = "line",
    output: PlanPage = None,
    figures: Figures = None,
    ports: Ports = "PORTS",
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Plan arrangements of boards that stand still: the steps, and how well each delay will be known."""
    import calib
    from calib.planning import survey_commands

    _check_places(output, figures, force=force)
    if boards.endswith(".uwb"):
        raise BadInputError("a recording is planned from with `calib plan flight`", parameter="boards")
    tags = _ids(boards, "boards")
    with waiting("planning"):
        found = calib.plan(tags if "," in boards else tags[0], on=on, **_given(settings))
    _finish(found, survey_commands(found, ports), output, figures, as_json=as_json, force=force)


def flight(
    robots: Annotated[
        str,
        typer.Argument(
            metavar="COUNT|TAG,TAG/...|FILE",
            help="Number of robots with two tags each, tags by robot (1,2/3,4), or a recording whose motion is taken "
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
    """Plan a flight without true distances: the steps, and how well each delay will be known."""
    import calib
    from calib.planning import flight_commands

    _check_places(output, figures, force=force)
    given = _given(settings)
    who: Any = Path(robots)
    if robots.endswith(".uwb"):
        for name in ("seconds", "rate_hz", "size_m", "speed_m_s", "apart_m", "anchors"):
            if name in given:
                raise BadInputError("the recording determines it; leave it out", parameter=name)
    elif "/" not in robots and "," not in robots:
        who = _ids(robots, "robots")[0]
    else:
        who = [_ids(robot, "robots") for robot in robots.split("/")]
    with waiting("planning"):
        found = calib.plan_flight(who, **given)
    _finish(found, flight_commands(found, ports, robots), output, figures, as_json=as_json, force=force)


def _given(settings: _Shared) -> dict[str, Any]:
    """Return the settings that were given, by name."""
    values = {one.name: getattr(settings, one.name) for one in fields(settings)}
    return {name: value for name, value in values.items() if value is not None}


def _ids(text: str, parameter: str) -> list[int]:
    try:
        return _whole(text)
    except BadInputError as error:
        raise BadInputError(str(error), parameter=parameter) from None


def _check_places(output: Path | None, figures: Path | None, *, force: bool) -> None:
    if output or figures:
        from calib.report import check_places

        check_places(output, None, figures, force=force)


def _finish(
    found: calib.Plan | calib.FlightPlan,
    following: Iterable[str],
    output: Path | None,
    figures: Path | None,
    *,
    as_json: bool,
    force: bool,
) -> None:
    """Write the page and the figures, and print the plan and the commands that follow it."""
    commands = list(following)
    if output or figures:
        from calib.report import write_plan

        write_plan(found, output, figures, commands=commands, force=force)
    if as_json:
        typer.echo(json.dumps(found.to_dict(), indent=1))
        return
    typer.echo(str(found))
    typer.echo("\nCommands, one after the other:")
    for line in commands:
        typer.echo(f"  {line}")
