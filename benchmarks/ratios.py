"""Processor time of the packages divided by that of plain scripts (`benchmarks.plain`) for the same tasks.

`python -m benchmarks.ratios` prints a table; `--check` fails if a ratio is above its bound in each of a dozen turns.
Times are processor times of all threads of this process. Both sides are measured in turns, so that other processes slow
both, and the ratio is the median over turns.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from benchmarks import plain

ROOT = Path(__file__).parents[1]
TRAIN = ROOT / "scenarios" / "icra2023" / "train.toml"
TURNS: Final = 7
TRIES: Final = 12
"""Number of turns after which a ratio that was always above its bound fails."""

FIGURES: Final = 7
ROWS: Final = 200_000
COUNT: Final = 1_000_000


class Pair(NamedTuple):
    """Two ways to do a task, with the goal for the ratio of their times, and the bound from which a check fails."""

    what: str
    beside: str
    ours: Callable[[], object]
    plain: Callable[[], object]
    goal: float | None
    bound: float


def pairs(folder: Path) -> list[Pair]:
    """Return the pairs, with their input data."""
    import calib
    import uwblink
    import uwbsim
    from benchmarks.__main__ import LISTENING
    from benchmarks.importing import TABLE
    from calib.fitting.fitting import fit
    from uwblink.protocols.table import PROTOCOLS
    from uwblink.ticks import SPEED_OF_LIGHT
    from uwbsim.protocols.conditions import STATES, Conditions, range_errors_m

    scenario = uwbsim.load(TRAIN)
    flight = uwbsim.simulate(scenario)
    flight.save(folder / "train.uwb")
    ranges = calib.load_ranges(folder / "train.uwb")
    heard = calib.load_ranges(uwbsim.simulate(uwbsim.load(TRAIN, LISTENING)))
    calibration = calib.fit(ranges).calibration
    errors = ranges.raw_m - ranges.truth_m
    panels = [{"power_dbm": ranges.fpp1_dbm, "error_m": errors}] * FIGURES
    times = {"flight": 5 / SPEED_OF_LIGHT, "at_once": 305e-6, "scheduled": 1538.7e-6}
    one = Conditions.single(**times, rate=(5e-6, -5e-6), rx_std=1e-10, tx_std=1e-10)
    states = one[np.zeros(STATES, dtype=np.int64)]
    write_table(folder, TABLE)

    def monte_carlo() -> None:
        range_errors_m(PROTOCOLS["ds"], states, 1, COUNT)

    return [
        Pair("a million ranges by Monte Carlo, DS-TWR, noise and skew", "NumPy, six columns of noise",
             monte_carlo, lambda: plain.monte_carlo(COUNT), 1 / 1.5, 1.5),
        Pair("simulating the training flight, all effects", "SimPy, five time-outs an exchange",
             lambda: uwbsim.simulate(scenario), lambda: plain.five_timeouts(len(flight.exchanges)), None, 5.0),
        Pair(f"`uwblink import csv` of {ROWS} rows", "DuckDB's `read_csv` of them",
             lambda: uwblink.import_recording(folder / "table.csv", folder / "table.uwb", force=True),
             lambda: plain.parse(folder / "table.csv"), 3.0, 9.0),
        # Measured: 13 to 19. Score tests for direction take a sixth of the time. Corrected steps converge in rooms, and
        # slopes are computed again for the checks, which halves the memory for long recordings.
        Pair("a fit of the flight: delays, curve, intervals, doubts", "SciPy's `least_squares`, delays alone",
             lambda: fit(ranges), lambda: plain.least_squares(errors, ranges.initiator, ranges.target), None, 18.0),
        # Measured: 4.6, for five times as many rows, two thirds of which are within the curve; 5.6 before both sides of
        # a difference used one density.
        Pair("a fit of it with all tags listening, four differences of arrival an exchange", "a fit of its exchanges",
             lambda: fit(heard, use="receptions"), lambda: fit(heard), 5.0, 6.0),
        Pair("`calib evaluate --report` of it, in process", "Matplotlib, as many figures at two widths",
             lambda: calib.write_report(folder / "r.html", ranges, calibration, force=True),
             lambda: plain.draw(panels), None, 4.0),
    ]  # fmt: skip


def write_table(folder: Path, code: str) -> None:
    """Write the table to import."""
    subprocess.run([sys.executable, "-c", code, str(ROWS)], cwd=folder, check=True)


def seconds(work: Callable[[], object]) -> float:
    """Return the processor time of a function, of all threads."""
    start = time.process_time()
    work()
    return time.process_time() - start


def turn(pair: Pair) -> tuple[float, float]:
    """Return the times of both sides, that of the packages first."""
    beside = seconds(pair.plain)
    return seconds(pair.ours), beside


def table(made: list[Pair]) -> None:
    """Print a row per pair."""
    print("| what | beside it | goal | ours | plain | ratio |\n|---|---|---|---|---|---|")
    for pair in made:
        turn(pair)
        taken = [turn(pair) for _ in range(TURNS)]
        ours, beside = (statistics.median(side) for side in zip(*taken, strict=True))
        ratio = statistics.median(one / other for one, other in taken)
        goal = f"at most {pair.goal:.2f}" if pair.goal else ""
        print(f"| {pair.what} | {pair.beside} | {goal} | {ours:.2f} s | {beside:.2f} s | {ratio:.2f} |", flush=True)


def beyond(pair: Pair) -> str:
    """Return a line on a ratio that is above its bound in all turns, "" otherwise."""
    found = []
    for _ in range(TRIES):
        ours, beside = turn(pair)
        found.append(ours / beside)
        if found[-1] <= pair.bound:
            return ""
    return (
        f"{pair.what}: {min(found):.2f} times {pair.beside} at best of {TRIES} turns, at most {pair.bound:g} expected"
    )


def main() -> int:
    """Print the table; with `--check`, return 1 and print the reason if a ratio is above its bound."""
    with tempfile.TemporaryDirectory() as folder:
        made = pairs(Path(folder))
        if sys.argv[1:] != ["--check"]:
            table(made)
            return 0
        wrong = list(filter(None, map(beyond, made)))
    print("\n".join(wrong) or f"{len(made)} ratios are within their bounds")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
