"""The commands of one scenario (run, serve, show, validate, schema, scenarios), and the list of all commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Final

import typer

import uwbsim
from uwblink.cli import guide
from uwblink.cli.guide import AntennaDelays, AsJson, Duration, Force, LinkDir, Seed, add
from uwblink.cli.shared import interrupts, new_app, print_json, waiting
from uwblink.output import check_output
from uwbsim.cli import workbench
from uwbsim.cli.arguments import AllowFiles, Overrides, ScenarioFile, progress, shipped


def run(
    scenario: ScenarioFile,
    output: Annotated[Path, guide.output("Recording to write (.uwb).")],
    seed: Seed = None,
    overrides: Overrides = None,
    allow_files: AllowFiles = None,
    antenna_delays: AntennaDelays = None,
    wire: Annotated[
        bool, typer.Option("--through-wire", help="Encode and decode every report, and record the bytes.")
    ] = False,
    contention: Annotated[
        bool,
        typer.Option(help="Simulate collisions of exchanges; without, none disturbs another, and it is faster."),
    ] = True,
    force: Force = False,
) -> None:
    """Simulate a scenario and write what its boards and motion capture record."""
    check_output(output, force=force, recording=True)
    loaded = _programmed(uwbsim.load(scenario, overrides or (), seed, allow_files=allow_files or ()), antenna_delays)
    with progress(loaded.run.name) as report:
        simulated = uwbsim.simulate(loaded, report, contention=contention)
    frames: list[Any] = []
    if wire:
        simulated, frames = uwbsim.through_wire(simulated)
    simulated.save(output, frames=frames, force=force)
    typer.echo(
        f"{output}: {len(simulated.exchanges)} exchanges of {len(loaded.tags)} tags in "
        f"{len(loaded.pairs())} pairs, {loaded.run.duration_s:g} s, "
        f"{len(simulated.faults)} failed"
    )


def _programmed(scenario: uwbsim.Scenario, path: Path | None) -> uwbsim.Scenario:
    """Return a scenario with the antenna delays of a file programmed into its tags."""
    from uwbsim.scenario import with_antenna_delays

    if path is None:
        return scenario
    return scenario.model_copy(update={"tags": with_antenna_delays(scenario.tags, path)})


def scenarios(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Scenarios, or folders of them; else all.", autocompletion=shipped),
    ] = None,
    output: Annotated[Path | None, guide.output("Folder to copy them into.")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """List the shipped scenarios, or copy them."""
    from uwbsim.scenario import copy_scenarios, listed

    if output is not None:
        for path in copy_scenarios(names or (), output, force=force):
            typer.echo(path)
        return
    found = listed(names or ())
    if as_json:
        print_json(found)
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table.grid("name", "what it is", padding=(0, 2, 0, 0))
    for row in found.items():
        table.add_row(*map(escape, row))
    Console(highlight=False).print(table)


def serve(
    scenario: ScenarioFile,
    link_dir: LinkDir = None,
    faults: Annotated[Path | None, typer.Option(help="Faults of boards and of the air (.toml).")] = None,
    poses: Annotated[
        Path | None, typer.Option(help="Motion capture to write while serving (.csv), in host time.")
    ] = None,
    duration: Duration = None,
    antenna_delays: AntennaDelays = None,
    overrides: Overrides = None,
    allow_files: AllowFiles = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the poses if they exist.")] = False,
) -> None:
    """Have the boards of a scenario answer on pseudo-terminals, as powered boards do on serial ports."""
    if poses:
        check_output(poses, force=force)
    loaded = _programmed(uwbsim.load(scenario, overrides or (), allow_files=allow_files or ()), antenna_delays)
    wrong = uwbsim.load_faults(faults, [tag.id for tag in loaded.tags]) if faults else None
    server = uwbsim.Server(
        uwbsim.Server.extended(loaded, duration), link_dir, wrong, tell=lambda text: typer.echo(text, err=True)
    )
    try:
        for tag, name in server.names.items():
            typer.echo(f"tag {tag:3d}  {name}")
        ports = f"{link_dir}/*" if link_dir else " ".join(server.names.values())
        until = "Ctrl-C ends it" if duration is None else f"for {duration:g} s"
        typer.echo(f"served, {until}; to record: uwblink record {ports} --pairs all -o flight.uwb", err=True)
        server.announce(typer.echo)
        if poses:
            server.write_poses(poses)
        with interrupts() as stop:
            server.run(stop, duration or float("inf"))
    finally:
        server.close()


def show(
    scenario: ScenarioFile,
    output: Annotated[Path, guide.output("Page (.html) or picture (.png, .svg, .pdf).")],
    overrides: Overrides = None,
    allow_files: AllowFiles = None,
    force: Force = False,
) -> None:
    """Draw the room, the flights, and one exchange of each protocol."""
    check_output(output, force=force)
    with waiting("drawing"):
        uwbsim.show(uwbsim.load(scenario, overrides or (), allow_files=allow_files or ()), output, force=force)
    typer.echo(f"{output}")


def validate(
    scenario: ScenarioFile,
    overrides: Overrides = None,
    allow_files: AllowFiles = None,
    as_json: AsJson = False,
) -> None:
    """Summarise what a scenario will do, without running it."""
    found = uwbsim.preview(uwbsim.load(scenario, overrides or (), allow_files=allow_files or ()))
    if as_json:
        print_json(found.to_dict())
    else:
        typer.echo(found)


def schema() -> None:
    """Print the JSON Schema of scenario files."""
    typer.echo(json.dumps(uwbsim.Scenario.model_json_schema(), indent=2))


app = new_app("Simulate tags that range with ultra-wideband radios.")
for _command, *_examples in (
    (scenarios, "uwbsim scenarios", "uwbsim scenarios icra2023 -o scenarios"),
    (
        run,
        "uwbsim run icra2023/train -o train.uwb",
        "uwbsim run scenario.toml -o short.uwb --set run.duration_s=60",
    ),
    (serve, "uwbsim serve scenario.toml --link-dir ports --poses poses.csv"),
    (show, "uwbsim show scenario.toml -o scene.html"),
    (validate, "uwbsim validate scenario.toml"),
    (schema, "uwbsim schema > scenario.schema.json"),
):
    add(app, _command, *_examples, panel="Scenarios")
workbench.add_to(app)

FLAGS: Final = {"count": "-n/--ranges", "overhead_s": "--overhead-us", "overrides": "--set", "evaluate": "evaluate"}
"""Of parameters that are spelt otherwise; what evaluates a sweep is a plug-in, which no flag names."""
