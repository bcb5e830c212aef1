"""Protocols side by side in the same random world: what they know, what they cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS
from uwbsim.errors import ParameterError
from uwbsim.protocols.conditions import Conditions, calibrated, conditions_of
from uwbsim.protocols.monte_carlo import range_errors_m
from uwbsim.protocols.prediction import predict
from uwbsim.scenario.airtime import (
    RECEIVER_ON_S,
    TURNAROUND_S,
    after_marker_s,
    exchange_air_s,
    exchange_s,
    frame_s,
    message_bytes,
)
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario

MOST: Final = 50_000_000
"""Ranges a protocol of which quantiles are taken exactly: 400 MB of errors."""

SAMPLE: Final = 200_000
"""Errors of each protocol that are kept."""

WINNER_DELAYS_US: Final = (300, 600, 1000, 1500, 2000, 3000, 5000)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtocolErrors:
    """One protocol in a world: errors of raw ranges in metres, simulated and predicted, and what an exchange costs.

    `air_s` is how long its frames are on the air, `duration_s` how long it takes from the first preamble to the end of
    the last frame, `radio_on_s` how long the two radios send and listen together (a proxy of energy), `rate_hz` how
    many exchanges a second follow one another.
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
class Comparison:
    """Protocols beside each other in a scenario: what came out, and a sample of each one's errors in metres, by name.

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
    ['protocols', 'winners']
    """

    scenario: Scenario
    protocols: tuple[RangingProtocol, ...]
    outcomes: list[ProtocolErrors]
    samples: dict[str, Floats]

    @cached_property
    def winners(self) -> list[dict[str, Any]]:
        """Say for some delays of the scheduled reply which protocol errs least, as a calibration leaves it."""
        return winners(self.scenario, self.protocols)

    def to_dict(self) -> dict[str, Any]:
        """Return what `uwbsim compare --json` prints."""
        return {"protocols": [one.to_dict() for one in self.outcomes], "winners": self.winners}

    def __repr__(self) -> str:
        """Return a line a protocol."""
        lines = [
            f"{'protocol':10s}{'bias (cm)':>11s}{'predicted':>11s}{'std (cm)':>11s}{'predicted':>11s}{'air (us)':>10s}"
        ]
        for one in self.outcomes:
            errors = (one.bias_m, one.predicted_bias_m, one.std_m, one.predicted_std_m)
            lines.append(
                f"{one.protocol:10s}" + "".join(f"{100 * e:11.3f}" for e in errors) + f"{1e6 * one.air_s:10.0f}"
            )
        return "\n".join(lines)


Protocols = Sequence[str | RangingProtocol]


def chosen(protocols: Protocols | None, parameter: str = "protocols") -> list[RangingProtocol]:
    """Return rows of protocols, given as rows or by name, each once; None is all that there are.

    Raises `ParameterError` that lists what there is.
    """
    wanted = list(PROTOCOLS) if protocols is None else protocols
    rows: dict[str, RangingProtocol] = {}
    for one in wanted:
        if not isinstance(one, RangingProtocol) and one not in PROTOCOLS:
            raise ParameterError(f"found {one!r}, allowed: {', '.join(PROTOCOLS)}", parameter=parameter)
        row = one if isinstance(one, RangingProtocol) else PROTOCOLS[one]
        rows.setdefault(row.name, row)
    if not rows:
        raise ParameterError(f"found none, allowed: {', '.join(PROTOCOLS)}", parameter=parameter)
    return list(rows.values())


def compare(
    scenario: Scenario | Source,
    protocols: Protocols | None = None,
    count: int = 1_000_000,
    progress: Callable[[float], None] | None = None,
) -> Comparison:
    """Range `count` times with each protocol in one random world, with the same noise; say how raw ranges err.

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
    if not 1 <= count <= MOST:
        raise ParameterError(f"found {count}, expected 1 to {MOST}", parameter="count")
    conditions = conditions_of(scenario)
    outcomes, samples = [], {}
    for number, protocol in enumerate(rows):

        def report(share: float, number: int = number) -> None:
            if progress:
                progress((number + share) / len(rows))

        errors = range_errors_m(protocol, conditions, scenario.run.seed, count, report)
        outcomes.append(_outcome(scenario, protocol, conditions, errors))
        samples[protocol.name] = errors[:SAMPLE].copy()
    return Comparison(scenario=scenario, protocols=tuple(rows), outcomes=outcomes, samples=samples)


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
        air_s=cost["air_s"],
        duration_s=cost["duration_s"],
        radio_on_s=cost["radio_on_s"],
        rate_hz=1 / (cost["duration_s"] + TURNAROUND_S),
    )


def costs(scenario: Scenario, protocol: RangingProtocol, scheduled_s: float | None = None) -> dict[str, float]:
    """Return what an exchange takes: `air_s`, `duration_s`, `radio_on_s`.

    `scheduled_s` replaces the scenario's delay.
    """
    symbols = scenario.radio.preamble_symbols
    scheduled, at_once = scheduled_s or scenario.ranging.scheduled_s, scenario.ranging.at_once_s
    lengths = message_bytes(protocol)
    marker, end = 0.0, after_marker_s(lengths[0])
    radio = 2 * frame_s(lengths[0], symbols)
    for message, length in zip(protocol.messages[1:], lengths[1:], strict=True):
        marker += scheduled if message.timing == "scheduled" else at_once
        # The receiver listens from the end of the frame before, as soon as it is on again.
        listening = marker + after_marker_s(length) - end - RECEIVER_ON_S
        radio += frame_s(length, symbols) + max(listening, 0.0)
        end = marker + after_marker_s(length)
    return {
        "air_s": exchange_air_s(protocol, symbols),
        "duration_s": exchange_s(protocol, symbols, scheduled, at_once),
        "radio_on_s": radio,
    }


def winners(scenario: Scenario, protocols: Sequence[RangingProtocol]) -> list[dict[str, Any]]:
    """Say which protocol wins at which delay of the scheduled reply, as a calibration leaves it, by prediction.

    By `rmse`, a single range; by `per_second`, the mean of as many as one pair has in a second of its own
    (`Prediction.mean_of`), which is what counts where the air is full and ranges are averaged.
    """
    world = calibrated(conditions_of(scenario, 2048))
    rows = []
    for delay_us in WINNER_DELAYS_US:
        here = world.with_columns(scheduled=delay_us * 1e-6)
        rmse, score = {}, {}
        for protocol in protocols:
            found = predict(protocol, here)
            duration = costs(scenario, protocol, delay_us * 1e-6)["duration_s"] + TURNAROUND_S
            rmse[protocol.name] = float(np.sqrt(found.mean_of(1)))
            score[protocol.name] = found.mean_of(1 / duration)
        rows.append(
            {
                "scheduled_us": delay_us,
                "rmse": min(rmse, key=lambda name: rmse[name]),
                "per_second": min(score, key=lambda name: score[name]),
                **{f"rmse_m {name}": value for name, value in rmse.items()},
            }
        )
    return rows
