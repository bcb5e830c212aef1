"""Long tests: the recorder is killed at 50 random moments, and boards are served for ten minutes at full rate."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.__main__ import BIN
from benchmarks.boards import BENCH, served
from uwblink.recording.file import Recording
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import raw_range

KILLS = 50
PROMISED_S = 0.25
SERVED_S = 600.0


def main() -> None:
    """Run both tests; exit with status 1 if one fails."""
    minutes = float(sys.argv[1]) / 60 if len(sys.argv) > 1 else SERVED_S / 60
    with tempfile.TemporaryDirectory() as name, served(BENCH, Path(name), 10, 20) as (server, _):
        good = kills(Path(name)) and long_serve(Path(name), server, minutes * 60)
    sys.exit(not good)


def recorder(folder: Path, *more: str) -> list[str]:
    ports = [str(folder / "tag10"), str(folder / "tag20")]
    return [str(BIN / "uwblink"), "record", *ports, "-o", str(folder / "f.uwb"), "--pairs", "all", "--force", *more]


def kills(folder: Path) -> bool:
    """Kill the recorder; the age of the last bytes in the file must be at most the promised one plus one exchange."""
    rng = np.random.default_rng(1)
    ages = []
    for _ in range(KILLS):
        process = subprocess.Popen(recorder(folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(1.5 + rng.uniform(0, 1.5))
        process.kill()
        killed_ns = time.time_ns()
        process.wait()
        with Recording.open(folder / "f.uwb") as recording:
            ages.append((killed_ns - max(f.time_ns for f in recording.frames())) * 1e-9)
    print(f"{KILLS} kills: every file opens; its last bytes are {max(ages):.3f} s old at most", flush=True)
    return max(ages) < PROMISED_S + 0.02


def long_serve(folder: Path, pid: int, seconds: float) -> bool:
    """Range at full rate; memory must stay constant and all ranges correct, over all wraps of the clocks."""
    process = subprocess.Popen(recorder(folder, "--duration", str(seconds)), stdout=subprocess.DEVNULL)
    memory = []
    while process.poll() is None:
        time.sleep(min(10.0, seconds / 6))
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        memory.append(pages * os.sysconf("SC_PAGE_SIZE") / 2**20)
    with Recording.open(folder / "f.uwb") as recording:
        e = recording.exchanges()
    ranges = raw_range(e)
    # The scenario has planted delays (a sum of 0.368 ns) and 116 ps of noise per stamp, and no other errors.
    expected = 3.0 + 0.5 * 0.368e-9 * SPEED_OF_LIGHT
    worst = float(np.abs(ranges - expected).max())
    print(
        f"{seconds:.0f} s served: {len(e)} exchanges, worst range error {100 * worst:.1f} cm, "
        f"{int(seconds / 0.0672)} wraps of 32 bits and {int(seconds / 17.2074)} of 40; "
        f"memory {memory[1]:.1f} MB after the start, {memory[-1]:.1f} MB at the end",
        flush=True,
    )
    return worst < 0.25 and memory[-1] < memory[1] * 1.05


if __name__ == "__main__":
    main()
