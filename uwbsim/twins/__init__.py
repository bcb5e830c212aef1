"""Scenarios fitted to recordings, and how well they fit."""

from uwbsim.twins.fitting import TWIN_LEVEL, Compared, Side, Twin, check_name

__all__ = ["TWIN_LEVEL", "Compared", "Side", "Twin", "check_name"]
