"""Trajectories in the TUM format: a line a pose, `time x y z qx qy qz qw`, a file a body."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from uwblink.errors import RecordingError
from uwblink.recording.contents import READING_MB, pieces
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses


def write_tum(recording: Path, folder: Path) -> dict[str, int]:
    """Write the poses of each body, times in seconds with nine decimals; returns the poses by file.

    Letters of a body's name that are not safe in a file's name become "_". Raises `RecordingError`.
    """
    with Recording.open(recording, memory_mb=READING_MB) as opened, ExitStack() as files:
        names = _file_names(body for (body,) in opened.tally("poses", "body"))
        if not names:
            raise RecordingError(f"{recording}: holds no poses")
        out = {body: files.enter_context((folder / name).open("w", encoding="utf-8")) for body, name in names.items()}
        written = dict.fromkeys(names.values(), 0)
        for held in pieces(opened):
            for body in np.unique(held.poses.body).tolist():
                mine = held.poses[held.poses.body == body]
                out[body].writelines(_lines(mine))
                written[names[body]] += len(mine)
    return written


def _file_names(bodies: Iterable[str]) -> dict[str, str]:
    """Return the name of each body's file, all different."""
    found: dict[str, str] = {}
    for body in sorted(bodies):
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in body) or "_"
        while f"{name}.tum" in found.values():
            name += "_"
        found[body] = f"{name}.tum"
    return found


def _lines(poses: Poses) -> Iterator[str]:
    columns = (poses.time_ns.tolist(), poses.position_m.tolist(), poses.quaternion.tolist())
    for time_ns, place, turn in zip(*columns, strict=True):
        yield " ".join([_seconds(time_ns), *map(repr, [*place, *turn])]) + "\n"


def _seconds(time_ns: int) -> str:
    """Return nanoseconds as seconds, exactly."""
    whole, rest = divmod(abs(time_ns), 1_000_000_000)
    return f"{'-' if time_ns < 0 else ''}{whole}.{rest:09d}"
