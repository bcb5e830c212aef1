"""Golden results: fits of about thirty flights, worlds and surveys, to compare with those of a changed estimator.

`python -m benchmarks.golden --write` fits all cases and writes `tests/golden/fits.json`; without `--write` they are
fitted again and compared with that file (`make golden`). The file has, for each case, delays and their standard errors
in ns, the bias curve in metres at `POWERS_DBM`, and warnings, or the error. The comparison prints, for each case, the
largest change of a delay in old standard errors, the smallest and largest ratio of standard errors, the root mean
square change of the curve, and changes of the warnings.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

import calib
import uwbsim
from benchmarks import worlds
from benchmarks.standing import standing_boards
from benchmarks.surveys import LINE, PLANE, SPACE
from benchmarks.trajectories import CORNERS, scenario
from calib.calibration.power_curves import lift
from tests.calib.trajectories.sines import flight

FILE: Final = Path(__file__).parents[1] / "tests" / "golden" / "fits.json"
POWERS_DBM: Final = np.arange(-98.0, -79.0, 2.0)
SCENARIOS: Final = (
    *("icra2023/train", "icra2023/test1", "icra2023/test2", "office/office", "nlos_office/office", "room/room"),
    *("hall_with_metal/hall", "lasting_reflections/hall", "six_robots/six_robots", "warm_up/warm_up", "day30/train"),
    *("anchors_and_tag/anchors_and_tag", "anchors_and_tag/bipartite", "noiseless"),
)
SETTINGS: Final[dict[str, dict[str, Any]]] = {
    "sequential": {"sequential": True},
    "delays only": {"delays_only": True},
    "constants of pairs": {"constants": "pair"},
    "Huber": {"loss": "huber"},
    "one delay pinned": {"fixed_ns": {1: -0.4}},
}
SURVEYS: Final[dict[str, dict[str, Any]]] = {
    "line": LINE,
    "plane": PLANE,
    "space": SPACE,
    "line, 5 % reflected": LINE | {"reflected": 0.05},
    "plane, bias over power": PLANE | {"bias_size_m": 0.05, "size_m": 8.0},
}
SEED: Final = 10_001
"""A seed that was not used to choose defaults (see `benchmarks.worlds.FIRST_REPORTED`)."""


def _simulated(name: str, **settings: Any) -> Any:
    return calib.fit(uwbsim.simulate(uwbsim.load(name, {"run.duration_s": 60.0})), **settings)


def _world(recipe: worlds.Recipe) -> Any:
    return calib.fit(worlds.make(recipe, SEED).ranges)


def _survey(settings: dict[str, Any]) -> Any:
    shape = "" if settings["shape"] == "space" else settings["shape"]
    return calib.survey(standing_boards(SEED, **settings).ranges, known=calib.Knowledge(shape=shape))


def _from_ranges(poses_until_s: float, fly: Callable[..., Any], *args: Any, **flown: Any) -> Any:
    return calib.fit_from_ranges(fly(*args, **flown), minimum_norm=True, poses_until_s=poses_until_s)


def cases() -> dict[str, Callable[[], Any]]:
    """Return functions that fit the cases, by name."""
    of_worlds = {name: recipe for name, recipe in worlds.CLEAN.items() if recipe.seconds <= 240}
    return {
        **{f"scenario {name}": partial(_simulated, name) for name in SCENARIOS},
        **{
            f"icra2023/train, {name}": partial(_simulated, "icra2023/train", **given)
            for name, given in SETTINGS.items()
        },
        **{f"world {name}": partial(_world, recipe) for name, recipe in of_worlds.items()},
        **{f"survey {name}": partial(_survey, settings) for name, settings in SURVEYS.items()},
        "from ranges, known for 8 of 24 s": partial(_from_ranges, 8.0, flight, seed=SEED),
        "from ranges, four anchors given": partial(_from_ranges, 0.0, flight, seed=SEED, anchors=CORNERS, rate=120),
        "from ranges, icra2023/test1, known for 10 s": partial(
            _from_ranges, 10.0, scenario, "icra2023/test1.toml", SEED, 40.0
        ),
    }


def outcome(name: str) -> dict[str, Any]:
    """Fit a case and return its stored values."""
    try:
        found = cases()[name]()
    except calib.CalibError as error:
        return {"error": f"{type(error).__name__}: {error}"}
    calibration = found.calibration
    curve = calibration.bias_curve(lift(POWERS_DBM, calibration.alpha_dbm))
    return {
        "delays_ns": {str(tag): delay for tag, delay in sorted(calibration.delays_ns.items())},
        "std_ns": {
            str(tag): std if np.isfinite(std) else None for tag, std in sorted(calibration.delays_std_ns.items())
        },
        "bias_m": np.round(curve, 6).tolist(),
        "warnings": list(found.warnings),
    }


def compared(old: dict[str, Any], new: dict[str, Any]) -> str:
    """Return a line on the changes between two outcomes of a case."""
    if "error" in old or "error" in new:
        return (
            "refused as before" if old.get("error") == new.get("error") else f"{old.get('error')} -> {new.get('error')}"
        )
    if old["delays_ns"].keys() != new["delays_ns"].keys():
        return f"tags {', '.join(old['delays_ns'])} -> {', '.join(new['delays_ns'])}"
    known = [tag for tag, std in old["std_ns"].items() if std and new["std_ns"][tag]]
    moved = [abs(new["delays_ns"][tag] - old["delays_ns"][tag]) / old["std_ns"][tag] for tag in known]
    ratio = [new["std_ns"][tag] / old["std_ns"][tag] for tag in known]
    curve = 1e3 * np.sqrt(np.mean((np.array(new["bias_m"]) - np.array(old["bias_m"])) ** 2))
    told = len(new["warnings"]) - len(old["warnings"])
    return (
        f"delays move by {max(moved, default=0):.2f} standard errors at most, which are {min(ratio, default=1):.2f} to "
        f"{max(ratio, default=1):.2f} times the old ones; curve {curve:.2f} mm; {told:+d} warnings"
    )


def main() -> None:
    """Write the file, or compare with it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write the file instead of comparing with it")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    names = list(cases())
    with ProcessPoolExecutor(given.workers) as pool:
        found = dict(zip(names, pool.map(outcome, names), strict=True))
    if given.write:
        FILE.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        return
    stored = json.loads(FILE.read_text(encoding="utf-8"))
    for name, new in found.items():
        print(f"{name}: {compared(stored[name], new) if name in stored else 'not stored'}")


if __name__ == "__main__":
    main()
