"""The recording: file, tables, summary, and distances between its tags."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwblink.recording.antenna_delays import AntennaDelay, AntennaDelays, delays_in_meta, load_antenna_delays
    from uwblink.recording.relative_clocks import clock_skews
    from uwblink.recording.summary import Summary, counted

__all__ = [
    "AntennaDelay",
    "AntennaDelays",
    "Summary",
    "clock_skews",
    "counted",
    "delays_in_meta",
    "load_antenna_delays",
]

_HOMES: Final = {
    "Summary": "uwblink.recording.summary",
    "clock_skews": "uwblink.recording.relative_clocks",
    "counted": "uwblink.recording.summary",
    **dict.fromkeys(
        ("AntennaDelay", "AntennaDelays", "delays_in_meta", "load_antenna_delays"), "uwblink.recording.antenna_delays"
    ),
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
