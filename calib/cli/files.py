"""Commands that turn files into others: apply, export, import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from calib.cli.arguments import CalibrationFile, Force
from calib.cli.loading import known_calibration
from uwblink.cli.guide import add, choice, epilog
from uwblink.cli.options import Group
from uwblink.cli.waiting import waiting

PANEL: Final = "Use"

WITHOUT_ERRORS: Final = ("miluv", "ros-yaml", "c-header")
"""Forms that hold delays and not how well they are known."""

MILUV: Final = "calib import miluv uwb_calib.json -o calibration.json"

imports = typer.Typer(
    cls=Group,
    help="Turn calibrations of other programs into ones that apply and evaluate take.",
    epilog=epilog(MILUV),
    no_args_is_help=True,
)


def _exporters() -> list[str]:
    from uwblink.exporters import EXPORTERS

    return list(EXPORTERS)


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    add(app, apply, "calib apply flight.uwb -c calibration.json -o corrected.uwb", panel=PANEL)
    add(
        app,
        export,
        "calib export calibration.json --to registers",
        "calib export calibration.json --to c-header -o calibration.h",
        panel=PANEL,
    )
    app.add_typer(imports, name="import", rich_help_panel=PANEL)
    add(imports, import_miluv, MILUV, name="miluv")


def apply(
    recording: Annotated[Path, typer.Argument(help="Recording to correct (.uwb).")],
    calibration: CalibrationFile,
    output: Annotated[Path, typer.Option("-o", "--output", help="Recording to write (.uwb); a folder with --to.")],
    to: Annotated[
        str | None,
        typer.Option(
            help="A folder in this form instead.", **choice("csv", "parquet", "mcap", "rosbag2", more=_exporters)
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write a recording again with its ranges corrected (range_m); all else stays as it was."""
    import calib

    with waiting("correcting"):
        applied = calib.apply(recording, known_calibration(calibration, [recording]), output, to=to, force=force)
    typer.echo(f"{output}: {applied.count} ranges corrected, {applied.clamped} beyond the fitted power")
    if applied.unpowered:
        typer.echo(
            f"warning: {applied.unpowered} without power: corrected by delays alone, and without sigma", err=True
        )


def export(
    calibration: Annotated[Path, typer.Argument(help="Calibration to turn (.json).")],
    to: Annotated[
        str,
        typer.Option(
            help="registers: antenna delays of the DW1000; firmware: those, and constants of its build; csv: delays "
            "in ns; c-header: a function for a robot's code.",
            **choice("registers", "firmware", "json", "csv", "miluv", "ros-yaml", "c-header"),
        ),
    ],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="File to write; else it is printed.")] = None,
    base: Annotated[
        Path | None,
        typer.Option(
            help="What was programmed when a calibration was fitted that does not say it: a recording or antenna "
            "delays (.toml)."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write a calibration as register values, CSV, MILUV's JSON, YAML for ROS or a C header."""
    import calib
    from calib.calibration import free_delays, programmed

    registers = programmed(base) if base else None
    known = known_calibration(calibration)
    text = calib.export(known, to, output, base=registers, force=force)
    free = free_delays(known)
    if free and to in WITHOUT_ERRORS:
        tags = ", ".join(map(str, free))
        typer.echo(f"warning: {to} does not say that the data leave the delay of tag {tags} free", err=True)
    if output is None:
        typer.echo(text, nl=False)
    else:
        typer.echo(f"{output}")


def import_miluv(
    source: Annotated[Path, typer.Argument(help="MILUV's published calibration (.json).")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Calibration to write (.json).")],
    force: Force = False,
) -> None:
    """Turn the calibration published with the MILUV dataset into one that apply and evaluate take."""
    from calib.calibration import read_miluv

    found = read_miluv(source)
    found.save(output, force=force)
    typer.echo(f"{output}: {len(found.delays_ns)} tags")
