"""The `calib` command."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

import uwblink
from calib.cli import evaluating, files, fitting, reporting
from calib.cli.flags import with_flags
from calib.errors import CalibError, UnanswerableError
from uwblink.errors import UwblinkError

app = typer.Typer(
    help="Fit antenna delays and power curves to ultra-wideband ranges, apply them, and say how good they are.",
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


fitting.add_to(app)
evaluating.add_to(app)
reporting.add_to(app)
files.add_to(app)


def main() -> None:
    """Run the command; a mistake is one line on standard error, status 2, or 1 (see docs)."""
    try:
        app(args=reporting.spread(sys.argv[1:]))
    except UnanswerableError as error:
        typer.echo(f"error: {with_flags(str(error))}", err=True)
        sys.exit(1)
    except (CalibError, UwblinkError) as error:
        typer.echo(f"error: {with_flags(str(error))}", err=True)
        sys.exit(2)
