"""A recording as a bag of ROS 2 (Jazzy, stored as MCAP), of standard messages alone.

Poses as PoseStamped and tf, ranges as sensor_msgs/Range with their variance, a topic a pair, inertial readings as Imu,
heights as Range, temperatures as Temperature, faults as Log. Names become what topics may be called: other letters
turn into "_".
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import Any, Final

import numpy as np

from uwblink.errors import RecordingError
from uwblink.exporters.corrections import variances
from uwblink.recording.contents import READING_MB, Contents, pieces
from uwblink.recording.file import Recording

WORLD: Final = "world"
WARN: Final = 30
"""The level of a Log that faults have."""

ALL_ROUND_RAD: Final = 2 * np.pi
FARTHEST_M: Final = 300.0
"""What DW1000 boards reach in the open."""

UNKNOWN: Final = np.array([-1.0] + [0.0] * 8)
"""A covariance of what an Imu does not measure, by the definition of the message."""

Message = tuple[int, str, str, Any]
"""Time in nanoseconds, topic, type, message."""


def write_rosbag2(recording: Path, folder: Path) -> dict[str, int]:
    """Write the bag `rosbag2`; returns its messages.

    Raises `RecordingError` where rosbags is not installed, for times before 1970, and for values beyond 32-bit floats.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise RecordingError("writing bags needs rosbags; pip install 'uwbcal[bags]'") from error
    store = get_typestore(Stores.ROS2_JAZZY)
    made = _Messages(store.types)
    count, known = 0, dict[str, Any]()
    with (
        Recording.open(recording, memory_mb=READING_MB) as opened,
        Writer(folder / "rosbag2", version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP) as bag,
    ):
        for time_ns, topic, kind, message in (row for held in pieces(opened) for row in made.all(held)):
            if time_ns < 0:
                raise RecordingError(f"{recording}: has times before 1970, which bags cannot hold")
            if topic not in known:
                known[topic] = bag.add_connection(topic, kind, typestore=store)
            try:
                bag.write(known[topic], time_ns, store.serialize_cdr(message, kind))
            except OverflowError as error:
                raise RecordingError(f"{recording}: {topic} has a value that is too large for {kind}") from error
            count += 1
    return {"rosbag2": count}


def topic_name(text: str) -> str:
    """Return a text as a part of a topic's name: letters, digits and "_", not a digit first."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return plain if re.match(r"[A-Za-z]", plain) else f"b{plain}"


class _Messages:
    """Makes messages of a recording's rows, by the types of a store."""

    def __init__(self, types: Any) -> None:
        self._types = types

    def all(self, held: Contents) -> Iterator[Message]:
        """Yield all messages of a piece of a recording in order of time."""
        parts = (
            self.poses(held), self.ranges(held), self.imu(held), self.heights(held), self.temperatures(held),
            self.faults(held),
        )  # fmt: skip
        return merge(*parts, key=lambda row: row[0])

    def _new(self, kind: str, *values: Any) -> Any:
        package, name = kind.split("/")
        return self._types[f"{package}/msg/{name}"](*values)

    def _header(self, time_ns: int, frame: str) -> Any:
        return self._new("std_msgs/Header", self._stamp(time_ns), frame)

    def _stamp(self, time_ns: int) -> Any:
        return self._new("builtin_interfaces/Time", *divmod(time_ns, 1_000_000_000))

    def _vector(self, values: list[float]) -> Any:
        return self._new("geometry_msgs/Vector3", *values)

    def poses(self, held: Contents) -> Iterator[Message]:
        poses = held.poses
        columns = (poses.time_ns, poses.body, poses.position_m, poses.quaternion)
        for time_ns, body, place, turn in zip(*(column.tolist() for column in columns), strict=True):
            attitude = self._new("geometry_msgs/Quaternion", *turn)
            header = self._header(time_ns, WORLD)
            pose = self._new("geometry_msgs/Pose", self._new("geometry_msgs/Point", *place), attitude)
            stamped = self._new("geometry_msgs/PoseStamped", header, pose)
            yield time_ns, f"/poses/{topic_name(body)}", "geometry_msgs/msg/PoseStamped", stamped
            moved = self._new("geometry_msgs/Transform", self._vector(place), attitude)
            transform = self._new("geometry_msgs/TransformStamped", header, body, moved)
            yield time_ns, "/tf", "tf2_msgs/msg/TFMessage", self._new("tf2_msgs/TFMessage", [transform])

    def ranges(self, held: Contents) -> Iterator[Message]:
        e = held.exchanges
        order = np.argsort(e.time_ns, kind="stable")
        columns = (column[order].tolist() for column in (e.time_ns, e.initiator, e.target, e.range_m, variances(held)))
        for time_ns, initiator, target, range_m, variance in zip(*columns, strict=True):
            message = self._range(time_ns, f"uwb_{initiator}", range_m, variance)
            yield time_ns, f"/uwb/range_{initiator}_{target}", "sensor_msgs/msg/Range", message

    def _range(self, time_ns: int, frame: str, range_m: float, variance: float) -> Any:
        header = self._header(time_ns, frame)
        return self._new("sensor_msgs/Range", header, 0, ALL_ROUND_RAD, 0.0, FARTHEST_M, range_m, variance)

    def imu(self, held: Contents) -> Iterator[Message]:
        if not held.imu:
            return
        names = ("time_ns", "body", "wx", "wy", "wz", "ax", "ay", "az")
        level = self._new("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
        unsaid = np.zeros(9)
        for time_ns, body, *values in zip(*(held.imu[name].tolist() for name in names), strict=True):
            turn, pull = self._vector(values[:3]), self._vector(values[3:])
            header = self._header(time_ns, body)
            message = self._new("sensor_msgs/Imu", header, level, UNKNOWN, turn, unsaid, pull, unsaid)
            yield time_ns, f"/imu/{topic_name(body)}", "sensor_msgs/msg/Imu", message

    def heights(self, held: Contents) -> Iterator[Message]:
        if held.height:
            columns = (held.height[name].tolist() for name in ("time_ns", "body", "height_m"))
            for time_ns, body, height_m in zip(*columns, strict=True):
                message = self._range(time_ns, body, height_m, 0.0)
                yield time_ns, f"/height/{topic_name(body)}", "sensor_msgs/msg/Range", message

    def temperatures(self, held: Contents) -> Iterator[Message]:
        if held.temperature:
            columns = (held.temperature[name].tolist() for name in ("time_ns", "tag", "temperature_c"))
            for time_ns, tag, celsius in zip(*columns, strict=True):
                message = self._new("sensor_msgs/Temperature", self._header(time_ns, f"uwb_{tag}"), celsius, 0.0)
                yield time_ns, f"/temperature/uwb_{tag}", "sensor_msgs/msg/Temperature", message

    def faults(self, held: Contents) -> Iterator[Message]:
        for fault in sorted(held.faults, key=lambda fault: fault.time_ns):
            text = f"{fault.kind}: {fault.detail}"
            log = self._new("rcl_interfaces/Log", self._stamp(fault.time_ns), WARN, fault.board, text, "", "", 0)
            yield fault.time_ns, "/faults", "rcl_interfaces/msg/Log", log
