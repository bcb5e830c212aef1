"""Scenarios: their models, and how files are read into them."""

from uwbsim.scenario.devices import with_antenna_delays
from uwbsim.scenario.loading import copy_scenarios, listed, shipped_scenarios

__all__ = ["copy_scenarios", "listed", "shipped_scenarios", "with_antenna_delays"]
