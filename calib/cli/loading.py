"""How commands read a calibration: with a warning where its fit had not settled."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import typer

STOPPED: Final = 1
"""Exit status of a command whose fit stopped before it settled: what it wrote says so, and is not final."""

if TYPE_CHECKING:
    from calib import Calibration


def known_calibration(path: Path, recordings: Iterable[Path] = ()) -> Calibration:
    """Return a calibration from its file, and warn on standard error where its fit stopped before it settled.

    Warns, too, where other antenna delays were programmed into the tags of recordings than where it was fitted.
    """
    import calib
    from calib.calibration import antenna_delays_warning

    known = calib.load_calibration(path)
    if known.stopped:
        typer.echo(f"warning: {path}: its fit stopped before it settled: delays and intervals are not final", err=True)
    for recording in recordings:
        warning = antenna_delays_warning(known, recording)
        if warning:
            typer.echo(f"warning: {recording}: {path}: {warning}", err=True)
    return known
