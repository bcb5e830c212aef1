"""The language of DWM1000 ranging boards: device time, wire messages, formulas, recordings.

>>> import uwblink
>>> x = uwblink.Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
>>> uwblink.raw_range(x).round(3).tolist()
[4.69]
"""

from typing import TYPE_CHECKING

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwblink import boards as boards
    from uwblink import exporters as exporters
    from uwblink import importers as importers
    from uwblink import recording as recording
    from uwblink import streaming as streaming
    from uwblink import wire as wire
    from uwblink.boards.board import Board
    from uwblink.boards.listeners import Heard, Listener
    from uwblink.boards.ranging_plan import RangingPlan
    from uwblink.boards.record import record
    from uwblink.errors import UwblinkError
    from uwblink.importers import import_recording, register_importer
    from uwblink.protocols.table import PROTOCOLS, ProtocolMessage, RangingProtocol, register_protocol
    from uwblink.recording.contents import Contents, load
    from uwblink.recording.file import Recording
    from uwblink.recording.schema import Arrangement, KnownDistance, Poses, Tag
    from uwblink.streaming.sources import StreamedRange, stream
    from uwblink.ticks import SPEED_OF_LIGHT
    from uwblink.twr import Exchanges, raw_range
    from uwblink.wire.messages import register_message

__version__ = "0.3.0"

__all__ = [
    "PROTOCOLS",
    "SPEED_OF_LIGHT",
    "Arrangement",
    "Board",
    "Contents",
    "Exchanges",
    "Heard",
    "KnownDistance",
    "Listener",
    "Poses",
    "ProtocolMessage",
    "RangingPlan",
    "RangingProtocol",
    "Recording",
    "StreamedRange",
    "Tag",
    "UwblinkError",
    "import_recording",
    "load",
    "raw_range",
    "record",
    "register_importer",
    "register_message",
    "register_protocol",
    "stream",
]

_homes = {
    "PROTOCOLS": "uwblink.protocols.table",
    "SPEED_OF_LIGHT": "uwblink.ticks",
    "Arrangement": "uwblink.recording.schema",
    "Board": "uwblink.boards.board",
    "Contents": "uwblink.recording.contents",
    "Exchanges": "uwblink.twr",
    "Heard": "uwblink.boards.listeners",
    "KnownDistance": "uwblink.recording.schema",
    "Listener": "uwblink.boards.listeners",
    "Poses": "uwblink.recording.schema",
    "ProtocolMessage": "uwblink.protocols.table",
    "RangingPlan": "uwblink.boards.ranging_plan",
    "RangingProtocol": "uwblink.protocols.table",
    "Recording": "uwblink.recording.file",
    "StreamedRange": "uwblink.streaming.sources",
    "Tag": "uwblink.recording.schema",
    "UwblinkError": "uwblink.errors",
    "import_recording": "uwblink.importers",
    "load": "uwblink.recording.contents",
    "raw_range": "uwblink.twr",
    "record": "uwblink.boards.record",
    "register_importer": "uwblink.importers",
    "register_message": "uwblink.wire.messages",
    "register_protocol": "uwblink.protocols.table",
    "stream": "uwblink.streaming.sources",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _homes)
