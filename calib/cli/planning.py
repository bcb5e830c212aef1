"""The command that says what to measure where nobody measured distances, and what will come of it: plan."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from calib.cli.arguments import AsJson, Figures, Force
from calib.errors import BadInputError
from uwblink.cli.guide import add, choice
from uwblink.cli.waiting import waiting

if TYPE_CHECKING:
    import calib

PANEL: Final = "Calibrate"
STANDING: Final = "Boards that stand still"
FLYING: Final = "Flights (--on flight)"
FLIGHT: Final = "flight"
KINDS: Final = ("line", "plane", "space", FLIGHT)


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    add(
        app,
        plan,
        "calib plan 4 --on line",
        "calib plan 6 --on plane --size 3,2 --arrangements 8 --taped 2 -o plan.html",
        "calib plan 1,2,3,4,5,6 --on space --anchors 1,2,3,4",
        "calib plan 1,2/3,4/5,6 --on flight --seconds 60 --poses-until 10",
        "calib plan simulated.uwb --on flight --poses-until 0 --imu consumer",
        panel=PANEL,
    )


def plan(
    boards: Annotated[
        str,
        typer.Argument(
            metavar="COUNT|TAG,TAG...",
            help="How many boards, or their ids; of a flight how many robots, tags by robot (1,2/3,4), or a recording.",
        ),
    ],
    on: Annotated[
        str,
        typer.Option(
            help="A string (line), a table (plane), a room (space), or robots that move (flight).",
            **choice(*KINDS),
        ),
    ] = "line",
    size: Annotated[
        str | None, typer.Option(metavar="M,M,M", help="Length of the string, or sides of table or room (m).")
    ] = None,
    anchors: Annotated[
        str | None, typer.Option(metavar="TAG,TAG...", help="Boards that stay where they are, at known places.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Exchanges a second of all together; 50 by default, 80 of a flight.")
    ] = None,
    taped: Annotated[int | None, typer.Option(help="How many distances will be measured with a tape.")] = None,
    tape_sigma: Annotated[
        float | None,
        typer.Option(help="Standard deviation of such a distance (m); 0.005 by default, 0.01 of a flight."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The plan as a page to write (.html or .pdf).")
    ] = None,
    figures: Figures = None,
    arrangements: Annotated[
        int | None,
        typer.Option(rich_help_panel=STANDING, help="How many arrangements; by default as many as are worth it."),
    ] = None,
    anchor_sigma: Annotated[
        float | None,
        typer.Option(rich_help_panel=STANDING, help="How well places of anchors are known (m); 0.01 by default."),
    ] = None,
    pair_error: Annotated[
        float | None,
        typer.Option(rich_help_panel=STANDING, help="Constant error of a pair in an arrangement (m); 0.02 by default."),
    ] = None,
    reflected: Annotated[
        float | None,
        typer.Option(help="Share of pairs that are reflected, of a flight of ranges; 0 by default, 0.08 of a flight."),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(rich_help_panel=FLYING, help="How long robots fly; 60 by default.")
    ] = None,
    speed: Annotated[
        float | None, typer.Option(rich_help_panel=FLYING, help="About how fast (m/s); 1 by default.")
    ] = None,
    apart: Annotated[
        float | None,
        typer.Option(rich_help_panel=FLYING, help="Distance of the tags of one robot (m); 0.5 by default."),
    ] = None,
    poses_until: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", rich_help_panel=FLYING, help="How long positions are known at first; 10 by default."
        ),
    ] = None,
    attitudes: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=FLYING,
            help="Where attitudes come from: poses (an attitude reference, the default), or imu.",
            **choice("poses", "imu", "none"),
        ),
    ] = None,
    heading_std: Annotated[
        float | None,
        typer.Option(
            metavar="DEGREES", rich_help_panel=FLYING, help="What headings may be off by; 3 by default, 0: nothing."
        ),
    ] = None,
    imu: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=FLYING,
            help="Robots have inertial sensors of a grade: consumer, industrial or tactical.",
            **choice("consumer", "industrial", "tactical"),
        ),
    ] = None,
    anchor_places: Annotated[
        str | None,
        typer.Option(
            rich_help_panel=FLYING,
            help="Places of anchors: given (the default), or sought along.",
            **choice("given", "sought"),
        ),
    ] = None,
    still: Annotated[
        float | None,
        typer.Option(
            metavar="SECONDS", rich_help_panel=FLYING, help="How long robots stand before they fly, for a tape."
        ),
    ] = None,
    noise: Annotated[
        float | None, typer.Option(rich_help_panel=FLYING, help="Noise of a range (m); 0.04 by default.")
    ] = None,
    delays_only: Annotated[
        bool, typer.Option("--delays-only", rich_help_panel=FLYING, help="No curve over power will be fitted.")
    ] = False,
    ports: Annotated[
        str, typer.Option(help="How the boards' serial ports are called in the commands, as in 'ports/*'.")
    ] = "PORTS",
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Say how to calibrate without true distances: what to do step by step, and how well delays will be known."""
    shared = {
        "size_m": None if size is None else _numbers(size, "size_m"),
        "anchors": None if anchors is None else _whole(anchors, "anchors"),
        "rate_hz": rate,
        "taped": taped,
        "tape_sigma_m": tape_sigma,
        "reflected": reflected,
    }
    standing = {
        "arrangements": arrangements,
        "anchor_sigma_m": anchor_sigma,
        "pair_error_m": pair_error,
    }
    flying = {
        "seconds": seconds,
        "speed_m_s": speed,
        "apart_m": apart,
        "poses_until_s": poses_until,
        "attitudes": attitudes,
        "heading_std_deg": heading_std,
        "imu": imu,
        "anchor_places": anchor_places,
        "still_s": still,
        "noise_m": noise,
        "delays_only": delays_only or None,
    }
    if output or figures:
        from calib.report import check_places

        check_places(output, None, figures, force=force)
    if on not in KINDS:
        raise BadInputError(f"found {on!r:.40}, allowed: {', '.join(KINDS)}", parameter="on")
    if on == FLIGHT:
        found: calib.Plan | calib.FlightPlan = _of_flight(boards, _given(shared | flying, standing, "boards stand"))
    else:
        found = _of_boards(boards, on, _given(shared | standing, flying, "robots fly"))
    if output or figures:
        from calib.report import write_plan

        write_plan(found, output, figures, commands=list(_commands(found, boards, ports)), force=force)
    _print(found, list(_commands(found, boards, ports)), as_json=as_json)


def _given(used: Mapping[str, Any], others: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the settings that were given; raises `BadInputError` for one of `others`."""
    for name, value in others.items():
        if value is not None:
            raise BadInputError(f"goes with plans in which {where} (`on` says which)", parameter=name)
    return {name: value for name, value in used.items() if value is not None}


def _of_boards(boards: str, on: str, settings: dict[str, Any]) -> calib.Plan:
    import calib

    if boards.endswith(".uwb"):
        raise BadInputError("a recording goes with plans in which robots fly (`on` flight)", parameter="boards")
    tags = _whole(boards, "boards")
    with waiting("planning"):
        return calib.plan(tags if "," in boards else tags[0], on=on, **settings)


def _of_flight(boards: str, settings: dict[str, Any]) -> calib.FlightPlan:
    import calib

    with waiting("planning"):
        return calib.plan_flight(_robots(boards, settings), **settings)


def _robots(boards: str, settings: Mapping[str, Any]) -> Any:
    if boards.endswith(".uwb"):
        for name in ("seconds", "rate_hz", "size_m", "speed_m_s", "apart_m", "anchors"):
            if name in settings:
                raise BadInputError("is what the recording says", parameter=name)
        return Path(boards)
    if "/" not in boards and "," not in boards:
        return _whole(boards, "robots")[0]
    return [_whole(robot, "robots") for robot in boards.split("/")]


def _print(found: calib.Plan | calib.FlightPlan, commands: list[str], *, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(found.to_dict(), indent=1))
        return
    typer.echo(str(found))
    typer.echo("\nCommands, one after the other:")
    for line in commands:
        typer.echo(f"  {line}")


def _commands(found: calib.Plan | calib.FlightPlan, boards: str, ports: str) -> Iterator[str]:
    """Yield the commands that follow the steps, a line each."""
    import calib

    if isinstance(found, calib.FlightPlan):
        yield from _flight_commands(found, boards, ports)
        return
    for one in found.arrangements:
        shape = f" --known {found.on}" if found.on else ""
        shape += f" --order {','.join(map(str, one.order()))}" if found.on == "line" else ""
        words = f"--pairs all --rate {found.rate_hz:g} --duration {found.seconds_each:.0f} -o {one.name}.uwb"
        yield f"uwblink record {ports} --arrangement {one.name}{shape} {words}"
    beside = " --known known.toml" if found.known_beside else ""
    yield f"calib survey {' '.join(f'{one.name}.uwb' for one in found.arrangements)}{beside} -o calibration.json"


def _flight_commands(found: calib.FlightPlan, boards: str, ports: str) -> Iterator[str]:
    name = "flight.uwb"
    if found.flown is None:
        name = boards
    else:
        yield f"uwblink record {ports} --pairs all --duration {found.seconds:.0f} -o {name}"
        yield f"uwblink poses {name} --from poses.csv --tags robots.toml"
    usable = found.usable
    words = [f"--poses-until {usable.poses_until_s:g}"]
    words += [f"--attitudes {usable.attitudes}"] if usable.attitudes != "poses" else []
    words += [f"--heading-std {usable.heading_std_deg:g}"] if usable.heading_std_deg != 3 else []
    words += [f"--anchors {usable.anchors}"] if found.stands else []
    when = f"@0..{found.still_s:g}" if found.still_s else ""
    words += [f"--distance {first}-{second}=METRES{when}" for first, second in found.taped]
    yield f"calib fit {name} --truth ranges {' '.join(words)} -o calibration.json"


def _whole(text: str, parameter: str) -> list[int]:
    """Return ids or a count from a text with commas; raises `BadInputError`."""
    found = _numbers(text, parameter)
    if not found or not all(math.isfinite(value) and value == int(value) for value in found):
        raise BadInputError(f"found {text!r:.40}, expected whole numbers with commas", parameter=parameter)
    return [int(value) for value in found]


def _numbers(text: str, parameter: str) -> list[float]:
    """Return numbers from a text with commas; raises `BadInputError`."""
    try:
        return [float(part) for part in text.split(",")] if text.strip() else []
    except ValueError:
        raise BadInputError(f"found {text!r:.40}, expected numbers with commas", parameter=parameter) from None
