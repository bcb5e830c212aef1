"""The delay of the scheduled message that gives the most accurate ranging for the time that it takes."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.rows import RangingProtocol
from uwbsim.errors import ParameterError
from uwbsim.protocols.comparison import calibrated, chosen, costs
from uwbsim.protocols.conditions import Conditions, conditions_of
from uwbsim.protocols.prediction import predict
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario

SHORTEST_S: Final = 287e-6
"""280 UWB microseconds, below which the boards miss the time to send (firmware wire format)."""

LONGEST_S: Final = 6.6e-3
POINTS: Final = 121


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Optimum:
    """The best delay, and the curve: delays in seconds, variance of a range in m^2, and variance times time in m^2 s.

    `on_edge` says that the best delay is the shortest or the longest one that boards take.
    """

    protocol: str
    delay_s: float
    std_m: float
    duration_s: float
    score_m2s: float
    on_edge: bool
    delays_s: Floats
    variance_m2: Floats
    scores_m2s: Floats

    def __repr__(self) -> str:
        """Return one line."""
        edge = " (the edge of what boards take)" if self.on_edge else ""
        return (
            f"{self.protocol}: best delay {1e6 * self.delay_s:.0f} us{edge}, one range {100 * self.std_m:.2f} cm in "
            f"{1e6 * self.duration_s:.0f} us, mean of a second {1e3 * self.score_m2s**0.5:.3f} mm"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return what `uwbsim optimum --json` prints."""
        document = asdict(self)
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in document.items()}


def optimum(scenario: Scenario | Source, protocol: str | RangingProtocol = "ds", overhead_s: float = 0.0) -> Optimum:
    """Minimise mean squared error times duration over the delay of the scheduled message.

    A second of air holds 1/duration exchanges, whose mean has the variance of one times the duration. Antenna delays,
    power bias and reflections are left out: calibration deals with them, and no delay does. `scenario` is whatever
    `load` takes, or a `Scenario`, `protocol` a name or a row of `PROTOCOLS`; `overhead_s` is what an exchange takes
    besides, in seconds (commands, turnaround). Raises `ParameterError`.

    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> best = uwbsim.optimum(
    ...     {
    ...         "run": {"duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone"}],
    ...     }
    ... )
    >>> best.on_edge, 500e-6 < best.delay_s < 1500e-6
    (False, True)
    """
    from scipy.optimize import minimize_scalar

    scenario, (protocol,) = as_scenario(scenario), chosen([protocol], "protocol")
    if not (math.isfinite(overhead_s) and overhead_s >= 0):
        raise ParameterError(f"found {overhead_s}, expected seconds, 0 or more", parameter="overhead_s")
    world = calibrated(conditions_of(scenario, 2048))
    # The grid of delayed transmissions would show as teeth of 8 ns on the curve.
    world = replace(world, quantize=False)
    delays = np.geomspace(SHORTEST_S, LONGEST_S, POINTS)
    squares = np.array([_square_m2(protocol, world, delay) for delay in delays])
    durations = np.array([costs(scenario, protocol, float(d))["duration_s"] + overhead_s for d in delays])
    scores = squares * durations
    best = int(np.argmin(scores))
    low, high = delays[max(best - 1, 0)], delays[min(best + 1, POINTS - 1)]

    def score(delay: float) -> float:
        return _square_m2(protocol, world, delay) * (costs(scenario, protocol, delay)["duration_s"] + overhead_s)

    refined = float(minimize_scalar(score, bounds=(low, high), method="bounded", options={"xatol": 1e-8}).x)
    delay = min((refined, float(delays[best])), key=score)
    return Optimum(
        protocol=protocol.name,
        delay_s=delay,
        std_m=float(np.sqrt(_square_m2(protocol, world, delay))),
        duration_s=costs(scenario, protocol, delay)["duration_s"] + overhead_s,
        score_m2s=score(delay),
        on_edge=best in (0, POINTS - 1),
        delays_s=delays,
        variance_m2=squares,
        scores_m2s=scores,
    )


def _square_m2(protocol: RangingProtocol, world: Conditions, delay_s: float) -> float:
    bias, variance = predict(protocol, world.with_columns(scheduled=delay_s)).pooled()
    return bias**2 + variance
