"""Twins: scenarios fitted to recordings, and the comparison of both."""

from uwbsim.twins.fitting import TWIN_LEVEL, Compared, Side, Twin, check_name

__all__ = ["TWIN_LEVEL", "Compared", "Side", "Twin", "check_name"]
