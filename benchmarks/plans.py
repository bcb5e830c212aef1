"""Plans of flights compared with fits over seeds: predicted and actual errors; a table of docs/accuracy.md.

The worlds are those of `benchmarks.trajectories`, which share no code with plans and fits. One plan is made from a
recording of the flight (the first seed; its recorded positions and attitudes, not its ranges), another for robots that
fly in a room of the same size, of which only some numbers are known.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import calib
from benchmarks.studies import options, write_section
from benchmarks.trajectories import ERRING, WORLDS, World
from tests.calib.trajectories.sines import flight
from uwblink import KnownDistance

ROOT: Final = Path(__file__).parents[1]
PAGE: Final = ROOT / "docs" / "accuracy.md"
TWO_SIDED: Final = 1.959963984540054
ROOM: Final[dict[str, Any]] = {"size_m": (7.0, 7.0, 3.0), "apart_m": 0.68, "speed_m_s": 0.7}
FOUR: Final = (11, 12, 13, 14)
TAPED: Final = "sines, 16 s of which they stand for 4, one distance by tape"
STANDING: Final = {"seconds": 16.0, "still_s": 4.0, "rate_hz": 80.0}


def _taped(seed: int) -> Any:
    """Fly after standing still for four seconds; the distance of tags 1 and 3 is measured with an error of 1 cm."""
    flown = flight(seed=seed, seconds=16.0, standing_s=4.0, **ERRING)
    apart = np.linalg.norm(np.diff(flown.antennas(np.array([1, 3]), np.array([1.0, 1.0])), axis=0))
    off = 0.01 * np.random.default_rng(seed).normal()
    flown.known_distances = [KnownDistance(1, 3, float(apart) + off, 0.01, "0..4")]
    return flown


FLIGHTS: Final = WORLDS | {TAPED: World(_taped, {"poses_until_s": 0.0})}
OF_ROBOTS: Final[dict[str, dict[str, Any]]] = {
    "sines, known for 8 of 24 s": ROOM | {"seconds": 24.0, "rate_hz": 80.0},
    "sines, four anchors given, no known start": ROOM | {"seconds": 24.0, "rate_hz": 120.0, "anchors": FOUR},
    "sines, four anchors sought, known for 8 s": ROOM | {"seconds": 24.0, "rate_hz": 120.0, "anchors": FOUR},
    "sines, nothing known": ROOM | {"seconds": 24.0, "rate_hz": 80.0},
    TAPED: ROOM | STANDING | {"taped": 1},
    "icra2023 test 1, 60 s, known for 10 s": {"seconds": 60.0, "rate_hz": 160.0, "imu": "consumer"},
}
FEWER: Final = {"icra2023 test 1, 60 s, known for 10 s": 3, "sines, nothing known": 6}
"""Divisors of the number of seeds for worlds whose fits take longer."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Fitted:
    """One fit: errors (tags,) of its delays in ps, and a mask of those that it determines."""

    tags: tuple[int, ...]
    error_ps: Floats
    claimed: tuple[bool, ...]


def fitted(name: str, seed: int) -> Fitted:
    """Fly, fit, and compare with the planted values."""
    world = FLIGHTS[name]
    flown = world.make(seed)
    found = calib.fit_from_ranges(flown, minimum_norm=True, **world.given).calibration
    tags = tuple(found.delays_ns)
    error = [1e3 * (found.delays_ns[tag] - flown.planted["delays_ns"][str(tag)]) for tag in tags]
    return Fitted(tags, np.array(error), tuple(bool(np.isfinite(found.delays_std_ns[tag])) for tag in tags))


def promised(name: str) -> tuple[calib.FlightPlan, calib.FlightPlan]:
    """Return the plan for the flight itself, and the plan for robots in a room."""
    world = FLIGHTS[name]
    given = dict(world.given)
    given["anchor_places"] = given.pop("anchors", "given")
    return calib.plan_flight(world.make(0), **given), calib.plan_flight(3, **given, **OF_ROBOTS[name])


def row(name: str, fits: list[Fitted], plans: tuple[calib.FlightPlan, calib.FlightPlan]) -> str:
    """Return the row of a world."""
    plan, like = plans
    tags = fits[0].tags
    claimed = np.mean([one.claimed for one in fits], axis=0) > 0.5
    says = [tag for tag in plan.half_ns if tag not in plan.undetermined]
    error = np.array([one.error_ps for one in fits])
    known = np.array([tag in says or not says for tag in tags])
    cells = [name, str(len(fits)), f"{len(says)}, {int(claimed.sum())} of {len(tags)}"]
    common = error[:, known].mean(axis=1)
    apart = error[:, known] - common[:, None]
    alike = FLIGHTS[name].planted_alike
    cells += [
        f"{1e3 * plan.apart_ns / TWO_SIDED:.0f}, {1e3 * like.apart_ns / TWO_SIDED:.0f}",
        f"{np.sqrt(np.mean(apart**2)):.0f}",
        f"{1e3 * plan.common_ns / TWO_SIDED:.0f}, {1e3 * like.common_ns / TWO_SIDED:.0f}",
        f"{np.sqrt(np.mean(common**2)):.0f}" if alike else "",
    ]
    # Undetermined delays have no predicted error, and arbitrary ones in fits.
    cells[3:] = [cell if says else "" for cell in cells[3:]]
    return f"| {' | '.join(cells)} |"


TITLES: Final = (
    "flight",
    "seeds",
    "determined: planned, fitted",
    "apart, ps: promised (by this flight, by robots in a room)",
    "actual, rms",
    "common, ps: promised",
    "actual, rms",
)
HEAD: Final = f"| {' | '.join(TITLES)} |\n{'|---' * len(TITLES)}|"


def main() -> None:
    """Print the table, and write it into the page."""
    parser = options(__doc__, seeds=24)
    parser.add_argument("--only", default="", help="flights whose name has this in it")
    given = parser.parse_args()
    lines = [HEAD]
    with ProcessPoolExecutor(given.workers) as pool:
        for name in OF_ROBOTS:
            if given.only in name:
                seeds = given.seeds // FEWER.get(name, 1)
                lines.append(row(name, list(pool.map(fitted, [name] * seeds, range(seeds))), promised(name)))
                print(lines[-1], flush=True)
    if given.write:
        write_section(PAGE, "plans", "\n".join(lines))


if __name__ == "__main__":
    main()
