"""Intervals from few ranges over seeds: errors of delays against their standard errors; a table of docs/accuracy.md.

`python -m benchmarks.few_ranges` prints it. The worlds are those of `benchmarks.worlds`, with ten ranges per second.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

import calib
from benchmarks.worlds import FIRST_REPORTED, Recipe, make
from tests.calib.synthetic import about_their_mean

SEEDS: Final = 100
PER_SECOND: Final = 10.0
LASTING: Final[Mapping[str, Any]] = {"lasts_s": 1.0, "share": (0.0, 0.4)}


def main() -> None:
    """Print a row per world; delays are compared relative to their mean."""
    print("| ranges | tags | reflections | rms (promised), ps | inside 95 % |\n" + "|---" * 5 + "|")
    for count, tags in ((110, 3), (150, 4), (300, 4), (300, 6)):
        for name, more in (("independent", {}), ("lasting", LASTING)):
            recipe = Recipe(tags=tags, seconds=count / PER_SECOND, per_second=PER_SECOND, **more)
            errors, stds = np.array([_one(recipe, FIRST_REPORTED + seed) for seed in range(SEEDS)]).swapaxes(0, 1)
            rms = [1e3 * np.sqrt(np.mean(some**2)) for some in (errors, stds)]
            inside = 100 * np.mean(np.abs(errors) < 1.96 * stds)
            print(f"| {count} | {tags} | {name} | {rms[0]:.0f} ({rms[1]:.0f}) | {inside:.0f} % |")


def _one(recipe: Recipe, seed: int) -> Any:
    """Return errors of delays relative to their mean, and their stated standard errors, in ns."""
    world = make(recipe, seed)
    return about_their_mean(calib.fit(world.ranges, between_m=0.0).calibration, world.delays_ns)


if __name__ == "__main__":
    main()
