"""Writes a recording again with corrected ranges."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.calibration.model import Calibration, require_calibration
from calib.errors import BadInputError
from calib.ranges import Ranges
from uwblink.output import check_output
from uwblink.recording.file import Recording


@dataclass(frozen=True, slots=True)
class Applied:
    """How many ranges were corrected, and how many of them at powers beyond the fitted ones."""

    count: int
    clamped: int


def apply(
    source: str | os.PathLike[str], calibration: Calibration, output: str | os.PathLike[str], *, force: bool = False
) -> Applied:
    """Write a recording again with `range_m` of every exchange corrected, and every other row of every table as it was.

    Stamps stay as they were recorded. An exchange without any power gets the delays' part only. Raises `BadInputError`
    for a recording that is corrected already, and what `Recording.open` and `check_output` raise.

    >>> import calib, tempfile
    >>> from uwblink import Recording
    >>> flight = calib.sample_flight()
    >>> known = calib.fit(flight).calibration
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with Recording.create(f"{folder}/flight.uwb") as recording:
    ...         recording.append_exchanges(flight.exchanges)
    ...     calib.apply(f"{folder}/flight.uwb", known, f"{folder}/corrected.uwb").count
    900
    """
    require_calibration(calibration)
    check_output(Path(output), force=force)
    with Recording.open(source) as recording:
        if "calibration" in recording.meta():
            raise BadInputError(f"{source}: its ranges are corrected already; apply to the original")
        exchanges = recording.exchanges()
        applied = calibration.apply(Ranges.from_exchanges(exchanges, source=Path(source).name))
        corrected = np.where(np.isfinite(applied.lifted), applied.corrected_m, applied.delay_corrected_m)
        recording.copy(
            output,
            replacing={"exchanges": replace(exchanges, range_m=corrected)},
            meta={"calibration": calibration.provenance},
            force=force,
        )
    return Applied(len(exchanges), int(np.count_nonzero(applied.clamped)))
