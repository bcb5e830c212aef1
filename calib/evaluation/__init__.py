"""How good a calibration is: statistics, localization."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.evaluation.localization import FILTERS, PAPER_RMSE_M, as_tum, summarize
    from calib.evaluation.statistics import CORRECTION_STAGES, ErrorStatistics, Evaluation

__all__ = [
    "CORRECTION_STAGES",
    "FILTERS",
    "PAPER_RMSE_M",
    "ErrorStatistics",
    "Evaluation",
    "as_tum",
    "summarize",
]

_HOMES: Final = {
    "CORRECTION_STAGES": "calib.evaluation.statistics",
    "ErrorStatistics": "calib.evaluation.statistics",
    "Evaluation": "calib.evaluation.statistics",
    "FILTERS": "calib.evaluation.localization",
    "PAPER_RMSE_M": "calib.evaluation.localization",
    "as_tum": "calib.evaluation.localization",
    "summarize": "calib.evaluation.localization",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
