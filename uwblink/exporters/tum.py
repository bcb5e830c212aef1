"""Trajectories in the TUM format: a line a pose, `time x y z qx qy qz qw`, a file a body."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from uwblink.errors import RecordingError
from uwblink.recording.file import Recording


def write_tum(recording: Path, folder: Path) -> dict[str, int]:
    """Write the poses of each body, times in seconds with nine decimals; returns the poses by file.

    Letters of a body's name that are not safe in a file's name become "_". Raises `RecordingError`.
    """
    with Recording.open(recording) as opened:
        poses = opened.poses()
    if not len(poses):
        raise RecordingError(f"{recording}: holds no poses")
    written: dict[str, int] = {}
    for body in np.unique(poses.body).tolist():
        rows = np.flatnonzero(poses.body == body)
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in body) or "_"
        while f"{name}.tum" in written:
            name += "_"
        lines = [
            " ".join([_seconds(int(poses.time_ns[k])), *map(repr, [*poses.position_m[k].tolist(), *q])])
            for k, q in zip(rows, poses.quaternion[rows].tolist(), strict=True)
        ]
        (folder / f"{name}.tum").write_text("\n".join(lines) + "\n", encoding="utf-8")
        written[f"{name}.tum"] = len(lines)
    return written


def _seconds(time_ns: int) -> str:
    """Return nanoseconds as seconds, exactly."""
    whole, rest = divmod(abs(time_ns), 1_000_000_000)
    return f"{'-' if time_ns < 0 else ''}{whole}.{rest:09d}"
