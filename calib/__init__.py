"""Fits, applies and evaluates calibrations of ultra-wideband ranges.

>>> import calib
>>> calib.__all__[:5]
['BadInputError', 'CalibError', 'Calibration', 'CorrectedRanges', 'FitResult']
"""

from typing import TYPE_CHECKING

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.calibration.applying import CorrectedRanges
    from calib.calibration.comparison import compare
    from calib.calibration.correction import apply
    from calib.calibration.formats import export
    from calib.calibration.model import Calibration, load_calibration
    from calib.checks.examine import examine
    from calib.data.ranges import Ranges
    from calib.data.samples import sample_flight
    from calib.data.sources import load_ranges
    from calib.errors import BadInputError, CalibError, UnanswerableError
    from calib.estimator.losses import register_loss
    from calib.evaluation.localization import localize
    from calib.evaluation.onboard import OnboardSettings, localize_onboard
    from calib.evaluation.statistics import evaluate
    from calib.evaluation.team import TeamSettings, localize_team
    from calib.fitting.fitting import add_tag, fit
    from calib.fitting.result import FitResult
    from calib.planning.flights import plan_flight
    from calib.planning.result import FlightPlan, Plan
    from calib.planning.settings import FlightPlanSettings, SurveyPlanSettings
    from calib.planning.surveys import plan
    from calib.report.campaign import run_campaign, write_report
    from calib.report.sections import register_report_section
    from calib.settings import FitSettings, FlightSettings, SurveySettings
    from calib.surveys.knowledge import Knowledge, KnownPosition
    from calib.surveys.result import SurveyResult
    from calib.surveys.survey import sample_arrangements, survey
    from calib.trajectories.fitting import fit_from_ranges

__all__ = [
    "BadInputError",
    "CalibError",
    "Calibration",
    "CorrectedRanges",
    "FitResult",
    "FitSettings",
    "FlightPlan",
    "FlightPlanSettings",
    "FlightSettings",
    "Knowledge",
    "KnownPosition",
    "OnboardSettings",
    "Plan",
    "Ranges",
    "SurveyPlanSettings",
    "SurveyResult",
    "SurveySettings",
    "TeamSettings",
    "UnanswerableError",
    "add_tag",
    "apply",
    "compare",
    "evaluate",
    "examine",
    "export",
    "fit",
    "fit_from_ranges",
    "load_calibration",
    "load_ranges",
    "localize",
    "localize_onboard",
    "localize_team",
    "plan",
    "plan_flight",
    "register_loss",
    "register_report_section",
    "run_campaign",
    "sample_arrangements",
    "sample_flight",
    "survey",
    "write_report",
]

_homes = {
    "BadInputError": "calib.errors",
    "CalibError": "calib.errors",
    "Calibration": "calib.calibration.model",
    "CorrectedRanges": "calib.calibration.applying",
    "FitResult": "calib.fitting.result",
    "FitSettings": "calib.settings",
    "FlightPlan": "calib.planning.result",
    "FlightPlanSettings": "calib.planning.settings",
    "FlightSettings": "calib.settings",
    "Knowledge": "calib.surveys.knowledge",
    "KnownPosition": "calib.surveys.knowledge",
    "OnboardSettings": "calib.evaluation.onboard",
    "Plan": "calib.planning.result",
    "Ranges": "calib.data.ranges",
    "SurveyPlanSettings": "calib.planning.settings",
    "SurveyResult": "calib.surveys.result",
    "SurveySettings": "calib.settings",
    "TeamSettings": "calib.evaluation.team",
    "UnanswerableError": "calib.errors",
    "add_tag": "calib.fitting.fitting",
    "apply": "calib.calibration.correction",
    "compare": "calib.calibration.comparison",
    "evaluate": "calib.evaluation.statistics",
    "examine": "calib.checks.examine",
    "export": "calib.calibration.formats",
    "fit": "calib.fitting.fitting",
    "fit_from_ranges": "calib.trajectories.fitting",
    "load_calibration": "calib.calibration.model",
    "load_ranges": "calib.data.sources",
    "localize": "calib.evaluation.localization",
    "localize_onboard": "calib.evaluation.onboard",
    "localize_team": "calib.evaluation.team",
    "plan": "calib.planning.surveys",
    "plan_flight": "calib.planning.flights",
    "register_loss": "calib.estimator.losses",
    "register_report_section": "calib.report.sections",
    "run_campaign": "calib.report.campaign",
    "sample_arrangements": "calib.surveys.survey",
    "sample_flight": "calib.data.samples",
    "survey": "calib.surveys.survey",
    "write_report": "calib.report.campaign",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _homes)
