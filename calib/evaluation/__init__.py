"""Evaluation of a calibration: statistics of errors, and localization with and without it."""

from calib.evaluation.localization import PAPER_RMSE_M, summarize
from calib.evaluation.onboard import OnboardSettings, localize_onboard
from calib.evaluation.output import (
    as_tum,
    localization_json,
    localization_text,
    onboard_json,
    onboard_text,
    write_onboard_tum,
    write_tum,
)
from calib.evaluation.statistics import CORRECTION_STAGES, ErrorStatistics, Evaluation
from calib.evaluation.tracking import FILTERS, Settings

__all__ = [
    "CORRECTION_STAGES",
    "FILTERS",
    "PAPER_RMSE_M",
    "ErrorStatistics",
    "Evaluation",
    "OnboardSettings",
    "Settings",
    "as_tum",
    "localization_json",
    "localization_text",
    "localize_onboard",
    "onboard_json",
    "onboard_text",
    "summarize",
    "write_onboard_tum",
    "write_tum",
]
