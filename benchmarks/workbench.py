"""Measure comparisons of protocols and sweeps: the two engines, workers, the overhead of Dask, memory of a sweep."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.__main__ import row, timed
from uwbsim import load, load_design, run_sweep, simulate
from uwbsim.sweep.design import SweepDesign

ROOT = Path(__file__).parents[1]
TEST1 = ROOT / "scenarios" / "icra2023" / "test1.toml"
SWEEP = """[sweep]
scenario = "icra2023/test1"
protocols = ["ss-cfo", "ds"]
ranges = 200_000
seeds = {seeds}
[vary]
"ranging.response_delay_uus" = [300, 1500]
"""

CALIBRATIONS = """[sweep]
scenario = "icra2023/test1"
kind = "calibrate"
seeds = {seeds}
[vary]
"run.duration_s" = [10.0]
"""


def main() -> None:
    """Print one row per figure."""
    if len(sys.argv) > 1:
        print(MEASURES[sys.argv[1]](*sys.argv[2:]))
        return
    print("| what | goal | measured |\n|---|---|---|")
    row("DS-TWR with noise and skew, vectorised, one core", "at least 5 M/s", f"{alone('plain')} M/s")
    row("the same with all effects of the icra2023 flights", "at least 1 M/s", f"{alone('full')} M/s")
    row("a million ranges, integer stamps beside floats: means apart, in standard errors", "under 4", alone("means"))
    row("their variances apart", "under 2 %", alone("variances"))
    one, two = float(alone("sweep", "1")), float(alone("sweep", "2"))
    row("a sweep with two workers, over one", "at least 1.8", f"{one / two:.2f} ({one:.1f} s, {two:.1f} s)")
    beyond = " and ".join(f"{alone('calibrations', workers)} s" for workers in ("1", "2"))
    row(
        "a calibration of a flight of ten seconds beyond its flight, in a sweep with one and two workers",
        "under 0.2 s",
        beyond,
    )
    row("Dask's overhead at the default chunk, over processes", "under 5 %", alone("dask"))
    few, many = float(alone("memory", "4")), float(alone("memory", "400"))
    row("peak memory of a sweep of 400 runs, over one of 4", "", f"{many:.0f} MB, {few:.0f} MB")


def alone(name: str, *arguments: str) -> str:
    """Measure in a separate process, with one thread for linear algebra."""
    environment = dict(os.environ) | {"OPENBLAS_NUM_THREADS": "1"}
    words = [sys.executable, "-m", "benchmarks.workbench", name, *arguments]
    return subprocess.run(words, capture_output=True, text=True, check=True, env=environment).stdout.strip()


def plain() -> str:
    """Return millions of ranges per second with six noisy stamps and skewed clocks."""
    from uwblink.ticks import SPEED_OF_LIGHT
    from uwbsim.protocols.conditions import STATES, Conditions

    start = {"flight": 5 / SPEED_OF_LIGHT, "rate": (5e-6, -5e-6), "at_once": 305e-6}
    one = Conditions.single(**start, scheduled=1538.7e-6, rx_std=1e-10, tx_std=1e-10)
    return _rate(one[np.zeros(STATES, dtype=np.int64)])


def full() -> str:
    """Return the same with motion, bias and noise by power, reflections, whole ticks and the transmission grid."""
    from uwbsim.protocols.conditions import conditions_of

    return _rate(conditions_of(load(TEST1, ["radio.tx_noise_ps=40"])))


def _rate(conditions: Any, count: int = 4_000_000) -> str:
    from uwblink.protocols.table import PROTOCOLS
    from uwbsim.protocols.conditions import range_errors_m

    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    seconds = timed(lambda: range_errors_m(PROTOCOLS["ds"], conditions, 1, count))
    return f"{count / seconds / 1e6:.1f}"


def engines() -> tuple[np.ndarray, np.ndarray, float]:
    """Simulate a million ranges with integer stamps and with floats over the same states; return both, with standard
    errors.
    """
    from uwblink.protocols.table import PROTOCOLS
    from uwblink.twr import raw_range
    from uwbsim.protocols.conditions import conditions_of, range_errors_m
    from uwbsim.protocols.prediction import predict

    settings = ["ranging.rate_hz=250", "run.duration_s=4000", "radio.tx_noise_ps=40"]
    scenario = load(TEST1, settings)
    flight = simulate(scenario, contention=False)
    exact = raw_range(flight.exchanges) - flight.truth_m
    conditions = conditions_of(scenario, 1_000_000)
    fast = range_errors_m(PROTOCOLS["ds"], conditions, 99, len(conditions))
    noise = float(predict(PROTOCOLS["ds"], conditions).variance_m2.mean())
    return exact, fast, float(np.sqrt(noise * (1 / len(exact) + 1 / len(fast))))


def means() -> str:
    exact, fast, error = engines()
    return f"{abs(exact.mean() - fast.mean()) / error:.1f} (n = {len(exact):,})"


def variances() -> str:
    exact, fast, _ = engines()
    return f"{100 * abs(exact.var() / fast.var() - 1):.2f} %"


def design(folder: str, text: str) -> SweepDesign:
    """Return the design of a sweep from its text, which is written into a folder."""
    path = Path(folder) / "plan.toml"
    path.write_text(text)
    return load_design(path)


def sweep(workers: str, seeds: int = 120) -> str:
    """Return the duration of a sweep in seconds."""
    with tempfile.TemporaryDirectory() as folder:
        plan = design(folder, SWEEP.format(seeds=seeds))
        start = time.perf_counter()
        run_sweep(plan, Path(folder) / "out", workers=int(workers))
        return f"{time.perf_counter() - start:.2f}"


def calibrations(workers: str, seeds: int = 40) -> str:
    """Return the processor time of a run with calibration, start of processes included, minus that of its flight."""
    with tempfile.TemporaryDirectory() as folder:
        plan, before = design(folder, CALIBRATIONS.format(seeds=seeds)), _processor_time()
        run_sweep(plan, Path(folder) / "out", workers=int(workers))
        each = (_processor_time() - before) / seeds
    flight = load(TEST1, ["run.duration_s=10"])
    start = time.process_time()
    for _ in range(seeds):
        simulate(flight)
    return f"{each - (time.process_time() - start) / seeds:.2f}"


def _processor_time() -> float:
    """Return the processor time of this process and of its ended child processes."""
    return sum(
        u.ru_utime + u.ru_stime for u in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def dask() -> str:
    """Return the relative overhead of Dask for a chunk of one second, measured on chunks alone."""
    from distributed import Client, LocalCluster

    from uwblink.protocols.table import PROTOCOLS
    from uwbsim.sweep.executors import Work, run_chunk

    with tempfile.TemporaryDirectory() as folder:
        plan = design(folder, SWEEP.format(seeds=40))
        rows = tuple(PROTOCOLS[name] for name in plan.protocols)
        work = Work(name=plan.scenario.stem, protocols=rows, ranges=plan.settings.ranges)
        _, once = run_chunk([plan.loaded(0)], work)
        _, once = run_chunk([plan.loaded(1)], work)
        size = max(int(1 / once), 1)
        chunk = [plan.loaded(k % plan.total) for k in range(size)]
        with (
            LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):
            client.submit(run_chunk, chunk, work, pure=False).result()
            start = time.perf_counter()
            futures = [client.submit(run_chunk, chunk, work, pure=False) for _ in range(8)]
            inside = sum(future.result()[1] for future in futures)
            whole = time.perf_counter() - start
    return f"{100 * (whole / inside - 1):.1f} % (chunks of {inside / 8:.2f} s)"


def memory(seeds: str) -> str:
    """Return the peak memory of a sweep in this process, in MB."""
    with tempfile.TemporaryDirectory() as folder:
        plan = design(folder, SWEEP.format(seeds=int(seeds) // 2).replace("200_000", "20_000"))
        run_sweep(plan, Path(folder) / "out", workers=1)
    return f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}"


MEASURES: dict[str, Callable[..., str]] = {
    "plain": plain, "full": full, "means": means, "variances": variances, "sweep": sweep,
    "calibrations": calibrations, "dask": dask, "memory": memory,
}  # fmt: skip


if __name__ == "__main__":
    main()
