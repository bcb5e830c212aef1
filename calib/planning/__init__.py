"""Plans of calibrations without true distances: what to measure, and the expected accuracy of each delay."""

from calib.planning.settings import FlightPlanSettings, SurveyPlanSettings, read_whole

__all__ = ["FlightPlanSettings", "SurveyPlanSettings", "read_whole"]
