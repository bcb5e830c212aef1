"""Motion-capture poses from text files and from bags of ROS 1, ROS 2 and MCAP (`uwbcal[bags]`), added to recordings.

The project's CSV has the columns `time_s` (or `time_ns`), `body`, `x, y, z` (metres) and `qx, qy, qz, qw` (body to
world). TUM has `time x y z qx qy qz qw` separated by blanks, and EuRoC `time_ns, x, y, z, qw, qx, qy, qz, ...` below a
line that begins with `#timestamp`, one body per file. Motive (OptiTrack), Vicon and Qualisys (6D) export a column for
each number of each body, below several lines of header: quaternions or Euler angles; rotation vectors or quaternions;
and rotation matrices, column by column. Their times start with the take.
"""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from io import TextIOWrapper
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final, TextIO

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from uwblink.arrays import Floats, Ints
from uwblink.errors import ImportTableError, RecordingExistsError, raising
from uwblink.importers.bags import open_bag
from uwblink.importers.column_map import DISTANCE_UNITS, TIME_UNITS, ColumnMap, load_map
from uwblink.importers.forms import plain_name
from uwblink.importers.plausibility import other_unit
from uwblink.importers.tables import check_text, opened
from uwblink.recording.distances import distances_m, find_offset
from uwblink.recording.file import Recording
from uwblink.recording.schema import POSE, Poses, Tag, load_places
from uwblink.text_files import number_in, require_regular
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
"""Message types with poses, in order of preference: the fields of position and attitude, and whether the child frame is
the name of the body."""

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
        raise ImportTableError(f"{path}: has no topics, because it is not a bag")
    else:
        with opened(path) as raw, TextIOWrapper(raw, "utf-8-sig", newline="") as file:
            check_text(path, raw.peek(4096))
            poses, turned = _from_text(path, file, body, stated)
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

    `topics` are the topics to read, by body. By default these are all topics of the first type of `MESSAGES` in the
    bag. The name of the body is the name of the topic without the driver's name, or the child frame of a transform.
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
                # The content of JSON messages may differ from their schema.
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
        # A ROS driver may give NaN, here None, while a body is not visible.
        known = [math.nan if number is None else float(number) for number in numbers]
        yield time_ns, _body_in(child), known  # Vicon's frames have names such as vicon/drone/drone


def _field(message: Any, path: str) -> Any:
    """Return a field of a field of a message."""
    for name in path.split("."):
        message = message[name]
    return message


@dataclass(frozen=True, slots=True)
class AddedPoses:
    """Added poses: number, bodies, offset, number of covered exchanges; and bodies without poses."""

    poses: int
    bodies: tuple[str, ...]
    offset_s: float
    exchanges: int
    covered: int
    missing: tuple[str, ...]


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

    `tags_from` is a file of TOML or JSON with `[[tags]]`, and `[[anchors]]` that stand still. `topics` are the topics
    of a bag to read, by body; `body` is the body of a file without names of bodies. `map_file` names the columns of CSV
    files. Raises `RecordingExistsError` where there are poses already, unless `force` replaces them, `ImportTableError`
    for unusable poses, and the errors of `load_places` and `Recording.open`; then the recording is unchanged.
    """
    shift_ns = None if offset == "auto" else _offset_ns(offset)
    files = source if isinstance(source, Mapping) else {body: source}
    if not files and tags_from is None:
        raise ImportTableError("found neither `source` with poses nor `tags_from` with anchors")
    stated = load_map(map_file) if map_file else ColumnMap()
    read = [_read(path, name, topics, stated) for name, path in files.items()]
    parts, unturned = [part for part, _ in read], {name for part, turned in read if not turned for name in part.body}
    what = ", ".join(str(path) for path in files.values()) or str(tags_from)
    given, anchors = load_places(tags_from) if tags_from else ((), {})
    poses, fixed = with_anchors(parts, anchors)
    with Recording.open(recording, update=True) as opened:
        if not force and (there := opened.count("poses")):
            raise RecordingExistsError(f"{recording}: holds {there} poses already; `force` replaces them")
        exchanges, heard = opened.exchanges(), opened.columns("differences")
        first, second, time_ns = exchanges.initiator, exchanges.target, exchanges.time_ns
        if not len(exchanges):
            first, second, time_ns = heard["plus"], heard["listener"], heard["time_ns"]
        placed = [tag for tag in (given or opened.tags()) if tag.tag not in anchors] + fixed
        if not len(time_ns) or (shift_ns is None and not len(exchanges)):
            raise ImportTableError(
                f"{recording}: holds no exchanges to {'add truth to' if shift_ns is not None else 'find the offset by'}"
            )
        bodies = set(names_in(poses.body))
        with_poses = [tag for tag in placed if tag.body in bodies]
        ids = [tag.tag for tag in with_poses]
        known = np.isin(first, ids) & np.isin(second, ids)
        # Places of anchors alone are useful for robots without poses; poses of bodies without tags are not.
        strange = parts and bodies.isdisjoint(tag.body for tag in placed if tag.tag not in anchors)
        if len(ids) < 2 or strange or not (known.any() or shift_ns is not None):
            found = ", ".join(sorted({tag.body for tag in placed})) or "none"
            lost = ", ".join(map(str, np.setdiff1d(np.append(first, second), [tag.tag for tag in placed])))
            raise ImportTableError(
                f"{what}: its bodies are {', '.join(sorted(bodies))}, but those of the tags are {found}; give the "
                f"bodies of {f'tags {lost}, which range,' if lost else 'the tags'} with `tags_from`"
            )
        if held := [tag for tag in with_poses if tag.body in unturned and any(tag.lever_arm_m)]:
            raise ImportTableError(
                f"{what}: has no attitudes (qx, qy, qz, qw) of {held[0].body}, but its tag {held[0].tag} has a lever "
                f"arm; without attitudes lever arms must be zero"
            )
        if shift_ns is None:
            _check_units(what, exchanges, poses, placed, int(exchanges.time_ns.min() - poses.time_ns.min()))
            shift_ns = find_offset(exchanges[known], poses, placed)
        moved = replace(poses, time_ns=poses.time_ns + shift_ns)
        truth = distances_m(moved, placed, first, second, time_ns)
        covered = int(np.count_nonzero(np.isfinite(truth)))
        if not covered and files:
            raise ImportTableError(
                f"{what}: no exchange is within the time of its poses, which end {_apart(time_ns, moved.time_ns)}; "
                f"give `offset` in seconds, or auto"
            )
        if len(exchanges):
            _check_units(what, exchanges, moved, placed)
        meta = {"poses_from": ", ".join(path.name for path in files.values()), "poses_offset_s": shift_ns * 1e-9}
        opened.replace_poses(moved, meta, placed if tags_from else None)
    missing = tuple(sorted({tag.body for tag in placed} - bodies))
    return AddedPoses(len(poses), tuple(sorted(bodies)), shift_ns * 1e-9, len(time_ns), covered, missing)


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
        "the ranges of the recording": lambda factor: ranges - distances(1.0, 1.0) / factor,
    }
    if found := other_unit(errors, "the ranges of the recording"):
        raise ImportTableError(f"{what}: {found}, not metres, by comparison of ranges and distances; convert them")


def with_anchors(parts: Sequence[Poses], places: Mapping[int, tuple[float, float, float]]) -> tuple[Poses, list[Tag]]:
    """Return poses in order of time with those of anchors, and the anchors as tags on bodies of their own.

    Single poses of standing bodies get the first time of the others.
    """
    anchors = [Tag(number, f"anchor{number}", (0.0, 0.0, 0.0)) for number in places]
    joined = [*parts, *(Poses.from_arrays([0], one.body, [places[one.tag]]) for one in anchors)]
    if len(joined) == 1:
        return joined[0], anchors
    first = min((int(part.time_ns.min()) for part in joined if len(part) > 1), default=0)
    moved = [part if len(part) > 1 else replace(part, time_ns=np.full(len(part), first)) for part in joined]
    return Poses.concatenate(moved).in_time_order(), anchors


def _offset_ns(text: str) -> int:
    with raising(ImportTableError, f"`offset`: found {text!r}, expected seconds or auto", ArithmeticError):
        if not abs(seconds := Decimal(text.strip())) <= 4_000_000_000:
            raise OverflowError
        return round(seconds * 10**9)


def _apart(exchanges_ns: np.ndarray, poses_ns: np.ndarray) -> str:
    early_s = (int(exchanges_ns.min()) - int(poses_ns.max())) * 1e-9
    late_s = (int(poses_ns.min()) - int(exchanges_ns.max())) * 1e-9
    return f"{early_s:.1f} s before they begin" if early_s > 0 else f"and begin {late_s:.1f} s after they end"


Lines = list[list[str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseLayout:
    """The columns and lines of poses in a form; columns are numbers from 0.

    `bodies` are the columns of position and attitude by body, with the name "" if a column has the body. `header` is
    the number of lines before the first pose. `gaps` tells whether poses may be missing while a body is not visible.
    `euler` is the order of Euler angles about the body's own axes, such as "XYZ".
    """

    form: str
    names: Sequence[str]
    time: int
    ns: float
    bodies: Mapping[str, Sequence[int]]
    header: int = 0
    metres: float = 1.0
    radians: float = 1.0
    euler: str = ""
    gaps: bool = True
    body: int | None = None
    comments: bool = False
    iso: bool = False


def _from_text(path: Path, file: TextIO, body: str | None, stated: ColumnMap) -> tuple[Poses, bool]:
    """Return the poses of a text file, and whether it has attitudes; without them all bodies have the identity.

    Quaternions need not have length one. `body` is the body of a file without names of bodies; `stated` names the
    columns of a CSV file, and the units of its times and positions. Raises `ImportTableError`.
    """
    first = file.readline()
    lines = chain([first], file)
    mark = max(",;\t", key=first.count)
    blanks = path.suffix.lower() not in (".csv", ".tsv")
    split: Iterator[list[str]] = (line.split() for line in lines) if blanks else csv.reader(lines, delimiter=mark)
    head = list(islice(split, 40))
    word = head[0][0].strip() if head and head[0] else ""
    if blanks or word.lower().startswith("#timestamp"):
        layout = _single(path, body, blanks=blanks)
    else:
        layout = _FORMS[word](path, [*head, [], []]) if word in _FORMS else _plain(path, head, body, stated)
    times, bodies, values = array("q"), list[str](), array("d")
    for row, cells in enumerate(chain(head[layout.header :], split), start=1 + layout.header):
        if not cells or (layout.comments and cells[0].startswith("#")):
            continue
        if (len(cells) < len(layout.names) and not layout.gaps) or (len(cells) > len(layout.names) and not layout.form):
            raise ImportTableError(f"{path}: row {row}: found {len(cells)} cells, expected {' '.join(layout.names)}")
        for name, places in layout.bodies.items():
            texts = [cells[k] if k < len(cells) else "" for k in (layout.time, *places)]
            texts[0] = _iso_ns(texts[0]) if layout.iso else texts[0]
            found = [number_in(text) for text in texts]
            # Where a body is lost, its position or its attitude is blank.
            lost = any(
                part and {text.strip().lower() for text in part} <= {"", "nan"} for part in (texts[1:4], texts[4:])
            )
            if (lost and len(cells) == len(layout.names)) or (
                layout.gaps and (not any(map(math.isfinite, found[1:])) or not any(found[1:]))
            ):
                continue
            named = name or (body or cells[layout.body or 0].strip())
            columns = zip((layout.time, *places), texts, found, strict=True)
            wrong = [(k, text, "a number") for k, text, value in columns if not math.isfinite(value)]
            wrong += [] if abs(found[0]) * layout.ns <= LATEST_NS else [(layout.time, texts[0], "a time")]
            wrong += [] if named else [(layout.body or 0, cells[layout.body or 0], "a name")]
            for place, cell, expected in wrong:
                raise ImportTableError(
                    f"{path}: row {row}: column {layout.names[place]!r}: found {cell!r}, expected {expected}"
                )
            times.append(round(Decimal(texts[0].strip()) * Decimal(layout.ns)))
            bodies.append(named)
            values.extend(found[1:])
    width = len(next(iter(layout.bodies.values()), (0, 0, 0)))
    table = np.array(values).reshape(-1, width)
    with raising(ImportTableError, f"{path}: its attitudes are no rotations", ValueError):
        turned = _quaternions(table[:, 3:] * layout.radians, layout.euler)
    values_of = np.column_stack([table[:, :3] * layout.metres, turned])
    return _poses(path, np.array(times, np.int64), np.array(bodies, np.str_), values_of), width > 3


def _quaternions(values: Floats, euler: str) -> Floats:
    """Return quaternions (n, 4) from none, rotation vectors or Euler angles (n, 3), quaternions, or matrices by column
    (n, 9)."""
    if values.shape[1] == 0:
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(values), 1))
    if values.shape[1] == 4 or not len(values):
        return values.reshape(-1, 4)
    if values.shape[1] == 3:
        return np.asarray((Rotation.from_euler(euler, values) if euler else Rotation.from_rotvec(values)).as_quat())
    return np.asarray(Rotation.from_matrix(values.reshape(-1, 3, 3).transpose(0, 2, 1)).as_quat())


def _iso_ns(text: str) -> str:
    """Return ISO 8601, UTC without a zone, as nanoseconds; other text unchanged."""
    try:
        moment = datetime.fromisoformat(text.strip())
    except ValueError:
        return text
    since = moment.replace(tzinfo=moment.tzinfo or UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    return str(since // timedelta(microseconds=1) * 1000)


def _single(path: Path, body: str | None, *, blanks: bool) -> PoseLayout:
    """Return the layout of TUM, with blanks between cells, or of EuRoC."""
    form, unit, quaternion = ("TUM", "s", POSE[3:]) if blanks else ("EuRoC", "ns", ("qw", "qx", "qy", "qz"))
    if not body:
        raise ImportTableError(f"{path}: a {form} file has no names of bodies; give the name with `body`")
    names = (f"time_{unit}", *POSE[:3], *quaternion)
    return PoseLayout(
        form=form, names=names, time=0, ns=TIME_UNITS[unit], bodies={body: [names.index(name) for name in POSE]},
        header=0 if blanks else 1, gaps=False, comments=True,
    )  # fmt: skip


_NAMES: Final = (
    {"time_s": r"(.*_)?(time|timestamp|stamp|t)(_(?P<unit>s|ms|us|ns))?"}
    | {"body": r"(rigid_?)?body(_name)?|object|subject|child_frame_id"}
    | {axis: rf"(p|pos|t|(.*_)?(position|translation))?_?{axis}(_(?P<unit>m|cm|mm))?" for axis in "xyz"}
    | {f"q{axis}": rf"(q|quat|rot|(.*_)?(quaternion|orientation|rotation))_?{axis}" for axis in "xyzw"}
)
"""Plain names of columns, as written by programs."""


def _plain(path: Path, head: Lines, body: str | None, stated: ColumnMap) -> PoseLayout:
    """Return the layout of CSV with the names of its columns in the first line."""
    names = [name.strip() for name in (head[0] if head else ())]
    found: dict[str, tuple[int, str | None]] = {}
    for ours, pattern in _NAMES.items():
        for k, name in enumerate(names):
            match = re.fullmatch(pattern, plain_name(name)) if ours not in stated.columns else None
            if name == stated.columns.get(ours, ours) or (match and ours not in found):
                found[ours] = k, match.groupdict().get("unit") if match else None
    needed = POSE if any(name in found for name in POSE[3:]) else POSE[:3]
    if missing := [name for name in ("time_s", *needed, "body") if name not in found and not (name == "body" and body)]:
        name = stated.columns.get(missing[0], missing[0])
        raise ImportTableError(
            f"{path}: column {name!r} is missing; there are {', '.join(names)[:400]}; "
            "expected a first line of time_s or time_ns, body (or `body` for all rows), x, y, z, qx, qy, qz, qw; "
            "a `map_file` can name them"
        )
    units = {found[axis][1] for axis in "xyz"}
    if len(units) > 1:
        raise ImportTableError(
            f"{path}: columns {', '.join(names[found[axis][0]] for axis in 'xyz')} have several units"
        )
    (time, time_unit), unit = found["time_s"], next(iter(units))
    first = head[1][time] if len(head) > 1 and time < len(head[1]) else ""
    iso = math.isnan(number_in(first)) and _iso_ns(first) != first
    time_unit = "ns" if iso else stated.units.get("time") or time_unit or "s"
    return PoseLayout(
        form="", names=names, time=time, ns=TIME_UNITS[time_unit], iso=iso,
        bodies={"": [found[name][0] for name in needed]}, header=1, gaps=False,
        metres=DISTANCE_UNITS[stated.units.get("distance") or unit or "m"], body=None if body else found["body"][0],
    )  # fmt: skip


def _header(path: Path, head: Lines, *words: str) -> int:
    """Return the number of the first line with these cells; raises `ImportTableError`."""
    for k, cells in enumerate(head):
        if set(words) <= {cell.strip() for cell in cells}:
            return k
    raise ImportTableError(f"{path}: its header has no line with {', '.join(words)}: export it with all lines")


def _motive(path: Path, head: Lines) -> PoseLayout:
    """Return the layout of Motive's CSV: lines of kinds, names, Rotation or Position, and axes, in any version.

    Euler angles are about the rotated axes (NaturalPoint's knowledge base, "Changes in Motive's reported Euler
    angles"), in degrees, in the order that the header names.
    """
    header = dict(zip(head[0][::2], head[0][1::2], strict=False))
    units = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
    unit, rotation = units.get(header.get("Length Units", "Meters").lower()), header.get("Rotation Type", "Quaternion")
    euler = rotation if sorted(rotation) == ["X", "Y", "Z"] else ""
    if unit is None or not (euler or rotation == "Quaternion"):
        raise ImportTableError(
            f"{path}: found {rotation} and {header.get('Length Units')}, export quaternions and metres"
        )
    types, kinds = _header(path, head, "Rigid Body"), _header(path, head, "Rotation", "Position")
    bodies: dict[str, dict[str, int]] = {}
    columns = zip(head[types], head[types + 1], head[kinds], head[kinds + 1], strict=False)
    for k, (kind, name, what, axis) in enumerate(columns):
        if kind == "Rigid Body" and what in ("Rotation", "Position"):
            bodies.setdefault(name, {})[("q" if what == "Rotation" else "") + axis.lower()] = k
    layout = PoseLayout(
        form="Motive", names=head[kinds + 1], time=1, ns=1e9, header=kinds + 2, metres=DISTANCE_UNITS[unit],
        bodies={}, euler=euler, radians=math.pi / 180 if euler else 1.0,
    )  # fmt: skip
    return _with_bodies(path, layout, bodies, (*POSE[:3], *(f"q{axis}" for axis in euler.lower())) if euler else POSE)


def _vicon(path: Path, head: Lines) -> PoseLayout:
    """Return the layout of Vicon's CSV: names, then axes, then units; RX, RY, RZ are a rotation vector without RW."""
    axes = _header(path, head, "Frame", "RX", "TX")
    rate = next((value for cells in head[:axes] if cells and (value := number_in(cells[0])) > 0), math.nan)
    bodies: dict[str, dict[str, int]] = {}
    name = ""
    for k, axis in enumerate(head[axes]):
        name = (head[axes - 1][k] if k < len(head[axes - 1]) else "").strip().split(":")[-1] or name
        if name and axis.strip()[1:] in "XYZW":
            bodies.setdefault(name, {})[axis.strip()] = k
    units = {cell.strip() for cell in head[axes + 1]} if axes + 1 < len(head) else set()
    fields = ("TX", "TY", "TZ", "RX", "RY", "RZ", *(["RW"] if "RW" in head[axes] else []))
    unit = next((one for one in ("mm", "cm", "m") if one in units), "mm")
    radians = math.pi / 180 if units & {"deg", "degrees"} and "RW" not in fields else 1.0
    layout = PoseLayout(
        form="Vicon", names=head[axes], time=0, ns=1e9 / rate, bodies={}, header=axes + 2,
        metres=DISTANCE_UNITS[unit], radians=radians,
    )  # fmt: skip
    return _with_bodies(path, layout, bodies, fields)


def _qualisys(path: Path, head: Lines) -> PoseLayout:
    """Return the layout of Qualisys' 6D TSV: lines of words and values, then a line of columns by body."""
    header = {cells[0]: cells[1:] for cells in head if len(cells) > 1}
    names, first = (
        [name.strip() for name in header.get("BODY_NAMES", ()) if name.strip()],
        _header(path, head, "Rot[0]"),
    )
    starts = [k for k, cell in enumerate(head[first]) if cell.strip().endswith("Rot[0]")]
    if len(starts) != len(names):
        raise ImportTableError(f"{path}: has {len(names)} BODY_NAMES and {len(starts)} bodies below: export 6D data")
    # Position, three angles and the residual come before the matrix.
    fields = ("x", "y", "z", *(f"r{k}" for k in range(9)))
    places = [dict(zip(fields, (k - 7, k - 6, k - 5, *range(k, k + 9)), strict=True)) for k in starts]
    timed, rate = head[first][1:2] == ["Time"], number_in(next(iter(header.get("FREQUENCY", ())), "")) or math.nan
    layout = PoseLayout(
        form="Qualisys", names=head[first], time=int(timed), ns=1e9 if timed else 1e9 / rate, bodies={},
        header=first + 1, metres=DISTANCE_UNITS["mm"],
    )  # fmt: skip
    return _with_bodies(path, layout, dict(zip(names, places, strict=True)), fields)


def _with_bodies(
    path: Path, layout: PoseLayout, bodies: Mapping[str, Mapping[str, int]], fields: Sequence[str]
) -> PoseLayout:
    """Return a layout with the bodies that have all fields; raises `ImportTableError` without bodies or a rate."""
    whole = {name: [found[one] for one in fields] for name, found in bodies.items() if set(fields) <= found.keys()}
    if not whole or not layout.ns > 0:
        lacking = "a frame rate" if whole else "rigid bodies"
        raise ImportTableError(f"{path}: a file of {layout.form} without {lacking}")
    return replace(layout, bodies=whole)


_FORMS: Final = {
    "Format Version": _motive,
    "Objects": _vicon,
    "Segments": _vicon,
    "FILE_VERSION": _qualisys,
    "NO_OF_FRAMES": _qualisys,
}
"""Forms by the first cell of a file."""
