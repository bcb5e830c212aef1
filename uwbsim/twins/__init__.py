"""Scenarios fitted to recordings, and how well they fit."""

from uwbsim.twins.fitting import LEVEL, Compared, Twin, check_name

__all__ = ["LEVEL", "Compared", "Twin", "check_name"]
