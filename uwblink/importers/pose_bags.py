"""Poses in ROS 1 and ROS 2 bags and MCAP files: the messages that carry them, and whose they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from uwblink.errors import ImportTableError
from uwblink.importers.bags import opened
from uwblink.twr import LATEST_NS

Row = tuple[int, str, list[float]]

DRIVERS: Final = frozenset(
    {
        "vrpn_client_node", "vrpn_mocap", "mocap", "mocap_node", "optitrack", "vicon", "vicon_bridge", "vicon_receiver",
        "natnet_ros", "natnet_ros2", "natnet", "qualisys", "qualisys_node", "motion_capture", "rigid_bodies", "pose",
        "odom", "poses", "tf",
    }
)  # fmt: skip
"""What motion-capture nodes call all of their topics, beside the name of a body."""


def read_bag(path: Path, topics: Mapping[str, str] | None = None) -> Iterator[Row]:
    """Yield time in nanoseconds, body, and x y z qx qy qz qw of every pose; raises `ImportTableError`.

    `topics` are those to read by the body that they are of. Without it all topics of PoseStamped are, or, where there
    are none, all of the next kind of `MESSAGES`; a body is what a topic is called beside the name of its driver, and
    that of a transform its child frame.
    """
    with opened(path) as bag:
        wanted = _chosen(path, bag.kinds, topics)
        for topic, kind, _, message in bag.messages(wanted):
            for time_ns, child, values in _poses(path, topic, kind, message):
                yield time_ns, wanted[topic] or child or body_of(topic), values


def _poses(path: Path, topic: str, kind: str, message: Any) -> list[Row]:
    try:
        return list(MESSAGES[kind](message))
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        # JSON need not hold what its schema is called after.
        raise ImportTableError(f"{path}: a message of {topic[:80]!r} is no {kind}") from error


def body_of(topic: str) -> str:
    """Return the body of a topic: its first part that is not what motion-capture nodes call all of theirs."""
    parts = [part for part in topic.split("/") if part and part not in DRIVERS]
    return parts[0] if parts else topic


def _chosen(path: Path, kinds: Mapping[str, str], topics: Mapping[str, str] | None) -> dict[str, str | None]:
    """Return the topics to read and the bodies they are of; None where the message or the topic's name says it."""
    if topics:
        for topic in topics.values():
            if kinds.get(topic) not in MESSAGES:
                what = kinds.get(topic, "not there")
                known = ", ".join(sorted(name for name, kind in kinds.items() if kind in MESSAGES)) or "none"
                raise ImportTableError(f"{path}: topic {topic[:80]!r} is {what}; topics with poses are {known}")
        return {topic: body for body, topic in topics.items()}
    for kind in MESSAGES:
        found = [topic for topic, its in kinds.items() if its == kind]
        if found:
            return dict.fromkeys(found)
    raise ImportTableError(
        f"{path}: no topic of {', '.join(name.replace('/msg', '') for name in MESSAGES)}; "
        f"found {', '.join(sorted(set(kinds.values()))) or 'nothing'}"
    )


def _time_ns(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _values(position: Any, attitude: Any) -> list[float]:
    return [position.x, position.y, position.z, attitude.x, attitude.y, attitude.z, attitude.w]


def _pose_stamped(message: Any) -> Iterator[tuple[int, str, list[float]]]:
    yield _time_ns(message.header), "", _values(message.pose.position, message.pose.orientation)


def _with_covariance(message: Any) -> Iterator[tuple[int, str, list[float]]]:
    yield _time_ns(message.header), "", _values(message.pose.pose.position, message.pose.pose.orientation)


def _transform(message: Any) -> Iterator[tuple[int, str, list[float]]]:
    place = message.transform
    # Vicon's frames are called vicon/drone/drone.
    parts = [part for part in message.child_frame_id.split("/") if part and part not in DRIVERS]
    yield _time_ns(message.header), parts[0] if parts else "", _values(place.translation, place.rotation)


def _transforms(message: Any) -> Iterator[tuple[int, str, list[float]]]:
    for one in message.transforms:
        yield from _transform(one)


def _of_json(message: Any, position: Any, attitude: Any) -> Iterator[Row]:
    when = message["timestamp"]
    values = [float(position[axis]) for axis in "xyz"] + [float(attitude[axis]) for axis in "xyzw"]
    parts = [part for part in str(message.get("child_frame_id", "")).split("/") if part and part not in DRIVERS]
    time_ns = int(when["sec"]) * 1_000_000_000 + int(when["nsec"])
    if abs(time_ns) > LATEST_NS or not all(map(math.isfinite, values)):
        raise ValueError
    yield time_ns, parts[0] if parts else "", values


def _pose_in_frame(message: Any) -> Iterator[Row]:
    yield from _of_json(message, message["pose"]["position"], message["pose"]["orientation"])


def _frame_transform(message: Any) -> Iterator[Row]:
    yield from _of_json(message, message["translation"], message["rotation"])


MESSAGES: Final[dict[str, Callable[[Any], Iterator[tuple[int, str, list[float]]]]]] = {
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _with_covariance,
    "geometry_msgs/msg/TransformStamped": _transform,
    "nav_msgs/msg/Odometry": _with_covariance,
    "tf2_msgs/msg/TFMessage": _transforms,
    "foxglove.PoseInFrame": _pose_in_frame,
    "foxglove.FrameTransform": _frame_transform,
}
"""The messages that carry poses, those first that are taken where a bag has several kinds."""
