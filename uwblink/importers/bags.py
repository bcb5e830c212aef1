"""Bags of ROS 1, ROS 2 and MCAP: their messages, and exchanges in them by a map of the messages' fields.

Each message becomes a row of a table. Its columns are the fields of the message, such as `header.frame_id`; times
(`header.stamp`) are whole nanoseconds, and the elements of an array are `stamps.0`, `stamps.1` and so on. Further
columns are `topic`, `log_time`, and the places of a topic that is a template; the fields of JSON in a `std_msgs/String`
are fields of the message. The table is then read as JSON lines. The project's own MCAP files and bags need no map.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from uwblink.errors import ImportTableError, raising
from uwblink.exporters.mcap import EXCHANGES, RANGE, STRING
from uwblink.importers.column_map import ColumnMap, load_map
from uwblink.importers.templates import Template, is_template
from uwblink.text_files import require_regular

BAG_SUFFIXES: Final = (".bag", ".mcap", ".db3")
MAX_RECORD_BYTES: Final = 2**28
"""Largest record and largest unpacked chunk; both are held in memory. Writers make chunks of a few MB."""

OWN_COLUMNS: Final = {
    "from_id": "initiator", "to_id": "target", "range_m": "range_m", "gt_range_m": "truth_m",
    "fpp1": "fpp1_dbm", "fpp2": "fpp2_dbm", "skew1": "skew1_ppm", "skew2": "skew2_ppm",
}  # fmt: skip
"""The fields of the project's own ranges, by the names of a map."""

_OWN: Final = (
    (RANGE, "{_}", OWN_COLUMNS),
    (STRING, EXCHANGES, OWN_COLUMNS),
    ("sensor_msgs/msg/Range", "/uwb/range_{from_id:int}_{to_id:int}", {"range_m": "range"}),
)
"""Message types, topics and columns of the project's exports, the most complete first."""


@dataclass(frozen=True, slots=True)
class Bag:
    """An open bag: the message type of each topic, such as `geometry_msgs/msg/PoseStamped`, and the messages.

    `messages(topics)` yields topic, type, recording time in nanoseconds, and the message as a dictionary of JSON types;
    it raises `ImportTableError`.
    """

    path: Path
    kinds: Mapping[str, str]
    messages: Callable[[Iterable[str]], Iterator[tuple[str, str, int, dict[str, Any]]]]


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag by its suffix, or a folder with the files of a bag."""
    named = [path] if not path.is_dir() else [part for part in path.iterdir() if part.suffix != ".bag"]
    return any(part.suffix.lower() in BAG_SUFFIXES for part in named)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag; raises `ImportTableError` for other files and for damaged ones, also within the block.

    Messages of ROS need rosbags; an MCAP file of JSON messages does not.
    """
    require_regular(path, ImportTableError, "bag", folders=True)
    for part in path.iterdir() if path.is_dir() else ():
        require_regular(part, ImportTableError, "part of a bag", folders=True)
    wrong = f"{path}: cannot be read as a bag"
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise ImportTableError(f"{wrong}: the folder has no metadata.yaml, which `ros2 bag reindex` writes")
    with raising(ImportTableError, wrong, OSError, ValueError):
        is_mcap = path.is_file() and path.suffix.lower() == ".mcap"
        if is_mcap and next((encoding == "json" for *_, encoding in _channels(path)), False):
            yield _json_bag(path)
            return
        needed = f"{path}: reading bags needs rosbags; pip install 'uwbcal[bags]'"
        with raising(ImportTableError, needed, ImportError):
            from rosbags.highlevel import AnyReader, AnyReaderError
            from rosbags.typesys import Stores, get_typestore
        store = get_typestore(Stores.ROS2_HUMBLE)
        with raising(ImportTableError, wrong, AnyReaderError), AnyReader([path], default_typestore=store) as reader:
            yield _ros_bag(path, reader)


def _ros_bag(path: Path, reader: Any) -> Bag:
    """Return a bag of ROS messages, in any storage format."""

    def messages(topics: Iterable[str]) -> Iterator[tuple[str, str, int, dict[str, Any]]]:
        wanted = set(topics)
        used = [connection for connection in reader.connections if connection.topic in wanted]
        for connection in used:
            # All bags define their message types, except bags in SQLite of ROS 2 before Iron.
            if connection.msgtype not in reader.typestore.types:
                raise ImportTableError(
                    f"{path}: has no definition of {connection.msgtype}; "
                    "convert it to MCAP with ROS, which stores definitions"
                )
        for connection, time_ns, raw in reader.messages(connections=used):
            message = _plain(reader.deserialize(raw, connection.msgtype))
            yield connection.topic, connection.msgtype, int(time_ns), message

    return Bag(path, {connection.topic: connection.msgtype for connection in reader.connections}, messages)


def _json_bag(path: Path) -> Bag:
    """Return an MCAP file of JSON messages, as `uwblink export --to mcap` and Foxglove's libraries write them."""
    channels = {number: (topic, kind) for number, topic, kind, encoding in _channels(path) if encoding == "json"}

    def messages(topics: Iterable[str]) -> Iterator[tuple[str, str, int, dict[str, Any]]]:
        wanted = set(topics)
        for record in _records(path):
            topic, kind = channels.get(record.channel_id, ("", "")) if isinstance(record, Message) else ("", "")
            if isinstance(record, Message) and topic in wanted:
                wrong = f"{path}: a message of {topic[:80]!r} is not JSON"
                with raising(ImportTableError, wrong, ValueError, RecursionError):
                    message = _plain(json.loads(record.data))
                if not isinstance(message, dict):
                    raise ImportTableError(f"{path}: a message of {topic[:80]!r} is not an object of JSON")
                yield topic, kind, record.log_time, message

    return Bag(path, dict(channels.values()), messages)


def _channels(path: Path) -> Iterator[tuple[int, str, str, str]]:
    """Yield number, topic, schema and encoding of every channel."""
    schemas: dict[int, str] = {}
    for record in _records(path):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            yield record.id, record.topic, schemas.get(record.schema_id, ""), record.message_encoding


def _records(path: Path) -> Iterator[McapRecord]:
    """Yield the records of a file, and of its chunks; raises `ImportTableError` for a file that is damaged."""
    # The library passes on all exceptions of its decompressors for damaged data.
    damaged = raising(
        ImportTableError, f"{path}: is cut off or damaged", Exception, remedy="; was it written to the end?"
    )
    with path.open("rb") as file, damaged:
        for record in StreamReader(file, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES).records:
            if not isinstance(record, Chunk):
                yield record
                continue
            if (size := record.uncompressed_size) > MAX_RECORD_BYTES:
                raise ImportTableError(f"{path}: a chunk unpacks to {size} bytes, at most {MAX_RECORD_BYTES} are read")
            yield from breakup_chunk(record)


def bag_to_table(sources: Sequence[Path], map_file: Path | None, folder: Path) -> tuple[list[Path], ColumnMap]:
    """Write the messages of a bag as JSON lines into a folder; returns their path, and the map of them.

    `map_file` names topics and fields. Raises `ImportTableError`.
    """
    (source,), column_map = sources, load_map(map_file) if map_file else ColumnMap()
    table = folder / f"{source.name}.jsonl"
    first: dict[str, Any] | None = None
    with open_bag(source) as bag:
        column_map = _with_topics(bag, column_map)
        wrong = f"{source.name}: cannot be turned into a table in {table.parent}"
        with raising(ImportTableError, wrong, OSError, RecursionError), table.open("w", encoding="utf-8") as file:
            for row in _rows(bag, column_map.topics):
                if column_map.each and not isinstance(row.get(column_map.each), list):
                    raise ImportTableError(
                        f"{source}: each: a message of {row['topic']} has no list {column_map.each[:60]!r}"
                    )
                first = first or row
                file.write(json.dumps(row, allow_nan=False) + "\n")
    if first is None:
        raise ImportTableError(f"{source}: no message on the topics of the map")
    # Times are in nanoseconds unless the map says otherwise.
    column_map = replace(column_map, units={"time": "ns"} | column_map.units)
    if "time_s" in column_map.columns or "time_s" in column_map.constants:
        return [table], column_map
    stamped = isinstance(first.get("header"), dict) and "stamp" in first["header"]
    columns = column_map.columns | {"time_s": "header.stamp" if stamped else "log_time"}
    return [table], replace(column_map, columns=columns)


def _with_topics(bag: Bag, column_map: ColumnMap) -> ColumnMap:
    """Return a map that names topics: the map's own, the topics of exported ranges, or the only topic."""
    listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(bag.kinds.items()))[:400] or "none"
    topics: dict[str, dict[str, float | str]] = {}
    for stated, constants in column_map.topics.items():
        matching = matching_topics(stated, bag.kinds)
        if not matching:
            raise ImportTableError(f"{bag.path}: no topic {stated[:80]!r}; there are {listed}")
        topics |= {topic: {**topics.get(topic, {}), **places, **constants} for topic, places in matching.items()}
    if topics:
        return replace(column_map, topics=topics)
    for kind, template, columns in _OWN:
        if own := matching_topics(template, (topic for topic, one in bag.kinds.items() if one == kind)):
            columns, units = columns | column_map.columns, {"distance": "m"} | column_map.units
            return replace(column_map, topics=own, columns=columns, units=units)
    if len(bag.kinds) == 1:
        return replace(column_map, topics={topic: {} for topic in bag.kinds})
    raise ImportTableError(
        f'{bag.path}: a `map_file` must name the topics, as [topics."/name"]; there are {listed}; '
        "'uwblink import guess' proposes a map"
    )


def matching_topics(stated: str, topics: Iterable[str]) -> dict[str, dict[str, float | str]]:
    """Return the topics with this name, or those that a template matches, with the values of its places."""
    listed = list(topics)
    if stated in listed or not is_template(stated):
        return {stated: {}} if stated in listed else {}
    return {topic: {**places} for topic in listed if (places := Template(stated).match(topic)) is not None}


def _rows(bag: Bag, topics: Mapping[str, dict[str, float | str]]) -> Iterator[dict[str, Any]]:
    """Yield one row for each message."""
    for topic, kind, time_ns, message in bag.messages(topics):
        # Exported messages omit unknown values.
        own = dict.fromkeys(OWN_COLUMNS.values()) if kind == RANGE or topic == EXCHANGES else {}
        yield {**own, **fields_of(kind, message), "topic": topic, "log_time": time_ns, **topics[topic]}


def fields_of(kind: str, message: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a message, or of the object of JSON in its text."""
    if kind == STRING:
        with suppress(KeyError, TypeError, ValueError, RecursionError):
            parsed = _plain(json.loads(message["data"]))
            return parsed if isinstance(parsed, dict) else message
    return message


def _plain(value: Any) -> Any:
    """Return a message as values of JSON types; all other values become None."""
    fields = getattr(value, "__dataclass_fields__", None)
    if fields is not None:
        value = {n: getattr(value, n) for n in fields if not n.isupper() and n != "__msgtype__"}
    if isinstance(value, dict):
        whole = [part for part in value.values() if isinstance(part, int)]
        if tuple(value) in (("sec", "nsec"), ("sec", "nanosec")) and len(whole) == len(value):
            return int(whole[0]) * 1_000_000_000 + int(whole[1])
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, np.ndarray):
        short = value.size <= 16  # longer arrays are images or similar data
        return {str(k): _plain(one) for k, one in enumerate(value.tolist())} if short else None
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, bool | int | str) else None
