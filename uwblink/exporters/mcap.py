"""A recording as one MCAP file of messages: JSON for Foxglove and PlotJuggler, or a bag of ROS 2.

JSON messages are poses, frames, ranges, readings and faults. Their schemas are also those of the messages on a
WebSocket; poses, frames and logs have those that Foxglove knows.

The bag (Jazzy, stored as MCAP) has standard messages alone: poses as PoseStamped and tf, ranges as sensor_msgs/Range
with their variance, a topic a pair, and with their powers and skews as JSON in std_msgs/String, inertial readings as
Imu, heights as Range, temperatures as Temperature, faults as Log. Names become what topics may be called: other letters
turn into "_".
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from heapq import merge
from itertools import tee
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.writer import Writer

from uwblink.arrays import Floats
from uwblink.errors import RecordingError, raising
from uwblink.recording.contents import READING_MB, Contents, distances_by_poses_m, pieces
from uwblink.recording.file import Recording

WORLD: Final = "world"
RANGE: Final = "uwb.Range"
STRING: Final = "std_msgs/msg/String"
EXCHANGES: Final = "/uwb/exchanges"
"""The topic of a bag with the ranges of all pairs as JSON in texts, which hold what a sensor_msgs/Range does not."""

READINGS: Final = {
    "imu": ("body", "wx", "wy", "wz", "ax", "ay", "az"),
    "height": ("body", "height_m"),
    "temperature": ("tag", "temperature_c", "supply_v"),
}
"""Tables of readings: the column of the body or tag, and the columns of values."""

TimedRow = tuple[int, str, Any, Any]
"""Time in nanoseconds, table, body, tag or pair, and values; the range and its content, the fault itself."""

Encoded = list[tuple[str, str, Any]]
"""Topic, type and content of messages."""


_MEASURED: Final = ("range_m", "truth_m", "fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm")
_CORRECTED: Final = ("corrected_m", "sigma_m", "sigma_total_m", "mean_error_m", "tail_share", "tail_probability")


def _schemas() -> dict[str, dict[str, Any]]:
    number, integer, text, flag = ({"type": kind} for kind in ("number", "integer", "string", "boolean"))

    def message(**properties: Any) -> dict[str, Any]:
        return {"type": "object", "properties": properties}

    time = message(sec=integer, nsec=integer)
    vector = message(x=number, y=number, z=number)
    attitude = message(x=number, y=number, z=number, w=number)
    found = {
        "foxglove.PoseInFrame": {"frame_id": text, "pose": message(position=vector, orientation=attitude)},
        "foxglove.FrameTransform": {
            "parent_frame_id": text, "child_frame_id": text, "translation": vector, "rotation": attitude,
        },
        "foxglove.Log": {"level": integer, "message": text, "name": text, "file": text, "line": integer},
        RANGE: {
            "initiator": integer, "target": integer, "protocol": text,
            **dict.fromkeys(("range_m", *_CORRECTED, *_MEASURED[1:]), number), "clamped": flag, "outlier": flag,
        },
        "uwb.Imu": {"angular_velocity": vector, "linear_acceleration": vector},
        "uwb.Height": {"height_m": number},
        "uwb.Temperature": {"temperature_c": number, "supply_v": number},
    }  # fmt: skip
    return {name: message(timestamp=time, **properties) for name, properties in found.items()}


SCHEMAS: Final = _schemas()
"""JSON Schemas of the messages, which leave out unknown values."""


def stamped(time_ns: int, content: dict[str, Any]) -> dict[str, Any]:
    """Return a message with its time, in seconds and nanoseconds as Foxglove requires."""
    sec, nsec = divmod(time_ns, 1_000_000_000)
    return {"timestamp": {"sec": sec, "nsec": nsec}} | content


def timed_rows(held: Contents, by_poses: Floats) -> Iterator[TimedRow]:
    """Yield poses, ranges, readings and faults of a piece of a recording in order of time.

    `by_poses` are the distances (n,) of the exchanges by poses.
    """
    poses, e, content = held.poses, held.exchanges, _ranges(held, by_poses)
    columns = (poses.time_ns, poses.body, poses.position_m, poses.quaternion)
    posed = zip(*(column.tolist() for column in columns), strict=True)
    order = np.argsort(e.time_ns, kind="stable")
    ends = zip(e.initiator[order].tolist(), e.target[order].tolist(), strict=True)
    parts: list[Iterator[TimedRow]] = [
        ((time_ns, "poses", body, place) for time_ns, body, *place in posed),
        (
            (t, "ranges", of, (float(e.range_m[k]), content(k)))
            for t, of, k in zip(e.time_ns[order].tolist(), ends, order.tolist(), strict=True)
        ),
    ]
    parts += [_readings(table, getattr(held, table)) for table in READINGS]
    parts.append((f.time_ns, "faults", f.board, f) for f in sorted(held.faults, key=lambda fault: fault.time_ns))
    return merge(*parts, key=lambda row: row[0])


def _readings(table: str, columns: Any) -> Iterator[TimedRow]:
    rows = zip(*(columns[name].tolist() for name in ("time_ns", *READINGS[table])), strict=True) if columns else ()
    return ((time_ns, table, whose, values) for time_ns, whose, *values in rows)


def _write(
    recording: Path,
    form: str,
    encode: Callable[[int, str, Any, Any], Encoded],
    publish: Callable[[int, str, str, Any], object],
) -> int:
    """Publish the messages of all rows of a recording in order of time; returns their number.

    `encode` takes a row as `timed_rows` yields it, `publish` time, topic, type and content of a message.

    Raises `RecordingError` for times before 1970 and for values that the form cannot represent.
    """
    count = 0
    with Recording.open(recording, memory_mb=READING_MB) as opened:
        held, same = tee(pieces(opened))
        by_poses = distances_by_poses_m(opened, (one.exchanges for one in same))
        for row in (row for piece in zip(held, by_poses, strict=True) for row in timed_rows(*piece)):
            if row[0] < 0:
                raise RecordingError(f"{recording}: has times before 1970, which {form} cannot hold")
            for topic, kind, content in encode(*row):
                wrong = f"{recording}: {topic}: has a number that is not finite or too large"
                with raising(RecordingError, f"{wrong}, which {form} cannot represent", ValueError, OverflowError):
                    publish(row[0], topic, kind, content)
                count += 1
    return count


def write_mcap(recording: Path, folder: Path) -> dict[str, int]:
    """Write `recording.mcap`; returns its messages. Times before 1970 cannot be written and raise `RecordingError`."""
    with (folder / "recording.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(library="uwbcal")
        schemas = {
            name: writer.register_schema(name, "jsonschema", json.dumps(layout).encode())
            for name, layout in SCHEMAS.items()
        }
        channel = cache(lambda topic, schema: writer.register_channel(topic, "json", schemas[schema]))

        def publish(time_ns: int, topic: str, schema: str, content: dict[str, Any]) -> None:
            data = json.dumps(stamped(time_ns, content), allow_nan=False).encode()
            writer.add_message(channel(topic, schema), time_ns, data, time_ns)

        count = _write(recording, "JSON in MCAP", lambda _, table, *row: _ENCODERS[table](*row), publish)
        writer.finish()  # type: ignore[no-untyped-call]  # the library does not say what it returns
    return {"recording.mcap": count}


def _ranges(held: Contents, by_poses: Floats) -> Callable[[int], dict[str, Any]]:
    """Return a function for the content of a range, with `corrected_m` and so on if ranges were corrected."""
    e = replace(held.exchanges, truth_m=np.where(np.isfinite(held.exchanges.truth_m), held.exchanges.truth_m, by_poses))
    columns = {name: getattr(e, name).tolist() for name in ("initiator", "target", "protocol", *_MEASURED)}
    if held.corrected:  # with the rows of the exchanges
        corrected = {name: column.tolist() for name, column in held.corrected.items() if name != "time_ns"}
        columns |= {"range_m": corrected.pop("raw_m"), **corrected}  # the measured range
    return lambda k: _known({name: column[k] for name, column in columns.items()})


def _known(row: dict[str, Any]) -> dict[str, Any]:
    """Leave out numbers that are not finite, which JSON does not have."""
    return {name: value for name, value in row.items() if not isinstance(value, float) or np.isfinite(value)}


def _vector(values: list[float]) -> dict[str, float]:
    return dict(zip("xyzw", values, strict=False))


def _of_pose(body: str, values: Any) -> Encoded:
    position, attitude = map(_vector, values)
    pose = {"frame_id": WORLD, "pose": {"position": position, "orientation": attitude}}
    frames = {"parent_frame_id": WORLD, "child_frame_id": body, "translation": position, "rotation": attitude}
    return [(f"/poses/{body}", "foxglove.PoseInFrame", pose), ("/tf", "foxglove.FrameTransform", frames)]


def _of_imu(body: str, values: Any) -> Encoded:
    turn, pull = (_known(_vector(part)) for part in (values[:3], values[3:]))
    return [(f"/imu/{body}", "uwb.Imu", {"angular_velocity": turn, "linear_acceleration": pull})]


def _of_fault(board: str, fault: Any) -> Encoded:
    text = {"message": f"{fault.kind}: {fault.detail}", "name": board, "file": "", "line": 0}
    return [("/faults", "foxglove.Log", {"level": 3, **text})]  # a warning


_ENCODERS: Final[dict[str, Callable[[Any, Any], Encoded]]] = {
    "poses": _of_pose,
    "ranges": lambda ends, values: [(f"/ranges/{ends[0]}_{ends[1]}", RANGE, values[1])],
    "imu": _of_imu,
    "height": lambda body, values: [(f"/height/{body}", "uwb.Height", _known({"height_m": values[0]}))],
    "temperature": lambda tag, values: [
        (f"/temperature/{tag}", "uwb.Temperature", _known(dict(zip(READINGS["temperature"][1:], values, strict=True))))
    ],
    "faults": _of_fault,
}
"""The JSON messages of a row by its table; their types are names of `SCHEMAS`."""


def write_rosbag2(recording: Path, folder: Path) -> dict[str, int]:
    """Write the bag `rosbag2`; returns its messages.

    Raises `RecordingError` where rosbags is not installed, for times before 1970, and for values beyond 32-bit floats.
    """
    with raising(RecordingError, "writing bags needs rosbags; pip install 'uwbcal[bags]'", ImportError):
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(folder / "rosbag2", version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = cache(lambda topic, kind: bag.add_connection(topic, kind, typestore=store))

        def publish(time_ns: int, topic: str, kind: str, message: Any) -> None:
            bag.write(connection(topic, kind), time_ns, store.serialize_cdr(message, kind))

        return {"rosbag2": _write(recording, "bags", _RosMessages(store.types).encode, publish)}


def topic_name(text: str) -> str:
    """Return a text as a part of a topic's name: letters, digits and "_", not a digit first."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", text)
    return plain if re.match(r"[A-Za-z]", plain) else f"b{plain}"


class _RosMessages:
    """Makes messages of a recording's rows, by the types of a store."""

    def __init__(self, types: Any) -> None:
        self._types = types

    def encode(self, time_ns: int, table: str, whose: Any, values: Any) -> Encoded:
        """Return the messages of a row."""
        encoders: dict[str, Callable[[Any, Any, Any], list[tuple[str, Any]]]] = {
            "poses": self._poses,
            "ranges": self._ranges,
            "imu": self._imu,
            "height": lambda stamp, body, values: [
                (f"/height/{topic_name(body)}", self._range(stamp, body, values[0], 0.0))
            ],
            "temperature": lambda stamp, tag, values: [
                (
                    f"/temperature/uwb_{tag}",
                    self._new("sensor_msgs/Temperature", self._header(stamp, f"uwb_{tag}"), values[0], 0.0),
                )
            ],
            "faults": lambda stamp, board, fault: [
                (
                    "/faults",
                    self._new("rcl_interfaces/Log", stamp, 30, board, f"{fault.kind}: {fault.detail}", "", "", 0),
                )
            ],
        }
        stamp = self._new("builtin_interfaces/Time", *divmod(time_ns, 1_000_000_000))
        return [(topic, message.__msgtype__, message) for topic, message in encoders[table](stamp, whose, values)]

    def _new(self, kind: str, *values: Any) -> Any:
        package, name = kind.split("/")
        return self._types[f"{package}/msg/{name}"](*values)

    def _header(self, stamp: Any, frame: str) -> Any:
        return self._new("std_msgs/Header", stamp, frame)

    def _poses(self, stamp: Any, body: str, pose: list[list[float]]) -> list[tuple[str, Any]]:
        place, turn = pose
        attitude, header = self._new("geometry_msgs/Quaternion", *turn), self._header(stamp, WORLD)
        posed = self._new("geometry_msgs/Pose", self._new("geometry_msgs/Point", *place), attitude)
        moved = self._new("geometry_msgs/Transform", self._new("geometry_msgs/Vector3", *place), attitude)
        transform = self._new("geometry_msgs/TransformStamped", header, body, moved)
        return [
            (f"/poses/{topic_name(body)}", self._new("geometry_msgs/PoseStamped", header, posed)),
            ("/tf", self._new("tf2_msgs/TFMessage", [transform])),
        ]

    def _ranges(self, stamp: Any, ends: tuple[int, int], values: tuple[float, dict[str, Any]]) -> list[tuple[str, Any]]:
        range_m, content = values
        # With reflections where that is known; 0 where nothing is.
        sigma_m = content.get("sigma_total_m", content.get("sigma_m", 0.0))
        return [
            (f"/uwb/range_{ends[0]}_{ends[1]}", self._range(stamp, f"uwb_{ends[0]}", range_m, sigma_m**2)),
            (EXCHANGES, self._new("std_msgs/String", json.dumps(content))),
        ]

    def _range(self, stamp: Any, frame: str, range_m: float, variance: float) -> Any:
        # A field of view all round, and the 300 m that DW1000 boards reach in the open.
        limits, header = (2 * np.pi, 0.0, 300.0), self._header(stamp, frame)
        return self._new("sensor_msgs/Range", header, 0, *limits, range_m, variance)

    def _imu(self, stamp: Any, body: str, values: list[float]) -> list[tuple[str, Any]]:
        turn, pull = (self._new("geometry_msgs/Vector3", *part) for part in (values[:3], values[3:]))
        level, unknown = self._new("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0), np.zeros(9)
        # -1 stands first in the covariance of what an Imu does not measure, by the definition of the message.
        readings = (level, np.array([-1.0] + [0.0] * 8), turn, unknown, pull, unknown)
        return [(f"/imu/{topic_name(body)}", self._new("sensor_msgs/Imu", self._header(stamp, body), *readings))]
