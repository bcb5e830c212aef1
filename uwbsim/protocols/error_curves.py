"""Errors over what they depend on (relative skew, reply delay, a quantity of the states), beside their prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.rows import RangingProtocol
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.protocols.conditions import Conditions, calibrated, conditions_of
from uwbsim.protocols.monte_carlo import range_errors_m
from uwbsim.protocols.prediction import predict
from uwbsim.scenario.model import Scenario


@dataclass(frozen=True, slots=True)
class ErrorCurve:
    """Error over something: where, simulated mean and spread, predicted mean and spread, metres, (n,) each."""

    x: Floats
    bias_m: Floats
    std_m: Floats
    predicted_bias_m: Floats
    predicted_std_m: Floats


def over_skew(scenario: Scenario, protocol: RangingProtocol, count: int = 16_384) -> ErrorCurve:
    """Error over the relative skew of the two clocks, in ppm, everything else as in the scenario."""
    world = calibrated(conditions_of(scenario, 2048))
    skews = np.linspace(-20, 20, 17)
    worlds = [world.with_columns(rate_initiator=s * 0.5e-6, rate_target=-s * 0.5e-6) for s in skews]
    return _curve(protocol, skews, worlds, scenario.run.seed, count)


def over_reply(scenario: Scenario, protocol: RangingProtocol, count: int = 16_384) -> ErrorCurve:
    """Error over the delay of the scheduled message, in microseconds."""
    world = calibrated(conditions_of(scenario, 2048))
    delays = np.geomspace(300, 6000, 15)
    worlds = [world.with_columns(scheduled=delay * 1e-6) for delay in delays]
    return _curve(protocol, delays, worlds, scenario.run.seed, count)


def _curve(protocol: RangingProtocol, x: Floats, worlds: Sequence[Conditions], seed: int, count: int) -> ErrorCurve:
    errors = [range_errors_m(protocol, world, seed, count) for world in worlds]
    pooled = np.array([predict(protocol, world).pooled() for world in worlds])
    means, spreads = (np.array([f(e) for e in errors]) for f in (np.mean, np.std))
    return ErrorCurve(x, means, spreads, pooled[:, 0], np.sqrt(pooled[:, 1]))


def over_state(
    protocol: RangingProtocol, conditions: Conditions, values: Floats, errors: Floats, groups: int = 14
) -> ErrorCurve:
    """Error over something that the states have, `values` (states,), from `errors` that met them in turn."""
    used = np.resize(np.arange(len(conditions)), len(errors))
    prediction = predict(protocol, conditions)
    parts = np.array_split(np.argsort(values), groups)
    place = np.empty(len(conditions), dtype=np.int64)
    for k, rows in enumerate(parts):
        place[rows] = k
    group = place[used]
    counts = np.maximum(np.bincount(group, minlength=groups), 1)
    mean = np.bincount(group, errors, groups) / counts
    std = np.sqrt(np.maximum(np.bincount(group, errors**2, groups) / counts - mean**2, 0))
    means = np.array([prediction.mean_m[rows].mean() for rows in parts])
    spreads = np.array([prediction.variance_m2[rows].mean() + prediction.mean_m[rows].var() for rows in parts])
    middles = np.array([np.median(values[rows]) for rows in parts])
    return ErrorCurve(middles, mean, std, means, np.sqrt(spreads))


def paper_bias_m(skew_ppm: float, reply_s: float) -> float:
    """Return the bias of SS-TWR, c/2 times relative skew times reply (ICRA 2023, section II)."""
    return 0.5 * SPEED_OF_LIGHT * skew_ppm * 1e-6 * reply_s
