"""Surveys of boards that stand still, over many seeds: errors of delays beside what was promised, and coverage.

`python -m benchmarks.surveys [SEEDS]` writes the table of docs/without-motion-capture.md (`make surveys`).
"""

from __future__ import annotations

import re
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

import calib
from benchmarks.standing import DIMENSIONS, Standing, power_dbm, standing_boards
from calib.planning.candidates import Layout, delay_information
from uwblink.arrays import Floats

PAGE = Path(__file__).parents[1] / "docs" / "without-motion-capture.md"
PLACE = re.compile(r"(<!-- surveys:begin[^>]*-->\n).*?(<!-- surveys:end -->)", re.DOTALL)
C_M_PER_NS = 0.299702547
PAIR_M = 0.02
LINE: dict[str, Any] = {"shape": "line", "boards": 5, "arrangements": 8}
PLANE: dict[str, Any] = {"shape": "plane", "boards": 6, "arrangements": 8}
SPACE: dict[str, Any] = {"shape": "space", "boards": 8, "arrangements": 8}
WORLDS: dict[str, dict[str, Any]] = {
    "line, 4 boards, 8 arrangements": LINE | {"boards": 4},
    "plane, 6 boards, 8 arrangements": PLANE,
    "space, 8 boards, 8 arrangements": SPACE,
    "line, 5 boards, no pair reflected": LINE,
    "line, 2 % of pairs reflected": LINE | {"reflected": 0.02},
    "line, 5 % of pairs reflected": LINE | {"reflected": 0.05},
    "line, 10 % of pairs reflected": LINE | {"reflected": 0.1},
    "line, 5 % reflected, by 5 to 20 cm": LINE | {"reflected": 0.05, "detour_m": (0.05, 0.2)},
    "plane, 5 % of pairs reflected": PLANE | {"reflected": 0.05},
    "space, 5 % of pairs reflected": SPACE | {"reflected": 0.05},
    "plane, bias over power": PLANE | {"bias_size_m": 0.05, "size_m": 8.0},
    "space, one arrangement": {"shape": "space", "boards": 5, "arrangements": 1},
}


@dataclass(frozen=True)
class Outcome:
    """One survey: errors of delays over their standard deviations, errors and promises in ns, or why there are none."""

    errors_ns: tuple[float, ...] = ()
    scores: tuple[float, ...] = ()
    promised_ns: tuple[float, ...] = ()
    left_out: int = 0
    refused: str = ""


def one(settings: dict[str, Any], seed: int) -> Outcome:
    """Survey one world."""
    world = standing_boards(seed, **settings)
    shape = settings["shape"]
    try:
        result = calib.survey(world.ranges, known="" if shape == "space" else shape)
    except calib.UnanswerableError as error:
        return Outcome(refused=str(error))
    found = result.calibration
    spread = promised(world, DIMENSIONS[shape], settings.get("bias_size_m", 0.0))
    errors = {tag: delay - world.delays_ns[tag] for tag, delay in found.delays_ns.items()}
    return Outcome(
        errors_ns=tuple(errors.values()),
        scores=tuple(error / found.delays_std_ns[tag] for tag, error in errors.items()),
        promised_ns=tuple(float(spread[tag - 1]) for tag in errors),
        left_out=len(world.delays_ns) - len(errors),
    )


def promised(world: Standing, dimensions: int, curve_m: float) -> Floats:
    """Return how well delays (tags,) can be known, ns, by Fisher's information of the very arrangements.

    Of the curve over power, where one is planted, its size is known and that it bends over 8 dB, and no more.
    """
    if not curve_m:
        total = sum(delay_information(Layout(place, dimensions), PAIR_M, 0.005) for place in world.places)
        return np.asarray(np.sqrt(np.diag(np.linalg.pinv(total))) / C_M_PER_NS)
    boards = len(world.places[0])
    pairs = np.array(list(combinations(range(boards), 2)))
    lines, powers = [], []
    for k, place in enumerate(world.places):
        apart = place[pairs[:, 0]] - place[pairs[:, 1]]
        length = np.linalg.norm(apart, axis=1)
        unit = apart[:, :dimensions] / length[:, None]
        rows = np.zeros((len(pairs), boards + len(world.places) * boards * dimensions))
        for n, (i, j) in enumerate(pairs.tolist()):
            rows[n, [i, j]] = -0.5
            for end, sign in ((i, 1.0), (j, -1.0)):
                first = boards + (k * boards + end) * dimensions
                rows[n, first : first + dimensions] = sign * unit[n]
        lines.append(rows)
        powers += [power_dbm(value) for value in length.tolist()]
    power = np.array([*powers, -82.0])
    likeness = np.exp(-0.5 * ((power[:, None] - power) / 8.0) ** 2)
    curve = curve_m**2 * (likeness[:-1, :-1] - np.outer(likeness[:-1, -1], likeness[-1, :-1]))
    weight = np.linalg.inv((PAIR_M**2 + 0.005**2) * np.eye(len(powers)) + curve)
    every = np.vstack(lines)
    delays, places = every[:, :boards], every[:, boards:]
    mixed = places.T @ weight @ delays
    free = np.linalg.pinv(places.T @ weight @ places, rcond=1e-9, hermitian=True)
    information = delays.T @ weight @ delays - mixed.T @ free @ mixed
    return np.asarray(np.sqrt(np.diag(np.linalg.pinv(information))) / C_M_PER_NS)


def row(name: str, outcomes: list[Outcome]) -> str:
    """Return a row of the table."""
    errors = np.concatenate([o.errors_ns for o in outcomes])
    scores = np.concatenate([o.scores for o in outcomes])
    promised = np.concatenate([o.promised_ns for o in outcomes])
    refused = sum(bool(o.refused) for o in outcomes)
    if not len(errors):
        return f"| {name} | {len(outcomes)} | - | - | - | - | {refused} |"
    rms, promise = (float(np.sqrt(np.mean(v**2))) for v in (errors, promised))
    covered = 100 * float(np.mean(np.abs(scores) < 1.96))
    left = sum(o.left_out for o in outcomes if not o.refused)
    cells = [
        f"{1e3 * rms:.0f} ps",
        f"{1e3 * promise:.0f} ps",
        f"{covered:.1f} %",
        str(left),
        str(refused),
    ]
    return f"| {name} | {len(outcomes)} | {' | '.join(cells)} |"


def table(seeds: int) -> str:
    """Return the table, worlds of seeds from 1000 on."""
    lines = [
        "| world | seeds | delays, rms | promised | in 95 % | delays left out | refused |",
        "|---|---|---|---|---|---|---|",
    ]
    with ProcessPoolExecutor(2) as workers:
        for name, settings in WORLDS.items():
            lines.append(row(name, list(workers.map(partial(one, settings), range(1000, 1000 + seeds)))))
            print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def main() -> int:
    """Write the table into the page."""
    text = table(int(sys.argv[1]) if len(sys.argv) > 1 else 50)
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(PLACE.sub(lambda found: found[1] + text + found[2], page), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
