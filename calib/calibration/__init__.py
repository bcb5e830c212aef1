"""Calibrations: the model, its file, other formats, corrections, comparison."""

from calib.calibration.formats import antenna_delays_warning, free_delays, programmed, read_miluv
from calib.calibration.model import held_out_line, rests_on

__all__ = ["antenna_delays_warning", "free_delays", "held_out_line", "programmed", "read_miluv", "rests_on"]
