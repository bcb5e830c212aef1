"""Comparison of protocols in the same random world: errors, costs, error curves, and the best delay of a reply."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.table import RangingProtocol
from uwbsim.errors import ParameterError
from uwbsim.protocols.conditions import Conditions, Protocols, calibrated, chosen, conditions_of, range_errors_m
from uwbsim.protocols.prediction import FleetFigures, fleet_figures, predict
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.ranging import TURNAROUND_S, exchange_costs


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtocolErrors:
    """One protocol: errors of raw ranges in metres, simulated and predicted, and the cost of an exchange.

    `air_s` is the total duration of its frames, `duration_s` the time from the first preamble to the end of the last
    frame, `radio_on_s` the time for which the two radios send or listen (a proxy of energy), `rate_hz` the number of
    exchanges per second, one after the other.
    """

    protocol: str
    title: str
    ranges: int
    bias_m: float
    std_m: float
    rmse_m: float
    low_m: float
    median_m: float
    high_m: float
    predicted_bias_m: float
    predicted_std_m: float
    messages: int
    air_s: float
    duration_s: float
    radio_on_s: float
    rate_hz: float

    def to_dict(self) -> dict[str, Any]:
        """Return the outcome as a row of a table."""
        return asdict(self)


@dataclass(frozen=True, kw_only=True, repr=False)
class ProtocolComparison:
    """A comparison of protocols in a scenario: their outcomes, and samples of their errors in metres, by name.

    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> scenario = uwbsim.load(
    ...     {
    ...         "run": {"duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone"}],
    ...     }
    ... )
    >>> found = uwbsim.compare(scenario, ["ss-cfo", "ds"], count=1000)
    >>> found.winners[0]["scheduled_us"], found.winners[0]["rmse"]
    (300, 'ss-cfo')
    >>> sorted(found.to_dict())
    ['fleet', 'protocols', 'winners']
    """

    scenario: Scenario
    protocols: tuple[RangingProtocol, ...]
    outcomes: list[ProtocolErrors]
    samples: dict[str, Floats]

    @cached_property
    def fleet(self) -> list[FleetFigures]:
        """Predict errors and rates of the scenario's tags with each protocol, with broadcasts and as anchors."""
        scenario, world = self.scenario, calibrated(conditions_of(self.scenario, 2048))
        return fleet_figures(world, self.protocols, len(scenario.senders()), scenario.radio.preamble_symbols)

    @cached_property
    def winners(self) -> list[dict[str, Any]]:
        """Predict the protocol with the smallest error at some delays of the scheduled reply.

        Errors are those after a calibration. `rmse` compares single ranges; `per_second` compares the mean of all
        ranges of a pair in a second (`PredictedErrors.mean_of`), which matters if ranges are averaged.
        """
        world, rows = calibrated(conditions_of(self.scenario, 2048)), []
        for delay_us in (300, 600, 1000, 1500, 2000, 3000, 5000):
            rmse, score = {}, {}
            for protocol in self.protocols:
                _, one_m2, score[protocol.name] = _at_delay(self.scenario, protocol, world, delay_us * 1e-6)
                rmse[protocol.name] = math.sqrt(one_m2)
            rows.append(
                {
                    "scheduled_us": delay_us,
                    "rmse": min(rmse, key=lambda name: rmse[name]),
                    "per_second": min(score, key=lambda name: score[name]),
                    **{f"rmse_m {name}": value for name, value in rmse.items()},
                }
            )
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Return what `uwbsim compare --json` prints."""
        outcomes, fleet = ([one.to_dict() for one in rows] for rows in (self.outcomes, self.fleet))
        return {"protocols": outcomes, "winners": self.winners, "fleet": fleet}

    def __repr__(self) -> str:
        """Return a line a protocol."""
        rows = [
            f"{one.protocol:10s}{100 * one.bias_m:11.3f}{100 * one.predicted_bias_m:11.3f}{100 * one.std_m:11.3f}"
            f"{100 * one.predicted_std_m:11.3f}{1e6 * one.air_s:10.0f}"
            for one in self.outcomes
        ]
        head = (
            f"{'protocol':10s}{'bias (cm)':>11s}{'predicted':>11s}{'std (cm)':>11s}{'predicted':>11s}{'air (us)':>10s}"
        )
        return "\n".join([head, *rows])


def compare(
    scenario: Scenario | Source,
    protocols: Protocols | None = None,
    count: int = 1_000_000,
    progress: Callable[[float], None] | None = None,
) -> ProtocolComparison:
    """Simulate `count` ranges with each protocol in one random world, with the same noise; return their errors.

    `scenario` is whatever `load` takes, or a `Scenario`; `protocols` are names or rows of `PROTOCOLS`, None for all,
    those included that were registered. `progress` is called with the done fraction, 0 to 1. Raises `ParameterError`
    for an unknown protocol, and for a `count` that is not 1 to 50 million.

    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> found = uwbsim.compare(
    ...     {
    ...         "run": {"duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0, "response_delay_uus": 1500},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast", "skew_ppm": 2.0}, {"id": 2, "body": "drone", "skew_ppm": -2.0}],
    ...     },
    ...     ["ss", "ds"],
    ...     count=10_000,
    ... )
    >>> [(one.protocol, round(abs(one.bias_m), 1)) for one in found.outcomes]
    [('ss', 0.9), ('ds', 0.0)]
    >>> found.samples["ds"].shape
    (10000,)
    """
    scenario, rows = as_scenario(scenario), chosen(protocols)
    most = 50_000_000  # 400 MB of errors per protocol, for exact quantiles
    if not 1 <= count <= most:
        raise ParameterError(f"found {count}, expected 1 to {most}", parameter="count")
    conditions = conditions_of(scenario)
    outcomes, samples = [], {}
    for number, protocol in enumerate(rows):

        def report(share: float, number: int = number) -> None:
            if progress:
                progress((number + share) / len(rows))

        errors = range_errors_m(protocol, conditions, scenario.run.seed, count, report)
        outcomes.append(_outcome(scenario, protocol, conditions, errors))
        samples[protocol.name] = errors[:200_000].copy()
    return ProtocolComparison(scenario=scenario, protocols=tuple(rows), outcomes=outcomes, samples=samples)


def _outcome(scenario: Scenario, protocol: RangingProtocol, conditions: Conditions, errors: Floats) -> ProtocolErrors:
    low, median, high = np.quantile(errors, (0.025, 0.5, 0.975))
    bias, variance = predict(protocol, conditions).pooled()
    cost = costs(scenario, protocol)
    return ProtocolErrors(
        protocol=protocol.name,
        title=protocol.title,
        ranges=len(errors),
        bias_m=float(np.mean(errors)),
        std_m=float(np.std(errors)),
        rmse_m=float(np.sqrt(np.mean(errors**2))),
        low_m=float(low),
        median_m=float(median),
        high_m=float(high),
        predicted_bias_m=bias,
        predicted_std_m=float(np.sqrt(variance)),
        messages=len(protocol.messages),
        **cost,
        rate_hz=1 / (cost["duration_s"] + TURNAROUND_S),
    )


def costs(scenario: Scenario, protocol: RangingProtocol, scheduled_s: float | None = None) -> dict[str, float]:
    """Return the durations of an exchange: `air_s`, `duration_s`, `radio_on_s`.

    `scheduled_s` replaces the scenario's delay.
    """
    ranging = scenario.ranging
    return exchange_costs(
        protocol, scenario.radio.preamble_symbols, scheduled_s or ranging.scheduled_s, ranging.reply.median_s
    )


def _at_delay(
    scenario: Scenario, protocol: RangingProtocol, world: Conditions, delay_s: float, overhead_s: float = 0.0
) -> tuple[float, float, float]:
    """Return the duration of an exchange whose scheduled message has this delay, turnaround included, and its errors.

    These are the mean squared error of one range, and of the mean of a second of them.
    """
    duration = costs(scenario, protocol, delay_s)["duration_s"] + TURNAROUND_S + overhead_s
    found = predict(protocol, world.with_columns(scheduled=delay_s))
    return duration, found.mean_of(1), found.mean_of(1 / duration)


@dataclass(frozen=True, slots=True)
class ErrorCurve:
    """Error over a quantity `x`: mean and standard deviation, simulated and predicted, metres, (n,) each."""

    x: Floats
    bias_m: Floats
    std_m: Floats
    predicted_bias_m: Floats
    predicted_std_m: Floats


def over_skew(scenario: Scenario, protocol: RangingProtocol, count: int = 16_384) -> ErrorCurve:
    """Return the error over the relative skew of the two clocks in ppm, all else as in the scenario."""
    skews = np.linspace(-20, 20, 17)
    return _curve(scenario, protocol, count, skews, lambda ppm: {"rate": np.array([[ppm], [-ppm]]) * 0.5e-6})


def over_reply(scenario: Scenario, protocol: RangingProtocol, count: int = 16_384) -> ErrorCurve:
    """Return the error over the delay of the scheduled message in microseconds."""
    return _curve(scenario, protocol, count, np.geomspace(300, 6000, 15), lambda delay: {"scheduled": delay * 1e-6})


def _curve(
    scenario: Scenario,
    protocol: RangingProtocol,
    count: int,
    x: Floats,
    columns: Callable[[float], Mapping[str, float | Floats]],
) -> ErrorCurve:
    """Return the error over values (n,) for which `columns` of the calibrated conditions change."""
    world = calibrated(conditions_of(scenario, 2048))
    worlds = [world.with_columns(**columns(value)) for value in x.tolist()]
    errors = [range_errors_m(protocol, one, scenario.run.seed, count) for one in worlds]
    pooled = np.array([predict(protocol, one).pooled() for one in worlds])
    means, spreads = (np.array([f(e) for e in errors]) for f in (np.mean, np.std))
    return ErrorCurve(x, means, spreads, pooled[:, 0], np.sqrt(pooled[:, 1]))


def over_state(protocol: RangingProtocol, conditions: Conditions, values: Floats, errors: Floats) -> ErrorCurve:
    """Return the error over a property of the states, `values` (states,), from `errors` of ranges in these in turn."""
    # Range k has the state k modulo their number: of few ranges some states have none.
    values = values[: len(errors)]
    rows = []
    for states in np.array_split(np.argsort(values), min(14, len(values))):
        own = errors[np.isin(np.arange(len(errors)) % len(values), states)]
        bias, variance = predict(protocol, conditions[states]).pooled()
        rows.append((np.median(values[states]), own.mean(), own.std(), bias, np.sqrt(variance)))
    return ErrorCurve(*np.array(rows).T)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class BestDelay:
    """The best delay, and the curve: delays in seconds, mean squared error of a range and of a second of them in m^2.

    `rms_m` is the error of one range, `second_rms_m` that of the mean of all ranges of a pair in a second: noise
    decreases with their number, the bias by skew does not. `duration_s` is the time of one, turnaround included.
    `on_edge` says that the best delay is the shortest or the longest one that boards accept.
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
        edge = " (at the limit of the boards)" if self.on_edge else ""
        return (
            f"{self.protocol}: best delay {1e6 * self.delay_s:.0f} µs{edge}, one range {100 * self.rms_m:.2f} cm in "
            f"{1e6 * self.duration_s:.0f} µs, mean of a second {1e3 * self.second_rms_m:.3f} mm"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return what `uwbsim optimum --json` prints."""
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(self).items()}


def optimum(scenario: Scenario | Source, protocol: str | RangingProtocol = "ds", overhead_s: float = 0.0) -> BestDelay:
    """Minimise the mean squared error of the mean of a second's exchanges over the delay of the scheduled message.

    A second holds 1/duration exchanges of a pair, one after the other at the boards' turnaround. The variance of their
    mean is that of one times the duration; the bias by skew, drift and motion is that of one. Antenna delays, power
    bias and reflections are left out: they do not depend on the delay, and calibration removes them. `scenario` is
    whatever `load` takes, or a `Scenario`, `protocol` a name or a row of `PROTOCOLS`; `overhead_s` is additional time
    per exchange in seconds (others on the air). Raises `ParameterError`.

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
    # From 280 UWB microseconds on, below which boards miss the time to send (firmware wire format), to their longest.
    delays = np.geomspace(287e-6, 6.6e-3, 121)

    tried = partial(_at_delay, scenario, protocol, world, overhead_s=overhead_s)
    _, one, second = np.array([tried(float(delay)) for delay in delays]).T
    best = int(np.argmin(second))
    low, high = delays[max(best - 1, 0)], delays[min(best + 1, len(delays) - 1)]
    refined = minimize_scalar(lambda d: tried(d)[2], bounds=(low, high), method="bounded", options={"xatol": 1e-8})
    delay = min((float(refined.x), float(delays[best])), key=lambda d: tried(d)[2])
    duration_s, one_m2, second_m2 = tried(delay)
    return BestDelay(
        protocol=protocol.name,
        delay_s=delay,
        rms_m=math.sqrt(one_m2),
        duration_s=duration_s,
        second_rms_m=math.sqrt(second_m2),
        on_edge=best in (0, len(delays) - 1),
        delays_s=delays,
        range_m2=one,
        second_m2=second,
    )
