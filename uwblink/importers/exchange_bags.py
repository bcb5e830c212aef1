"""Exchanges in bags of ROS 1, ROS 2 and MCAP: fields of messages by a map, as if they were columns of a table.

The project's own MCAP files need no map: all ranges in them are taken, and what they have beside.

A message becomes a row whose columns are its fields, `header.frame_id`; a time (`header.stamp`) is whole nanoseconds,
and the numbers of an array are `stamps.0`, `stamps.1` ...
`topic` and `log_time` are columns, too. From there on a bag is a table of JSON lines.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from uwblink.errors import ImportTableError
from uwblink.importers.bags import Bag, opened
from uwblink.importers.column_map import ColumnMap, load_map
from uwblink.importers.exchange_tables import plan
from uwblink.importers.staged_tables import StagedTables, Watch
from uwblink.importers.table_import import TableImport
from uwblink.recording.contents import Contents

SUFFIXES: Final = (".bag", ".mcap", ".db3")
LONGEST_ARRAY: Final = 16
"""Numbers of an array that become columns; longer ones are images and the like."""

OWN: Final = "uwb.Range"
OWN_COLUMNS: Final = {
    "from_id": "initiator", "to_id": "target", "range_m": "range_m", "gt_range_m": "truth_m",
    "fpp1": "fpp1_dbm", "fpp2": "fpp2_dbm", "skew1": "skew1_ppm", "skew2": "skew2_ppm",
}  # fmt: skip
"""What the project calls its ranges in MCAP files, and what is in them."""

STAMP: Final = "header.stamp"
LOGGED: Final = "log_time"


def read_exchange_bag(source: Path, map_file: Path | None = None) -> Contents:
    """Return the exchanges of a bag; `map_file` says which topics and fields they are in. Raises `ImportTableError`."""
    with open_exchange_bag([source], map_file) as found:
        return found.contents()


@contextmanager
def open_exchange_bag(
    sources: Sequence[Path], map_file: Path | None = None, watch: Watch | None = None
) -> Iterator[TableImport]:
    """Yield what `read_exchange_bag` returns of one bag, as something that can be written a part at a time."""
    (source,) = sources
    if watch:
        watch("reading", 0.0)
    with TemporaryDirectory() as place:
        table = Path(place) / f"{source.name}.jsonl"
        column_map = _as_table(source, load_map(map_file) if map_file else ColumnMap(), table)
        with StagedTables([table], column_map, watch) as tables:
            yield replace(plan(tables, watch), kind="import bag", imported_from=source.name)


def _as_table(source: Path, column_map: ColumnMap, table: Path) -> ColumnMap:
    """Write the messages of a bag as JSON lines; returns the map of these."""
    with opened(source) as bag:
        column_map = _own(bag, column_map)
        try:
            first = _write(table, _rows(bag, column_map, _topics(bag, column_map)))
        except RecursionError as error:
            raise ImportTableError(f"{source}: a message is nested too deeply") from error
    if first is None:
        raise ImportTableError(f"{source}: no message on the topics of the map")
    return _timed(column_map, first)


def _own(bag: Bag, column_map: ColumnMap) -> ColumnMap:
    """Return the map of the project's own ranges where a map names no topic and a bag has some, else the map."""
    own = [topic for topic, kind in bag.kinds.items() if kind == OWN]
    if column_map.topics or not own:
        return column_map
    topics: dict[str, dict[str, float | str]] = {topic: {} for topic in own}
    columns = OWN_COLUMNS | column_map.columns
    return replace(column_map, topics=topics, columns=columns, distance_unit=column_map.distance_unit or "m")


def _topics(bag: Bag, column_map: ColumnMap) -> list[str]:
    kinds = bag.kinds
    if not column_map.topics and len(kinds) == 1:
        return list(kinds)
    listed = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(kinds.items()))[:400] or "none"
    if not column_map.topics:
        raise ImportTableError(
            f'{bag.path}: a `map_file` must say which topics, as [topics."/name"]; there are {listed}'
        )
    for topic in column_map.topics:
        if topic not in kinds:
            raise ImportTableError(f"{bag.path}: no topic {topic[:80]!r}; there are {listed}")
    return list(column_map.topics)


def _timed(column_map: ColumnMap, first: Mapping[str, Any]) -> ColumnMap:
    """Return a map with a column for the time, which is in nanoseconds where nobody says otherwise."""
    unit = column_map.time_unit or "ns"
    if "time_s" in column_map.columns or "time_s" in column_map.constants:
        return replace(column_map, time_unit=unit)
    stamped = isinstance(first.get("header"), dict) and "stamp" in first["header"]
    columns = column_map.columns | {"time_s": STAMP if stamped else LOGGED}
    return replace(column_map, columns=columns, time_unit=unit)


def _rows(bag: Bag, column_map: ColumnMap, topics: list[str]) -> Iterator[dict[str, Any]]:
    for topic, kind, time_ns, message in bag.messages(topics):
        # What is not known is left out of the project's own messages.
        fields = (dict.fromkeys(OWN_COLUMNS.values()) if kind == OWN else {}) | _plain(message)
        row = {**fields, "topic": topic, LOGGED: time_ns, **column_map.topics.get(topic, {})}
        yield from _elements(bag.path, row, column_map.each)


def _elements(path: Path, row: dict[str, Any], each: str | None) -> Iterable[dict[str, Any]]:
    """Return a row for each element of a field, or the row itself where none is named."""
    if each is None:
        return [row]
    if not isinstance(row.get(each), list):
        raise ImportTableError(f"{path}: each: a message of {row['topic']} has no list {each[:60]!r}")
    return [row | {each: one} for one in row[each]]


def _plain(value: Any) -> Any:
    """Return a message as JSON has it; what JSON has no word for is None."""
    if isinstance(value, dict):
        whole = [part for part in value.values() if isinstance(part, int)]
        if tuple(value) in (("sec", "nsec"), ("sec", "nanosec")) and len(whole) == len(value):
            return whole[0] * 1_000_000_000 + whole[1]
        return {name: _plain(one) for name, one in value.items()}
    names = getattr(value, "__dataclass_fields__", None)
    if names is not None:
        if "sec" in names and "nanosec" in names:
            return int(value.sec) * 1_000_000_000 + int(value.nanosec)
        return {name: _plain(getattr(value, name)) for name in names if not name.isupper() and name != "__msgtype__"}
    if isinstance(value, np.ndarray):
        return {str(k): _plain(one) for k, one in enumerate(value.tolist())} if value.size <= LONGEST_ARRAY else None
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, bool | int | str) else None


def _write(path: Path, rows: Iterable[dict[str, Any]]) -> dict[str, Any] | None:
    """Write rows as JSON lines; returns the first, None where there is none."""
    first = None
    try:
        with path.open("w", encoding="utf-8") as file:
            for row in rows:
                first = first or row
                file.write(json.dumps(row, allow_nan=False) + "\n")
    except OSError as error:
        reason = error.strerror or error
        raise ImportTableError(f"{path.stem}: cannot be turned into a table in {path.parent} ({reason})") from error
    return first
