"""Measure the figures of docs/speed.md and print them as a table.

Each figure is the median of several runs, after a first run that is not counted. Commands run in separate processes, so
that their time and peak memory include start-up; they use compiled modules, as in an installation. The others are timed
in this process.
"""

from __future__ import annotations

import datetime
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uwblink.arrays import Floats

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
TRAIN = ROOT / "scenarios" / "icra2023" / "train.toml"
RUNS = 5
IN_A_ROOM = (
    "room={min_m=[-3.5,-3.5,0],max_m=[3.5,3.5,3.5]}",
    "radio.multipath={model='geometric'}",
    *(f"bodies.{k}.shadow={{semi_axes_m=[0.25,0.25,0.08],loss_db_per_m=30.0}}" for k in range(3)),
)
LISTENING = tuple(f"tags.{k}.passive=true" for k in range(6))


def main() -> None:
    """Print one row per figure."""
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"numpy {np.__version__}, {datetime.datetime.now(tz=datetime.UTC).date()}\n"
    )
    print("| what | goal | measured (median of 5) |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = f"{folder}/compiled"
        recording = Path(folder) / "train.uwb"
        seconds, megabytes = command("uwbsim", "run", TRAIN, "-o", recording, "--force")
        row("`uwbsim run` of the 240 s training scenario, whole process", "under 1 s", f"{seconds:.2f} s")
        row("its peak memory", "under 500 MB", f"{megabytes:.0f} MB")
        row(
            "fit of its exchanges, in process, after loading",
            "under 150 ms",
            f"{fitting(recording) * 1e3:.0f} ms",
        )
        calibration = Path(folder) / "calibration.json"
        seconds, _ = command("calib", "fit", recording, "-o", calibration, "--force")
        row("`calib fit` of it, whole process", "under 0.4 s", f"{seconds:.2f} s")
        seconds, _ = command(
            "calib", "evaluate", recording, "-c", calibration, "--report", f"{folder}/r.html", "--force"
        )
        row("`calib evaluate --report` of it, all figures, whole process", "under 2 s", f"{seconds:.1f} s")
        row("loading a million exchanges", "under 0.3 s", f"{loading(Path(folder)):.2f} s")
        seconds, _ = command("calib", "--help")
        row("`calib --help`, whole process", "under 0.5 s", f"{seconds:.2f} s")
    for what, goal, settings, contention in (
        ("simulating its exchanges, all effects, in process", "80 000", (), True),
        ("the same without the event loop (`--no-contention`)", "150 000", (), False),
        ("the first with all tags listening, four to each exchange", "8 000", LISTENING, True),
        ("simulating them with one channel from geometry: room, things and bodies", "25 000", IN_A_ROOM, True),
        ("the same with all tags listening", "8 000", IN_A_ROOM + LISTENING, True),
    ):
        rate = f"{simulating(settings, contention=contention):,.0f} exchanges/s".replace(",", " ")
        row(what, f"at least {goal} exchanges/s", rate)


def row(what: str, goal: str, figure: str) -> None:
    """Print a row of the table."""
    print(f"| {what} | {goal} | {figure} |", flush=True)


def command(name: str, *arguments: object) -> tuple[float, float]:
    """Return the median wall time in seconds and the peak memory in MB of a command on one core."""
    times, peaks = zip(*(one_run([str(BIN / name), *map(str, arguments)]) for _ in range(RUNS + 1)), strict=True)
    return statistics.median(times[1:]), max(peaks)


def one_run(arguments: list[str]) -> tuple[float, float]:
    """Run a command once; return the time and memory that the operating system reports for the finished process."""
    start = time.perf_counter()
    process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, preexec_fn=one_core)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{' '.join(arguments)}: exit status {process.returncode}")
    return time.perf_counter() - start, usage.ru_maxrss / 1024


def one_core() -> None:
    """Restrict the process that is started here to one core."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def timed(work: Callable[[], object]) -> float:
    """Return the median time of `work` in seconds."""
    return float(np.median(durations(work, RUNS)))


def durations(
    work: Callable[[], object], count: int, warm_up: int = 1, clock: Callable[[], float] = time.perf_counter
) -> Floats:
    """Return the times (count,) of some runs of `work` in seconds, after the first ones, which are not counted."""
    times = []
    for _ in range(warm_up + count):
        start = clock()
        work()
        times.append(clock() - start)
    return np.array(times[warm_up:])


def simulating(settings: Sequence[str], *, contention: bool) -> float:
    """Return the number of simulated exchanges per second for the training flight, with further settings."""
    from uwbsim import simulate
    from uwbsim.scenario.loading import load

    scenario = load(TRAIN, settings)
    count = len(simulate(scenario, contention=contention).exchanges)
    return count / timed(lambda: simulate(scenario, contention=contention))


def fitting(recording: Path) -> float:
    """Return the time of a fit in seconds, with data in memory."""
    from calib.data.sources import load_ranges
    from calib.fitting.fitting import fit

    ranges = load_ranges(recording)
    return timed(lambda: fit(ranges))


def loading(folder: Path) -> float:
    """Return the time to read a million random exchanges as columns, in seconds."""
    from uwblink.recording.file import Recording
    from uwblink.twr import COLUMNS, Exchanges

    rng = np.random.default_rng(1)
    n = 1_000_000
    columns: dict[str, Any] = {
        name: rng.normal(size=n) if name.endswith(("_m", "_dbm", "_ppm")) else rng.integers(0, 2**32, n)
        for name in COLUMNS
    }
    columns |= {name: rng.integers(1, 7, n) for name in ("initiator", "target", "reporter")}
    columns |= {"time_ns": np.arange(n, dtype=np.int64), "protocol": np.full(n, "ds")}
    path = folder / "million.uwb"
    with Recording.create(path) as recording:
        recording.append("exchanges", Exchanges(**columns))

    def read() -> None:
        with Recording.open(path) as recording:
            if len(recording.exchanges()) != n:
                sys.exit("not all exchanges came back")

    return timed(read)


if __name__ == "__main__":
    main()
