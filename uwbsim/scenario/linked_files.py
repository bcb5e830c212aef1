"""Files that a scenario names: antenna tables, trajectories, plans. Their contents replace their names.

Names are relative to the scenario's folder and must lead to regular files in it or below, links resolved: an untrusted
scenario opens no other file.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from itertools import islice, product
from pathlib import Path
from typing import Any, Final

import numpy as np

from uwblink.errors import UwblinkError
from uwblink.recording.file import Recording
from uwblink.recording.schema import SUFFIX, Poses
from uwbsim.errors import ScenarioError

MOST_POSES: Final = 200_000

Folders = Iterable[str | os.PathLike[str]]


def fill_in(table: dict[str, Any], scenario: Path, folders: Folders = ()) -> None:
    """Read the files that a scenario's tables name, in place; raises `ScenarioError`. Other values are left alone.

    Files lie in the scenario's folder, in one of `folders`, or below one of these.
    """
    folders = tuple(folders)
    for name in ("radio", "ranging", "bodies", "tags"):
        section = table.get(name)
        tables: list[tuple[str, Any]] = [(name, section)]
        if isinstance(section, list):
            tables = [(f"{name}[{k}]", one) for k, one in enumerate(section)]
        for place, one in tables:
            for key, named in [*one.items()] if isinstance(one, dict) else ():
                model, read = READERS.get(key, (None, None))
                if read is None or not isinstance(named, dict) or "file" not in named or named.get("model") != model:
                    continue
                where = f"{scenario}: {place}.{key}.file"
                if not isinstance(named["file"], str):
                    raise ScenarioError(f"{where}: found {named['file']!r}, expected the name of a file")
                path = scenario.parent / named["file"]
                path = check_linked(path, f"{where}: found {named['file']!r}", scenario.parent, folders)
                held = read(path, key, named)
                # A table of antenna gains has no key of its own for its file.
                one[key] = held if key == "antenna" else named | held


def check_linked(path: Path, where: str, beside: Path, folders: Folders) -> Path:
    """Return a file that another file names; raises `ScenarioError`, which begins with `where`.

    It is a regular file of text in the folder `beside` or one of `folders`, or below, or a recording there.
    """
    try:
        place = path.resolve()
        inside = any(place.is_relative_to(Path(folder).resolve()) for folder in (beside, *folders))
    except (OSError, RuntimeError, ValueError) as error:  # a circle of links, a NUL
        raise ScenarioError(f"{where}, but there is no such file beside the scenario") from error
    if not inside:
        # The message does not reveal whether the file exists.
        raise ScenarioError(f"{where}, which is not below the naming file's folder; `allow_files` names other folders")
    if not place.exists():
        raise ScenarioError(f"{where}, but there is no such file beside the scenario")
    if not place.is_file():
        raise ScenarioError(f"{where}, which is no regular file")
    # Twice what `MOST_POSES` take as text, at eight numbers of twenty digits.
    most = 64_000_000
    if place.suffix != SUFFIX and (size := place.stat().st_size) > most:
        raise ScenarioError(f"{where}, which has {size} bytes; at most {most} are read")
    return path


def _rows(path: Path, columns: tuple[str, ...]) -> list[list[float]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = (line for line in file if not line.startswith("#"))
            reader = csv.DictReader(lines)
            missing = [c for c in columns if c not in (reader.fieldnames or [])]
            if missing:
                raise ScenarioError(f"{path}: column {missing[0]!r} is missing; expected {', '.join(columns)}")
            most = 1_000_000  # nearly three hours of slots at 100 Hz; in memory they take 0.2 GB
            rows = [[_number(path, reader.line_num, c, row[c]) for c in columns] for row in islice(reader, most)]
            if next(reader, None) is not None:
                raise ScenarioError(f"{path}: more than {most} rows, which is the most that is read")
            return rows
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ScenarioError(f"{path}: cannot be read as a table ({error})") from error


def _number(path: Path, line: int, column: str, cell: str | None) -> float:
    with suppress(ValueError):
        value = float(cell or "")
        if math.isfinite(value):
            return value
    raise ScenarioError(f"{path}: row {line}: column {column!r}: found {cell!r}, expected a number")


def _grid(path: Path, name: str) -> dict[str, Any]:
    """Read rows of azimuth_deg, elevation_deg and a value into a full grid."""
    rows = _rows(path, ("azimuth_deg", "elevation_deg", name))
    azimuth, elevation = (sorted({row[k] for row in rows}) for k in (0, 1))
    found = {(row[0], row[1]): row[2] for row in rows}
    if len(found) != len(rows):
        raise ScenarioError(f"{path}: two rows are for the same direction")
    for a, e in product(azimuth, elevation):
        if (a, e) not in found:
            raise ScenarioError(f"{path}: a hole in the table: no {name} at azimuth {a:g}, elevation {e:g} degrees")
    return {
        "azimuth_deg": azimuth,
        "elevation_deg": elevation,
        name: [[found[a, e] for e in elevation] for a in azimuth],
    }


def _plan(path: Path, *_: Any) -> dict[str, Any]:
    rows = _rows(path, ("time_s", "initiator", "target"))
    if not rows:
        raise ScenarioError(f"{path}: a plan without slots")
    return {"slots": [(row[0], int(row[1]), int(row[2])) for row in rows]}


def _profile(path: Path, key: str, *_: Any) -> dict[str, Any]:
    rows = _rows(path, ("time_s", key))
    return {"times_s": [row[0] for row in rows], "values": [row[1] for row in rows]}


def _trajectory(path: Path, _key: str, named: Mapping[str, Any]) -> dict[str, Any]:
    body = named.get("body")
    try:
        if path.suffix == ".uwb":
            with Recording.open(path) as recording:
                poses = recording.poses()
        else:
            # With it come all importers, which few scenarios need.
            from uwblink.importers.poses import read_poses

            poses = read_poses(path, body if path.suffix in (".tum", ".txt") else None)
    except UwblinkError as error:
        raise ScenarioError(str(error)) from error
    one = _of_body(path, poses, body)
    return {
        "times_s": ((one.time_ns - one.time_ns[0]) * 1e-9).tolist(),
        "positions_m": one.position_m.tolist(),
        "quaternions": one.quaternion.tolist(),
    }


def _of_body(path: Path, poses: Poses, body: str | None) -> Poses:
    names = sorted(set(poses.body.tolist()))
    if body is None and len(names) == 1:
        body = names[0]
    if body not in names:
        raise ScenarioError(f"{path}: found body {body!r}, the file has {', '.join(names) or 'none'}")
    rows = np.flatnonzero(poses.body == body)[:MOST_POSES]
    return Poses(poses.time_ns[rows], poses.body[rows], poses.position_m[rows], poses.quaternion[rows])


READERS: Final[dict[str, tuple[str | None, Callable[[Path, str, Mapping[str, Any]], dict[str, Any]]]]] = {
    "antenna": (None, lambda path, *_: _grid(path, "gain_db")),
    "plan": (None, _plan),
    "group_delay": ("table", lambda path, *_: _grid(path, "delay_cm")),
    "motion": ("recorded", _trajectory),
    "temperature_c": ("table", _profile),
    "supply_v": ("table", _profile),
}
"""Keys whose tables can name a file, of which model these tables are then, and what the file holds.

Readers are called with the file, the key and its table.
"""
