"""Recordings: the file and its tables, summaries, and distances between tags."""

from uwblink.recording.antenna_delays import AntennaDelay, AntennaDelays, delays_in_meta, load_antenna_delays
from uwblink.recording.summary import IMPOSSIBLE_PPM, Summary, clock_skews, counted, target_faster_ppm

__all__ = [
    "IMPOSSIBLE_PPM",
    "AntennaDelay",
    "AntennaDelays",
    "Summary",
    "clock_skews",
    "counted",
    "delays_in_meta",
    "load_antenna_delays",
    "target_faster_ppm",
]
