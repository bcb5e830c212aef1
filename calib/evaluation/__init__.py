"""Evaluation of a calibration: statistics of errors, and localization with and without it."""

from calib.evaluation.filters import IMUS
from calib.evaluation.localization import PAPER_RMSE_M, localization_json, localization_text, summarize, write_tum
from calib.evaluation.onboard import OnboardSettings, localize_onboard, onboard_json, onboard_text
from calib.evaluation.statistics import CORRECTION_STAGES, ErrorStatistics, Evaluation
from calib.evaluation.team import TeamSettings, localize_team, team_json, team_text
from calib.evaluation.tracking import FILTERS, Settings

__all__ = [
    "CORRECTION_STAGES",
    "FILTERS",
    "IMUS",
    "PAPER_RMSE_M",
    "ErrorStatistics",
    "Evaluation",
    "OnboardSettings",
    "Settings",
    "TeamSettings",
    "localization_json",
    "localization_text",
    "localize_onboard",
    "localize_team",
    "onboard_json",
    "onboard_text",
    "summarize",
    "team_json",
    "team_text",
    "write_tum",
]
