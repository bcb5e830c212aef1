"""Motion capture of served boards: a file that grows in step with the boards' time, for as long as they are served."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from uwblink.arrays import Floats
from uwblink.output import new_file
from uwbsim.random_streams import stream
from uwbsim.world.world import World

NS_PER_S: Final = 1_000_000_000
HEADER: Final = "time_ns,body,x,y,z,qx,qy,qz,qw\n"


class LivePoses:
    """Writes what motion capture sees, with its rate, noise, latency and gaps, as `uwblink poses` reads it.

    Rows are written whole, so that whoever reads the file meanwhile finds complete lines.
    """

    def __init__(self, world: World, path: Path, epoch_ns: int) -> None:
        """Begin a file; `epoch_ns` is the host time at which the world's time is zero."""
        self._world, self._epoch_ns = world, epoch_ns
        self._eyes = {name: _Eye(world, name) for name in world.trajectories}
        self._next = 0
        self._file = new_file(path, force=True)
        self._file.write(HEADER)
        self._file.flush()

    def write_until(self, time_ns: int) -> None:
        """Append what motion capture has told by a time of the world."""
        mocap = self._world.scenario.mocap
        latency_ns = round(mocap.latency_ms * 1e6)
        end = math.floor((time_ns - latency_ns) * mocap.rate_hz / NS_PER_S) + 1
        if end <= self._next:
            return
        taken_ns = np.rint(np.arange(self._next, end) * (NS_PER_S / mocap.rate_hz)).astype(np.int64)
        rows = [
            f"{int(at) + latency_ns + self._epoch_ns},{name}," + ",".join(f"{v:.6f}" for v in pose)
            for name, eye in self._eyes.items()
            for at, pose in zip(taken_ns, eye.see(taken_ns * 1e-9), strict=True)
            if pose is not None
        ]
        rows.sort(key=lambda row: int(row[: row.index(",")]))
        self._next = end
        if rows:
            self._file.write("\n".join(rows) + "\n")
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class _Eye:
    """What motion capture sees of one body."""

    def __init__(self, world: World, body: str) -> None:
        self._mocap, self._path = world.scenario.mocap, world.trajectories[body]
        self._noise = stream(world.scenario.run.seed, "live motion capture", body)
        self._gaps = stream(world.scenario.run.seed, "live motion capture gaps", body)
        self._blind_from_s = self._gap_after(0.0)

    def _gap_after(self, time_s: float) -> float:
        """Draw when the next gap begins."""
        per_min = self._mocap.gaps_per_min
        return time_s + float(self._gaps.exponential(60 / per_min)) if per_min else math.inf

    def see(self, time_s: Floats) -> list[Floats | None]:
        """Return position and quaternion at times (n,), None in a gap."""
        spread = self._noise.normal(size=(2, len(time_s), 3))
        position = self._path.position_m(time_s) + spread[0] * self._mocap.position_noise_m
        wobble = Rotation.from_rotvec(spread[1] * self._mocap.attitude_noise_rad)
        turn = (Rotation.from_quat(self._path.quaternion(time_s)) * wobble).as_quat()
        return [
            None if self._is_blind(at) else np.concatenate(p) for at, *p in zip(time_s, position, turn, strict=True)
        ]

    def _is_blind(self, time_s: float) -> bool:
        while time_s > (end_s := self._blind_from_s + self._mocap.gap_s):
            self._blind_from_s = self._gap_after(end_s)
        return time_s >= self._blind_from_s
