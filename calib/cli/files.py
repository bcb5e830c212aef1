"""Commands that convert files: apply, export, import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

import calib
import uwblink
from calib.cli.shared import known_calibration, warn
from uwblink.cli.shared import CalibrationFile, Force, Group, add, choice, epilog, output, waiting

MILUV: Final = "calib import miluv uwb_calib.json -o calibration.json"

imports = typer.Typer(
    cls=Group,
    help="Convert calibrations of other programs into calibration files.",
    epilog=epilog(MILUV),
    no_args_is_help=True,
)


def _exporters() -> list[str]:
    return list(uwblink.exporters.EXPORTERS)


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    panel = "Use"
    add(app, apply, "calib apply flight.uwb -c calibration.json -o corrected.uwb", panel=panel)
    add(
        app,
        export,
        "calib export calibration.json --to registers",
        "calib export calibration.json --to c-header -o calibration.h",
        panel=panel,
        renamed={"--base": "--antenna-delays"},
    )
    app.add_typer(imports, name="import", rich_help_panel=panel)
    add(imports, import_miluv, MILUV, name="miluv")


def apply(
    recording: Annotated[Path, typer.Argument(help="Recording to correct (.uwb).")],
    calibration: CalibrationFile,
    output: Annotated[Path, output("Recording to write (.uwb), or folder to write with --to.")],
    to: Annotated[
        str | None,
        typer.Option(
            help="Write a folder in this format instead of a recording.",
            **choice("csv", "parquet", "mcap", "rosbag2", more=_exporters),
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write a copy of a recording with corrected ranges (range_m); all other data stay the same."""
    with waiting("correcting"):
        applied = calib.apply(recording, known_calibration(calibration, [recording]), output, to=to, force=force)
    typer.echo(f"{output}: {applied.count} ranges corrected, {applied.clamped} outside the fitted powers")
    if applied.unpowered:
        warn(f"{applied.unpowered} without power: corrected for delays only, and without sigma")


def export(
    calibration: Annotated[Path, typer.Argument(help="Calibration to export (.json).")],
    to: Annotated[
        str,
        typer.Option(
            help="Format to write. registers: antenna delays of the DW1000; firmware: the same, and constants of the "
            "firmware's build; csv: delays in ns; c-header: a function for a robot's code.",
            **choice("registers", "firmware", "json", "csv", "miluv", "ros-yaml", "c-header"),
        ),
    ],
    output: Annotated[Path | None, output("File to write; by default the text is printed.")] = None,
    antenna_delays: Annotated[
        Path | None,
        typer.Option(
            help="Antenna delays programmed into the boards when the calibration was fitted, if the calibration does "
            "not contain them: from a recording (.uwb) or a file (.toml)."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write a calibration as register values, CSV, MILUV's JSON, YAML for ROS or a C header."""
    registers = calib.calibration.programmed(antenna_delays) if antenna_delays else None
    known = known_calibration(calibration)
    text = calib.export(known, to, output, base=registers, force=force)
    # These formats have no standard errors of delays. All but MILUV's have the undetermined splits.
    free = [tag for tag in calib.calibration.free_delays(known) if to == "miluv" or tag not in known.sides]
    if free and to in ("miluv", "ros-yaml", "c-header"):
        warn(f"{to} cannot state that the data do not determine the delay of tag {', '.join(map(str, free))}")
    if output is None:
        typer.echo(text, nl=False)
    else:
        typer.echo(f"{output}")


def import_miluv(
    source: Annotated[Path, typer.Argument(help="MILUV's published calibration (.json).")],
    output: Annotated[Path, output("Calibration to write (.json).")],
    force: Force = False,
) -> None:
    """Convert the calibration published with the MILUV dataset into a calibration file."""
    found = calib.calibration.read_miluv(source)
    found.save(output, force=force)
    typer.echo(f"{output}: {len(found.delays_ns)} tags")
