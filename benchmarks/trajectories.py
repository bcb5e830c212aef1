"""Errors of delays without known distances against planted values, over seeds: a table of docs/accuracy.md.

The worlds of `tests.calib.trajectories.sines` share no code with fit and simulator: bodies on sums of sines, ranges by
geometry, attitudes and known positions with errors. In the worlds of scenarios, each seed gives other motion and noise
of the simulator, with a consumer IMU; their delays are compared after the common shift, together with those of a fit
with motion capture of the same flight.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import calib
import uwbsim
from benchmarks.layouts import furnish
from benchmarks.studies import options, outcomes_of, write_section
from tests.calib.trajectories.sines import flight

ROOT: Final = Path(__file__).parents[1]
PAGE: Final = ROOT / "docs" / "accuracy.md"
CORNERS: Final = [[3.5, 3.5, 0.3], [-3.5, 3.5, 2.6], [-3.5, -3.5, 0.5], [3.5, -3.5, 2.5]]
ERRING: Final = {"wander_deg": 3.0, "tilt_deg": 1.0, "place_noise_m": 0.02}
IMU: Final = {"grade": "consumer", "vibration_mps2": 1.0}
Floats = NDArray[np.float64]


def _sines(seed: int, **more: Any) -> Any:
    return flight(seed=seed, **(ERRING | more))


def scenario(name: str, seed: int, seconds: float, *, alike: bool = False, furnished: bool = False) -> Any:
    """Simulate a scenario with another seed and duration, each body with an IMU.

    With `alike`, all tags have the same power, and read powers without an offset. A `furnished` room has another layout
    for each seed.
    """
    table = tomllib.loads((ROOT / "scenarios" / name).read_text(encoding="utf-8"))
    table["run"] |= {"seed": seed, "duration_s": seconds}
    for body in table["bodies"]:
        body["imu"] = IMU
    for tag in table["tags"] if alike else ():
        tag |= {"tx_power_db": 0.0, "power_offset_db": 0.0}
    if furnished:
        furnish(table, seed)
    return uwbsim.simulate(table)


@dataclass(frozen=True, slots=True)
class World:
    """A kind of flight, the settings of its fit, whether delays are planted in the gauge of the fit, and the number of
    seeds.
    """

    make: Callable[[int], Any]
    given: dict[str, Any]
    planted_alike: bool = True
    seeds: int = 50


WORLDS: Final = {
    "sines, known for 8 of 24 s": World(_sines, {"poses_until_s": 8.0}),
    "sines, four anchors given, no known start": World(
        lambda seed: _sines(seed, anchors=CORNERS, rate=120), {"poses_until_s": 0.0}
    ),
    "sines, four anchors sought, known for 8 s": World(
        lambda seed: _sines(seed, anchors=CORNERS, rate=120), {"poses_until_s": 8.0, "anchors": "sought"}
    ),
    "sines, nothing known": World(_sines, {"poses_until_s": 0.0}),
    "icra2023 test 1, 60 s, known for 10 s": World(
        lambda seed: scenario("icra2023/test1.toml", seed, 60.0), {"poses_until_s": 10.0}, False
    ),
    "icra2023 test 2, 60 s, known for 10 s, attitudes by IMU": World(
        lambda seed: scenario("icra2023/test2.toml", seed, 60.0),
        {"poses_until_s": 10.0, "attitudes": "imu"},
        False,
    ),
    "six robots, 40 s, known for 10 s": World(
        lambda seed: scenario("six_robots/six_robots.toml", seed, 40.0), {"poses_until_s": 10.0}, False, seeds=24
    ),
    "lasting reflections, 40 s, known for 10 s": World(
        lambda seed: scenario("lasting_reflections/hall.toml", seed, 40.0), {"poses_until_s": 10.0}, False, seeds=12
    ),
    "room, 40 s, known for 10 s": World(
        lambda seed: scenario("room/room.toml", seed, 40.0), {"poses_until_s": 10.0}, False, seeds=12
    ),
    "rooms of other layouts, 40 s, known for 10 s": World(
        lambda seed: scenario("room/room.toml", seed, 40.0, furnished=True), {"poses_until_s": 10.0}, False, seeds=24
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One fit: errors and standard errors of determined delays (k,) in ps, those of distances in cm, and its end."""

    claimed: int
    apart_ps: float
    promised_ps: float
    scores: Floats
    distance_cm: float
    mean_cm: float
    to_mocap_ps: float
    localized: float


def one(name: str, seed: int) -> Outcome:
    """Fly, fit without distances, and compare with the planted values."""
    world = WORLDS[name]
    flown = world.make(seed)
    result = calib.fit_from_ranges(flown, minimum_norm=True, **world.given)
    found = result.calibration
    if found.uncertainty is None:
        sys.exit("a fit without uncertainty")
    tags = list(found.uncertainty.tags)
    known = np.array([np.isfinite(found.delays_std_ns[tag]) for tag in tags])
    error = 1e3 * np.array([found.delays_ns[tag] - flown.planted["delays_ns"][str(tag)] for tag in tags])[known]
    covariance = 1e6 * np.array(found.uncertainty.delays_ns2)[np.ix_(known, known)]
    centre = np.eye(len(error)) - 1 / max(len(error), 1)
    apart, spread = centre @ error, centre @ covariance @ centre
    scores = error / np.sqrt(np.diag(covariance)) if world.planted_alike else apart / np.sqrt(np.diag(spread))
    true_m = flown.distance_m if world.planted_alike else flown.truth_m
    away = 100 * (result.ranges.truth_m - true_m[np.searchsorted(flown.exchanges.time_ns, result.ranges.time_ns)])
    to_mocap, localized = np.nan, np.nan
    if not world.planted_alike:
        mocap = calib.fit(flown).calibration
        differ = 1e3 * np.array([found.delays_ns[tag] - mocap.delays_ns[tag] for tag in tags])
        to_mocap = float(np.std(differ))
        localized = localized_m(flown, found) / localized_m(flown, mocap)
    return Outcome(
        claimed=int(known.sum()),
        apart_ps=float(np.sqrt(np.mean(apart**2))) if len(apart) else np.nan,
        promised_ps=float(np.sqrt(np.mean(np.diag(spread)))) if len(apart) else np.nan,
        scores=scores,
        distance_cm=float(np.std(away)),
        mean_cm=float(np.mean(away)),
        to_mocap_ps=to_mocap,
        localized=localized,
    )


def localized_m(flown: Any, calibration: calib.Calibration) -> float:
    """Return the position error of the robust filter with a calibration, in metres.

    Single reflected ranges can mislead the plain filter, with one calibration by chance more often than with another.
    """
    judged = calib.localize(flown, calibration)
    return float(np.mean([summary.rmse_m["robust"].mean() for summary in judged]))


def row(name: str, outcomes: list[Outcome]) -> str:
    """Return the row of a world."""

    def rms(values: list[float]) -> float:
        return float(np.sqrt(np.nanmean(np.square(values)))) if np.isfinite(values).any() else float("nan")

    some = [one for one in outcomes if one.claimed]
    if not some:
        return f"| {name} | {len(outcomes)} | none | | | | | |"
    inside = float(np.mean(np.abs(np.concatenate([one.scores for one in some])) < 1.96))
    claimed = sorted({one.claimed for one in outcomes})
    cells = [
        name,
        str(len(outcomes)),
        f"{claimed[0]} to {claimed[-1]}" if len(claimed) > 1 else str(claimed[0]),
        f"{rms([one.apart_ps for one in some]):.0f} ({rms([one.promised_ps for one in some]):.0f})",
        f"{100 * inside:.1f} %",
        f"{rms([one.distance_cm for one in some]):.1f}",
        f"{rms([one.mean_cm for one in some]):.2f}",
        _beside(some),
    ]
    return f"| {' | '.join(cells)} |"


def _beside(some: list[Outcome]) -> str:
    values = [one.to_mocap_ps for one in some if np.isfinite(one.to_mocap_ps)]
    if not values:
        return ""
    ratios = [one.localized for one in some]
    return f"{float(np.sqrt(np.mean(np.square(values)))):.0f} ps, {np.median(ratios):.2f} ({max(ratios):.2f})"


TITLES: Final = (
    "flight",
    "seeds",
    "delays determined",
    "apart: rms (promised), ps",
    "inside 95 %",
    "distances: rms, cm",
    "their mean, cm",
    "beside motion capture: delays, localization (worst flight)",
)
HEAD: Final = f"| {' | '.join(TITLES)} |\n{'|---' * len(TITLES)}|"


def main() -> None:
    """Print the table, and write it into the page."""
    parser = options(__doc__, seeds=50)
    parser.add_argument("--only", default="", help="worlds whose name has this in it")
    parser.add_argument("--results", type=Path, help="file of outcomes, a line each: what it has is not flown again")
    given = parser.parse_args()
    lines = [HEAD]
    with ProcessPoolExecutor(given.workers) as pool:
        for name, world in WORLDS.items():
            if given.only in name:
                seeds = range(min(given.seeds, world.seeds))
                lines.append(row(name, [*outcomes_of(name, seeds, one, Outcome, given.results, pool).values()]))
                print(lines[-1], flush=True)
    if given.write:
        write_section(PAGE, "trajectories", "\n".join(lines))


if __name__ == "__main__":
    main()
