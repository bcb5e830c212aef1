"""Calibrations: the model, its file, other formats, corrections, comparison."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.calibration.formats import programmed, read_miluv

__all__ = [
    "programmed",
    "read_miluv",
]

_HOMES: Final = {
    "programmed": "calib.calibration.formats",
    "read_miluv": "calib.calibration.formats",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
