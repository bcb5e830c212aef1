"""Requirements of a training flight (duration, room, motion, pairs): errors of fits against planted values, as a table.

`python -m benchmarks.campaigns` writes the table into docs/motion-capture.md. Each flight is
scenarios/icra2023/train.toml with one change; the result is evaluated on the test flight, which is not changed.
"""

from __future__ import annotations

import argparse
import copy
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

import calib
import uwbsim
from benchmarks.studies import write_section

PAGE: Final = Path("docs/motion-capture.md")
FLIGHTS: Final = Path("scenarios/icra2023")
LENGTH_S: Final = 60.0
COLUMNS: Final = (
    "the training flight",
    "ranges",
    "delays off by, rms (ps)",
    "half of their 95 % intervals (ps)",
    "corrections of another flight off by, rms (mm)",
)
HEAD: Final = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|\n"

Table = dict[str, Any]


def lasting(seconds: float) -> Callable[[Table], None]:
    """Return a function that changes the duration of a flight."""

    def change(table: Table) -> None:
        table["run"]["duration_s"] = seconds

    return change


def in_boxes_of(size_m: float) -> Callable[[Table], None]:
    """Return a function that replaces the boxes in which bodies fly by cubes about the same centres."""

    def change(table: Table) -> None:
        for body in table["bodies"]:
            motion = body["motion"]
            middle = (np.array(motion["box_min_m"]) + np.array(motion["box_max_m"])) / 2
            motion["box_min_m"] = (middle - size_m / 2).tolist()
            motion["box_max_m"] = (middle + size_m / 2).tolist()

    return change


def hovering(table: Table) -> None:
    """Place all bodies at the centres of their boxes, without motion."""
    for body in table["bodies"]:
        motion = body["motion"]
        middle = (np.array(motion["box_min_m"]) + np.array(motion["box_max_m"])) / 2
        body["motion"] = {"model": "static", "position_m": middle.tolist()}


def in_a_row(table: Table) -> None:
    """Let each tag range only with the next one, so that constants of pairs do not determine delays of tags."""
    table["ranging"]["pairs"] = [[1, 3], [3, 5], [2, 4], [4, 6]]


CASES: Final[dict[str, Callable[[Table], None]]] = {
    "10 s": lasting(10.0),
    "30 s": lasting(30.0),
    "60 s": lasting(60.0),
    "120 s": lasting(120.0),
    "240 s, as it is": lasting(240.0),
    "60 s, each drone in a cube of 1 m": in_boxes_of(1.0),
    "60 s, each drone in a cube of 0.3 m": in_boxes_of(0.3),
    "60 s, hovering": hovering,
    "60 s, four pairs in two rows (1-3-5, 2-4-6)": in_a_row,
}


def judged(case: str, seed: int) -> list[float] | str:
    """Return the results of a case with a seed, or the error of its fit."""
    table = copy.deepcopy(tomllib.loads((FLIGHTS / "train.toml").read_text(encoding="utf-8")))
    table["run"] |= {"duration_s": LENGTH_S, "seed": seed}
    CASES[case](table)
    try:
        fitted = calib.fit(uwbsim.simulate(uwbsim.load(table)))
    except calib.UnanswerableError as error:
        return str(error)
    found = calib.evaluate(uwbsim.simulate(uwbsim.load(FLIGHTS / "test1.toml")), fitted.calibration)
    if found.planted is None:
        raise ValueError("the test flight does not say what it planted")
    half = 1.96 * np.median(list(fitted.calibration.delays_std_ns.values()))
    delays = np.sqrt(np.mean(np.square(list(found.planted.delay_error_ns.values()))))
    exchanges = table["run"]["duration_s"] * table["ranging"]["rate_hz"]
    return [exchanges, 1000 * delays, 1000 * half, 1000 * found.planted.correction_rms_m]


def row(case: str, seeds: int) -> str:
    """Return the row of a case: medians over seeds."""
    outcomes = [judged(case, seed) for seed in range(1, seeds + 1)]
    figures = [outcome for outcome in outcomes if not isinstance(outcome, str)]
    if not figures:
        return f"| {case} | | refused | | |\n"
    count, delays, half, correction = np.median(np.array(figures), axis=0)
    return f"| {case} | {count:.0f} | {delays:.0f} | {half:.0f} | {correction:.1f} |\n"


def main(seeds: int) -> None:
    """Measure every case and write the table into the page."""
    table = HEAD
    for case in CASES:
        table += row(case, seeds)
        print(table.splitlines()[-1], flush=True)
    write_section(PAGE, "campaigns", table)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--seeds", type=int, default=5)
    main(arguments.parse_args().seeds)
