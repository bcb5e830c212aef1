"""Schemas of the JSON messages that leave the project: in MCAP files, and on a WebSocket.

Poses, frames and logs have those that Foxglove knows.
"""

from __future__ import annotations

from typing import Any, Final

RANGE: Final = "uwb.Range"
_NUMBER: Final = {"type": "number"}
_INTEGER: Final = {"type": "integer"}
_FLAG: Final = {"type": "boolean"}
_TEXT: Final = {"type": "string"}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_TIME: Final = _object(sec=_INTEGER, nsec=_INTEGER)
_VECTOR: Final = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION: Final = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
RANGE_NUMBERS: Final = (
    "range_m", "corrected_m", "sigma_m", "sigma_total_m", "mean_error_m", "tail_share", "tail_probability", "truth_m",
    "fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm",
)  # fmt: skip
RANGE_FLAGS: Final = ("clamped", "outlier")
SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    "foxglove.PoseInFrame": _object(
        timestamp=_TIME, frame_id=_TEXT, pose=_object(position=_VECTOR, orientation=_QUATERNION)
    ),
    "foxglove.FrameTransform": _object(
        timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_QUATERNION
    ),
    "foxglove.Log": _object(timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER),
    RANGE: _object(
        timestamp=_TIME, initiator=_INTEGER, target=_INTEGER, protocol=_TEXT,
        **dict.fromkeys(RANGE_NUMBERS, _NUMBER), **dict.fromkeys(RANGE_FLAGS, _FLAG),
    ),
    "uwb.Imu": _object(timestamp=_TIME, angular_velocity=_VECTOR, linear_acceleration=_VECTOR),
    "uwb.Height": _object(timestamp=_TIME, height_m=_NUMBER),
    "uwb.Temperature": _object(timestamp=_TIME, temperature_c=_NUMBER, supply_v=_NUMBER),
}  # fmt: skip
"""What messages hold, as JSON Schema; what is not known is left out of a message."""


def stamped(time_ns: int, content: dict[str, Any]) -> dict[str, Any]:
    """Return a message with its time, which Foxglove wants as seconds and nanoseconds."""
    sec, nsec = divmod(time_ns, 1_000_000_000)
    return {"timestamp": {"sec": sec, "nsec": nsec}} | content
