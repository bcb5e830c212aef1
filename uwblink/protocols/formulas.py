"""The formulas of the protocols: time of flight from intervals, and what antenna delays do to it.

Each maps `Intervals` of n exchanges to ticks (n,), or to a pair of dimensionless weights (n,).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwblink.arrays import Floats


@dataclass(frozen=True, slots=True)
class Intervals:
    """Durations of an exchange in ticks of the clock that measured them, float64, shape (n,).

    dt41 is the initiator's round trip, dt32 the target's reply; dt53 and dt64 are the third leg as its sender and its
    receiver count it, without meaning where there is no third message. `carrier_ppm` is how much faster than the
    target's the initiator's clock runs by its carrier integrator, on the response; NaN if unknown.
    """

    dt41: Floats
    dt32: Floats
    dt53: Floats
    dt64: Floats
    carrier_ppm: Floats


def single_sided(t: Intervals) -> Floats:
    """ICRA 2023, eq. (1)."""
    return (t.dt41 - t.dt32) / 2


def carrier_corrected(t: Intervals) -> Floats:
    """ICRA 2023, eq. (1), with the reply rescaled by the clocks' ratio as the carrier integrator has it."""
    # Taken apart, so that what is left of two long times is not rounded twice.
    return (t.dt41 - t.dt32 - t.carrier_ppm * 1e-6 * t.dt32) / 2


def double_sided(t: Intervals) -> Floats:
    """ICRA 2023, eq. (2): the target's reply is rescaled by K = dt64/dt53."""
    with np.errstate(invalid="ignore"):  # an infinite ratio of a reply of zero, as of stamps that are all the same
        return (t.dt41 - _clock_ratio(t) * t.dt32) / 2


def _clock_ratio(t: Intervals) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return t.dt64 / t.dt53


def alternative(t: Intervals) -> Floats:
    """Neirynck, Luk, McLaughlin, WPNC 2016: (R1 R2 - D1 D2) / (R1 + R2 + D1 + D2)."""
    # R1 R2 - D1 D2 cancels twenty digits: with R = D + e it is D1 e2 + D2 e1 + e1 e2, which does
    # not cancel (e1 and e2 are near twice the flight time plus what the skew adds).
    e1 = t.dt41 - t.dt32
    e2 = t.dt64 - t.dt53
    numerator = t.dt32 * e2 + t.dt53 * e1 + e1 * e2
    with np.errstate(divide="ignore", invalid="ignore"):
        return numerator / (t.dt41 + t.dt64 + t.dt32 + t.dt53)


def half_delays(t: Intervals) -> tuple[Floats, Floats]:
    """Weights of SS-TWR: each delay is half in the time of flight."""
    half = np.full_like(t.dt41, 0.5)
    return half, half


def carrier_delays(t: Intervals) -> tuple[Floats, Floats]:
    """Weights of `carrier_corrected`: the reply, and with it the target's delay, is rescaled."""
    return np.full_like(t.dt41, 0.5), (1 + t.carrier_ppm * 1e-6) / 2


def double_sided_delays(t: Intervals) -> tuple[Floats, Floats]:
    """Weights of `double_sided`, ICRA 2023, section III: 1/2 and K/2."""
    return np.full_like(t.dt41, 0.5), _clock_ratio(t) / 2


def alternative_delays(t: Intervals) -> tuple[Floats, Floats]:
    """Weights of `alternative`: its derivatives by what each delay adds to a round trip and takes from a reply."""
    with np.errstate(divide="ignore", invalid="ignore"):
        total = t.dt41 + t.dt64 + t.dt32 + t.dt53
        return (t.dt64 + t.dt32) / total, (t.dt41 + t.dt53) / total
