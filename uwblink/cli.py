"""The `uwblink` command."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from uwblink import __version__
from uwblink.errors import UwblinkError

app = typer.Typer(
    help="Recordings of ranging boards: look at them, import them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
imports = typer.Typer(help="Turn other files into recordings.", no_args_is_help=True)
app.add_typer(imports, name="import")


@app.callback(invoke_without_command=True)
def _top(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


@app.command()
def show(
    recording: Annotated[Path, typer.Argument(help="Recording (.uwb).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print what a recording holds."""
    from uwblink.listing import print_summary, summarize
    from uwblink.recording import Recording

    with Recording.open(recording) as opened:
        summary = summarize(opened)
    if as_json:
        typer.echo(json.dumps(summary, indent=1))
        return
    from rich.console import Console

    print_summary(summary, Console(highlight=False))


@imports.command("csv")
def import_csv(
    table: Annotated[Path, typer.Argument(help="Table of exchanges (.csv or .csv.gz).")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Recording to write (.uwb).")],
    column_map: Annotated[Path | None, typer.Option("--map", help="Names, units and constants (.toml).")] = None,
    force: Annotated[bool, typer.Option(help="Replace the output if it exists.")] = False,
) -> None:
    """Import ranging exchanges from a table."""
    from uwblink.importers.csv_table import import_csv as run
    from uwblink.importers.mapping import ColumnMap, load_map

    count = run(table, output, load_map(column_map) if column_map else ColumnMap(), force=force)
    typer.echo(f"{output}: {count} exchanges")


def main() -> None:
    """Run the command; a user's mistake is one line on standard error and exit status 2."""
    try:
        app()
    except UwblinkError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)
