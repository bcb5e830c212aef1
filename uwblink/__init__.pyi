"""What the package offers: the names, and the rooms, that are imported on first use (`uwblink.lazy`)."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # so that mypy follows other imports first
    from uwblink import boards as boards
    from uwblink import exporters as exporters
    from uwblink import importers as importers
    from uwblink import recording as recording
    from uwblink import streaming as streaming
    from uwblink import wire as wire
    from uwblink.boards.board import Board as Board
    from uwblink.boards.listeners import Heard as Heard
    from uwblink.boards.listeners import Listener as Listener
    from uwblink.boards.ranging_plan import RangingPlan as RangingPlan
    from uwblink.boards.record import record as record
    from uwblink.errors import UwblinkError as UwblinkError
    from uwblink.importers import import_recording as import_recording
    from uwblink.importers import register_importer as register_importer
    from uwblink.protocols.table import PROTOCOLS as PROTOCOLS
    from uwblink.protocols.table import ProtocolMessage as ProtocolMessage
    from uwblink.protocols.table import RangingProtocol as RangingProtocol
    from uwblink.protocols.table import register_protocol as register_protocol
    from uwblink.recording.contents import Contents as Contents
    from uwblink.recording.contents import load as load
    from uwblink.recording.file import Recording as Recording
    from uwblink.recording.schema import Arrangement as Arrangement
    from uwblink.recording.schema import KnownDistance as KnownDistance
    from uwblink.recording.schema import Poses as Poses
    from uwblink.recording.schema import Tag as Tag
    from uwblink.streaming.sources import StreamedRange as StreamedRange
    from uwblink.streaming.sources import stream as stream
    from uwblink.ticks import SPEED_OF_LIGHT as SPEED_OF_LIGHT
    from uwblink.twr import Exchanges as Exchanges
    from uwblink.twr import raw_range as raw_range
    from uwblink.wire.messages import register_message as register_message

__version__: str
