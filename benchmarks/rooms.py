"""Errors of delays if errors of ranges depend on positions: the table of rooms in docs/accuracy.md.

The scenarios are some whose errors all follow from the geometry of a room, others without geometry, and fields of
errors of `tests.calib.fitting.fields`, which share no code with the simulator. Seeds start at `FIRST_REPORTED`; they
were not used for tuning. Errors of delays are relative to their mean, because the planted and the fitted curve are zero
at different powers.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import calib
from benchmarks.studies import options, write_section
from benchmarks.trajectories import localized_m, scenario
from tests.calib.fitting.fields import ranges_with_field
from tests.calib.synthetic import about_their_mean

PAGE: Final = Path(__file__).parents[1] / "docs" / "accuracy.md"
FIRST_REPORTED: Final = 10_000
NAMED: Final = "errors depend on places"
Floats = NDArray[np.float64]

SCENARIOS: Final = {
    "room (four bodies, seven tags)": ("room/room.toml", 40.0),
    "office (four bodies, five tags)": ("office/office.toml", 40.0),
    "hall with metal (three bodies, six tags)": ("hall_with_metal/hall.toml", 40.0),
    "lasting reflections, each pair's own": ("lasting_reflections/hall.toml", 40.0),
    "the same, tags send and read powers alike": ("lasting_reflections/hall.toml", 40.0),
    "icra2023 test 1": ("icra2023/test1.toml", 40.0),
}
FIELDS: Final[dict[str, dict[str, Any]]] = {
    "no such errors, three bodies": {"bodies": 3},
    "no such errors, four bodies": {"bodies": 4},
    "no such errors, five bodies": {"bodies": 5},
    "a field of 2 cm over 2 m, three bodies": {"bodies": 3, "field_m": 0.02},
    "a field of 2 cm over 2 m, four bodies": {"bodies": 4, "field_m": 0.02},
    "a field of 2 cm over 4 m, four bodies": {"bodies": 4, "field_m": 0.02, "wave_m": 4.0},
    "walls of 3 cm, field of 1 cm, three bodies": {"bodies": 3, "field_m": 0.01, "between_m": 0.03},
    "walls of 3 cm, field of 1 cm, four bodies": {"bodies": 4, "field_m": 0.01, "between_m": 0.03},
    "walls of 3 cm, field of 1 cm, five bodies": {"bodies": 5, "field_m": 0.01, "between_m": 0.03},
    "walls of 3 cm alone, five bodies": {"bodies": 5, "between_m": 0.03},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """Errors of delays relative to their mean and their standard errors (tags,) in ps, whether a finding names places,
    and the increase of the localization error compared with a calibration by motion capture.
    """

    errors_ps: Floats
    std_ps: Floats
    named: bool
    localized: float = float("nan")


def outcome_of(result: calib.FitResult, planted_ns: dict[int, float], ratio: float = float("nan")) -> Outcome:
    """Compare a fit with the planted values."""
    errors, std = about_their_mean(result.calibration, planted_ns)
    return Outcome(
        errors_ps=1e3 * errors,
        std_ps=1e3 * std,
        named=any(NAMED in warning for warning in result.warnings),
        localized=ratio,
    )


def with_capture(name: str, seed: int) -> Outcome:
    """Fit a scenario with motion capture."""
    flown = _flown(name, seed)
    return outcome_of(calib.fit(flown), _planted(flown))


def from_ranges(name: str, seed: int) -> Outcome:
    """Fit a scenario in which positions are known for the first ten seconds."""
    flown = _flown(name, seed)
    found = calib.fit_from_ranges(flown, minimum_norm=True, poses_until_s=10.0)
    ratio = localized_m(flown, found.calibration) / localized_m(flown, calib.fit(flown).calibration)
    return outcome_of(found, _planted(flown), ratio)


def in_fields(name: str, seed: int) -> Outcome:
    """Fit ranges with a field of errors."""
    ranges, planted = ranges_with_field(seed, **FIELDS[name])
    return outcome_of(calib.fit(ranges), dict(enumerate(planted.tolist(), 1)))


def _flown(name: str, seed: int) -> Any:
    path, seconds = SCENARIOS[name]
    return scenario(path, seed, seconds, alike="alike" in name)


def _planted(flown: Any) -> dict[int, float]:
    return {int(tag): delay for tag, delay in flown.planted["delays_ns"].items()}


KINDS: Final[dict[str, tuple[Callable[[str, int], Outcome], list[str], str]]] = {
    "fields": (in_fields, list(FIELDS), ""),
    "capture": (with_capture, list(SCENARIOS), ""),
    "ranges": (from_ranges, list(SCENARIOS)[:5], ", from ranges"),
}

HEAD: Final = (
    "| world | seeds | delays, rms (promised), ps, median | inside 95 % | z-scores, rms | named | localization |\n"
    "|---|---|---|---|---|---|---|"
)


def row(name: str, outcomes: list[Outcome]) -> str:
    """Return the row of a world."""
    errors, std = (np.concatenate([getattr(one, what) for one in outcomes]) for what in ("errors_ps", "std_ps"))
    # Medians, because a single flight with few ranges between robots would dominate a mean.
    each, promised = (
        np.median([np.sqrt(np.mean(getattr(one, what) ** 2)) for one in outcomes]) for what in ("errors_ps", "std_ps")
    )
    ratios = [one.localized for one in outcomes if np.isfinite(one.localized)]
    cells = [
        name,
        str(len(outcomes)),
        f"{each:.0f} ({promised:.0f})",
        f"{100 * np.mean(np.abs(errors) < 1.96 * std):.0f} %",
        f"{np.sqrt(np.mean((errors / std) ** 2)):.2f}",
        f"{sum(one.named for one in outcomes)}",
        f"{np.median(ratios):.2f}" if ratios else "",
    ]
    return f"| {' | '.join(cells)} |"


def rows(kind: str, seeds: int, pool: Executor) -> list[str]:
    """Yield the rows of a kind of worlds."""
    fly, names, more = KINDS[kind]
    found = []
    for name in names:
        every = range(FIRST_REPORTED, FIRST_REPORTED + seeds)
        found.append(row(name + more, list(pool.map(fly, [name] * seeds, every))))
        print(found[-1], flush=True)
    return found


def main() -> None:
    """Print the table, and write it into the page."""
    parser = options(__doc__, seeds=12)
    parser.add_argument("--only", choices=list(KINDS), nargs="*", default=list(KINDS), help="kinds of worlds")
    given = parser.parse_args()
    with ProcessPoolExecutor(given.workers) as pool:
        lines = [HEAD, *(line for kind in given.only for line in rows(kind, given.seeds, pool))]
    if given.write:
        write_section(PAGE, "rooms", "\n".join(lines))


if __name__ == "__main__":
    main()
