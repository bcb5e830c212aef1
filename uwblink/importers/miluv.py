"""A flight of the MILUV dataset, as its authors publish it, into a recording.

A folder holds one folder a robot with `uwb_range.csv`, and optionally `uwb_passive.csv`, `uwb_cir.csv`, `mocap.csv`,
`imu_px4.csv` and `height.csv`, and beside those `timeshift.yaml`, `tags.yaml` (lever arms) and `anchors.yaml`
(constellations). Stamps are those before the authors' correction (`tx1_raw` ...): unwrapped nanoseconds, which become
ticks again. All files of a folder share one clock; `timeshift.yaml` says when it began.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from uwblink.errors import ImportTableError
from uwblink.importers import miluv_files as files
from uwblink.importers.miluv_anchors import Anchors, find_anchors, read_tags, unplaced
from uwblink.importers.miluv_yaml import read_mapping
from uwblink.recording.contents import Contents
from uwblink.recording.distances import distances_m
from uwblink.text_files import TomlReader


def read_miluv(folder: Path, map_file: Path | None = None) -> Contents:
    """Return the flight in `folder`; rows that stand in the files of two robots are taken once.

    `map_file` may name the anchors of anchors.yaml (`constellation = "0"`); else they are those whose distances are
    `gt_range`. `meta["notes"]` says what was left out. Raises `ImportTableError`.
    """
    wanted = _constellation(map_file)
    flight = files.open_flight(folder)
    start_ns = _start_ns(folder)
    exchanges, measured_m = files.read_exchanges(flight)
    poses, tags = files.read_poses(flight), read_tags(flight)
    anchors = find_anchors(flight, exchanges, measured_m, poses, tags, wanted)
    poses, tags = anchors.join(poses), [*tags, *anchors.tags()]
    # What the authors measured stands in where a tag's place is not known, and nowhere else.
    known_m = distances_m(poses, tags, exchanges.initiator, exchanges.target, exchanges.time_ns)
    truth_m = np.where(np.isfinite(known_m), np.nan, measured_m)
    tags += unplaced(tags, exchanges)
    overheard, cirs, imu, height = (
        _later(read(flight), start_ns)
        for read in (files.read_overheard, files.read_cirs, files.read_imu, files.read_heights)
    )
    return Contents(
        exchanges=replace(exchanges, truth_m=truth_m, time_ns=exchanges.time_ns + start_ns),
        tags=sorted(tags, key=lambda tag: tag.tag),
        poses=replace(poses, time_ns=poses.time_ns + start_ns),
        overheard=overheard,
        cirs=files.cir_rows(cirs),
        imu=imu,
        height=height,
        faults=[replace(fault, time_ns=fault.time_ns + start_ns) for fault in flight.faults],
        meta=_meta(flight, start_ns, anchors),
    )


def _later(columns: files.Columns, start_ns: int) -> files.Columns:
    return columns | {"time_ns": columns["time_ns"] + start_ns} if columns else columns


def _constellation(map_file: Path | None) -> str | None:
    if map_file is None:
        return None
    file = TomlReader(map_file, ImportTableError, "map")
    file.known(file.table, ("constellation",))
    found = file.table.get("constellation")
    file.check("constellation", found, found is None or isinstance(found, str), 'a name of anchors.yaml, as "0"')
    return found


def _meta(flight: files.Flight, start_ns: int, anchors: Anchors) -> dict[str, Any]:
    doubled, lost = sum(flight.doubled.values()), len(flight.faults)
    notes = [f"{doubled} rows stand in the files of two robots, and are taken once"] if doubled else []
    notes += [f"{lost} rows cannot be used and are kept as faults"] if lost else []
    if anchors.constellation is not None:
        notes.append(f"anchors of constellation {anchors.constellation}, {100 * anchors.off_m:.1f} cm off gt_range")
    return {
        "source": "import miluv",
        "imported_from": flight.folder.resolve().name,
        "clock_began_ns": start_ns,
        "doubled_rows": flight.doubled,
        "notes": notes,
        **({"anchor_constellation": anchors.constellation} if anchors.constellation else {}),
    }


def _start_ns(folder: Path) -> int:
    path = folder / "timeshift.yaml"
    if not path.exists():
        return 0
    table = read_mapping(path)
    try:
        return int(table["timeshift_s"]) * 1_000_000_000 + int(table["timeshift_ns"])
    except (KeyError, TypeError, ValueError) as error:
        raise ImportTableError(f"{path}: expected whole numbers timeshift_s and timeshift_ns") from error
