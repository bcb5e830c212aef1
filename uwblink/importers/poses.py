"""Motion-capture poses from text files (`pose_files`) and from bags of ROS 1, ROS 2 and MCAP (`uwbcal[bags]`)."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.errors import ImportTableError, RecordingExistsError, raising
from uwblink.importers.bags import open_bag
from uwblink.importers.column_map import ColumnMap, load_map
from uwblink.importers.plausibility import other_unit
from uwblink.importers.pose_files import read_text_poses
from uwblink.importers.tables import reading
from uwblink.recording.distances import distances_m, find_offset
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses, Tag, load_places
from uwblink.text_files import require_regular
from uwblink.twr import LATEST_NS, Exchanges, names_in, raw_range

MESSAGES: Final = {
    "geometry_msgs/msg/PoseStamped": ("pose.position", "pose.orientation", False),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose.pose.position", "pose.pose.orientation", False),
    "geometry_msgs/msg/TransformStamped": ("transform.translation", "transform.rotation", True),
    "nav_msgs/msg/Odometry": ("pose.pose.position", "pose.pose.orientation", False),
    "tf2_msgs/msg/TFMessage": ("transform.translation", "transform.rotation", True),
    "foxglove.PoseInFrame": ("pose.position", "pose.orientation", False),
    "foxglove.FrameTransform": ("translation", "rotation", True),
}
"""Message types with poses, in order of preference: the fields of position and attitude, and whether the child frame
has the name of the body."""

DRIVERS: Final = frozenset(
    {
        "vrpn_client_node", "vrpn_mocap", "mocap", "mocap_node", "optitrack", "vicon", "vicon_bridge", "vicon_receiver",
        "natnet_ros", "natnet_ros2", "natnet", "qualisys", "qualisys_node", "motion_capture", "rigid_bodies", "pose",
        "odom", "poses", "tf",
    }
)  # fmt: skip
"""Parts of topic names that are not the name of a body."""


def read_poses(path: Path, body: str | None = None, topics: Mapping[str, str] | None = None) -> Poses:
    """Read poses from a file by its suffix; raises `ImportTableError`.

    `body` is the body of files without names of bodies; `topics` are the topics of a bag to read, by body.
    """
    return _read(path, body, topics, ColumnMap())[0]


def _read(path: Path, body: str | None, topics: Mapping[str, str] | None, stated: ColumnMap) -> tuple[Poses, bool]:
    """Return the poses of a file, and whether it has attitudes."""
    require_regular(path, ImportTableError, "file of poses", folders=True)
    kind = "bag" if path.is_dir() else path.suffix.lower().lstrip(".")
    known = ("bag", "csv", "db3", "mcap", "tsv", "tum", "txt")
    if kind not in known:
        raise ImportTableError(
            f"{path}: found {f'.{kind}' if kind else 'no suffix'}, expected one of .{', .'.join(known)}"
        )
    turned = True
    if kind in ("bag", "mcap", "db3"):
        poses = _from_bag(path, topics)
    elif topics:
        raise ImportTableError(f"{path}: has no topics; only bags have")
    else:
        with reading(path), path.open(encoding="utf-8-sig", newline="") as file:
            times, bodies, values, turned = read_text_poses(path, file, body, stated)
        poses = _poses(path, times, bodies, values)
    if not len(poses):
        raise ImportTableError(f"{path}: holds no poses")
    return poses, turned


def _poses(path: Path, time_ns: Ints, body: NDArray[np.str_], values: Floats) -> Poses:
    """Return poses in order of time; `values` (n, 7) are the columns of `POSE`."""
    norm = np.linalg.norm(values[:, 3:], axis=1)
    bad = np.flatnonzero((norm < 0.9) | (norm > 1.1))
    if len(bad):
        raise ImportTableError(f"{path}: pose {bad[0] + 1}: its quaternion has length {norm[bad[0]]:.3g}, expected 1")
    return Poses(time_ns, body, values[:, :3], values[:, 3:] / norm[:, None]).in_time_order()


def _from_bag(path: Path, topics: Mapping[str, str] | None) -> Poses:
    """Return the poses of a bag.

    `topics` are the topics to read, by body. By default these are all topics of the first type of `MESSAGES` that the
    bag has. The name of the body is the topic's without that of the driver, or the child frame of a transform.
    """
    times, bodies, values = list[int](), list[str](), array("d")
    with open_bag(path) as bag:
        wanted = _chosen_topics(path, bag.kinds, topics)
        for topic, kind, _, message in bag.messages(wanted):
            try:
                for time_ns, child, numbers in _of_message(kind, message):
                    times.append(time_ns)
                    bodies.append(wanted[topic] or child or _body_in(topic) or topic)
                    values.extend(numbers)
            except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
                # The content of JSON messages need not agree with the name of their schema.
                raise ImportTableError(f"{path}: a message of {topic[:80]!r} is no {kind}") from error
    return _poses(path, np.array(times, dtype=np.int64), np.array(bodies, np.str_), np.array(values).reshape(-1, 7))


def _body_in(name: str) -> str:
    """Return the body in the name of a topic or a frame: the first part that is not in `DRIVERS`; "" without one."""
    return next((part for part in name.split("/") if part and part not in DRIVERS), "")


def pose_topics(bag: Path) -> list[str]:
    """Return the topics of a bag that have poses; raises `ImportTableError`."""
    with open_bag(bag) as opened:
        return sorted(topic for topic, kind in opened.kinds.items() if kind in MESSAGES)


def _chosen_topics(path: Path, kinds: Mapping[str, str], topics: Mapping[str, str] | None) -> dict[str, str | None]:
    """Return the topics to read and their bodies; None if message or topic name the body."""
    known = {topic: kind for topic, kind in kinds.items() if kind in MESSAGES}
    for topic in (topics or {}).values():
        if topic not in known:
            listed = ", ".join(sorted(known)) or "none"
            there = kinds.get(topic, "not there")
            raise ImportTableError(f"{path}: topic {topic[:80]!r} is {there}; topics with poses are {listed}")
    if topics:
        return {topic: body for body, topic in topics.items()}
    if not known:
        raise ImportTableError(
            f"{path}: no topic of {', '.join(name.replace('/msg', '') for name in MESSAGES)}; "
            f"found {', '.join(sorted(set(kinds.values()))) or 'nothing'}"
        )
    first = min(known.values(), key=list(MESSAGES).index)
    return {topic: None for topic, kind in known.items() if kind == first}


def _of_message(kind: str, message: dict[str, Any]) -> Iterator[tuple[int, str, list[float]]]:
    """Yield time in nanoseconds, body (empty if the message has none), and the values of `POSE` for each pose."""
    (position, attitude, has_body), is_json = MESSAGES[kind], kind.startswith("foxglove.")
    for one in message["transforms"] if kind == "tf2_msgs/msg/TFMessage" else [message]:
        time_ns = _field(one, "timestamp" if is_json else "header.stamp")
        names = [*(f"{position}.{axis}" for axis in "xyz"), *(f"{attitude}.{axis}" for axis in "xyzw")]
        numbers = [_field(one, name) for name in names]
        if abs(time_ns) > LATEST_NS or (is_json and None in numbers):
            raise ValueError
        child = str(one.get("child_frame_id", "")) if has_body else ""
        # A driver of ROS may give NaN, here None, while it does not see a body.
        known = [math.nan if number is None else float(number) for number in numbers]
        yield time_ns, _body_in(child), known  # Vicon's frames are called vicon/drone/drone


def _field(message: Any, path: str) -> Any:
    """Return a field of a field of a message."""
    for name in path.split("."):
        message = message[name]
    return message


@dataclass(frozen=True, slots=True)
class AddedPoses:
    """Added poses: their number, bodies and offset, and the number of exchanges that they cover."""

    poses: int
    bodies: tuple[str, ...]
    offset_s: float
    exchanges: int
    covered: int


def add_poses(
    recording: Path,
    source: Path | Mapping[str, Path],
    *,
    offset: str = "0",
    tags_from: Path | None = None,
    body: str | None = None,
    topics: Mapping[str, str] | None = None,
    map_file: Path | None = None,
    force: bool = False,
) -> AddedPoses:
    """Add poses from a file, or from files by body, to a recording; `offset` is in seconds, or "auto".

    `tags_from` is a file of TOML or JSON with `[[tags]]`, and `[[anchors]]` that stand still. `topics` are those of a
    bag to read, by body; `body` names that of a file which does not. `map_file` names the columns of CSV files. Raises
    `RecordingExistsError` where there are poses already, unless `force` replaces them, `ImportTableError` for poses
    that cannot be used, what `load_places` and `Recording.open` raise; the recording stays as it was then.
    """
    shift_ns = None if offset == "auto" else _offset_ns(offset)
    files = source if isinstance(source, Mapping) else {body: source}
    stated = load_map(map_file) if map_file else ColumnMap()
    read = [_read(path, name, topics, stated) for name, path in files.items()]
    parts, unturned = [part for part, _ in read], {name for part, turned in read if not turned for name in part.body}
    what = ", ".join(str(path) for path in files.values()) or str(tags_from)
    given, anchors = load_places(tags_from) if tags_from else ((), {})
    fixed = [Tag(number, f"anchor{number}", (0.0, 0.0, 0.0)) for number in anchors]
    poses = _in_order([*parts, *(Poses.from_arrays([0], f"anchor{n}", [place]) for n, place in anchors.items())])
    with Recording.open(recording, update=True) as opened:
        if not force and (there := opened.count("poses")):
            raise RecordingExistsError(f"{recording}: holds {there} poses already; `force` replaces them")
        exchanges = opened.exchanges()
        placed = [tag for tag in (given or opened.tags()) if tag.tag not in anchors] + fixed
        if not len(exchanges):
            raise ImportTableError(f"{recording}: holds no exchanges to add truth to")
        bodies = set(names_in(poses.body))
        with_poses = [tag for tag in placed if tag.body in bodies]
        if len(with_poses) < 2:
            found = ", ".join(sorted({tag.body for tag in placed})) or "none"
            raise ImportTableError(
                f"{what}: its bodies are {', '.join(sorted(bodies))}, those of the tags {found}; "
                "give the bodies of the tags with `tags_from`"
            )
        if held := [tag for tag in with_poses if tag.body in unturned and any(tag.lever_arm_m)]:
            raise ImportTableError(
                f"{what}: has no attitudes (qx, qy, qz, qw) of {held[0].body}, whose tag {held[0].tag} has a lever "
                "arm; without attitudes lever arms must be zero"
            )
        if shift_ns is None:
            _check_units(what, exchanges, poses, placed, int(exchanges.time_ns.min() - poses.time_ns.min()))
            shift_ns = find_offset(exchanges, poses, placed)
        moved = replace(poses, time_ns=poses.time_ns + shift_ns)
        truth = distances_m(moved, placed, exchanges.initiator, exchanges.target, exchanges.time_ns)
        covered = int(np.count_nonzero(np.isfinite(truth)))
        if not covered:
            raise ImportTableError(
                f"{what}: no exchange lies within its poses, which end {_apart(exchanges.time_ns, moved.time_ns)}; "
                "give `offset` in seconds, or auto"
            )
        _check_units(what, exchanges, moved, placed)
        meta = {"poses_from": ", ".join(path.name for path in files.values()), "poses_offset_s": shift_ns * 1e-9}
        opened.replace_poses(moved, meta, placed if tags_from else None)
    return AddedPoses(len(poses), tuple(sorted(bodies)), shift_ns * 1e-9, len(exchanges), covered)


def _check_units(what: str, exchanges: Exchanges, poses: Poses, tags: Sequence[Tag], shift_ns: int = 0) -> None:
    """Raise `ImportTableError` if positions, lever arms or ranges are evidently not in metres."""
    some = exchanges[np.unique(np.linspace(0, len(exchanges) - 1, 2000).astype(np.int64))]
    ranges, time_ns = raw_range(some), some.time_ns - shift_ns

    def distances(place: float, arm: float) -> Floats:
        moved = replace(poses, position_m=poses.position_m * place)
        arms = [[arm * x for x in tag.lever_arm_m] for tag in tags]
        placed = [replace(tag, lever_arm_m=(x, y, z)) for tag, (x, y, z) in zip(tags, arms, strict=True)]
        return distances_m(moved, placed, some.initiator, some.target, time_ns)

    errors = {
        "its positions": lambda factor: ranges - distances(factor, 1.0),
        "lever arms": lambda factor: ranges - distances(1.0, factor),
        "its positions and the lever arms": lambda factor: ranges - distances(factor, factor),
        "the ranges": lambda factor: ranges - distances(1.0, 1.0) / factor,
    }
    if found := other_unit(errors):
        raise ImportTableError(f"{what}: {found}, not metres, by comparison of ranges and distances; convert them")


def _in_order(parts: list[Poses]) -> Poses:
    """Join poses in order of time; single poses of bodies that stand still get the first time of the others."""
    if len(parts) == 1:
        return parts[0]
    first = min((int(part.time_ns.min()) for part in parts if len(part) > 1), default=0)
    moved = [part if len(part) > 1 else replace(part, time_ns=np.full(len(part), first)) for part in parts]
    return Poses.concatenate(moved).in_time_order()


def _offset_ns(text: str) -> int:
    with raising(ImportTableError, f"`offset`: found {text!r}, expected seconds or auto", ArithmeticError):
        if not abs(seconds := Decimal(text.strip())) <= 4_000_000_000:
            raise OverflowError
        return round(seconds * 10**9)


def _apart(exchanges_ns: np.ndarray, poses_ns: np.ndarray) -> str:
    early_s = (int(exchanges_ns.min()) - int(poses_ns.max())) * 1e-9
    late_s = (int(poses_ns.min()) - int(exchanges_ns.max())) * 1e-9
    return f"{early_s:.1f} s before they begin" if early_s > 0 else f"and begin {late_s:.1f} s after they end"
