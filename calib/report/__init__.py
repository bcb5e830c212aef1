"""Reports as HTML and PDF, and their figures."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.report.figure_files import write_comparison_figures, write_onboard_figures, write_track_figures
    from calib.report.origin import origin_of
    from calib.report.plans import write_plan
    from calib.report.survey_report import write_survey_report
    from calib.report.writing import check_places

__all__ = [
    "check_places",
    "origin_of",
    "write_comparison_figures",
    "write_onboard_figures",
    "write_plan",
    "write_survey_report",
    "write_track_figures",
]

_HOMES: Final = {
    "check_places": "calib.report.writing",
    "origin_of": "calib.report.origin",
    "write_comparison_figures": "calib.report.figure_files",
    "write_onboard_figures": "calib.report.figure_files",
    "write_plan": "calib.report.plans",
    "write_survey_report": "calib.report.survey_report",
    "write_track_figures": "calib.report.figure_files",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
