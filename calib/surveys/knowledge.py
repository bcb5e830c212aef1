"""Known facts about arrangements besides the ranges (shapes, distances, positions), and their file."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from calib.errors import BadInputError
from calib.settings import refuse
from uwblink.recording.schema import SHAPES, Arrangement, KnownDistance, is_id
from uwblink.text_files import TomlReader, is_number

TAPE_M, PLACE_M = 0.005, 0.01
"""Standard deviations of a distance by tape, and of each coordinate of a position, where none is stated:
a tape is read to 5 mm, and both ends of a coordinate are antennas."""

MAX_LENGTH_M, MIN_SIGMA_M = 1e6, 1e-6
"""From a micrometre to a thousand kilometres, squares and weights do not overflow."""


@dataclass(frozen=True, slots=True)
class KnownPosition:
    """The position of a tag's antenna, metres, and the standard deviation of each coordinate; in one arrangement or in
    all.

    >>> import calib
    >>> calib.KnownPosition(1, (0.0, 0.0, 2.5)).sigma_m
    0.01
    """

    tag: int
    position_m: tuple[float, float, float]
    sigma_m: float = PLACE_M
    arrangement: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Knowledge:
    """Known facts about arrangements: `shapes` by name, and stretches of time by name, in seconds since the first
    exchange.

    `shape` is for all arrangements that are not in `shapes`; `orders` are the tags in their order along a line, from
    either end, by name.

    >>> import calib
    >>> from uwblink import KnownDistance
    >>> taped = calib.Knowledge(shape="line", distances=(KnownDistance(1, 2, 3.06, 0.005),))
    >>> taped.distances[0].distance_m
    3.06
    """

    shape: str = ""
    shapes: Mapping[str, str] = field(default_factory=dict)
    spans_s: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    distances: tuple[KnownDistance, ...] = ()
    positions: tuple[KnownPosition, ...] = ()
    orders: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def shape_of(self, arrangement: Arrangement) -> str:
        """Return the known shape of an arrangement: the one stated here, or else its own."""
        default = "line" if arrangement.name in self.orders else self.shape or arrangement.known
        return self.shapes.get(arrangement.name, default)

    def order_of(self, arrangement: Arrangement) -> tuple[int, ...]:
        """Return the order of boards on a line; empty if it is not stated, or if they are not on a line."""
        order = self.orders.get(arrangement.name, arrangement.order)
        return tuple(order) if self.shape_of(arrangement) == "line" else ()


def _are_tags(value: Any, count: int | None = None) -> bool:
    good = isinstance(value, list) and all(map(is_id, value))
    return good and len(set(value)) == len(value) and (len(value) == count if count else len(value) > 1)


LENGTH: Final = (lambda value: is_number(value) and value > 0, "a number above 0 (metres)")
WORD: Final = (lambda value: isinstance(value, str) and value.isprintable() and value != "", "a name")
SECONDS: Final = (lambda value: is_number(value) and abs(value) <= 1e9, "a number of seconds")  # thirty years
KEYS: Final[dict[str, dict[str, tuple[Callable[[Any], bool], str]]]] = {
    "arrangements": {
        "name": WORD,
        "known": (SHAPES.__contains__, "line or plane"),
        "order": (_are_tags, "two tags or more, each once, as in [3, 1, 2]"),
        "start_s": SECONDS,
        "end_s": SECONDS,
    },
    "distances": {
        "between": (lambda value: _are_tags(value, 2), "two different tags, as in [1, 2]"),
        "distance_m": LENGTH,
        "sigma_m": LENGTH,
        "arrangement": WORD,
    },
    "positions": {
        "tag": (lambda value: _are_tags([value], 1), "a whole number 0 to 65535"),
        "position_m": (
            lambda value: isinstance(value, list) and len(value) == 3 and all(map(is_number, value)),
            "three numbers (metres)",
        ),
        "sigma_m": LENGTH,
        "arrangement": WORD,
    },
}
"""The keys of the tables of a file of known facts: tests of values, and the expected values."""


def load_knowledge(path: str | os.PathLike[str]) -> Knowledge:
    """Read a TOML file of `[[arrangements]]`, `[[distances]]` and `[[positions]]`; raises `BadInputError`, one line.

    `known = "line"` or "plane" at the head is for all arrangements without their own `known`; an arrangement has
    `name`, and any of `known`, `order = [3, 1, 2]`, `start_s` and `end_s`. A distance has `between = [1, 2]`,
    `distance_m`, and any of `sigma_m` and `arrangement`; a position `tag`, `position_m`, and any of the same two.
    """
    file = TomlReader(Path(path), BadInputError, "file of known facts (.toml; or give line or plane)")
    file.known(file.table, ("known", *KEYS))
    arrangements = list(_rows(file, "arrangements"))
    names = [row["name"] for row in arrangements]
    for k, row in enumerate(arrangements):
        on_line = "order" not in row or row.get("known", "line") == "line"
        paired, start_s = ("start_s" in row) == ("end_s" in row), row.get("start_s", -math.inf)
        for key, value, good, expected in (
            (".name", row["name"], names.count(row["name"]) == 1, "each name once"),
            (".order", row.get("order"), on_line, 'an order of boards on a line, known = "line"'),
            ("", row, paired, "start_s and end_s, both or neither"),
            (".end_s", row.get("end_s"), start_s < row.get("end_s", math.inf), f"a number above start_s, {start_s}"),
        ):
            file.check(f"arrangements[{k}]{key}", value, good, expected)
    return Knowledge(
        shape=str(file.choice("known", file.table.get("known", ""), SHAPES)),
        shapes={row["name"]: row["known"] for row in arrangements if "known" in row},
        spans_s={row["name"]: (float(row["start_s"]), float(row["end_s"])) for row in arrangements if "end_s" in row},
        orders={row["name"]: tuple(row["order"]) for row in arrangements if "order" in row},
        distances=tuple(
            KnownDistance(
                min(row["between"]), max(row["between"]), float(row["distance_m"]), *_how_and_where(row, TAPE_M)
            )
            for row in _rows(file, "distances")
        ),
        positions=tuple(
            KnownPosition(row["tag"], (float(x), float(y), float(z)), *_how_and_where(row, PLACE_M))
            for row in _rows(file, "positions")
            for x, y, z in (row["position_m"],)
        ),
    )


def _rows(file: TomlReader, name: str) -> Iterator[dict[str, Any]]:
    """Yield the rows of a table of a file, checked key by key."""
    for k, row in enumerate(file.rows(name, KEYS[name])):
        for key, (is_good, expected) in KEYS[name].items():
            if key in row or key not in {"known", "order", "start_s", "end_s", "sigma_m", "arrangement"}:
                file.check(f"{name}[{k}].{key}", row.get(key), is_good(row.get(key)), expected)
        yield row


def _how_and_where(row: Mapping[str, Any], default: float) -> tuple[float, str]:
    return float(row.get("sigma_m", default)), row.get("arrangement", "")


def check_knowledge(knowledge: Knowledge, tags: Mapping[str, set[int]]) -> None:
    """Raise `BadInputError` for names of absent arrangements or tags; `tags` are the present ones by arrangement.

    Lengths that come from Python are checked here, too.
    """
    known: list[KnownDistance | KnownPosition] = [*knowledge.distances, *knowledge.positions]
    named = {*knowledge.shapes, *knowledge.orders, *(one.arrangement for one in known)}
    there, shapes = ", ".join(sorted(tags)), {knowledge.shape, *knowledge.shapes.values()}
    refuse(
        [
            *(
                ("known", True, f"contains an unknown arrangement {name!r:.40}; there are {there}")
                for name in sorted(named - {"", *tags})
            ),
            *(("known", True, f"found {shape!r:.40}, allowed: line, plane") for shape in sorted(shapes - {*SHAPES})),
        ]
    )
    for one in known:
        if isinstance(one, KnownDistance):
            who, good = {one.first, one.second}, 0 < one.distance_m <= MAX_LENGTH_M
        else:
            who = {one.tag}
            good = len(one.position_m) == 3 and all(abs(x) <= MAX_LENGTH_M for x in one.position_m)
        nowhere = not any(who <= own for name, own in tags.items() if one.arrangement in ("", name))
        refuse(
            [
                ("known", isinstance(one, KnownDistance) and len(who) < 2, f"{one}: expected two different tags"),
                ("known", nowhere, f"{one}: its tags have no ranges in {one.arrangement or 'any arrangement'}"),
                (
                    "known",
                    not (good and MIN_SIGMA_M <= one.sigma_m <= MAX_LENGTH_M),
                    f"{one}: expected more than 0 and up to {MAX_LENGTH_M:g} m ± {MIN_SIGMA_M:g} m or more",
                ),
            ]
        )
