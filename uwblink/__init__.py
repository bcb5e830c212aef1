"""The language of DWM1000 ranging boards: device time, wire messages, formulas, recordings."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwblink.boards.board import Board
    from uwblink.boards.listeners import Heard, Listener
    from uwblink.boards.ranging_plan import RangingPlan
    from uwblink.boards.recorder import record
    from uwblink.errors import UwblinkError
    from uwblink.recording.file import Recording
    from uwblink.recording.schema import Poses, Tag
    from uwblink.ticks import SPEED_OF_LIGHT
    from uwblink.twr import PROTOCOLS, Exchanges, raw_range

__version__ = "0.1.0"

__all__ = [
    "PROTOCOLS",
    "SPEED_OF_LIGHT",
    "Board",
    "Exchanges",
    "Heard",
    "Listener",
    "Poses",
    "RangingPlan",
    "Recording",
    "Tag",
    "UwblinkError",
    "raw_range",
    "record",
]

_HOMES: Final = {
    "PROTOCOLS": "uwblink.twr",
    "SPEED_OF_LIGHT": "uwblink.ticks",
    "Board": "uwblink.boards.board",
    "Exchanges": "uwblink.twr",
    "Heard": "uwblink.boards.listeners",
    "Listener": "uwblink.boards.listeners",
    "Poses": "uwblink.recording.schema",
    "RangingPlan": "uwblink.boards.ranging_plan",
    "Recording": "uwblink.recording.file",
    "Tag": "uwblink.recording.schema",
    "UwblinkError": "uwblink.errors",
    "raw_range": "uwblink.twr",
    "record": "uwblink.boards.recorder",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
