"""Ranges as they come, corrected: from boards, or from a recording in its own time; and ways to send them on."""

from uwblink.streaming.senders import FoxgloveServer, UdpSender
from uwblink.streaming.sources import RangeListener, StreamedRange, stream

__all__ = [
    "FoxgloveServer",
    "RangeListener",
    "StreamedRange",
    "UdpSender",
    "stream",
]
