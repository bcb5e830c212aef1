"""Dependences of delays: planted patterns over direction, slopes over temperature and drifts, and the results of fits.

The worlds share no code with the packages: `benchmarks.directions`, and those of the tests of sessions and filters.
`make dependences` writes the table in docs/accuracy.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track

import calib
from benchmarks.directions import PLANTED, SOUND, Recipe, flight, pattern_m
from benchmarks.studies import write_section
from calib.evaluation import Settings
from calib.evaluation.localization import consistency
from tests.calib.evaluation import drifting_flight
from tests.calib.fitting.test_sessions import drifting
from uwblink.arrays import Floats

PAGE = Path(__file__).parents[1] / "docs" / "accuracy.md"
FIRST_SEED = 700
"""Seeds that were not used to choose anything (seeds 41 to 316 were)."""

TWO_SIDED_95 = 1.96
KINDS: dict[str, list[Recipe]] = {
    f"no pattern, {len(SOUND)} kinds of flights": [*SOUND.values()],
    "shared pattern of 5, 10, 20 cm": [one for name, one in PLANTED.items() if "shared" in name],
    "each antenna's own": [one for name, one in PLANTED.items() if "own" in name],
    "no slope, 15 K": [Recipe(pattern_m=0.0, warmer_k=15.0)],
    "2.15, 20 mm/K": [Recipe(pattern_m=0.0, warmer_k=15.0, mm_per_k=slope) for slope in (2.15, 20.0)],
    "5 mm/K, tags differ by 4": [Recipe(pattern_m=0.0, warmer_k=15.0, mm_per_k=5.0, apart_mm_per_k=4.0)],
    "2.15 mm/K, pattern of 10 cm": [Recipe(pattern_m=0.1, warmer_k=15.0, mm_per_k=2.15)],
}
RATES_M2 = (0.0, 1e-5, 1e-4)
DRIFTS_M: tuple[dict[int, float], ...] = (
    {},
    dict.fromkeys(drifting_flight.DELAYS_NS, 0.0215) | {1: 0.2},
    {1: 0.2, 2: 0.2},
)
"""Drifts in flights of filters: none; one tag by 2 cm/K over 10 K and others by 2.15 mm/K; both tags of the robot."""
OFFSETS_M = (0.0, 0.02, 0.05)
"""Standard deviations of the constants of pairs in flights of filters, in metres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Result in one world: whether a dependence was found, the relative change of the errors of another flight by the
    fitted dependence, and the shares of planted values within 95 % intervals.
    """

    found: bool
    change: float = np.nan
    inside: tuple[float, ...] = ()


def flown(recipe: Recipe, seed: int) -> Outcome:
    """Return the result of a fit with a pattern or slope. If tags warm up, the other flight is 15 K warmer."""
    warm = recipe.warmer_k > 0
    warmer = replace(recipe, start_c=recipe.start_c + recipe.warmer_k)
    (first, planted), (second, _) = flight(recipe, seed), flight(warmer, seed, 1)
    pattern = "auto" if recipe.pattern_m or not warm else "none"
    fits = ((pattern if warm else "none", "none"), (pattern, "auto" if warm else "none"))
    without, known = (
        calib.fit(first, between_m=0.0, pattern=one, temperature=other).calibration for one, other in fits
    )
    inside = _slopes_inside(known, planted["mm_per_k"]) if warm else []
    if recipe.pattern_m:
        inside += _patterns_inside(known, calib.load_ranges(first), planted["waves"], recipe.pattern_m)
    change = _error_m(second, known) / _error_m(second, without) - 1
    return Outcome(found=bool(known.temperatures if warm else known.patterns), change=change, inside=tuple(inside))


def _error_m(flown: Any, known: calib.Calibration) -> float:
    """Return the size of errors of corrected ranges, without reflections."""
    found = calib.evaluate(flown, known).overall.full
    return float(np.hypot(found.median_m, found.robust_std_m))


def _patterns_inside(known: calib.Calibration, ranges: calib.Ranges, waves: Floats, size_m: float) -> list[float]:
    """Return, for each fitted pattern, the share of fitted directions whose 95 % interval contains the planted value.

    Both patterns are compared relative to their means over these directions, because delays contain the mean.
    """
    ends, shares = np.column_stack([ranges.initiator, ranges.target]), []
    for one in known.patterns:
        toward = np.asarray(ranges.toward, dtype=np.float64)[np.isin(ends, one.tags)]
        planted, values = pattern_m(toward, waves[one.tags[0]], size_m), one.values(toward)
        values = values - values.mean(axis=0)
        off = values @ np.array(one.coefficients_m) - (planted - planted.mean())
        shares.append(float(np.mean(np.abs(off) <= TWO_SIDED_95 * one.std_m(values))))
    return shares


def _slopes_inside(known: calib.Calibration, mm_per_k: Floats) -> list[float]:
    """Return 1 for each fitted slope whose 95 % interval contains the planted slope, else 0."""
    off = [(one.m_per_k - 1e-3 * mm_per_k[one.tags[0]]) / one.std_m_per_k for one in known.temperatures]
    return [float(abs(one) <= TWO_SIDED_95) for one in off]


def sessions(rate_m2: float, seed: int) -> Outcome:
    """Return the result of a fit of sessions on several days, with random walks of delays of a variance per day."""
    days = np.cumsum([0, *np.random.default_rng([seed, 5]).uniform(2, 15, 2 + seed % 4)])
    one = calib.fit(drifting(seed, days, rate_m2)).calibration.provenance["drift"]
    low, _, high = one["m2_per_day"]
    return Outcome(found=one["told"], inside=(float(low <= rate_m2 <= high),))


def filtered(name: str, kind: str, cases: Sequence[dict[str, Any]], seeds: Sequence[int]) -> list[str]:
    """Return a row on filters of a `kind` in flights of some cases.

    It has the NEES with its bounds, and the RMSE, also of a filter with fixed delays and without constants of pairs.
    """
    fixed, known = (
        calib.fit(drifting_flight.flight(100, 60.0)[0], between_m=value).calibration for value in (0.0, None)
    )
    cells = []
    for case in cases:
        flights = [drifting_flight.flight(seed, **case)[0] for seed in seeds]
        # Filters with delays as states are evaluated alone.
        by, online = fixed if kind == "online" else known, Settings(seeds=1, online=kind == "online")
        found = [calib.localize(one, by, online)[0].tracks[kind] for one in flights]
        beside = [calib.localize(one, fixed, Settings(seeds=1))[0].tracks["robust"] for one in flights]
        change = np.mean([one.rmse_m / other.rmse_m - 1 for one, other in zip(found, beside, strict=True)])
        nees, (low, high), _ = consistency(found)
        cells.append((f"{nees:.1f}", f"{100 * change:+.1f}"))
    texts = [", ".join(some) for some in zip(*cells, strict=True)]
    # All flights have one duration, so bounds of the last case apply to all.
    return [name, f"NEES {texts[0]} ({low:.1f} to {high:.1f})", f"{texts[1]} %", ""]


def row(name: str, cases: Sequence[Sequence[Outcome]]) -> list[str]:
    """Return a row on several cases, each with its results in several worlds."""
    found = [sum(one.found for one in worlds) for worlds in cases]
    changes = [100 * np.mean([one.change for one in worlds]) for worlds in cases]
    inside = [100 * np.mean(every) for worlds in cases if (every := [part for one in worlds for part in one.inside])]
    return [
        name,
        f"{', '.join(map(str, found))} of {len(cases[0])}",
        f"{', '.join(f'{one:+.0f}' for one in changes)} %" if inside and np.isfinite(changes).all() else "",
        f"{', '.join(f'{one:.0f}' for one in inside)} %" if inside else "",
    ]


def main() -> None:
    """Print the table, and write it into docs/accuracy.md with `--write`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="worlds of each kind")
    parser.add_argument("--write", action="store_true", help="write docs/accuracy.md")
    args = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + args.seeds)
    lines = ["| planted | found | another flight | inside 95 % |", "|---|---|---|---|"]
    for name, recipes in track(KINDS.items(), description="worlds"):
        planted = bool(recipes[0].pattern_m or recipes[0].mm_per_k)
        # Flights without a dependence, of all kinds, are one case.
        cases = [[one] for one in recipes] if planted else [recipes]
        lines.append(_line(row(name, [[flown(*world) for world in product(case, seeds)] for case in cases])))
    walks = [[sessions(rate_m2, seed) for seed in seeds] for rate_m2 in RATES_M2]
    lines.append(_line(row("from day to day: none, 3, 10 mm/√day", walks)))
    drifts, offsets = [{"drift_m": one} for one in DRIFTS_M], [{"offset_m": one} for one in OFFSETS_M]
    lines.append(_line(filtered("in a filter: no drift, one tag, two tags", "online", drifts, seeds[:8])))
    lines.append(_line(filtered("constants of pairs of 0, 2, 5 cm", "robust", offsets, seeds[:8])))
    if args.write:
        write_section(PAGE, "dependences", "\n".join(lines))


def _line(cells: list[str]) -> str:
    line = f"| {' | '.join(cells)} |"
    print(line, flush=True)
    return line


if __name__ == "__main__":
    main()
