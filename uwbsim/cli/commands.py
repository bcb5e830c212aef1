"""The commands of `uwbsim`, and the arguments that several of them share."""

from __future__ import annotations

import json
import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

import uwbsim
from uwblink.cli import shared
from uwblink.cli.shared import (
    INTERRUPTED,
    AntennaDelays,
    AsJson,
    CalibrationFile,
    Duration,
    Figures,
    Force,
    LinkDir,
    Seed,
    Seeds,
    add,
    interrupts,
    new_app,
    print_json,
    print_result,
    several,
    starting,
    waiting,
)
from uwblink.output import check_apart, check_folder, check_output
from uwbsim.settings import protocol_names

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwblink import RangingProtocol


def shipped(incomplete: str) -> list[str]:
    """Complete the name of a shipped scenario; where nothing was typed yet, the shell completes files."""
    return starting(incomplete, uwbsim.shipped_scenarios()) if incomplete else []


ScenarioFile = Annotated[
    Path, typer.Argument(help="Scenario file (.toml), or the name of a shipped one.", autocompletion=shipped)
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change one value. May be repeated.")
]
AllowFiles = Annotated[
    list[Path] | None,
    typer.Option(metavar="DIR", help="Additional folder from which the scenario may read files. May be repeated."),
]


Protocols = Annotated[
    str, typer.Option(help="Protocols, separated by commas, or all.", **several(lambda: ["all", *protocol_names()]))
]


def run(
    scenario: ScenarioFile,
    output: Annotated[Path, shared.output("Recording to write (.uwb).")],
    seed: Seed = None,
    overrides: Overrides = None,
    allow_files: AllowFiles = None,
    antenna_delays: AntennaDelays = None,
    wire: Annotated[
        bool, typer.Option("--through-wire", help="Encode and decode every report, and record the bytes.")
    ] = False,
    contention: Annotated[
        bool,
        typer.Option(help="Simulate collisions of exchanges. Without collisions, the simulation is faster."),
    ] = True,
    force: Force = False,
) -> None:
    """Simulate a scenario and write the recording of its boards and motion capture."""
    check_output(output, force=force, recording=True)
    loaded = _loaded(scenario, overrides, allow_files, antenna_delays, seed)
    with waiting(loaded.run.name) as report:
        simulated = uwbsim.simulate(loaded, progress=report, contention=contention)
    frames: list[Any] = []
    if wire:
        simulated, frames = uwbsim.through_wire(simulated)
    simulated.save(output, frames=frames, force=force)
    typer.echo(
        f"{output}: {len(simulated.exchanges)} exchanges of {len(loaded.tags)} tags in "
        f"{len(loaded.pairs())} pairs, {loaded.run.duration_s:g} s, "
        f"{len(simulated.faults)} failed"
    )


def _loaded(
    scenario: Path,
    overrides: list[str] | None,
    allow_files: list[Path] | None,
    antenna_delays: Path | None = None,
    seed: int | None = None,
) -> uwbsim.Scenario:
    """Return a scenario with the antenna delays of a file, if there is one, programmed into its tags."""
    loaded = uwbsim.load(scenario, overrides or (), seed, allow_files=allow_files or ())
    if antenna_delays is None:
        return loaded
    return loaded.model_copy(update={"tags": uwbsim.scenario.with_antenna_delays(loaded.tags, antenna_delays)})


def scenarios(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME]...",
            help="Names of scenarios, or of folders of scenarios; by default all.",
            autocompletion=shipped,
        ),
    ] = None,
    output: Annotated[Path | None, shared.output("Folder to copy them into.")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """List the shipped scenarios, or copy them."""
    if output is not None:
        for path in uwbsim.scenario.copy_scenarios(names or (), output, force=force):
            typer.echo(path)
        return
    found = uwbsim.scenario.listed(names or ())
    print_result(found, "\n".join(f"{name}\n    {title}" for name, title in found.items()), as_json=as_json)


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
    """Run the boards of a scenario on pseudo-terminals, where they answer like real boards on serial ports."""
    if poses:
        check_output(poses, force=force)
        check_apart({"poses": poses}, filter(None, (scenario, faults, antenna_delays)))
    loaded = _loaded(scenario, overrides, allow_files, antenna_delays)
    wrong = uwbsim.load_faults(faults, [tag.id for tag in loaded.tags]) if faults else None
    served = uwbsim.Server.extended(loaded, duration)
    with closing(uwbsim.Server(served, link_dir, wrong, tell=lambda text: typer.echo(text, err=True))) as server:
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


def show(
    scenario: ScenarioFile,
    output: Annotated[Path, shared.output("Page (.html) or picture (.png, .svg, .pdf).")],
    overrides: Overrides = None,
    allow_files: AllowFiles = None,
    force: Force = False,
) -> None:
    """Draw the room, the flights, and one exchange of each protocol."""
    check_output(output, force=force)
    with waiting("drawing"):
        uwbsim.show(_loaded(scenario, overrides, allow_files), output, force=force)
    typer.echo(f"{output}")


def validate(
    scenario: ScenarioFile,
    overrides: Overrides = None,
    allow_files: AllowFiles = None,
    as_json: AsJson = False,
) -> None:
    """Summarise what a scenario will do, without running it."""
    found = uwbsim.preview(_loaded(scenario, overrides, allow_files))
    print_result(found.to_dict(), str(found), as_json=as_json)


def schema() -> None:
    """Print the JSON Schema of scenario files."""
    typer.echo(json.dumps(uwbsim.Scenario.model_json_schema(), indent=2))


def compare(
    scenario: ScenarioFile,
    output: Annotated[Path, shared.output("Folder for compare.html, .csv and .parquet.")],
    protocols: Protocols = "all",
    count: Annotated[int, typer.Option("-n", "--ranges", help="Ranges with each protocol.")] = 1_000_000,
    overrides: Overrides = None,
    allow_files: AllowFiles = None,
    figures: Figures = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Simulate ranges of every protocol in the same random world, and compare their errors and costs."""
    rows = _rows(protocols)
    loaded = _loaded(scenario, overrides, allow_files)
    check_folder(output, uwbsim.pages.FILES, force=force)
    _check_figures(figures, force=force)
    with waiting(loaded.run.name) as report:
        found = uwbsim.compare(loaded, rows, count, report)
    uwbsim.pages.write_comparison(found, output, figures=figures, force=force)
    if as_json:
        print_json(found.to_dict())
        return
    # On its side, because it has few protocols and many quantities.
    _print_table([[name.strip(), *map(show, found.outcomes)] for name, show in uwbsim.pages.COMPARISON_COLUMNS.items()])
    _print_fleet(found.fleet)
    typer.echo(f"{output / uwbsim.pages.FILES[0]}, {', '.join(uwbsim.pages.FILES[1:])}")


def _check_figures(folder: Path | None, *, force: bool) -> None:
    """Check the folder of figures before anything is computed: without `force` it holds none yet."""
    if folder is not None:
        check_folder(folder, [path.name for path in folder.glob("*.svg")], force=force)


def _print_fleet(found: Sequence[uwbsim.FleetFigures]) -> None:
    columns = uwbsim.pages.FLEET_COLUMNS
    _print_table([[*columns], *([show(one) for show in columns.values()] for one in found)], f"{found[0].tags} tags")


def _rows(protocols: str) -> list[RangingProtocol]:
    """Return the protocols of these names, separated by commas, or all."""
    return uwbsim.protocols.chosen(
        None if protocols == "all" else [name.strip() for name in protocols.split(",") if name.strip()]
    )


def _print_table(rows: Sequence[Sequence[str]], title: str | None = None) -> None:
    """Print a table of texts whose first row has the headings, and whose first column is left-aligned."""
    console = Console(width=None if sys.stdout.isatty() else 150)
    gap = 1 if console.width > 80 else 0
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, gap, 0, 0), title=title, title_justify="left")
    for k, head in enumerate(rows[0]):
        table.add_column(head, justify="right" if k else "left", overflow="fold")
    for row in rows[1:]:
        table.add_row(*row)
    console.print(table)


def predict(
    state: uwbsim.State,
    tags: Annotated[
        int | None,
        typer.Option(help="Also predict the rates and errors of a fleet of this many tags, for each way of ranging."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Predict the bias and standard deviation of a range analytically."""
    found, fleet = uwbsim.predict_state(state), [] if tags is None else uwbsim.predict_fleet(state, tags)
    more = {"fleet": [one.to_dict() for one in fleet]} if fleet else {}
    print_result(found.to_dict() | more, str(found), as_json=as_json)
    if fleet and not as_json:
        _print_fleet(fleet)


def optimum(
    scenario: ScenarioFile,
    protocols: Protocols = "all",
    overhead_us: Annotated[float, typer.Option(min=0.0, help="Additional time of an exchange, microseconds.")] = 0.0,
    output: Annotated[Path | None, shared.output("Folder for pictures of the curves (.png).")] = None,
    overrides: Overrides = None,
    allow_files: AllowFiles = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Find the delay of the scheduled message that minimises the error of a pair's ranges averaged over one second."""
    rows = _rows(protocols)
    loaded = _loaded(scenario, overrides, allow_files)
    if output:
        check_folder(output, [uwbsim.pages.optimum_file(row.name) for row in rows], force=force)
    with waiting("searching"):
        found = [uwbsim.optimum(loaded, row, overhead_us * 1e-6) for row in rows]
    if output:
        uwbsim.pages.write_optima(found, output, force=force)
    if as_json:
        print_json([one.to_dict() for one in found])
        return
    typer.echo(f"{'protocol':10s}{'best delay':>12s}{'one range':>12s}{'takes':>10s}{'mean of 1 s':>14s}")
    for one in found:
        typer.echo(
            f"{one.protocol:10s}{1e6 * one.delay_s:9.0f} µs{100 * one.rms_m:9.2f} cm{1e6 * one.duration_s:7.0f} µs"
            f"{100 * one.second_rms_m:11.4f} cm" + ("  (at the limit of the boards)" if one.on_edge else "")
        )


def sweep(
    plan: Annotated[Path, typer.Argument(help="Sweep file with the varied keys (.toml).")],
    output: Annotated[Path, shared.output("Folder for the results.")],
    workers: Annotated[int | None, typer.Option(min=1, help="Number of processes; by default one per core.")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a running Dask scheduler.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a sweep that was interrupted.")] = False,
    allow_files: AllowFiles = None,
    figures: Figures = None,
) -> None:
    """Run a scenario many times with varied settings and seeds; an interrupted sweep can be resumed."""
    loaded = uwbsim.load_design(plan, allow_files=allow_files or ())
    _check_figures(figures, force=resume)
    with interrupts() as stop, waiting(loaded.name) as report:

        def go_on(share: float) -> None:
            report(share)
            if stop():  # between two chunks, when nothing is being written
                raise KeyboardInterrupt

        try:
            summary = uwbsim.run_sweep(
                loaded, output, workers=workers, scheduler=scheduler, resume=resume, progress=go_on
            )
        except KeyboardInterrupt:
            typer.echo(f"{output}: interrupted; finished runs are kept, and --resume continues")
            raise typer.Exit(INTERRUPTED) from None
    page = uwbsim.pages.write_sweep_page(loaded, output, figures=figures)
    typer.echo(
        f"{output}: {summary.done} runs of {loaded.total}, {summary.failed} failed, {summary.skipped} already done; "
        f"results.csv, results.parquet, {page.name}"
    )


def twin(
    recording: Annotated[Path, typer.Argument(help="Recording with poses and first-path powers (.uwb).")],
    calibration: CalibrationFile,
    output: Annotated[Path, shared.output("Scenario to write (.toml).")],
    seeds: Seeds = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fit a scenario to a recording, and compare its simulation with the measurements on a page."""
    uwbsim.twins.check_name(output)
    page = output.with_suffix(".html")
    for path in (output, page):
        check_output(path, force=force)
    with waiting("fitting"):
        found = uwbsim.twin(recording, calibration)
    with waiting(output.name) as report:
        compared = found.compare(seeds, report)
    found.save(output, force=force)
    uwbsim.pages.write_twin(found, compared, page, force=force)
    if as_json:
        rows = [one.to_dict() for one in compared]
        print_json({"found": found.found, "unknown": found.unknown, "compared": rows})
        return
    rows_of_text = [[show(one) for show in uwbsim.pages.TWIN_COLUMNS.values()] for one in compared]
    _print_table([[*uwbsim.pages.TWIN_COLUMNS], *rows_of_text], "measured / simulated")
    typer.echo(", ".join(map(str, (*found.files(output), page))))


app = new_app("Simulate tags that range with ultra-wideband radios.")
for _panel, _command, *_examples in (
    ("Scenarios", scenarios, "uwbsim scenarios", "uwbsim scenarios icra2023 -o scenarios"),
    (
        "Scenarios",
        run,
        "uwbsim run icra2023/train -o train.uwb",
        "uwbsim run scenario.toml -o short.uwb --set run.duration_s=60",
    ),
    ("Scenarios", serve, "uwbsim serve scenario.toml --link-dir ports --poses poses.csv"),
    ("Scenarios", show, "uwbsim show scenario.toml -o scene.html"),
    ("Scenarios", validate, "uwbsim validate scenario.toml"),
    ("Scenarios", schema, "uwbsim schema > scenario.schema.json"),
    ("Protocols and studies", compare, "uwbsim compare scenario.toml -o comparison -n 200000"),
    ("Protocols and studies", predict, "uwbsim predict --protocol ss-cfo --skew-ppm 10 --reply-delay-us 300"),
    ("Protocols and studies", optimum, "uwbsim optimum scenario.toml --protocols ds,ds-alt"),
    (
        "Protocols and studies",
        sweep,
        "uwbsim sweep plan.toml -o results",
        "uwbsim sweep plan.toml -o results --resume",
    ),
    ("From measurements", twin, "uwbsim twin flight.uwb -c calibration.json -o twin.toml"),
):
    add(app, _command, *_examples, panel=_panel)

UWBSIM_FLAGS: Final = {
    "count": "-n/--ranges",
    "overhead_s": "--overhead-us",
    "overrides": "--set",
    "evaluate": "evaluate",
}
"""Flags of parameters that differ from the parameter's name; plug-ins that evaluate sweeps have no flag."""
