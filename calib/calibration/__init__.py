"""Calibrations: the model, its file, other formats, corrections, comparison."""

from calib.calibration.applying import keep_determined
from calib.calibration.formats import antenna_delays_warning, free_delays, programmed, read_miluv
from calib.calibration.model import (
    age_line,
    delay_rows,
    held_out_line,
    known_facts,
    pair_rows,
    pattern_rows,
    temperature_rows,
    warnings_of,
)

__all__ = [
    "age_line",
    "antenna_delays_warning",
    "delay_rows",
    "free_delays",
    "held_out_line",
    "keep_determined",
    "known_facts",
    "pair_rows",
    "pattern_rows",
    "programmed",
    "read_miluv",
    "temperature_rows",
    "warnings_of",
]
