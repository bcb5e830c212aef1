"""MCAP files whose messages are JSON, as `uwblink export --to mcap` and Foxglove's libraries write them.

The format is that of the MCAP specification, version 0: records of an opcode, a length and a content, little-endian,
walked from the beginning; chunks are read where they are not compressed.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final

from uwblink.errors import ImportTableError

MAGIC: Final = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
_HEAD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
_CHUNK: Final = struct.Struct("<QQQII")
"""Times, size and checksum of what a chunk holds, and how long the name of its compression is."""

_LENGTH: Final = struct.Struct("<Q")


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
        for opcode, content in _records(self.path, {MESSAGE}):
            if opcode != MESSAGE or len(content) < _MESSAGE.size:
                continue
            number, _, time_ns, _ = _MESSAGE.unpack_from(content)
            topic, kind = self._channels.get(number, ("", ""))
            if topic in wanted:
                yield topic, kind, time_ns, self._decoded(topic, content[_MESSAGE.size :])

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
    for opcode, content in _records(path, {SCHEMA, CHANNEL}):
        try:
            if opcode == SCHEMA:
                schemas[struct.unpack_from("<H", content)[0]] = _texts(content, 2, 1)[0]
            elif opcode == CHANNEL:
                number, schema = struct.unpack_from("<HH", content)
                topic, encoding = _texts(content, 4, 2)
                yield number, topic, schemas.get(schema, ""), encoding
        except (struct.error, UnicodeDecodeError) as error:
            raise ImportTableError(f"{path}: is not MCAP as specified: a channel or a schema cannot be read") from error


def _records(path: Path, wanted: set[int]) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of the records of some opcodes, those in chunks that are not compressed included."""
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        yield from _walk(path, file, path.stat().st_size, wanted | {CHUNK})


def _walk(path: Path, file: BinaryIO, size: int, wanted: set[int]) -> Iterator[tuple[int, bytes]]:
    while len(head := file.read(_HEAD.size)) == _HEAD.size:
        opcode, length = _HEAD.unpack(head)
        if opcode == DATA_END:
            return
        if length > size - file.tell():
            break
        if opcode not in wanted:
            file.seek(length, 1)
            continue
        if opcode == CHUNK:
            inner = _uncompressed(file, length)
            yield from _walk(path, BytesIO(inner), len(inner), wanted - {CHUNK})
        else:
            yield opcode, file.read(length)
    else:
        if not head:
            return
    raise ImportTableError(f"{path}: ends within a record; was it written to the end?")


def _uncompressed(file: BinaryIO, length: int) -> bytes:
    """Read a chunk of that length; returns its records, none of one that is compressed."""
    end = file.tell() + length
    head = file.read(min(length, _CHUNK.size))
    inner = b""
    if len(head) == _CHUNK.size and not _CHUNK.unpack(head)[-1]:
        inner = file.read(end - file.tell())[_LENGTH.size :]
    file.seek(end)
    return inner


def _texts(content: bytes, place: int, count: int) -> list[str]:
    found = []
    for _ in range(count):
        (length,) = struct.unpack_from("<I", content, place)
        found.append(content[place + 4 : place + 4 + length].decode())
        place += 4 + length
    return found
