"""Checks with p-values: of recordings in a table, of fits as score tests, with one budget of false alarms."""

from calib.checks.recording_view import examined_part

__all__ = ["examined_part"]
