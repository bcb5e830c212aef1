"""Scenarios fitted to recordings, and how well they fit."""

from uwbsim.twins.fitting import LEVEL, Compared, Side, Twin, check_name

__all__ = ["LEVEL", "Compared", "Side", "Twin", "check_name"]
