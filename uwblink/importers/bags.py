"""Bags of ROS 1 and ROS 2 and MCAP files: the one place where they are opened."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from uwblink.errors import ImportTableError
from uwblink.importers.json_mcap import JsonBag, has_json
from uwblink.text_files import require_regular


class Bag(Protocol):
    """An open bag: its topics with the kinds of their messages, and the messages."""

    path: Path

    @property
    def kinds(self) -> Mapping[str, str]:
        """What kind of message each topic has, as `geometry_msgs/msg/PoseStamped`."""

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, str, int, Any]]:
        """Yield topic, kind, time in nanoseconds by the recorder, and message; raises `ImportTableError`."""


class RosBag:
    """A bag with the messages of ROS, whatever it is stored as."""

    def __init__(self, path: Path, reader: Any) -> None:
        """Wrap an open reader."""
        self.path, self._reader = path, reader

    @property
    def kinds(self) -> Mapping[str, str]:
        """What kind of message each topic has, as `geometry_msgs/msg/PoseStamped`."""
        return {connection.topic: connection.msgtype for connection in self._reader.connections}

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, str, int, Any]]:
        """Yield topic, kind, time in nanoseconds by the recorder, and message; raises `ImportTableError`.

        A kind that is none of the standard ones must be defined in the bag, as it is in all but those of ROS 2 before
        Iron that are stored in SQLite.
        """
        wanted = set(topics)
        used = [connection for connection in self._reader.connections if connection.topic in wanted]
        for connection in used:
            if connection.msgtype not in self._reader.typestore.types:
                raise ImportTableError(
                    f"{self.path}: does not say what a {connection.msgtype} is; convert it to MCAP in ROS, which does"
                )
        for connection, time_ns, raw in self._reader.messages(connections=used):
            message = self._reader.deserialize(raw, connection.msgtype)
            yield connection.topic, connection.msgtype, int(time_ns), message


@contextmanager
def opened(path: Path) -> Iterator[Bag]:
    """Open a bag; raises `ImportTableError` for what is none, also from within the block.

    Messages of ROS need rosbags; an MCAP file of JSON messages does not.
    """
    require_regular(path, ImportTableError, "bag", folders=True)
    for part in path.iterdir() if path.is_dir() else ():
        require_regular(part, ImportTableError, "part of a bag", folders=True)
    try:
        json_bag = JsonBag(path) if has_json(path) else None
    except OSError as error:
        raise ImportTableError(f"{path}: cannot be read as a bag ({error})") from error
    if json_bag is not None:
        yield json_bag
        return
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportTableError(f"{path}: reading bags needs rosbags; pip install 'uwbcal[bags]'") from error
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield RosBag(path, reader)
    except (AnyReaderError, OSError, ValueError) as error:
        if isinstance(error, ImportTableError):
            raise
        raise ImportTableError(f"{path}: cannot be read as a bag ({error})") from error
