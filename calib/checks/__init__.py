"""Checks with p-values, of recordings and of fits, in one table with one budget of false alarms."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from calib.checks.examine import CHECKS
    from calib.checks.recording_view import examined_part

__all__ = ["CHECKS", "examined_part"]

_HOMES: Final = {"CHECKS": "calib.checks.examine", "examined_part": "calib.checks.recording_view"}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
