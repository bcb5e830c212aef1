"""The recording: file, tables, summary, and distances between its tags."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwblink.recording.summary import Summary, counted

__all__ = [
    "Summary",
    "counted",
]

_HOMES: Final = {
    "Summary": "uwblink.recording.summary",
    "counted": "uwblink.recording.summary",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
