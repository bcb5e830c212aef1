"""What the package offers: the names that are imported on first use (`uwblink.lazy`)."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # so that mypy follows other imports first
    from calib import calibration as calibration
    from calib import data as data
    from calib import evaluation as evaluation
    from calib.calibration.applying import CorrectedRanges as CorrectedRanges
    from calib.calibration.comparison import compare as compare
    from calib.calibration.correction import apply as apply
    from calib.calibration.formats import export as export
    from calib.calibration.model import Calibration as Calibration
    from calib.calibration.model import load_calibration as load_calibration
    from calib.checks.examine import examine as examine
    from calib.data.ranges import Ranges as Ranges
    from calib.data.samples import sample_flight as sample_flight
    from calib.data.sources import load_ranges as load_ranges
    from calib.errors import BadInputError as BadInputError
    from calib.errors import CalibError as CalibError
    from calib.errors import UnanswerableError as UnanswerableError
    from calib.estimator.losses import register_loss as register_loss
    from calib.evaluation.localization import localize as localize
    from calib.evaluation.onboard import OnboardSettings as OnboardSettings
    from calib.evaluation.onboard import localize_onboard as localize_onboard
    from calib.evaluation.statistics import evaluate as evaluate
    from calib.evaluation.team import TeamSettings as TeamSettings
    from calib.evaluation.team import localize_team as localize_team
    from calib.fitting.fitting import add_tag as add_tag
    from calib.fitting.fitting import fit as fit
    from calib.fitting.result import FitResult as FitResult
    from calib.planning.flights import plan_flight as plan_flight
    from calib.planning.result import FlightPlan as FlightPlan
    from calib.planning.result import Plan as Plan
    from calib.planning.settings import FlightPlanSettings as FlightPlanSettings
    from calib.planning.settings import SurveyPlanSettings as SurveyPlanSettings
    from calib.planning.surveys import plan as plan
    from calib.report.campaign import run_campaign as run_campaign
    from calib.report.campaign import write_report as write_report
    from calib.report.sections import register_report_section as register_report_section
    from calib.settings import FitSettings as FitSettings
    from calib.settings import FlightSettings as FlightSettings
    from calib.settings import SurveySettings as SurveySettings
    from calib.surveys.knowledge import Knowledge as Knowledge
    from calib.surveys.knowledge import KnownPosition as KnownPosition
    from calib.surveys.result import SurveyResult as SurveyResult
    from calib.surveys.survey import sample_arrangements as sample_arrangements
    from calib.surveys.survey import survey as survey
    from calib.trajectories.fitting import fit_from_ranges as fit_from_ranges
