"""Correct the reports of boards as they come: what a recorder's live page and a stream of ranges ask for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from calib.calibration.model import load_calibration
from calib.errors import CalibError
from uwblink.wire.messages import RangeReport


def live_correction(path: Path) -> Callable[[int, RangeReport], dict[str, float]]:
    """Return a function that corrects a report of an initiator: `corrected_m`, and what else `CorrectedRange` has.

    It returns nothing for a tag that is not calibrated. Raises what `load_calibration` raises.
    """
    calibration = load_calibration(path)

    def correct(initiator: int, report: RangeReport) -> dict[str, float]:
        try:
            found = calibration.correct(report.range_m, report.fpp1_dbm, report.fpp2_dbm, initiator, report.neighbour)
        except CalibError:
            return {}
        known = found._asdict()
        return {"corrected_m": known.pop("range_m"), **known}

    return correct
