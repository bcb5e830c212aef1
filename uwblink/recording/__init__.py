"""The recording: file, tables, summary, and distances between its tags."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwblink.recording.relative_clocks import clock_skews
    from uwblink.recording.summary import Summary, counted

__all__ = [
    "Summary",
    "clock_skews",
    "counted",
]

_HOMES: Final = {
    "Summary": "uwblink.recording.summary",
    "clock_skews": "uwblink.recording.relative_clocks",
    "counted": "uwblink.recording.summary",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
