"""Where tags sit, from the `[[tags]]` of a ranging plan or a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from uwblink.errors import PlanError
from uwblink.recording.schema import Tag
from uwblink.text_files import TomlReader, is_number


def load_places(path: Path) -> tuple[tuple[Tag, ...], dict[int, tuple[float, float, float]]]:
    """Read the `[[tags]]` of a plan, a scenario or another file, and the places in metres of its `[[anchors]]`, by id.

    Anchors stand still. One may have `covariance_m2` (xx xy xz yy yz zz), as `calib survey --anchors` writes it; poses
    have no place for it. Raises `PlanError` where there are neither, or an id is there twice.
    """
    file = TomlReader(path, PlanError, "file of tags (.toml)")
    if not _is_scenario(file):
        # A ranging plan says where tags sit, too.
        plan = ("pairs", "rate_hz", "protocol", "target_reports", "get_cir", "antenna_delays")
        file.known(file.table, ("tags", "anchors", *plan))
    tags, rows = read_tags(file), file.rows("anchors", ("id", "position_m", "covariance_m2"))
    if not tags and not rows:
        raise PlanError(f"{path}: holds no [[tags]] with id, body and lever_arm_m, and no [[anchors]]")
    found: dict[int, tuple[float, float, float]] = {}
    for k, row in enumerate(rows):
        number = _new_id(file, f"anchors[{k}].id", row, {*found, *(tag.tag for tag in tags)})
        found[number] = _point(file, f"anchors[{k}].position_m", row.get("position_m"))
        spread = row.get("covariance_m2", [0.0] * 6)
        file.check(f"anchors[{k}].covariance_m2", spread, _are_numbers(spread, 6), "xx xy xz yy yz zz, six numbers")
    return tags, found


def read_tags(file: TomlReader) -> tuple[Tag, ...]:
    """Return tags from the array of tables `tags` of a file, none where there is none; raises the file's error.

    The tags of a scenario have more keys, which its own reader checks.
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
    """Return the id of a tag or an anchor; raises the file's error for one that is none, or is taken."""
    number: Any = row.get("id")
    file.check(key, number, is_board_id(number), "a whole number 0 to 254")
    file.check(key, number, number not in taken, "another id than those before")
    return int(number)


def _is_scenario(file: TomlReader) -> bool:
    """Return whether a file is a scenario: only those have bodies or a run."""
    return "bodies" in file.table or "run" in file.table


def _are_numbers(value: Any, count: int) -> bool:
    return isinstance(value, list) and len(value) == count and all(map(is_number, value))


def is_board_id(value: Any) -> bool:
    """Whether a value can be the id of a board: the firmware's ids have eight bits, and 255 is not used."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 254
