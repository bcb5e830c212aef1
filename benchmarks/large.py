"""Measure a calibration of 3.8 million exchanges: time, peak memory, and growth with the number of exchanges.

Each size runs in a separate process on one core. Exchanges are synthetic ranges with the poses of a flight; the time
includes true distances, but not loading. Times are processor times, so that other processes have little effect.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.__main__ import durations

if TYPE_CHECKING:
    from calib.data.ranges import Ranges

SIZES = (38_000, 380_000, 3_800_000)
RATE_HZ = 160
POSES_HZ = 100


def main() -> None:
    """Print one row per size; with an argument, run that size."""
    if len(sys.argv) > 1:
        print("| " + " | ".join(one_size(int(sys.argv[1]))) + " |", flush=True)
        return
    print("| exchanges | true distances | fit by the default loss | by Cauchy's | peak memory of the fits |")
    print("|---|---|---|---|---|")
    for size in SIZES:
        environment = dict(os.environ) | {"OPENBLAS_NUM_THREADS": "1"}
        subprocess.run([sys.executable, "-m", "benchmarks.large", str(size)], check=True, env=environment)


def one_size(size: int) -> list[str]:
    """Return the cells of a row."""
    from uwblink.recording.distances import distances_m

    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    poses, tags, ranges = flight(size)
    runs = 5 if size < 1_000_000 else 1
    ends = tags, ranges.initiator, ranges.target, ranges.time_ns
    seconds = [processor_time(partial(distances_m, poses, *ends), runs)]
    del poses
    # The memory until here is that of the ranges.
    Path("/proc/self/clear_refs").write_text("5")
    seconds += [processor_time(partial(settled, ranges, loss), runs) for loss in (None, "cauchy")]
    unit = [f"{1e3 * s:.0f} ms" if s < 1 else f"{s:.1f} s" for s in seconds]
    return [f"{size:,}".replace(",", " "), *unit, f"{peak_mb():.0f} MB"]


def processor_time(work: Callable[[], object], runs: int) -> float:
    """Return the median time of some runs in seconds; the first of several runs is not counted."""
    return float(np.median(durations(work, runs, int(runs > 1), time.process_time)))


def settled(ranges: Ranges, loss: str | None) -> None:
    """Fit ranges; exit if the fit did not converge, because its time has no meaning."""
    from calib.fitting.fitting import fit

    if not fit(ranges, loss=loss).success:
        sys.exit("the fit did not converge")


def peak_mb() -> float:
    """Return the peak of resident memory since the last reset (Linux)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1e3


def flight(size: int):  # type: ignore[no-untyped-def]
    """Return poses, tags and ranges of three bodies with two tags each, with planted delays, curve and tail."""
    from calib.data.ranges import Ranges
    from uwblink.recording.distances import distances_m
    from uwblink.recording.schema import Poses, Tag
    from uwblink.ticks import SPEED_OF_LIGHT

    rng = np.random.default_rng(1)
    seconds = size / RATE_HZ + 1
    time_s = np.arange(int(seconds * POSES_HZ) + 1) / POSES_HZ
    bodies = ("a", "b", "c")
    phase = np.arange(3)[:, None] + time_s * 0.3
    place = np.stack([2 * np.sin(phase), 2 * np.cos(1.3 * phase), 1 + np.sin(0.7 * phase)], axis=-1)
    turn = np.stack([0 * phase, 0 * phase, np.sin(phase / 2), np.cos(phase / 2)], axis=-1)
    count = len(time_s)
    poses = Poses(
        np.tile((time_s * 1e9).astype(np.int64), 3), np.repeat(bodies, count), place.reshape(-1, 3), turn.reshape(-1, 4)
    )
    tags = [Tag(k + 1, bodies[k // 2], (0.17 * (-1) ** k, -0.17 * (-1) ** k, -0.05)) for k in range(6)]
    pairs = np.array([(i, j) for i in range(1, 7) for j in range(i + 1, 7) if (i - 1) // 2 != (j - 1) // 2])
    initiator, target = pairs[np.arange(size) % len(pairs)].T
    time_ns = (np.arange(size) * (1e9 / RATE_HZ)).astype(np.int64)
    truth = distances_m(poses, tags, initiator, target, time_ns)
    power = -78 - 20 * np.log10(truth) + rng.normal(size=(2, size)) * 2
    lifted = np.mean(10 ** ((power + 82) / 10), axis=0)
    delay = np.array([0, -0.36, 0.0, -0.07, -0.36, -0.17, -0.12])
    raw = truth + 0.08 * np.sin(3 * lifted) - 0.5e-9 * SPEED_OF_LIGHT * (delay[initiator] + delay[target])
    raw += 0.08 * rng.normal(size=size) + np.where(rng.random(size) < 0.11, rng.exponential(0.34, size), 0)
    ranges = Ranges.from_arrays(
        raw, truth_m=truth, initiator=initiator, target=target, fpp1_dbm=power[0], fpp2_dbm=power[1], time_ns=time_ns
    )
    return poses, tags, ranges


if __name__ == "__main__":
    main()
