"""Correct the reports of boards as they come: what a recorder's live page asks for."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from calib.calibration.model import load_calibration
from calib.errors import CalibError
from uwblink.wire.messages import RangeReport


def live_correction(path: Path) -> Callable[[int, RangeReport], float]:
    """Return a function that corrects a report of an initiator, in metres; NaN for a tag that is not calibrated.

    Raises what `load_calibration` raises.
    """
    calibration = load_calibration(path)

    def correct(initiator: int, report: RangeReport) -> float:
        try:
            return calibration.correct(
                report.range_m, report.fpp1_dbm, report.fpp2_dbm, initiator, report.neighbour
            ).range_m
        except CalibError:
            return math.nan

    return correct
