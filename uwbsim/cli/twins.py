"""The command that makes a scenario from a recording."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uwblink.cli.guide import add
from uwblink.cli.waiting import waiting
from uwbsim.cli.arguments import AsJson, Force, progress

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwbsim.twins import Compared


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    add(app, twin, "uwbsim twin flight.uwb -c calibration.json -o twin.toml", panel="From measurements")


def twin(
    recording: Annotated[Path, typer.Argument(help="Recording with poses and first-path powers (.uwb).")],
    calibration: Annotated[Path, typer.Option("-c", "--calibration", help="Calibration of its tags (.json).")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Scenario to write (.toml).")],
    seeds: Annotated[int | None, typer.Option(min=1, help="Simulated flights to compare with.")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fit a scenario to a recording, and compare what it makes with what was measured, on a page beside it."""
    import uwbsim
    from uwblink.output import check_output
    from uwbsim.pages import write_twin
    from uwbsim.twins import check_name

    check_name(output)
    page = output.with_suffix(".html")
    for path in (output, page):
        check_output(path, force=force)
    with waiting("fitting"):
        found = uwbsim.twin(recording, calibration)
    files = found.files(output)
    for path in files:
        check_output(path, force=force)
    with progress(output.name) as report:
        compared = found.compare(seeds, report)
    found.save(output, force=force)
    write_twin(found, compared, page, force=force)
    if as_json:
        rows = [one.to_dict() for one in compared]
        typer.echo(json.dumps({"found": found.found, "unknown": found.unknown, "compared": rows}, indent=1))
        return
    _print(compared)
    typer.echo(", ".join(map(str, (*files, page))))


def _print(compared: Sequence[Compared], width: int | None = None) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from uwbsim.pages import TWIN_COLUMNS

    console = Console(width=width or (None if sys.stdout.isatty() else 150))
    gap = 1 if console.width > 80 else 0
    table = Table(
        box=SIMPLE_HEAD, pad_edge=False, padding=(0, gap, 0, 0), title="measured / simulated", title_justify="left"
    )
    for k, name in enumerate(TWIN_COLUMNS):
        # In a narrow terminal cells go on in a second line: cut off, they would lose what was simulated.
        table.add_column(name, justify="left" if k == 0 else "right", overflow="fold")
    for one in compared:
        table.add_row(*(show(one) for show in TWIN_COLUMNS.values()))
    console.print(table)
