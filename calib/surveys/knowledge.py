"""What is known of arrangements beside the ranges: shapes, distances, positions; and the file that says it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from calib.errors import BadInputError
from uwblink.recording.schema import SHAPES, Arrangement, KnownDistance
from uwblink.text_files import TomlReader, is_number

TAPE_M, PLACE_M = 0.005, 0.01
"""Standard deviations of a distance by tape, and of each coordinate of a position, where none is stated."""

MAX_LENGTH_M, MIN_SIGMA_M = 1e6, 1e-6
"""From a micrometre to a thousand kilometres, squares and weights are numbers that can be computed with."""


@dataclass(frozen=True, slots=True)
class KnownPosition:
    """Where a tag's antenna is, metres, and the standard deviation of each coordinate; in one arrangement or in all.

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
    """What is known of arrangements: `shapes` by name, stretches of time in seconds since the first exchange by name.

    `shape` is that of all arrangements that `shapes` does not name; `orders` are the tags of a line as they were put
    along it, from either end, by name.

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
        """Return what is known of where boards stand in an arrangement: what is said here, else what it says itself."""
        said = "line" if arrangement.name in self.orders else self.shape or arrangement.known
        return self.shapes.get(arrangement.name, said)

    def order_of(self, arrangement: Arrangement) -> tuple[int, ...]:
        """Return in which order boards stand on a line; empty where nobody said it, or where they are on none."""
        order = self.orders.get(arrangement.name, arrangement.order)
        return tuple(order) if self.shape_of(arrangement) == "line" else ()


def load_knowledge(path: str | os.PathLike[str]) -> Knowledge:
    """Read a TOML file of `[[arrangements]]`, `[[distances]]` and `[[positions]]`; raises `BadInputError`, one line.

    `known = "line"` or "plane" at the head holds for all arrangements but those with a `known` of their own; an
    arrangement has `name`, and any of `known`, `order = [3, 1, 2]`, `start_s` and `end_s`. A distance has
    `between = [1, 2]`, `distance_m`, and any of `sigma_m` and `arrangement`; a position `tag`, `position_m`, and any of
    the same two.
    """
    file = TomlReader(Path(path), BadInputError, "file of what is known")
    file.known(file.table, ("known", "arrangements", "distances", "positions"))
    shapes: dict[str, str] = {}
    spans: dict[str, tuple[float, float]] = {}
    orders: dict[str, tuple[int, ...]] = {}
    names: list[str] = []
    for k, row in enumerate(file.rows("arrangements", ("name", "known", "order", "start_s", "end_s"))):
        where = f"arrangements[{k}]."
        name = _word(file, f"{where}name", row.get("name"))
        file.check(f"{where}name", name, name not in names, "each name once")
        names.append(name)
        if "order" in row:
            orders[name] = _tags(file, f"{where}order", row["order"], "two tags or more, each once, as in [3, 1, 2]")
            good = row.get("known", "line") == "line"
            file.check(f"{where}order", row["order"], good, 'an order of boards on a line, known = "line"')
        if "known" in row:
            shapes[name] = str(file.choice(f"{where}known", row["known"], SHAPES))
        good = ("start_s" in row) == ("end_s" in row)
        file.check(where[:-1], row, good, "start_s and end_s, both or neither")
        if "start_s" in row:
            start, end = row["start_s"], row["end_s"]
            # Thirty years either way.
            file.check(f"{where}start_s", start, is_number(start) and abs(start) <= 1e9, "a number of seconds")
            good = is_number(end) and start < end <= 1e9
            file.check(f"{where}end_s", end, good, f"a number above start_s, {start}")
            spans[name] = (float(start), float(end))
    return Knowledge(
        shape=str(file.choice("known", file.table.get("known", ""), SHAPES)),
        shapes=shapes,
        spans_s=spans,
        orders=orders,
        distances=tuple(
            _distance(file, f"distances[{k}].", row)
            for k, row in enumerate(file.rows("distances", ("between", "distance_m", "sigma_m", "arrangement")))
        ),
        positions=tuple(
            _position(file, f"positions[{k}].", row)
            for k, row in enumerate(file.rows("positions", ("tag", "position_m", "sigma_m", "arrangement")))
        ),
    )


def _distance(file: TomlReader, where: str, row: dict[str, Any]) -> KnownDistance:
    ends = _tags(file, f"{where}between", row.get("between"), "two different tags, as in [1, 2]", count=2)
    length: Any = row.get("distance_m")
    file.check(f"{where}distance_m", length, is_number(length) and length > 0, "a number above 0 (metres)")
    return KnownDistance(min(ends), max(ends), float(length), *_sigma_and_arrangement(file, where, row, TAPE_M))


def _position(file: TomlReader, where: str, row: dict[str, Any]) -> KnownPosition:
    tag, place = row.get("tag"), row.get("position_m")
    (tag,) = _tags(file, f"{where}tag", [tag], "a whole number 0 to 254", count=1)
    good = isinstance(place, list) and len(place) == 3 and all(map(is_number, place))
    file.check(f"{where}position_m", place, good, "three numbers (metres)")
    x, y, z = map(float, place or ())
    return KnownPosition(tag, (x, y, z), *_sigma_and_arrangement(file, where, row, PLACE_M))


def _tags(file: TomlReader, key: str, value: Any, expected: str, count: int | None = None) -> tuple[int, ...]:
    good = isinstance(value, list) and all(type(one) is int and 0 <= one <= 254 for one in value)
    good = good and len(set(value)) == len(value) and (len(value) == count if count else len(value) > 1)
    file.check(key, value, good, expected)
    return tuple(value)


def _sigma_and_arrangement(file: TomlReader, where: str, row: dict[str, Any], default: float) -> tuple[float, str]:
    sigma = row.get("sigma_m", default)
    file.check(f"{where}sigma_m", sigma, is_number(sigma) and sigma > 0, "a number above 0 (metres)")
    return float(sigma), _word(file, f"{where}arrangement", row["arrangement"]) if "arrangement" in row else ""


def _word(file: TomlReader, key: str, value: Any) -> str:
    file.check(key, value, isinstance(value, str) and bool(value) and value.isprintable(), "a name")
    return str(value)


def check_knowledge(knowledge: Knowledge, tags: dict[str, set[int]]) -> None:
    """Raise `BadInputError` for what names an arrangement or tags that are not there; `tags` are those by arrangement.

    Lengths that come from Python are checked here, too.
    """
    known: list[KnownDistance | KnownPosition] = [*knowledge.distances, *knowledge.positions]
    named = {*knowledge.shapes, *knowledge.orders, *(one.arrangement for one in known)}
    strangers = sorted(named - {"", *tags})
    if strangers:
        raise BadInputError(
            f"names an arrangement {strangers[0]!r:.40}; there are {', '.join(sorted(tags))}", parameter="known"
        )
    bad = sorted({shape for shape in (knowledge.shape, *knowledge.shapes.values()) if shape not in SHAPES})
    if bad:
        raise BadInputError(f"found {bad[0]!r:.40}, allowed: line, plane", parameter="known")
    for one in known:
        if isinstance(one, KnownDistance):
            who, what = {one.first, one.second}, f"a distance of {one.first} and {one.second}"
            good = 0 < one.distance_m <= MAX_LENGTH_M
            value = f"{one.distance_m} ± {one.sigma_m} m, expected more than 0, and"
        else:
            who, what = {one.tag}, f"a position of {one.tag}"
            good = all(abs(x) <= MAX_LENGTH_M for x in one.position_m)
            value = f"{one.position_m} ± {one.sigma_m} m, expected numbers"
        where = {one.arrangement: tags[one.arrangement]} if one.arrangement else tags
        if not any(who <= there for there in where.values()):
            place = f"arrangement {one.arrangement}" if one.arrangement else "any arrangement"
            raise BadInputError(f"{what}, which do not range in {place}", parameter="known")
        if not (good and MIN_SIGMA_M <= one.sigma_m <= MAX_LENGTH_M):
            text = f"{what} of {value} up to {MAX_LENGTH_M:g} m ± {MIN_SIGMA_M:g} m or more"
            raise BadInputError(text, parameter="known")
