"""Motion-capture poses from files: CSV with a body a row, TUM and EuRoC trajectories, ROS bags.

CSV has the columns `time_s` (or `time_ns`), `body`, `x, y, z` (metres, ENU) and `qx, qy, qz, qw` (body to world). TUM
has `time x y z qx qy qz qw` separated by blanks, and EuRoC `time_ns, x, y, z, qw, qx, qy, qz, ...` below a line that
begins with `#timestamp`, one body a file. Bags (ROS 1, ROS 2, MCAP) need the extra `uwbcal[bags]`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final, TextIO

import numpy as np

from uwblink.errors import ImportTableError
from uwblink.importers.pose_bags import Row, read_bag
from uwblink.importers.pose_columns import LATEST_NS, NUMBERS, poses_of_lines, poses_of_table
from uwblink.recording.schema import Poses
from uwblink.text_files import read_text, require_regular

Reader = Callable[[Path, str | None], Iterable[Row]]


def read_poses(path: Path, body: str | None = None, topics: Mapping[str, str] | None = None) -> Poses:
    """Read poses by the file's kind; raises `ImportTableError`.

    `body` names the body of a file that does not; `topics` are those of a bag to read, by body.
    """
    require_regular(path, ImportTableError, "file of poses", folders=True)
    kind = "bag" if path.is_dir() else path.suffix.lower().lstrip(".")
    reader = _READERS.get(kind)
    if reader is None:
        raise ImportTableError(
            f"{path}: found {f'.{kind}' if kind else 'no suffix'}, expected one of .{', .'.join(sorted(_READERS))}"
        )
    if topics and reader is not _bag:
        raise ImportTableError(f"{path}: has no topics; only bags have")
    poses = None if topics else _at_once(path, reader, body)
    if poses is None:
        poses = _as_poses(path, read_bag(path, topics) if topics else reader(path, body))
    if not len(poses):
        raise ImportTableError(f"{path}: holds no poses")
    return poses


def _at_once(path: Path, reader: Reader, body: str | None) -> Poses | None:
    """Return the poses of a file in which every cell is as it should be; None for all others, and for bags."""
    if reader is _bag:
        return None
    if reader is _csv and not _is_euroc(path):
        return poses_of_table(path, body)
    return None if body is None else poses_of_lines(path, body, euroc=reader is _csv)


def _is_euroc(path: Path) -> bool:
    with path.open("rb") as file:
        return file.readline().removeprefix(b"\xef\xbb\xbf").lower().startswith(EUROC.encode())


EUROC: Final = "#timestamp"
EUROC_NUMBERS: Final = ("x", "y", "z", "qw", "qx", "qy", "qz")


def _euroc(path: Path, body: str | None, file: TextIO) -> Iterable[Row]:
    if body is None:
        raise ImportTableError(f"{path}: a EuRoC file does not say whose poses it holds; name it as `body`")
    for number, line in enumerate(file, start=1):
        cells = line.split(",")
        if line.startswith("#") or not line.strip():
            continue
        if len(cells) < 8:
            raise ImportTableError(
                f"{path}: row {number}: found {len(cells)} cells, EuRoC has 8: time_ns, {', '.join(EUROC_NUMBERS)}"
            )
        found = {n: _number(path, number, n, c) for n, c in zip(EUROC_NUMBERS, cells[1:], strict=False)}
        yield _time_ns(path, number, "time_ns", cells[0]), body, [found[name] for name in NUMBERS]


_EXPECTED: Final = (
    "expected a first line of time_s or time_ns, body (or `body` for all rows), x, y, z, qx, qy, qz, qw, in metres and "
    "between commas"
)


def _csv(path: Path, body: str | None) -> Iterable[Row]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            if file.readline().lower().startswith(EUROC):
                file.seek(0)
                yield from _euroc(path, body, file)
                return
            file.seek(0)
            reader = csv.DictReader(file)
            names = [name.strip() for name in reader.fieldnames or []]
            reader.fieldnames = names
            time = next((name for name in ("time_ns", "time_s") if name in names), None)
            missing = [name for name in (*NUMBERS, *(() if body else ("body",))) if name not in names]
            if time is None or missing:
                first, there = (missing or ["time_s"])[0], ", ".join(names)[:400]
                raise ImportTableError(f"{path}: column {first!r} is missing; there are {there}; {_EXPECTED}")
            for row in reader:
                line = reader.line_num
                name = body or str(row["body"]).strip()
                if not name:
                    raise ImportTableError(f"{path}: row {line}: column 'body' is empty")
                yield _time_ns(path, line, time, row[time]), name, [_number(path, line, n, row[n]) for n in NUMBERS]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ImportTableError(f"{path}: cannot be read as a table ({error})") from error


def _tum(path: Path, body: str | None) -> Iterable[Row]:
    if body is None:
        raise ImportTableError(f"{path}: a TUM file does not say whose poses it holds; name it as `body`")
    text = read_text(path, ImportTableError, "TUM file")
    for number, line in enumerate(text.splitlines(), start=1):
        cells = line.split()
        if not cells or cells[0].startswith("#"):
            continue
        if len(cells) != 8:
            raise ImportTableError(f"{path}: row {number}: found {len(cells)} cells, TUM has 8: time x y z qx qy qz qw")
        values = [_number(path, number, n, c) for n, c in zip(NUMBERS, cells[1:], strict=True)]
        yield _time_ns(path, number, "time_s", cells[0]), body, values


def _bag(path: Path, _body: str | None) -> Iterable[Row]:
    return read_bag(path)


_READERS: Final[dict[str, Reader]] = {
    "csv": _csv,
    "tum": _tum,
    "txt": _tum,
    "bag": _bag,
    "mcap": _bag,
    "db3": _bag,
}


def _as_poses(path: Path, rows: Iterable[Row]) -> Poses:
    listed = list(rows)
    time = np.array([row[0] for row in listed], dtype=np.int64)
    body = np.array([row[1] for row in listed], dtype=np.str_)
    values = np.array([row[2] for row in listed], dtype=np.float64).reshape(-1, len(NUMBERS))
    norm = np.linalg.norm(values[:, 3:], axis=1)
    bad = np.flatnonzero((norm < 0.9) | (norm > 1.1))
    if len(bad):
        raise ImportTableError(f"{path}: pose {bad[0] + 1}: its quaternion has length {norm[bad[0]]:.3g}, expected 1")
    order = np.argsort(time, kind="stable")
    return Poses(time[order], body[order], values[order, :3], values[order, 3:] / norm[order, None])


def _number(path: Path, line: int, name: str, cell: str | None) -> float:
    try:
        value = float(cell or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ImportTableError(f"{path}: row {line}: column {name!r}: found {cell!r}, expected a number")
    return value


def _time_ns(path: Path, line: int, name: str, cell: str | None) -> int:
    if name == "time_ns" and cell and cell.strip().lstrip("-").isdecimal():
        value = int(cell)
    else:
        # Seconds since 1970 have ten digits; a float of them is good to 0.2 us.
        value = round(_number(path, line, name, cell) * (1 if name == "time_ns" else 1e9))
    if abs(value) > LATEST_NS:
        raise ImportTableError(f"{path}: row {line}: column {name!r}: found {cell!r}, expected a time")
    return value
