"""MCAP files whose messages are JSON, as `uwblink export --to mcap` and Foxglove's libraries write them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from uwblink.errors import ImportTableError, first_line

MAGIC: Final = b"\x89MCAP0\r\n"
LARGEST_BYTES: Final = 2**28
"""Of a record, and of what a compressed chunk unpacks to: both are held in memory. Writers make chunks of some MB."""


class JsonBag:
    """A file of JSON messages: topics with the names of their schemas, and the messages as `json` decodes them."""

    def __init__(self, path: Path) -> None:
        """Look at the channels; raises `ImportTableError` for a file that ends within a record."""
        self.path = path
        self._channels = {
            number: (topic, kind) for number, topic, kind, encoding in _channels(path) if encoding == "json"
        }

    @property
    def kinds(self) -> Mapping[str, str]:
        """What schema the messages of each topic have, as `foxglove.PoseInFrame`."""
        return dict(self._channels.values())

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, str, int, Any]]:
        """Yield topic, schema, time in nanoseconds by the recorder, and message; raises `ImportTableError`."""
        wanted = set(topics)
        for record in _records(self.path):
            if isinstance(record, Message):
                topic, kind = self._channels.get(record.channel_id, ("", ""))
                if topic in wanted:
                    yield topic, kind, record.log_time, self._decoded(topic, record.data)

    def _decoded(self, topic: str, data: bytes) -> Any:
        try:
            message = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise ImportTableError(f"{self.path}: a message of {topic[:80]!r} is not JSON") from error
        if not isinstance(message, dict):
            raise ImportTableError(f"{self.path}: a message of {topic[:80]!r} is not an object of JSON")
        return message


def has_json(path: Path) -> bool:
    """Whether a file is MCAP whose first topic is one of JSON messages."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return False
    return next((encoding == "json" for *_, encoding in _channels(path)), False)


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
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, emit_chunks=True, record_size_limit=LARGEST_BYTES).records:
                if not isinstance(record, Chunk):
                    yield record
                elif record.uncompressed_size <= LARGEST_BYTES:
                    yield from breakup_chunk(record)
                else:
                    raise ImportTableError(
                        f"{path}: a chunk unpacks to {record.uncompressed_size} bytes, at most {LARGEST_BYTES} are read"
                    )
        except ImportTableError:
            raise
        except Exception as error:  # the library passes on whatever its decompressors raise of damaged data
            raise ImportTableError(
                f"{path}: is cut off or damaged ({first_line(error)}); was it written to the end?"
            ) from error
