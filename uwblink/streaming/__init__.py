"""Streams of ranges, optionally corrected, from boards or a recording; and senders by UDP and WebSocket."""

from uwblink.streaming.senders import FoxgloveServer, UdpSender
from uwblink.streaming.sources import RangeListener, StreamedDifference, StreamedRange, stream, stream_printed

__all__ = [
    "FoxgloveServer",
    "RangeListener",
    "StreamedDifference",
    "StreamedRange",
    "UdpSender",
    "stream",
    "stream_printed",
]
