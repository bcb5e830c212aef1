"""The command that shows a calibration: show."""

from __future__ import annotations

from collections.abc import Iterator
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
    from calib.calibration import rests_on

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
    told = rests_on(known.provenance)
    for line in [f"distances: {told}"] if told else _rests_on(known.provenance.get("rests_on")):
        typer.echo(f"  {line}")
    for warning in known.provenance.get("warnings", []):
        typer.echo(f"warning: {with_flags(str(warning))}")


def _rests_on(rests: object) -> Iterator[str]:
    """Yield what a survey rests on: arrangements by what was known of them, and what was known beside."""
    if not isinstance(rests, dict):
        return
    rows = [row for row in rests.get("arrangements", []) if isinstance(row, dict)]
    for shape in dict.fromkeys(str(row.get("known", "")) for row in rows):
        names = ", ".join(str(row.get("name")) for row in rows if row.get("known", "") == shape)
        yield f"rests on arrangements {names}{f', on a {shape}' if shape else ''}"
    distances, positions = rests.get("known_distances", 0), rests.get("known_positions", 0)
    yield f"rests on {distances} known distances and {positions} known positions"
