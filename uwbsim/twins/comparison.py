"""A recording and its twin side by side: distributions, dependence, and whether chance explains the difference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from scipy.special import kolmogorov

from uwblink.arrays import Floats, Ints
from uwblink.ticks import TICK_S
from uwblink.twr import intervals
from uwbsim.errors import ParameterError
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.run import simulate
from uwbsim.twins.calibration_file import KnownDevices
from uwbsim.twins.flight import Flight
from uwbsim.twins.persistence import effective_size, lag_one, some_rows

LEVEL: Final = 0.01
"""Below this probability chance does not explain a difference."""

SIMULATED: Final = 6000
"""Exchanges that are simulated in all, at least, unless there are four times as many measured."""

MOST_SEEDS: Final = 8
SHOWN: Final = 4000
"""Values that are kept of each side for pictures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """One quantity in a recording and in its twin.

    Quantiles are of all values; `lag1_*` is the autocorrelation to the pair's next value, about the mean of all.
    `worth_*` is how many independent values the values are worth, `distance` the largest difference of the cumulative
    shares, and `probability` how likely chance makes it as large as that where both are the same (Kolmogorov and
    Smirnov, with sizes as the values are worth). `alike` says whether that is more than `LEVEL`.
    """

    name: str
    unit: str
    measured: Floats
    simulated: Floats
    count: int
    median_measured: float
    median_simulated: float
    low_measured: float
    low_simulated: float
    high_measured: float
    high_simulated: float
    lag1_measured: float
    lag1_simulated: float
    worth_measured: float
    worth_simulated: float
    distance: float
    probability: float
    pairs: dict[str, dict[str, float]]

    @property
    def alike(self) -> bool:
        """Return whether chance explains the difference."""
        return self.probability > LEVEL

    def to_dict(self) -> dict[str, Any]:
        """Return the figures, JSON-ready, without the values."""
        table = asdict(self)
        values = {key: value for key, value in table.items() if key not in ("measured", "simulated")}
        numbers = {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in values.items()}
        return numbers | {"alike": self.alike}


Column = Callable[[Flight], Floats]
QUANTITIES: Final[dict[str, tuple[str, Column]]] = {
    "reply dt32": ("us", lambda f: intervals(f.exchanges).dt32 * TICK_S * 1e6),
    "first-path power at target": ("dBm", lambda f: f.exchanges.fpp1_dbm),
    "first-path power at initiator": ("dBm", lambda f: f.exchanges.fpp2_dbm),
    "difference of the two powers": ("dB", lambda f: f.exchanges.fpp1_dbm - f.exchanges.fpp2_dbm),
    "carrier reading at initiator": ("ppm", lambda f: f.exchanges.skew2_ppm),
    "sum of both carrier readings": ("ppm", lambda f: f.exchanges.skew1_ppm + f.exchanges.skew2_ppm),
    "skew by dt64/dt53": ("ppm", lambda f: f.ratio_ppm),
    "ratio less carrier readings": ("ppm", lambda f: f.ratio_ppm - (f.exchanges.skew2_ppm - f.exchanges.skew1_ppm) / 2),
    "residual of calibrated ranges": ("m", lambda f: f.residual_m),
}
"""What is compared, of which unit, one value an exchange; columns without values are left out."""


def compare_flights(
    measured: Flight,
    known: KnownDevices,
    scenario: Scenario,
    seeds: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[Compared]:
    """Simulate a scenario with seeds 1, 2 and so on, and compare; raises `ParameterError` for less than one seed."""
    if seeds is not None and (isinstance(seeds, bool) or not isinstance(seeds, int) or seeds < 1):
        raise ParameterError(f"found {seeds!r}, expected a whole number from 1 on", parameter="seeds")
    count = seeds or int(np.clip(-(-SIMULATED // len(measured)), 1, MOST_SEEDS))
    flights = []
    for k in range(count):
        one = scenario.model_copy(update={"run": scenario.run.model_copy(update={"seed": k + 1})})
        flights.append(Flight.of(simulate(one), known, "the simulated twin", fewest=2))
        if progress:
            progress((k + 1) / count)
    found = [_compared(name, measured, flights) for name in QUANTITIES]
    return [one for one in found if one is not None]


def _compared(name: str, measured: Flight, flights: list[Flight]) -> Compared | None:
    unit, column = QUANTITIES[name]
    mine, group = _finite(column(measured), measured.pair)
    parts = [_finite(column(flight), flight.pair) for flight in flights]
    if len(mine) < 8 or not all(len(values) for values, _ in parts):
        return None
    # A seed's pairs are pairs of their own.
    span = max(int(pairs.max()) for _, pairs in parts) + 1
    theirs = np.concatenate([values for values, _ in parts])
    theirs_group = np.concatenate([pairs + k * span for k, (_, pairs) in enumerate(parts)])
    worth = effective_size(mine, group), float(sum(effective_size(*part) for part in parts))
    distance = _distance(mine, theirs)
    low, middle, high = (
        (float(np.quantile(mine, level)), float(np.quantile(theirs, level))) for level in (0.1, 0.5, 0.9)
    )
    return Compared(
        name=name,
        unit=unit,
        measured=_thinned(mine),
        simulated=_thinned(theirs),
        count=len(mine),
        median_measured=middle[0],
        median_simulated=middle[1],
        low_measured=low[0],
        low_simulated=low[1],
        high_measured=high[0],
        high_simulated=high[1],
        lag1_measured=lag_one(mine, group),
        lag1_simulated=lag_one(theirs, theirs_group),
        worth_measured=worth[0],
        worth_simulated=worth[1],
        distance=distance,
        probability=float(kolmogorov(distance * np.sqrt(worth[0] * worth[1] / (worth[0] + worth[1])))),
        pairs=_by_pair(measured, column(measured), [(flight, column(flight)) for flight in flights]),
    )


def _finite(values: Floats, pair: Ints) -> tuple[Floats, Ints]:
    good = np.isfinite(values)
    return np.asarray(values[good], dtype=np.float64), pair[good]


def _distance(one: Floats, other: Floats) -> float:
    """Return the largest difference of the two cumulative shares."""
    at = np.sort(np.concatenate([one, other]))
    shares = (np.searchsorted(np.sort(values), at, side="right") / len(values) for values in (one, other))
    first, second = shares
    return float(np.max(np.abs(first - second)))


def _thinned(values: Floats) -> Floats:
    return values[some_rows(len(values), SHOWN)]


def _by_pair(measured: Flight, values: Floats, simulated: list[tuple[Flight, Floats]]) -> dict[str, dict[str, float]]:
    """Return medians, 90 % quantiles and autocorrelations of both sides by pair."""
    found = {}
    for k, pair in enumerate(measured.pairs):
        mine = values[measured.pair == k]
        theirs = [
            column[flight.pair == flight.pairs.index(pair)] for flight, column in simulated if pair in flight.pairs
        ]
        if not theirs:
            continue
        groups = np.repeat(np.arange(len(theirs)), [len(part) for part in theirs])
        together = np.concatenate(theirs)
        found[f"{pair[0]}-{pair[1]}"] = {
            "count": float(len(mine)),
            "median_measured": float(np.median(mine)),
            "median_simulated": float(np.median(together)),
            "high_measured": float(np.quantile(mine, 0.9)),
            "high_simulated": float(np.quantile(together, 0.9)),
            "lag1_measured": lag_one(mine, np.zeros(len(mine), np.int64)),
            "lag1_simulated": lag_one(together, groups),
        }
    return found
