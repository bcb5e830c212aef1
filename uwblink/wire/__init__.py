"""What the boards say: messages, fields, the codec, and reports in bulk."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwblink.wire.messages import GetMaxFrame, MaxFrameReport, RangeReport

__all__ = [
    "GetMaxFrame",
    "MaxFrameReport",
    "RangeReport",
]

_HOMES: Final = {
    "GetMaxFrame": "uwblink.wire.messages",
    "MaxFrameReport": "uwblink.wire.messages",
    "RangeReport": "uwblink.wire.messages",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
