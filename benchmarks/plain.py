"""Plain scripts for the same tasks, written from the definitions without the packages, for comparison."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from uwblink.arrays import Floats, Ints

C = 299_702_547.0
WIDTHS_IN = (7.16, 3.5)


def monte_carlo(count: int, seed: int = 1) -> Floats:
    """Return errors of DS-TWR in metres: six noisy stamps, two skewed clocks, 5 m."""
    rng = np.random.default_rng(seed)
    flight, reply, third, noise_s = 5 / C, 305e-6, 1538.7e-6, 1e-10
    first, second = 1 + 5e-6, 1 - 5e-6

    def noise() -> Floats:
        return rng.normal(0, noise_s, count)

    tx1, rx1 = noise(), second * flight + noise()
    left = flight + reply / second
    tx2, rx2 = second * left + noise(), first * (left + flight) + noise()
    left = left + third / second
    tx3, rx3 = second * left + noise(), first * (left + flight) + noise()
    ratio = (rx3 - rx2) / (tx3 - tx2)
    return np.asarray(C * 0.5 * ((rx2 - tx1) - ratio * (tx2 - rx1)) - 5)


def five_timeouts(count: int) -> float:
    """Run exchanges with five time-outs each, one after the other, in SimPy; return the end of the last one."""
    import simpy

    env = simpy.Environment()

    def flights() -> Any:
        for _ in range(count):
            for delay in (1e-3, 3e-4, 1e-3, 1.5e-3, 1e-3):
                yield env.timeout(delay)

    env.process(flights())
    env.run()
    return float(env.now)


def parse(table: Path) -> int:
    """Read a table with DuckDB alone; return the number of its rows."""
    import duckdb

    connection = duckdb.connect()
    connection.execute("SET enable_progress_bar = false")
    found = connection.execute("SELECT * FROM read_csv(?)", [str(table)]).fetchnumpy()
    return len(next(iter(found.values())))


def least_squares(error_m: Floats, initiator: Ints, target: Ints) -> Floats:
    """Return delays by tag in metres from errors of ranges (n,), by a robust loss of SciPy with a dense matrix."""
    from scipy import optimize

    tags, ends = np.unique(np.concatenate([initiator, target]), return_inverse=True)
    design = np.zeros((len(error_m), len(tags)))
    rows = np.arange(len(error_m))
    for end in np.split(ends, 2):
        design[rows, end] -= 0.5

    def left(delays: Floats) -> Floats:
        return np.asarray(error_m - design @ delays)

    def slope(_delays: Floats) -> Floats:
        return -design

    return np.asarray(optimize.least_squares(left, np.zeros(len(tags)), slope, loss="soft_l1", f_scale=0.1).x)


def draw(panels: list[dict[str, Floats]]) -> int:
    """Draw errors over power and histograms at the widths of a page and a column; return SVG files."""
    from matplotlib.figure import Figure

    total = 0
    for panel in panels:
        for width in WIDTHS_IN:
            figure = Figure(figsize=(width, 2.6), layout="constrained")
            cloud, bars = figure.subplots(1, 2)
            cloud.scatter(panel["power_dbm"], 100 * panel["error_m"], s=1, alpha=0.3, rasterized=True)
            cloud.set_xlabel("power (dBm)")
            cloud.set_ylabel("error (cm)")
            bars.hist(100 * panel["error_m"], bins=40, histtype="step", label="raw")
            bars.set_xlabel("error (cm)")
            bars.legend()
            data = io.BytesIO()
            figure.savefig(data, format="svg", dpi=220)
            total += len(data.getvalue())
    return total
