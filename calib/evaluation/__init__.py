"""How good a calibration is: statistics, localization."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.evaluation.consistency import summarize
    from calib.evaluation.error_statistics import ErrorStatistics
    from calib.evaluation.localization import PAPER_RMSE_M
    from calib.evaluation.localization_display import (
        as_tum,
        localization_json,
        localization_text,
        onboard_json,
        onboard_text,
        write_onboard_tum,
        write_tum,
    )
    from calib.evaluation.onboard import localize_onboard
    from calib.evaluation.onboard_track import OnboardSettings
    from calib.evaluation.statistics import CORRECTION_STAGES, Evaluation
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

_HOMES: Final = {
    "CORRECTION_STAGES": "calib.evaluation.statistics",
    "ErrorStatistics": "calib.evaluation.error_statistics",
    "Evaluation": "calib.evaluation.statistics",
    "FILTERS": "calib.evaluation.tracking",
    "PAPER_RMSE_M": "calib.evaluation.localization",
    "OnboardSettings": "calib.evaluation.onboard_track",
    "Settings": "calib.evaluation.tracking",
    "as_tum": "calib.evaluation.localization_display",
    "localization_json": "calib.evaluation.localization_display",
    "localization_text": "calib.evaluation.localization_display",
    "localize_onboard": "calib.evaluation.onboard",
    "onboard_json": "calib.evaluation.localization_display",
    "onboard_text": "calib.evaluation.localization_display",
    "summarize": "calib.evaluation.consistency",
    "write_onboard_tum": "calib.evaluation.localization_display",
    "write_tum": "calib.evaluation.localization_display",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
