"""What is known of arrangements beside the ranges: shapes, distances, positions; and the file that says it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from calib.errors import BadInputError
from uwblink.recording.schema import SHAPES, Arrangement, KnownDistance
from uwblink.text_files import TomlReader, is_number

TAPE_M: Final = 0.005
"""Standard deviation of a distance by tape where none is stated."""

PLACE_M: Final = 0.01
"""Standard deviation of each coordinate of a position where none is stated."""

LARGEST_ID: Final = 254
FARTHEST_M: Final = 1e6
LEAST_SIGMA_M: Final = 1e-6
"""From a micrometre to a thousand kilometres, squares and weights are numbers that can be computed with."""

LATEST_S: Final = 1e9
"""Of seconds within a recording: thirty years either way."""


DISTANCE_KEYS: Final = ("between", "distance_m", "sigma_m", "arrangement")
POSITION_KEYS: Final = ("tag", "position_m", "sigma_m", "arrangement")


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
    shapes, spans, orders = _arrangements(file)
    return Knowledge(
        shape=_shape(file, "known", file.table.get("known", "")),
        shapes=shapes,
        spans_s=spans,
        orders=orders,
        distances=tuple(
            _distance(file, f"distances[{k}].", row) for k, row in enumerate(file.rows("distances", DISTANCE_KEYS))
        ),
        positions=tuple(
            _position(file, f"positions[{k}].", row) for k, row in enumerate(file.rows("positions", POSITION_KEYS))
        ),
    )


def _shape(file: TomlReader, key: str, value: Any) -> str:
    return str(file.choice(key, value, SHAPES))


def _arrangements(
    file: TomlReader,
) -> tuple[dict[str, str], dict[str, tuple[float, float]], dict[str, tuple[int, ...]]]:
    shapes: dict[str, str] = {}
    spans: dict[str, tuple[float, float]] = {}
    orders: dict[str, tuple[int, ...]] = {}
    names: set[str] = set()
    for k, row in enumerate(file.rows("arrangements", ("name", "known", "order", "start_s", "end_s"))):
        where = f"arrangements[{k}]."
        name = _word(file, f"{where}name", row.get("name"))
        file.check(f"{where}name", name, name not in names, "each name once")
        names.add(name)
        if "order" in row:
            orders[name] = _order(file, f"{where}order", row["order"], row.get("known", "line"))
        if "known" in row:
            shapes[name] = _shape(file, f"{where}known", row["known"])
        if ("start_s" in row) != ("end_s" in row):
            raise BadInputError(f"{file.path}: {where}start_s: give both start_s and end_s, or neither")
        if "start_s" in row:
            start, end = row["start_s"], row["end_s"]
            file.check(f"{where}start_s", start, _is_time(start), "a number of seconds")
            file.check(f"{where}end_s", end, _is_time(end) and end > start, f"a number above start_s, {start}")
            spans[name] = (float(start), float(end))
    return shapes, spans, orders


def _order(file: TomlReader, key: str, order: Any, shape: Any) -> tuple[int, ...]:
    good = isinstance(order, list) and len(order) > 1 and all(map(_is_id, order)) and len(set(order)) == len(order)
    file.check(key, order, good, "two tags or more, each once, as in [3, 1, 2]")
    file.check(key, order, shape == "line", 'an order of boards on a line, known = "line"')
    return tuple(order)


def _distance(file: TomlReader, where: str, row: dict[str, Any]) -> KnownDistance:
    ends: Any = row.get("between")
    length: Any = row.get("distance_m")
    good = isinstance(ends, list) and len(ends) == 2 and all(map(_is_id, ends)) and ends[0] != ends[1]
    file.check(f"{where}between", ends, good, "two different tags, as in [1, 2]")
    file.check(f"{where}distance_m", length, is_number(length) and length > 0, "a number above 0 (metres)")
    sigma = _sigma(file, where, row, TAPE_M)
    return KnownDistance(min(ends), max(ends), float(length), sigma, _arrangement(file, where, row))


def _position(file: TomlReader, where: str, row: dict[str, Any]) -> KnownPosition:
    tag: Any = row.get("tag")
    place: Any = row.get("position_m")
    file.check(f"{where}tag", tag, _is_id(tag), f"a whole number 0 to {LARGEST_ID}")
    good = isinstance(place, list) and len(place) == 3 and all(map(is_number, place))
    file.check(f"{where}position_m", place, good, "three numbers (metres)")
    x, y, z = map(float, place)
    return KnownPosition(int(tag), (x, y, z), _sigma(file, where, row, PLACE_M), _arrangement(file, where, row))


def _sigma(file: TomlReader, where: str, row: dict[str, Any], default: float) -> float:
    sigma = row.get("sigma_m", default)
    file.check(f"{where}sigma_m", sigma, is_number(sigma) and sigma > 0, "a number above 0 (metres)")
    return float(sigma)


def _arrangement(file: TomlReader, where: str, row: dict[str, Any]) -> str:
    return _word(file, f"{where}arrangement", row["arrangement"]) if "arrangement" in row else ""


def _word(file: TomlReader, key: str, value: Any) -> str:
    file.check(key, value, isinstance(value, str) and bool(value) and value.isprintable(), "a name")
    return str(value)


def _is_id(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= LARGEST_ID


def check_knowledge(knowledge: Knowledge, tags: dict[str, set[int]]) -> None:
    """Raise `BadInputError` for what names an arrangement or tags that are not there; `tags` are those by arrangement.

    Lengths that come from Python are checked here, too.
    """
    named = {*knowledge.shapes, *knowledge.orders, *(d.arrangement for d in knowledge.distances)}
    named |= {p.arrangement for p in knowledge.positions}
    strangers = sorted(named - {"", *tags})
    if strangers:
        raise BadInputError(
            f"names an arrangement {strangers[0]!r:.40}; there are {', '.join(sorted(tags))}", parameter="known"
        )
    bad = sorted({shape for shape in (knowledge.shape, *knowledge.shapes.values()) if shape not in SHAPES})
    if bad:
        raise BadInputError(f"found {bad[0]!r:.40}, allowed: line, plane", parameter="known")
    for d in knowledge.distances:
        _check_tags((d.first, d.second), d.arrangement, tags, f"a distance of {d.first} and {d.second}")
        if not (0 < d.distance_m <= FARTHEST_M and _is_sigma(d.sigma_m)):
            text = (
                f"a distance of {d.first} and {d.second} of {d.distance_m} ± {d.sigma_m} m, expected more than 0, and "
                f"up to {FARTHEST_M:g} m ± {LEAST_SIGMA_M:g} m or more"
            )
            raise BadInputError(text, parameter="known")
    for p in knowledge.positions:
        _check_tags((p.tag,), p.arrangement, tags, f"a position of {p.tag}")
        if not all(abs(x) <= FARTHEST_M for x in p.position_m) or not _is_sigma(p.sigma_m):
            raise BadInputError(f"a position of {p.tag} that is no number, or without sigma", parameter="known")


def _is_sigma(value: float) -> bool:
    return LEAST_SIGMA_M <= value <= FARTHEST_M


def _check_tags(ids: tuple[int, ...], name: str, tags: dict[str, set[int]], what: str) -> None:
    wanted = {name: tags[name]} if name else tags
    if not any(set(ids) <= there for there in wanted.values()):
        where = f"arrangement {name}" if name else "any arrangement"
        raise BadInputError(f"{what}, which do not range in {where}", parameter="known")


def _is_time(value: Any) -> bool:
    return is_number(value) and abs(value) <= LATEST_S
