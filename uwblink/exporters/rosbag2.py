"""A recording as a bag of ROS 2 (Jazzy, stored as MCAP), of standard messages alone.

Poses as PoseStamped and tf, ranges as sensor_msgs/Range with their variance, a topic a pair, inertial readings as Imu,
heights as Range, temperatures as Temperature, faults as Log. Names become what topics may be called: other letters
turn into "_".
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from uwblink.arrays import Floats
from uwblink.errors import RecordingError
from uwblink.exporters.mcap import WORLD, fits_exchanges, timed_rows
from uwblink.recording.contents import READING_MB, Contents, pieces
from uwblink.recording.file import Recording


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

    def all(self, held: Contents) -> Iterator[tuple[int, str, str, Any]]:
        """Yield time in nanoseconds, topic, type and message of a piece of a recording, in order of time."""
        ranges, variances = held.exchanges.range_m, _variances(held)
        for time_ns, table, whose, values in timed_rows(held):
            if table == "poses":
                yield from self._poses(time_ns, whose, *values)
            elif table == "ranges":
                message = self._range(time_ns, f"uwb_{whose[0]}", float(ranges[values]), float(variances[values]))
                yield time_ns, f"/uwb/range_{whose[0]}_{whose[1]}", "sensor_msgs/msg/Range", message
            elif table == "imu":
                yield time_ns, f"/imu/{topic_name(whose)}", "sensor_msgs/msg/Imu", self._imu(time_ns, whose, values)
            elif table == "height":
                message = self._range(time_ns, whose, values[0], 0.0)
                yield time_ns, f"/height/{topic_name(whose)}", "sensor_msgs/msg/Range", message
            elif table == "temperature":
                message = self._new("sensor_msgs/Temperature", self._header(time_ns, f"uwb_{whose}"), values[0], 0.0)
                yield time_ns, f"/temperature/uwb_{whose}", "sensor_msgs/msg/Temperature", message
            else:
                warning = (30, whose, f"{values.kind}: {values.detail}", "", "", 0)
                yield (
                    time_ns,
                    "/faults",
                    "rcl_interfaces/msg/Log",
                    self._new("rcl_interfaces/Log", self._stamp(time_ns), *warning),
                )

    def _new(self, kind: str, *values: Any) -> Any:
        package, name = kind.split("/")
        return self._types[f"{package}/msg/{name}"](*values)

    def _header(self, time_ns: int, frame: str) -> Any:
        return self._new("std_msgs/Header", self._stamp(time_ns), frame)

    def _stamp(self, time_ns: int) -> Any:
        return self._new("builtin_interfaces/Time", *divmod(time_ns, 1_000_000_000))

    def _poses(
        self, time_ns: int, body: str, place: list[float], turn: list[float]
    ) -> Iterator[tuple[int, str, str, Any]]:
        attitude, header = self._new("geometry_msgs/Quaternion", *turn), self._header(time_ns, WORLD)
        pose = self._new("geometry_msgs/Pose", self._new("geometry_msgs/Point", *place), attitude)
        stamped = self._new("geometry_msgs/PoseStamped", header, pose)
        yield time_ns, f"/poses/{topic_name(body)}", "geometry_msgs/msg/PoseStamped", stamped
        moved = self._new("geometry_msgs/Transform", self._new("geometry_msgs/Vector3", *place), attitude)
        transform = self._new("geometry_msgs/TransformStamped", header, body, moved)
        yield time_ns, "/tf", "tf2_msgs/msg/TFMessage", self._new("tf2_msgs/TFMessage", [transform])

    def _range(self, time_ns: int, frame: str, range_m: float, variance: float) -> Any:
        # A field of view all round, and the 300 m that DW1000 boards reach in the open.
        header = self._header(time_ns, frame)
        return self._new("sensor_msgs/Range", header, 0, 2 * np.pi, 0.0, 300.0, range_m, variance)

    def _imu(self, time_ns: int, body: str, values: list[float]) -> Any:
        turn, pull = (self._new("geometry_msgs/Vector3", *part) for part in (values[:3], values[3:]))
        level, unknown = self._new("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0), np.zeros(9)
        # -1 stands first in the covariance of what an Imu does not measure, by the definition of the message.
        unmeasured = np.array([-1.0] + [0.0] * 8)
        return self._new(
            "sensor_msgs/Imu", self._header(time_ns, body), level, unmeasured, turn, unknown, pull, unknown
        )


def _variances(held: Contents) -> Floats:
    """Return the variances of ranges (n,), reflections counted in where that is known; 0 where nothing is."""
    if not fits_exchanges(held):
        return np.zeros(len(held.exchanges))
    total, noise = held.corrected["sigma_total_m"], held.corrected["sigma_m"]
    return np.asarray(np.nan_to_num(np.where(np.isfinite(total), total, noise) ** 2))
