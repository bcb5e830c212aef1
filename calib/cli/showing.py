"""The command that shows a calibration: show."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.arguments import AsJson
from calib.cli.fitting import PANEL
from calib.cli.flags import with_flags
from uwblink.cli.guide import add


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    add(app, show, "calib show calibration.json", panel=PANEL)


def show(
    calibration: Annotated[Path, typer.Argument(help="Calibration to show (.json).")], as_json: AsJson = False
) -> None:
    """Print a calibration: delays, curves, what it was fitted to, and what its fit could not know."""
    import calib

    known = calib.load_calibration(calibration)
    if as_json:
        typer.echo(known.to_json(), nl=False)
        return
    typer.echo(repr(known))
    for name in ("fitted", "gauge", "recordings"):
        if name in known.provenance:
            value = known.provenance[name]
            typer.echo(
                f"  {name.replace('_', ' ')}: {', '.join(map(str, value)) if isinstance(value, list) else value}"
            )
    for warning in known.provenance.get("warnings", []):
        typer.echo(f"warning: {with_flags(str(warning))}")
