"""The `uwblink` command."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from uwblink import __version__
from uwblink.cli import boards, files, recording
from uwblink.errors import UwblinkError

app = typer.Typer(
    help="Talk to ranging boards, record them, and look at, import and replay recordings.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def _top(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


boards.add_to(app)
recording.add_to(app)
files.add_to(app)


def main() -> None:
    """Run the command; a user's mistake is one line on standard error and exit status 2."""
    try:
        app()
    except UwblinkError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)
