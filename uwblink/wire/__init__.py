"""The wire format of the boards: messages, fields, and the codec."""

from uwblink.wire.messages import GetMaxFrame, MaxFrameReport, RangeReport

__all__ = ["GetMaxFrame", "MaxFrameReport", "RangeReport"]
