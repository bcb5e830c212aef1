"""Evaluation of a calibration: statistics of errors, and localization with and without it."""

from functools import partial
from typing import Final

from calib.evaluation.filters import IMUS
from calib.evaluation.localization import (
    PAPER_RMSE_M,
    LocalizationModel,
    localization_json,
    localization_text,
    localize,
    summarize,
    write_tum,
)
from calib.evaluation.onboard import OnboardSettings, localize_onboard, onboard_json, onboard_text
from calib.evaluation.statistics import CORRECTION_STAGES, ErrorStatistics, Evaluation
from calib.evaluation.team import TeamSettings, localize_team, team_json, team_text
from calib.evaluation.tracking import FILTERS, Settings

__all__ = [
    "CORRECTION_STAGES",
    "FILTERS",
    "IMUS",
    "MODELS",
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

MODELS: Final = {
    "poses": LocalizationModel(Settings, localize, localization_json, localization_text),
    **{
        name: LocalizationModel(partial(OnboardSettings, model=name), localize_onboard, onboard_json, onboard_text)
        for name in ("imu", "constant-velocity")
    },
    "team": LocalizationModel(TeamSettings, localize_team, team_json, team_text),
}
"""Motion models by name."""
