"""What to measure with what one has, before anything is measured, and how well each delay will be known then."""

from calib.planning.commands import flight_commands, survey_commands

__all__ = ["flight_commands", "survey_commands"]
