"""A recording as one MCAP file of JSON messages for Foxglove and PlotJuggler: poses, frames, ranges, readings, faults.

Poses, frames and logs have the schemas that Foxglove knows.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from heapq import merge
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from mcap.writer import Writer

from uwblink.arrays import Floats
from uwblink.errors import RecordingError
from uwblink.exporters.corrections import corrections
from uwblink.exporters.schemas import RANGE, SCHEMAS, stamped
from uwblink.recording.contents import READING_MB, Contents, distances_by_poses_m, pieces
from uwblink.recording.file import Recording

WORLD: Final = "world"
WARNING: Final = 3
"""The level of a foxglove.Log that faults have."""

NUMBERS: Final = ("range_m", "truth_m", "fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm")

Message = tuple[int, str, str, dict[str, Any]]
"""Time in nanoseconds, topic, schema, content."""


def write_mcap(recording: Path, folder: Path) -> dict[str, int]:
    """Write `recording.mcap`; returns its messages. Times before 1970 cannot be written and raise `RecordingError`."""
    with Recording.open(recording, memory_mb=READING_MB) as opened, (folder / "recording.mcap").open("wb") as file:
        count = _write(recording, file, _messages(opened))
    return {"recording.mcap": count}


def _messages(recording: Recording) -> Iterator[Message]:
    for held in pieces(recording):
        (by_poses,) = distances_by_poses_m(recording, [held.exchanges])
        parts = (_poses(held), _ranges(held, by_poses), _imu(held), _heights(held), _temperatures(held), _faults(held))
        yield from merge(*parts, key=lambda message: message[0])


def _write(recording: Path, file: BinaryIO, messages: Iterator[Message]) -> int:
    writer = Writer(file)
    writer.start(library="uwbcal")
    schemas = {
        name: writer.register_schema(name, "jsonschema", json.dumps(layout).encode())
        for name, layout in SCHEMAS.items()
    }
    channels: dict[str, int] = {}
    count = 0
    for time_ns, topic, schema, content in messages:
        if time_ns < 0:
            raise RecordingError(f"{recording}: has times before 1970, which MCAP cannot hold")
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, "json", schemas[schema])
        try:
            data = json.dumps(stamped(time_ns, content), allow_nan=False).encode()
        except ValueError as error:
            raise RecordingError(f"{recording}: {topic}: holds a number that is none, which JSON cannot say") from error
        writer.add_message(channels[topic], time_ns, data, time_ns, count & 0xFFFFFFFF)
        count += 1
    writer.finish()  # type: ignore[no-untyped-call]  # the library does not say what it returns
    return count


def _vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def _poses(held: Contents) -> Iterator[Message]:
    poses = held.poses
    columns = (poses.time_ns.tolist(), poses.body.tolist(), poses.position_m.tolist(), poses.quaternion.tolist())
    for time_ns, body, place, (x, y, z, w) in zip(*columns, strict=True):
        position, attitude = _vector(*place), {"x": x, "y": y, "z": z, "w": w}
        pose = {"position": position, "orientation": attitude}
        yield time_ns, f"/poses/{body}", "foxglove.PoseInFrame", {"frame_id": WORLD, "pose": pose}
        frames = {"parent_frame_id": WORLD, "child_frame_id": body}
        yield time_ns, "/tf", "foxglove.FrameTransform", frames | {"translation": position, "rotation": attitude}


def _ranges(held: Contents, by_poses: Floats) -> Iterator[Message]:
    e = replace(held.exchanges, truth_m=np.where(np.isfinite(held.exchanges.truth_m), held.exchanges.truth_m, by_poses))
    names = ("initiator", "target", "protocol", *NUMBERS)
    columns = {name: getattr(e, name).tolist() for name in names} | corrections(held)
    for k in np.argsort(e.time_ns, kind="stable").tolist():
        row = {name: column[k] for name, column in columns.items()}
        yield int(e.time_ns[k]), f"/ranges/{row['initiator']}_{row['target']}", RANGE, _known(row)


def _known(row: dict[str, Any]) -> dict[str, Any]:
    """Leave out numbers that are none: JSON has no word for them."""
    return {name: value for name, value in row.items() if not isinstance(value, float) or np.isfinite(value)}


def _imu(held: Contents) -> Iterator[Message]:
    if held.imu:
        columns = [held.imu[name].tolist() for name in ("time_ns", "body", "wx", "wy", "wz", "ax", "ay", "az")]
        for time_ns, body, *values in zip(*columns, strict=True):
            turn, pull = (_known(_vector(*part)) for part in (values[:3], values[3:]))
            yield time_ns, f"/imu/{body}", "uwb.Imu", {"angular_velocity": turn, "linear_acceleration": pull}


def _heights(held: Contents) -> Iterator[Message]:
    if held.height:
        for time_ns, body, height in zip(
            *(held.height[n].tolist() for n in ("time_ns", "body", "height_m")), strict=True
        ):
            yield time_ns, f"/height/{body}", "uwb.Height", _known({"height_m": height})


def _temperatures(held: Contents) -> Iterator[Message]:
    if held.temperature:
        names = ("time_ns", "tag", "temperature_c", "supply_v")
        for time_ns, tag, celsius, volts in zip(*(held.temperature[n].tolist() for n in names), strict=True):
            yield (
                time_ns,
                f"/temperature/{tag}",
                "uwb.Temperature",
                _known({"temperature_c": celsius, "supply_v": volts}),
            )


def _faults(held: Contents) -> Iterator[Message]:
    for fault in sorted(held.faults, key=lambda fault: fault.time_ns):
        text = {"message": f"{fault.kind}: {fault.detail}", "name": fault.board, "file": "", "line": 0}
        yield fault.time_ns, "/faults", "foxglove.Log", {"level": WARNING, **text}
