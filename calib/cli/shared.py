"""Functions and options that the commands of `calib` share."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final

import typer

import calib
from calib.errors import BadInputError
from calib.settings import FitSettings, FlightSettings, SurveySettings
from uwblink.cli import shared
from uwblink.cli.shared import output
from uwblink.settings import flags_of

STOPPED: Final = 1
"""Exit status if a fit stopped before it converged; its output is written, and marked as not converged."""

CALIB_FLAGS: Final = {
    "boards": "COUNT",
    "data": "RECORDINGS",
    "robots": "COUNT",
    "arrangement": "--save-anchors",
    "base": "--antenna-delays",
    "velocity_std_mps": "--process-noise",
    **dict.fromkeys(("start_std_m", "start_std_deg", "start_std_m_s"), "--start-std"),
    **flags_of(FitSettings),
    **flags_of(FlightSettings),
    **flags_of(SurveySettings),
}
"""Options of parameters of the library, if they are not the parameter's name with dashes."""

Recordings = Annotated[list[Path], typer.Argument(help="Recordings with true distances (.uwb).")]
NewCalibration = Annotated[Path, output("Calibration to write (.json).")]
TrimStatic = Annotated[
    bool,
    typer.Option(
        "--trim-static",
        rich_help_panel="Error model",
        help="Leave out spans of 2 s in which a pair's distance stays within 2 cm.",
    ),
]


def with_flags(text: str) -> str:
    """Return a text with options in place of parameters in backticks: `minimum_norm` becomes --minimum-norm."""
    return shared.with_flags(text, CALIB_FLAGS)


def warn(text: str) -> None:
    """Print a warning on standard error."""
    typer.echo(f"warning: {with_flags(text)}", err=True)


def refuse_given(context: typer.Context, options: Iterable[str], why: str) -> None:
    """Raise `BadInputError` with the reason `why` if one of some options was given on the command line."""
    for name in options:
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            raise BadInputError(why, parameter=name)


def check_report(report: Path | None, figures: Path | None, *, pdf: Path | None = None, force: bool) -> None:
    """Check the output files of a report, if any, before the computation."""
    if report or figures:
        calib.report.check_places(report, pdf, figures, force=force)


def command_line() -> str:
    """Return the command line of this process, for reports."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def known_calibration(path: Path, recordings: Iterable[Path] = ()) -> calib.Calibration:
    """Return the calibration in a file, with warnings on standard error.

    Warns if its fit stopped before it converged, and if the antenna delays programmed during `recordings` differ from
    those during its fit.
    """
    known = calib.load_calibration(path)
    if known.stopped:
        warn(f"{path}: its fit stopped before it converged: delays and intervals are not final")
    for recording in recordings:
        if warning := calib.calibration.antenna_delays_warning(known, recording):
            warn(f"{recording}: {path}: {warning}")
    return known
