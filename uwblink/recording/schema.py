"""The tables and columns of a recording, classes for rows of tables, and tags in TOML files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwblink import __version__, arrays
from uwblink.arrays import ColumnTable, Floats, Ints
from uwblink.display import first_few, printable
from uwblink.errors import PlanError
from uwblink.text_files import TomlReader, is_number
from uwblink.ticks import ANTENNA_DELAY_TICKS, REPORT_BITS, SPEED_OF_LIGHT, TICKS_PER_SECOND
from uwblink.twr import COLUMNS, LARGEST_ID, LATEST_NS

FORMAT_VERSION: Final = 1
SUFFIX: Final = ".uwb"

POSE: Final = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""The columns of a pose in addition to time and body: position in metres and quaternion."""

TABLES: Final[dict[str, dict[str, str]]] = {
    "meta": {"key": "VARCHAR", "value": "VARCHAR"},
    "tags": {"tag": "USMALLINT", "body": "VARCHAR", "x": "DOUBLE", "y": "DOUBLE", "z": "DOUBLE"},
    "poses": {
        "time_ns": "BIGINT",
        "body": "VARCHAR",
        **dict.fromkeys(POSE, "DOUBLE"),
    },
    "exchanges": {
        **dict.fromkeys(COLUMNS, "BIGINT"),
        **dict.fromkeys(("initiator", "target", "reporter"), "USMALLINT"),
        **dict.fromkeys([c for c in COLUMNS if c.endswith(("_m", "_dbm", "_ppm"))], "DOUBLE"),
        "protocol": "VARCHAR",
    },
    "overheard": {
        "time_ns": "BIGINT",
        **dict.fromkeys(("listener", "initiator", "target"), "USMALLINT"),
        **dict.fromkeys(("rx1", "rx2", "rx3", "tx1_n", "rx1_n", "tx2_n", "rx2_n", "tx3_n", "rx3_n"), "BIGINT"),
        **dict.fromkeys(("fpp1_dbm", "fpp2_dbm", "fpp3_dbm", "skew1_ppm", "skew2_ppm", "skew3_ppm"), "DOUBLE"),
        **dict.fromkeys(("fpp1_n_dbm", "fpp2_n_dbm", "skew1_n_ppm", "skew2_n_ppm"), "DOUBLE"),
    },
    "cirs": {
        "time_ns": "BIGINT",
        **dict.fromkeys(("board", "initiator", "target"), "USMALLINT"),
        "first_path_index": "DOUBLE",
        "magnitudes": "USMALLINT[]",
    },
    "frames": {"time_ns": "BIGINT", "board": "VARCHAR", "direction": "VARCHAR", "bytes": "BLOB"},
    "faults": {
        "time_ns": "BIGINT",
        **dict.fromkeys(("board", "kind", "detail"), "VARCHAR"),
        **dict.fromkeys(("initiator", "target"), "USMALLINT"),
    },
    "imu": {
        "time_ns": "BIGINT",
        "body": "VARCHAR",
        **dict.fromkeys(("wx", "wy", "wz", "ax", "ay", "az"), "DOUBLE"),
    },
    "height": {"time_ns": "BIGINT", "body": "VARCHAR", "height_m": "DOUBLE"},
    "powers": {
        "time_ns": "BIGINT",
        **dict.fromkeys(("initiator", "target"), "USMALLINT"),
        **dict.fromkeys(("rxp1_dbm", "rxp2_dbm"), "DOUBLE"),
    },
    "quality": {
        "time_ns": "BIGINT",
        **dict.fromkeys(("initiator", "target"), "USMALLINT"),
        **dict.fromkeys(("sts1", "sts2"), "DOUBLE"),
    },
    "temperature": {
        "time_ns": "BIGINT",
        "tag": "USMALLINT",
        **dict.fromkeys(("temperature_c", "supply_v"), "DOUBLE"),
    },
    "receptions": {
        **dict.fromkeys(("time_ns", "frame", "tx", "rx"), "BIGINT"),
        **dict.fromkeys(("sender", "listener"), "USMALLINT"),
        **dict.fromkeys(("fpp_dbm", "rxp_dbm", "skew_ppm"), "DOUBLE"),
    },
    "differences": {
        "time_ns": "BIGINT",
        **dict.fromkeys(("minus", "plus", "listener"), "USMALLINT"),
        "difference_m": "DOUBLE",
    },
    "arrangements": {"start_ns": "BIGINT", "end_ns": "BIGINT", **dict.fromkeys(("name", "known"), "VARCHAR")},
    "distances": {
        **dict.fromkeys(("first", "second"), "USMALLINT"),
        **dict.fromkeys(("distance_m", "sigma_m"), "DOUBLE"),
        "arrangement": "VARCHAR",
    },
    "corrected": {
        "time_ns": "BIGINT",
        **dict.fromkeys(("initiator", "target"), "USMALLINT"),
        **dict.fromkeys(("raw_m", "corrected_m", "sigma_m", "sigma_total_m"), "DOUBLE"),
        **dict.fromkeys(("mean_error_m", "tail_share", "tail_probability"), "DOUBLE"),
        **dict.fromkeys(("clamped", "outlier"), "BOOLEAN"),
    },
}

TRUTH_FROM: Final = "truth_from"
BY_POSES: Final = "poses"
"""The column of exported exchanges with the source of `truth_m`, and its value for distances from poses."""

ADDED_LATER: Final = {
    "faults": frozenset({"initiator", "target"}),
    **{
        table: frozenset(TABLES[table])
        for table in (
            "imu",
            "height",
            "powers",
            "quality",
            "temperature",
            "receptions",
            "differences",
            "corrected",
            "arrangements",
            "distances",
        )
    },
}
"""Columns that older recordings may lack, by table; a table whose columns are all listed may be missing."""


@dataclass(frozen=True, slots=True)
class Tag:
    """A tag on a body; its lever arm, the position of its antenna, is in the frame of the body, in metres.

    >>> from uwblink import Tag
    >>> Tag(1, "drone", (0.17, -0.17, -0.05)).body
    'drone'
    """

    tag: int
    body: str
    lever_arm_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True, repr=False)
class Poses(ColumnTable):
    """Poses of bodies as columns of length n, in order of time.

    `position_m` (n, 3) is the position of the body in the world frame (east, north, up); `quaternion` (n, 4), in the
    order x y z w, rotates vectors from the body frame to the world frame.
    """

    time_ns: Ints
    body: NDArray[np.str_]
    position_m: Floats
    quaternion: Floats

    @classmethod
    def from_arrays(
        cls, time_ns: ArrayLike, body: ArrayLike, position_m: ArrayLike, quaternion: ArrayLike | None = None
    ) -> Poses:
        """Return poses from lists or arrays, in order of time; one body, position or attitude applies to all rows.

        Without `quaternion` bodies are not rotated. Quaternions are normalised. Raises `ArgumentError` that names the
        column and the row of a wrong value.

        >>> from uwblink import Poses
        >>> poses = Poses.from_arrays([2, 1], "drone", [[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]])
        >>> poses.position_m[:, 2].tolist(), poses.quaternion[0].tolist()
        ([2.0, 1.0], [0.0, 0.0, 0.0, 1.0])
        """
        count = arrays.length("time_ns", time_ns)
        time = arrays.whole_numbers("time_ns", time_ns, count, -LATEST_NS, LATEST_NS)
        attitude = arrays.vectors("quaternion", (0.0, 0.0, 0.0, 1.0) if quaternion is None else quaternion, count, 4)
        norm = np.linalg.norm(attitude, axis=1)
        arrays.reject("quaternion", attitude, (norm < 0.9) | (norm > 1.1), "x y z w of length 1")
        position = arrays.vectors("position_m", position_m, count, 3)
        return cls(time, arrays.words("body", body, count), position, attitude / norm[:, None]).in_time_order()

    def to_dict(self) -> dict[str, NDArray[Any]]:
        """Return the columns (n,) of the table `poses` by name, for data frames.

        >>> from uwblink import Poses
        >>> [*Poses.from_arrays([0], "drone", [0.0, 0.0, 1.0]).to_dict()]
        ['time_ns', 'body', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw']
        """
        named = {"time_ns": self.time_ns, "body": self.body}
        return named | dict(zip(POSE, (*self.position_m.T, *self.quaternion.T), strict=True))

    def _title(self) -> str:
        return f"{len(self)} poses of {first_few(map(printable, np.unique(self.body).tolist()))}"


@dataclass(frozen=True, slots=True)
class Fault:
    """An event during a recording, such as a time-out, unreadable bytes, or a failed exchange.

    `initiator` and `target` are those of a failed exchange, None for other faults.
    """

    time_ns: int
    board: str
    kind: str
    detail: str
    initiator: int | None = None
    target: int | None = None


SHAPES: Final = ("", "line", "plane")
"""Known shapes of an arrangement of boards: none, a straight line, a plane."""


@dataclass(frozen=True, slots=True)
class Arrangement:
    """A span of time in which boards stood still, with a name.

    `known` is their shape, "line", "plane", or "" if unknown; `order` are the tags in their order along a line, from
    either end, empty if unknown.

    >>> from uwblink import Arrangement
    >>> Arrangement("A", 0, 60_000_000_000, "line", (3, 1, 2)).order
    (3, 1, 2)
    """

    name: str
    start_ns: int
    end_ns: int
    known: str = ""
    order: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class KnownDistance:
    """An independently measured distance between the antennas of two tags, and its standard deviation, in metres.

    It is valid in one arrangement, or in all if `arrangement` is "".

    >>> from uwblink import KnownDistance
    >>> KnownDistance(1, 2, 3.06, 0.005).sigma_m
    0.005
    """

    first: int
    second: int
    distance_m: float
    sigma_m: float
    arrangement: str = ""


@dataclass(frozen=True, slots=True)
class CirRow:
    """A channel impulse response that a board printed.

    `first_path_index` is the position of the first path in taps of 1.0016 ns, with a fraction; `magnitudes` are those
    of the taps, 1016 on a board.
    """

    time_ns: int
    board: int
    initiator: int
    target: int
    first_path_index: float
    magnitudes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class FrameRow:
    """Raw bytes of a port: `board` is the name of the port, `direction` is "in" (from the board) or "out" (to it)."""

    time_ns: int
    board: str
    direction: str
    data: bytes


def load_places(path: Path) -> tuple[tuple[Tag, ...], dict[int, tuple[float, float, float]]]:
    """Read the `[[tags]]` of a plan, scenario or other file, and the positions of its `[[anchors]]` in metres, by id.

    Anchors stand still. An anchor may have `covariance_m2` (xx xy xz yy yz zz), as written by `calib survey
    --save-anchors`; it is checked and not used, because poses have no covariance. Raises `PlanError` if there are
    neither tags nor anchors, or an id is repeated.
    """
    file = TomlReader(path, PlanError, "file of tags (.toml)")
    if not _is_scenario(file):
        # A ranging plan has tags, too.
        plan = ("pairs", "rate_hz", "protocol", "target_reports", "get_cir", "antenna_delays")
        file.known(file.table, ("tags", "anchors", *plan))
    tags, rows = read_tags(file), file.rows("anchors", ("id", "position_m", "covariance_m2"))
    if not tags and not rows:
        raise PlanError(f"{path}: contains neither [[tags]] with id, body and lever_arm_m nor [[anchors]]")
    found: dict[int, tuple[float, float, float]] = {}
    for k, row in enumerate(rows):
        number = _new_id(file, f"anchors[{k}].id", row, {*found, *(tag.tag for tag in tags)})
        found[number] = _point(file, f"anchors[{k}].position_m", row.get("position_m"))
        spread = row.get("covariance_m2", [0.0] * 6)
        file.check(f"anchors[{k}].covariance_m2", spread, _are_numbers(spread, 6), "xx xy xz yy yz zz, six numbers")
    return tags, found


def read_tags(file: TomlReader) -> tuple[Tag, ...]:
    """Return tags from the array of tables `tags` of a file, empty if there is none; raises the error of the file.

    Tags of a scenario have more keys, which the reader of scenarios checks.
    """
    tags: list[Tag] = []
    for k, row in enumerate(file.rows("tags", None if _is_scenario(file) else ("id", "body", "lever_arm_m"))):
        number = _new_id(file, f"tags[{k}].id", row, {tag.tag for tag in tags})
        body: Any = row.get("body")
        file.check(f"tags[{k}].body", body, isinstance(body, str) and bool(body), "the name of a body")
        tags.append(Tag(number, body, _point(file, f"tags[{k}].lever_arm_m", row.get("lever_arm_m", [0.0, 0.0, 0.0]))))
    return tuple(tags)


def _point(file: TomlReader, key: str, value: Any) -> tuple[float, float, float]:
    file.check(key, value, _are_numbers(value, 3), "three numbers (metres)")
    x, y, z = map(float, value)
    return x, y, z


def _new_id(file: TomlReader, key: str, row: dict[str, Any], taken: set[int]) -> int:
    """Return the id of a tag or an anchor; raises the error of the file if it is not an id, or is in `taken`."""
    number: Any = row.get("id")
    file.check(key, number, is_id(number), f"a whole number 0 to {LARGEST_ID}")
    file.check(key, number, number not in taken, "another id than those before")
    return int(number)


def _is_scenario(file: TomlReader) -> bool:
    """Return whether a file is a scenario, which has bodies or a run."""
    return "bodies" in file.table or "run" in file.table


def _are_numbers(value: Any, count: int) -> bool:
    return isinstance(value, list) and len(value) == count and all(map(is_number, value))


LARGEST_BOARD_ID: Final = 254
"""Largest id of boards with the firmware: its ids have eight bits, and 255 is not used. Other boards have 16 bits."""


def is_id(value: Any, largest: int = LARGEST_ID) -> bool:
    """Return whether a value can be the id of a tag."""
    return type(value) is int and 0 <= value <= largest


def standard_meta() -> dict[str, Any]:
    """Return the entries of `meta` that every recording has."""
    return {
        "format_version": FORMAT_VERSION,
        "writer": "uwbcal",
        "writer_version": __version__,
        "speed_of_light": SPEED_OF_LIGHT,
        "ticks_per_second": TICKS_PER_SECOND,
        "timestamp_bits": REPORT_BITS,
        "configured_antenna_delay_ticks": {"tx": ANTENNA_DELAY_TICKS, "rx": ANTENNA_DELAY_TICKS},
    }
