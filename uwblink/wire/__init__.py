"""What the boards say: messages, fields, the codec, and reports in bulk."""

from uwblink.wire.messages import GetMaxFrame, MaxFrameReport, RangeReport

__all__ = ["GetMaxFrame", "MaxFrameReport", "RangeReport"]
