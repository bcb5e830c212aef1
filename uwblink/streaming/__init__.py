"""Ranges as they come, corrected: from boards, or from a recording in its own time; and ways to send them on."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwblink.streaming.foxglove_server import FoxgloveServer
    from uwblink.streaming.ranges import StreamedRange
    from uwblink.streaming.sources import RangeListener, stream
    from uwblink.streaming.udp import UdpSender

__all__ = [
    "FoxgloveServer",
    "RangeListener",
    "StreamedRange",
    "UdpSender",
    "stream",
]

_HOMES: Final = {
    "FoxgloveServer": "uwblink.streaming.foxglove_server",
    "RangeListener": "uwblink.streaming.sources",
    "StreamedRange": "uwblink.streaming.ranges",
    "UdpSender": "uwblink.streaming.udp",
    "stream": "uwblink.streaming.sources",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
