"""Surveys of boards that stand still, over many seeds: errors of delays, their standard errors, and coverage.

`python -m benchmarks.surveys --write` writes the table of docs/accuracy.md (`make surveys`). With `--results FILE`,
results are stored, one per line, and stored ones are not computed again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

import calib
from benchmarks.standing import DIMENSIONS, Standing, power_dbm, standing_boards
from benchmarks.studies import options, outcomes_of, write_section
from calib.planning import SurveyPlanSettings
from calib.planning.result import PlannedArrangement
from calib.planning.surveys import predict
from uwblink.arrays import Floats

PAGE = Path(__file__).parents[1] / "docs" / "accuracy.md"
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
    "plane, bias that is not monotone": PLANE | {"wave_size_m": 0.05, "board_power_db": 1.0},
    "line, bias that is not monotone": LINE | {"wave_size_m": 0.05, "board_power_db": 1.0},
    "space, one arrangement": {"shape": "space", "boards": 5, "arrangements": 1},
}


HEAD = """\
| world | delays, rms (ps) | promised | in 95 % | delays left out | refused |
|---|---|---|---|---|---|"""

LABELS: dict[str, dict[str, Any]] = {
    f"line, {share} % reflected, labels exchanged": LINE | {"reflected": share / 100, "order": "wrong"}
    for share in (0, 5, 10)
}
LABELS_HEAD = """\
| two labels exchanged in one arrangement | found, the two named | another two named as well |
|---|---|---|"""


@dataclass(frozen=True)
class Outcome:
    """One survey: errors of delays and their standard deviations in ns by tag, or its error."""

    tags: tuple[int, ...] = ()
    errors_ns: tuple[float, ...] = ()
    std_ns: tuple[float, ...] = ()
    refused: str = ""
    exchanged: str = ""


def one(name: str, seed: int) -> Outcome:
    """Survey one world; in the worlds of `LABELS`, the order given for an arrangement has two boards exchanged."""
    settings = dict((WORLDS | LABELS)[name])
    order = settings.pop("order", None)
    world = standing_boards(seed, **settings)
    shape = "" if settings["shape"] == "space" else settings["shape"]
    orders, two = orders_of(world, seed if order else None) if order is not None else ({}, "")
    try:
        found = calib.survey(world.ranges, known=calib.Knowledge(shape=shape, orders=orders)).calibration
    except calib.UnanswerableError as error:
        return Outcome(refused=str(error), exchanged=two)
    return Outcome(
        tags=tuple(found.delays_ns),
        errors_ns=tuple(delay - world.delays_ns[tag] for tag, delay in found.delays_ns.items()),
        std_ns=tuple(found.delays_std_ns[tag] for tag in found.delays_ns),
        exchanged=two,
    )


def orders_of(world: Standing, wrong: int | None) -> tuple[dict[str, tuple[int, ...]], str]:
    """Return the orders of boards by arrangement. With a seed, two boards are exchanged in one order, and a text names
    them.
    """
    orders = {str(k): (np.argsort(place[:, 0]) + 1).tolist() for k, place in enumerate(world.places, start=1)}
    text = ""
    if wrong is not None:
        rng = np.random.default_rng(wrong)
        name = str(rng.integers(1, len(orders) + 1))
        i, j = rng.choice(len(orders[name]), 2, replace=False).tolist()
        orders[name][i], orders[name][j] = orders[name][j], orders[name][i]
        text = f"{name}: {min(orders[name][i], orders[name][j])} and {max(orders[name][i], orders[name][j])}"
    return {name: tuple(order) for name, order in orders.items()}, text


def planned(places: Iterable[Floats]) -> list[PlannedArrangement]:
    """Return arrangements of tags 1, 2, ... at given positions (tags, 3) each."""
    return [
        PlannedArrangement("", {k + 1: (x, y, z) for k, (x, y, z) in enumerate(one.tolist())}, ()) for one in places
    ]


def promised(world: Standing, dimensions: int, curve_m: float, reflected: float) -> Floats:
    """Return the smallest possible standard errors of delays (tags,) in ns, by the Fisher information of the
    arrangements.

    This is the prediction of a plan with a share of reflected pairs, whichever they are. Of a planted curve over power,
    only its size is assumed to be known, and that it bends over 4 dB.
    """
    if not curve_m:
        shape = {1: "line", 2: "plane", 3: "space"}[dimensions]
        inputs = SurveyPlanSettings(tags=tuple(world.delays_ns), on=shape, pair_error_m=PAIR_M, reflected=reflected)
        return predict(inputs, planned(world.places))[-1].each
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
    apart = math.sqrt(5.0) * np.abs(power[:, None] - power) / 4.0
    likeness = (1 + apart + apart**2 / 3) * np.exp(-apart)
    curve = curve_m**2 * (likeness[:-1, :-1] - np.outer(likeness[:-1, -1], likeness[-1, :-1]))
    weight = np.linalg.inv((PAIR_M**2 + 0.005**2) * np.eye(len(powers)) + curve)
    every = np.vstack(lines)
    delays, places = every[:, :boards], every[:, boards:]
    mixed = places.T @ weight @ delays
    free = np.linalg.pinv(places.T @ weight @ places, rcond=1e-9, hermitian=True)
    information = delays.T @ weight @ delays - mixed.T @ free @ mixed
    return np.asarray(np.sqrt(np.diag(np.linalg.pinv(information))) / C_M_PER_NS)


def row(name: str, outcomes: dict[int, Outcome]) -> str:
    """Return a row of the table, given results by seed."""
    settings = dict(WORLDS[name])
    settings.pop("order", None)
    some = {seed: found for seed, found in outcomes.items() if not found.refused}
    refused = len(outcomes) - len(some)
    if not some:
        return f"| {name} | - | - | - | - | {refused} |"
    errors = np.concatenate([found.errors_ns for found in some.values()])
    scores = errors / np.concatenate([found.std_ns for found in some.values()])
    spreads = []
    for seed, found in some.items():
        world = standing_boards(seed, **settings)
        spread = promised(world, DIMENSIONS[settings["shape"]], _curve_size_m(settings), settings.get("reflected", 0.0))
        spreads.append(spread[np.array(found.tags) - 1])
    every = np.concatenate(spreads)
    rms, promise = (float(np.sqrt(np.mean(v**2))) for v in (errors, every[np.isfinite(every)]))
    left = sum(settings["boards"] - len(found.tags) for found in some.values())
    cells = [
        f"{1e3 * rms:.0f}",
        f"{1e3 * promise:.0f}",
        f"{100 * float(np.mean(np.abs(scores) < 1.96)):.1f} %",
        str(left),
        str(refused),
    ]
    return f"| {name} | {' | '.join(cells)} |"


def _curve_size_m(settings: dict[str, Any]) -> float:
    return float(settings.get("bias_size_m", 0.0) + settings.get("wave_size_m", 0.0))


def labels_row(name: str, outcomes: dict[int, Outcome]) -> str:
    """Return a row of the table of exchanged labels."""
    found = others = 0
    for one in outcomes.values():
        where, two = one.exchanged.split(": ")
        told = one.refused.split(" are exchanged")[0]
        good = told.startswith(f"{where}: boards ") and two in told
        found, others = found + good, others + (good and ", or " in told)
    return f"| {name.removesuffix(', labels exchanged')} | {found} | {others} |"


def main() -> None:
    """Print the tables, and write them into the page."""
    parser = options(__doc__, seeds=50)
    parser.add_argument("--only", default="", help="worlds whose name has this in it")
    parser.add_argument("--results", type=Path, help="file of outcomes, a line each: what it has is not surveyed again")
    given = parser.parse_args()
    seeds = range(1000, 1000 + given.seeds)
    with ProcessPoolExecutor(given.workers) as pool:
        for place, worlds, head, line in (("surveys", WORLDS, HEAD, row), ("labels", LABELS, LABELS_HEAD, labels_row)):
            lines = [head]
            for name in filter(lambda name: given.only in name, worlds):
                lines.append(line(name, outcomes_of(name, seeds, one, Outcome, given.results, pool)))
                print(lines[-1], flush=True)
            if given.write:
                write_section(PAGE, place, "\n".join(lines))


if __name__ == "__main__":
    main()
