"""Evaluation of a calibration: statistics of errors, and localization with and without it."""

from calib.evaluation.localization import PAPER_RMSE_M, localization_json, localization_text, summarize, write_tum
from calib.evaluation.onboard import OnboardSettings, localize_onboard, onboard_json, onboard_text
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
    "localization_json",
    "localization_text",
    "localize_onboard",
    "onboard_json",
    "onboard_text",
    "summarize",
    "write_tum",
]
