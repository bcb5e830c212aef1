"""Calibrations: the model, its file, other formats, corrections, comparison."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.calibration.formats import antenna_delays_warning, free_delays, programmed, read_miluv
    from calib.calibration.model import rests_on

__all__ = [
    "antenna_delays_warning",
    "free_delays",
    "programmed",
    "read_miluv",
    "rests_on",
]

_HOMES: Final = {
    "antenna_delays_warning": "calib.calibration.formats",
    "free_delays": "calib.calibration.formats",
    "programmed": "calib.calibration.formats",
    "read_miluv": "calib.calibration.formats",
    "rests_on": "calib.calibration.model",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
