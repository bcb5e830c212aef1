"""What to measure with what one has, before anything is measured, and how well each delay will be known then."""

from calib.planning.settings import FlightPlanSettings, SurveyPlanSettings, read_whole

__all__ = ["FlightPlanSettings", "SurveyPlanSettings", "read_whole"]
