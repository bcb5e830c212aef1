"""Ways to damage a file: bytes, lines, numbers, values of JSON, cells and tables of a recording.

Each takes the content of a sound file and a random generator, and returns a damaged one, or None if it finds nothing to
damage.
"""

from __future__ import annotations

import json
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import duckdb

NUMBERS: Final = (
    "0", "-1", "1", "2", "0.5", "1e-300", "1e16", "1e300", "-1e300", "1e400", "nan", "inf", "-inf", "255", "256",
    "65536", "4294967296", "9223372036854775807", "9223372036854775808", "1" + "0" * 400, "true", '"text"', "[]", "{}",
)  # fmt: skip
WORDS: Final = (
    "", "\x00", "\n", "\x1b[31m", "'; DROP TABLE meta; --", '"', "../../etc/passwd", "/dev/full", "\N{SNOWMAN}",
    "a" * 10_000, "\ud800", "nan", "NULL", "1 2", "{{}}", "%s", "$(reboot)", "__class__", "\N{RIGHT-TO-LEFT OVERRIDE}x",
)  # fmt: skip
VALUES: Final[tuple[Any, ...]] = (
    None, True, 0, -1, 1.5, 1e300, -1e300, float("nan"), float("inf"), 2**31, 2**53, 2**63, 2**64, 10**400, [], {},
    [[]], [None], {"a": 1}, *WORDS,
)  # fmt: skip

NUMBER: Final = re.compile(rb"(?<![\w.])-?\d+(\.\d+)?(e-?\d+)?")

Mutation = Callable[[bytes, random.Random], bytes | None]


def flip(data: bytes, rng: random.Random) -> bytes | None:
    """Change one to eight bytes."""
    if not data:
        return None
    changed = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def cut(data: bytes, rng: random.Random) -> bytes | None:
    """Truncate the file."""
    return data[: rng.randrange(len(data))] if data else None


def number(data: bytes, rng: random.Random) -> bytes | None:
    """Replace a number by another, or remove it."""
    found = list(NUMBER.finditer(data))
    if not found:
        return None
    place = rng.choice(found)
    return data[: place.start()] + rng.choice(NUMBERS).encode() + data[place.end() :]


def line(data: bytes, rng: random.Random) -> bytes | None:
    """Remove a line, repeat it, or move it."""
    lines = data.split(b"\n")
    taken = lines.pop(rng.randrange(len(lines)))
    for _ in range(rng.randint(0, 2)):
        lines.insert(rng.randint(0, len(lines)), taken)
    return b"\n".join(lines)


def word(data: bytes, rng: random.Random) -> bytes | None:
    """Replace a word by a hostile word, or insert one."""
    found = list(re.finditer(rb"[A-Za-z_]{2,}", data))
    hostile = rng.choice(WORDS).encode("utf-8", "surrogatepass")
    if not found:
        return hostile
    place = rng.choice(found)
    return data[: place.start()] + hostile + data[place.end() :]


def splice(data: bytes, rng: random.Random) -> bytes | None:
    """Insert a piece of the file at another place, once or a thousand times."""
    if not data:
        return None
    start = rng.randrange(len(data))
    piece = data[start : start + rng.randint(1, 200)] * rng.choice((1, 2, 1000))
    place = rng.randrange(len(data))
    return data[:place] + piece + data[place:]


def leaf(data: bytes, rng: random.Random) -> bytes | None:
    """Change, remove or add a value of a JSON document, at any depth."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return None
    place: Any = document
    while isinstance(place, dict | list) and place:
        key = rng.choice(list(place)) if isinstance(place, dict) else rng.randrange(len(place))
        if not isinstance(place[key], dict | list) or not place[key] or rng.random() < 0.15:
            if rng.random() < 0.2:
                del place[key]
            else:
                place[key] = rng.choice(VALUES)
            break
        place = place[key]
    return json.dumps(document).encode("utf-8", "surrogatepass")


def nest(data: bytes, rng: random.Random) -> bytes | None:
    """Nest a document, or a text that looks like one, a thousand or a hundred thousand times."""
    depth = rng.choice((1000, 100_000))
    return b"[" * depth + data + b"]" * depth


TEXT: Final[tuple[Mutation, ...]] = (flip, cut, number, number, number, line, word, word, splice)
JSON: Final[tuple[Mutation, ...]] = (flip, cut, number, leaf, leaf, leaf, leaf, nest)
BINARY: Final[tuple[Mutation, ...]] = (flip, cut, splice)


def damage_recording(source: Path, target: Path, rng: random.Random) -> None:
    """Write a copy of a recording with one to three changes of cells, columns, rows, tables or entries of `meta`.

    Changes that the database refuses are left out.
    """
    shutil.copyfile(source, target)
    with duckdb.connect(str(target)) as db:
        for _ in range(rng.randint(1, 3)):
            try:
                db.execute(*_statement(db, rng))
            except duckdb.Error:
                continue


def _statement(db: duckdb.DuckDBPyConnection, rng: random.Random) -> tuple[str, list[Any]]:
    columns = db.execute(
        "SELECT table_name, column_name, data_type FROM duckdb_columns() WHERE schema_name = 'main' AND NOT internal"
    ).fetchall()
    table, column, _ = rng.choice(columns)
    rows = rng.choice(("rowid = 0", f"rowid % {rng.randint(2, 9)} = 0", "true"))
    value = rng.choice((None, *(v for v in VALUES if not isinstance(v, list | dict)), *map(float, (-100, 1e5, 1e18))))
    if table == "meta" or rng.random() < 0.2:
        return _meta(db, rng)
    kinds: tuple[tuple[str, list[Any]], ...] = (
        (f'UPDATE {table} SET "{column}" = ? WHERE {rows}', [value]),
        (f'UPDATE {table} SET "{column}" = ? WHERE {rows}', [value]),
        (f'UPDATE {table} SET "{column}" = NULL WHERE {rows}', []),
        (f"DELETE FROM {table} WHERE {rows}", []),
        (f"INSERT INTO {table} SELECT * FROM {table} LIMIT {rng.choice((1, 1000))}", []),
        (f'ALTER TABLE {table} DROP COLUMN "{column}"', []),
        (f'ALTER TABLE {table} ALTER "{column}" TYPE {rng.choice(("VARCHAR", "DOUBLE", "HUGEINT", "BOOLEAN"))}', []),
        (f"DROP TABLE {table}", []),
        (f"CREATE VIEW v{rng.randrange(99)} AS SELECT * FROM {table}, range(1000000000)", []),
    )
    return rng.choice(kinds)


def _meta(db: duckdb.DuckDBPyConnection, rng: random.Random) -> tuple[str, list[Any]]:
    key, value = rng.choice(db.execute("SELECT key, value FROM meta").fetchall())
    changed = rng.choice(JSON)(str(value).encode(), rng)
    text = None if changed is None or rng.random() < 0.1 else changed.decode("utf-8", "replace").replace("\x00", "")
    return "UPDATE meta SET value = ? WHERE key = ?", [text, key]
