"""Commands that turn files into others: apply, export, import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.arguments import CalibrationFile, Force

imports = typer.Typer(help="Turn other files into calibrations.", no_args_is_help=True)


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    app.command()(apply)
    app.command()(export)
    app.add_typer(imports, name="import")


def apply(
    recording: Annotated[Path, typer.Argument(help="Recording (.uwb).")],
    calibration: CalibrationFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Recording to write (.uwb).")],
    force: Force = False,
) -> None:
    """Write a recording whose ranges are corrected."""
    import calib

    applied = calib.apply(recording, calib.load_calibration(calibration), output, force=force)
    typer.echo(f"{output}: {applied.count} ranges corrected, {applied.clamped} beyond the fitted power")


def export(
    calibration: Annotated[Path, typer.Argument(help="Calibration (.json).")],
    to: Annotated[str, typer.Option(help="registers, json, csv, miluv or ros-yaml.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="File to write; else it is printed.")] = None,
    force: Force = False,
) -> None:
    """Write a calibration in another form."""
    import calib

    text = calib.export(calib.load_calibration(calibration), to, output, force=force)
    if output is None:
        typer.echo(text, nl=False)
    else:
        typer.echo(f"{output}")


@imports.command("miluv")
def import_miluv(
    source: Annotated[Path, typer.Argument(help="MILUV's published calibration (.json).")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Calibration to write (.json).")],
    force: Force = False,
) -> None:
    """Read the calibration published with the MILUV dataset."""
    from calib.calibration.formats import read_miluv
    from calib.calibration.model import save
    from uwblink.output import check_output

    check_output(output, force=force)
    found = read_miluv(source)
    save(found, output, force=force)
    typer.echo(f"{output}: {len(found.delays_ns)} tags")
