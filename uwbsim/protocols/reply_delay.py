"""The delay of the scheduled message that gives the most accurate ranging for the time that it takes."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.rows import RangingProtocol
from uwbsim.errors import ParameterError
from uwbsim.protocols.comparison import chosen, costs
from uwbsim.protocols.conditions import calibrated, conditions_of
from uwbsim.protocols.prediction import predict
from uwbsim.scenario.airtime import TURNAROUND_S
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario

SHORTEST_S: Final = 287e-6
"""280 UWB microseconds, below which the boards miss the time to send (firmware wire format)."""

LONGEST_S: Final = 6.6e-3
POINTS: Final = 121


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Optimum:
    """The best delay, and the curve: delays in seconds, mean squared error of a range and of a second of them in m^2.

    `rms_m` is the error of one range, `second_rms_m` that of the mean of as many as a pair has in a second: noise
    averages away with their number, what skew leaves does not. `duration_s` is how long one takes, turnaround included.
    `on_edge` says that the best delay is the shortest or the longest one that boards take.
    """

    protocol: str
    delay_s: float
    rms_m: float
    duration_s: float
    second_rms_m: float
    on_edge: bool
    delays_s: Floats
    range_m2: Floats
    second_m2: Floats

    def __repr__(self) -> str:
        """Return one line."""
        edge = " (the edge of what boards take)" if self.on_edge else ""
        return (
            f"{self.protocol}: best delay {1e6 * self.delay_s:.0f} µs{edge}, one range {100 * self.rms_m:.2f} cm in "
            f"{1e6 * self.duration_s:.0f} µs, mean of a second {1e3 * self.second_rms_m:.3f} mm"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return what `uwbsim optimum --json` prints."""
        document = asdict(self)
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in document.items()}


def optimum(scenario: Scenario | Source, protocol: str | RangingProtocol = "ds", overhead_s: float = 0.0) -> Optimum:
    """Minimise the mean squared error of the mean of a second's exchanges over the delay of the scheduled message.

    A second holds 1/duration exchanges of a pair, one after the other at the boards' turnaround. The variance of their
    mean is that of one times the duration; the bias that skew, drift and motion leave is that of one. Antenna delays,
    power bias and reflections are left out: calibration deals with them, and no delay does. `scenario` is whatever
    `load` takes, or a `Scenario`, `protocol` a name or a row of `PROTOCOLS`; `overhead_s` is what an exchange takes
    besides, in seconds (others on the air). Raises `ParameterError`.

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

    def duration(delay: float) -> float:
        return costs(scenario, protocol, delay)["duration_s"] + TURNAROUND_S + overhead_s

    def errors(delay: float) -> tuple[float, float]:
        """Return the mean squared error of one range, and of the mean of a second of them."""
        found = predict(protocol, world.with_columns(scheduled=delay))
        return found.mean_of(1), found.mean_of(1 / duration(delay))

    one, second = np.array([errors(float(delay)) for delay in delays]).T
    best = int(np.argmin(second))
    low, high = delays[max(best - 1, 0)], delays[min(best + 1, POINTS - 1)]
    refined = minimize_scalar(lambda d: errors(d)[1], bounds=(low, high), method="bounded", options={"xatol": 1e-8})
    delay = min((float(refined.x), float(delays[best])), key=lambda d: errors(d)[1])
    one_m2, second_m2 = errors(delay)
    return Optimum(
        protocol=protocol.name,
        delay_s=delay,
        rms_m=math.sqrt(one_m2),
        duration_s=duration(delay),
        second_rms_m=math.sqrt(second_m2),
        on_edge=best in (0, POINTS - 1),
        delays_s=delays,
        range_m2=one,
        second_m2=second,
    )
