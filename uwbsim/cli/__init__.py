"""The `uwbsim` command."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

import uwblink
from uwblink.errors import UwblinkError
from uwbsim.cli import flights, workbench
from uwbsim.errors import UwbsimError

app = typer.Typer(
    help="Simulate tags that range with ultra-wideband radios.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def _top(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    if version:
        typer.echo(uwblink.__version__)
        raise typer.Exit


flights.add_to(app)
workbench.add_to(app)


def main() -> None:
    """Run the command; a user's mistake is one line on standard error and exit status 2."""
    try:
        app()
    except (UwbsimError, UwblinkError) as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)
