"""Import of flights of the MILUV dataset as published by its authors.

A folder contains one folder per robot with `uwb_range.csv`, and optionally `uwb_passive.csv`, `uwb_cir.csv`,
`mocap.csv`, `imu_px4.csv` and `height.csv`, and beside those `timeshift.yaml`, `tags.yaml` (lever arms) and
`anchors.yaml` (constellations). Stamps are those before the authors' correction (`tx1_raw` ...): unwrapped nanoseconds,
which become ticks again. All files of a folder have the same clock; `timeshift.yaml` has its start.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import yaml

from uwblink.arrays import Columns, Floats, in_time_order
from uwblink.errors import ImportTableError, raising
from uwblink.importers.plausibility import clocks, to_ticks
from uwblink.importers.poses import with_anchors
from uwblink.importers.tables import SourceTable, connected, number, time_ns, whole_number
from uwblink.recording.contents import Contents
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import CirRow, Fault, Poses, Tag
from uwblink.text_files import TomlReader, read_text
from uwblink.ticks import REPORT_BITS, TICKS_PER_SECOND
from uwblink.twr import LARGEST_ID, STAMPS, Exchanges

Found = TypeVar("Found")

Vectors = dict[str, dict[int, tuple[float, float, float]]]
"""Vectors by name and number: lever arms by robot and tag, or places in metres by constellation and anchor."""

_PAIR: Final = {"initiator": "from_id", "target": "to_id"}
_IDS: Final = (*_PAIR, "listener", "board")


@dataclass(slots=True)
class FlightFolder:
    """A folder, its robots' folders, when its clock began, the number of duplicate rows by file, and faults."""

    folder: Path
    robots: tuple[Path, ...]
    start_ns: int
    doubled: dict[str, int] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)


def read_miluv(folder: Path, map_file: Path | None = None) -> Contents:
    """Return the flight in `folder`; rows in the files of two robots are imported once.

    `map_file` may name the constellation of anchors.yaml (`constellation = "0"`); by default it is the one whose
    distances agree with `gt_range`. `meta["notes"]` lists omitted data. Raises `ImportTableError`.
    """
    wanted = _constellation(map_file)
    if not folder.is_dir():
        raise ImportTableError(
            f"{folder}: no such folder; expected one with a folder a robot (ifo001/uwb_range.csv ...)"
        )
    start_ns = _read_yaml(
        folder / "timeshift.yaml",
        lambda table: int(table["timeshift_s"]) * 1_000_000_000 + int(table["timeshift_ns"]),
        0,
        expected="whole numbers timeshift_s and timeshift_ns",
    )
    flight = FlightFolder(folder, tuple(sorted(path.parent for path in folder.glob("*/uwb_range.csv"))), start_ns)
    if not flight.robots:
        raise ImportTableError(f"{folder}: no folder in it holds uwb_range.csv, as those of MILUV's robots do")
    exchanges, measured_m = _read_exchanges(flight)
    poses, tags = _read_poses(flight), _read_tags(flight)
    constellation, off_m, places = _find_anchors(flight, exchanges, measured_m, poses, tags, wanted)
    poses, anchors = with_anchors([poses], places)
    tags += anchors
    # The distances measured by the authors are used only if the position of a tag is not known.
    known_m = distances_m(poses, tags, exchanges.initiator, exchanges.target, exchanges.time_ns)
    truth_m = np.where(np.isfinite(known_m), np.nan, measured_m)
    ranging = {*exchanges.initiator.tolist(), *exchanges.target.tolist()} - {tag.tag for tag in tags}
    tags += [Tag(number, f"tag{number}", (0.0, 0.0, 0.0)) for number in ranging]
    heard = _read_overheard(flight)
    cirs = _read(flight, "uwb_cir.csv", {"board": "my_id", **_PAIR, "first_path_index": "idx", "taps": "cir"})
    sensed = {f"w{axis}": f"angular_velocity.{axis}" for axis in "xyz"}
    sensed |= {f"a{axis}": f"linear_acceleration.{axis}" for axis in "xyz"}
    imu, height = _read(flight, "imu_px4.csv", sensed), _read(flight, "height.csv", {"height_m": "range"})
    return Contents(
        exchanges=replace(exchanges, truth_m=truth_m),
        tags=sorted(tags, key=lambda tag: tag.tag),
        poses=poses,
        overheard=heard,
        cirs=_cir_rows(cirs),
        imu=imu,
        height=height,
        faults=flight.faults,
        meta=_meta(flight, start_ns, constellation, off_m),
    )


def _constellation(map_file: Path | None) -> str | None:
    if map_file is None:
        return None
    file = TomlReader(map_file, ImportTableError, "map")
    file.known(file.table, ("constellation",))
    found = file.table.get("constellation")
    file.check("constellation", found, found is None or isinstance(found, str), 'a name of anchors.yaml, as "0"')
    return found


def _meta(flight: FlightFolder, start_ns: int, constellation: str | None, off_m: float) -> dict[str, Any]:
    doubled, lost = sum(flight.doubled.values()), len(flight.faults)
    notes = [f"{doubled} rows are in the files of two robots, and are imported once"] if doubled else []
    notes += [f"{lost} rows cannot be used and are kept as faults"] if lost else []
    if constellation is not None:
        notes.append(f"anchors of constellation {constellation}, {100 * off_m:.1f} cm off gt_range")
    return {
        "source": "import miluv",
        "imported_from": flight.folder.resolve().name,
        "clock_began_ns": start_ns,
        "doubled_rows": flight.doubled,
        "notes": notes,
        **({"anchor_constellation": constellation} if constellation else {}),
    }


def _read(
    flight: FlightFolder,
    name: str,
    needed: Mapping[str, str],
    optional: Mapping[str, str] = {},
    by_clock: tuple[tuple[str, ...], ...] = (),
) -> Columns:
    """Return the rows of all robots' files of one name in order of time; an empty dictionary if there are none.

    `needed` and `optional` map names of columns to those of the files; `{raw}` is replaced by `_raw` if a file has such
    columns. `by_clock` are the columns of stamps. Duplicates of rows with ids are dropped; rows without ids belong to
    the robot's body. Rows that lack a required number are faults.
    """
    parts: list[Columns] = []
    ids = [n for n in needed if n in _IDS]
    for robot in flight.robots:
        if not (robot / name).exists():
            continue
        with connected([robot / name]) as db:
            table = SourceTable(db, robot / name)
            raw = "_raw" if any("_raw" in header for header in table.names) else ""
            headers = {n: header.format(raw=raw) for n, header in {"time_ns": "timestamp", **needed}.items()}
            there = headers | {n: header for n, header in optional.items() if header in table.names}
            found = table.read({n: _cell(n, table.text(header)) for n, header in there.items()})
        bad = np.any([np.ma.getmaskarray(found[n]) for n in headers], axis=0)
        flight.faults += [
            Fault(
                flight.start_ns,
                name,
                "unusable row",
                f"{robot.name}/{name}: row {row + 2}: a number is missing or none",
            )
            for row in np.flatnonzero(bad).tolist()
        ]
        columns = {n: np.full(len(bad), np.nan) for n in optional} | {"body": np.full(len(bad), robot.name)}
        columns |= {n: np.ma.getdata(found[n]) if n in headers else np.ma.filled(found[n], np.nan) for n in there}
        columns |= to_ticks(columns, by_clock, TICKS_PER_SECOND * 1e-9, REPORT_BITS)
        parts.append({n: column[~bad] for n, column in columns.items() if n != "body" or not ids})
    if not sum(len(part["time_ns"]) for part in parts):
        return {}
    joined = in_time_order(parts)
    joined["time_ns"] += flight.start_ns
    if not ids:
        return joined
    key = ["time_ns", *ids, *(n for n in ("tx1", "rx1") if n in joined)]
    first = np.sort(np.unique(np.column_stack([joined[n] for n in key]), axis=0, return_index=True)[1])
    flight.doubled[name] = len(joined["time_ns"]) - len(first)
    return {n: column[first] for n, column in joined.items()}


def _cell(name: str, text: str) -> str:
    """Return SQL of a cell of a column, from its text."""
    if name == "taps":
        return f"TRY_CAST({text} AS USMALLINT[])"
    if name == "time_ns":
        return time_ns(text, "s", 1e9)
    whole = whole_number(text)
    return f"CASE WHEN {whole} BETWEEN 0 AND {LARGEST_ID} THEN {whole} END" if name in _IDS else number(text)


def _read_exchanges(flight: FlightFolder) -> tuple[Exchanges, Floats]:
    """Return all exchanges in order of time, without truth, and the distances that the authors measured (n,)."""
    needed = _PAIR | {"range_m": "range{raw}"} | {name: f"{name}{{raw}}" for name in STAMPS}
    optional = {"measured_m": "gt_range"} | {f"fpp{k}_dbm": f"fpp{k}" for k in (1, 2)}
    optional |= {f"skew{k}_ppm": f"skew{k}" for k in (1, 2)}
    columns: dict[str, Any] = _read(flight, "uwb_range.csv", needed, optional, clocks("ds"))
    if not columns:
        raise ImportTableError(f"{flight.folder}: its uwb_range.csv hold no row that can be used")
    measured = columns.pop("measured_m")
    unknown, protocol = np.full(len(measured), np.nan), np.full(len(measured), "ds")
    return Exchanges(protocol=protocol, reporter=columns["initiator"], truth_m=unknown, **columns), measured


def _read_overheard(flight: FlightFolder) -> Columns:
    """Return overheard exchanges: measurements of the listener, and those of the two robots (`_n`)."""
    own = {f"rx{k}": f"rx{k}{{raw}}" for k in (1, 2, 3)}
    neighbours = {f"{name}_n": f"{name}{{raw}}_n" for name in STAMPS}
    by_clock = (tuple(own), *(tuple(f"{name}_n" for name in clock) for clock in clocks("ds")))
    ends = ("1", "2", "3", "1_n", "2_n")
    optional = {f"fpp{end}_dbm": f"fpp{end}" for end in ends} | {f"skew{end}_ppm": f"skew{end}" for end in ends}
    return _read(flight, "uwb_passive.csv", {"listener": "my_id", **_PAIR, **own, **neighbours}, optional, by_clock)


def _cir_rows(columns: Columns) -> list[CirRow]:
    names = ("time_ns", "board", *_PAIR, "first_path_index", "taps")
    cells = [columns[name].tolist() for name in names] if columns else []
    return [CirRow(*plain, tuple(taps.tolist())) for *plain, taps in zip(*cells, strict=True)]  # type: ignore[call-arg]


def _read_poses(flight: FlightFolder) -> Poses:
    """Return the poses of the robots; none without motion capture."""
    names = [*(f"pose.position.{axis}" for axis in "xyz"), *(f"pose.orientation.{axis}" for axis in "xyzw")]
    columns = _read(flight, "mocap.csv", {name: name for name in names})
    if not columns:
        return Poses.from_arrays([], "", (0.0, 0.0, 0.0))
    values = np.column_stack([columns[name] for name in names])
    norm = np.linalg.norm(values[:, 3:], axis=1)
    good = (norm > 0.9) & (norm < 1.1)
    for row in np.flatnonzero(~good):
        detail = f"{columns['body'][row]}/mocap.csv: a quaternion of length {norm[row]:.3g}"
        flight.faults.append(Fault(int(columns["time_ns"][row]), "mocap.csv", "unusable row", detail))
    return Poses(columns["time_ns"], columns["body"], values[:, :3], values[:, 3:] / norm[:, None])[good]


def _read_tags(flight: FlightFolder) -> list[Tag]:
    """Return the robots' tags and lever arms from tags.yaml; none without such a file."""
    arms: Vectors = _read_yaml(flight.folder / "tags.yaml", _vectors, {})
    names = {robot.name for robot in flight.robots}
    return [Tag(number, body, arm) for body, tags in arms.items() if body in names for number, arm in tags.items()]


def _find_anchors(
    flight: FlightFolder, exchanges: Exchanges, measured_m: Floats, poses: Poses, tags: list[Tag], wanted: str | None
) -> tuple[str | None, float, dict[int, tuple[float, float, float]]]:
    """Return the constellation `wanted`, or else the one whose distances agree with `gt_range`.

    Returns its name (None without anchors), the median difference of its distances from `gt_range` (NaN if none can be
    compared), and positions by anchor. Raises `ImportTableError` for a name that is not in anchors.yaml, and if no
    constellation fits.
    """
    path = flight.folder / "anchors.yaml"
    known: Vectors = _read_yaml(path, _vectors, {})
    if wanted is not None and wanted not in known:
        raise ImportTableError(f"{path}: no constellation {wanted[:40]!r}; there are {', '.join(known) or 'none'}")
    ends = exchanges.initiator, exchanges.target
    ranging = {*ends[0].tolist(), *ends[1].tolist()} - {tag.tag for tag in tags}
    if not known or not (ranging or wanted):
        return None, float("nan"), {}
    found = []
    for name, all_places in known.items():
        places = {number: place for number, place in sorted(all_places.items()) if number in ranging}
        joined, anchors = with_anchors([poses], places)
        true_m = distances_m(joined, [*tags, *anchors], *ends, exchanges.time_ns)
        off = np.abs(true_m - measured_m)[np.isin(ends[0], list(places)) | np.isin(ends[1], list(places))]
        off = off[np.isfinite(off)]
        found.append((float(np.median(off)) if len(off) else float("nan"), name, places))
    # The constellations of the dataset differ by a decimetre or more.
    chosen = [one for one in found if one[1] == wanted or (wanted is None and one[0] < 0.05)]
    if not chosen:
        raise ImportTableError(
            f"{path}: gt_range does not determine the constellation; choose one of {', '.join(known)}"
        )
    off_m, name, places = min(chosen)
    return name, off_m, places


def _vectors(table: Any) -> Vectors:
    """Return vectors of tags.yaml and anchors.yaml; each is a list, or text such as "[1.0, 2.0, 3.0]"."""
    found: Vectors = {}
    for name, group in table.items():
        for tag, value in group.items():
            cells = value.strip("[] ").split(",") if isinstance(value, str) else value
            if len(cells) != 3:
                raise ValueError(f"{name}: {tag}: found {reprlib.repr(value)[:40]}")
            found.setdefault(str(name), {})[int(tag)] = (float(cells[0]), float(cells[1]), float(cells[2]))
    return found


def _read_yaml(
    path: Path,
    convert: Callable[[Any], Found],
    absent: Found,
    *,
    expected: str = "groups of tags, each with [x, y, z] in metres",
) -> Found:
    """Return a YAML file as `convert` makes it, `absent` without a file; raises `ImportTableError` if it fails."""
    if not path.exists():
        return absent
    kinds = (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError, RecursionError)
    with raising(ImportTableError, f"{path}: cannot be understood", *kinds, remedy=f"; expected {expected}"):
        return convert(yaml.safe_load(read_text(path, ImportTableError)))
