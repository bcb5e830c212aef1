"""Checks with p-values, of recordings and of fits, in one table with one budget of false alarms."""

from calib.checks.recording_view import examined_part

__all__ = ["examined_part"]
